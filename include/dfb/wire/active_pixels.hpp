// ActivePixels: what of a tile travels: the pixels with any colour channel that is not 0, or those with a depth, as
// spans.
#pragma once

#include <dfb/base/cpu.hpp>
#include <dfb/fragment.hpp>
#include <dfb/wire/wire_codes.hpp>

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

// Of up to 64 pixels, bit by bit.
struct DepthBits {
    std::uint64_t active = 0; // below +infinity
    std::uint64_t nan = 0;
};

DFB_INLINE DepthBits findDepths(const float* depth, int count)
{
    DepthBits bits;
    for (int i = 0; i < count; ++i) {
        bits.active |= std::uint64_t{depth[i] < std::numeric_limits<float>::infinity()} << i;
        bits.nan |= std::uint64_t{depth[i] != depth[i]} << i;
    }
    return bits;
}

#if defined(DFB_HAS_AVX2_CLONES)
DFB_AVX2 inline DepthBits findDepthsAvx2(const float* depth, int count)
{
    const __m256 infinity = _mm256_set1_ps(std::numeric_limits<float>::infinity());
    const auto bitsOf8 = [](int mask) { return static_cast<std::uint64_t>(mask & 255); };
    DepthBits bits;
    int i = 0;
    for (; i + 8 <= count; i += 8) {
        const __m256 d = _mm256_loadu_ps(depth + i);
        bits.active |= bitsOf8(_mm256_movemask_ps(_mm256_cmp_ps(d, infinity, _CMP_LT_OQ))) << i;
        bits.nan |= bitsOf8(_mm256_movemask_ps(_mm256_cmp_ps(d, d, _CMP_UNORD_Q))) << i;
    }
    if (i == count)
        return bits;
    const DepthBits rest = findDepths(depth + i, count - i);
    return {bits.active | rest.active << i, bits.nan | rest.nan << i};
}
#endif

inline DepthBits depthBits(const float* depth, int count)
{
#if defined(DFB_HAS_AVX2_CLONES)
    if (cpuHasAvx2())
        return findDepthsAvx2(depth, count);
#endif
    return findDepths(depth, count);
}

// Copies colours. False if one is not finite, or an alpha not within [0, 1]. No branches, so that it can be vectorized.
inline bool copyAndCheckColors(const float* rgba, int count, float* out)
{
    constexpr float most = std::numeric_limits<float>::max();
    constexpr float low[4] = {-most, -most, -most, 0}, high[4] = {most, most, most, 1};
    int bad[4] = {};
    for (int i = 0; i < 4 * count; i += 4)
        for (int c = 0; c < 4; ++c) {
            const float value = rgba[i + c];
            out[i + c] = value;
            bad[c] |= static_cast<int>(!(value >= low[c])) | static_cast<int>(!(value <= high[c]));
        }
    return (bad[0] | bad[1] | bad[2] | bad[3]) == 0;
}

#if defined(DFB_HAS_AVX2_CLONES)
DFB_AVX2 inline bool copyAndCheckColorsAvx2(const float* rgba, int count, float* out)
{
    constexpr float most = std::numeric_limits<float>::max();
    const __m256 low = _mm256_setr_ps(-most, -most, -most, 0, -most, -most, -most, 0);
    const __m256 high = _mm256_setr_ps(most, most, most, 1, most, most, most, 1);
    __m256 areInside = _mm256_castsi256_ps(_mm256_set1_epi32(-1));
    int i = 0;
    for (; i + 2 <= count; i += 2) {
        const __m256 two = _mm256_loadu_ps(rgba + 4 * i);
        _mm256_storeu_ps(out + 4 * i, two);
        areInside = _mm256_and_ps(
            areInside, _mm256_and_ps(_mm256_cmp_ps(two, low, _CMP_GE_OQ), _mm256_cmp_ps(two, high, _CMP_LE_OQ)));
    }
    const bool isLastGood = i == count || copyAndCheckColors(rgba + 4 * i, 1, out + 4 * i);
    return isLastGood && _mm256_movemask_ps(areInside) == 255;
}
#endif

