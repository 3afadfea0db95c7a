// Visibility: which tiles a brick may project to; and a perspective camera that can tell.
//
// A camera, for the loops in render/, is any type with
//   Region project(const Box3& bounds, int width, int height) const;
// the pixels of a width x height image that the box may cover for any sample position within a pixel: never too few;
// too many cost a header each.
#pragma once

#include <dfb/detail/manifest.hpp>
#include <dfb/render/world.hpp>
#include <dfb/tile_layout.hpp>

#include <algorithm>
#include <cmath>
#include <vector>

namespace dfb {

// A pinhole at `eye`. Pixels are square; pixel coordinates grow to the right and down.
class PerspectiveCamera {
public:
    // Looks from `eye` to `target`; `fovY` is the vertical angle of view in degrees. Throws InvalidArgument if the two
    // coincide, `up` is along the view, or the angle is not in (0, 180).
    PerspectiveCamera(const Vec3& eye, const Vec3& target, const Vec3& up, float fovY)
        : PerspectiveCamera(Along(target - eye), eye, up, fovY)
    {
    }

    // Looks along `view`, of any length: also where the eye is so far from the origin that no target near it is exact.
    static PerspectiveCamera along(const Vec3& eye, const Vec3& view, const Vec3& up, float fovY)
    {
        return PerspectiveCamera(Along(view), eye, up, fovY);
    }

    const Vec3& eye() const noexcept { return eye_; }

    // The unit direction from the eye through point (x, y) of the image, in pixels; pixel centres are at .5.
    Vec3 direction(double x, double y, int width, int height) const
    {
        const double scale = 2.0 * static_cast<double>(tanHalfFov_) / height;
        const auto u = static_cast<float>((x - 0.5 * width) * scale),
                   v = static_cast<float>((0.5 * height - y) * scale);
        return normalize(forward_ + u * right_ + v * up_);
    }

    // Of a box that reaches behind the eye: the whole image; of one that is behind it altogether: nothing.
    Region project(const Box3& bounds, int width, int height) const
    {
        const Region all{0, 0, width, height};
        const double pixelsPerUnit = 0.5 * height / static_cast<double>(tanHalfFov_);
        const auto along = [](const double(&d)[3], const Vec3& axis) {
            return d[0] * static_cast<double>(axis.x) + d[1] * static_cast<double>(axis.y)
                   + d[2] * static_cast<double>(axis.z);
        };
        double x0 = 1e300, y0 = 1e300, x1 = -1e300, y1 = -1e300;
        int behind = 0;
        bool near = false;
        for (int corner = 0; corner < 8; ++corner) {
            const Vec3 p{corner & 1 ? bounds.upper.x : bounds.lower.x, corner & 2 ? bounds.upper.y : bounds.lower.y,
                         corner & 4 ? bounds.upper.z : bounds.lower.z};
            const double d[3] = {static_cast<double>(p.x) - static_cast<double>(eye_.x),
                                 static_cast<double>(p.y) - static_cast<double>(eye_.y),
                                 static_cast<double>(p.z) - static_cast<double>(eye_.z)};
            // The axes are rounded to float: a depth below that rounding may have either sign.
            const double depth = along(d, forward_);
            const double rounding = 1e-6 * (std::fabs(d[0]) + std::fabs(d[1]) + std::fabs(d[2]));
            behind += depth < -rounding;
            near = near || depth <= rounding;
            const double x = 0.5 * width + pixelsPerUnit * along(d, right_) / depth;
            const double y = 0.5 * height - pixelsPerUnit * along(d, up_) / depth;
            x0 = std::min(x0, x), x1 = std::max(x1, x);
            y0 = std::min(y0, y), y1 = std::max(y1, y);
        }
        if (behind == 8)
            return {};
        if (near)
            return all;
        // One pixel more on each side covers the rounding of all this and of the renderer's rays.
        const auto pixel = [](double v) { return static_cast<int>(std::floor(std::clamp(v, -1e6, 1e6))); };
        const Region region = intersection(all, {pixel(x0) - 1, pixel(y0) - 1, pixel(x1) + 2, pixel(y1) + 2});
        return region.empty() ? Region{} : region;
    }

private:
    struct Along { // tells the constructors apart, also where they are given braces
        explicit Along(const Vec3& direction) : view(direction) {}
        Vec3 view;
    };

    PerspectiveCamera(const Along& along, const Vec3& eye, const Vec3& up, float fovY) : eye_(eye)
    {
        const Vec3 right = cross(along.view, up);
        if (!(dot(along.view, along.view) > 0.0f) || !(dot(right, right) > 0.0f) || !(fovY > 0.0f && fovY < 180.0f))
            throw InvalidArgument("the camera's view, up vector or angle is degenerate");
        forward_ = normalize(along.view);
        right_ = normalize(right);
        up_ = cross(right_, forward_);
        tanHalfFov_ = std::tan(fovY * 3.14159265358979f / 360.0f);
    }

    Vec3 eye_, forward_, right_, up_;
    float tanHalfFov_ = 1.0f;
};

// A brick of the world, by its place in World::bricks(), and a tile that it may project to.
struct BrickInTile {
    int brick = 0;
    int tile = 0;
};

// All pairs, tile by tile, so that the inputs of a tile are rendered one after the other.
template <class Camera>
std::vector<BrickInTile> visibleTiles(const World& world, const Camera& camera, const TileLayout& layout)
{
    std::vector<BrickInTile> result;
    for (std::size_t b = 0; b < world.bricks().size(); ++b) {
        const Region tiles = layout.tilesIn(camera.project(world.bricks()[b].bounds, layout.width(), layout.height()));
        for (int row = tiles.y0; row < tiles.y1; ++row)
            for (int column = tiles.x0; column < tiles.x1; ++column)
                result.push_back({static_cast<int>(b), layout.tileAt(column, row)});
    }
    std::sort(result.begin(), result.end(), [](const BrickInTile& a, const BrickInTile& b) {
        return a.tile != b.tile ? a.tile < b.tile : a.brick < b.brick;
    });
    return result;
}

// What a rank declares that renders these pairs: the source is the brick's id.
inline std::vector<TileInput> inputsOf(const World& world, const std::vector<BrickInTile>& pairs)
{
    std::vector<TileInput> inputs;
    inputs.reserve(pairs.size());
    for (const BrickInTile& pair : pairs)
        inputs.push_back({pair.tile, world.bricks()[static_cast<std::size_t>(pair.brick)].id, 0});
    return inputs;
}

} // namespace dfb
