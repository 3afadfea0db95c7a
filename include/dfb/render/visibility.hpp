// Visibility: which tiles a brick may project to; and PerspectiveCamera.
//
// A camera, for the loops in render/, is any type with
//   Region project(const Box3& bounds, int width, int height) const;
// It returns the pixels of a width x height image that the box may cover, for any sample position within a pixel. It
// must not leave out a pixel; a tile too many costs only a header of 64 bytes. It may also return a Footprint, a convex
// polygon, which leaves out tiles in the corners of a Region; or a std::vector of either, as a stereo camera does. A
// camera may also have
//   std::optional<Vec3> commonEye() const;
// the point where all its rays begin, if there is one: then AlphaBlend need not sort (FrameConfig::order). Parallel
// rays come from a point at infinity: each coordinate is +-infinity, or NaN if the rays are perpendicular to that axis.
// Loops call both on the thread that is in start(); if they throw, the frame fails on all ranks. A partial
// frame then lacks tiles, or fails as well: see docs/errors.md.
#pragma once

#include <dfb/base/function_ref.hpp>
#include <dfb/compiled.hpp>
#include <dfb/frame.hpp>
#include <dfb/image.hpp>
#include <dfb/render/world.hpp>
#include <dfb/tile_layout.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <optional>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// A point of an image, in pixels. Pixel (x, y) is the square from there to (x + 1, y + 1).
struct PixelPoint {
    double x = 0, y = 0;
};

// A convex polygon in an image: the part that a convex body may cover. Any thread may call const members.
class Footprint {
public:
    Footprint() = default; // nothing

    // The hull of these points, widened by `margin` pixels, within an image of this size.
    Footprint(std::vector<PixelPoint> points, double margin, int width, int height);

    static Footprint whole(int width, int height)
    {
        const double w = width, h = height;
        return Footprint({{0, 0}, {w, 0}, {w, h}, {0, h}}, 0, width, height);
    }

    // Leaves only what is in a rectangle of pixels.
    void cut(const Region& r)
    {
        region_ = intersection(region_, r);
        if (region_.empty())
            region_ = {};
    }

    // The smallest rectangle of pixels around it.
    const Region& region() const noexcept { return region_; }

    // Whether it meets a rectangle of pixels, borders and margin included.
    bool meets(const Region& r) const;

private:
    static std::vector<PixelPoint> hullOf(std::vector<PixelPoint> points);

    std::vector<PixelPoint> hull_;
    double margin_ = 0;
    Region region_;
};

#if DFB_HAS_BODIES
DFB_COMPILED_ONCE Footprint::Footprint(std::vector<PixelPoint> points, double margin, int width, int height)
    : margin_(margin)
{
    if (points.empty())
        return;
    hull_ = hullOf(std::move(points));
    double x0 = hull_[0].x, y0 = hull_[0].y, x1 = x0, y1 = y0;
    for (const PixelPoint& p : hull_) {
        x0 = std::min(x0, p.x), x1 = std::max(x1, p.x);
        y0 = std::min(y0, p.y), y1 = std::max(y1, p.y);
    }
    const auto pixel = [](double v) { return static_cast<int>(std::floor(std::clamp(v, -1e6, 1e6))); };
    region_ = {0, 0, width, height};
    cut({pixel(x0 - margin), pixel(y0 - margin), pixel(x1 + margin) + 1, pixel(y1 + margin) + 1});
}

DFB_COMPILED_ONCE bool Footprint::meets(const Region& r) const
{
    if (intersection(region_, r).empty())
        return false;
    // Two convex sets are disjoint if and only if a line along an edge of one of them separates them. The test above
    // covers the rectangle's own edges.
    const double xs[2] = {static_cast<double>(r.x0), static_cast<double>(r.x1)},
                 ys[2] = {static_cast<double>(r.y0), static_cast<double>(r.y1)};
    for (std::size_t i = 0; i < hull_.size(); ++i) {
        const PixelPoint &a = hull_[i], &b = hull_[(i + 1) % hull_.size()];
        const double nx = b.y - a.y, ny = a.x - b.x, length = std::hypot(nx, ny); // outwards
        if (length == 0)
            continue;
        double nearest = 1e300;
        for (const double x : xs)
            for (const double y : ys)
                nearest = std::min(nearest, ((x - a.x) * nx + (y - a.y) * ny) / length);
        if (nearest > margin_)
            return false;
    }
    return true;
}

