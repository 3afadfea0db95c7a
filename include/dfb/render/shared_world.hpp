// SharedWorld: the bricks of all ranks, and which ranks hold each. For bricks that several ranks hold, and for orders
// of bricks from front to back.
#pragma once

#include <dfb/render/cameras.hpp>
#include <dfb/render/visibility.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// The id and bounds of a brick of any rank, and the ranks that hold it, ascending.
struct SharedBrick {
    Brick brick;
    std::vector<int> ranks;
};

// The bricks of all ranks, and which ranks hold them; equal on all ranks. Takes memory and time in proportion to the
// number of all bricks.
class SharedWorld {
public:
    // Gathers the bricks of all ranks. Bricks with the same id are one. Collective, outside frames. Waits for all
    // ranks. Throws InvalidArgument on all ranks if the bounds of one brick differ between ranks, or if a rank sends no
    // World.
    template <class FrameBuffer>
    SharedWorld(FrameBuffer& fb, const World& world) : rank_(fb.rank())
    {
        std::vector<std::byte> mine(world.bricks().size() * sizeof(Record));
        for (std::size_t i = 0; i < world.bricks().size(); ++i) {
            const Record record{world.bricks()[i].id, world.bricks()[i].bounds};
            std::memcpy(mine.data() + i * sizeof record, &record, sizeof record);
        }
        const std::vector<std::vector<std::byte>> all = fb.allGather(mine);
        std::vector<std::pair<Record, int>> held;
        for (std::size_t rank = 0; rank < all.size(); ++rank) {
            if (all[rank].size() % sizeof(Record) != 0)
                detail::failArgument("the bricks of rank %zu have %zu bytes", rank, all[rank].size());
            for (std::size_t at = 0; at < all[rank].size(); at += sizeof(Record)) {
                Record record;
                std::memcpy(&record, all[rank].data() + at, sizeof record);
                if (!detail::isBox(record.bounds))
                    detail::failArgument("the bounds of brick %u of rank %zu are not a box", record.id, rank);
                held.emplace_back(record, static_cast<int>(rank));
            }
        }
        std::sort(held.begin(), held.end(), [](const auto& a, const auto& b) {
            return a.first.id != b.first.id ? a.first.id < b.first.id : a.second < b.second;
        });
        for (const auto& [record, rank] : held) {
            if (bricks_.empty() || bricks_.back().brick.id != record.id) {
                SharedBrick shared;
                shared.brick.id = record.id;
                shared.brick.bounds = record.bounds;
                bricks_.push_back(std::move(shared));
            }
            if (std::memcmp(&bricks_.back().brick.bounds, &record.bounds, sizeof record.bounds) != 0)
                detail::failArgument("brick %u has other bounds on rank %d than on rank %d", record.id, rank,
                                     bricks_.back().ranks.front());
            if (!bricks_.back().ranks.empty() && bricks_.back().ranks.back() == rank)
                detail::failArgument("brick %u comes twice from rank %d", record.id, rank);
            bricks_.back().ranks.push_back(rank);
        }
    }

    // By ascending id.
    const std::vector<SharedBrick>& bricks() const noexcept { return bricks_; }

    // This rank.
    int rank() const noexcept { return rank_; }

private:
    struct Record {
        std::uint32_t id = 0;
        Box3 bounds;
    };

    int rank_;
    std::vector<SharedBrick> bricks_;
};

namespace detail {

// `isParallel`: axes along which no ray goes, so that no ray crosses a plane between two boxes there.
inline std::vector<int> frontToBack(const SharedWorld& world, const Vec3& eye, const bool (&isParallel)[3])
{
    const auto& bricks = world.bricks();
    const std::size_t n = bricks.size();
    // A plane between two boxes with the eye on one side of it (or on it) makes it right to have that side's box first.
    enum class Before { Either, First, Second };
    const auto compare = [&](const Box3& a, const Box3& b) {
        bool apart = false, first = false, second = false;
        const auto alongAxis = [&](float aLower, float aUpper, float bLower, float bUpper, float e, bool parallel) {
            if (aUpper <= bLower) { // a plane between, at any of [aUpper, bLower]
                apart = true;
                first = first || parallel || e <= bLower;
                second = second || parallel || e >= aUpper;
            } else if (bUpper <= aLower) {
                apart = true;
                first = first || parallel || e >= bUpper;
                second = second || parallel || e <= aLower;
            }
        };
        alongAxis(a.lower.x, a.upper.x, b.lower.x, b.upper.x, eye.x, isParallel[0]);
        alongAxis(a.lower.y, a.upper.y, b.lower.y, b.upper.y, eye.y, isParallel[1]);
        alongAxis(a.lower.z, a.upper.z, b.lower.z, b.upper.z, eye.z, isParallel[2]);
        if (!apart)
            failArgument("two bricks overlap: there is no order in which they could be blended");
        return first == second ? Before::Either : first ? Before::First : Before::Second;
    };
    std::vector<std::vector<int>> behind(n);
    std::vector<int> inFront(n, 0);
    for (std::size_t a = 0; a < n; ++a)
        for (std::size_t b = a + 1; b < n; ++b) {
            const Before before = compare(bricks[a].brick.bounds, bricks[b].brick.bounds);
            if (before == Before::Either)
                continue;
            const std::size_t front = before == Before::First ? a : b, back = before == Before::First ? b : a;
            behind[front].push_back(static_cast<int>(back));
            ++inFront[back];
        }
    std::vector<int> order;
    for (std::size_t i = 0; i < n; ++i)
        if (inFront[i] == 0)
            order.push_back(static_cast<int>(i));
    for (std::size_t i = 0; i < order.size(); ++i)
        for (const int next : behind[static_cast<std::size_t>(order[i])])
            if (--inFront[static_cast<std::size_t>(next)] == 0)
                order.push_back(next);
    if (order.size() != n)
        failArgument("the bricks are in front of each other in a circle: no order is right for all pixels");
    return order;
}

} // namespace detail

// Returns the bricks, by their place in SharedWorld::bricks(), such that no ray from `eye` meets one before another
// that stands earlier in the list. Takes time with the square of their number. Throws InvalidArgument if two overlap,
// or if there is no such order: three boxes can each be in front of the next.
inline std::vector<int> visibilityOrder(const SharedWorld& world, const Vec3& eye)
{
    return detail::frontToBack(world, eye, {false, false, false});
}

// Returns this order for all rays of a camera, also of an orthographic one. Throws likewise.
inline std::vector<int> visibilityOrder(const SharedWorld& world, const MatrixCamera& camera)
{
    if (!camera.isOrthographic())
        return visibilityOrder(world, camera.eye());
    const Vec3 d = camera.ray(0, 0, 1, 1).direction;
    const auto from = [](float direction) { return std::copysign(std::numeric_limits<float>::infinity(), -direction); };
    return detail::frontToBack(world, {from(d.x), from(d.y), from(d.z)}, {d.x == 0, d.y == 0, d.z == 0});
}

DFB_NAMESPACE_END
