// How colour travels: as float32, or as codes of 16 or 8 bits; what that costs in accuracy, and the choice of the
// cheapest format that keeps an error budget.
#pragma once

#include <dfb/base/cpu.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>

// Below: conversion of floats to codes of 16 or 8 bits, rounded to nearest, ties to even, and back, one at a time and
// in rows. For numbers that have a code, rows give the same bits on every processor; NaNs may differ.

DFB_NAMESPACE_BEGIN
namespace detail {

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

// `condition` ? a : b. Uses masks, as compilers do not vectorize a choice between values made of floats.
inline std::uint32_t choose(bool condition, std::uint32_t a, std::uint32_t b) noexcept
{
    const std::uint32_t mask = 0u - static_cast<std::uint32_t>(condition);
    return (a & mask) | (b & ~mask);
}

// Converts a number from 0 to 65504 to the nearest binary16, ties to even.
inline std::uint16_t positiveToHalf(float value) noexcept
{
    // `small` is the result where it is denormal: adding 0.5 rounds the value, and leaves the bits that stay at the end
    // of the mantissa.
    const std::uint32_t bits = bitsOf(value), small = bitsOf(value + 0.5f) - 0x3f000000u;
    const std::uint32_t normal = (bits + 0xc8000fffu + (bits >> 13 & 1u)) >> 13;
    return static_cast<std::uint16_t>(choose(static_cast<std::int32_t>(bits) < 0x38800000, small, normal));
}
inline float positiveFromHalf(std::uint16_t half) noexcept { return floatOf((half & 0x7fffu) << 13) * 0x1p112f; }

// Rounds a value within [0, 65535] to the nearest integer, ties to even.
inline std::uint32_t nearestInteger(float value) noexcept
{
    return bitsOf(value + 0x1p23f) & 0x7fffffu; // the addition leaves no bit below one
}

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
    static Word of(float value) noexcept { return static_cast<Word>(nearestInteger(value)); }
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
inline void bytesToFloats(const std::byte* in, std::size_t count, float* rgba) noexcept
{
    fastest<decodeBytes>(in, count, rgba);
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
#endif

template <class Code>
DFB_AVX2 inline void encodePixelsAvx2(const float* rgba, int count, const WireScales& by, std::byte* out) noexcept
{
    constexpr std::size_t wordBytes = sizeof(typename Code::Word);
    int i = 0;
#if defined(DFB_HAS_AVX2_CLONES)
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
#endif
    encodePixels<Code>(rgba + 4 * i, count - i, by, out + 4 * wordBytes * static_cast<std::size_t>(i));
}

template <class Code>
DFB_AVX2 inline bool decodePixelsAvx2(const std::byte* in, int count, const WireScales& by, float* rgba) noexcept
{
    constexpr std::size_t wordBytes = sizeof(typename Code::Word);
    int i = 0;
    bool inRange = true;
#if defined(DFB_HAS_AVX2_CLONES)
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
#endif
    return decodePixels<Code>(in + 4 * wordBytes * static_cast<std::size_t>(i), count - i, by, rgba + 4 * i) && inRange;
}

DFB_AVX2 inline bool arePixelsInRangeAvx2(const float* rgba, int count, float maxColor) noexcept
{
    int i = 0, inRange = 0xff; // a bit for each lane
#if defined(DFB_HAS_AVX2_CLONES)
    const __m256 zero = _mm256_setzero_ps(), one = _mm256_set1_ps(1.0f), most = _mm256_set1_ps(maxColor);
    __m256 in = _mm256_castsi256_ps(_mm256_set1_epi32(-1));
    for (; i + 2 <= count; i += 2) {
        const __m256 value = _mm256_loadu_ps(rgba + 4 * i), alpha = _mm256_permute_ps(value, 0xff);
        const __m256 limit = _mm256_blend_ps(_mm256_mul_ps(most, alpha), one, 0x88);
        in = _mm256_and_ps(in, _mm256_and_ps(_mm256_cmp_ps(value, zero, _CMP_GE_OQ),
                                             _mm256_cmp_ps(value, limit, _CMP_LE_OQ))); // false for NaN
    }
    inRange = _mm256_movemask_ps(in);
#endif
    return inRange == 0xff && arePixelsInRange(rgba + 4 * i, count - i, maxColor);
}

} // namespace detail

// Only colour and alpha are rounded, and the bound is for these. All other channels travel unchanged. Depth, positions
// and ids of the image are bit for bit what they would be with Float32: a pixel whose alpha was above 0 counts for them
// even if its alpha was rounded to 0. Normals and albedo are means of the inputs' unrounded values, weighted by their
// rounded alphas, so the mean is off by as much as the weights.
//
// The bound. A pixel is `C = sum_j T_j c_j`, with T_j the product of 1 - a_i over the layers i in front of j. The last
// layer is the background. After rounding, layer j has c_j + d_j and a_j + e_j. Replace the layers by the rounded ones,
// one after the other from the front. The step at j changes the pixel by `T'_j (d_j - e_j B_j)`, where T'_j is the
// product over the rounded layers in front of j, and B_j is the unrounded pixel that the layers behind j make. So
//
//     |error| <= sum_j T'_j (|d_j| + |e_j| B),    B >= |B_j|
//
// If colours are within [0, M a] and a in [0, 1], the pixel behind is a mean of colours up to M and of the background:
// B = max(M, background). Alpha itself is the same sum with 1 in place of M.
//   Unorm of n bits: |d| <= M h, |e| <= h, h = 1 / (2 (2^n - 1)): each layer adds up to h (M + B).
//   Float16:         |d| <= u c, |e| <= u a, u = 2^-11, and sum_j T'_j a'_j <= 1: u / (1 - u) (M + B), however many
//                    layers there are. Values below 2^-28 M are denormal there: 2^-39 (M + B) more for each layer.
// A mean of passes is no worse than its worst pass. Unorm is converted in float, with four roundings of 2^-24 M, which
// adds 2^-21 (M + B) for each layer. And `c <= M a` is checked in float, which multiplies all that by 1 + 2^-20.
// tests/unit/wire/wire_format.cpp looks for pixels that are worse, also at the edges.

enum class WireFormat : std::uint8_t {
    Float32, // as the renderer wrote it
    Float16, // IEEE binary16, scaled into its range
    Unorm16, // integers over a range that is the same on all ranks
    Unorm8,
    Bytes // 8-bit colours as the renderer wrote them, see TileView::color8; not to be asked for
};

// The largest error that may come from rounding inputs: the absolute difference of any colour or alpha value from its
// value with Float32, in the float image, before that is converted to the output format.
struct ErrorBudget {
    double error = 0;
    float maxColor = 1; // see Precision
};

// For 8-bit images: a value may be off by half a level before the final rounding, so by at most one level after it.
// Only inputs that go to another node (to a rank that shares no memory with this one) are rounded, to the cheapest
// format that keeps this bound. Everything else is exact, and so are float images. The image may therefore depend on
// which ranks share a node.
struct HalfLevel {
    float maxColor = 1; // see Precision
};

// The format in which the colours of inputs travel to the owners. It also applies to inputs of the owner's own
// renderer, except with HalfLevel: otherwise the image would depend on the owner map. Rounded to nearest, ties to even.
struct Precision {
    Precision() = default;
    Precision(WireFormat colorFormat) : color(colorFormat) {} // NOLINT: meant to convert
    // The format of the colour is chosen anew for each frame: the cheapest that is sure to keep within the budget,
    // given FrameConfig::maxLayers. If there is none, it is Float32.
    Precision(const ErrorBudget& errorBudget) // NOLINT: meant to convert
        : budget(errorBudget.error), maxColor(errorBudget.maxColor)
    {
    }
    Precision(const HalfLevel& halfLevel) // NOLINT: meant to convert
        : isHalfLevel(true), maxColor(halfLevel.maxColor)
    {
    }

