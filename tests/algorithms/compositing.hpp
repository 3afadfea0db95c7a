// Operations on layers: auxiliary channels, blending in a given order, the nearest.
#pragma once

#include "everywhere.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <tuple>
#include <utility>

namespace algorithms {

using dfb::testing::Exact;

// ---- auxiliary channels ----------------------------------------------------------------------------------------

struct AuxSample {
    std::array<float, 3> normal{}, albedo{}, position{};
    std::uint32_t primitive = dfb::noId, instance = dfb::noId;
};

// What a sample of the scene has beside colour and depth.
inline AuxSample auxOf(const scene::Scene& s, const dfb::testing::Sample& sample, int pass, int x, int y)
{
    const std::uint64_t h = scene::mix(scene::mix(s.seed * 77 + sample.source) + static_cast<std::uint64_t>(pass) * 7919
                                       + static_cast<std::uint64_t>(y) * 65536 + static_cast<std::uint64_t>(x));
    const auto part = [h](int shift) { return static_cast<float>((h >> shift) & 0xff) / 128.0f - 1.0f; };
    AuxSample a;
    for (std::size_t c = 0; c < 3; ++c) {
        const int shift = static_cast<int>(8 * c);
        a.normal[c] = sample.rgba[3] * part(shift);
        a.albedo[c] = sample.rgba[3] * std::fabs(part(shift + 24));
        a.position[c] = 10.0f * part(shift + 8);
    }
    if (h % 3 != 0) // a volume has none
        a.primitive = static_cast<std::uint32_t>(h >> 40);
    a.instance = sample.source;
    return a;
}

struct AuxPixel {
    std::array<Exact, 3> normal{}, albedo{};
    Exact weight = 0;
    float depth = std::numeric_limits<float>::infinity();
    std::array<float, 3> position{};
    std::uint32_t primitive = dfb::noId, instance = dfb::noId;
};

// Pixel by pixel, by the rules of channels.hpp.
inline AuxPixel auxReference(const scene::Scene& s, int x, int y)
{
    AuxPixel p;
    float primitiveDepth = 0, instanceDepth = 0;
    for (int pass = 0; pass < s.passes; ++pass) {
        std::vector<dfb::testing::Sample> samples;
        for (const dfb::Brick& brick : s.bricks)
            if (const auto sample = sampleOf(s, brick, pass, x, y))
                samples.push_back(*sample);
        std::sort(samples.begin(), samples.end(), [](const auto& a, const auto& b) {
            return std::tie(a.depth, a.source) < std::tie(b.depth, b.source);
        });
        Exact through = 1;
        bool hasPrimitive = false, hasInstance = false;
        for (const auto& sample : samples) {
            const AuxSample a = auxOf(s, sample, pass, x, y);
            const float alpha = sample.rgba[3];
            for (std::size_t c = 0; c < 3; ++c) {
                p.normal[c] += through * static_cast<Exact>(a.normal[c]);
                p.albedo[c] += through * static_cast<Exact>(a.albedo[c]);
            }
            p.weight += through * static_cast<Exact>(alpha);
            through *= 1 - static_cast<Exact>(alpha);
            if (!(alpha > 0))
                continue;
            if (sample.depth < p.depth) {
                p.depth = sample.depth;
                p.position = a.position;
            }
            if (a.primitive != dfb::noId && !hasPrimitive) {
                hasPrimitive = true;
                if (p.primitive == dfb::noId || sample.depth < primitiveDepth) {
                    p.primitive = a.primitive;
                    primitiveDepth = sample.depth;
                }
            }
            if (!hasInstance) {
                hasInstance = true;
                if (p.instance == dfb::noId || sample.depth < instanceDepth) {
                    p.instance = a.instance;
                    instanceDepth = sample.depth;
                }
            }
        }
    }
    return p;
}

template <class Tile>
void renderWithAux(const scene::Scene& s, const dfb::Brick& brick, Tile& tile)
{
    renderBrick(s, brick, tile);
    for (int y = tile.region.y0; y < tile.region.y1; ++y)
        for (int x = tile.region.x0; x < tile.region.x1; ++x)
            if (const auto sample = sampleOf(s, brick, tile.pass, x, y)) {
                const AuxSample a = auxOf(s, *sample, tile.pass, x, y);
                const int i = (y - tile.region.y0) * Tile::size + x - tile.region.x0;
                std::copy(a.normal.begin(), a.normal.end(), tile.normal + 3 * i);
                std::copy(a.albedo.begin(), a.albedo.end(), tile.albedo + 3 * i);
                std::copy(a.position.begin(), a.position.end(), tile.position + 3 * i);
                tile.primitiveId[i] = a.primitive;
                tile.instanceId[i] = a.instance;
            }
}

// Values of the image that are off.
inline std::size_t wrongAux(const scene::Scene& s, const dfb::Image& image)
{
    std::size_t wrong = 0;
    for (int y = 0; y < s.height; ++y)
        for (int x = 0; x < s.width; ++x) {
            const auto i =
                static_cast<std::size_t>(y) * static_cast<std::size_t>(s.width) + static_cast<std::size_t>(x);
            const AuxPixel p = auxReference(s, x, y);
            for (std::size_t c = 0; c < 3; ++c) {
                // Normals have either sign: what cancels is off by the rounding of what was summed.
                const auto expected = [&](Exact sum) {
                    return p.weight > 0 ? static_cast<double>(sum / p.weight) : 0.0;
                };
                const auto off = [](float got, double want) {
                    return !(std::fabs(static_cast<double>(got) - want) <= 1e-12 + 0x1p-24 * std::fabs(want));
                };
                wrong += off(image.normal()[3 * i + c], expected(p.normal[c]));
                wrong += off(image.albedo()[3 * i + c], expected(p.albedo[c]));
                wrong += image.position()[3 * i + c] != p.position[c];
            }
            wrong += image.primitiveId()[i] != p.primitive;
            wrong += image.instanceId()[i] != p.instance;
        }
    return wrong;
}

inline std::uint64_t hashAux(const dfb::Image& image)
{
    const std::size_t n = image.pixelCount();
    return dfb::testing::hashOf(image.rgba32f(), 16 * n) ^ 3 * dfb::testing::hashOf(image.normal(), 12 * n)
           ^ 5 * dfb::testing::hashOf(image.albedo(), 12 * n) ^ 7 * dfb::testing::hashOf(image.position(), 12 * n)
           ^ 9 * dfb::testing::hashOf(image.primitiveId(), 4 * n) ^ 11 * dfb::testing::hashOf(image.instanceId(), 4 * n);
}

struct AuxChannels {
    template <class Transport>
    static Result run(const typename Transport::Communicator& communicator)
    {
        using Op = dfb::BasicAlphaBlend<16, dfb::allChannels & ~dfb::farChannel>;
        Result result;
        for (const int passes : {1, 3}) {
            const scene::Scene s = scene::makeScene(7, 5, 61, 47, passes);
            auto config = configOf(s, 2);
            config.aux = dfb::imageAuxChannels;
            dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, Transport> fb(communicator, config);
            const dfb::World world(bricksOf(s, fb.rank(), fb.size()));
            for (int frame = 0; frame < 2; ++frame) {
                const auto report = dfb::renderDataParallel(
                    fb, world, scene::FlatCamera(), [&](const dfb::Brick& b, auto& tile) { renderWithAux(s, b, tile); },
                    paramsOf(s));
                if (!fb.isDisplayRank())
                    continue;
                const scene::Picture picture(fb.image(), report);
                result.expect(wrongValues(picture, referenceOf(s)) == 0, "colour or depth");
                const std::size_t wrong = wrongAux(s, fb.image());
                result.expect(wrong == 0, std::to_string(wrong) + " values of auxiliary channels");
                result.hash = result.hash * 31 + hashAux(fb.image());
            }
        }
        return result;
    }
};

// One that all ranks have, and that a pixel operation sees.
struct AuxImageParallel {
    struct SeeAux {
        std::atomic<std::int64_t>* pixels = nullptr;
        void process(dfb::PixelTile& tile) const
        {
            for (std::size_t i = 0; i < tile.pixelCount(); ++i)
                *pixels += tile.aux.instanceId[i] != dfb::noId && tile.aux.normal != nullptr;
        }
    };

