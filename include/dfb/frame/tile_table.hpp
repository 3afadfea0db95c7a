// TileTable: the tiles that this rank owns. A tile has a tile operation, and a dependency tracker for each pass. They
// are made when first needed.
#pragma once

#include <dfb/blend/background_pixels.hpp>
#include <dfb/dependency_tracker.hpp>
#include <dfb/frame.hpp>
#include <dfb/frame/declarations.hpp>
#include <dfb/frame/operations.hpp>
#include <dfb/tile_layout.hpp>
#include <dfb/tile_op.hpp>

#include <algorithm>
#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <memory>
#include <mutex>
#include <new>
#include <string>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// arrive() and declare() may be called from any thread, for one frame at a time.
class TileTable {
public:
    // `operations` must live as long as this. Throws InvalidArgument for owners that do not exist, and OutOfMemory.
    TileTable(const TileLayout& layout, const OwnerMap& ownerMap, int rank, int rankCount, const Operations& operations)
    try : operations_(operations), layout_(layout), rank_(rank), rankCount_(rankCount),
        slots_(static_cast<std::size_t>(layout.tileCount())),
        series_(traits().keepsState ? static_cast<std::size_t>(layout.tileCount()) : 0) {
        std::vector<int> owners;
        owners.reserve(slots_.size());
        for (int tile = 0; tile < layout.tileCount(); ++tile)
            owners.push_back(ownerMap(tile, layout, rankCount));
        byMap_ = std::make_shared<const std::vector<int>>(std::move(owners));
        setOwners(byMap_, "the owner map");
        ownedByMap_ = owned_;
    } catch (const std::bad_alloc&) {
        constexpr std::size_t mostBytes = 3 * sizeof(int) + sizeof(std::unique_ptr<Slot>);
        const auto tiles = static_cast<std::size_t>(layout.tileCount());
        throw OutOfMemory(mostBytes * tiles, ("tables of " + std::to_string(tiles) + " tiles").c_str());
    }

    const TileLayout& layout() const noexcept { return layout_; }

    // The owners of this frame, and those by the owner map alone.
    int owner(int tile) const noexcept { return (*owners_)[static_cast<std::size_t>(tile)]; }
    const std::vector<int>& owned() const noexcept { return owned_; }
    const std::vector<int>& ownersByMap() const noexcept { return *byMap_; }
    const std::vector<int>& ownedByMap() const noexcept { return ownedByMap_; }

    bool isMine(int tile) const noexcept { return tile >= 0 && tile < layout_.tileCount() && owner(tile) == rank_; }
    // Sets the owners of the next frame; null: those by the owner map. No other member may be running. Returns whether
    // they differ from the present ones. Throws InvalidArgument if they are not valid, with nothing changed; the text
    // names `who` as their source. Slots of tiles that this rank no longer owns are kept for other tiles.
    bool setOwners(const TileOwners& owners, const char* who = "FrameConfig::owners")
    {
        const TileOwners& nextOwners = owners ? owners : byMap_;
        const std::vector<int>& next = *nextOwners;
        if (owners_ && (nextOwners == owners_ || next == *owners_))
            return false;
        if (next.size() != slots_.size())
            failArgument("%s has %zu tiles, the image %zu", who, next.size(), slots_.size());
        for (std::size_t tile = 0; tile < next.size(); ++tile)
            if (next[tile] < 0 || next[tile] >= rankCount_)
                failArgument("%s gives tile %zu to rank %d of %d", who, tile, next[tile], rankCount_);
        spare_.reserve(spare_.size() + owned_.size());
        owned_.reserve(static_cast<std::size_t>(std::count(next.begin(), next.end(), rank_)));
        owners_ = nextOwners; // from here on nothing throws
        for (const int tile : owned_)
            if (auto& slot = slotOf(tile); slot && !isMine(tile)) {
                slot->background = BackgroundPixels(); // others write to this tile's place from now on
                spare_.push_back(std::move(slot));
            }
        owned_.clear();
        for (int tile = 0; tile < layout_.tileCount(); ++tile)
            if (isMine(tile))
                owned_.push_back(tile);
        return true;
    }
    const TileInfo& frameInfo() const noexcept { return info_; }

    // `info` is common to all tiles; its `rank` is set here. No other member may be running.
    void newFrame(const TileInfo& info, const SamplePlan& plan)
    {
        expected_ = nullptr;
        info_ = info;
        info_.rank = rank_;
        plan_ = plan;
        arrived_ = endedEarly_ = 0;
        touchedCount_ = 0;
        for (std::size_t tile = 0; tile < series_.size(); ++tile)
            if (const TileSamples s = samples(static_cast<int>(tile)); s.count > 0) {
                Series& series = series_[tile];
                series.goesOn = s.first > 0 && s.first == series.next;
                series.begin = s.first == 0 ? info.frame : series.begin;
                series.next = s.first + s.count;
            }
    }
    // saidWhy(): call it when the error of a spoilt tile has been reported. isSaid(): all have been; only then may a
    // frame end.
    void saidWhy() { --unsaid_; }
    bool isSaid() const noexcept { return unsaid_ == 0; }

