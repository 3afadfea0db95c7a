// Numbers for which sums go wrong: very many layers, the ends of all ranges, and values of very different size.
// Compared with the reference. The long form: test_stress "[long]".
#include "catch.hpp"

#include <dfb/ops/image_parallel.hpp>
#include <dfb/ops/progressive.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/testing/adversarial.hpp>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>
#include <string>
#include <vector>

namespace {

using dfb::testing::below;
using dfb::testing::ErrorReport;
using dfb::testing::Exact;
using dfb::testing::Random;
using dfb::testing::TileInputs;
using dfb::testing::uniform;

constexpr float infinity = std::numeric_limits<float>::infinity();

// Three pixels of a tile of 8: so that many layers cost little.
TileInputs<8> narrow()
{
    TileInputs<8> in;
    in.layout = dfb::TileLayout(8 + 3, 8 + 1, 8);
    in.tile = 3;
    return in;
}

// An input whose pixels are `pixel(x)`: colour and alpha, and the depth.
template <class PixelOf>
void add(TileInputs<8>& in, std::uint32_t source, const PixelOf& pixelOf)
{
    auto& tile = in.add(0, source);
    tile.forEachPixel([&](int x, int, float* rgba, float& depth) {
        const dfb::testing::Sample s = pixelOf(x - in.region().x0);
        std::copy(s.rgba.begin(), s.rgba.end(), rgba);
        depth = s.depth;
    });
}

template <class Op>
ErrorReport reportOf(const TileInputs<Op::tileSize>& in)
{
    return dfb::testing::compare<Op>(in, dfb::testing::referenceOf(in));
}

// Layers of alpha from 1e-6 to 1 in any order of depth, colours up to alpha.
void checkLayers(int layers, std::uint64_t seed)
{
    for (const int kind : {0, 1, 2}) {
        Random random(seed + static_cast<std::uint64_t>(kind));
        TileInputs<8> in = narrow();
        in.background = {0.5f, 0.25f, 1, 1};
        for (int i = 0; i < layers; ++i)
            add(in, static_cast<std::uint32_t>(i), [&](int x) {
                dfb::testing::Sample s;
                const float alpha =
                    kind == 0   ? 1e-6f
                    : kind == 1 ? static_cast<float>(std::pow(10.0, -6.0 * static_cast<double>(uniform(random))))
                                : 2e-5f * uniform(random);
                s.rgba = {alpha * uniform(random), x == 1 ? alpha : 0.0f, alpha * 0.5f, alpha};
                s.depth = x == 2 ? 1.0f : uniform(random);
                return s;
            });
        const ErrorReport report = reportOf<dfb::BasicAlphaBlend<8>>(in);
        INFO(layers << " layers, kind " << kind << ": " << report.text());
        CHECK(report.ulpsBelow() <= 2);
        CHECK(report.wrongBytes == 0);
    }
}

} // namespace

TEST_CASE("1 to 65536 layers are within 1 ulp, and exact in 8 bits", "[numbers]")
{
    for (const int layers : {1, 2, 3, 17, 256, 4096})
        checkLayers(layers, 1);
    checkLayers(65536, 2);
}

TEST_CASE("65536 layers, many times", "[.long]")
{
    for (std::uint64_t seed = 10; seed < 60; ++seed)
        checkLayers(65536, seed);
}

TEST_CASE("Emission is kept, and what is opaque hides", "[numbers]")
{
    TileInputs<8> in = narrow();
    const auto sample = [](std::array<float, 4> rgba, float depth) {
        dfb::testing::Sample s;
        s.rgba = rgba;
        s.depth = depth;
        return s;
    };
    add(in, 0, [&](int) { return sample({0.25f, 0, 0, 0}, 1); }); // emission in front
    add(in, 1, [&](int) { return sample({0, 0.5f, 0, 1}, 2); });  // opaque
    add(in, 2, [&](int) { return sample({0, 0, 3, 0}, 3); });     // emission behind it
    const auto out = dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, {2, 0, 1}, dfb::OutputFormat::RGBA32F);
    for (std::size_t i = 0; i < 3; ++i) {
        CHECK(out.value(4 * i) == 0.25f);
        CHECK(out.value(4 * i + 1) == 0.5f);
        CHECK(out.value(4 * i + 2) == 0.0f);
        CHECK(out.value(4 * i + 3) == 1.0f);
        CHECK(out.depth[i] == 2.0f);
    }
}

TEST_CASE("Equal depths: all 720 orders of arrival of 6 layers give the same", "[numbers]")
{
    Random random(5);
    TileInputs<8> in = narrow();
    for (std::uint32_t source = 0; source < 6; ++source)
        add(in, 7 * source % 6, [&](int x) {
            dfb::testing::Sample s;
            s.rgba = {0.1f * static_cast<float>(source), 0.3f, 0, 0.3f};
            s.depth = x == 0 ? 1.0f : x == 1 ? -0.0f * static_cast<float>(source % 2) : infinity;
            return s;
        });
    auto order = in.order();
    const auto first = dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, order, dfb::OutputFormat::RGBA32F);
    int different = 0, orders = 0;
    do {
        different +=
            !(dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, order, dfb::OutputFormat::RGBA32F) == first);
        ++orders;
    } while (std::next_permutation(order.begin(), order.end()));
    CHECK(orders == 720);
    CHECK(different == 0);
    CHECK(reportOf<dfb::BasicAlphaBlend<8>>(in).ulpsBelow() <= 1); // and by source
}

