// The inputs of tiles that are hidden by an opaque input in front of them, and those that may still be. HiddenTiles has
// the words of other ranks about them, HidingExchange the messages.
#pragma once

#include <dfb/base/function_ref.hpp>
#include <dfb/comm/mailbox.hpp>
#include <dfb/comm/message.hpp>
#include <dfb/frame/engine.hpp>
#include <dfb/frame/open_frame.hpp>
#include <dfb/frame/outcome.hpp>
#include <dfb/frame/tile_pipeline.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <mutex>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// The words that this rank has received in a frame. Any thread may call the members, except newFrame().
class HiddenTiles {
public:
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

    void take(const HidingWord& word)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        any_ = true;
        Tile& tile = tiles_[static_cast<std::size_t>(word.tile)];
        if (word.effect == HidingWord::Hides)
            tile.from = std::min(tile.from.load(), word.generation);
        if (word.effect == HidingWord::MayHide)
            anyUndecided_ = true;
        auto at = std::find_if(tile.undecided.begin(), tile.undecided.end(),
                               [&](const Undecided& u) { return u.generation == word.generation; });
        if (at == tile.undecided.end())
            at = tile.undecided.insert(at, {word.generation, 0});
        at->count += word.effect == HidingWord::MayHide ? 1 : -1; // the words may overtake each other
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

// The words of a frame, between ranks. Any thread may call the members, except newFrame() and wait().
class HidingExchange {
public:
    // All must live as long as this.
    HidingExchange(Mailbox& mailbox, const OpenFrame& frame, const FrameOutcome& outcome, const TilePipeline& tiles)
        : mailbox_(mailbox), frame_(frame), outcome_(outcome), tiles_(tiles)
    {
    }

    void newFrame() { hidden_.newFrame(tileCount()); }

    bool isHidden(int tile, int generation) const { return generation >= hidden_.from(tile); }
    bool isUndecided(int tile, int generation) const { return hidden_.isUndecided(tile, generation); }

    // Sends the word to rank `other`, or takes it if that is this rank. Throws InvalidArgument if there is no such
    // input or rank, or if no input of the tile hides others in this frame.
    void tell(int other, const HidingWord& word)
    {
        if (!isOfInput(word))
            failArgument("hide() of generation %d of tile %d", word.generation, word.tile);
        if (other < 0 || other >= mailbox_.size())
            failArgument("hide() for rank %d of %d", other, mailbox_.size());
        if (!tiles_.opaqueHides(word.tile))
            failArgument("hide() with a tile operation or a frame to which everything counts");
        if (other == mailbox_.rank())
            take(word);
        else
            mailbox_.sendBody(other, MessageKind::Hidden, frame_.number(), word);
    }

    // Waits until heard() returns true or the frame has failed. Returns false if neither happens within `limit`. For
    // threads see FrameBase::waitForWord().
    bool wait(FunctionRef<bool()> heard, std::chrono::milliseconds limit)
    {
        return mailbox_.wait([&] { return outcome_.failed() || heard(); }, Mailbox::Clock::now() + limit);
    }

    // Throws Error (MalformedMessage).
    void receive(const Buffer& message)
    {
        const auto word = bodyOf<HidingWord>(message);
        if (!isOfInput(word) || !tiles_.opaqueHides(word.tile))
            failMalformed("word of hidden inputs of a tile that has none", tileCount() - 1, word.tile);
        if (word.effect < HidingWord::Hides || word.effect > HidingWord::Shows)
            failMalformed("word of hidden inputs that there is not", HidingWord::Shows, word.effect);
        take(word);
    }

private:
    int tileCount() const { return tiles_.table().layout().tileCount(); }
    bool isOfInput(const HidingWord& word) const
    {
        return word.tile >= 0 && word.tile < tileCount() && word.generation >= 1;
    }

    void take(const HidingWord& word)
    {
        hidden_.take(word);
        mailbox_.notify(); // wakes wait()
    }

    Mailbox& mailbox_;
    const OpenFrame& frame_;
    const FrameOutcome& outcome_;
    const TilePipeline& tiles_;
    HiddenTiles hidden_;
};

} // namespace detail
DFB_NAMESPACE_END
