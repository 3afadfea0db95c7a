// Adversarial: inputs of a tile that are likely to reveal faults of an operation, a format or a codec.
#pragma once

#include <dfb/testing/tile_op_test.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <random>

namespace dfb::testing {

using Random = std::mt19937_64;

inline float uniform(Random& random) { return static_cast<float>(random() >> 40) * 0x1p-24f; } // [0, 1)
inline std::size_t below(Random& random, std::size_t count) { return static_cast<std::size_t>(random() % count); }

inline constexpr float smallestDenormal = 1e-45f;

// Returns exactly 0 or 1, a value next to them, a denormal, a quarter (exact results, and ties in 8 bits), or anything.
inline float anyAlpha(Random& random)
{
    switch (below(random, 8)) {
    case 0: return 0.0f;
    case 1: return 1.0f;
    case 2: return 0x1p-24f * uniform(random);
    case 3: return std::nextafter(1.0f, 0.0f);
    case 4: return smallestDenormal * static_cast<float>(1 + below(random, 9));
    case 5: return static_cast<float>(below(random, 5)) * 0.25f;
    default: return uniform(random);
    }
}

// Returns 0 or 1, a value up to 1e30, a denormal, or one below alpha; any value below 1 if alpha is 0 (emission).
inline float anyColor(Random& random, float alpha)
{
    switch (below(random, 8)) {
    case 0: return 0.0f;
    case 1: return 1e30f * uniform(random);
    case 2: return smallestDenormal * static_cast<float>(below(random, 1000));
    case 3: return 1.0f;
    default: return alpha > 0.0f ? alpha * uniform(random) : uniform(random);
    }
}

// Returns a depth of one of 8 kinds: all equal, few values, 0 and -0, infinities, denormals, negative ones, neighbours
// in the last bit, any.
inline float anyDepth(Random& random, std::size_t kind)
{
    switch (kind) {
    case 0: return 1.0f;
    case 1: return static_cast<float>(below(random, 3));
    case 2: return below(random, 2) ? 0.0f : -0.0f;
    case 3: return below(random, 3) ? uniform(random) : std::numeric_limits<float>::infinity();
    case 4: return smallestDenormal * static_cast<float>(below(random, 4));
    case 5: return uniform(random) - 0.5f;
    case 6: return below(random, 2) ? 1e38f : std::nextafter(1.0f, below(random, 2) ? 0.0f : 2.0f);
    default: return 100.0f * uniform(random);
    }
}

// Fills random spans rather than random pixels, so that the order changes within a row but also stays for some pixels.
// `inRange`: no colour is above alpha, so that lossy formats apply.
template <class Tile>
void fillAdversarial(Tile& tile, Random& random, bool inRange = false)
{
    const auto color = [&](float alpha) { return inRange ? alpha * uniform(random) : anyColor(random, alpha); };
    const std::size_t depthKind = below(random, 8);
    const std::size_t density = below(random, 5); // 0: empty; 4: all
    const bool plain = below(random, 3) == 0;     // one colour and depth
    const float plainAlpha = anyAlpha(random), plainColor = color(plainAlpha), plainDepth = anyDepth(random, depthKind);
    for (int y = 0; y < tile.region.height(); ++y)
        for (int x = 0; x < tile.region.width();) {
            const bool active = density == 4 || below(random, 4) < density;
            const int end = std::min(tile.region.width(), x + 1 + static_cast<int>(below(random, 20)));
            for (; x < end; ++x) {
                if (!active)
                    continue;
                const float alpha = plain ? plainAlpha : anyAlpha(random);
                for (int c = 0; c < 3; ++c)
                    tile.pixel(x, y)[c] = plain ? plainColor : color(alpha);
                tile.pixel(x, y)[3] = alpha;
                tile.depth[y * Tile::size + x] = plain ? plainDepth : anyDepth(random, depthKind);
            }
        }
}

// Makes `layers` inputs of generation 1 in each pass; with `image`, one input of generation 0 instead. Some tiles lie
// at the image's border, some images have a background.
template <int Size>
TileInputs<Size> adversarial(std::uint64_t seed, int layers, int passes, bool image = false, bool inRange = false)
{
    Random random(seed);
    TileInputs<Size> in;
    if (seed % 3 == 1) { // a tile at the lower right border
        in.layout = TileLayout(Size + Size / 2 + 1, Size + 3, Size);
        in.tile = 3;
    }
    in.passes = passes;
    if (seed % 2 == 1)
        in.background = {0.25f, 1e-3f, 0.5f, uniform(random)};
    for (int pass = 0; pass < passes; ++pass)
        for (int i = 0; i < (image ? 1 : layers); ++i)
            fillAdversarial(
                in.add(pass, static_cast<std::uint32_t>(i / 2), static_cast<std::uint16_t>(i % 2), image ? 0 : 1),
                random, inRange);
    return in;
}

// Layers of one grey over that grey: all pixels are exactly 1/2, which is a tie in 8 bits, between 127 and 128.
template <int Size>
TileInputs<Size> greyLayers(std::uint64_t seed, int layers)
{
    Random random(seed);
    TileInputs<Size> in;
    in.background = {0.5f, 0.5f, 0.5f, 1};
    for (int layer = 0; layer < layers; ++layer) {
        auto& tile = in.add(0, static_cast<std::uint32_t>(layer));
        for (int i = 0; i < Size * Size; ++i) {
            const float alpha = uniform(random);
            std::fill_n(tile.color + 4 * i, 3, alpha / 2);
            tile.color[4 * i + 3] = alpha;
            tile.depth[i] = static_cast<float>(layer);
        }
    }
    return in;
}

} // namespace dfb::testing
