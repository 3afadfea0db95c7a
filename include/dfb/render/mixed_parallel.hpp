// MixedParallelLoop (Listing 5 of the paper): several ranks may hold a brick, and in each tile one of them renders it.
// If one rank holds each brick, this is data-parallel rendering; if all ranks hold all bricks, image-parallel
// rendering. OrderedLoop does this for bricks in a known order, without sorting. For the choice of the rank see
// brick_owners.hpp.
#pragma once

#include <dfb/base/function_ref.hpp>
#include <dfb/frame.hpp>
#include <dfb/framebuffer_base.hpp>
#include <dfb/render/brick_owners.hpp>
#include <dfb/render/loops.hpp>
#include <dfb/render/shared_world.hpp>

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <mutex>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// The jobs of a mixed-parallel frame.
struct MixedWork {
    std::vector<BrickInTile> pairs; // tile by tile
    std::vector<int> passes;        // how many passes each pair has
    std::vector<Job> jobs;          // of this rank; `item` is an index into `pairs`

    // Finds the jobs that `owner` gives to the rank `own`. Tells the frame how many bricks meet in a tile.
    template <class Owner>
    void findJobs(FrameBase& frame, const SharedWorld& world, Owner& owner, int own)
    {
        countPasses(frame);
        if constexpr (has_plan_v<Owner>)
            owner.plan(world, pairs, passes);
        pickJobs(
            world, [&](const SharedBrick& brick, int tile, int pass) { return owner(brick, tile, pass); }, own);
    }

    // Puts the jobs first that cost more than twice the mean, if the owner knows costs.
    template <class Owner>
    void renderCostlyFirst(const SharedWorld& world, const Owner& owner)
    {
        if constexpr (has_costs_v<Owner>)
            moveCostly([&](const Job& job) {
                const BrickInTile& pair = pairs[job.item];
                return owner.costOf(brickOf(world, pair), pair.tile) / passes[job.item];
            });
    }

private:
    void moveCostly(FunctionRef<double(const Job&)> costOf)
    {
        double sum = 0;
        for (const Job& job : jobs)
            sum += costOf(job);
        const double limit = 2 * sum / static_cast<double>(std::max<std::size_t>(jobs.size(), 1));
        std::stable_partition(jobs.begin(), jobs.end(), [&](const Job& job) { return costOf(job) > limit; });
    }

    void countPasses(FrameBase& frame)
    {
        passes.clear();
        int inTile = 0, most = 1;
        for (std::size_t p = 0; p < pairs.size(); ++p) {
            passes.push_back(frame.samples(pairs[p].tile).count);
            inTile = p > 0 && pairs[p].tile == pairs[p - 1].tile ? inTile + 1 : 1;
            most = std::max(most, inTile);
        }
        frame.expectLayers(most);
    }

    void pickJobs(const SharedWorld& world, OwnerRef owner, int own)
    {
        jobs.clear();
        for (std::size_t p = 0; p < pairs.size(); ++p) {
            const SharedBrick& brick = brickOf(world, pairs[p]);
            for (int pass = 0; pass < passes[p]; ++pass) {
                if (rankOf(brick, pairs[p].tile, pass, owner) == own)
                    jobs.push_back({p, pass});
            }
        }
    }
};

// The work of an OrderedLoop: that of a MixedParallelLoop in a known order.
struct OrderedWork : MixedWork {
    std::vector<int> place;             // each brick's place in the order; 0: in front
    std::vector<int> firstPair;         // where each tile's pairs begin, or -1
    std::vector<int> empty;             // the tiles that this rank owns and no brick projects to
    std::atomic<bool> anyHidden{false}; // in the last frame an input of this rank was hidden, or hid others
    std::vector<std::atomic<int>>
        hider;                  // of each tile: the brick of this rank that hid others in the last frame, or -1
    std::vector<int> announced; // of each tile: the brick that may hide others in this frame, or -1
    std::mutex undecidedMutex;
    std::vector<Job> undecided; // jobs that another rank may hide

