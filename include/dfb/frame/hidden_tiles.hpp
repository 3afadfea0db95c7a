// HiddenTiles: which inputs of a tile are hidden by an opaque input in front of them, and which may still be.
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

// One object per rank, with the messages (words) that this rank has received. Any thread may call the members, except
// newFrame().
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
        if (tiles_.size() != static_cast<std::size_t>(tileCount))
            tiles_ = std::vector<Tile>(static_cast<std::size_t>(tileCount));
        else if (any_)
            for (Tile& tile : tiles_) {
                tile.from = none;
                tile.undecided.clear();
            }
        any_ = anyUndecided_ = false;
    }

    void take(const Message& message)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        any_ = true;
        Tile& tile = tiles_[static_cast<std::size_t>(message.tile)];
        if (message.word == Word::Hides)
            tile.from = std::min(tile.from.load(), message.generation);
        if (message.word == Word::MayHide)
            anyUndecided_ = true;
        auto at = std::find_if(tile.undecided.begin(), tile.undecided.end(),
                               [&](const Undecided& u) { return u.generation == message.generation; });
        if (at == tile.undecided.end())
            at = tile.undecided.insert(at, {message.generation, 0});
        at->count += message.word == Word::MayHide ? 1 : -1; // the words may overtake each other
    }

    // The first generation that cannot be seen.
    int from(int tile) const { return any_ ? tiles_[static_cast<std::size_t>(tile)].from.load() : none; }

    // Whether a word is still to come that may hide an input which is not hidden yet.
    bool isUndecided(int tile, int generation) const
    {
        if (!anyUndecided_ || generation >= from(tile))
            return false;
        const std::lock_guard<std::mutex> lock(mutex_);
        const auto& all = tiles_[static_cast<std::size_t>(tile)].undecided;
        return std::any_of(all.begin(), all.end(),
                           [&](const Undecided& u) { return u.count > 0 && u.generation <= generation; });
    }

private:
    struct Undecided { // inputs that words are still to come about
        std::int32_t generation;
        int count;
    };
    static constexpr std::int32_t none = std::numeric_limits<std::int32_t>::max();
    struct Tile {
        std::atomic<std::int32_t> from{none}; // the first generation that is hidden; set under mutex_
        std::vector<Undecided> undecided;     // under mutex_
    };
    std::vector<Tile> tiles_;
    std::atomic<bool> any_{false}, anyUndecided_{false};
    mutable std::mutex mutex_;
};

} // namespace detail
DFB_NAMESPACE_END
