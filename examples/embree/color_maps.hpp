// Colour maps and presets by name, as short lists of control points.
#pragma once

#include "mesh.hpp"
#include "transfer_function.hpp"

#include <cstdint>
#include <string>
#include <vector>

namespace example {

// Colours as a screen shows them (sRGB, 0xRRGGBB), at equal distances.
struct ColorMap {
    const char* name;
    std::vector<std::uint32_t> colors;
    bool isDiverging; // the middle of its range is the background
};

inline const std::vector<ColorMap>& colorMaps()
{
    static const std::vector<ColorMap> maps = {
        // By van der Walt, Smith and Firing for Matplotlib, where they are in the public domain (CC0): 17 of its 256
        // colours. Between them no channel is off by more than 7 of 255.
        {"viridis",
         {0x440154, 0x48186a, 0x472d7b, 0x424086, 0x3b528b, 0x33638d, 0x2c728e, 0x26828e, 0x21918c, 0x1f9f88, 0x27ad81,
          0x3dbc74, 0x5cc863, 0x81d34d, 0xaadc32, 0xd5e21a, 0xfde725},
         false},
        {"inferno",
         {0x000004, 0x0b0724, 0x210c4a, 0x3d0965, 0x57106e, 0x71196e, 0x8a226a, 0xa32c61, 0xbc3754, 0xd04545, 0xe35933,
          0xf1711f, 0xf98c0a, 0xfcaa0f, 0xf9c932, 0xf2e865, 0xfcffa4},
         false},
        // The diverging map of K. Moreland, "Diverging Color Maps for Scientific Visualization" (2009): from (59, 76,
        // 192) over (221, 221, 221) to (180, 4, 38), by his formula, likewise.
        {"cool-warm",
         {0x3b4cc0, 0x4e68d8, 0x6282ea, 0x779af7, 0x8db0fe, 0xa3c2fe, 0xb9d0f9, 0xccd9ed, 0xdddcdc, 0xebd3c6, 0xf4c5ad,
          0xf7b194, 0xf49a7b, 0xec7f63, 0xde614d, 0xcb3e38, 0xb40426},
         true},
        {"grey", {0x202020, 0xffffff}, false},
        // Our own, for volumes of which nothing is known: from a haze to embers.
        {"ember", {0x5b7f96, 0x8fb4bf, 0xc9cfae, 0xf0c777, 0xf29a45, 0xe4602c, 0xe0703a, 0xf3a75c, 0xfff0d2}, false},
    };
    return maps;
}

// A preset for computed tomography: points at Hounsfield units, which are 0 for water and -1000 for air. Where the
// tissues lie is textbook knowledge (fat -100, muscle 50, trabecular bone from 150, compact bone from 700, enamel
// above 2000); colours and opacities are ours.
struct TissuePoint {
    float hounsfield;
    std::uint32_t color; // sRGB
    float opacity;       // of a slab as thick as 1/256 of the largest extent
};
struct TissuePreset {
    const char* name;
    std::vector<TissuePoint> points;
};

inline constexpr float leastHounsfield = -1024, greatestHounsfield = 3071;

// The last one is for volumes that look like computed tomography of a body.
inline const std::vector<TissuePreset>& tissuePresets()
{
    static const std::vector<TissuePreset> presets = {
        {"bone",
         {{-1024, 0xd8b894, 0},
          {130, 0xb8805c, 0},
          {250, 0xd8b894, 0.04f},
          {450, 0xeadcc0, 0.30f},
          {1000, 0xf6efe0, 0.75f},
          {3071, 0xffffff, 0.95f}}},
        {"soft-tissue",
         {{-1024, 0xc78d74, 0},
          {-250, 0xc78d74, 0},
          {-120, 0xd6a283, 0.015f},
          {-20, 0xcf8a6e, 0.03f},
          {60, 0xb5543f, 0.035f},
          {180, 0xc9805c, 0.05f},
          {350, 0xeadcc0, 0.35f},
          {1000, 0xf6efe0, 0.80f},
          {3071, 0xffffff, 0.95f}}},
    };
    return presets;
}

// All names that --transfer takes.
inline std::vector<std::string> transferNames()
{
    std::vector<std::string> names;
    for (const ColorMap& map : colorMaps())
        names.emplace_back(map.name);
    for (const TissuePreset& preset : tissuePresets())
        names.emplace_back(preset.name);
    return names;
}

namespace detail {

// A linear colour in sRGB.
inline Vec3 displayOf(const Vec3& linear)
{
    const auto srgb = [](float v) { return v <= 0.0031308f ? v * 12.92f : 1.055f * std::pow(v, 1 / 2.4f) - 0.055f; };
    return {srgb(linear.x), srgb(linear.y), srgb(linear.z)};
}

// Converts points from sRGB to linear RGB. Between the given points sRGB colours are interpolated linearly; added
// points keep this right within one level of 8 bits.
inline TransferPoints linearPoints(const TransferPoints& srgb)
{
    const int parts = 16;
    TransferPoints points;
    for (std::size_t i = 0; i + 1 < srgb.size(); ++i)
        for (int k = 0; k < parts + (i + 2 == srgb.size()); ++k) {
            const TransferPoint &a = srgb[i], &b = srgb[i + 1];
            const float f = static_cast<float>(k) / parts;
            const auto mix = [f](float from, float to) { return from + f * (to - from); };
            const Vec3 c = linearOf({mix(a.r, b.r), mix(a.g, b.g), mix(a.b, b.b)});
            points.push_back({mix(a.value, b.value), c.x, c.y, c.z, mix(a.opacity, b.opacity)});
        }
    return points;
}

} // namespace detail
} // namespace example
