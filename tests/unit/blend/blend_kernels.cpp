// The kernels of blending and sorting. Vectorised ones equal those in plain C++, bit for bit, and what is built of them
// equals over(), layer by layer and pixel by pixel.
#include "brief.hpp"
#include "catch.hpp"

#include <dfb/blend/compositing.hpp>
#include <dfb/blend/in_place_kernels.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/testing/adversarial.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <numeric>
#include <vector>

namespace blend_kernels_cases {

namespace {

namespace d = dfb::detail;
using dfb::testing::below;
using dfb::testing::Random;
using dfb::testing::uniform;

constexpr float infinity = std::numeric_limits<float>::infinity();
constexpr float notANumber = std::numeric_limits<float>::quiet_NaN();

// Whether all bits are the same. For NaNs any NaN will do, as which one results is not defined.
bool isSame(const std::vector<double>& a, const std::vector<double>& b)
{
    return std::equal(a.begin(), a.end(), b.begin(), b.end(), [](double x, double y) {
        return std::memcmp(&x, &y, sizeof x) == 0 || (std::isnan(x) && std::isnan(y));
    });
}

// A special property of a set of layers. Alpha and colour are of any kind.
enum class Kind { Any, Opaque, OddAlpha, NotFinite };

// Layers of `width` pixels. Each layer is in memory of exactly its size and begins `offset` floats into it.
struct Stack {
    Stack(Random& random, Kind kind, int layerCount, int width)
    {
        const std::size_t offset = below(random, 4), depthKind = below(random, 8);
        for (int k = 0; k < layerCount; ++k) {
            auto& c = colors.emplace_back(offset, 0.0f);
            auto& z = depths.emplace_back(offset, 0.0f);
            const float tilt = uniform(random) - 0.5f, base = uniform(random);
            for (int i = 0; i < width; ++i) {
                float alpha = dfb::testing::anyAlpha(random);
                if (kind == Kind::Opaque && below(random, 8) > 0)
                    alpha = 1.0f;
                if (kind == Kind::OddAlpha && below(random, 4) == 0)
                    alpha = below(random, 2) ? 1.5f : -0.5f;
                for (int channel = 0; channel < 3; ++channel) {
                    float value = dfb::testing::anyColor(random, alpha);
                    if (below(random, 6) == 0)
                        value = -value; // also -0
                    if (kind == Kind::NotFinite && below(random, 40) == 0)
                        value = below(random, 2) ? infinity : notANumber;
                    c.push_back(value);
                }
                c.push_back(kind == Kind::NotFinite && below(random, 100) == 0 ? notANumber : alpha);
                // Surfaces that cross here and there, or depths in no order.
                z.push_back(depthKind == 7 ? base + tilt * static_cast<float>(i) / 16
                                           : dfb::testing::anyDepth(random, depthKind));
                if (below(random, 50) == 0)
                    z.back() = below(random, 2) ? infinity : -infinity;
            }
            c.shrink_to_fit(); // so that AddressSanitizer finds reads beyond the end
            z.shrink_to_fit();
        }
        for (std::size_t k = 0; k < colors.size(); ++k)
            layers.push_back({colors[k].data() + offset, depths[k].data() + offset, nullptr});
    }

