// Wire formats: how exactly colour and depth travel, what that costs in accuracy, and the choice of the cheapest that
// keeps an error budget.
//
// The bound. A pixel is C = sum_j T_j c_j, with T_j the product of 1 - a_i over the layers i in front of j, the last
// layer being the background. Rounded, layer j has c_j + d_j and a_j + e_j. Replace the layers by the rounded ones one
// after the other from the front: the step at j changes the pixel by T'_j (d_j - e_j B_j), where T'_j is of the rounded
// layers in front and B_j what is behind j, as it was. So
//
//     |error| <= sum_j T'_j (|d_j| + |e_j| B),    B >= |B_j|
//
// If colours are within [0, M a] and a in [0, 1], what is behind is a mean of colours up to M and of the background:
// B = max(M, background). Alpha itself is the same sum with 1 in place of M.
//   Unorm of n bits: |d| <= M h, |e| <= h, h = 1 / (2 (2^n - 1)): each of the n layers adds up to h (M + B).
//   Float16:         |d| <= u c, |e| <= u a, u = 2^-11, and sum_j T'_j a'_j <= 1: u / (1 - u) (M + B), however many
//                    layers there are. Values below 2^-28 M are denormal there: 2^-39 (M + B) more for each layer.
// A mean of passes is no worse than its worst pass. Unorm is converted in float, four roundings of 2^-24 M: 2^-21 (M +
// B) more for each layer. And `c <= M a` is checked in float: 1 + 2^-20 times all that. tests/unit/wire_format.cpp
// looks for pixels that are worse, also at the edges.
#pragma once

#include <dfb/version.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>

namespace dfb {

enum class WireFormat : std::uint8_t {
    Float32, // what the renderer wrote
    Float16, // IEEE binary16 of what is scaled into its range
    Unorm16, // of a range that is the same on all ranks
    Unorm8
};

// An error of the float image, before it is converted to its output format, that may be made: the greatest absolute
// difference of a channel to what it would be with Float32.
struct ErrorBudget {
    double error = 0;
    float maxColor = 1; // see WirePrecision
};

// How inputs travel to the tiles' owners; and to a tile of the same rank as well, or else the image would depend on who
// owns what. Rounded to nearest, ties to even.
struct WirePrecision {
    WirePrecision() = default;
    WirePrecision(WireFormat colorFormat) : color(colorFormat) {} // NOLINT: meant to convert
    // The format of the colour is chosen anew for each frame: the cheapest that is sure to keep within the budget,
    // given FrameParams::maxLayers. Where nothing is, Float32.
    WirePrecision(const ErrorBudget& errorBudget) // NOLINT: meant to convert
        : budget(errorBudget.error), maxColor(errorBudget.maxColor)
    {
    }

    // An alpha that is rounded to 0 no longer counts for the image's depth.
    WireFormat color = WireFormat::Float32;
    double budget = 0; // above 0: in place of `color`
    // Colours that occur, as a renderer would give them before it multiplies by alpha: each channel is within
    // [0, maxColor * alpha]. A tile of which that is not true, such as emission or HDR, travels as Float32.
    float maxColor = 1;
    // Rounding keeps the order of depths, but may make different ones equal; pixels in which that could matter are
    // counted in FrameReport::orderUndefinedPixels. The image's depth is rounded as well. Never chosen by the budget.
    WireFormat depth = WireFormat::Float32;
    float depthNear = 0, depthFar = 1; // of the Unorm formats; depths outside become these, infinity stays
};

namespace detail {

inline std::size_t bytesOf(WireFormat format) noexcept
{
    return format == WireFormat::Float32 ? 4 : format == WireFormat::Unorm8 ? 1 : 2;
}

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

// To the nearest binary16, ties to even; what is too large is infinity. NaN stays one.
inline std::uint16_t toHalf(float value) noexcept
{
    const std::uint32_t bits = bitsOf(value), sign = bits >> 16 & 0x8000u, magnitude = bits & 0x7fffffffu;
    // Denormal there: adding 0.5 leaves the bits that stay at the end of the mantissa, rounded by the addition.
    const std::uint32_t small = bitsOf(floatOf(magnitude) + 0.5f) - 0x3f000000u;
    const std::uint32_t normal = (magnitude + 0xc8000fffu + (magnitude >> 13 & 1u)) >> 13;
    const std::uint32_t large = magnitude > 0x7f800000u ? 0x7e00u : 0x7c00u;
    const std::uint32_t finite = magnitude < 0x38800000u ? small : normal;
    return static_cast<std::uint16_t>(sign | (magnitude >= 0x47800000u ? large : finite));
}

inline float fromHalf(std::uint16_t half) noexcept
{
    const std::uint32_t sign = static_cast<std::uint32_t>(half & 0x8000u) << 16, rest = half & 0x7fffu;
    const float finite = floatOf(rest << 13) * 0x1p112f; // exact
    const std::uint32_t bits = rest >= 0x7c00u ? 0x7f800000u | rest << 13 : bitsOf(finite);
    return floatOf(sign | bits);
}

// The same for numbers from 0 to 65504, in a form that can be vectorized.
inline std::uint16_t positiveToHalf(float value) noexcept
{
    const auto bits = static_cast<std::int32_t>(bitsOf(value));
    const auto small = static_cast<std::int32_t>(bitsOf(value + 0.5f) - 0x3f000000u);
    const std::int32_t normal = (bits - 0x37fff001 + (bits >> 13 & 1)) >> 13;
    return static_cast<std::uint16_t>(bits < 0x38800000 ? small : normal);
}
inline float positiveFromHalf(std::uint16_t half) noexcept { return floatOf((half & 0x7fffu) << 13) * 0x1p112f; }

// To the nearest integer, ties to even, of a value within [0, 65535].
inline std::uint32_t nearestInteger(float value) noexcept
{
    return bitsOf(value + 0x1p23f) & 0x7fffffu; // the addition leaves no bit below one
}

// Converts colour and depth of one framebuffer's fragments.
class WireCoder {
public:
    WireCoder() = default;
    explicit WireCoder(const WirePrecision& precision)
        : depth_(precision.depth), maxColor_(precision.maxColor), near_(precision.depthNear), far_(precision.depthFar),
          scale_(std::ldexp(1.0f, 14 - std::ilogb(precision.maxColor)))
    {
    }

