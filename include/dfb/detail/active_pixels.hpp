// ActivePixels: what of a tile travels: the pixels with any colour channel that is not 0, as spans, and what they have
// in the channels that are wanted, one after the other.
#pragma once

#include <dfb/cpu.hpp>
#include <dfb/fragment.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

namespace dfb::detail {

// Of up to 64 pixels, bit by bit: those with a colour channel that is not 0.
DFB_INLINE std::uint64_t findActivePixels(const float* rgba, int count)
{
    std::uint64_t bits = 0;
    for (int i = 0; i < count; ++i) { // all bits but the signs
        std::uint64_t halves[2];
        std::memcpy(halves, rgba + 4 * i, sizeof halves);
        bits |= std::uint64_t{((halves[0] | halves[1]) & 0x7fffffff7fffffffu) != 0} << i;
    }
    return bits;
}

#if defined(DFB_HAS_AVX2_CLONES)
DFB_AVX2 inline std::uint64_t findActivePixelsAvx2(const float* rgba, int count)
{
    const __m256i zero = _mm256_setzero_si256(), allButSign = _mm256_set1_epi32(0x7fffffff);
    std::uint64_t bits = 0;
    int i = 0;
    for (; i + 8 <= count; i += 8) {
        __m256i isZero[4]; // of 2 pixels each
        for (int k = 0; k < 4; ++k) {
            const auto* from = reinterpret_cast<const __m256i*>(rgba + 4 * i + 8 * k);
            isZero[k] = _mm256_cmpeq_epi32(_mm256_and_si256(_mm256_loadu_si256(from), allButSign), zero);
        }
        // A byte for each value, 4 for each pixel: of pixels 0 2 4 6 1 3 5 7.
        __m256i bytes =
            _mm256_packs_epi16(_mm256_packs_epi32(isZero[0], isZero[1]), _mm256_packs_epi32(isZero[2], isZero[3]));
        bytes = _mm256_permutevar8x32_epi32(bytes, _mm256_setr_epi32(0, 4, 1, 5, 2, 6, 3, 7));
        const int none = _mm256_movemask_ps(_mm256_castsi256_ps(_mm256_cmpeq_epi32(bytes, _mm256_set1_epi32(-1))));
        bits |= static_cast<std::uint64_t>(~none & 255) << i;
    }
    return i < count ? bits | findActivePixels(rgba + 4 * i, count - i) << i : bits;
}
#endif

inline std::uint64_t activePixelBits(const float* rgba, int count)
{
#if defined(DFB_HAS_AVX2_CLONES)
    if (cpuHasAvx2())
        return findActivePixelsAvx2(rgba, count);
#endif
    return findActivePixels(rgba, count);
}

// Copies the colours of pixels. False if any is not finite, or an alpha not within [0, 1]. No branches, so that it can
// be vectorized.
DFB_INLINE bool copyAndCheckColors(const float* rgba, int count, float* out)
{
    constexpr float most = std::numeric_limits<float>::max();
    constexpr float low[8] = {-most, -most, -most, 0, -most, -most, -most, 0};
    constexpr float high[8] = {most, most, most, 1, most, most, most, 1};
    const auto isOutside = [&](float value, int c) {
        return static_cast<int>(!(value >= low[c])) | static_cast<int>(!(value <= high[c]));
    };
    int bad[8] = {}, i = 0;
    for (; i + 8 <= 4 * count; i += 8)
        for (int c = 0; c < 8; ++c) {
            out[i + c] = rgba[i + c];
            bad[c] |= isOutside(rgba[i + c], c);
        }
    for (; i < 4 * count; ++i) {
        out[i] = rgba[i];
        bad[i % 4] |= isOutside(rgba[i], i % 4);
    }
    return (bad[0] | bad[1] | bad[2] | bad[3] | bad[4] | bad[5] | bad[6] | bad[7]) == 0;
}
DFB_AVX2 inline bool copyAndCheckColorsAvx2(const float* rgba, int count, float* out)
{
    return copyAndCheckColors(rgba, count, out);
}

// The same for depths; false if any is NaN.
DFB_INLINE bool copyAndCheckDepths(const float* depth, int count, float* out)
{
    int isNan = 0;
    for (int i = 0; i < count; ++i) {
        out[i] = depth[i];
        isNan |= static_cast<int>(depth[i] != depth[i]);
    }
    return isNan == 0;
}
DFB_AVX2 inline bool copyAndCheckDepthsAvx2(const float* depth, int count, float* out)
{
    return copyAndCheckDepths(depth, count, out);
}

// One per thread, to be used again and again. A pixel of colour 0 and alpha 0 contributes nothing, whatever its depth;
// one with colour and alpha 0 is emission and does.
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
        isClean_ = true;
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
                copy(planes, first + spans[i].x, spans[i].count);
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

    // False if all colours are finite, all alphas within [0, 1], and no depth is NaN.
    bool mayBeFaulty() const noexcept { return !isClean_; }

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

    // The next `count` pixels, of each channel from its place `first` on.
    void copy(const ConstPlanes& planes, std::size_t first, int count)
    {
        const bool fast = cpuHasAvx2();
        const float* rgba = floatsOf(planes.at[Color]) + 4 * first;
        float* to = floatsAt(Color);
        isClean_ &= fast ? copyAndCheckColorsAvx2(rgba, count, to) : copyAndCheckColors(rgba, count, to);
        if (hasChannel(channels_, Depth)) {
            const float* depth = floatsOf(planes.at[Depth]) + first;
            isClean_ &= fast ? copyAndCheckDepthsAvx2(depth, count, floatsAt(Depth))
                             : copyAndCheckDepths(depth, count, floatsAt(Depth));
        }
        if ((channels_ & ~(colorChannel | depthChannel)) == 0)
            return;
        for (std::size_t c = Normal; c < channelCount; ++c)
            if (hasChannel(channels_, c)) {
                const auto bytes = 4 * static_cast<std::size_t>(channelWords[c]);
                std::memcpy(floatsAt(c), planes.at[c] + bytes * first, bytes * static_cast<std::size_t>(count));
            }
    }
    float* floatsAt(std::size_t channel) // of the next pixel
    {
        return planes_[channel].data() + static_cast<std::size_t>(channelWords[channel]) * pixels;
    }

    void findSpans(const float* row, int width)
    {
        const std::size_t before = spans.size();
        for (int x0 = 0; x0 < width; x0 += 64) {
            const int count = std::min(64, width - x0);
            const float* from = row + 4 * static_cast<std::ptrdiff_t>(x0);
            std::uint64_t bits = activePixelBits(from, count);
            for (int x = x0; bits != 0;) {
                const int skipped = zerosBelow(bits);
                bits >>= skipped;
                x += skipped;
                const int run = ~bits == 0 ? 64 : zerosBelow(~bits);
                bits = run == 64 ? 0 : bits >> run;
                if (spans.size() > before && spans.back().x + spans.back().count == x)
                    spans.back().count = static_cast<std::uint16_t>(spans.back().count + run); // over x0
                else
                    spans.push_back({static_cast<std::uint16_t>(x), static_cast<std::uint16_t>(run)});
                x += run;
            }
        }
    }

    ChannelMask channels_ = 0;
    std::array<std::vector<float>, channelCount> planes_; // words of 4 bytes; those of ids are copied as such
    bool isClean_ = true;
    std::vector<float> scratch_;
};

} // namespace dfb::detail
