// Tile-brick owners: if several ranks hold a brick, an owner picks the rank that renders it in a tile.
// MixedParallelLoop and OrderedLoop take one. RoundRobinBricks deals tiles out evenly, MeasuredCostBricks by the cost
// of the last frame. Or write your own. It is any type with
//   int operator()(const SharedBrick& brick, int tile, int pass);      returns the rank, one of brick.ranks
// and, if it decides about all pairs of brick and tile together,
//   void plan(const SharedWorld&, const std::vector<BrickInTile>&, const std::vector<int>& passes);
//                                  called once a frame, before operator(): with all pairs, and the number of passes of
//                                  each. FrameReport::figures then has the cost of each pair that was rendered, the
//                                  sum over its passes, for the next plan.
// and, if it knows costs,
//   double costOf(const SharedBrick& brick, int tile) const;      in any unit, 0 if it is not known. In a
//                                  MixedParallelLoop, a rank first renders the passes that cost more than twice the
//                                  mean of its own, so that no worker is left with one at the end.
// MixedParallelLoop calls all of them on the thread that is in start(). OrderedLoop calls operator() from several
// workers at once as well. It may be asked about pass 0 more than once, except by a MixedParallelLoop if it has
// plan(). All ranks must get the same answers. If it picks a rank that does not hold the brick, the frame fails.
#pragma once

#include <dfb/base/detect.hpp>
#include <dfb/base/function_ref.hpp>
#include <dfb/frame.hpp>
#include <dfb/framebuffer_base.hpp>
#include <dfb/render/shared_world.hpp>
#include <dfb/render/visibility.hpp>
#include <dfb/render/world.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <tuple>
#include <type_traits>
#include <unordered_map>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// Deals the tiles of a brick in turn to the ranks that hold it (section 4.3 of the paper), in a mixed order. Otherwise
// a rank would get whole columns of some images, whose tiles may all cost more than others. Any thread may call it.
struct RoundRobinBricks {
    int operator()(const SharedBrick& brick, int tile, int /*pass*/) const
    {
        const std::uint32_t mixed = static_cast<std::uint32_t>(tile) * 0x9e3779b1u >> 16;
        return brick.ranks[(brick.id + mixed) % brick.ranks.size()];
    }
};

// Deals out the passes of bricks in tiles so that all ranks have equally much to do. It takes the cost of each brick
// and tile from the last frame; if that is not known, the mean cost of the brick, or of all bricks. Call update() after
// each frame. The cost is the number that renderBrick returns, or else the time that it took, in ns. One thread at a
// time may call update() and plan().
class MeasuredCostBricks {
public:
    // Takes the costs of the frame of this report, and forgets all others. A cost that is not finite counts as not
    // known. Call it on all ranks, after the same end() and before the same begin(). Sends nothing and waits for
    // nothing.
    void update(const FrameReport& report)
    {
        costs_.clear();
        for (const Figure& figure : report.figures)
            if (std::isfinite(figure.value))
                costs_[figure.key] = figure.value;
    }

    // Returns the key under which FrameReport::figures has the cost of a brick in a tile.
    static std::uint64_t keyOf(std::uint32_t brickId, int tile) noexcept
    {
        return std::uint64_t{brickId} << 32 | static_cast<std::uint32_t>(tile);
    }

    // Called by the loop, once a frame: see the top of this file.
    void plan(const SharedWorld& world, const std::vector<BrickInTile>& pairs, const std::vector<int>& passes)
    {
        struct Job {
            double cost;
            std::size_t pair;
            int pass, rank;
        };
        const std::vector<double> pairCosts = estimate(world, pairs);
        std::vector<Job> jobs;
        int rankCount = 1;
        for (std::size_t p = 0; p < pairs.size(); ++p) {
            rankCount = std::max(rankCount, detail::brickOf(world, pairs[p]).ranks.back() + 1);
            for (int pass = 0; pass < passes[p]; ++pass)
                jobs.push_back({pairCosts[p] / passes[p], p, pass, 0});
        }
        // Each job, the costliest first, goes to the rank with the least load (Graham 1969).
        std::sort(jobs.begin(), jobs.end(), [](const Job& a, const Job& b) {
            return a.cost != b.cost ? a.cost > b.cost : std::tie(a.pair, a.pass) < std::tie(b.pair, b.pass);
        });
        std::vector<double> load(static_cast<std::size_t>(rankCount), 0.0);
        const auto loadOf = [&](int rank) -> double& { return load[static_cast<std::size_t>(rank)]; };
        const auto least = [&](const Job& job) {
            const std::vector<int>& ranks = detail::brickOf(world, pairs[job.pair]).ranks;
            return *std::min_element(ranks.begin(), ranks.end(), [&](int a, int b) { return loadOf(a) < loadOf(b); });
        };
        for (Job& job : jobs) {
            job.rank = least(job);
            loadOf(job.rank) += job.cost;
        }
        // Not every rank holds every brick, so a rank may still have too much load. Moves jobs from rank to rank, step
        // by step.
        for (int sweep = 0, moved = 1; sweep < 32 && moved > 0; ++sweep) {
            moved = 0;
            for (Job& job : jobs) {
                const int other = least(job);
                if (other == job.rank || !(loadOf(other) + job.cost < loadOf(job.rank)))
                    continue;
                loadOf(job.rank) -= job.cost;
                loadOf(other) += job.cost;
                job.rank = other;
                ++moved;
            }
        }
        table_.clear();
        for (std::size_t p = 0; p < pairs.size(); ++p)
            table_[keyOf(world, pairs[p])].resize(static_cast<std::size_t>(passes[p]));
        for (const Job& job : jobs)
            table_[keyOf(world, pairs[job.pair])][static_cast<std::size_t>(job.pass)] = job.rank;
    }