    // Sorts `pairs` by tile, then front to back. Throws InvalidArgument if `order` does not have each brick once.
    void sortFrontToBack(const SharedWorld& world, const std::vector<int>& order)
    {
        place.assign(world.bricks().size(), -1);
        for (std::size_t i = 0; i < order.size(); ++i)
            if (const auto brick = static_cast<std::size_t>(order[i]); brick < place.size())
                place[brick] = static_cast<int>(i);
        if (order.size() != place.size() || std::count(place.begin(), place.end(), -1) > 0)
            failArgument("the order does not have each brick once");
        std::sort(pairs.begin(), pairs.end(), [&](const BrickInTile& a, const BrickInTile& b) {
            return a.tile != b.tile
                       ? a.tile < b.tile
                       : place[static_cast<std::size_t>(a.brick)] < place[static_cast<std::size_t>(b.brick)];
        });
    }

    // Finds which of this rank's tiles no brick projects to, and where the pairs of the other tiles begin.
    void findEmpty(int tileCount, const std::vector<int>& ownedTiles)
    {
        firstPair.assign(static_cast<std::size_t>(tileCount), -1);
        for (std::size_t p = pairs.size(); p-- > 0;)
            firstPair[static_cast<std::size_t>(pairs[p].tile)] = static_cast<int>(p);
        empty.clear();
        for (const int tile : ownedTiles)
            if (firstPair[static_cast<std::size_t>(tile)] < 0)
                empty.push_back(tile);
    }

    int generationOf(const Job& job) const
    {
        return static_cast<int>(job.item) - firstPair[static_cast<std::size_t>(pairs[job.item].tile)];
    }

    // Puts the jobs first that are in front in their tile, so that other ranks soon learn which inputs are hidden. If
    // nothing is hidden, this would only complete tiles later.
    void renderFrontsFirst()
    {
        std::stable_partition(jobs.begin(), jobs.end(), [this](const Job& job) { return generationOf(job) == 0; });
    }

    // Tells the ranks behind them of this rank's inputs that hid others in the last frame, as they probably will again.
    void announceHiders(const FrameBase& frame, const SharedWorld& world, int tileCount, OwnerRef owner)
    {
        if (hider.size() != static_cast<std::size_t>(tileCount)) {
            hider = std::vector<std::atomic<int>>(static_cast<std::size_t>(tileCount));
            std::fill(hider.begin(), hider.end(), -1);
        }
        announced.assign(hider.size(), -1);
        for (const Job& job : jobs) {
            const BrickInTile& pair = pairs[job.item];
            const auto tile = static_cast<std::size_t>(pair.tile);
            if (hider[tile] != pair.brick || !frame.opaqueHides(pair.tile))
                continue;
            announced[tile] = pair.brick;
            forEachRankBehind(world, job, owner,
                              [&](int generation, int rank) { frame.mayHide(pair.tile, generation, rank); });
        }
    }

    // Tells the ranks behind an input that it hides theirs; or, if they wait to be told, that it does not.
    void tellBehind(const FrameBase& frame, const SharedWorld& world, const Job& job, OwnerRef owner, bool hides)
    {
        const BrickInTile& pair = pairs[job.item];
        const auto tile = static_cast<std::size_t>(pair.tile);
        if (!hides && announced[tile] != pair.brick)
            return; // nobody waits
        if (hides)
            anyHidden = true;
        hider[tile] = hides ? pair.brick : -1;
        forEachRankBehind(world, job, owner, [&](int generation, int rank) {
            if (hides)
                frame.hide(pair.tile, generation, rank);
            else
                frame.show(pair.tile, generation, rank);
        });
    }

    // Waits until other ranks have said whether they hide some of the undecided jobs, and moves these to `jobs`.
    // Returns false if there are no more, or the frame has failed.
    bool takeDecided(const FrameBase& frame)
    {
        const auto isUndecided = [&](const Job& job) {
            return frame.isUndecided(pairs[job.item].tile, generationOf(job));
        };
        while (!undecided.empty() && !frame.failed()) {
            auto decided = std::stable_partition(undecided.begin(), undecided.end(), isUndecided);
            const auto heard = [&] { return !std::all_of(undecided.begin(), undecided.end(), isUndecided); };
            if (decided == undecided.end()) {
                if (frame.waitForWord(heard))
                    continue;
                decided = undecided.begin(); // there was no word in time
            }
            jobs.assign(decided, undecided.end());
            undecided.erase(decided, undecided.end());
            return true;
        }
        return false;
    }

private:
    // Calls f(generation, rank) for each rank that renders something behind a job. `generation`: the first one behind
    // it.
    void forEachRankBehind(const SharedWorld& world, const Job& job, OwnerRef owner,
                           FunctionRef<void(int, int)> f) const
    {
        const int tile = pairs[job.item].tile;
        static thread_local std::vector<int> spare; // not used itself, as owner() may do other work meanwhile
        std::vector<int> told = std::move(spare);
        told.clear();
        for (std::size_t p = job.item + 1; p < pairs.size() && pairs[p].tile == tile; ++p) {
            const int rank = owner(brickOf(world, pairs[p]), tile, 0);
            if (std::find(told.begin(), told.end(), rank) != told.end())
                continue;
            f(generationOf(job) + 1, rank);
            told.push_back(rank);
        }
        spare = std::move(told);
    }
};

} // namespace detail

