// BrickGrid: a box of bricks, one a rank; and the views of an orbit around it.
#pragma once

#include <dfb/render/visibility.hpp>
#include <dfb/render/world.hpp>

#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

namespace bench {

// As near to a cube as the number of bricks allows: 2: 2x1x1, 4: 2x2x1, 8: 2x2x2, 16: 4x2x2.
struct BrickGrid {
    explicit BrickGrid(int bricks)
    {
        for (int left = bricks, axis = 0; left > 1; axis = (axis + 1) % 3) {
            int factor = 2;
            while (left % factor != 0)
                ++factor;
            cells[static_cast<std::size_t>(axis)] *= factor;
            left /= factor;
        }
    }

    // Where bricks have length 1.
    dfb::Vec3 size() const
    {
        return {static_cast<float>(cells[0]), static_cast<float>(cells[1]), static_cast<float>(cells[2])};
    }

    // The box of a brick, if all bricks fill a box from 0 to `extent`. Neighbours share a face, bit for bit.
    dfb::Box3 box(int brick, const dfb::Vec3& extent) const
    {
        const std::array<int, 3> at{brick % cells[0], brick / cells[0] % cells[1], brick / (cells[0] * cells[1])};
        const auto corner = [&](int further) {
            const auto face = [&](std::size_t axis, float length) {
                return length * static_cast<float>(at[axis] + further) / static_cast<float>(cells[axis]);
            };
            return dfb::Vec3{face(0, extent.x), face(1, extent.y), face(2, extent.z)};
        };
        return {corner(0), corner(1)};
    }

    std::array<int, 3> cells{1, 1, 1};
};

// Cameras on a circle around a box from 0 to `extent`, obliquely from above; `distance` in diagonals of the box.
inline std::vector<dfb::PerspectiveCamera> orbitOf(int views, const dfb::Vec3& extent, float distance)
{
    std::vector<dfb::PerspectiveCamera> cameras;
    const dfb::Vec3 target = 0.5f * extent;
    const float radius = distance * std::sqrt(dot(extent, extent));
    for (int v = 0; v < views; ++v) {
        const float angle = 0.3f + 6.2831853f * static_cast<float>(v) / static_cast<float>(views);
        cameras.emplace_back(target + radius * dfb::Vec3{0.9f * std::cos(angle), 0.44f, 0.9f * std::sin(angle)}, target,
                             dfb::Vec3{0, 1, 0}, 36.0f);
    }
    return cameras;
}

} // namespace bench
