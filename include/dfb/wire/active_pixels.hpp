// Active pixels: which of a row travel, those with any colour channel that is not 0 or those with a depth; and copying
// them, with a check.
#pragma once

#include <dfb/base/cpu.hpp>
#include <dfb/channels.hpp>
#include <dfb/wire/wire_format.hpp>

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>

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

// Finds the active ones of pixels with 8 bits a channel.
DFB_INLINE std::uint64_t findActiveBytes(const std::byte* rgba, int count)
{
    std::uint64_t bits = 0;
    for (int i = 0; i < count; ++i) {
        std::uint32_t pixel = 0;
        std::memcpy(&pixel, rgba + 4 * i, sizeof pixel);
        bits |= std::uint64_t{pixel != 0} << i;
    }
    return bits;
}

#if defined(DFB_HAS_AVX2_CLONES)
DFB_AVX2 inline std::uint64_t findActiveBytesAvx2(const std::byte* rgba, int count)
{
    const __m256i zero = _mm256_setzero_si256();
    std::uint64_t bits = 0;
    int i = 0;
    for (; i + 8 <= count; i += 8) {
        const __m256i pixels = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(rgba + 4 * i));
        const int none = _mm256_movemask_ps(_mm256_castsi256_ps(_mm256_cmpeq_epi32(pixels, zero)));
        bits |= static_cast<std::uint64_t>(~none & 255) << i;
    }
    return i < count ? bits | findActiveBytes(rgba + 4 * i, count - i) << i : bits;
}
#endif

inline std::uint64_t activeByteBits(const std::byte* rgba, int count)
{
#if defined(DFB_HAS_AVX2_CLONES)
    if (cpuHasAvx2())
        return findActiveBytesAvx2(rgba, count);
#endif
    return findActiveBytes(rgba, count);
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

// Copies `count` pixels of a channel, from place `first` of its plane on, as they travel; `hasBytes`: the colour has 8
// bits a channel. False if a colour is not finite, an alpha not within [0, 1], or a depth NaN.
inline bool copyAndCheck(const ConstPlanes& planes, bool hasBytes, std::size_t channel, std::ptrdiff_t first, int count,
                         std::byte* out)
{
    const bool fast = cpuHasAvx2();
    if (channel == Color && hasBytes) {
        std::memcpy(out, planes.at[Color] + 4 * first, 4 * static_cast<std::size_t>(count));
        return true;
    }
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
    const std::ptrdiff_t bytes = 4 * channelWords[channel];
    std::memcpy(out, planes.at[channel] + bytes * first, static_cast<std::size_t>(bytes * count));
    return true;
}

} // namespace dfb::detail