// Andrew's monotone chain, such that the outside is to the right of each edge (y grows downwards).
DFB_COMPILED_ONCE std::vector<PixelPoint> Footprint::hullOf(std::vector<PixelPoint> points)
{
    std::sort(points.begin(), points.end(),
              [](const PixelPoint& a, const PixelPoint& b) { return a.x != b.x ? a.x < b.x : a.y < b.y; });
    const auto turnsRight = [](const PixelPoint& o, const PixelPoint& a, const PixelPoint& b) {
        return (a.x - o.x) * (b.y - o.y) - (a.y - o.y) * (b.x - o.x) <= 0;
    };
    std::vector<PixelPoint> hull;
    hull.reserve(points.size() + 1);
    for (int pass = 0; pass < 2; ++pass) {
        const std::size_t first = hull.size();
        for (const PixelPoint& p : points) {
            while (hull.size() >= first + 2 && turnsRight(hull[hull.size() - 2], hull.back(), p))
                hull.pop_back();
            hull.push_back(p);
        }
        hull.pop_back();
        std::reverse(points.begin(), points.end());
    }
    return hull.empty() ? std::vector<PixelPoint>{points.front()} : hull;
}
#endif

namespace detail {

inline double length(const Vec3d& a) noexcept { return std::sqrt(dot(a, a)); }

inline Vec3d cornerOf(const Box3& b, int corner) noexcept
{
    const auto pick = [corner](int bit, float lower, float upper) {
        return static_cast<double>(corner & bit ? upper : lower);
    };
    return {pick(1, b.lower.x, b.upper.x), pick(2, b.lower.y, b.upper.y), pick(4, b.lower.z, b.upper.z)};
}

inline constexpr double pi = 3.14159265358979323846;

// The eye and its orientation. The axes are orthonormal.
struct Pose {
    Vec3d eye, forward, right, up;
    double tangent = 0; // of half the vertical angle of view

    // The vector from the eye to a point of the image, in the plane at distance 1 along `forward`.
    Vec3d through(double x, double y, int width, int height) const
    {
        const double scale = 2 * tangent / height;
        return forward + (x - 0.5 * width) * scale * right + (0.5 * height - y) * scale * up;
    }
};

// Throws InvalidArgument if `view` is 0, `up` is 0 or along it, or a number is not finite.
inline Pose poseOf(const Vec3& eye, const Vec3& view, const Vec3& up)
{
    const Vec3d e = toDouble(eye), v = toDouble(view), side = cross(v, toDouble(up));
    if (!(dot(v, v) > 0) || !(dot(side, side) > 0) || !std::isfinite(dot(e, e) + dot(v, v) + dot(side, side)))
        failArgument(
            "the camera looks nowhere: its view has no length, `up` has none or is along the view, or a number "
            "is not finite");
    const Vec3d forward = normalize(v), right = normalize(side);
    return {e, forward, right, cross(right, forward)};
}

// Also throws InvalidArgument for an angle of view that is not in (0, 180) degrees.
inline Pose poseOf(const Vec3& eye, const Vec3& view, const Vec3& up, float fovY)
{
    Pose pose = poseOf(eye, view, up);
    if (!(fovY > 0 && fovY < 180))
        failArgument("the camera's angle of view must be in (0, 180) degrees");
    pose.tangent = std::tan(0.5 * static_cast<double>(fovY) * pi / 180);
    return pose;
}

// A corner of a box as a camera sees it.
struct SeenCorner {
    double depth, rounding; // a depth below its rounding may have either sign
    PixelPoint at;
    double margin, blur = 0; // blur: by how many pixels it may be off to any side
};

// The footprint of a box. `see(point)` returns the SeenCorner of a corner. The footprint is the whole image if the box
// reaches behind the eye, and nothing if all of the box is behind it.
//
// The image of a convex body in front of the eye is the hull of the images of its corners. The margin covers the
// rounding of renderers' rays and points, which are floats. It is 1/8 pixel for directions (2^-23 of an image of 65536
// pixels is less than 1/100), and some units of the last place of the coordinates for points.
template <class See>
Footprint footprintOf(const Box3& bounds, int width, int height, const See& see)
{
    std::vector<PixelPoint> points;
    points.reserve(32);
    int behind = 0;
    bool near = false;
    double margin = 0;
    for (int corner = 0; corner < 8; ++corner) {
        const SeenCorner seen = see(cornerOf(bounds, corner));
        behind += seen.depth < -seen.rounding;
        near = near || seen.depth <= seen.rounding;
        if (near)
            continue;
        const auto& [x, y] = seen.at;
        const double b = seen.blur;
        if (b > 0)
            for (int side = 0; side < 4; ++side)
                points.push_back({x + (side & 1 ? b : -b), y + (side & 2 ? b : -b)});
        else
            points.push_back(seen.at);
        margin = std::max(margin, 0.125 + seen.margin);
    }
    if (behind == 8)
        return {};
    if (near)
        return Footprint::whole(width, height);
    return Footprint(std::move(points), margin, width, height);
}

// The footprint of a box for a pinhole whose image has its middle at width / 2 + shiftX, or for a lens.
//
// Take a point of the lens at most `lensRadius` off its middle. Seen from there, a point at depth z is off by at most
// lensRadius |1/z - 1/focusDistance| in the plane at distance 1. So each corner's image lies in a square around its
// image from the middle. The hull of all these squares holds the image of the box from every point of the lens.
DFB_COMPILED_ONCE Footprint projectBox(const Box3& bounds, const Pose& pose, int width, int height, double shiftX = 0,
                                       double lensRadius = 0, double focusDistance = 1);

#if DFB_HAS_BODIES
DFB_COMPILED_ONCE Footprint projectBox(const Box3& bounds, const Pose& pose, int width, int height, double shiftX,
                                       double lensRadius, double focusDistance)
{
    const double pixelsPerUnit = 0.5 * height / pose.tangent; // at distance 1
    return footprintOf(bounds, width, height, [&](const Vec3d& p) {
        const Vec3d d = p - pose.eye;
        const double depth = dot(d, pose.forward);
        const double largest = length(p) + length(pose.eye);
        return SeenCorner{depth,
                          // Axes and origins of rays are rounded to float.
                          1e-6 * (std::fabs(d.x) + std::fabs(d.y) + std::fabs(d.z)) + 1e-7 * largest,
                          {0.5 * width + shiftX + pixelsPerUnit * dot(d, pose.right) / depth,
                           0.5 * height - pixelsPerUnit * dot(d, pose.up) / depth},
                          (5e-7 * largest + 2e-7 * dot(d, d) / depth) / depth * pixelsPerUnit,
                          pixelsPerUnit * lensRadius * std::fabs(1 / depth - 1 / focusDistance)};
    });
}
#endif

} // namespace detail