    WireFormat depth() const noexcept { return depth_; }

    // Whether pixels may travel in a format other than Float32. No branch, so that it can be vectorized.
    bool inRange(const float* rgba, int count) const noexcept
    {
        int out = 0;
        for (int i = 0; i < count; ++i) {
            const float alpha = rgba[4 * i + 3], most = maxColor_ * alpha;
            for (int c = 0; c < 3; ++c)
                out |= static_cast<int>(!(rgba[4 * i + c] >= 0.0f)) | static_cast<int>(!(rgba[4 * i + c] <= most));
            out |= static_cast<int>(!(alpha >= 0.0f)) | static_cast<int>(!(alpha <= 1.0f));
        }
        return out == 0;
    }

    // `count` pixels, in range unless the format is Float32; `out` gets 4 * bytesOf(format) bytes for each.
    void encodeColor(WireFormat format, const float* rgba, int count, std::byte* out) const
    {
        switch (format) {
        case WireFormat::Float32: std::memcpy(out, rgba, 4 * sizeof(float) * static_cast<std::size_t>(count)); return;
        case WireFormat::Float16:
            encode<std::uint16_t>(rgba, count, out, scale_, 0x1p15f, [](float v) { return positiveToHalf(v); });
            return;
        case WireFormat::Unorm16:
            encode<std::uint16_t>(rgba, count, out, 65535.0f / maxColor_, 65535.0f,
                                  [](float v) { return nearestInteger(v); });
            return;
        case WireFormat::Unorm8:
            encode<std::uint8_t>(rgba, count, out, 255.0f / maxColor_, 255.0f,
                                 [](float v) { return nearestInteger(v); });
            return;
        }
    }
    void decodeColor(WireFormat format, const std::byte* in, std::size_t count, float* rgba) const
    {
        switch (format) {
        case WireFormat::Float32: std::memcpy(rgba, in, 4 * sizeof(float) * count); return;
        case WireFormat::Float16:
            decode<std::uint16_t>(in, count, rgba, 1 / scale_, 0x1p-15f,
                                  [](std::uint16_t v) { return positiveFromHalf(v); });
            return;
        case WireFormat::Unorm16:
            decode<std::uint16_t>(in, count, rgba, maxColor_ / 65535.0f, 1 / 65535.0f,
                                  [](std::uint16_t v) { return static_cast<float>(v); });
            return;
        case WireFormat::Unorm8:
            decode<std::uint8_t>(in, count, rgba, maxColor_ / 255.0f, 1 / 255.0f,
                                 [](std::uint8_t v) { return static_cast<float>(v); });
            return;
        }
    }

