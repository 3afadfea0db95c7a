// The kernels between an input and its message: the conversion of colours to the formats in which they travel, and
// back; which pixels are active; copies that check them.
#pragma once

#include <dfb/base/cpu.hpp>
#include <dfb/channels.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>

#if defined(DFB_HAS_AVX2_CLONES)
#include <immintrin.h>
#endif

DFB_NAMESPACE_BEGIN
namespace detail {

// ---- conversion of floats to codes of 16 or 8 bits, rounded to nearest, ties to even, and back: one at a time and in
// rows. For numbers that have a code, rows give the same bits on every processor; NaNs may differ.

inline float floatOf(std::uint32_t bits) noexcept
{
    float value = 0;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}
inline std::uint32_t bitsOf(float value) noexcept
{
    std::uint32_t bits = 0;
    std::memcpy(&bits, &value, sizeof bits);
    return bits;
}

// Converts a number from 0 to 65504 to the nearest binary16, ties to even.
inline std::uint16_t positiveToHalf(float value) noexcept
{
    // `small` is the result where it is denormal: adding 0.5 rounds the value, and moves its bits to the end of the
    // mantissa.
    const std::uint32_t bits = bitsOf(value), small = bitsOf(value + 0.5f) - 0x3f000000u;
    const std::uint32_t normal = (bits + 0xc8000fffu + (bits >> 13 & 1u)) >> 13;
    // A mask, as compilers do not vectorize a choice between values made of floats.
    const std::uint32_t isSmall = 0u - static_cast<std::uint32_t>(static_cast<std::int32_t>(bits) < 0x38800000);
    return static_cast<std::uint16_t>((small & isSmall) | (normal & ~isSmall));
}
inline float positiveFromHalf(std::uint16_t half) noexcept { return floatOf((half & 0x7fffu) << 13) * 0x1p112f; }

// The codes in which a scaled channel of a colour travels. No pixel in range has a code above `most`.
struct HalfCode {
    using Word = std::uint16_t;
    static constexpr Word most = 0x7800; // 2^15: alpha 1 is scaled to it, and no colour is above it
    static Word of(float value) noexcept { return positiveToHalf(value); }
    static float valueOf(Word code) noexcept { return positiveFromHalf(code); }
};
template <class Unsigned>
struct UnormCode {
    using Word = Unsigned;
    static constexpr Word most = std::numeric_limits<Word>::max();
    // The addition rounds to an integer, ties to even, which is then in the lowest bits.
    static Word of(float value) noexcept { return static_cast<Word>(bitsOf(value + 0x1p23f)); }
    static float valueOf(Word code) noexcept { return static_cast<float>(code); }
};

using Unorm16Code = UnormCode<std::uint16_t>;
using Unorm8Code = UnormCode<std::uint8_t>;

// The factors for the channels of a pixel, and the least alpha that decoding returns.
struct WireScales {
    float color, alpha, leastAlpha = 0;
};

// Rows in plain C++. Values converted from or to bytes go through `words`, as pointers to bytes could alias anything.
constexpr int wireBlock = 256;

template <class Code>
DFB_INLINE void encodePixels(const float* rgba, int count, const WireScales& by, std::byte* out) noexcept
{
    const float scales[4] = {by.color, by.color, by.color, by.alpha};
    typename Code::Word words[wireBlock];
    for (int first = 0; first < 4 * count; first += wireBlock) {
        const int size = std::min(wireBlock, 4 * count - first);
        for (int i = 0; i < size; i += 4)
            for (int c = 0; c < 4; ++c)
                words[i + c] = Code::of(rgba[first + i + c] * scales[c]);
        std::memcpy(out + sizeof words[0] * static_cast<std::size_t>(first), words,
                    sizeof words[0] * static_cast<std::size_t>(size));
    }
}

// Returns false if there is a code that no pixel in range has.
template <class Code>
DFB_INLINE bool decodePixels(const std::byte* in, int count, const WireScales& by, float* rgba) noexcept
{
    const float scales[4] = {by.color, by.color, by.color, by.alpha}, least[4] = {0, 0, 0, by.leastAlpha};
    typename Code::Word words[wireBlock];
    std::uint16_t above = 0; // the highest bit is set if a code is above `most`
    for (int first = 0; first < 4 * count; first += wireBlock) {
        const int size = std::min(wireBlock, 4 * count - first);
        std::memcpy(words, in + sizeof words[0] * static_cast<std::size_t>(first),
                    sizeof words[0] * static_cast<std::size_t>(size));
        for (int i = 0; i < size; i += 4)
            for (int c = 0; c < 4; ++c)
                rgba[first + i + c] = std::max(Code::valueOf(words[i + c]) * scales[c], least[c]);
        if constexpr (std::is_same_v<Code, HalfCode>)
            for (int i = 0; i < size; ++i) // a loop of its own, so that both are vectorized
                above = static_cast<std::uint16_t>(above | words[i] | (words[i] + (0x7fff - Code::most)));
    }
    return above < 0x8000;
}

// Converts pixels with 8 bits a channel: level / 255, rounded once.
DFB_INLINE void decodeBytes(const std::byte* in, std::size_t count, float* rgba) noexcept
{
    for (std::size_t i = 0; i < 4 * count; ++i)
        rgba[i] = static_cast<float>(static_cast<std::uint8_t>(in[i])) / 255.0f;
}
// Whether all pixels have 0 <= alpha <= 1 and 0 <= color <= maxColor * alpha. No branch, so that it can be vectorized.
DFB_INLINE bool arePixelsInRange(const float* rgba, int count, float maxColor) noexcept
{
    int out = 0;
    for (int i = 0; i < count; ++i) {
        const float alpha = rgba[4 * i + 3], most = maxColor * alpha;
        for (int c = 0; c < 3; ++c)
            out |= static_cast<int>(!(rgba[4 * i + c] >= 0.0f)) | static_cast<int>(!(rgba[4 * i + c] <= most));
        out |= static_cast<int>(!(alpha >= 0.0f)) | static_cast<int>(!(alpha <= 1.0f));
    }
    return out == 0;
}

// These loops with AVX2 and F16C: whole blocks at once, and the rest as above.
#if defined(DFB_HAS_AVX2_CLONES)
constexpr int toNearest = _MM_FROUND_TO_NEAREST_INT;
// The factors for two pixels.
DFB_AVX2 inline __m256 wireVector(float color, float alpha) noexcept
{
    return _mm256_setr_ps(color, color, color, alpha, color, color, color, alpha);
}

template <class Code>
DFB_AVX2 inline void encodePixelsAvx2(const float* rgba, int count, const WireScales& by, std::byte* out) noexcept
{
    constexpr std::size_t wordBytes = sizeof(typename Code::Word);
    int i = 0;
    const __m256 scales = wireVector(by.color, by.alpha), zero = _mm256_setzero_ps();
    for (; i + 8 <= count; i += 8) {
        __m256 scaled[4];
        for (int part = 0; part < 4; ++part)
            scaled[part] = _mm256_mul_ps(_mm256_loadu_ps(rgba + 4 * i + 8 * part), scales);
        auto* to = reinterpret_cast<__m128i*>(out + 4 * wordBytes * static_cast<std::size_t>(i));
        if constexpr (std::is_same_v<Code, HalfCode>) {
            for (int part = 0; part < 4; ++part) // without the sign of -0
                _mm_storeu_si128(to + part, _mm256_cvtps_ph(_mm256_max_ps(scaled[part], zero), toNearest));
        } else {
            __m256i codes[4];
            for (int part = 0; part < 4; ++part)
                codes[part] = _mm256_cvtps_epi32(scaled[part]);
            const __m256i low = _mm256_packus_epi32(codes[0], codes[1]), high = _mm256_packus_epi32(codes[2], codes[3]);
            auto* words = reinterpret_cast<__m256i*>(to);
            if constexpr (wordBytes == 2) {
                _mm256_storeu_si256(words, _mm256_permute4x64_epi64(low, 0xd8));
                _mm256_storeu_si256(words + 1, _mm256_permute4x64_epi64(high, 0xd8));
            } else {
                const __m256i inOrder = _mm256_setr_epi32(0, 4, 1, 5, 2, 6, 3, 7);
                _mm256_storeu_si256(words, _mm256_permutevar8x32_epi32(_mm256_packus_epi16(low, high), inOrder));
            }
        }
    }
    encodePixels<Code>(rgba + 4 * i, count - i, by, out + 4 * wordBytes * static_cast<std::size_t>(i));
}

template <class Code>
DFB_AVX2 inline bool decodePixelsAvx2(const std::byte* in, int count, const WireScales& by, float* rgba) noexcept
{
    constexpr std::size_t wordBytes = sizeof(typename Code::Word);
    int i = 0;
    bool inRange = true;
    const __m256 scales = wireVector(by.color, by.alpha), least = wireVector(0, by.leastAlpha);
    if constexpr (std::is_same_v<Code, HalfCode>) {
        __m128i largest[2] = {};
        for (; i + 4 <= count; i += 4) // two at a time would be slower for the comparison
            for (int part = 0; part < 2; ++part) {
                const __m128i codes = _mm_loadu_si128(reinterpret_cast<const __m128i*>(in + 8 * i) + part);
                largest[part] = _mm_max_epu16(largest[part], codes);
                _mm256_storeu_ps(rgba + 4 * i + 8 * part,
                                 _mm256_max_ps(_mm256_mul_ps(_mm256_cvtph_ps(codes), scales), least));
            }
        const __m128i all = _mm_max_epu16(largest[0], largest[1]), most = _mm_set1_epi16(HalfCode::most);
        inRange = _mm_movemask_epi8(_mm_cmpeq_epi16(_mm_max_epu16(all, most), most)) == 0xffff;
    } else {
        for (; i + 2 <= count; i += 2) {
            const auto* from = reinterpret_cast<const __m128i*>(in + 4 * wordBytes * static_cast<std::size_t>(i));
            const __m256i codes = wordBytes == 2 ? _mm256_cvtepu16_epi32(_mm_loadu_si128(from))
                                                 : _mm256_cvtepu8_epi32(_mm_loadl_epi64(from));
            _mm256_storeu_ps(rgba + 4 * i, _mm256_max_ps(_mm256_mul_ps(_mm256_cvtepi32_ps(codes), scales), least));
        }
    }
    return decodePixels<Code>(in + 4 * wordBytes * static_cast<std::size_t>(i), count - i, by, rgba + 4 * i) && inRange;
}

DFB_AVX2 inline bool arePixelsInRangeAvx2(const float* rgba, int count, float maxColor) noexcept
{
    int i = 0;
    const __m256 zero = _mm256_setzero_ps(), one = _mm256_set1_ps(1.0f), most = _mm256_set1_ps(maxColor);
    __m256 in = _mm256_castsi256_ps(_mm256_set1_epi32(-1));
    for (; i + 2 <= count; i += 2) {
        const __m256 value = _mm256_loadu_ps(rgba + 4 * i), alpha = _mm256_permute_ps(value, 0xff);
        const __m256 limit = _mm256_blend_ps(_mm256_mul_ps(most, alpha), one, 0x88);
        in = _mm256_and_ps(in, _mm256_and_ps(_mm256_cmp_ps(value, zero, _CMP_GE_OQ),
                                             _mm256_cmp_ps(value, limit, _CMP_LE_OQ))); // false for NaN
    }
    return _mm256_movemask_ps(in) == 0xff && arePixelsInRange(rgba + 4 * i, count - i, maxColor);
}
#endif

// ---- active pixels, and copies that check them

// Returns a bit for each of up to 64 pixels, set if any of its colour channels is not 0.
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

// Copies colours. Returns false if one is not finite, or an alpha is not within [0, 1]. There are no branches, so that
// it can be vectorized.
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
// Checks colours as copyAndCheckColors() does.
struct Avx2ColorCheck {
    __m256 areInside;

