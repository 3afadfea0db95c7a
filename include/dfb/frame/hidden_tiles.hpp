// HiddenTiles: which inputs of a tile cannot be seen because an opaque input lies in front of them, and which may still
// turn out to be hidden.
#pragma once

#include <dfb/version.hpp>

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <mutex>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// One object per rank, with the words that this rank has received. Any thread may call the members, except newFrame().
class HiddenTiles {
public:
    // The effect of an input on those behind it.
    enum class Word : std::int32_t {
        Hides,
        MayHide, // it hid them in the last frame; Hides or Shows follows
        Shows
    };
    struct Message {
        std::int32_t tile = 0;
        std::int32_t generation = 0; // the first generation behind the input
        Word word = Word::Hides;
    };

    void newFrame(int tileCount)
    {
        if (from_.size() != static_cast<std::size_t>(tileCount)) {
            from_ = std::vector<std::atomic<std::int32_t>>(static_cast<std::size_t>(tileCount));
            open_ = std::vector<std::vector<Open>>(from_.size());
        } else if (!any_) {
            return;
        }
        for (auto& from : from_)
            from = none;
        for (auto& open : open_)
            open.clear();
        any_ = anyOpen_ = false;
    }

    void take(const Message& message)
    {
        any_ = true;
        if (message.word == Word::Hides) {
            auto& from = from_[static_cast<std::size_t>(message.tile)];
            std::int32_t before = from;
            while (message.generation < before && !from.compare_exchange_weak(before, message.generation)) {
            }
        }
        if (message.word == Word::MayHide)
            anyOpen_ = true;
        const std::lock_guard<std::mutex> lock(mutex_);
        auto& open = open_[static_cast<std::size_t>(message.tile)];
        auto at =
            std::find_if(open.begin(), open.end(), [&](const Open& o) { return o.generation == message.generation; });
        if (at == open.end())
            at = open.insert(open.end(), {message.generation, 0});
        at->count += message.word == Word::MayHide ? 1 : -1; // the words may overtake each other
    }

    // The first generation that cannot be seen.
    int from(int tile) const { return any_ ? from_[static_cast<std::size_t>(tile)].load() : none; }

    // Whether a word is still to come that may hide an input which is not hidden yet.
    bool isUndecided(int tile, int generation) const
    {
        if (!anyOpen_ || generation >= from(tile))
            return false;
        const std::lock_guard<std::mutex> lock(mutex_);
        const auto& open = open_[static_cast<std::size_t>(tile)];
        return std::any_of(open.begin(), open.end(),
                           [&](const Open& o) { return o.count > 0 && o.generation <= generation; });
    }

private:
    struct Open {
        std::int32_t generation;
        int count;
    };
    static constexpr std::int32_t none = std::numeric_limits<std::int32_t>::max();
    std::vector<std::atomic<std::int32_t>> from_;
    std::atomic<bool> any_{false}, anyOpen_{false};
    mutable std::mutex mutex_;
    std::vector<std::vector<Open>> open_; // by tile; under mutex_
};

} // namespace detail
DFB_NAMESPACE_END
