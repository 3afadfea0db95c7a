// WallLayout: where the displays of a wall are, and which ranks drive them.
#pragma once

#include <dfb/image.hpp>

#include <vector>

namespace dfb {

// Displays of equal size in columns and rows, 0 at the upper left, row by row. The framebuffer has the pixels of all of
// them and those behind the bezels between them, so that a line that crosses a bezel goes on straight.
struct WallLayout {
    int columns = 1, rows = 1;
    int displayWidth = 0, displayHeight = 0; // pixels
    int bezelX = 0, bezelY = 0;              // pixels that are not seen between two displays
    std::vector<int> ranks;                  // that drives each display; any number of displays each, from none to all

    // Of the framebuffer.
    int width() const noexcept { return columns * displayWidth + (columns - 1) * bezelX; }
    int height() const noexcept { return rows * displayHeight + (rows - 1) * bezelY; }
    int displayCount() const noexcept { return columns * rows; }

    // What a display shows of the framebuffer.
    Region region(int display) const noexcept
    {
        const int x0 = display % columns * (displayWidth + bezelX), y0 = display / columns * (displayHeight + bezelY);
        return {x0, y0, x0 + displayWidth, y0 + displayHeight};
    }
};

} // namespace dfb