    // The number of right inputs that have come to tiles of this rank. If all tiles are complete, the numbers of all
    // ranks add up to the number of inputs sent. If they do not, a wrong input has come in place of a right one.
    std::int64_t arrivedCount() const noexcept { return arrived_; }
    // The number of tiles that needed no more inputs although more were to come.
    std::int64_t endedEarlyCount() const noexcept { return endedEarly_; }
    // How many tiles have had an input in this frame.
    int touchedCount() const noexcept { return touchedCount_; }

    // Returns the samples that a tile gets in this frame.
    TileSamples samples(int tile) const
    {
        return plan_ ? (*plan_)[static_cast<std::size_t>(tile)] : TileSamples{info_.firstSample, info_.passes};
    }

    struct Arrival {
        bool ready = false;  // the tile's inputs are now complete: call finish() once
        bool spoilt = false; // the tile is spoilt: call saidWhy() when its error has been reported
    };

    // Hands an input of rank `from` to its tile. Throws the exceptions of the tracker and of the operation; the tile is
    // then spoilt and waits for no more inputs, so both members of `arrival` may be set.
    void arrive(Fragment&& fragment, int from, Arrival& arrival)
    {
        const TileHeader h = fragment.header();
        const std::lock_guard<std::mutex> lock(mutexOf(h.tile));
        try {
            Slot& slot = slotFor(h.tile);
            DependencyTracker& tree = slot.trees[static_cast<std::size_t>(h.pass)];
            tree.arrive(h.generation, h.source, h.part, h.children, from);
            if (!std::exchange(slot.touched, true))
                ++touchedCount_;
            if (!slot.ready && !slot.spoilt) { // otherwise the op had enough, or is of no use
                slot.hasPixels = slot.hasPixels || !fragment.empty();
                slot.op->add(std::move(fragment));
                const bool enough = slot.op->isComplete();
                const bool complete = tree.complete() && allComplete(slot);
                arrival.ready = becomesReady(slot, enough || complete);
                endedEarly_ += enough && !complete;
            }
            ++arrived_;
        } catch (...) {
            if (const auto& slot = slotOf(h.tile)) {
                ++unsaid_; // before declare() can see it
                arrival.spoilt = true;
                arrival.ready = spoil(*slot);
            }
            throw;
        }
    }

    // Spoils the tile, which will not get all of its inputs. Returns true if it still waited for some: then call
    // finish() once. The error must have been reported. Throws std::bad_alloc.
    bool lose(int tile)
    {
        const std::lock_guard<std::mutex> lock(mutexOf(tile));
        if (samples(tile).count == 0)
            return false;
        try {
            if (slotFor(tile).ready)
                return false;
        } catch (...) { // of the operation, which is not needed
            if (!slotOf(tile))
                throw;
        }
        return spoil(*slotOf(tile));
    }

    // Takes the inputs that each tile will get in each pass; a tile that is not named gets none. Calls `counted(tile)`
    // for each tile with inputs, and then `ready(tile)` if they are all there. Also calls both for tiles without inputs
    // if the pixel operation is not pointwise, if an input has come all the same, or if the operation keeps earlier
    // samples of the tile. `expected` must live as long as the frame. If the tracker or the operation throws, this goes
    // on with the other tiles and throws at the end; `where` then names the first tile that failed.
    template <class Counted, class Ready>
    void declare(const ExpectedInputs& expected, ErrorInfo& where, const Counted& counted, const Ready& ready)
    {
        expected_ = &expected; // from now on slotFor() knows
        std::exception_ptr failure;
        for (const int tile : owned_) {
            const ExpectedInputs::Range inputs = expected.of(tile);
            bool complete = false;
            {
                const std::lock_guard<std::mutex> lock(mutexOf(tile));
                const auto& slot = slotOf(tile);
                if ((inputs.empty() && traits().pixelOpIsPointwise && !isTouched(tile) && !hasSamples(tile))
                    || samples(tile).count == 0)
                    continue;
                try {
                    if (Slot& its = slotFor(tile); !its.declared)
                        declareSlot(its, inputs);
                } catch (...) {
                    if (!slot)
                        throw;
                    slot->spoilt = true;
                    if (!failure)
                        where.tile = tile;
                    failure = failure ? failure : std::current_exception();
                }
                slot->counted = true;
                complete = becomesReady(*slot, slot->spoilt || allComplete(*slot));
            }
            counted(tile);
            if (complete)
                ready(tile);
        }
        if (failure)
            std::rethrow_exception(failure);
    }