TEST_CASE("Values of any size and sign are within the bound", "[numbers]")
{
    // |error| <= 2^-24 |exact| + 4 n 2^-53 sum |T c|; with denormals, half of the smallest.
    for (std::uint64_t seed = 1; seed <= 40; ++seed) {
        Random random(seed);
        TileInputs<8> in = narrow();
        const int layers = 2 + static_cast<int>(seed % 30);
        for (int i = 0; i < layers; ++i)
            add(in, static_cast<std::uint32_t>(i), [&](int) {
                dfb::testing::Sample s;
                for (int c = 0; c < 3; ++c) {
                    const float sizes[] = {1e30f, 1e-30f, 1, 1e-40f, 1e38f, 0};
                    s.rgba[static_cast<std::size_t>(c)] =
                        (uniform(random) - (seed % 2 ? 0.5f : 0.0f)) * sizes[below(random, 6)];
                }
                s.rgba[3] = dfb::testing::anyAlpha(random);
                const float depths[] = {0.0f, -0.0f, 1e-38f, 1e38f, infinity, -infinity, -1.0f, 1e-45f};
                s.depth = depths[below(random, 8)];
                return s;
            });
        const auto out = dfb::testing::runTileOp<dfb::BasicAlphaBlend<8>>(in, in.order(), dfb::OutputFormat::RGBA32F);
        const auto expected = dfb::testing::referenceOf(in);
        const auto sizes = dfb::testing::referenceOf(in, [](std::vector<dfb::testing::Sample> samples) {
            std::stable_sort(samples.begin(), samples.end(), dfb::testing::isInFront);
            dfb::testing::Pixel sum;
            Exact transmittance = 1;
            for (const auto& s : samples) {
                for (std::size_t c = 0; c < 4; ++c)
                    sum.rgba[c] += transmittance
                                   * (s.rgba[c] < 0 ? -static_cast<Exact>(s.rgba[c]) : static_cast<Exact>(s.rgba[c]));
                transmittance *= 1 - static_cast<Exact>(s.rgba[3]);
            }
            return sum;
        });
        for (std::size_t i = 0; i < 12; ++i) {
            const auto exact = static_cast<double>(expected[i / 4].rgba[i % 4]);
            const double allowed = 0x1p-24 * std::abs(exact)
                                   + 4.0 * layers * 0x1p-53 * static_cast<double>(sizes[i / 4].rgba[i % 4]) + 0x1p-150;
            if (std::abs(exact) > 3.4e38)
                continue; // infinity
            INFO("seed " << seed << ", value " << i << ": " << out.value(i) << ", exact " << exact);
            CHECK(std::abs(static_cast<double>(out.value(i)) - exact) <= allowed);
        }
        for (std::size_t i = 0; i < 3; ++i)
            CHECK(out.depth[i] == expected[i].depth);
    }
}

TEST_CASE("A value that is not finite spoils its own pixel at most", "[numbers]")
{
    const float nan = std::numeric_limits<float>::quiet_NaN();
    Random random(9);
    TileInputs<8> in;
    for (std::uint32_t source = 0; source < 5; ++source) {
        auto& tile = in.add(0, source);
        for (int i = 0; i < 64; ++i) {
            tile.depth[i] = uniform(random);
            tile.color[4 * i + 3] = uniform(random);
            for (int c = 0; c < 3; ++c)
                tile.color[4 * i + c] = tile.color[4 * i + 3] * uniform(random);
        }
    }
    using Op = dfb::BasicAlphaBlend<8>;
    const auto clean = dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA32F);
    for (const float bad : {nan, infinity, -infinity})
        for (int channel = 0; channel < 5; ++channel) {
            auto& tile = *in.tiles[2];
            float& value = channel == 4 ? tile.depth[27] : tile.color[4 * 27 + channel];
            const float saved = value;
            value = bad;
            const auto out = dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA32F);
            std::size_t elsewhere = 0;
            for (std::size_t i = 0; i < 4 * 64; ++i)
                elsewhere += i / 4 != 27 && out.value(i) != clean.value(i);
            INFO(bad << " in channel " << channel);
            CHECK(elsewhere == 0);
            CHECK(out.faults.nonFinite == (channel < 4 || std::isnan(bad) ? 1u : 0u)); // an infinite depth is far away
            CHECK_NOTHROW(dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::SRGBA8));
            value = saved;
        }
    // Alpha that is none is taken as it is, and counted.
    in.tiles[1]->color[4 * 3 + 3] = 1.5f;
    in.tiles[1]->color[4 * 9 + 3] = -0.5f;
    CHECK(dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA32F).faults.alphaOutside == 2);
}

TEST_CASE("Squared deviations of 10^7 samples, mean 10^6 times the deviation", "[numbers]")
{
    constexpr std::size_t count = 10000000;
    Random random(11);
    std::vector<float> samples(count);
    long double sum = 0, squares = 0; // of the deviations from 1, which are exact
    for (float& sample : samples) {
        sample = 1 + 3.5e-6f * (uniform(random) - 0.5f);
        const long double deviation = static_cast<long double>(sample) - 1;
        sum += deviation;
        squares += deviation * deviation;
    }
    const long double m2 = squares - sum * sum / count;
    double sums[4] = {0, 0, 0, 0}, grown = 0;
    for (std::size_t i = 0; i < count; ++i) {
        const double sample[4] = {static_cast<double>(samples[i]), 0, 0, 0};
        grown += dfb::detail::growthOfM2(static_cast<std::int64_t>(i), sums, sample);
        sums[0] += sample[0];
    }
    CHECK(std::abs(static_cast<long double>(grown) / m2 - 1) < 1e-7L);
    CHECK(std::abs(static_cast<long double>(sums[0]) / count - 1 - sum / count) < 1e-12L);
}