// `direction` has length 1, or is 0 where the camera sees nothing.
struct Ray {
    Vec3 origin, direction;
};

// The point of the lens and the moment of the shutter for a ray, as numbers in [0, 1).
struct LensSample {
    double lensU = 0, lensV = 0, time = 0;
};

// A pinhole at `eye`. Pixels are square; pixel coordinates grow to the right and down. Any thread may call any member.
class PerspectiveCamera {
public:
    // Looks from `eye` to `target`; `fovY` is the vertical angle of view in degrees. Throws InvalidArgument if the two
    // coincide, `up` is 0 or along the view, the angle is not in (0, 180), or a number is not finite.
    PerspectiveCamera(const Vec3& eye, const Vec3& target, const Vec3& up, float fovY)
        : PerspectiveCamera(detail::poseOf(eye, target - eye, up, fovY))
    {
    }

    // Looks along `view`, of any length. Use it if the eye is so far from the origin that a float target near it would
    // not be exact. Throws as above.
    static PerspectiveCamera along(const Vec3& eye, const Vec3& view, const Vec3& up, float fovY)
    {
        return PerspectiveCamera(detail::poseOf(eye, view, up, fovY));
    }

    Vec3 eye() const noexcept { return toFloat(pose_.eye); }
    std::optional<Vec3> commonEye() const noexcept { return eye(); } // see the top of this file

    // The axes of the camera: unit vectors at right angles to each other.
    Vec3 forward() const noexcept { return toFloat(pose_.forward); }
    Vec3 right() const noexcept { return toFloat(pose_.right); }
    Vec3 up() const noexcept { return toFloat(pose_.up); }

    // The unit direction from the eye through point (x, y) of the image, in pixels; pixel centres are at .5.
    Vec3 direction(double x, double y, int width, int height) const
    {
        return toFloat(normalize(pose_.through(x, y, width, height)));
    }
    Ray ray(double x, double y, int width, int height, const LensSample& = {}) const
    {
        return {eye(), direction(x, y, width, height)};
    }

