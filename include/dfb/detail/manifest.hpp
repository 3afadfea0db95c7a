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
#include <set>
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
        acksMissing_.clear();
        declared_ = isComplete_ = false;
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
        for (const auto& [owner, manifest] : result)
            acksMissing_.insert(owner);
        return result;
    }

    // The owner's side, with a manifest of rank `from`. Throws Error (MalformedMessage); `isMine(tile)` tells which
    // tiles can be meant.
    template <class IsMine>
    void receive(int from, ByteReader in, const IsMine& isMine)
    {
        std::lock_guard<std::mutex> lock(mutex_);
        if (isComplete_)
            fail("a manifest after all ranks have declared");
        while (in.left() > 0) {
            const int tile = in.get<std::int32_t>();
            const auto source = in.get<std::uint32_t>();
            const auto part = in.get<std::uint16_t>();
            if (!isMine(tile))
                fail("a manifest names a tile of another owner", tile, source);
            expected_[tile].push_back({source, part, from});
        }
    }

    // By rank `from`. True if this was the last acknowledgement that was missing. Throws Error (MalformedMessage).
    bool acknowledged(int from)
    {
        std::lock_guard<std::mutex> lock(mutex_);
        if (acksMissing_.erase(from) == 0)
            fail("an answer to a manifest that was not sent");
        return acksMissing_.empty();
    }

    // The exchange is over: from now on expected() may be read.
    void complete()
    {
        std::lock_guard<std::mutex> lock(mutex_);
        isComplete_ = true;
    }

    bool declared() const
    {
        std::lock_guard<std::mutex> lock(mutex_);
        return declared_;
    }

    // Per owned tile what will come. To be read after complete().
    const ExpectedInputs& expected() const { return expected_; }

private:
    [[noreturn]] static void fail(const char* message, std::int64_t tile = -1, std::int64_t source = -1)
    {
        ErrorInfo info;
        info.kind = ErrorKind::MalformedMessage;
        info.tile = tile;
        info.source = source;
        info.message = message;
        throw Error(std::move(info));
    }

    mutable std::mutex mutex_;
    ExpectedInputs expected_;
    std::set<int> acksMissing_; // of these owners
    bool declared_ = false, isComplete_ = false;
};

} // namespace dfb::detail
