// ContentCut: bricks that take equally long to render, as an example of a cost function. A scene that is cut by volume
// gives some ranks more to do than others, as most of its space may be empty, and what is near covers more pixels.
//
// The cost of a place is the work of a frame's rays there: samples in visible blocks of a volume, and hits of surfaces
// with the secondary rays that start there. It is estimated on a coarse grid, from what all ranks know about the scene
// anyway, for several frames of the run.
#pragma once

#include "renderer.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <numeric>
#include <utility>
#include <vector>

namespace example {

class ContentCut {
public:
    // Collective: each rank looks at its own parts of meshes and spheres.
    ContentCut(const Scene& scene, const SceneInfo& info, const RenderSettings& settings, const Loaders& loaders = {})
        : bounds_(scene.bounds)
    {
        const double extent = static_cast<double>(bounds_.largestExtent());
        for (std::size_t axis = 0; axis < 3; ++axis) {
            const double length = static_cast<double>(component(bounds_.extent(), axis));
            size_[axis] = std::max<std::size_t>(1, static_cast<std::size_t>(std::lround(finest * length / extent)));
        }
        std::vector<double> content = surfaceContent(scene, loaders);
        for (double& amount : content)
            amount *= 1 + settings.aoRays + settings.shadows;
        for (const VolumeObject& volume : scene.volumes)
            addVolume(content, volume, 1 / static_cast<double>(info.step));
        const int views = std::min(settings.frames, mostViews);
        for (int view = 0; view < views; ++view)
            addView(content, frameCamera(info, settings, view * settings.frames / views).pinhole(), settings);
    }

    // The cells of `count` bricks, which tile the scene's bounds. The bounds are cut into halves of equal cost again
    // and again, each time along the axis that gives the busiest rank the least work.
    std::vector<Box> cells(int count) const
    {
        std::vector<Box> all;
        Grid whole;
        for (std::size_t axis = 0; axis < 3; ++axis)
            whole.hi[axis] = static_cast<double>(size_[axis]);
        bisect(whole, bounds_, count, all);
        return all;
    }

private:
    static constexpr int finest = 64;   // cells of the grid along the longest axis
    static constexpr int mostViews = 8; // frames of the run that are considered
    // The part of the total cost that is spread evenly over space: a brick takes memory also where it is empty, and the
    // grid is coarse.
    static constexpr double roomPart = 0.1;

    static constexpr int mostAhead = 8;          // up to so many bricks, all cuts are tried to the end
    static constexpr double thinnest = 1.0 / 16; // a side may be cut if it is at least this part of the longest

    // A box in cells of the grid, or parts of them.
    struct Grid {
        std::array<double, 3> lo{}, hi{};
    };

    std::size_t indexOf(std::size_t x, std::size_t y, std::size_t z) const { return (z * size_[1] + y) * size_[0] + x; }

    // The position of a world coordinate on the grid.
    double onGrid(float world, std::size_t axis) const
    {
        const double lo = static_cast<double>(component(bounds_.lo, axis)),
                     extent = static_cast<double>(component(bounds_.extent(), axis));
        const double cells = static_cast<double>(size_[axis]);
        return std::clamp((static_cast<double>(world) - lo) / extent * cells, 0.0, cells);
    }

