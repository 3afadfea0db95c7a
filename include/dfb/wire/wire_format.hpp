// The formats in which colour travels: float32, or codes of 16 or 8 bits; the bound of their errors; and the choice of
// the cheapest format within an error budget.
#pragma once

#include <dfb/compiled.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

DFB_NAMESPACE_BEGIN

// Only colour and alpha are rounded, and the bound is for these. All other channels travel unchanged. Depth, positions
// and ids of the image are bit for bit those with Float32: a pixel whose alpha was above 0 counts even if its alpha was
// rounded to 0. Normals and albedo are means of the inputs' unrounded values, weighted by their rounded alphas: only
// the weights are off.
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
// adds 2^-21 (M + B) for each layer. `c <= M a` is checked in float, which multiplies all this by 1 + 2^-20.
// tests/unit/wire/wire_format.cpp searches for pixels with a larger error.

enum class WireFormat : std::uint8_t {
    Float32, // as the renderer wrote it
    Float16, // IEEE binary16, scaled into its range
    Unorm16, // integers over a range that is the same on all ranks
    Unorm8,
    Bytes // 8-bit colours as the renderer wrote them, see TileView::color8; not to be asked for
};

// The largest error that may come from rounding inputs: the absolute difference of any colour or alpha value from its
// value with Float32, in the float image, before a pixel operation and the conversion to the output format.
struct ErrorBudget {
    double error = 0;
    float maxColor = 1; // see Precision
};

// For 8-bit images: a value may be off by half a level before the final rounding, so by at most one level after it. A
// pixel operation may enlarge this error. Only inputs that go to another node (to a rank that shares no memory with
// this one) are rounded, to the cheapest format that keeps this bound. Everything else is exact, and so are float
// images. The image may therefore depend on which ranks share a node.
struct HalfLevel {
    float maxColor = 1; // see Precision
};

// The format in which the colours of inputs travel to the owners. It also applies to inputs of the owner's own
// renderer, except with HalfLevel: otherwise the image would depend on the owner map. Rounded to nearest, ties to even.
struct Precision {
    Precision() = default;
    Precision(WireFormat colorFormat) : color(colorFormat) {} // NOLINT: meant to convert
    // Each frame takes the cheapest format whose error is within the budget for FrameConfig::maxLayers layers; if there
    // is none, Float32.
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
    // The largest colour, before it is multiplied by alpha: each channel is within [0, maxColor * alpha]. A tile with
    // other pixels, such as emission or HDR, travels as Float32.
    float maxColor = 1;
};

namespace detail {

inline std::size_t bytesOf(WireFormat format) noexcept
{
    return format == WireFormat::Float32 ? 4 : format == WireFormat::Float16 || format == WireFormat::Unorm16 ? 2 : 1;
}

// Converts `count` pixels with 8 bits a channel: level / 255, rounded once.
DFB_COMPILED_ONCE void bytesToFloats(const std::byte* in, std::size_t count, float* rgba) noexcept;

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
    bool inRange(const float* rgba, int count) const noexcept;

    // Encodes `count` pixels, which are in range, in a format that rounds. `out` gets 4 * bytesOf(format) bytes for
    // each.
    void encodeColor(WireFormat format, const float* rgba, int count, std::byte* out) const;
    // Decodes `count` pixels, which are not Float32. An alpha that was rounded to 0 becomes leastAlpha. It was above 0:
    // a pixel in range with alpha 0 has no colour, and does not travel. With activeByDepth it does travel, and an alpha
    // of 0 stays 0. Returns false if there is a code that encodeColor() does not make.
    bool decodeColor(WireFormat format, const std::byte* in, std::size_t count, float* rgba) const;

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

// The cheapest format whose bound is within `budget`; of two that cost the same, the one with the smaller bound.
// `layers` 0: not known, counts as 65536.
inline WireFormat cheapestWithin(double budget, std::int64_t layers, double maxColor, double background)
{
    const auto boundOf = [&](WireFormat format) {
        return wireErrorBound(format, layers > 0 ? layers : 65536, maxColor, background);
    };
    if (boundOf(WireFormat::Unorm8) <= budget)
        return WireFormat::Unorm8;
    const bool isHalfBetter = boundOf(WireFormat::Float16) < boundOf(WireFormat::Unorm16);
    const WireFormat best = isHalfBetter ? WireFormat::Float16 : WireFormat::Unorm16;
    return boundOf(best) <= budget ? best : WireFormat::Float32;
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

#if DFB_HAS_BODIES
#include <dfb/wire/wire_kernels.hpp>

DFB_NAMESPACE_BEGIN
namespace detail {

DFB_COMPILED_ONCE void bytesToFloats(const std::byte* in, std::size_t count, float* rgba) noexcept
{
    fastest<decodeBytes>(in, count, rgba);
}

DFB_COMPILED_ONCE bool WireCoder::inRange(const float* rgba, int count) const noexcept
{
    return DFB_FASTEST(arePixelsInRange, arePixelsInRangeAvx2, rgba, count, maxColor_);
}

DFB_COMPILED_ONCE void WireCoder::encodeColor(WireFormat format, const float* rgba, int count, std::byte* out) const
{
    const auto encode = [&](auto code, float colorScale, float alphaScale) {
        using Code = decltype(code);
        const WireScales by{colorScale, alphaScale};
        DFB_FASTEST(encodePixels<Code>, encodePixelsAvx2<Code>, rgba, count, by, out);
    };
    switch (format) {
    case WireFormat::Float16: encode(HalfCode(), scale_, 0x1p15f); return;
    case WireFormat::Unorm16: encode(Unorm16Code(), 65535.0f / maxColor_, 65535.0f); return;
    case WireFormat::Unorm8: encode(Unorm8Code(), 255.0f / maxColor_, 255.0f); return;
    case WireFormat::Float32:
    case WireFormat::Bytes: return; // the caller has copied them
    }
}

DFB_COMPILED_ONCE bool WireCoder::decodeColor(WireFormat format, const std::byte* in, std::size_t count,
                                              float* rgba) const
{
    const auto decode = [&](auto code, float colorScale, float alphaScale) {
        using Code = decltype(code);
        const auto pixels = static_cast<int>(count);
        const WireScales by{colorScale, alphaScale, activeByDepth_ ? 0.0f : leastAlpha};
        return DFB_FASTEST(decodePixels<Code>, decodePixelsAvx2<Code>, in, pixels, by, rgba);
    };
    switch (format) {
    case WireFormat::Float16: return decode(HalfCode(), 1 / scale_, 0x1p-15f);
    case WireFormat::Unorm16: return decode(Unorm16Code(), maxColor_ / 65535.0f, 1 / 65535.0f);
    case WireFormat::Unorm8: return decode(Unorm8Code(), maxColor_ / 255.0f, 1 / 255.0f);
    case WireFormat::Bytes: bytesToFloats(in, count, rgba); break;
    case WireFormat::Float32: break; // the caller reads them in place
    }
    return true;
}

} // namespace detail
DFB_NAMESPACE_END
#endif
