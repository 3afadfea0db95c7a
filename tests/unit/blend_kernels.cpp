// The kernels of blending, each by hand against the same in plain C++, bit for bit; and the plain ones against exact
// arithmetic's order of operations, written out per pixel.
#include "catch.hpp"

#include <dfb/compositing.hpp>
#include <dfb/testing/adversarial.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <limits>
#include <numeric>
#include <vector>

namespace {

namespace d = dfb::detail;
using dfb::testing::below;
using dfb::testing::Random;
using dfb::testing::uniform;

constexpr float infinity = std::numeric_limits<float>::infinity();
constexpr float notANumber = std::numeric_limits<float>::quiet_NaN();

// The same bits, but for NaNs, of which nobody promises which one comes out.
bool isSame(const std::vector<double>& a, const std::vector<double>& b)
{
    return std::equal(a.begin(), a.end(), b.begin(), b.end(), [](double x, double y) {
        return std::memcmp(&x, &y, sizeof x) == 0 || (std::isnan(x) && std::isnan(y));
    });
}

// What a set of layers is like, beside alpha and colour of any kind.
enum class Kind { Any, Opaque, OddAlpha, NotFinite };

// Layers of `width` pixels, each in memory of just that size, which begin `offset` floats into it.
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
                // Surfaces that cross here and there, or depths without order.
                z.push_back(depthKind == 7 ? base + tilt * static_cast<float>(i) / 16
                                           : dfb::testing::anyDepth(random, depthKind));
                if (below(random, 50) == 0)
                    z.back() = below(random, 2) ? infinity : -infinity;
            }
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
    for (int round = 0; round < 2000; ++round) {
        const int width = anyCount(random);
        const Kind kind = kinds[round % 4];
        const Stack stack(random, kind, 1 + static_cast<int>(below(random, d::BlendGroup::mostLayers)), width);
        d::BlendGroup group;
        group.isFirst = below(random, 2) == 0;
        group.minTransmittance = anyLeast(random);
        for (const dfb::Layer& layer : stack.layers)
            group.colors[group.layers++] = layer.color;
        // What is there already.
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

TEST_CASE("Layers in order are what over() makes of them one by one", "[kernels]")
{
    Random random(4);
    int different = 0;
    std::vector<int> scratch;
    for (int round = 0; round < 1500; ++round) {
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
        for (double* t = row.transmittance.data(); t != row.transmittance.data() + row.transmittance.size(); ++t)
            *t += 0.0; // behind an opaque pixel an alpha above 1 makes 0 of it or -0
        for (double& t : expected.transmittance)
            t += 0.0;
        different += !isSame(row.rgba, expected.rgba) || !isSame(row.transmittance, expected.transmittance)
                     || row.depth != expected.depth;
    }
    CHECK(different == 0);
}