    // The cost of rays that hit surfaces, without secondary rays. It is summed in whole units, which doubles hold
    // exactly, so the sum does not depend on the number or the order of the ranks.
    std::vector<double> surfaceContent(const Scene& scene, const Loaders& loaders) const
    {
        const double extent = static_cast<double>(bounds_.largestExtent()), unit = extent * extent * 0x1.0p-30;
        std::vector<double> own(size_[0] * size_[1] * size_[2]);
        if (!(unit > 0))
            return own;
        const auto isMine = [&](const auto& object) { return object.isPart || loaders.rank() == 0; };
        for (const MeshObject& object : scene.meshes)
            for (const Triangle& triangle : object.mesh.triangles) {
                const Vec3 &a = object.mesh.positions[triangle[0]], &b = object.mesh.positions[triangle[1]],
                           &c = object.mesh.positions[triangle[2]];
                Box box;
                for (const Vec3& p : {a, b, c})
                    box.grow(p);
                // Seen from a random side, a triangle covers half of its area on average.
                if (isMine(object) && box.overlaps(bounds_)) // otherwise it is clipped away
                    add(own, box, 0.25 * static_cast<double>(length(cross(b - a, c - a))) / unit, std::nearbyint);
            }
        for (const SphereObject& object : scene.spheres)
            for (const Sphere& sphere : object.spheres) {
                Box box;
                box.grow(sphere.center, sphere.radius);
                const double radius = static_cast<double>(sphere.radius);
                if (isMine(object) && box.overlaps(bounds_)) // a ray hits it twice
                    add(own, box, 2 * 3.14159265358979323846 * radius * radius / unit, std::nearbyint);
            }
        std::vector<std::int64_t> whole;
        for (const double amount : own)
            whole.push_back(static_cast<std::int64_t>(std::min(amount, 0x1.0p52)));
        whole = loaders.sumOf(whole);
        for (std::size_t i = 0; i < own.size(); ++i)
            own[i] = static_cast<double>(whole[i]) * unit;
        return own;
    }

    // Spreads an amount over the grid cells in a box; `round` rounds the amount of each.
    void add(std::vector<double>& content, const Box& box, double amount, double (*round)(double)) const
    {
        std::array<std::size_t, 3> first{}, last{};
        std::array<std::array<double, 2>, 3> ends{};
        for (std::size_t axis = 0; axis < 3; ++axis) {
            ends[axis] = {onGrid(component(box.lo, axis), axis), onGrid(component(box.hi, axis), axis)};
            first[axis] = std::min(static_cast<std::size_t>(ends[axis][0]), size_[axis] - 1);
            last[axis] = std::min(static_cast<std::size_t>(ends[axis][1]), size_[axis] - 1);
        }
        const auto part = [&](std::size_t axis, std::size_t i) { // part of the box in grid cell `i` along an axis
            const auto [lo, hi] = ends[axis];
            if (!(hi > lo))
                return 1.0;
            const double at = static_cast<double>(i);
            return std::max(0.0, std::min(hi, at + 1) - std::max(lo, at)) / (hi - lo);
        };
        for (std::size_t z = first[2]; z <= last[2]; ++z)
            for (std::size_t y = first[1]; y <= last[1]; ++y)
                for (std::size_t x = first[0]; x <= last[0]; ++x)
                    content[indexOf(x, y, z)] += round(amount * part(0, x) * part(1, y) * part(2, z));
    }

    void addVolume(std::vector<double>& content, const VolumeObject& object, double samplesPerLength) const
    {
        const VisibleVoxels& visible = *object.source.visible;
        std::size_t i = 0;
        for (int z = 0; z < visible.blocks[2]; ++z)
            for (int y = 0; y < visible.blocks[1]; ++y)
                for (int x = 0; x < visible.blocks[0]; ++x) {
                    if (visible.isSeen[i++] == 0)
                        continue;
                    Box block;
                    const Index3 at{x, y, z};
                    for (const int upper : {0, 1}) {
                        Vec3 p;
                        for (std::size_t axis = 0; axis < 3; ++axis)
                            component(p, axis) = static_cast<float>(
                                std::min((at[axis] + upper) * visible.width[axis], object.source.info.dims[axis] - 1));
                        block.grow(object.placement.toWorld(p));
                    }
                    block = intersection(block, object.upright());
                    if (block.empty())
                        continue;
                    const Vec3 e = block.extent();
                    add(content, object.rotation.box(block),
                        samplesPerLength * static_cast<double>(e.x) * static_cast<double>(e.y)
                            * static_cast<double>(e.z),
                        [](double v) { return v; });
                }
    }