    DFB_AVX2 DFB_INLINE void clear() { areInside = _mm256_castsi256_ps(_mm256_set1_epi32(-1)); }
    DFB_AVX2 DFB_INLINE void add(__m256 two)
    {
        constexpr float most = std::numeric_limits<float>::max();
        const __m256 low = _mm256_setr_ps(-most, -most, -most, 0, -most, -most, -most, 0);
        const __m256 high = _mm256_setr_ps(most, most, most, 1, most, most, most, 1);
        areInside = _mm256_and_ps(
            areInside, _mm256_and_ps(_mm256_cmp_ps(two, low, _CMP_GE_OQ), _mm256_cmp_ps(two, high, _CMP_LE_OQ)));
    }
    DFB_AVX2 DFB_INLINE bool isGood() const { return _mm256_movemask_ps(areInside) == 255; }
};

DFB_AVX2 inline bool copyAndCheckColorsAvx2(const float* rgba, int count, float* out)
{
    Avx2ColorCheck check;
    check.clear();
    int i = 0;
    for (; i + 2 <= count; i += 2) {
        const __m256 two = _mm256_loadu_ps(rgba + 4 * i);
        _mm256_storeu_ps(out + 4 * i, two);
        check.add(two);
    }
    return (i == count || copyAndCheckColors(rgba + 4 * i, count - i, out + 4 * i)) && check.isGood();
}

// With `Copies`, also does what copyAndCheckColors() does, and sets `isGood` to false where that would return false.
template <bool Copies>
DFB_AVX2 std::uint64_t findActivePixelsAvx2(const float* rgba, const float* ahead, int count, float* out, bool& isGood)
{
    const __m256i zero = _mm256_setzero_si256(), allButSign = _mm256_set1_epi32(0x7fffffff);
    Avx2ColorCheck check;
    check.clear();
    std::uint64_t bits = 0;
    int i = 0;
    for (; i + 8 <= count; i += 8) {
        prefetch(reinterpret_cast<const std::byte*>(ahead + 4 * i), 128);
        __m256i isZero[4]; // of 2 pixels each
        for (int k = 0; k < 4; ++k) {
            const __m256 two = _mm256_loadu_ps(rgba + 4 * i + 8 * k);
            if constexpr (Copies) {
                _mm256_storeu_ps(out + 4 * i + 8 * k, two);
                check.add(two);
            }
            isZero[k] = _mm256_cmpeq_epi32(_mm256_and_si256(_mm256_castps_si256(two), allButSign), zero);
        }
        // A byte for each value, 4 for each pixel. The pixels are in the order 0 2 4 6 1 3 5 7.
        __m256i bytes =
            _mm256_packs_epi16(_mm256_packs_epi32(isZero[0], isZero[1]), _mm256_packs_epi32(isZero[2], isZero[3]));
        bytes = _mm256_permutevar8x32_epi32(bytes, _mm256_setr_epi32(0, 4, 1, 5, 2, 6, 3, 7));
        const int none = _mm256_movemask_ps(_mm256_castsi256_ps(_mm256_cmpeq_epi32(bytes, _mm256_set1_epi32(-1))));
        bits |= static_cast<std::uint64_t>(~none & 255) << i;
    }
    if (Copies && !check.isGood())
        isGood = false;
    if (i == count)
        return bits;
    if (Copies && !copyAndCheckColors(rgba + 4 * i, count - i, out + 4 * i))
        isGood = false;
    return bits | findActivePixels(rgba + 4 * i, count - i) << i;
}
#endif

template <bool Copies>
std::uint64_t findActivePixelsPlain(const float* rgba, const float* ahead, int count, float* out, bool& isGood)
{
    prefetch(reinterpret_cast<const std::byte*>(ahead), 4 * sizeof(float) * static_cast<std::size_t>(count));
    if (Copies && !copyAndCheckColors(rgba, count, out))
        isGood = false;
    return findActivePixels(Copies ? out : rgba, count);
}

// Calls findActivePixels() in its fastest version. `ahead`: as many pixels there are prefetched meanwhile.
inline std::uint64_t activePixelBits(const float* rgba, const float* ahead, int count)
{
    bool isGood = true;
    return DFB_FASTEST(findActivePixelsPlain<false>, findActivePixelsAvx2<false>, rgba, ahead, count, nullptr, isGood);
}

// Does the same and copies all pixels, in one pass. Sets `isGood` to false if copyAndCheckColors() would return false.
inline std::uint64_t copyAndFindActivePixels(const float* rgba, const float* ahead, int count, float* out, bool& isGood)
{
    return DFB_FASTEST(findActivePixelsPlain<true>, findActivePixelsAvx2<true>, rgba, ahead, count, out, isGood);
}

// Like findActivePixels(), for pixels with 8 bits a channel.
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
    return DFB_FASTEST(findActiveBytes, findActiveBytesAvx2, rgba, count);
}

