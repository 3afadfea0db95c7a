// ManifestExchange: every rank tells the owners which inputs it will send, and all learn when all owners
// know. Counts come from the senders only, so owner and contributor can not disagree about visibility.
//
// Each rank sends one manifest to each owner that it touches; the owner acknowledges; a rank whose manifests are all
// acknowledged enters a reduction, and when that is done every manifest has arrived everywhere.
#pragma once

#include <dfb/comm/byte_io.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
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
    int tile = 0;
    std::uint32_t source = 0;
    std::uint16_t part = 0;
    int rank = 0; // that has said so
};

// All that will come, by tile.
class ExpectedInputs {
public:
    struct Range {
        const ExpectedInput *first = nullptr, *last = nullptr;
        const ExpectedInput* begin() const noexcept { return first; }
        const ExpectedInput* end() const noexcept { return last; }
        bool empty() const noexcept { return first == last; }
    };

    void clear() { inputs_.clear(); }
    void add(const ExpectedInput& input) { inputs_.push_back(input); }
    // All have been added: from now on they can be looked up.
    void sort()
    {
        std::sort(inputs_.begin(), inputs_.end(),
                  [](const ExpectedInput& a, const ExpectedInput& b) { return a.tile < b.tile; });
    }

    auto begin() const noexcept { return inputs_.begin(); }
    auto end() const noexcept { return inputs_.end(); }
    Range of(int tile) const
    {
        const auto first = std::lower_bound(inputs_.begin(), inputs_.end(), tile,
                                            [](const ExpectedInput& input, int t) { return input.tile < t; });
        auto last = first;
        while (last != inputs_.end() && last->tile == tile)
            ++last;
        return {inputs_.data() + (first - inputs_.begin()), inputs_.data() + (last - inputs_.begin())};
    }

private:
    std::vector<ExpectedInput> inputs_;
};

class ManifestExchange {
public:
    void reset()
    {
        std::lock_guard<std::mutex> lock(mutex_);
        expected_.clear();
        acksMissing_.clear();
        declared_ = isComplete_ = false;
    }

    // For the inputs of this rank: calls send(owner, bytes) with what is to be sent to whom. `ownerOf(tile)` gives the
    // owner. False if nothing is. By one thread at a time.
    template <class OwnerOf, class Send>
    bool split(const std::vector<TileInput>& inputs, int rank, const OwnerOf& ownerOf, const Send& send)
    {
        toSend_.clear();
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            declared_ = true;
            for (std::size_t i = 0; i < inputs.size(); ++i) {
                const TileInput& input = inputs[i];
                const int owner = ownerOf(input.tile);
                if (owner == rank)
                    expected_.add({input.tile, input.source, input.part, rank});
                else
                    toSend_.emplace_back(owner, i);
            }
            std::sort(toSend_.begin(), toSend_.end());
            for (const auto& [owner, input] : toSend_) // all of them, before the first can answer
                if (acksMissing_.empty() || acksMissing_.back() != owner)
                    acksMissing_.push_back(owner);
        }
        for (std::size_t i = 0; i < toSend_.size();) {
            const int owner = toSend_[i].first;
            manifest_.clear();
            for (; i < toSend_.size() && toSend_[i].first == owner; ++i) {
                const TileInput& input = inputs[toSend_[i].second];
                manifest_.put(static_cast<std::int32_t>(input.tile));
                manifest_.put(input.source);
                manifest_.put(input.part);
            }
            send(owner, manifest_.bytes());
        }
        return !toSend_.empty();
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
            expected_.add({tile, source, part, from});
        }
    }

    // By rank `from`. True if this was the last acknowledgement that was missing. Throws Error (MalformedMessage).
    bool acknowledged(int from)
    {
        std::lock_guard<std::mutex> lock(mutex_);
        const auto place = std::find(acksMissing_.begin(), acksMissing_.end(), from);
        if (place == acksMissing_.end())
            fail("an answer to a manifest that was not sent");
        acksMissing_.erase(place);
        return acksMissing_.empty();
    }

    // The exchange is over: from now on expected() may be read.
    void complete()
    {
        std::lock_guard<std::mutex> lock(mutex_);
        if (!std::exchange(isComplete_, true))
            expected_.sort();
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
    std::vector<int> acksMissing_; // of these owners
    bool declared_ = false, isComplete_ = false;

    // Only split() uses them: to which owner which of the inputs goes, and what one owner is sent.
    std::vector<std::pair<int, std::size_t>> toSend_;
    ByteWriter manifest_;
};

} // namespace dfb::detail
