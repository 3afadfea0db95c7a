// ManifestExchange: every rank tells the owners which inputs it will send, and all learn when all owners
// know. Counts come from the senders only, so owner and contributor can not disagree about visibility.
//
// Each rank sends one manifest to each owner that it touches; the owner acknowledges; a rank whose manifests are all
// acknowledged enters a reduction, and when that is done every manifest has arrived everywhere.
#pragma once

#include <dfb/comm/byte_io.hpp>

#include <cstddef>
#include <cstdint>
#include <map>
#include <mutex>
#include <utility>
#include <vector>

namespace dfb {

// One input that a rank will send for a tile (for each pass of the frame): generation 1, without children.
struct TileInput {
    int tile = 0;
    std::uint32_t source = 0;
    std::uint16_t part = 0;
};

} // namespace dfb

namespace dfb::detail {

// Something that will come for a tile.
struct ExpectedInput {
    std::uint32_t source = 0;
    std::uint16_t part = 0;
    int rank = 0; // that has said so
};
using ExpectedInputs = std::map<int, std::vector<ExpectedInput>>; // per tile

class ManifestExchange {
public:
    void reset()
    {
        std::lock_guard<std::mutex> lock(mutex_);
        expected_.clear();
        acksMissing_ = 0;
        declared_ = false;
    }

    // What to send to whom, for the inputs of this rank. `ownerOf(tile)` gives the owner.
    template <class OwnerOf>
    std::map<int, std::vector<std::byte>> split(const std::vector<TileInput>& inputs, int rank, const OwnerOf& ownerOf)
    {
        std::map<int, ByteWriter> writers;
        std::lock_guard<std::mutex> lock(mutex_);
        declared_ = true;
        for (const TileInput& input : inputs) {
            const int owner = ownerOf(input.tile);
            if (owner == rank) {
                expected_[input.tile].push_back({input.source, input.part, rank});
                continue;
            }
            ByteWriter& out = writers[owner];
            out.put(static_cast<std::int32_t>(input.tile));
            out.put(input.source);
            out.put(input.part);
        }
        std::map<int, std::vector<std::byte>> result;
        for (auto& [owner, writer] : writers)
            result.emplace(owner, writer.take());
        acksMissing_ = result.size();
        return result;
    }

    // The owner's side, with a manifest of rank `from`. Throws Error (MalformedMessage); `isMine(tile)` tells which
    // tiles can be meant.
    template <class IsMine>
    void receive(int from, ByteReader in, const IsMine& isMine)
    {
        std::lock_guard<std::mutex> lock(mutex_);
        while (in.left() > 0) {
            const int tile = in.get<std::int32_t>();
            const auto source = in.get<std::uint32_t>();
            const auto part = in.get<std::uint16_t>();
            if (!isMine(tile)) {
                ErrorInfo info;
                info.kind = ErrorKind::MalformedMessage;
                info.tile = tile;
                info.source = source;
                info.message = "a manifest names a tile of another owner";
                throw Error(std::move(info));
            }
            expected_[tile].push_back({source, part, from});
        }
    }

    // True if this was the last acknowledgement that was missing.
    bool acknowledged()
    {
        std::lock_guard<std::mutex> lock(mutex_);
        return acksMissing_ > 0 && --acksMissing_ == 0;
    }

    bool declared() const
    {
        std::lock_guard<std::mutex> lock(mutex_);
        return declared_;
    }

    // Per owned tile what will come. To be read when the exchange is complete.
    const ExpectedInputs& expected() const { return expected_; }

private:
    mutable std::mutex mutex_;
    ExpectedInputs expected_;
    std::size_t acksMissing_ = 0;
    bool declared_ = false;
};

} // namespace dfb::detail