// A DataParallelLoop for bricks that several ranks may hold. For each tile and pass `owner` picks the rank that renders
// the brick. The image is that of data-parallel rendering, bit for bit, whichever ranks it picks. Framebuffer, world
// and owner must outlive it. One thread at a time may use it. Sets FrameConfig::order where the bricks have one.
template <class FrameBuffer, class TileBrickOwner>
class MixedParallelLoop {
public:
    // Not collective. Waits for nothing.
    MixedParallelLoop(FrameBuffer& fb, const SharedWorld& world, TileBrickOwner& owner)
        : fb_(fb), world_(world), owner_(owner)
    {
    }

    // As DataParallelLoop::start(). renderBrick(brick, tile) may return its cost, a number in any unit.
    template <class Camera, class RenderBrick>
    typename FrameBuffer::Frame start(const Camera& camera, const RenderBrick& renderBrick, FrameConfig params = {},
                                      const typename FrameBuffer::TileFrameData& tileData = {},
                                      const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        params.declared = true;
        const std::exception_ptr failure = fromWorld_.set(params, fb_, world_, camera, detail::firstRank(owner_));
        auto frame = fb_.begin(params, tileData, pixelData, failure);
        frame.guard([&] {
            work_.pairs = visibleTiles(world_, camera, fb_.layout(), std::move(work_.pairs));
            work_.findJobs(frame, world_, owner_, fb_.rank());
            work_.renderCostlyFirst(world_, owner_);
            // The first rank that holds the brick declares the tile, even if another one renders it.
            inputs_.clear();
            for (const BrickInTile& pair : work_.pairs)
                if (const SharedBrick& b = detail::brickOf(world_, pair); b.ranks.front() == fb_.rank())
                    inputs_.push_back({pair.tile, b.id, 0});
            frame.declare(inputs_);
            const auto count = static_cast<std::int64_t>(work_.jobs.size());
            frame.template forEachTile<detail::TileFor<FrameBuffer, RenderBrick>>(
                count, [&](std::int64_t i, auto& tile) {
                    const detail::Job& job = work_.jobs[static_cast<std::size_t>(i)];
                    const BrickInTile& pair = work_.pairs[job.item];
                    const Brick& brick = detail::brickOf(world_, pair);
                    frame.start(tile, pair.tile, job.pass);
                    tile.generation = 1;
                    tile.source = brick.id;
                    detail::renderMeasured<TileBrickOwner>(frame, brick, renderBrick, tile);
                    frame.setTile(tile);
                });
        });
        return frame;
    }

    // Renders a whole frame: start() and Frame::end(). Collective. Waits and throws as both do.
    template <class Camera, class RenderBrick>
    FrameReport render(const Camera& camera, const RenderBrick& renderBrick, const FrameConfig& params = {},
                       const typename FrameBuffer::TileFrameData& tileData = {},
                       const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        return start(camera, renderBrick, params, tileData, pixelData).end();
    }

private:
    FrameBuffer& fb_;
    const SharedWorld& world_;
    TileBrickOwner& owner_;
    detail::MixedWork work_;
    detail::FromWorld fromWorld_;
    std::vector<TileInput> inputs_; // that this rank declares
};

// The mixed-parallel loop for OrderedBlend. The generation of an input is its place in the order of the tile's bricks,
// so owners sort nothing and wait for no declarations. With one pass and an image of colour alone, an input behind an
// opaque one is neither rendered nor sent if its rank learns of that in time. If an input hid others in the last frame,
// these wait until it has been rendered again, at most FrameBufferConfig::quiet. Use the loop only if one order of the
// bricks is right for all rays of a frame: not with an extended lens or several eyes. Framebuffer, world and owner must
// outlive it. One thread at a time may use it.
template <class FrameBuffer, class TileBrickOwner>
class OrderedLoop {
public:
    // Not collective. Waits for nothing.
    OrderedLoop(FrameBuffer& fb, const SharedWorld& world, TileBrickOwner& owner)
        : fb_(fb), world_(world), owner_(owner)
    {
    }