    std::vector<std::vector<float>> colors, depths;
    std::vector<dfb::Layer> layers;
};

int anyCount(Random& random) { return 1 + static_cast<int>(below(random, 70)); }
double anyLeast(Random& random) { return below(random, 3) == 0 ? 0.05 : 0.0; }
const Kind kinds[] = {Kind::Any, Kind::Opaque, Kind::OddAlpha, Kind::NotFinite};

} // namespace

TEST_CASE("Blending a group of layers by hand gives the bits of plain C++", "[kernels]")
{
    Random random(3);
    int different = 0;
    for (int round = 0; round < repeats(2000); ++round) {
        const int width = anyCount(random);
        const Kind kind = kinds[round % 4];
        const Stack stack(random, kind, 1 + static_cast<int>(below(random, d::BlendGroup::mostLayers)), width);
        d::BlendGroup group;
        group.isFirst = below(random, 2) == 0;
        group.minTransmittance = anyLeast(random);
        for (const dfb::Layer& layer : stack.layers)
            group.colors[group.layers++] = layer.color;
        // What the pixels hold before.
        std::vector<double> rgba, transmittance;
        for (int i = 0; i < width; ++i) {
            transmittance.push_back(below(random, 2) ? 0.0 : static_cast<double>(uniform(random)));
            for (int c = 0; c < 4; ++c)
                rgba.push_back(static_cast<double>(uniform(random)));
        }
        auto rgbaPlain = rgba, transmittancePlain = transmittance;
        const bool isSeen = d::blendGroup(rgba.data(), transmittance.data(), width, group);
        const bool isSeenPlain =
            group.minTransmittance > 0
                ? d::blendGroupPlain<true>(rgbaPlain.data(), transmittancePlain.data(), width, group)
                : d::blendGroupPlain<false>(rgbaPlain.data(), transmittancePlain.data(), width, group);
        different += isSeen != isSeenPlain || !isSame(rgba, rgbaPlain) || !isSame(transmittance, transmittancePlain);
        d::takeLayer(rgba.data(), transmittance.data(), width, stack.layers[0].color, group.minTransmittance);
        d::takeLayerPlain(rgbaPlain.data(), transmittancePlain.data(), width, stack.layers[0].color,
                          group.minTransmittance);
        different += !isSame(rgba, rgbaPlain) || !isSame(transmittance, transmittancePlain);
    }
    CHECK(different == 0);
}

#if defined(DFB_HAS_AVX2_CLONES)
TEST_CASE("Full rows in place: with AVX2 and AVX-512 as in plain C++", "[kernels]")
{
    Random random(11);
    int different = 0, used = 0;
    for (int round = 0; d::cpuHasAvx2() && round < repeats(4000); ++round) {
        const int width = 3 + anyCount(random) + (round % 50 == 0 ? 256 : 0);
        const Stack stack(random, kinds[round % 4], 1 + static_cast<int>(below(random, d::mostInPlace)), width);
        if (round % 3 == 0) // four empty pixels
            for (const dfb::Layer& layer : stack.layers)
                std::fill_n(const_cast<float*>(layer.color), 16, below(random, 2) ? 0.0f : -0.0f);
        std::vector<d::RowInPlace> rows;
        bool isGood = true;
        for (const dfb::Layer& layer : stack.layers) {
            d::RowInPlace& row = rows.emplace_back();
            row.span = {0, static_cast<std::uint16_t>(width)};
            row.first.color = row.ahead.color = reinterpret_cast<const std::byte*>(layer.color);
            for (int i = 0; i < width; ++i) {
                const float* pixel = layer.color + 4 * i;
                isGood = isGood && std::all_of(pixel, pixel + 4, [](float c) { return std::isfinite(c); })
                         && pixel[3] >= 0 && pixel[3] <= 1;
            }
        }
        const double least = anyLeast(random);
        const auto size = static_cast<std::size_t>(width);
        std::vector<double> plain(4 * size), transmittance(size);
        d::BlendGroup group;
        group.minTransmittance = least;
        for (std::size_t k = 0; k < stack.layers.size(); k += 8, group.isFirst = false) {
            group.layers = static_cast<int>(std::min<std::size_t>(8, stack.layers.size() - k));
            for (int j = 0; j < group.layers; ++j)
                group.colors[j] = stack.layers[k + static_cast<std::size_t>(j)].color;
            (least > 0 ? d::blendGroupPlain<true> : d::blendGroupPlain<false>)(plain.data(), transmittance.data(),
                                                                               width, group);
        }
        for (int i = 0; i < width; i += 4) { // the last four overlap those before
            const auto four = plain.begin() + 4 * std::min(i, width - 4);
            isGood = isGood && std::any_of(four, four + 16, [](double c) { return c != 0; });
        }
        const auto check = [&](auto blend) {
            std::vector<double> rgba(4 * size, -1.0), through(size, -1.0);
            const bool isUsed = blend(rows.data(), static_cast<int>(rows.size()), least, rgba.data(), through.data());
            different += isUsed != isGood || (isUsed && (!isSame(rgba, plain) || !isSame(through, transmittance)));
            used += isUsed;
        };
        check(least > 0 ? d::blendFullRowsAvx2<true> : d::blendFullRowsAvx2<false>);
        if (d::cpuHasAvx512())
            check(least > 0 ? d::blendFullRowsAvx512<true> : d::blendFullRowsAvx512<false>);
    }
    CHECK(different == 0);
    CHECK((used > repeats(1000) || !d::cpuHasAvx2()));
}
#endif

TEST_CASE("A constant under pixels, and the nearest depths: by hand as in plain C++", "[kernels]")
{
    Random random(9);
    int different = 0;
    for (int round = 0; round < repeats(1000); ++round) {
        const int width = anyCount(random);
        const Stack stack(random, kinds[round % 4], 2, width);
        std::vector<double> rgba(stack.colors[0].end() - 4 * width, stack.colors[0].end()), plain = rgba, transmittance;
        for (int i = 0; i < width; ++i)
            transmittance.push_back(static_cast<double>(dfb::testing::anyAlpha(random)));
        d::blendConstant(rgba.data(), transmittance.data(), width, stack.layers[1].color);
        d::blendConstantPlain(plain.data(), transmittance.data(), width, stack.layers[1].color);
        different += !isSame(rgba, plain);
        std::vector<float> nearest(stack.depths[0].end() - width, stack.depths[0].end()), nearestPlain = nearest;
        d::takeNearest(nearest.data(), width, stack.layers[1].color, stack.layers[1].depth);
        d::takeNearestPlain(nearestPlain.data(), width, stack.layers[1].color, stack.layers[1].depth);
        different += std::memcmp(nearest.data(), nearestPlain.data(), nearest.size() * sizeof(float)) != 0;
    }
    CHECK(different == 0);
}

TEST_CASE("In twice the precision layers blend as sums and products of pairs of doubles do", "[kernels]")
{
    using d::DoubleDouble;
    Random random(21);
    int different = 0;
    double farthest = 0;
    for (int round = 0; round < repeats(300); ++round) {
        const int width = anyCount(random);
        const bool isExact = round % 2 == 0; // 11 factors of 8 bits: a pair of doubles has room for all digits
        const auto at = [](int i) { return static_cast<std::size_t>(i); };
        std::vector<DoubleDouble> rgba(4 * at(width)), through(at(width), DoubleDouble{1, 0});
        dfb::CompositeRow row;
        row.resize(width, 0, true);
        row.clear(0, width);
        for (int layer = 0; layer < 11; ++layer) {
            const bool isConstant = layer == 10;
            std::vector<float> colors(4 * at(isConstant ? 1 : width));
            for (float& value : colors)
                value = isExact ? static_cast<float>(below(random, 257)) / 256 : uniform(random);
            if (isConstant)
                dfb::overBackground(row, 0, width, colors.data());
            else
                dfb::over(row, 0, width, {colors.data(), nullptr, nullptr});
            for (int i = 0; i < width; ++i) {
                const float* color = colors.data() + (isConstant ? 0 : 4 * i);
                for (int c = 0; c < 4; ++c)
                    rgba[at(4 * i + c)] =
                        rgba[at(4 * i + c)] + through[at(i)] * DoubleDouble{static_cast<double>(color[c]), 0};
                through[at(i)] = through[at(i)] * DoubleDouble::sum(1, -static_cast<double>(color[3]));
            }
        }
        const auto check = [&](const DoubleDouble& expected, double high, double low) {
            const double off = std::abs((high - expected.high) + (low - expected.low));
            different += isExact ? off != 0 : !(off < 0x1p-96);
            farthest = std::max(farthest, off);
        };
        for (std::size_t i = 0; i < rgba.size(); ++i)
            check(rgba[i], row.rgba[i], row.rgbaLow[i]);
        for (std::size_t i = 0; i < through.size(); ++i)
            check(through[i], row.transmittance[i], row.transmittanceLow[i]);
        dfb::CompositeRow plain = row, fast = row;
        const float color[] = {0.1f, 0.2f, 0.7f, 0.3f};
        const auto pixels = [](dfb::CompositeRow& r) {
            return d::ExactPixels{r.rgba.data(), r.rgbaLow.data(), r.transmittance.data(), r.transmittanceLow.data()};
        };
        d::blendExactlyPlain(pixels(plain), width, color, 0);
        d::blendExactly(pixels(fast), width, color, 0);
        different += !isSame(plain.rgba, fast.rgba) || !isSame(plain.rgbaLow, fast.rgbaLow)
                     || !isSame(plain.transmittance, fast.transmittance)
                     || !isSame(plain.transmittanceLow, fast.transmittanceLow);
    }
    INFO("off by up to " << farthest);
    CHECK(different == 0);
}

TEST_CASE("A layer of levels under another is rounded to the nearest, by hand as in plain C++", "[kernels]")
{
    Random random(5);
    for (int alpha = 0; alpha < 256; ++alpha) {
        constexpr int width = 261; // all levels behind, and a remainder
        std::vector<std::uint8_t> front(4 * width), behind(4 * width);
        for (int i = 0; i < 4 * width; ++i) {
            const auto at = static_cast<std::size_t>(i);
            front[at] = static_cast<std::uint8_t>(i % 4 == 3 ? alpha : static_cast<int>(below(random, 256)));
            behind[at] = static_cast<std::uint8_t>(i / 4);
        }
        std::vector<std::uint8_t> exact(front), plain(front), fast(front);
        for (std::size_t i = 0; i < exact.size(); ++i)
            exact[i] = static_cast<std::uint8_t>(
                std::min(255.0, std::round(front[i] + (255 - alpha) / 255.0 * static_cast<double>(behind[i]))));
        d::blendLevelsPlain(plain.data(), width, behind.data());
        d::blendLevels(fast.data(), width, behind.data());
        REQUIRE(plain == exact);
        REQUIRE(fast == exact);
    }
}

TEST_CASE("Layers in order are what over() makes of them one by one", "[kernels]")
{
    Random random(4);
    int different = 0;
    std::vector<int> scratch;
    for (int round = 0; round < repeats(1500); ++round) {
        const int width = anyCount(random), x = static_cast<int>(below(random, 9));
        const Stack stack(random, kinds[round % 3], anyCount(random), width); // all is finite
        dfb::CompositeRow row, expected;
        row.minTransmittance = anyLeast(random);
        row.resize(x + width);
        row.clear(0, x);
        expected = row;
        expected.clear(0, x + width);
        dfb::blendInOrder(row, x, width, stack.layers, scratch);
        for (const dfb::Layer& layer : stack.layers) {
            dfb::over(expected, x, width, layer);
            dfb::closeOpaque(expected, x, width);
        }
        for (dfb::CompositeRow* r : {&row, &expected})
            for (double& t : r->transmittance)
                t += 0.0; // an alpha above 1 behind an opaque pixel makes -0 of 0, if it is blended
        different += !isSame(row.rgba, expected.rgba) || !isSame(row.transmittance, expected.transmittance)
                     || row.depth != expected.depth;
    }
    CHECK(different == 0);
}

TEST_CASE("How far an order of depths holds: by hand as in plain C++", "[kernels]")
{
    Random random(5);
    int different = 0;
    for (int round = 0; round < repeats(4000); ++round) {
        const int width = anyCount(random), begin = static_cast<int>(below(random, static_cast<std::size_t>(width)));
        const Stack stack(random, Kind::Any, 2 + static_cast<int>(below(random, 15)), width);
        d::OrderedDepths order;
        for (const dfb::Layer& layer : stack.layers) {
            order.losesTies[order.layers] = below(random, 4) > 0 ? 0 : -1;
            order.depths[order.layers++] = layer.depth;
        }
        if (round % 2 == 0) // rows that are mostly in order, too
            for (int i = 0; i < width; ++i)
                for (int k = 0; k < order.layers; ++k)
                    const_cast<float*>(order.depths[k])[i] = below(random, 500) ? static_cast<float>(k) : 0.5f;
        const int end = d::firstOutOfOrder(order, begin, width);
        different += end != d::firstOutOfOrderPlain(order, begin, width);
        const auto isRight = [&](int x) {
            for (int k = 0; k + 1 < order.layers; ++k) {
                const float front = order.depths[k][x], back = order.depths[k + 1][x];
                if (!(order.losesTies[k] ? front < back : front <= back))
                    return false;
            }
            return true;
        };
        for (int x = begin; x < end; ++x)
            different += !isRight(x);
        different += end < width && isRight(end);
    }
    CHECK(different == 0);
}

TEST_CASE("Four pixels are sorted by depth, then index, by hand as in plain C++", "[kernels]")
{
    Random random(6);
    int different = 0;
    for (int n = 1; n <= d::SortNetwork::mostLayers; ++n)
        for (int round = 0; round < repeats(40); ++round) {
            const Stack stack(random, Kind::Any, n, 4);
            std::vector<const float*> depths;
            for (const dfb::Layer& layer : stack.layers)
                depths.push_back(layer.depth);
            d::FourOrders orders, plain;
            d::sortFour(depths.data(), d::SortNetwork::of(n), orders);
            d::sortFourPlain(depths.data(), d::SortNetwork::of(n), plain);
            std::vector<std::uint32_t> expected(depths.size());
            for (std::size_t p = 0; p < 4; ++p) {
                std::iota(expected.begin(), expected.end(), 0u);
                std::stable_sort(expected.begin(), expected.end(),
                                 [&](std::uint32_t a, std::uint32_t b) { return depths[a][p] < depths[b][p]; });
                for (std::size_t k = 0; k < expected.size(); ++k)
                    different += orders[k][p] != expected[k] || plain[k][p] != expected[k];
            }
        }
    CHECK(different == 0);
    // A NaN among depths, which should not occur, does no harm: it is placed somewhere behind finite depths.
    const float depths[3][4] = {{notANumber, 1, notANumber, 1}, {2, notANumber, 2, 2}, {1, 3, -infinity, notANumber}};
    const float* const pointers[] = {depths[0], depths[1], depths[2]};
    d::FourOrders orders, plain;
    d::sortFour(pointers, d::SortNetwork::of(3), orders);
    d::sortFourPlain(pointers, d::SortNetwork::of(3), plain);
    CHECK(std::memcmp(orders, plain, 3 * sizeof orders[0]) == 0);
    const std::uint32_t last[] = {0, 1, 0, 2};
    CHECK(std::memcmp(orders[2], last, sizeof last) == 0);
}

TEST_CASE("Blending four pixels with an order each: by hand as in plain C++", "[kernels]")
{
    Random random(7);
    int different = 0;
    for (int round = 0; round < repeats(1000); ++round) {
        const int n = anyCount(random);
        const Stack stack(random, kinds[round % 4], n, 4);
        std::vector<const float*> colors, depths;
        for (const dfb::Layer& layer : stack.layers) {
            colors.push_back(layer.color);
            depths.push_back(layer.depth);
        }
        d::FourOrders orders;
        d::sortFourPlain(depths.data(), d::SortNetwork::of(n), orders);
        std::vector<double> rgba(16, -1.0), t(4, -1.0), rgbaPlain = rgba, tPlain = t;
        const double least = anyLeast(random);
        d::blendFour(rgba.data(), t.data(), colors.data(), orders, n, least);
        (least > 0 ? d::blendFourPlain<true> : d::blendFourPlain<false>)(rgbaPlain.data(), tPlain.data(), colors.data(),
                                                                         orders, n, least);
        different += !isSame(rgba, rgbaPlain) || !isSame(t, tPlain);
    }
    CHECK(different == 0);
}

TEST_CASE("Layers that are sorted are what over() makes of them one by one, pixel by pixel", "[kernels]")
{
    Random random(8);
    int different = 0;
    std::vector<int> scratch;
    for (int round = 0; round < repeats(3000); ++round) {
        const int width = anyCount(random), x = static_cast<int>(below(random, 9));
        const int layerCount = round % 100 == 0 ? 150 : anyCount(random); // more than a network sorts, too
        const Stack stack(random, kinds[round % 3], layerCount, width);
        dfb::CompositeRow row, expected;
        row.minTransmittance = anyLeast(random);
        row.wantsDepth = round % 2 == 0;
        row.resize(x + width);
        row.clear(0, x);
        expected = row;
        expected.clear(0, x + width);
        if (round % 4 >= 2)
            scratch.clear(); // otherwise it mostly comes from other layers
        dfb::sortAndBlend(row, x, width, stack.layers, scratch);
        if (round % 4 == 0) {
            std::shuffle(scratch.begin(), scratch.end(), random);
            dfb::sortAndBlend(row, x, width, stack.layers, scratch);
        }
        std::vector<std::size_t> order(stack.layers.size());
        for (int i = 0; i < width; ++i) {
            std::iota(order.begin(), order.end(), 0u);
            std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) {
                return stack.layers[a].depth[i] < stack.layers[b].depth[i];
            });
            for (std::size_t k = 0; k < order.size(); ++k) {
                dfb::over(expected, x + i, 1, stack.layers[order[k]].from(i));
                dfb::closeOpaque(expected, x + i, 1);
            }
        }
        for (dfb::CompositeRow* r : {&row, &expected})
            for (double& t : r->transmittance)
                t += 0.0; // as above
        different +=
            !isSame(row.rgba, expected.rgba) || !isSame(row.transmittance, expected.transmittance)
            || row.depth.size() != expected.depth.size()
            || (row.wantsDepth
                && std::memcmp(row.depth.data(), expected.depth.data(), row.depth.size() * sizeof(float)) != 0);
    }
    CHECK(different == 0);
}

