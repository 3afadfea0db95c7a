// Viewports: rectangles of pixels, which IceT gives by their lower left corner, as regions of the library.
#pragma once

#include <dfb/image.hpp>

#include <algorithm>

namespace dfb_icet {

// Rows count upwards.
using dfb::Region;

inline Region viewport(int x, int y, int width, int height) noexcept { return {x, y, x + width, y + height}; }

// The smallest region that contains both; `a` may be empty.
inline Region hull(const Region& a, const Region& b) noexcept
{
    if (a.empty())
        return b;
    return {std::min(a.x0, b.x0), std::min(a.y0, b.y0), std::max(a.x1, b.x1), std::max(a.y1, b.y1)};
}

// `part` in coordinates of the picture of `tile`. Rows of both count upwards, so no picture is flipped.
inline Region regionIn(const Region& tile, const Region& part) noexcept
{
    return viewport(part.x0 - tile.x0, part.y0 - tile.y0, part.width(), part.height());
}

} // namespace dfb_icet
