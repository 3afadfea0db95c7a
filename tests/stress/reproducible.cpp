// The image is the same, bit for bit, whatever the arrival order of inputs, the way they travel, and the instruction
// set.
#include "catch.hpp"

#include <dfb/base/levels.hpp>
#include <dfb/blend/compositing.hpp>
#include <dfb/ops/image_parallel.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/testing/adversarial.hpp>

#if defined(DFB_HAS_SNAPPY)
#include <dfb/comm/snappy_codec.hpp>
#endif

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

namespace {

using dfb::testing::Random;

// Arrival orders and codecs.
template <class Op>
int differencesOf(std::uint64_t seed, int shuffles)
{
    const int layers = 2 + static_cast<int>(seed % 29), passes = 1 + static_cast<int>(seed % 3);
    const auto in = dfb::testing::adversarial<Op::tileSize>(seed, layers, passes, false, seed % 4 == 0);
    dfb::testing::TileWire wire;
    if (seed % 4 == 0)
        wire.precision = static_cast<dfb::WireFormat>(seed / 4 % 4);
    const auto format = seed % 5 == 0 ? dfb::OutputFormat::SRGBA8 : dfb::OutputFormat::RGBA32F;
    auto order = in.order();
    const auto first = dfb::testing::runTileOp<Op>(in, order, format, true, wire);
    Random random(seed);
    int different = 0;
    for (int i = 0; i < shuffles; ++i) {
        std::shuffle(order.begin(), order.end(), random);
        auto other = wire;
#if defined(DFB_HAS_SNAPPY)
        const dfb::SnappyCodec codec;
        if (i % 2 == 1)
            other.codec = &codec;
#endif
        different += !(dfb::testing::runTileOp<Op>(in, order, format, true, other) == first);
    }
    return different;
}

} // namespace

TEST_CASE("240 shuffles of adversarial tiles show nothing of the order or the codec", "[reproducible]")
{
    for (std::uint64_t seed = 1; seed <= 60; ++seed) {
        INFO("seed " << seed);
        CHECK(differencesOf<dfb::BasicAlphaBlend<16>>(seed, 4) == 0);
        CHECK(differencesOf<dfb::BasicDepthComposite<16>>(seed, 2) == 0);
    }
}

TEST_CASE("Many more shuffles", "[.long]")
{
    for (std::uint64_t seed = 1000; seed < 3000; ++seed)
        CHECK(differencesOf<dfb::BasicAlphaBlend<16>>(seed, 20) == 0);
}

TEST_CASE("Rounding in rows gives what rounding one by one gives", "[reproducible]")
{
    Random random(3);
    for (int round = 0; round < 300; ++round) {
        const int count = 1 + static_cast<int>(random() % 70), layerCount = 1 + static_cast<int>(random() % 9);
        std::vector<std::vector<float>> pixels(static_cast<std::size_t>(layerCount));
        std::vector<dfb::Layer> layers;
        std::vector<int> order;
        for (auto& p : pixels) {
            for (int i = 0; i < count; ++i) {
                const float alpha = dfb::testing::anyAlpha(random);
                for (int c = 0; c < 3; ++c)
                    p.push_back(dfb::testing::anyColor(random, alpha));
                p.push_back(alpha);
            }
            order.push_back(static_cast<int>(layers.size()));
            layers.push_back({p.data(), nullptr, nullptr});
        }
        dfb::CompositeRow a;
        a.resize(count);
        dfb::detail::blendColors(a, 0, 0, count, layers, order);
        for (double& value : a.rgba) // some ties
            value = random() % 3 ? value : (static_cast<double>(random() % 255) + 0.5) / 255;
        std::vector<std::uint8_t> levels(a.rgba.size());
        const double farthest = dfb::detail::toUnorm8(a.rgba.data(), static_cast<int>(levels.size()), levels.data());
        double farthestAlone = 0;
        int wrong = 0;
        for (std::size_t i = 0; i < levels.size(); ++i) {
            std::uint8_t level = 0;
            farthestAlone = std::max(farthestAlone, dfb::detail::toUnorm8(&a.rgba[i], 1, &level));
            wrong += levels[i] != dfb::detail::toUnorm8(a.rgba[i]);
        }
        CHECK(wrong == 0);
        CHECK(farthest == farthestAlone);
    }
}