// A bit for each of up to 64 pixels.
struct DepthBits {
    std::uint64_t active = 0; // the depth is below the limit
    std::uint64_t nan = 0;
};

DFB_INLINE DepthBits findDepths(const float* depth, int count, float limit)
{
    DepthBits bits;
    for (int i = 0; i < count; ++i) {
        bits.active |= std::uint64_t{depth[i] < limit} << i;
        bits.nan |= std::uint64_t{depth[i] != depth[i]} << i;
    }
    return bits;
}

#if defined(DFB_HAS_AVX2_CLONES)
DFB_AVX2 inline DepthBits findDepthsAvx2(const float* depth, int count, float limit)
{
    const __m256 most = _mm256_set1_ps(limit);
    const auto bitsOf8 = [](int mask) { return static_cast<std::uint64_t>(mask & 255); };
    DepthBits bits;
    int i = 0;
    for (; i + 8 <= count; i += 8) {
        const __m256 d = _mm256_loadu_ps(depth + i);
        bits.active |= bitsOf8(_mm256_movemask_ps(_mm256_cmp_ps(d, most, _CMP_LT_OQ))) << i;
        bits.nan |= bitsOf8(_mm256_movemask_ps(_mm256_cmp_ps(d, d, _CMP_UNORD_Q))) << i;
    }
    if (i == count)
        return bits;
    const DepthBits rest = findDepths(depth + i, count - i, limit);
    return {bits.active | rest.active << i, bits.nan | rest.nan << i};
}
#endif

