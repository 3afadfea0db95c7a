// Viewport: a rectangle of pixels as IceT has it, from its lower left corner.
#pragma once

#include <dfb/image.hpp>

#include <algorithm>

namespace dfb_icet {

struct Viewport {
    int x = 0, y = 0, width = 0, height = 0;

    bool empty() const noexcept { return width <= 0 || height <= 0; }
    bool contains(const Viewport& other) const noexcept
    {
        return other.x >= x && other.y >= y && other.x + other.width <= x + width
               && other.y + other.height <= y + height;
    }
};

// Empty, at 0, if there is none.
inline Viewport intersection(const Viewport& a, const Viewport& b) noexcept
{
    const int x = std::max(a.x, b.x), y = std::max(a.y, b.y);
    const Viewport both{x, y, std::min(a.x + a.width, b.x + b.width) - x, std::min(a.y + a.height, b.y + b.height) - y};
    return both.empty() ? Viewport{} : both;
}

// The smallest that has both, of which `a` may be empty.
inline Viewport hull(const Viewport& a, const Viewport& b) noexcept
{
    if (a.empty())
        return b;
    const int x = std::min(a.x, b.x), y = std::min(a.y, b.y);
    return {x, y, std::max(a.x + a.width, b.x + b.width) - x, std::max(a.y + a.height, b.y + b.height) - y};
}

// `part` as a picture of `tile` has it. Rows of both count upwards, so no picture is turned.
inline dfb::Region regionIn(const Viewport& tile, const Viewport& part) noexcept
{
    const int x = part.x - tile.x, y = part.y - tile.y;
    return {x, y, x + part.width, y + part.height};
}

} // namespace dfb_icet