    template <class Transport>
    static Result run(const typename Transport::Communicator& communicator)
    {
        using Op = dfb::BasicImageParallel<16, dfb::allChannels & ~dfb::farChannel>;
        Result result;
        scene::Scene s = scene::makeScene(1, 3, 61, 47, 2);
        s.bricks[0].bounds = {{0, 0, 0}, {61, 47, 1}};
        auto config = configOf(s, 2);
        config.aux = dfb::imageAuxChannels;
        std::atomic<std::int64_t> seen{0};
        dfb::DistributedFrameBuffer<Op, SeeAux, Transport> fb(communicator, config, {&seen});
        dfb::renderImageParallel(
            fb, [&](auto& tile) { renderWithAux(s, s.bricks[0], tile); }, paramsOf(s));
        const std::int64_t all = fb.allReduce({seen.load()}, decltype(fb)::Reduce::Sum).front();
        if (fb.isDisplayRank()) {
            const std::size_t wrong = wrongAux(s, fb.image());
            result.expect(wrong == 0, std::to_string(wrong) + " values of auxiliary channels");
            std::int64_t withId = 0;
            for (std::size_t i = 0; i < fb.image().pixelCount(); ++i)
                withId += fb.image().instanceId()[i] != dfb::noId;
            result.expect(all == withId && all > 1000, "the pixel operation saw " + std::to_string(all) + " pixels");
            result.hash = hashAux(fb.image());
        }
        return result;
    }
};

// ---- the nearest -----------------------------------------------------------------------------------------------

struct Nearest {
    template <class Transport>
    static Result run(const typename Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(8, 9, 97, 61, 2);
        dfb::DistributedFrameBuffer<dfb::BasicDepthComposite<16>, dfb::NoPixelOp, Transport> fb(communicator,
                                                                                                configOf(s, 2));
        const auto report = dfb::renderDataParallel(
            fb, dfb::World(bricksOf(s, fb.rank(), fb.size(), 3)), scene::FlatCamera(),
            [&](const dfb::Brick& b, auto& tile) { renderBrick(s, b, tile); }, paramsOf(s));
        if (!fb.isDisplayRank())
            return result;
        std::vector<dfb::testing::Pixel> expected;
        for (int y = 0; y < s.height; ++y)
            for (int x = 0; x < s.width; ++x) {
                std::vector<dfb::testing::Pixel> passes;
                for (int pass = 0; pass < s.passes; ++pass) {
                    std::vector<dfb::testing::Sample> nearest;
                    for (const dfb::Brick& brick : s.bricks)
                        if (const auto sample = sampleOf(s, brick, pass, x, y)) {
                            const bool seen = std::any_of(sample->rgba.begin(), sample->rgba.end(),
                                                          [](float v) { return v != 0.0f; });
                            if (seen && (nearest.empty() || sample->depth < nearest[0].depth))
                                nearest = {*sample};
                        }
                    passes.push_back(dfb::testing::composite(nearest, s.background));
                }
                expected.push_back(dfb::testing::mean(passes));
            }
        const scene::Picture picture(fb.image(), report);
        const std::size_t wrong = wrongValues(picture, expected);
        result.expect(wrong == 0, std::to_string(wrong) + " values");
        result.hash = picture.hash();
        return result;
    }
};

// In compositing.cpp, so that the tests over MPI need not compile them again.
extern template Result inProcess<AuxChannels>(int);
extern template Result inProcess<AuxImageParallel>(int);
extern template Result inProcess<Nearest>(int);

} // namespace algorithms

#if !defined(ALGORITHMS_WITHOUT_TESTS)
TEST_CASE("Auxiliary channels come out by their rules, composited", "[compositing]")
{
    everywhere<algorithms::AuxChannels>();
}

TEST_CASE("Auxiliary channels come out by their rules, image-parallel, and pixel operations see them", "[compositing]")
{
    everywhere<algorithms::AuxImageParallel>();
}

TEST_CASE("DepthComposite keeps the nearest input of each pixel", "[compositing]")
{
    everywhere<algorithms::Nearest>();
}
#endif
