// Tile: the dense square of pixels that a renderer fills (Listing 1 of the paper), with its size and its
// channels fixed at compile time.
#pragma once

#include <dfb/image.hpp>

#include <cstdint>
#include <cstring>
#include <limits>

namespace dfb {

// A set of channels, one bit each.
using ChannelMask = std::uint16_t;
inline constexpr ChannelMask colorChannel = 1; // premultiplied linear RGBA, 4 floats a pixel
inline constexpr ChannelMask depthChannel = 2; // distance along the ray or any monotone function of it, 1 float

// Floats that the channels of a mask take per pixel.
constexpr int floatsPerPixel(ChannelMask channels) noexcept
{
    return (channels & colorChannel ? 4 : 0) + (channels & depthChannel ? 1 : 0);
}

// Who an input of a tile is. (tile, pass, generation, source, part) is unique in a frame.
struct TileHeader {
    std::int64_t frame = -1;  // set by Frame::start
    int tile = -1;            // index in the TileLayout
    Region region;            // its pixels; at the right and lower border smaller than the tile
    int pass = 0;             // sample index: passes are composited each by itself, then averaged
    int generation = 0;       // level in the tile's dependency tree
    int children = 0;         // how many inputs of generation + 1 this one announces
    std::uint32_t source = 0; // brick id; the rank where there are no bricks
    std::uint16_t part = 0;   // to tell apart several inputs of one source
};

namespace detail {
template <bool Present, int FloatCount>
struct DepthPlane {
    float depth[FloatCount];
};
template <int FloatCount>
struct DepthPlane<false, FloatCount> {
};
} // namespace detail

// Pixel (x, y) of the tile, counted from region.x0 and region.y0, is color[4 * (y * size + x)] and
// depth[y * size + x]. Pixels outside the region are never read.
template <ChannelMask Channels, int Size>
struct Tile : TileHeader, detail::DepthPlane<(Channels & depthChannel) != 0, Size * Size> {
    static_assert(Size >= 8 && Size <= 256, "dfb: the tile size must be 8 to 256 pixels");
    static_assert(Channels & colorChannel, "dfb: a tile has at least the colour channel");

    static constexpr int size = Size;
    static constexpr ChannelMask channels = Channels;
    static constexpr bool hasDepth = (Channels & depthChannel) != 0;

    float color[4 * Size * Size];

    // All pixels: nothing here (colour 0, depth +infinity).
    void clear()
    {
        std::memset(color, 0, sizeof color);
        if constexpr (hasDepth)
            std::fill_n(this->depth, Size * Size, std::numeric_limits<float>::infinity());
    }

    // All pixels: one premultiplied RGBA colour at one depth.
    void fill(const float (&rgba)[4], float depthValue = std::numeric_limits<float>::infinity())
    {
        for (int i = 0; i < Size * Size; ++i)
            std::memcpy(color + 4 * i, rgba, sizeof rgba);
        if constexpr (hasDepth)
            std::fill_n(this->depth, Size * Size, depthValue);
        (void)depthValue;
    }

    // Calls f(x, y, rgba, depth), or f(x, y, rgba) without a depth channel, for each pixel of the region, row by row:
    // x and y are its place in the image, `rgba` points to its 4 floats, `depth` is a reference to its depth.
    template <class PixelFunction>
    void forEachPixel(const PixelFunction& f)
    {
        for (int y = 0; y < region.height(); ++y)
            for (int x = 0; x < region.width(); ++x) {
                if constexpr (hasDepth)
                    f(region.x0 + x, region.y0 + y, pixel(x, y), this->depth[y * Size + x]);
                else
                    f(region.x0 + x, region.y0 + y, pixel(x, y));
            }
    }

    float* pixel(int x, int y) noexcept { return color + 4 * (y * Size + x); }
    const float* pixel(int x, int y) const noexcept { return color + 4 * (y * Size + x); }
};

} // namespace dfb