    // Whether an input of the tile was wrong, so that it must not be finished. The tile must be complete.
    bool isSpoilt(int tile)
    {
        const std::lock_guard<std::mutex> lock(mutexOf(tile));
        return slotFor(tile).spoilt;
    }

    // Whether any input had a pixel. The tile must be complete.
    bool hasPixels(int tile) { return slotFor(tile).hasPixels; }

    // The tile must be complete. Nothing else touches its op any more.
    void finish(int tile, FinishedTile& out) { slotFor(tile).op->finish(out); }

    // The background pixels at the tile's place in the image. For the thread that finishes the tile.
    BackgroundPixels& backgroundPixels(int tile) { return slotFor(tile).background; }

    // Called when a complete tile has been finished and is on its way.
    void setFinished(int tile)
    {
        const std::lock_guard<std::mutex> lock(mutexOf(tile));
        slotFor(tile).finished = true;
    }

    // The tiles of this rank that should be finished in this frame but are not, and those that are spoilt.
    std::vector<std::int32_t> unfinished()
    {
        std::vector<std::int32_t> tiles;
        for (const int tile : owned_) {
            const std::lock_guard<std::mutex> lock(mutexOf(tile));
            const auto& slot = slotOf(tile);
            if (isTouched(tile) ? slot->spoilt || (!slot->finished && (!isUndeclared(tile) || slot->counted))
                                : !isUndeclared(tile) && samples(tile).count > 0)
                tiles.push_back(tile);
        }
        return tiles;
    }

    // Returns the operation's report on a finished tile.
    TileReport report(int tile) { return slotFor(tile).op->report(); }

    // Returns the inputs that incomplete tiles wait for: those of the first tile in numbers, those of all tiles in
    // words. The text is empty if no tile waits. In a frame with declared inputs, call it after declare().
    ErrorInfo missing()
    {
        constexpr int mostTiles = 8; // in the text
        ErrorInfo info;
        int tiles = 0;
        for (const int tile : owned_) {
            const std::lock_guard<std::mutex> lock(mutexOf(tile));
            const auto& slot = slotOf(tile);
            const bool touched = isTouched(tile);
            if (touched ? slot->ready : isUndeclared(tile) || samples(tile).count == 0)
                continue;
            const DependencyTracker untouched;
            for (int pass = 0; pass < samples(tile).count; ++pass) {
                const DependencyTracker& tree = touched ? slot->trees[static_cast<std::size_t>(pass)] : untouched;
                const auto m = tree.missing();
                if (!m)
                    continue;
                if (++tiles == 1) {
                    info.tile = tile;
                    info.pass = pass;
                    info.generation = m->generation;
                    info.source = m->inputs.empty() ? -1 : static_cast<std::int64_t>(m->inputs.front().source);
                    info.from = !m->inputs.empty()      ? m->inputs.front().rank
                                : m->announcers.empty() ? -1
                                                        : m->announcers.front().rank;
                    info.expected = m->expected;
                    info.got = m->got;
                }
                if (tiles <= mostTiles) {
                    info.message +=
                        printed(samples(tile).count > 1 ? "%stile %d pass %d: " : "%stile %d: ", tiles > 1 ? "; " : "",
                                tile, pass);
                    info.message += m->text();
                    info.message += listOf("; missing source ", m->inputs, "declared by");
                    info.message += listOf("; announced by source ", m->announcers);
                    info.message += listOf("; here are source ", m->arrived);
                }
                break;
            }
        }
        if (tiles > mostTiles)
            info.message += printed("; and %d more tiles", tiles - mostTiles);
        return info;
    }

private:
    struct Slot {
        std::int64_t frame = -1;
        bool ready = false, touched = false, declared = false, hasPixels = false, finished = false;
        bool spoilt = false;  // an input contradicted others, or the op refused it; even after `finished`
        bool counted = false; // whether declare() has counted the tile
        std::vector<DependencyTracker> trees; // one per pass
        std::unique_ptr<TileStage> op;        // null only in a tile that is spoilt
        BackgroundPixels background;
    };

    // The samples of a tile over several frames.
    struct Series {
        std::int64_t begin = 0; // the frame with sample 0
        int next = 0;           // the sample that comes next
        bool goesOn = false;    // this frame's samples follow the earlier ones
    };

    std::mutex& mutexOf(int tile) { return mutexes_[static_cast<std::size_t>(tile) % mutexes_.size()]; }

    std::unique_ptr<Slot>& slotOf(int tile) { return slots_[static_cast<std::size_t>(tile)]; }
    // Whether the tile has a slot that is set up for this frame.
    bool isTouched(int tile)
    {
        const auto& slot = slotOf(tile);
        return slot && slot->frame == info_.frame;
    }