// Depth as it travels: NaN counts as farthest, and -0 as 0, so that comparing is enough to order.
inline float canonicalDepth(float depth)
{
    const std::uint32_t bits = bitsOf(depth), some = bits == 0x80000000u ? 0u : bits;
    return floatOf((bits & 0x7fffffffu) > 0x7f800000u ? 0x7f800000u : some); // integers, so that it can be vectorized
}

// Copies depths as they travel. False if any is NaN.
DFB_INLINE bool copyAndCheckDepths(const float* depth, int count, float* out)
{
    int isNan = 0;
    for (int i = 0; i < count; ++i) {
        isNan |= static_cast<int>((bitsOf(depth[i]) & 0x7fffffffu) > 0x7f800000u);
        out[i] = canonicalDepth(depth[i]);
    }
    return isNan == 0;
}
DFB_AVX2 inline bool copyAndCheckDepthsAvx2(const float* depth, int count, float* out)
{
    return copyAndCheckDepths(depth, count, out);
}

// Copies `count` pixels of a channel, from place `first` of its plane on, as they travel. False if a colour is not
// finite, an alpha not within [0, 1], or a depth NaN.
inline bool copyAndCheck(const ConstPlanes& planes, std::size_t channel, std::size_t first, int count, std::byte* out)
{
    const bool fast = cpuHasAvx2();
    if (channel == Color) {
        const float* rgba = floatsOf(planes.at[Color]) + 4 * first;
        return fast ? copyAndCheckColorsAvx2(rgba, count, floatsOf(out))
                    : copyAndCheckColors(rgba, count, floatsOf(out));
    }
    if (channel == Depth) {
        const float* depth = floatsOf(planes.at[Depth]) + first;
        return fast ? copyAndCheckDepthsAvx2(depth, count, floatsOf(out))
                    : copyAndCheckDepths(depth, count, floatsOf(out));
    }
    const std::size_t bytes = 4 * static_cast<std::size_t>(channelWords[channel]);
    std::memcpy(out, planes.at[channel] + bytes * first, bytes * static_cast<std::size_t>(count));
    return true;
}

// One per thread, to be used again and again. A pixel of colour 0 and alpha 0 contributes nothing, whatever its depth;
// one with colour and alpha 0 is emission and does. By depth, what has one below +infinity does, and nothing else.
struct ActivePixels {
    std::vector<std::uint16_t> rowCounts; // of spans, of rows [rowBegin, rowEnd)
    std::vector<Span> spans;
    int rowBegin = 0, rowEnd = 0;
    std::uint32_t pixels = 0;

    // `channels` has colour, `byDepth` also depth, and the tile all of them. Copies the colours, as they travel, to
    // `colors`, which has room for all pixels of the tile, and the rest to where plane() says. Each row is copied as
    // soon as its spans are found: rows of a large image are far apart in memory, and so are read there once.
    void gather(const InputPixels& tile, ChannelMask channels, bool byDepth, float* colors)
    {
        const ConstPlanes& planes = tile.planes();
        const auto most =
            static_cast<std::size_t>(tile.region.width()) * static_cast<std::size_t>(tile.region.height());
        struct Target {
            std::size_t channel;
            std::byte* to;
        };
        std::array<Target, channelCount> targets{{{Color, reinterpret_cast<std::byte*>(colors)}}};
        std::size_t targetCount = 1;
        for (std::size_t c = Depth; c < channelCount; ++c)
            if (hasChannel(channels, c)) {
                planes_[c].resize(std::max(planes_[c].size(), most * static_cast<std::size_t>(channelWords[c])));
                targets[targetCount++] = {c, reinterpret_cast<std::byte*>(planes_[c].data())};
            }
        bool isClean = true;
        find(tile, byDepth, [&](std::size_t first, int count) {
            for (std::size_t i = 0; i < targetCount; ++i) {
                const auto [channel, to] = targets[i];
                isClean &= copyAndCheck(planes, channel, first, count, to);
                targets[i].to += 4 * static_cast<std::size_t>(channelWords[channel]) * static_cast<std::size_t>(count);
            }
        });
        isClean_ = isClean;
    }
    const std::byte* plane(std::size_t channel) const noexcept
    {
        return reinterpret_cast<const std::byte*>(planes_[channel].data());
    }
    // False if all colours are finite, all alphas within [0, 1], and no depth is NaN.
    bool mayBeFaulty() const noexcept { return !isClean_; }
    // Pixels that are not active because their depth is NaN.
    std::uint64_t nanDepths() const noexcept { return nanDepths_; }