    // Adds a view: sums of what the content costs when this camera sees it. Rays are denser near the eye, and there are
    // none outside of the image. A dome has rays all around.
    void addView(const std::vector<double>& content, const dfb::PerspectiveCamera& camera,
                 const RenderSettings& settings)
    {
        const Vec3 eye = camera.eye(), forward = camera.forward(), up = camera.up(), right = camera.right();
        const double tangent = std::tan(0.5 * static_cast<double>(settings.view.fieldOfView) * detail::degree)
                               / static_cast<double>(settings.view.zoom);
        const double aspect = static_cast<double>(settings.width) / settings.height;
        Vec3 cell;
        for (std::size_t axis = 0; axis < 3; ++axis)
            component(cell, axis) = component(bounds_.extent(), axis) / static_cast<float>(size_[axis]);
        const double radius = 0.5 * static_cast<double>(length(cell));
        const bool isDome = settings.view.kind == CameraKind::Dome;
        std::vector<double> sums((size_[0] + 1) * (size_[1] + 1) * (size_[2] + 1));
        for (std::size_t z = 0; z < size_[2]; ++z)
            for (std::size_t y = 0; y < size_[1]; ++y)
                for (std::size_t x = 0; x < size_[0]; ++x) {
                    const Vec3 p =
                        bounds_.lo
                        + Vec3{(static_cast<float>(x) + 0.5f) * cell.x, (static_cast<float>(y) + 0.5f) * cell.y,
                               (static_cast<float>(z) + 0.5f) * cell.z}
                        - eye;
                    const double far = std::max(static_cast<double>(length(p)), radius),
                                 ahead = static_cast<double>(dot(p, forward));
                    double rays = 1 / (far * far);
                    if (!isDome) {
                        const double high = std::max(ahead, radius) * tangent + radius,
                                     wide = std::max(ahead, radius) * tangent * aspect + radius;
                        const bool isInside = ahead > -radius && std::fabs(static_cast<double>(dot(p, up))) < high
                                              && std::fabs(static_cast<double>(dot(p, right))) < wide;
                        const double cosine = std::max(ahead, radius) / far;
                        rays = isInside ? rays / (cosine * cosine * cosine) : 0;
                    }
                    sums[sumIndex(x + 1, y + 1, z + 1)] = content[indexOf(x, y, z)] * rays;
                }
        const double all = std::accumulate(sums.begin(), sums.end(), 0.0), cells = static_cast<double>(content.size());
        for (std::size_t z = 1; z <= size_[2]; ++z)
            for (std::size_t y = 1; y <= size_[1]; ++y)
                for (std::size_t x = 1; x <= size_[0]; ++x) {
                    double& s = sums[sumIndex(x, y, z)];
                    s = (all > 0 ? s / all : 0) + roomPart / cells;
                }
        for (std::size_t axis = 0; axis < 3; ++axis)
            for (std::size_t z = 1; z <= size_[2]; ++z)
                for (std::size_t y = 1; y <= size_[1]; ++y)
                    for (std::size_t x = 1; x <= size_[0]; ++x)
                        sums[sumIndex(x, y, z)] += sums[sumIndex(x - (axis == 0), y - (axis == 1), z - (axis == 2))];
        views_.push_back(std::move(sums));
    }

    std::size_t sumIndex(std::size_t x, std::size_t y, std::size_t z) const
    {
        return (z * (size_[1] + 1) + y) * (size_[0] + 1) + x;
    }

    // The sum over all cells that lie before a point of the grid along all three axes.
    double sumBefore(const std::vector<double>& sums, const std::array<double, 3>& at) const
    {
        std::array<std::size_t, 3> cell{};
        std::array<double, 3> part{};
        for (std::size_t axis = 0; axis < 3; ++axis) {
            cell[axis] = std::min(static_cast<std::size_t>(at[axis]), size_[axis] - 1);
            part[axis] = at[axis] - static_cast<double>(cell[axis]);
        }
        double all = 0;
        for (std::size_t corner = 0; corner < 8; ++corner) {
            const std::size_t x = corner & 1, y = corner >> 1 & 1, z = corner >> 2;
            const double weight =
                (x != 0 ? part[0] : 1 - part[0]) * (y != 0 ? part[1] : 1 - part[1]) * (z != 0 ? part[2] : 1 - part[2]);
            all += weight * sums[sumIndex(cell[0] + x, cell[1] + y, cell[2] + z)];
        }
        return all;
    }

