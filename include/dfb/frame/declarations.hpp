// Declarations: every rank tells the owners which inputs it will send, and all ranks learn when all owners know. Counts
// come from the senders only, so owner and contributor cannot disagree about visibility.
//
// A rank's declaration holds until the rank declares something else. In each frame a rank sends a manifest only to the
// owners for which its inputs differ from the last frame's. The owner acknowledges a manifest and drops the rank's
// older one. A rank enters a reduction when all of its manifests are acknowledged, or at once if it sent none. When the
// reduction is done, every manifest has arrived, and ranks without a new manifest send the inputs of before.
#pragma once

#include <dfb/comm/message.hpp>
#include <dfb/frame.hpp>

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <iterator>
#include <mutex>
#include <tuple>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// An input that will come for a tile.
struct ExpectedInput : TileInput {
    int rank = 0; // the rank that has declared it
};

// All inputs that will come, by tile.
class ExpectedInputs {
public:
    struct Range {
        const ExpectedInput *first = nullptr, *last = nullptr;
        const ExpectedInput* begin() const noexcept { return first; }
        const ExpectedInput* end() const noexcept { return last; }
        bool empty() const noexcept { return first == last; }
    };

    void clear() { inputs_.clear(); }
    // Puts these in place of all inputs of `ranks`, which ascend.
    void replace(const std::vector<int>& ranks, const std::vector<ExpectedInput>& inputs)
    {
        const auto isReplaced = [&](const ExpectedInput& input) {
            return std::binary_search(ranks.begin(), ranks.end(), input.rank);
        };
        inputs_.erase(std::remove_if(inputs_.begin(), inputs_.end(), isReplaced), inputs_.end());
        inputs_.insert(inputs_.end(), inputs.begin(), inputs.end());
        std::sort(inputs_.begin(), inputs_.end(), [](const ExpectedInput& a, const ExpectedInput& b) {
            return std::tie(a.tile, a.source, a.part, a.rank) < std::tie(b.tile, b.source, b.part, b.rank);
        });
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

class Declarations {
public:
    // `lastHolds`: whether the declarations up to the last frame have arrived at all owners, the same on all ranks. If
    // not, all of them are forgotten. `haveMoved`: whether tiles have other owners than in the last frame.
    void newFrame(bool lastHolds, bool haveMoved)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (!lastHolds) {
            expected_.clear();
            mine_.clear();
            told_.clear();
        }
        changedRanks_.clear();
        changedInputs_.clear();
        acksMissing_.clear();
        declared_ = isComplete_ = false;
        haveMoved_ = haveMoved_ || haveMoved;
    }

    // Takes note of the inputs that this rank will send: calls send(owner, bytes) for each other owner whose inputs
    // have changed. `ownerOf(tile)` gives the owner. Returns whether acknowledgements are to come. One thread at a time
    // may call it.
    template <class OwnerOf, class Send>
    bool declare(const std::vector<TileInput>& inputs, int rank, const OwnerOf& ownerOf, const Send& send)
    {
        const bool haveMoved = std::exchange(haveMoved_, false);
        if (inputs == mine_ && !haveMoved) {
            declared_ = true;
            return false;
        }
        mine_ = inputs;
        toTell_.clear();
        for (const TileInput& input : inputs)
            toTell_.push_back({ownerOf(input.tile), input});
        std::sort(toTell_.begin(), toTell_.end());
        news_.clear();
        std::set_symmetric_difference(told_.begin(), told_.end(), toTell_.begin(), toTell_.end(),
                                      std::back_inserter(news_));
        const auto haveOneOwner = [](const Addressed& a, const Addressed& b) { return a.owner == b.owner; };
        news_.erase(std::unique(news_.begin(), news_.end(), haveOneOwner), news_.end());
        bool isWaiting = false;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            declared_ = true;
            for (const Addressed& its : news_) // all of them, before the first can answer
                if (its.owner == rank) {
                    changedRanks_.push_back(rank);
                    forEachOf(its.owner, [&](const TileInput& input) { changedInputs_.push_back({input, rank}); });
                } else {
                    acksMissing_.push_back(its.owner);
                    isWaiting = true;
                }
        }
        for (const Addressed& its : news_) {
            if (its.owner == rank)
                continue;
            manifest_.clear();
            forEachOf(its.owner, [&](const TileInput& input) {
                manifest_.put(static_cast<std::int32_t>(input.tile));
                manifest_.put(input.source);
                manifest_.put(input.part);
            });
            send(its.owner, manifest_);
        }
        told_.swap(toTell_);
        return isWaiting;
    }

