// FragmentCompositor: rows of fragments in order, beside a fold of each pixel by itself.
#include "catch.hpp"

#include <dfb/blend/fragment_compositor.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <random>
#include <vector>

namespace fragment_compositor_cases {

namespace {

constexpr float infinity = std::numeric_limits<float>::infinity();
constexpr int width = 150, height = 12;

// The pixels of a fragment, in spans of about so many.
struct Pixels {
    std::vector<float> colors = std::vector<float>(4 * width * height), depths = std::vector<float>(width * height);

    Pixels(std::mt19937& random, unsigned span, bool isOpaque)
    {
        bool isThere = false;
        for (std::size_t i = 0; i < depths.size(); ++i) {
            if (random() % span == 0)
                isThere = !isThere;
            const float alpha = isOpaque ? 1.0f : static_cast<float>(random() % 1000) / 1000.0f;
            for (std::size_t c = 0; c < 4 && isThere; ++c)
                colors[4 * i + c] = c == 3 ? alpha : static_cast<float>(random() % 1000) / 999.0f;
            depths[i] = static_cast<float>(random() % 9);
        }
    }

    dfb::Fragment fragment(bool hasDepth) const
    {
        dfb::TileHeader header;
        header.region = {0, 0, width, height};
        dfb::Fragment::Parts parts;
        parts.encoding = dfb::FragmentEncoding::InPlace;
        parts.channels = hasDepth ? dfb::colorChannel | dfb::depthChannel : dfb::colorChannel;
        parts.inPlace.color = reinterpret_cast<const std::byte*>(colors.data());
        parts.inPlace.depth = hasDepth ? depths.data() : nullptr;
        parts.inPlace.stride = width;
        parts.inPlace.valid = header.region;
        return dfb::Fragment(header, dfb::Buffer(), parts);
    }
    bool isActive(std::size_t pixel) const
    {
        return std::any_of(&colors[4 * pixel], &colors[4 * pixel] + 4, [](float value) { return value != 0; });
    }
};

struct Folded {
    double rgba[4] = {0, 0, 0, 0}, transmittance = 1;
    float depth = infinity;
    int layers = 0;
};

Folded fold(const std::vector<Pixels>& inputs, std::size_t pixel, double minTransmittance)
{
    Folded result;
    for (const Pixels& input : inputs) {
        if (!input.isActive(pixel))
            continue;
        ++result.layers;
        const float* color = &input.colors[4 * pixel];
        for (int c = 0; c < 4; ++c)
            result.rgba[c] += result.transmittance * static_cast<double>(color[c]);
        result.transmittance *= 1.0 - static_cast<double>(color[3]);
        if (result.transmittance < minTransmittance)
            result.transmittance = 0;
        if (color[3] > 0)
            result.depth = std::min(result.depth, input.depths[pixel]);
    }
    return result;
}

} // namespace

TEST_CASE("Fragments in order are folded pixel by pixel, in long runs and in short ones", "[compositing]")
{
    std::mt19937 random(11);
    for (int round = 0; round < 60; ++round) {
        const unsigned span = round % 3 == 0 ? 4 : round % 3 == 1 ? 20 : 100;
        const bool hasDepth = round % 4 == 1, wantsGaps = round % 5 < 2;
        const double least = round % 7 == 0 ? 0.05 : 0;
        std::vector<Pixels> inputs;
        std::vector<dfb::Fragment> fragments;
        std::vector<const dfb::Fragment*> pointers;
        for (int k = 0; k < 2 + round % 11; ++k)
            inputs.emplace_back(random, span, round % 6 == 5 && k == 3);
        for (const Pixels& input : inputs)
            fragments.push_back(input.fragment(hasDepth));
        for (const dfb::Fragment& fragment : fragments)
            pointers.push_back(&fragment);
        dfb::FragmentCompositor compositor;
        compositor.start(dfb::BlendRule::InOrder, pointers.begin(), pointers.end());
        dfb::CompositeRow row;
        row.wantsDepth = hasDepth;
        row.wantsGaps = wantsGaps;
        row.wantsSingles = wantsGaps;
        row.minTransmittance = least;
        row.resize(width);
        for (std::size_t y = 0; y < height; ++y) {
            compositor.nextRow(row);
            std::vector<const dfb::FragmentCompositor::Run*> runOf(width);
            int end = 0;
            for (const auto& run : compositor.runs()) {
                CHECK(run.x >= end);
                end = run.x + run.count;
                REQUIRE(end <= width);
                std::fill_n(runOf.begin() + run.x, run.count, &run);
            }
            for (std::size_t x = 0; x < width; ++x) {
                const Folded expected = fold(inputs, y * width + x, least);
                if (expected.layers > 0)
                    REQUIRE(runOf[x]);
                if (!runOf[x] && !wantsGaps)
                    continue;
                double rgba[4];
                std::copy_n(&row.rgba[4 * x], 4, rgba);
                if (runOf[x] && runOf[x]->color) {
                    REQUIRE(expected.layers == 1);
                    std::copy_n(runOf[x]->color + 4 * (static_cast<int>(x) - runOf[x]->x), 4, rgba);
                }
                CHECK(std::equal(rgba, rgba + 4, expected.rgba)); // all bits, or 0 and -0
                if (hasDepth)
                    CHECK(row.depth[x] == expected.depth);
            }
        }
    }
}

} // namespace fragment_compositor_cases