TEST_CASE("An infinity behind what is opaque shows nothing of the tile before", "[kernels]")
{
    // Whether such a pixel becomes a NaN depends on which pixels are blended with it, and thus on the order in which
    // layers were before. All rows are alike but the last, which leaves the other order. Each input is composited
    // twice.
    dfb::testing::TileInputs<16> in;
    for (std::uint32_t source = 0; source < 2; ++source) {
        auto& tile = in.add(0, source);
        for (int y = 0; y < 16; ++y)
            for (int x = 0; x < 16; ++x) {
                const bool isFront = (source == 1) == (x < 6 || y == 15);
                float* rgba = tile.pixel(x, y);
                rgba[0] = y < 15 && x == 6 && !isFront ? infinity : 0.25f;
                rgba[3] = isFront && x >= 4 && x < 8 ? 1.0f : 0.5f;
                tile.depth[16 * y + x] = isFront ? 1.0f : 2.0f;
            }
    }
    const auto out =
        dfb::testing::runTileOp<dfb::BasicAlphaBlend<16>>(in, in.order(), dfb::OutputFormat::RGBA32F, false);
    const std::size_t rowBytes = 16 * 4 * sizeof(float);
    CHECK(std::memcmp(out.color.data(), out.color.data() + rowBytes, rowBytes) == 0);
}

} // namespace blend_kernels_cases
