// Dither: conversion to 8 bit that leaves no bands in gradients. Each pixel's place in the image says from which part
// of the way between two levels on it takes the upper one, so that the mean over neighbours is what no level is.
//
// The thresholds are those of B. E. Bayer, "An optimum method for two-level rendition of continuous-tone pictures",
// IEEE Intl. Conf. on Communications 1973: each of (rank + 1/2) / 64 once in any 8x8 pixels. Unlike noise they keep the
// mean over every such block, and are made of integers alone. Colours are rounded to float first: then each step is
// exact, and an image of floats gets the same levels. All channels of a pixel have one threshold, so grey stays grey
// and what is less in one channel does not become more.
#pragma once

#include <dfb/image.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>

namespace dfb {

namespace detail {

// 0 to 63: the bits of x ^ y and y in turn, the lowest in front.
constexpr int ditherRank(int x, int y) noexcept
{
    int rank = 0;
    for (int bit = 0; bit < 3; ++bit)
        rank = 4 * rank + 2 * (((x ^ y) >> bit) & 1) + ((y >> bit) & 1);
    return rank;
}

// The level at or below `value`, or the next if it is more than `threshold` of the way there. Clamped; NaN gives 0.
inline int ditherUnorm8(float value, double threshold) noexcept
{
    if (!(value > 0.0f))
        return 0;
    if (value >= 1.0f)
        return 255;
    const double scaled = 255.0 * static_cast<double>(value);
    const int below = static_cast<int>(scaled);
    return below + (scaled - below > threshold ? 1 : 0);
}

// The same for an sRGB level. The way is that of light, so that the mean is right for an eye that sees no single pixel;
// in levels it differs by less than 1/128.
inline int ditherSrgb8(float value, double threshold)
{
    static const std::array<double, 256> light = [] {
        std::array<double, 256> levels{};
        for (int k = 0; k < 256; ++k)
            levels[static_cast<std::size_t>(k)] = srgbInverse(2 * k).high;
        return levels;
    }();
    if (!(value > 0.0f))
        return 0;
    if (value >= 1.0f)
        return 255;
    const auto linear = static_cast<double>(value);
    std::size_t below = toSrgb8(linear);
    below -= linear < light[below] ? 1 : 0;
    const bool isAbove = linear - light[below] > threshold * (light[below + 1] - light[below]);
    return static_cast<int>(below) + (isAbove ? 1 : 0);
}

} // namespace detail

// convertPixels() with dithered colour, if the format has 8 bits; (x, y) is where the first pixel is in the image.
// Alpha is rounded as ever. A colour that is at most alpha gets at most the level to which alpha would be rounded as
// such a colour (of two that are equally near, the lower), so that in RGBA8 it stays at most alpha; that puts it off by
// half a level at most. Returns of alpha alone how far the farthest value was from a level.
template <class Real>
double ditherPixels(const Real* rgba, int count, OutputFormat format, int x, int y, std::byte* out)
{
    if (format != OutputFormat::RGBA8 && format != OutputFormat::SRGBA8)
        return convertPixels(rgba, count, format, out);
    const bool isSrgb = format == OutputFormat::SRGBA8;
    auto* bytes = reinterpret_cast<std::uint8_t*>(out);
    double farthest = 0;
    for (int i = 0; i < count; ++i, rgba += 4, bytes += 4) {
        const double threshold = (detail::ditherRank(x + i, y) + 0.5) / 64, exactAlpha = rgba[3];
        farthest = std::max(farthest, detail::toUnorm8(&exactAlpha, 1, bytes + 3));
        const auto alpha = static_cast<float>(rgba[3]);
        // A tie may yet be decided either way, with more digits.
        const int most = isSrgb ? detail::toSrgb8(static_cast<double>(alpha)) : detail::ditherUnorm8(alpha, 0.5001);
        for (int c = 0; c < 3; ++c) {
            const auto value = static_cast<float>(rgba[c]);
            const int level = isSrgb ? detail::ditherSrgb8(value, threshold) : detail::ditherUnorm8(value, threshold);
            bytes[c] = static_cast<std::uint8_t>(value <= alpha ? std::min(level, most) : level);
        }
    }
    return farthest;
}

} // namespace dfb
