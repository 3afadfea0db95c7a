// Wire formats: how exactly the colour of inputs travels, what that costs in accuracy, and the choice of the cheapest
// that keeps an error budget.
//
// Which channels are rounded: colour and alpha, and the bound is for these. All others travel as they are. Depth,
// positions and ids of the image are bit for bit what they would be with Float32: a pixel whose alpha was above 0
// counts for them, also if that was rounded to 0. Normals and albedo are means of the inputs' own, which count with
// their rounded alphas, so that the mean is off by what the weights are off.
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

#include <dfb/wire/wire_codes.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

namespace dfb {

enum class WireFormat : std::uint8_t {
    Float32, // what the renderer wrote
    Float16, // IEEE binary16 of what is scaled into its range
    Unorm16, // of a range that is the same on all ranks
    Unorm8
};

// An error of the float image's colour and alpha, before they are converted to the output format, that may be made: the
// greatest absolute difference of one of the four to what it would be with Float32.
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

    WireFormat color = WireFormat::Float32; // and alpha
    double budget = 0;                      // above 0: in place of `color`
    // Colours that occur, as a renderer would give them before it multiplies by alpha: each channel is within
    // [0, maxColor * alpha]. A tile of which that is not true, such as emission or HDR, travels as Float32.
    float maxColor = 1;
};

namespace detail {

inline std::size_t bytesOf(WireFormat format) noexcept
{
    return format == WireFormat::Float32 ? 4 : format == WireFormat::Unorm8 ? 1 : 2;
}

// What all fragments of a framebuffer have in common: which pixels they have, and how their colours are converted.
class WireCoder {
public:
    WireCoder() = default;
    // `activeByDepth`: of the tile operation.
    explicit WireCoder(const WirePrecision& precision, bool activeByDepth = false)
        : activeByDepth_(activeByDepth), maxColor_(precision.maxColor),
          scale_(std::ldexp(1.0f, 14 - std::ilogb(precision.maxColor)))
    {
    }

    bool activeByDepth() const noexcept { return activeByDepth_; }

    // Whether pixels may travel in a format other than Float32.
    bool inRange(const float* rgba, int count) const noexcept
    {
        return cpuHasF16c() ? arePixelsInRangeAvx2(rgba, count, maxColor_) : arePixelsInRange(rgba, count, maxColor_);
    }

    // `count` pixels, in range unless the format is Float32; `out` gets 4 * bytesOf(format) bytes for each.
    void encodeColor(WireFormat format, const float* rgba, int count, std::byte* out) const
    {
        const auto encode = [&](auto code, float colorScale, float alphaScale) {
            using Code = decltype(code);
            const WireScales by{colorScale, alphaScale};
            cpuHasF16c() ? encodePixelsAvx2<Code>(rgba, count, by, out) : encodePixels<Code>(rgba, count, by, out);
        };
        switch (format) {
        case WireFormat::Float32: std::memcpy(out, rgba, 4 * sizeof(float) * static_cast<std::size_t>(count)); return;
        case WireFormat::Float16: encode(HalfCode(), scale_, 0x1p15f); return;
        case WireFormat::Unorm16: encode(Unorm16Code(), 65535.0f / maxColor_, 65535.0f); return;
        case WireFormat::Unorm8: encode(Unorm8Code(), 255.0f / maxColor_, 255.0f); return;
        }
    }
    // An alpha of 0 becomes leastAlpha: it was above 0, as pixels of alpha 0 that are in range have no colour, and
    // those do not travel; by depth they do, and stay as they are. False if there is a code that encodeColor() does not
    // make.
    bool decodeColor(WireFormat format, const std::byte* in, std::size_t count, float* rgba) const
    {
        const auto decode = [&](auto code, float colorScale, float alphaScale) {
            using Code = decltype(code);
            const auto pixels = static_cast<int>(count);
            const WireScales by{colorScale, alphaScale, activeByDepth_ ? 0.0f : leastAlpha};
            return cpuHasF16c() ? decodePixelsAvx2<Code>(in, pixels, by, rgba)
                                : decodePixels<Code>(in, pixels, by, rgba);
        };
        switch (format) {
        case WireFormat::Float32: std::memcpy(rgba, in, 4 * sizeof(float) * count); break;
        case WireFormat::Float16: return decode(HalfCode(), 1 / scale_, 0x1p-15f);
        case WireFormat::Unorm16: return decode(Unorm16Code(), maxColor_ / 65535.0f, 1 / 65535.0f);
        case WireFormat::Unorm8: return decode(Unorm8Code(), maxColor_ / 255.0f, 1 / 255.0f);
        }
        return true;
    }

    // Not 0, less than the least alpha that has a code of its own, and nothing beside what may be off.
    static constexpr float leastAlpha = 0x1p-100f;

private:
    bool activeByDepth_ = false;
    float maxColor_ = 1;
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
