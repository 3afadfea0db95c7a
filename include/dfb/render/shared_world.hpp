// SharedWorld: the bricks of all ranks, and which ranks hold each. visibilityOrder(): the bricks from front to back.
#pragma once

#include <dfb/base/detect.hpp>
#include <dfb/base/function_ref.hpp>
#include <dfb/compiled.hpp>
#include <dfb/render/visibility.hpp>

#include <algorithm>
#include <cstddef>
#include <cstring>
#include <optional>
#include <type_traits>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// The id and bounds of a brick of any rank, and the ranks that hold it, ascending.
struct SharedBrick : Brick {
    std::vector<int> ranks;
};

// The bricks of all ranks, and which ranks hold them; equal on all ranks. Memory and time grow with the number of all
// bricks. Any thread may read it.
class SharedWorld {
public:
    // Gathers the bricks of all ranks of a framebuffer or an ImageCompositor. Bricks with the same id are the same
    // brick. Collective, outside frames. Waits and throws as DistributedFrameBuffer::allGather(). Also throws
    // InvalidArgument on all ranks if the bounds of one brick differ between ranks, or if the bricks of a rank cannot
    // be read.
    template <class Object>
    SharedWorld(Object& object, const World& world)
        : SharedWorld(world, [&object](const Bytes& own) { return object.allGather(own, "SharedWorld()"); })
    {
    }

    // Sorted by ascending id.
    const std::vector<SharedBrick>& bricks() const noexcept { return bricks_; }

private:
    using Bytes = std::vector<std::byte>;
    using Gather = detail::FunctionRef<std::vector<Bytes>(const Bytes&)>;
    SharedWorld(const World& world, const Gather& gather);

    std::vector<SharedBrick> bricks_;
};

#if DFB_HAS_BODIES
DFB_COMPILED_ONCE SharedWorld::SharedWorld(const World& world, const Gather& gather)
{
    static_assert(std::is_trivially_copyable_v<Brick>);
    const auto* first = reinterpret_cast<const std::byte*>(world.bricks().data());
    const std::vector<Bytes> all = gather({first, first + world.bricks().size() * sizeof(Brick)});
    std::vector<std::pair<Brick, int>> held;
    for (std::size_t rank = 0; rank < all.size(); ++rank) {
        if (all[rank].size() % sizeof(Brick) != 0)
            detail::failArgument("the bricks of rank %zu have %zu bytes", rank, all[rank].size());
        for (std::size_t at = 0; at < all[rank].size(); at += sizeof(Brick)) {
            Brick brick;
            std::memcpy(&brick, all[rank].data() + at, sizeof brick);
            if (!detail::isBox(brick.bounds))
                detail::failArgument("the bounds of brick %u of rank %zu are not a box", brick.id, rank);
            held.emplace_back(brick, static_cast<int>(rank));
        }
    }
    std::sort(held.begin(), held.end(), [](const auto& a, const auto& b) {
        return a.first.id != b.first.id ? a.first.id < b.first.id : a.second < b.second;
    });
    for (const auto& [brick, rank] : held) {
        if (bricks_.empty() || bricks_.back().id != brick.id)
            bricks_.push_back({brick, {}});
        SharedBrick& shared = bricks_.back();
        if (!(shared.bounds == brick.bounds))
            detail::failArgument("brick %u has other bounds on rank %d than on rank %d", brick.id, rank,
                                 shared.ranks.front());
        if (!shared.ranks.empty() && shared.ranks.back() == rank)
            detail::failArgument("brick %u comes twice from rank %d", brick.id, rank);
        shared.ranks.push_back(rank);
    }
}
#endif

namespace detail {

DFB_DETECTS(has_common_eye_v, std::declval<const T&>().commonEye());

// Finds the order of bricks. Keeps it as long as their boxes and the eye stay the same.
class FrontToBack {
public:
    // Returns null, or why there is no order.
    const char* find(const SharedWorld& world, const Vec3& eye);

    // The bricks front to back, by their place in SharedWorld::bricks().
    const std::vector<int>& order() const noexcept { return order_; }

private:
    const char* findAgain();
    bool mayPrecede(const Box3& a, const Box3& b) const;