    WireFormat color = WireFormat::Float32; // of colour and alpha
    double budget = 0;                      // above 0: replaces `color`
    bool isHalfLevel = false;               // replaces both
    // The largest colour that occurs, as a renderer would give it before it multiplies by alpha: each channel is within
    // [0, maxColor * alpha]. A tile with other pixels, such as emission or HDR, travels as Float32.
    float maxColor = 1;
};

namespace detail {

inline std::size_t bytesOf(WireFormat format) noexcept
{
    switch (format) {
    case WireFormat::Float32: return 4;
    case WireFormat::Float16:
    case WireFormat::Unorm16: return 2;
    case WireFormat::Unorm8:
    case WireFormat::Bytes: break;
    }
    return 1;
}

// Encodes and decodes the colours of a framebuffer's fragments.
class WireCoder {
public:
    WireCoder() = default;
    // `activeByDepth`: that of the tile operation. `keepsBytes`: nobody asks fragments for Fragment::color().
    explicit WireCoder(const Precision& precision, bool activeByDepth = false, bool keepsBytes = false)
        : activeByDepth_(activeByDepth), keepsBytes_(keepsBytes), maxColor_(precision.maxColor),
          scale_(std::ldexp(1.0f, 14 - std::ilogb(precision.maxColor)))
    {
    }

    bool activeByDepth() const noexcept { return activeByDepth_; }
    // Whether colours stay in this format until a FragmentCursor reads their row.
    bool keeps(WireFormat format) const noexcept { return keepsBytes_ && format == WireFormat::Bytes; }

    // Whether pixels may travel in a format other than Float32.
    bool inRange(const float* rgba, int count) const noexcept
    {
        return DFB_FASTEST(arePixelsInRange, arePixelsInRangeAvx2, rgba, count, maxColor_);
    }