    // Calls f(first, count) for each span as it is found: its first pixel's place in the planes.
    template <class F>
    void find(const InputPixels& tile, bool byDepth, const F& f)
    {
        rowCounts.clear();
        spans.clear();
        rowBegin = rowEnd = 0;
        pixels = 0;
        nanDepths_ = 0;
        const float* depths = byDepth ? floatsOf(tile.planes().at[Depth]) : nullptr;
        const Region valid = tile.valid;
        const int x0 = valid.x0 - tile.region.x0, width = tile.pixel(0, 0) ? valid.width() : 0;
        const int yEnd = width > 0 ? valid.y1 - tile.region.y0 : 0;
        const int ahead = width < 64 ? 1 : std::max(1, 384 / width); // rows: 6 KiB were best where it was measured
        for (int y = valid.y0 - tile.region.y0; y < yEnd; ++y) {
            const std::size_t before = spans.size(), begin = static_cast<std::size_t>(y) * tile.stride;
            if (y + ahead < yEnd)
                prefetch(tile.pixel(x0, y + ahead), width);
            if (depths)
                findSpans(x0, x0 + width, [&](int x, int count) {
                    const DepthBits bits = depthBits(depths + begin + static_cast<std::size_t>(x), count);
                    for (std::uint64_t nan = bits.nan; nan != 0; nan &= nan - 1)
                        ++nanDepths_;
                    return bits.active;
                });
            else
                findSpans(x0, x0 + width, [&](int x, int count) { return activePixelBits(tile.pixel(x, y), count); });
            for (std::size_t i = before; i < spans.size(); ++i) {
                f(begin + spans[i].x, static_cast<int>(spans[i].count));
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

    // The same for those that were found in `tile`.
    template <class F>
    void forEachSpan(const InputPixels& tile, const F& f) const
    {
        const Span* span = spans.data();
        for (std::size_t row = 0; row < rowCounts.size(); ++row) {
            const std::size_t begin = (static_cast<std::size_t>(rowBegin) + row) * tile.stride;
            for (int i = 0; i < rowCounts[row]; ++i, ++span)
                f(begin + span->x, static_cast<int>(span->count));
        }
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

    // Of pixels [begin, end) of a row; `bitsOfSome(x, count)`: which of so many from x on, up to 64, are active.
    template <class BitsOfSome>
    void findSpans(int begin, int end, const BitsOfSome& bitsOfSome)
    {
        const std::size_t before = spans.size();
        for (int x0 = begin; x0 < end; x0 += 64) {
            const int count = std::min(64, end - x0);
            forEachRun(bitsOfSome(x0, count), [&](int at, int run) {
                const int x = x0 + at;
                if (spans.size() > before && spans.back().x + spans.back().count == x)
                    spans.back().count = static_cast<std::uint16_t>(spans.back().count + run); // over x0
                else
                    spans.push_back({static_cast<std::uint16_t>(x), static_cast<std::uint16_t>(run)});
            });
        }
    }

    std::array<std::vector<float>, channelCount> planes_; // words of 4 bytes; those of ids are copied as such
    bool isClean_ = true;
    std::uint64_t nanDepths_ = 0;
};

} // namespace dfb::detail