    // The part of a frame's cost that is in a box.
    double costOf(const std::vector<double>& sums, const Grid& box) const
    {
        double all = 0;
        for (std::size_t corner = 0; corner < 8; ++corner) {
            std::array<double, 3> at{};
            double sign = 1;
            for (std::size_t axis = 0; axis < 3; ++axis) {
                const bool isLower = (corner >> axis & 1) != 0;
                at[axis] = isLower ? box.lo[axis] : box.hi[axis];
                sign = isLower ? -sign : sign;
            }
            all += sign * sumBefore(sums, at);
        }
        return std::max(0.0, all);
    }

    struct Cut {
        std::size_t axis = 0;
        double at = 0;
    };

    // The cost per brick of the costlier half of a cut box, in the worst view. The halves are for `lower` and `upper`
    // bricks.
    double worstOf(const Grid& box, const Cut& cut, int lower, int upper) const
    {
        const auto [a, b] = halves(box, cut);
        double worst = 0;
        for (const auto& sums : views_)
            worst = std::max({worst, costOf(sums, a) / lower, costOf(sums, b) / upper});
        return worst;
    }

    static std::pair<Grid, Grid> halves(const Grid& box, const Cut& cut)
    {
        Grid a = box, b = box;
        a.hi[cut.axis] = b.lo[cut.axis] = cut.at;
        return {a, b};
    }

    // In world units.
    double lengthOf(const Grid& box, std::size_t axis) const
    {
        return (box.hi[axis] - box.lo[axis]) / static_cast<double>(size_[axis])
               * static_cast<double>(component(bounds_.extent(), axis));
    }

    // The best cut along an axis.
    Cut balanced(const Grid& box, std::size_t axis, int lower, int upper) const
    {
        double first = box.lo[axis], last = box.hi[axis];
        const double extent = last - first;
        first += extent / 64;
        last -= extent / 64;
        for (int step = 0; step < 20; ++step) {
            const double middle = 0.5 * (first + last);
            const auto [a, b] = halves(box, {axis, middle});
            double below = 0, above = 0;
            for (const auto& sums : views_) {
                below = std::max(below, costOf(sums, a) / lower);
                above = std::max(above, costOf(sums, b) / upper);
            }
            (below < above ? first : last) = middle;
        }
        return {axis, 0.5 * (first + last)};
    }

    // The best cut, and the cost of the costliest brick then. For up to `mostAhead` bricks all further cuts are tried;
    // for more, the halves count as if they could be cut evenly.
    std::pair<Cut, double> best(const Grid& box, int count) const
    {
        if (count == 1) {
            double worst = 0;
            for (const auto& sums : views_)
                worst = std::max(worst, costOf(sums, box));
            return {{}, worst};
        }
        const int lower = count / 2, upper = count - lower;
        std::pair<Cut, double> found{{}, std::numeric_limits<double>::infinity()};
        for (std::size_t axis = 0; axis < 3; ++axis) {
            if (lengthOf(box, axis) < thinnest * std::max({lengthOf(box, 0), lengthOf(box, 1), lengthOf(box, 2)}))
                continue;
            const Cut cut = balanced(box, axis, lower, upper);
            double worst = 0;
            if (count <= mostAhead) {
                const auto [a, b] = halves(box, cut);
                worst = std::max(best(a, lower).second, best(b, upper).second);
            } else {
                worst = worstOf(box, cut, lower, upper);
            }
            if (worst < found.second)
                found = {cut, worst};
        }
        return found;
    }

    void bisect(const Grid& grid, const Box& box, int count, std::vector<Box>& cells) const
    {
        if (count == 1) {
            cells.push_back(box);
            return;
        }
        const Cut cut = best(grid, count).first;
        const auto [a, b] = halves(grid, cut);
        const double part = (cut.at - grid.lo[cut.axis]) / (grid.hi[cut.axis] - grid.lo[cut.axis]);
        const double lo = static_cast<double>(component(box.lo, cut.axis)),
                     hi = static_cast<double>(component(box.hi, cut.axis));
        Box lower = box, upper = box;
        component(lower.hi, cut.axis) = component(upper.lo, cut.axis) = static_cast<float>(lo + part * (hi - lo));
        bisect(a, lower, count / 2, cells);
        bisect(b, upper, count - count / 2, cells);
    }

    Box bounds_;
    std::array<std::size_t, 3> size_{};
    std::vector<std::vector<double>> views_; // for each view: sums of its cost before each corner of the grid
};

} // namespace example