    std::vector<Box3> boxes_;
    Vec3 eye_;
    const char* why_ = nullptr;
    std::vector<int> order_, inFront_;
};

#if DFB_HAS_BODIES
DFB_COMPILED_ONCE const char* FrontToBack::find(const SharedWorld& world, const Vec3& eye)
{
    const auto& bricks = world.bricks();
    if (std::memcmp(&eye, &eye_, sizeof eye) == 0 // also of NaNs
        && std::equal(bricks.begin(), bricks.end(), boxes_.begin(), boxes_.end(),
                      [](const Brick& brick, const Box3& box) { return brick.bounds == box; }))
        return why_;
    order_.reserve(bricks.size()); // nothing may throw once boxes_ is set
    inFront_.reserve(bricks.size());
    eye_ = eye;
    boxes_.clear();
    for (const Brick& brick : bricks)
        boxes_.push_back(brick.bounds);
    return why_ = findAgain();
}

DFB_COMPILED_ONCE const char* FrontToBack::findAgain()
{
    order_.clear();
    inFront_.assign(boxes_.size(), 0);
    for (std::size_t a = 0; a < boxes_.size(); ++a)
        for (std::size_t b = a + 1; b < boxes_.size(); ++b) {
            const bool aFirst = mayPrecede(boxes_[a], boxes_[b]), bFirst = mayPrecede(boxes_[b], boxes_[a]);
            if (!aFirst && !bFirst)
                return "two bricks overlap: there is no order in which they could be blended";
            if (aFirst != bFirst)
                ++inFront_[aFirst ? b : a];
        }
    for (std::size_t i = 0; i < boxes_.size(); ++i)
        if (inFront_[i] == 0)
            order_.push_back(static_cast<int>(i));
    for (std::size_t i = 0; i < order_.size(); ++i)
        for (std::size_t b = 0; b < boxes_.size(); ++b)
            if (inFront_[b] > 0 && !mayPrecede(boxes_[b], boxes_[static_cast<std::size_t>(order_[i])])
                && --inFront_[b] == 0)
                order_.push_back(static_cast<int>(b));
    return order_.size() == boxes_.size()
               ? nullptr
               : "the bricks are in front of each other in a circle: no order is right for all pixels";
}

// If the eye is on one side of a plane between two boxes, or on the plane, the box on that side may come first. If no
// ray crosses the plane, either box may: the eye's coordinate is then NaN, and all comparisons are false.
DFB_COMPILED_ONCE bool FrontToBack::mayPrecede(const Box3& a, const Box3& b) const
{
    const auto along = [](float aLower, float aUpper, float bLower, float bUpper, float e) {
        return (aUpper <= bLower && !(e > bLower)) || (bUpper <= aLower && !(e < bUpper));
    };
    return along(a.lower.x, a.upper.x, b.lower.x, b.upper.x, eye_.x)
           || along(a.lower.y, a.upper.y, b.lower.y, b.upper.y, eye_.y)
           || along(a.lower.z, a.upper.z, b.lower.z, b.upper.z, eye_.z);
}
#endif

} // namespace detail

// Returns the bricks front to back as seen from `eye`, by their place in SharedWorld::bricks(). The time grows with the
// square of their number. Not collective. Any thread. Waits for nothing. Throws InvalidArgument if two overlap, or if
// there is no such order: three boxes can each be in front of the next.
inline std::vector<int> visibilityOrder(const SharedWorld& world, const Vec3& eye)
{
    detail::FrontToBack bricks;
    if (const char* why = bricks.find(world, eye))
        detail::failArgument("%s", why);
    return bricks.order();
}

// Returns this order for a camera that has commonEye(), such as an orthographic one. Also throws InvalidArgument if
// commonEye() returns nothing.
template <class Camera, std::enable_if_t<detail::has_common_eye_v<Camera>, int> = 0>
std::vector<int> visibilityOrder(const SharedWorld& world, const Camera& camera)
{
    const std::optional<Vec3> eye = camera.commonEye();
    if (!eye)
        detail::failArgument("the rays of this camera have no common eye: there is no order for all of them");
    return visibilityOrder(world, *eye);
}

DFB_NAMESPACE_END
