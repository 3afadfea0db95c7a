// ActivePixels: what of a tile travels: the pixels with any colour channel that is not 0, as spans, and what they have in
// the channels that are wanted, one after the other.
#pragma once

#include <dfb/fragment.hpp>

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

namespace dfb::detail {

// One per thread, to be used again and again. A pixel of colour 0 and alpha 0 contributes nothing, whatever its depth; one
// with colour and alpha 0 is emission and does.
struct ActivePixels {
    std::vector<std::uint16_t> rowCounts; // of spans, of rows [rowBegin, rowEnd)
    std::vector<Span> spans;
    int rowBegin = 0, rowEnd = 0;
    std::uint32_t pixels = 0;

    // Of a Tile or a TileView. `channels` has colour, and the tile all of them. Each row is copied as soon as its spans
    // are found: rows of a large image are far apart in memory, and so are read there once.
    template <class TileType>
    void gather(const TileType& tile, ChannelMask channels)
    {
        rowCounts.clear();
        spans.clear();
        rowBegin = rowEnd = 0;
        pixels = 0;
        channels_ = channels;
        const ConstPlanes planes = tile.planes();
        const int width = tile.region.width(), height = tile.pixel(0, 0) ? tile.region.height() : 0;
        const std::size_t most = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
        for (std::size_t c = 0; c < channelCount; ++c)
            if (hasChannel(channels, c) && planes_[c].size() < most * static_cast<std::size_t>(channelWords[c]))
                planes_[c].resize(most * static_cast<std::size_t>(channelWords[c]));
        for (int y = 0; y < height; ++y) {
            const std::size_t before = spans.size();
            const std::size_t first = static_cast<std::size_t>(y) * tile.rowStride();
            if (y + 1 < height)
                prefetch(tile.pixel(0, y + 1), width);
            findSpans(tile.pixel(0, y), width);
            for (std::size_t i = before; i < spans.size(); ++i) {
                for (std::size_t c = 0; c < channelCount; ++c)
                    if (hasChannel(channels, c)) {
                        const auto words = static_cast<std::size_t>(channelWords[c]);
                        std::memcpy(planes_[c].data() + words * pixels, planes.at[c] + 4 * words * (first + spans[i].x),
                                    4 * words * spans[i].count);
                    }
                pixels += spans[i].count;
            }
            const auto count = static_cast<std::uint16_t>(spans.size() - before);
            if (count > 0 && rowEnd == 0)
                rowBegin = y;
            if (count > 0)
                rowEnd = y + 1;
            if (rowEnd > 0)
                rowCounts.push_back(count);
        }
        rowCounts.resize(static_cast<std::size_t>(rowEnd - rowBegin));
    }

    // What they have in a channel; null if it is not wanted.
    const std::byte* plane(std::size_t channel) const noexcept
    {
        return hasChannel(channels_, channel) ? reinterpret_cast<const std::byte*>(planes_[channel].data()) : nullptr;
    }

    // All alike, bit for bit.
    bool isConstant() const
    {
        for (std::size_t c = 0; c < channelCount && pixels > 0; ++c) {
            const std::size_t bytes = 4 * static_cast<std::size_t>(channelWords[c]);
            if (const std::byte* p = plane(c); p && std::memcmp(p, p + bytes, bytes * (pixels - 1)) != 0)
                return false;
        }
        return true;
    }

    // For `count` numbers.
    float* scratch(std::size_t count)
    {
        scratch_.resize(count);
        return scratch_.data();
    }

private:
    // No processor knows by itself where the next row of an image begins.
    static void prefetch(const float* row, int width)
    {
#if defined(__GNUC__)
        for (int x = 0; x < width; x += 4)
            __builtin_prefetch(row + 4 * x);
#else
        (void)row, (void)width;
#endif
    }

    void findSpans(const float* row, int width)
    {
        const auto active = [row](int x) { // all bits but the signs
            std::uint64_t halves[2];
            std::memcpy(halves, row + 4 * x, sizeof halves);
            return ((halves[0] | halves[1]) & 0x7fffffff7fffffffu) != 0;
        };
        for (int x = 0; x < width;) {
            while (x < width && !active(x))
                ++x;
            const int begin = x;
            while (x + 4 <= width && active(x) & active(x + 1) & active(x + 2) & active(x + 3))
                x += 4;
            while (x < width && active(x))
                ++x;
            if (x > begin)
                spans.push_back({static_cast<std::uint16_t>(begin), static_cast<std::uint16_t>(x - begin)});
        }
    }

    ChannelMask channels_ = 0;
    std::array<std::vector<std::uint32_t>, channelCount> planes_;
    std::vector<float> scratch_;
};

} // namespace dfb::detail