    // Returns the pixels that the box may cover: all if it reaches behind the eye, none if all of it is behind.
    Footprint project(const Box3& bounds, int width, int height) const
    {
        return detail::projectBox(bounds, pose_, width, height);
    }

private:
    explicit PerspectiveCamera(const detail::Pose& pose) : pose_(pose) {}

    detail::Pose pose_;
};

// A brick, by its place in bricks() of a World or a SharedWorld, and a tile that it may project to.
struct BrickInTile {
    int brick = 0;
    int tile = 0;
};

namespace detail {

using FoundTile = FunctionRef<void(int tile, const Region& pixels)>;

// Calls found(tile, pixels) for each tile that the projection may cover, with a rectangle around its pixels there. A
// tile may come up twice.
DFB_COMPILED_ONCE void forEachTile(const Region& projection, const TileLayout& layout, FoundTile found);
DFB_COMPILED_ONCE void forEachTile(const Footprint& projection, const TileLayout& layout, FoundTile found);
template <class Projection>
void forEachTile(const std::vector<Projection>& projections, const TileLayout& layout, FoundTile found)
{
    for (const Projection& projection : projections)
        forEachTile(projection, layout, found);
}

// Sorts the pairs by tile, then by brick, and leaves each once.
DFB_COMPILED_ONCE void sortPairs(std::vector<BrickInTile>& pairs);

#if DFB_HAS_BODIES
DFB_COMPILED_ONCE void forEachTile(const Region& projection, const TileLayout& layout, FoundTile found)
{
    const Region tiles = layout.tilesIn(projection);
    for (int row = tiles.y0; row < tiles.y1; ++row)
        for (int column = tiles.x0; column < tiles.x1; ++column) {
            const int tile = layout.tileAt(column, row);
            found(tile, intersection(projection, layout.region(tile)));
        }
}

DFB_COMPILED_ONCE void forEachTile(const Footprint& projection, const TileLayout& layout, FoundTile found)
{
    forEachTile(projection.region(), layout, [&](int tile, const Region& pixels) {
        if (projection.meets(layout.region(tile)))
            found(tile, pixels);
    });
}

DFB_COMPILED_ONCE void sortPairs(std::vector<BrickInTile>& pairs)
{
    const auto key = [](const BrickInTile& p) { return std::make_pair(p.tile, p.brick); };
    std::sort(pairs.begin(), pairs.end(), [&](const auto& a, const auto& b) { return key(a) < key(b); });
    const auto isSame = [&](const auto& a, const auto& b) { return key(a) == key(b); };
    pairs.erase(std::unique(pairs.begin(), pairs.end(), isSame), pairs.end());
}
#endif

// The brick of a pair, of a World or a SharedWorld.
template <class AnyWorld>
const auto& brickOf(const AnyWorld& world, const BrickInTile& pair)
{
    return world.bricks()[static_cast<std::size_t>(pair.brick)];
}

} // namespace detail

// Returns the pairs of a brick and a tile that it may project to, by tile, then by brick. `world`: a World or a
// SharedWorld. Any thread. Waits for nothing. Throws what camera.project() throws. Uses the memory of `memory` for the
// result.
template <class AnyWorld, class Camera>
std::vector<BrickInTile> visibleTiles(const AnyWorld& world, const Camera& camera, const TileLayout& layout,
                                      std::vector<BrickInTile> memory = {})
{
    memory.clear();
    for (std::size_t b = 0; b < world.bricks().size(); ++b)
        detail::forEachTile(camera.project(world.bricks()[b].bounds, layout.width(), layout.height()), layout,
                            [&](int tile, const Region&) {
                                memory.push_back({static_cast<int>(b), tile});
                            });
    detail::sortPairs(memory);
    return memory;
}

// Returns the inputs that a rank declares if it renders these pairs. They must be of this world, which is not checked.
// The source is the brick's id. Any thread. Waits for nothing. Uses the memory of `memory` for the result.
inline std::vector<TileInput> inputsOf(const World& world, const std::vector<BrickInTile>& pairs,
                                       std::vector<TileInput> memory = {})
{
    memory.clear();
    memory.reserve(pairs.size());
    for (const BrickInTile& pair : pairs)
        memory.push_back({pair.tile, detail::brickOf(world, pair).id, 0});
    return memory;
}

DFB_NAMESPACE_END