inline DepthBits depthBits(const float* depth, int count, float limit)
{
    return DFB_FASTEST(findDepths, findDepthsAvx2, depth, count, limit);
}

inline bool hasNan(const float* depth, std::size_t count)
{
    std::uint64_t nan = 0;
    for (std::size_t i = 0; i < count; i += 64)
        nan |= depthBits(depth + i, static_cast<int>(std::min<std::size_t>(64, count - i)), 0).nan;
    return nan != 0;
}

// A depth as it travels: NaN becomes +infinity, and -0 becomes 0, so that plain comparisons order depths.
inline float canonicalDepth(float depth)
{
    const std::uint32_t bits = bitsOf(depth), some = bits == 0x80000000u ? 0u : bits;
    return floatOf((bits & 0x7fffffffu) > 0x7f800000u ? 0x7f800000u : some); // integers, so that it can be vectorized
}

// Copies depths in the form in which they travel. Returns false if any is NaN.
DFB_INLINE bool copyAndCheckDepths(const float* depth, int count, float* out)
{
    int isNan = 0;
    for (int i = 0; i < count; ++i) {
        isNan |= static_cast<int>((bitsOf(depth[i]) & 0x7fffffffu) > 0x7f800000u);
        out[i] = canonicalDepth(depth[i]);
    }
    return isNan == 0;
}

// Copies `count` pixels of a channel, of `pixelBytes` bytes each, in the form in which they travel. Returns false if a
// colour in floats is not finite, an alpha of these is not within [0, 1], or a depth is NaN.
inline bool copyAndCheck(std::size_t channel, std::ptrdiff_t pixelBytes, const std::byte* in, int count, std::byte* out)
{
    if (channel == Color && pixelBytes > 4)
        return DFB_FASTEST(copyAndCheckColors, copyAndCheckColorsAvx2, floatsOf(in), count, floatsOf(out));
    if (channel == Depth)
        return fastest<copyAndCheckDepths>(floatsOf(in), count, floatsOf(out));
    std::memcpy(out, in, static_cast<std::size_t>(pixelBytes * count));
    return true;
}

} // namespace detail

DFB_NAMESPACE_END