    // On the owner: takes a manifest of rank `from`. `isMine(tile)`: whether this rank owns a tile. Throws Error
    // (MalformedMessage).
    template <class IsMine>
    void receive(int from, ByteReader in, const IsMine& isMine)
    {
        std::lock_guard<std::mutex> lock(mutex_);
        if (isComplete_)
            failMalformed("a manifest after all ranks have declared");
        changedRanks_.push_back(from);
        while (in.left() > 0) {
            const int tile = in.get<std::int32_t>();
            const auto source = in.get<std::uint32_t>();
            const auto part = in.get<std::uint16_t>();
            if (!isMine(tile)) {
                ErrorInfo info = errorInfo(ErrorKind::MalformedMessage, "a manifest names a tile of another owner");
                info.tile = tile;
                info.source = source;
                throw Error(std::move(info));
            }
            changedInputs_.push_back({{tile, source, part}, from});
        }
    }

    // Takes an acknowledgement of rank `from`. Returns whether it was the last one missing. Throws Error
    // (MalformedMessage).
    bool acknowledged(int from)
    {
        std::lock_guard<std::mutex> lock(mutex_);
        const auto place = std::find(acksMissing_.begin(), acksMissing_.end(), from);
        if (place == acksMissing_.end())
            failMalformed("an answer to a manifest that was not sent");
        acksMissing_.erase(place);
        return acksMissing_.empty();
    }

    // The exchange is over: from now on expected() may be read.
    void complete()
    {
        std::lock_guard<std::mutex> lock(mutex_);
        if (std::exchange(isComplete_, true) || changedRanks_.empty())
            return;
        std::sort(changedRanks_.begin(), changedRanks_.end());
        expected_.replace(changedRanks_, changedInputs_);
    }

    bool declared() const { return declared_; }

    // The ranks that have not acknowledged this rank's manifest.
    std::vector<int> unanswered() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return acksMissing_;
    }

    // The inputs that will come, per owned tile. Read it after complete().
    const ExpectedInputs& expected() const { return expected_; }

private:
    struct Addressed {
        int owner = 0;
        TileInput input;
        bool operator<(const Addressed& o) const
        {
            return std::tie(owner, input.tile, input.source, input.part)
                   < std::tie(o.owner, o.input.tile, o.input.source, o.input.part);
        }
    };

    // Calls take(input) for each input in toTell_ of that owner.
    template <class Take>
    void forEachOf(int owner, const Take& take) const
    {
        auto its = std::partition_point(toTell_.begin(), toTell_.end(),
                                        [owner](const Addressed& other) { return other.owner < owner; });
        for (; its != toTell_.end() && its->owner == owner; ++its)
            take(its->input);
    }

    mutable std::mutex mutex_;
    ExpectedInputs expected_;                  // as of the last complete()
    std::vector<int> changedRanks_;            // ranks that have told this owner something new in this frame
    std::vector<ExpectedInput> changedInputs_; // their new inputs
    std::vector<int> acksMissing_;             // owners that have not acknowledged
    bool isComplete_ = false;
    std::atomic<bool> declared_{false};

    // Only declare() and newFrame() use them.
    std::vector<TileInput> mine_;          // what was declared last
    bool haveMoved_ = false;               // tiles have other owners since then
    std::vector<Addressed> told_, toTell_; // by owner: what was told last; what is to be told now
    std::vector<Addressed> news_;          // what only one of them has; then one for each owner
    SmallBytes manifest_;                  // for one owner
};

} // namespace detail
DFB_NAMESPACE_END
