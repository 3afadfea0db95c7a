// PixelCamera: bricks whose boxes are in pixels, of which each rank has one.
#pragma once

#include <dfb/image.hpp>
#include <dfb/render/world.hpp>

#include <cstdint>

namespace bench {

struct PixelCamera {
    dfb::Region project(const dfb::Box3& box, int, int) const
    {
        return {static_cast<int>(box.lower.x), static_cast<int>(box.lower.y), static_cast<int>(box.upper.x),
                static_cast<int>(box.upper.y)};
    }
};

inline dfb::World worldOf(int rank, const dfb::Region& region)
{
    dfb::World world;
    if (!region.empty())
        world.add({static_cast<std::uint32_t>(rank),
                   {{static_cast<float>(region.x0), static_cast<float>(region.y0), 0},
                    {static_cast<float>(region.x1), static_cast<float>(region.y1), 1}}});
    return world;
}

} // namespace bench