    // As MixedParallelLoop::start(), but also waits for ranks that may hide inputs. `order`: the bricks front to back,
    // by their place in world.bricks(), as visibilityOrder() returns them. If it does not have each once, the frame
    // fails (InvalidArgument).
    template <class Camera, class RenderBrick>
    typename FrameBuffer::Frame start(const Camera& camera, const std::vector<int>& order,
                                      const RenderBrick& renderBrick, FrameConfig params = {},
                                      const typename FrameBuffer::TileFrameData& tileData = {},
                                      const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        params.declared = false;
        const std::exception_ptr failure = fromWorld_.set(params, fb_, world_, camera, detail::firstRank(owner_), true);
        auto frame = fb_.begin(params, tileData, pixelData, failure);
        frame.guard([&] {
            work_.pairs = visibleTiles(world_, camera, fb_.layout(), std::move(work_.pairs));
            work_.sortFrontToBack(world_, order);
            work_.findJobs(frame, world_, owner_, fb_.rank());
            work_.findEmpty(fb_.layout().tileCount(), frame.ownedTiles());
            frame.template forEachTile<typename FrameBuffer::TileView>(work_.empty,
                                                                       [&](const auto& tile) { frame.setTile(tile); });
            if (work_.anyHidden.exchange(false))
                work_.renderFrontsFirst();
            work_.announceHiders(frame, world_, fb_.layout().tileCount(), owner());
            work_.undecided.clear();
            renderJobs(frame, renderBrick, true);
            while (work_.takeDecided(frame))
                renderJobs(frame, renderBrick, false);
        });
        return frame;
    }

    // Renders a whole frame: start() and Frame::end(). Collective. Waits and throws as both do.
    template <class Camera, class RenderBrick>
    FrameReport render(const Camera& camera, const std::vector<int>& order, const RenderBrick& renderBrick,
                       const FrameConfig& params = {}, const typename FrameBuffer::TileFrameData& tileData = {},
                       const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        return start(camera, order, renderBrick, params, tileData, pixelData).end();
    }

private:
    // `mayWait`: sets aside the jobs that another rank may still hide.
    template <class RenderBrick>
    void renderJobs(typename FrameBuffer::Frame& frame, const RenderBrick& renderBrick, bool mayWait)
    {
        const std::vector<BrickInTile>& pairs = work_.pairs;
        const auto count = static_cast<std::int64_t>(work_.jobs.size());
        frame.template forEachTile<detail::TileFor<FrameBuffer, RenderBrick>>(count, [&](std::int64_t i, auto& tile) {
            const detail::Job& job = work_.jobs[static_cast<std::size_t>(i)];
            const BrickInTile& pair = pairs[job.item];
            const Brick& brick = detail::brickOf(world_, pair);
            const int generation = work_.generationOf(job);
            if (frame.isHidden(pair.tile, generation)) {
                work_.anyHidden = true;
                return;
            }
            if (mayWait && frame.isUndecided(pair.tile, generation)) {
                const std::lock_guard<std::mutex> lock(work_.undecidedMutex);
                work_.undecided.push_back(job);
                return;
            }
            frame.start(tile, pair.tile, job.pass);
            tile.generation = generation;
            tile.children = job.item + 1 < pairs.size() && pairs[job.item + 1].tile == pair.tile;
            tile.source = brick.id;
            try {
                detail::renderMeasured<TileBrickOwner>(frame, brick, renderBrick, tile);
                frame.setTile(tile);
            } catch (...) { // in a partial frame, others would wait to be told
                work_.tellBehind(frame, world_, job, owner(), false);
                throw;
            }
            if (tile.children > 0 && frame.opaqueHides(pair.tile))
                work_.tellBehind(frame, world_, job, owner(), frame.hidesRest(tile));
        });
    }

    // The owner, in the form that OrderedWork takes.
    auto owner() const
    {
        return [this](const SharedBrick& brick, int tile, int pass) { return owner_(brick, tile, pass); };
    }

    FrameBuffer& fb_;
    const SharedWorld& world_;
    TileBrickOwner& owner_;
    detail::OrderedWork work_;
    detail::FromWorld fromWorld_;
};

DFB_NAMESPACE_END