    // The cost in the last frame; 0 if it is not known.
    double costOf(const SharedBrick& brick, int tile) const
    {
        const auto known = costs_.find(keyOf(brick.id, tile));
        return known != costs_.end() ? known->second : 0;
    }

    // After plan(). Throws std::out_of_range for a pair that plan() did not get.
    int operator()(const SharedBrick& brick, int tile, int pass) const
    {
        return table_.at(keyOf(brick.id, tile))[static_cast<std::size_t>(pass)];
    }

private:
    static std::uint64_t keyOf(const SharedWorld& world, const BrickInTile& pair)
    {
        return keyOf(detail::brickOf(world, pair).id, pair.tile);
    }

    std::vector<double> estimate(const SharedWorld& world, const std::vector<BrickInTile>& pairs) const
    {
        struct Mean {
            double sum = 0;
            std::int64_t count = 0;
        };
        std::vector<Mean> ofBrick(world.bricks().size());
        Mean ofAll;
        for (const BrickInTile& pair : pairs)
            if (const auto known = costs_.find(keyOf(world, pair)); known != costs_.end())
                for (Mean* mean : {&ofBrick[static_cast<std::size_t>(pair.brick)], &ofAll}) {
                    mean->sum += known->second;
                    ++mean->count;
                }
        std::vector<double> costs;
        for (const BrickInTile& pair : pairs) {
            const auto known = costs_.find(keyOf(world, pair));
            const Mean& brick = ofBrick[static_cast<std::size_t>(pair.brick)];
            costs.push_back(known != costs_.end() ? known->second
                            : brick.count > 0     ? brick.sum / static_cast<double>(brick.count)
                            : ofAll.count > 0     ? ofAll.sum / static_cast<double>(ofAll.count)
                                                  : 1.0);
        }
        return costs;
    }

    std::unordered_map<std::uint64_t, double> costs_;           // cost of each pair in the last frame
    std::unordered_map<std::uint64_t, std::vector<int>> table_; // of this frame: the rank for each pass
};

namespace detail {

DFB_DETECTS(has_costs_v, std::declval<const T&>().costOf(std::declval<const SharedBrick&>(), int()));
DFB_DETECTS(has_plan_v,
            std::declval<T&>().plan(std::declval<const SharedWorld&>(), std::declval<const std::vector<BrickInTile>&>(),
                                    std::declval<const std::vector<int>&>()));

// A tile-brick owner of any type.
using OwnerRef = FunctionRef<int(const SharedBrick& brick, int tile, int pass)>;

// Returns the rank that renders a pass of a brick in a tile. Throws InvalidArgument if it does not hold the brick.
inline int rankOf(const SharedBrick& brick, int tile, int pass, OwnerRef owner)
{
    const int rank = owner(brick, tile, pass);
    if (!std::binary_search(brick.ranks.begin(), brick.ranks.end(), rank))
        failArgument("the tile-brick owner gives tile %d of brick %u to rank %d, which does not hold it", tile,
                     brick.id, rank);
    return rank;
}

// Returns FromWorld::RankOf for the first pass. If the owner plans, it does so later in the frame, and this is a guess.
template <class Owner>
auto firstRank(Owner& owner)
{
    return [&owner](const SharedBrick& brick, int tile) {
        if constexpr (has_plan_v<Owner>)
            return RoundRobinBricks()(brick, tile, 0);
        else
            return rankOf(brick, tile, 0, [&](const SharedBrick& b, int t, int pass) { return owner(b, t, pass); });
    };
}

// Calls renderBrick, and notes the cost if the owner plans.
template <class Owner, class RenderBrick, class Tile>
void renderMeasured(const FrameBase& frame, const Brick& brick, const RenderBrick& renderBrick, Tile& tile)
{
    if constexpr (!has_plan_v<Owner>) {
        renderBrick(brick, tile);
        return;
    }
    const std::uint64_t key = MeasuredCostBricks::keyOf(brick.id, tile.tile);
    if constexpr (std::is_arithmetic_v<decltype(renderBrick(brick, tile))>) {
        frame.addFigure(key, static_cast<double>(renderBrick(brick, tile)));
    } else {
        const auto start = std::chrono::steady_clock::now();
        renderBrick(brick, tile);
        frame.addFigure(key,
                        std::chrono::duration<double, std::nano>(std::chrono::steady_clock::now() - start).count());
    }
}

} // namespace detail
DFB_NAMESPACE_END
