// TileLayout: how an image is divided into tiles; OwnerMap: which rank owns which tile; WallLayout: where the displays
// of a wall are.
#pragma once

#include <dfb/error.hpp>
#include <dfb/image.hpp>
#include <dfb/tile.hpp>

#include <algorithm>
#include <cstdint>
#include <functional>
#include <limits>
#include <memory>
#include <numeric>
#include <vector>

DFB_NAMESPACE_BEGIN

// Tiles are numbered row by row from the top left. All have one size, cut at the image's border. All members are pure
// and may be called from any thread.
class TileLayout {
public:
    static constexpr int maxImageSize = 1 << 16; // pixels a side

    TileLayout() = default;
    // Throws InvalidArgument for an image size or a tile size outside [1, 65536], or for more than 2^31 - 1 tiles.
    TileLayout(int width, int height, int tileSize) : TileLayout(width, height, tileSize, tileSize) {}
    TileLayout(int width, int height, int tileWidth, int tileHeight)
        : width_(width), height_(height), tileWidth_(tileWidth), tileHeight_(tileHeight)
    {
        if (width < 1 || height < 1 || width > maxImageSize || height > maxImageSize)
            detail::failArgument("the image size is %dx%d, it must be 1 to 65536 pixels a side", width, height);
        if (tileWidth < 1 || tileHeight < 1 || tileWidth > maxImageSize || tileHeight > maxImageSize)
            detail::failArgument("the tile size is %dx%d, it must be 1 to 65536 pixels a side", tileWidth, tileHeight);
        tilesX_ = (width + tileWidth - 1) / tileWidth;
        tilesY_ = (height + tileHeight - 1) / tileHeight;
        if (tilesX_ > std::numeric_limits<int>::max() / tilesY_)
            detail::failArgument("%dx%d pixels have more than 2^31 - 1 tiles of %dx%d", width, height, tileWidth,
                                 tileHeight);
    }

    int width() const noexcept { return width_; }
    int height() const noexcept { return height_; }
    int tileSize() const noexcept { return tileWidth_; } // of square tiles, as a tile operation has them
    int tileWidth() const noexcept { return tileWidth_; }
    int tileHeight() const noexcept { return tileHeight_; }
    int tilesX() const noexcept { return tilesX_; }
    int tilesY() const noexcept { return tilesY_; }
    int tileCount() const noexcept { return tilesX_ * tilesY_; }

    // Nobody checks these arguments.
    int column(int tile) const noexcept { return tile % tilesX_; }
    int row(int tile) const noexcept { return tile / tilesX_; }
    int tileAt(int column, int row) const noexcept { return row * tilesX_ + column; }

    // The pixels of a tile, cut at the image's border.
    Region region(int tile) const noexcept
    {
        const int x0 = column(tile) * tileWidth_, y0 = row(tile) * tileHeight_;
        return {x0, y0, std::min(x0 + tileWidth_, width_), std::min(y0 + tileHeight_, height_)};
    }

    // The tiles that meet a region of pixels, as half-open ranges of tile columns (x) and tile rows (y). Empty if the
    // region is outside the image.
    Region tilesIn(const Region& pixels) const noexcept
    {
        const Region r = intersection(pixels, {0, 0, width_, height_});
        if (r.empty())
            return {};
        return {r.x0 / tileWidth_, r.y0 / tileHeight_, (r.x1 - 1) / tileWidth_ + 1, (r.y1 - 1) / tileHeight_ + 1};
    }

private:
    int width_ = 0, height_ = 0, tileWidth_ = 1, tileHeight_ = 1;
    int tilesX_ = 0, tilesY_ = 0;
};

// Returns the rank in [0, rankCount) that owns a tile. A pure function, the same on all ranks. The constructor of a
// framebuffer and resize() call it for each tile. They throw InvalidArgument on all ranks if it throws or returns no
// rank.
using OwnerMap = std::function<int(int tile, const TileLayout& layout, int rankCount)>;

// The rank that owns each tile, by the tile's index.
using TileOwners = std::shared_ptr<const std::vector<int>>;

// See FrameBufferConfig::onTile.
using TileCallback = std::function<void(int tile, const Region& pixels, const Image& image)>;

// The default. The owners of a tile row are those of the row above, shifted by about 0.62 of the rank count. So
// neighbours in both directions belong to different ranks. (With tile % rankCount a rank would own whole columns of
// many images.)
inline int latticeOwner(int tile, const TileLayout& layout, int rankCount)
{
    int shift = std::max(1, static_cast<int>(0.618 * rankCount));
    while (std::gcd(shift, rankCount) != 1)
        --shift;
    const std::int64_t diagonal = layout.column(tile) + static_cast<std::int64_t>(layout.row(tile)) * shift;
    return static_cast<int>(diagonal % rankCount);
}

// Equal contiguous shares in tile order.
inline int linearOwner(int tile, const TileLayout& layout, int rankCount)
{
    return static_cast<int>(static_cast<std::int64_t>(tile) * rankCount / layout.tileCount());
}

// A fixed pseudo-random scatter (the finaliser of SplitMix64).
inline int hashOwner(int tile, const TileLayout&, int rankCount)
{
    std::uint64_t h = static_cast<std::uint64_t>(tile) + 0x9e3779b97f4a7c15u;
    h = (h ^ (h >> 30)) * 0xbf58476d1ce4e5b9u;
    h = (h ^ (h >> 27)) * 0x94d049bb133111ebu;
    h ^= h >> 31;
    return static_cast<int>(h % static_cast<std::uint64_t>(rankCount));
}

// WallLayout: where the displays of a wall are, and which ranks drive them.
//
// The displays have one size and stand in columns and rows. They are numbered row by row, from 0 at the upper left. The
// framebuffer also has the pixels behind the bezels between them, so that a line that crosses a bezel goes on straight.
struct WallLayout {
    int columns = 1, rows = 1;
    int displayWidth = 0, displayHeight = 0; // pixels
    int bezelX = 0, bezelY = 0;              // pixels that are not seen between two displays
    std::vector<int> ranks;                  // for each display the rank that drives it; one may drive several, or none

    // The size of the framebuffer, in pixels.
    int width() const noexcept { return columns * displayWidth + (columns - 1) * bezelX; }
    int height() const noexcept { return rows * displayHeight + (rows - 1) * bezelY; }
    int displayCount() const noexcept { return columns * rows; }

    // The part of the framebuffer that a display shows, in pixels. `display`: 0 to displayCount() - 1; nobody checks
    // it.
    Region region(int display) const noexcept
    {
        const int x0 = display % columns * (displayWidth + bezelX), y0 = display / columns * (displayHeight + bezelY);
        return {x0, y0, x0 + displayWidth, y0 + displayHeight};
    }
};

DFB_NAMESPACE_END