    // Returns the slot, set up for this frame. The first call in a frame throws the exceptions of the op's constructor
    // and of its newFrame(). The tile is then spoilt.
    Slot& slotFor(int tile)
    {
        auto& slot = slotOf(tile);
        if (!slot) {
            const std::lock_guard<std::mutex> lock(spareMutex_);
            if (!spare_.empty()) {
                slot = std::move(spare_.back());
                spare_.pop_back();
            }
        }
        if (!slot)
            slot = std::make_unique<Slot>();
        if (slot->frame != info_.frame) {
            const bool isEmptyYet = goesOn(tile) && !hasSamples(tile);
            slot->trees.resize(static_cast<std::size_t>(samples(tile).count)); // first, as it may throw
            slot->frame = info_.frame;
            slot->ready = slot->touched = slot->declared = slot->hasPixels = slot->finished = false;
            slot->spoilt = slot->counted = false;
            for (DependencyTracker& tree : slot->trees)
                tree.reset();
            if (isUndeclared(tile))
                declareSlot(*slot, {});
            TileInfo info = info_;
            info.tile = tile;
            info.region = layout_.region(tile);
            info.passes = samples(tile).count;
            info.firstSample = samples(tile).first;
            info.emptySamples = isEmptyYet ? info.firstSample : 0;
            try {
                if (!slot->op)
                    slot->op = operations_.makeTile();
                slot->op->newFrame(info);
            } catch (...) {
                slot->spoilt = true; // the op is of no use in this frame
                throw;
            }
        }
        return *slot;
    }

    // Whether it is known that nobody has declared an input of the tile.
    bool isUndeclared(int tile) const
    {
        const ExpectedInputs* expected = expected_;
        return expected && expected->of(tile).empty();
    }

    // Whether the samples of this frame follow those of the tile in earlier ones.
    bool goesOn(int tile) const { return traits().keepsState && series_[static_cast<std::size_t>(tile)].goesOn; }
    // Whether the operation has had any of those earlier samples. It then gets this frame's, too, even if they are
    // empty.
    bool hasSamples(int tile)
    {
        const auto& slot = slotOf(tile);
        return goesOn(tile) && slot && slot->frame >= series_[static_cast<std::size_t>(tile)].begin;
    }

    static void declareSlot(Slot& slot, const ExpectedInputs::Range& inputs)
    {
        slot.declared = true;
        for (DependencyTracker& tree : slot.trees)
            tree.declare(inputs);
    }

    static std::string listOf(const char* what, const std::vector<DependencyTracker::Declared>& inputs,
                              const char* whose = "of")
    {
        constexpr std::size_t most = 8; // each rank sends the text to all others
        std::string text;
        for (std::size_t i = 0; i < std::min(most, inputs.size()); ++i) {
            text += printed("%s%u", i == 0 ? what : ", ", inputs[i].source);
            if (inputs[i].part > 0)
                text += printed(" part %d", inputs[i].part);
            text += printed(" %s rank %d", whose, inputs[i].rank);
        }
        if (inputs.size() > most)
            text += printed(" and %zu more", inputs.size() - most);
        return text;
    }

    static bool allComplete(const Slot& slot)
    {
        return std::all_of(slot.trees.begin(), slot.trees.end(), [](const auto& tree) { return tree.complete(); });
    }

    // Returns whether to finish the tile now. If not, declare() will, or that has begun already.
    bool spoil(Slot& slot)
    {
        slot.spoilt = true;
        return becomesReady(slot, slot.counted || !expected_);
    }

    static bool becomesReady(Slot& slot, bool now) { return now && !std::exchange(slot.ready, true); }

    const OperationTraits& traits() const noexcept { return operations_.traits(); }

    const Operations& operations_;
    TileLayout layout_;
    int rank_, rankCount_;
    TileOwners byMap_, owners_; // owners_: of this frame
    std::vector<int> ownedByMap_, owned_;
    std::vector<std::unique_ptr<Slot>> slots_; // of each tile; null for tiles of other owners
    std::mutex spareMutex_;
    std::vector<std::unique_ptr<Slot>> spare_; // under spareMutex_
    std::vector<Series> series_;               // of each tile, with an operation that keeps state
    std::array<std::mutex, 64> mutexes_;
    std::atomic<const ExpectedInputs*> expected_{nullptr}; // null until declare()
    TileInfo info_;
    std::atomic<std::int64_t> arrived_{0}, endedEarly_{0};
    std::atomic<int> touchedCount_{0};
    std::atomic<int> unsaid_{0}; // spoilt tiles whose errors have not been reported yet
    SamplePlan plan_;            // null: all tiles as info_ says
};

} // namespace detail
DFB_NAMESPACE_END
