// The random scene with auxiliary channels: normal, albedo, position, primitive and instance id.
#pragma once

#include "random_scene.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace frame_cases {

// The auxiliary channels of a sample of the scene.
inline dfb::testing::AuxSample auxOf(const scene::Scene& s, const dfb::testing::Sample& sample, int pass, int x, int y)
{
    const std::uint64_t h = scene::mix(scene::mix(s.seed * 77 + sample.source) + static_cast<std::uint64_t>(pass) * 7919
                                       + static_cast<std::uint64_t>(y) * 65536 + static_cast<std::uint64_t>(x));
    const auto part = [h](int shift) { return static_cast<float>((h >> shift) & 0xff) / 128.0f - 1.0f; };
    dfb::testing::AuxSample a;
    for (std::size_t c = 0; c < 3; ++c) {
        const int shift = static_cast<int>(8 * c);
        a.normal[c] = sample.rgba[3] * part(shift);
        a.albedo[c] = sample.rgba[3] * std::fabs(part(shift + 24));
        a.position[c] = 10.0f * part(shift + 8);
    }
    if (h % 3 != 0) // a third of the samples have no primitive id, as in a volume
        a.primitiveId = static_cast<std::uint32_t>(h >> 40);
    a.instanceId = sample.source;
    return a;
}

template <class Tile>
void renderWithAux(const scene::Scene& s, const dfb::Brick& brick, Tile& tile)
{
    renderBrick(s, brick, tile);
    for (int y = tile.region.y0; y < tile.region.y1; ++y)
        for (int x = tile.region.x0; x < tile.region.x1; ++x)
            if (const auto sample = sampleOf(s, brick, tile.pass, x, y)) {
                const dfb::testing::AuxSample a = auxOf(s, *sample, tile.pass, x, y);
                const int i = (y - tile.region.y0) * Tile::size + x - tile.region.x0;
                std::copy(a.normal.begin(), a.normal.end(), tile.normal + 3 * i);
                std::copy(a.albedo.begin(), a.albedo.end(), tile.albedo + 3 * i);
                std::copy(a.position.begin(), a.position.end(), tile.position + 3 * i);
                tile.primitiveId[i] = a.primitiveId;
                tile.instanceId[i] = a.instanceId;
            }
}

// Number of wrong values in the auxiliary channels of an image.
inline std::size_t wrongAux(const scene::Scene& s, const dfb::Image& image)
{
    const auto expected =
        referenceOf(s, [&](auto& sample, int pass, int x, int y) { sample.aux = auxOf(s, sample, pass, x, y); });
    std::size_t wrong = 0;
    for (std::size_t i = 0; i < expected.size(); ++i) {
        const dfb::testing::Pixel& p = expected[i];
        for (std::size_t c = 0; c < 3; ++c) {
            wrong += dfb::testing::isWrongMean(image.normal()[3 * i + c], p.normal[c], p);
            wrong += dfb::testing::isWrongMean(image.albedo()[3 * i + c], p.albedo[c], p);
            wrong += image.position()[3 * i + c] != p.position.value[c];
        }
        wrong += image.primitiveId()[i] != p.primitiveId.value;
        wrong += image.instanceId()[i] != p.instanceId.value;
    }
    return wrong;
}

inline std::uint64_t hashAux(const dfb::Image& image)
{
    const std::size_t n = image.pixelCount();
    return dfb::testing::hashOf(image.rgba32f(), 16 * n) ^ 3 * dfb::testing::hashOf(image.normal(), 12 * n)
           ^ 5 * dfb::testing::hashOf(image.albedo(), 12 * n) ^ 7 * dfb::testing::hashOf(image.position(), 12 * n)
           ^ 9 * dfb::testing::hashOf(image.primitiveId(), 4 * n)
           ^ 11 * dfb::testing::hashOf(image.instanceId(), 4 * n);
}

} // namespace frame_cases