    // Not NaN. The order of two depths stays, or they become equal.
    void encodeDepth(WireFormat format, const float* depth, int count, std::byte* out) const
    {
        switch (format) {
        case WireFormat::Float32: std::memcpy(out, depth, sizeof(float) * static_cast<std::size_t>(count)); return;
        case WireFormat::Float16:
            for (int i = 0; i < count; ++i)
                put(out, i, toHalf(depth[i]));
            return;
        case WireFormat::Unorm16:
            for (int i = 0; i < count; ++i)
                put(out, i, static_cast<std::uint16_t>(depthCode(depth[i], 65534.0f)));
            return;
        case WireFormat::Unorm8:
            for (int i = 0; i < count; ++i)
                put(out, i, static_cast<std::uint8_t>(depthCode(depth[i], 254.0f)));
            return;
        }
    }
    void decodeDepth(WireFormat format, const std::byte* in, std::size_t count, float* depth) const
    {
        switch (format) {
        case WireFormat::Float32: std::memcpy(depth, in, sizeof(float) * count); return;
        case WireFormat::Float16:
            for (std::size_t i = 0; i < count; ++i)
                depth[i] = fromHalf(get<std::uint16_t>(in, i));
            return;
        case WireFormat::Unorm16:
            for (std::size_t i = 0; i < count; ++i)
                depth[i] = depthOf(get<std::uint16_t>(in, i), 65534.0f);
            return;
        case WireFormat::Unorm8:
            for (std::size_t i = 0; i < count; ++i)
                depth[i] = depthOf(get<std::uint8_t>(in, i), 254.0f);
            return;
        }
    }

private:
    template <class Code>
    static void put(std::byte* out, int i, Code code) noexcept
    {
        std::memcpy(out + sizeof code * static_cast<std::size_t>(i), &code, sizeof code);
    }
    template <class Code>
    static Code get(const std::byte* in, std::size_t i) noexcept
    {
        Code code = 0;
        std::memcpy(&code, in + sizeof code * i, sizeof code);
        return code;
    }

    // Colour and alpha have scales of their own.
    template <class Code, class ToCode>
    static void encode(const float* rgba, int count, std::byte* out, float colorScale, float alphaScale,
                       const ToCode& toCode)
    {
        const float scales[4] = {colorScale, colorScale, colorScale, alphaScale};
        Code codes[4 * block]; // bytes could alias what they are made of
        for (int first = 0; first < count; first += block) {
            const int size = std::min(block, count - first);
            const float* from = rgba + 4 * first;
            for (int i = 0; i < size; ++i)
                for (int c = 0; c < 4; ++c)
                    codes[4 * i + c] = static_cast<Code>(toCode(from[4 * i + c] * scales[c]));
            std::memcpy(out + 4 * sizeof(Code) * static_cast<std::size_t>(first), codes,
                        4 * sizeof(Code) * static_cast<std::size_t>(size));
        }
    }
    template <class Code, class FromCode>
    static void decode(const std::byte* in, std::size_t count, float* rgba, float colorScale, float alphaScale,
                       const FromCode& fromCode)
    {
        const float scales[4] = {colorScale, colorScale, colorScale, alphaScale};
        Code codes[4 * block];
        for (std::size_t first = 0; first < count; first += block) {
            const std::size_t size = std::min<std::size_t>(block, count - first);
            std::memcpy(codes, in + 4 * sizeof(Code) * first, 4 * sizeof(Code) * size);
            float* to = rgba + 4 * first;
            for (std::size_t i = 0; i < size; ++i)
                for (std::size_t c = 0; c < 4; ++c)
                    to[4 * i + c] = fromCode(codes[4 * i + c]) * scales[c];
        }
    }
    static constexpr int block = 64; // pixels

    // 0 to `most`; infinity is most + 1.
    std::uint32_t depthCode(float depth, float most) const noexcept
    {
        const float place = std::min(std::max((depth - near_) / (far_ - near_), 0.0f), 1.0f);
        return depth == std::numeric_limits<float>::infinity() ? static_cast<std::uint32_t>(most) + 1
                                                               : nearestInteger(place * most);
    }
    float depthOf(std::uint32_t code, float most) const noexcept
    {
        return code > static_cast<std::uint32_t>(most) ? std::numeric_limits<float>::infinity()
                                                       : near_ + (far_ - near_) * (static_cast<float>(code) / most);
    }

    WireFormat depth_ = WireFormat::Float32;
    float maxColor_ = 1, near_ = 0, far_ = 1;
    float scale_ = 0x1p14f; // Float16: a power of two that brings maxColor to [2^14, 2^15]
};

} // namespace detail

// The most that a pixel may be off if no pixel has more than `layers` inputs in a pass, all in this format and in
// range, over a background of at most `background` in a channel. See the top of this file.
inline double wireErrorBound(WireFormat format, std::int64_t layers, double maxColor, double background)
{
    const double reach = maxColor + std::max(maxColor, background); // M + B; of alpha |1 - A|, A being what is behind
    const double most = (1 + 0x1p-20) * std::max({reach, 1.0, background});
    const double conversion = 0x1p-21, n = static_cast<double>(layers);
    switch (format) {
    case WireFormat::Float32: break;
    case WireFormat::Float16: return most * (0x1p-11 / (1 - 0x1p-11) + n * 0x1p-39);
    case WireFormat::Unorm16: return most * n * (0.5 / 65535 + conversion);
    case WireFormat::Unorm8: return most * n * (0.5 / 255 + conversion);
    }
    return 0;
}

// The cheapest format whose bound is within `budget`; of two that cost the same, the better. `layers` 0: not
// known, which is taken for 65536.
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
    }
    return "";
}

} // namespace dfb