    // Encodes `count` pixels, which are in range unless the format is Float32. `out` gets 4 * bytesOf(format) bytes for
    // each.
    void encodeColor(WireFormat format, const float* rgba, int count, std::byte* out) const
    {
        const auto encode = [&](auto code, float colorScale, float alphaScale) {
            using Code = decltype(code);
            const WireScales by{colorScale, alphaScale};
            DFB_FASTEST(encodePixels<Code>, encodePixelsAvx2<Code>, rgba, count, by, out);
        };
        switch (format) {
        case WireFormat::Float32: std::memcpy(out, rgba, 4 * sizeof(float) * static_cast<std::size_t>(count)); return;
        case WireFormat::Float16: encode(HalfCode(), scale_, 0x1p15f); return;
        case WireFormat::Unorm16: encode(Unorm16Code(), 65535.0f / maxColor_, 65535.0f); return;
        case WireFormat::Unorm8: encode(Unorm8Code(), 255.0f / maxColor_, 255.0f); return;
        case WireFormat::Bytes: return; // the caller has copied them
        }
    }
    // Decodes `count` pixels. An alpha that was rounded to 0 becomes leastAlpha. It is known to have been above 0: a
    // pixel of alpha 0 that is in range has no colour, and does not travel. With activeByDepth it does travel, and an
    // alpha of 0 stays 0. Returns false if there is a code that encodeColor() does not make.
    bool decodeColor(WireFormat format, const std::byte* in, std::size_t count, float* rgba) const
    {
        const auto decode = [&](auto code, float colorScale, float alphaScale) {
            using Code = decltype(code);
            const auto pixels = static_cast<int>(count);
            const WireScales by{colorScale, alphaScale, activeByDepth_ ? 0.0f : leastAlpha};
            return DFB_FASTEST(decodePixels<Code>, decodePixelsAvx2<Code>, in, pixels, by, rgba);
        };
        switch (format) {
        case WireFormat::Float32: std::memcpy(rgba, in, 4 * sizeof(float) * count); break;
        case WireFormat::Float16: return decode(HalfCode(), 1 / scale_, 0x1p-15f);
        case WireFormat::Unorm16: return decode(Unorm16Code(), maxColor_ / 65535.0f, 1 / 65535.0f);
        case WireFormat::Unorm8: return decode(Unorm8Code(), maxColor_ / 255.0f, 1 / 255.0f);
        case WireFormat::Bytes: bytesToFloats(in, count, rgba); break;
        }
        return true;
    }

    // Above 0, less than the least alpha that has a code of its own, and negligible beside the error bound.
    static constexpr float leastAlpha = 0x1p-100f;

private:
    bool activeByDepth_ = false, keepsBytes_ = false;
    float maxColor_ = 1;
    float scale_ = 0x1p14f; // Float16: a power of two that brings maxColor to [2^14, 2^15]
};

} // namespace detail

// The most that a pixel may be off if no pixel has more than `layers` inputs in a pass, all in this format and in
// range, over a background of at most `background` in a channel. See the comment above WireFormat.
inline double wireErrorBound(WireFormat format, std::int64_t layers, double maxColor, double background)
{
    const double reach = maxColor + std::max(maxColor, background); // M + B; for alpha |1 - A|, A the alpha behind
    const double most = (1 + 0x1p-20) * std::max({reach, 1.0, background});
    const double conversion = 0x1p-21, n = static_cast<double>(layers);
    switch (format) {
    case WireFormat::Float32:
    case WireFormat::Bytes: break;
    case WireFormat::Float16: return most * (0x1p-11 / (1 - 0x1p-11) + n * 0x1p-39);
    case WireFormat::Unorm16: return most * n * (0.5 / 65535 + conversion);
    case WireFormat::Unorm8: return most * n * (0.5 / 255 + conversion);
    }
    return 0;
}

// The cheapest format whose bound is within `budget`; of two that cost the same, the one with the smaller bound. If
// `layers` is 0, it is not known, and 65536 is assumed.
inline WireFormat cheapestWithin(double budget, std::int64_t layers, double maxColor, double background)
{
    const std::int64_t most = layers > 0 ? layers : 65536;
    WireFormat best = WireFormat::Float32;
    double bound = 0;
    for (const WireFormat format : {WireFormat::Unorm16, WireFormat::Float16, WireFormat::Unorm8}) {
        const double its = wireErrorBound(format, most, maxColor, background);
        const std::size_t bytes = detail::bytesOf(format), bestBytes = detail::bytesOf(best);
        if (its <= budget && (bytes < bestBytes || (bytes == bestBytes && its < bound))) {
            best = format;
            bound = its;
        }
    }
    return best;
}

inline const char* nameOf(WireFormat format) noexcept
{
    switch (format) {
    case WireFormat::Float32: return "float32";
    case WireFormat::Float16: return "float16";
    case WireFormat::Unorm16: return "unorm16";
    case WireFormat::Unorm8: return "unorm8";
    case WireFormat::Bytes: return "bytes";
    }
    return "";
}

DFB_NAMESPACE_END
