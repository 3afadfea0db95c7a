// Wire formats: conversions to the nearest value, error bounds that hold and are not much too large, the choice of a
// format within a budget, and which tiles are compressed.
#include "catch.hpp"

#include <dfb/ops/image_parallel.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/testing/adversarial.hpp>
#include <dfb/wire/wire_format.hpp>
#include <dfb/wire/wire_kernels.hpp>

#if defined(DFB_HAS_SNAPPY)
#include <dfb/comm/snappy_codec.hpp>
#endif

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <random>
#include <string>
#include <vector>

namespace wire_format_cases {

namespace {

using dfb::WireFormat;
using dfb::detail::positiveFromHalf;
using dfb::detail::positiveToHalf;
using dfb::testing::Random;
using dfb::testing::uniform;

constexpr float infinity = std::numeric_limits<float>::infinity();
constexpr WireFormat lossy[] = {WireFormat::Float16, WireFormat::Unorm16, WireFormat::Unorm8};

std::vector<float> through(WireFormat format, const dfb::detail::WireCoder& coder, const std::vector<float>& rgba)
{
    std::vector<std::byte> bytes(rgba.size() * 4);
    std::vector<float> result(rgba.size());
    coder.encodeColor(format, rgba.data(), static_cast<int>(rgba.size() / 4), bytes.data());
    coder.decodeColor(format, bytes.data(), rgba.size() / 4, result.data());
    return result;
}

dfb::Precision precisionOf(WireFormat format, float maxColor = 1)
{
    dfb::Precision precision = format;
    precision.maxColor = maxColor;
    return precision;
}

// The nearest binary16 number, with ties to even, computed in double. `guess` is at most two numbers off.
std::uint16_t nearestHalf(float value, std::uint16_t guess)
{
    std::uint16_t best = guess;
    for (int step = -2; step <= 2; ++step) {
        const int other = guess + step;
        if (other < 0 || other > 0x7bff)
            continue;
        const double distance = std::abs(static_cast<double>(positiveFromHalf(static_cast<std::uint16_t>(other)))
                                         - static_cast<double>(value)),
                     bestDistance = std::abs(static_cast<double>(positiveFromHalf(best)) - static_cast<double>(value));
        if (distance < bestDistance || (distance == bestDistance && other % 2 == 0))
            best = static_cast<std::uint16_t>(other);
    }
    return best;
}

} // namespace

TEST_CASE("Half precision: every number from 0 on comes back, and floats become the nearest", "[wire_format]")
{
    std::size_t wrong = 0;
    for (std::uint16_t half = 0; half < 0x7c00; ++half) {
        const float value = positiveFromHalf(half);
        const int exponent = half >> 10, mantissa = half & 1023;
        const double expected = std::ldexp(exponent ? 1024 + mantissa : mantissa, (exponent ? exponent : 1) - 25);
        wrong += static_cast<double>(value) != expected || positiveToHalf(value) != half;
    }
    CHECK(wrong == 0);
    Random random(1);
    for (int i = 0; i < 200000; ++i) {
        const auto half = static_cast<std::uint16_t>(random() % 0x7bff);
        const float low = positiveFromHalf(half), high = positiveFromHalf(static_cast<std::uint16_t>(half + 1));
        // Values between two numbers, in the middle, and next to the middle.
        const float middle = low + 0.5f * (high - low);
        for (const float value : {low + uniform(random) * (high - low), middle, std::nextafter(middle, 0.0f),
                                  std::nextafter(middle, infinity)})
            wrong += positiveToHalf(value) != nearestHalf(value, half);
    }
    CHECK(wrong == 0);
    CHECK(positiveToHalf(0x1p-25f) == 0); // a tie, to even
    CHECK(positiveToHalf(std::nextafter(0x1p-25f, 1.0f)) == 1);
}

TEST_CASE("Colours become the nearest of their format", "[wire_format]")
{
    Random random(2);
    for (const float maxColor : {1.0f, 0.3f, 7.0f, 1e-20f, 1e20f})
        for (const WireFormat format : lossy) {
            INFO(dfb::nameOf(format) << ", colours up to " << maxColor);
            const dfb::detail::WireCoder coder(precisionOf(format, maxColor));
            std::vector<float> rgba;
            for (int i = 0; i < 20000; ++i) {
                const float alpha = dfb::testing::anyAlpha(random);
                for (int c = 0; c < 3; ++c)
                    rgba.push_back(maxColor * alpha * uniform(random));
                rgba.push_back(alpha);
            }
            REQUIRE(coder.inRange(rgba.data(), static_cast<int>(rgba.size() / 4)));
            const std::vector<float> result = through(format, coder, rgba);
            double worst = 0; // in units of the allowed error
            for (std::size_t i = 0; i < rgba.size(); ++i) {
                const auto value = static_cast<double>(rgba[i]);
                const double largest = i % 4 == 3 ? 1.0 : static_cast<double>(maxColor);
                const double allowed = format == WireFormat::Float16   ? 0x1p-11 * value + 0x1p-39 * largest
                                       : format == WireFormat::Unorm16 ? largest * (0.5 / 65535 + 0x1p-22)
                                                                       : largest * (0.5 / 255 + 0x1p-22);
                worst = std::max(worst, std::abs(static_cast<double>(result[i]) - value) / allowed);
            }
            CHECK(worst <= 1);
            CHECK(worst > 0.9); // the bound is nearly reached
        }
    // Colours of 0, alphas of 1 and 8-bit values do not change.
    const dfb::detail::WireCoder coder(precisionOf(WireFormat::Unorm8));
    for (int level = 0; level <= 255; ++level) {
        const float value = static_cast<float>(level) / 255;
        CHECK(through(WireFormat::Unorm8, coder, {0, 1, value, 1})
              == std::vector<float>{0, 1, static_cast<float>(level) * (1 / 255.0f), 1});
    }
}

TEST_CASE("What is not in range is found out", "[wire_format]")
{
    const dfb::detail::WireCoder coder(precisionOf(WireFormat::Float16, 2));
    const float nan = std::numeric_limits<float>::quiet_NaN();
    for (const auto& pixel : std::vector<std::vector<float>>{{1.01f, 0, 0, 0.5f},
                                                             {0, -1e-30f, 0, 1},
                                                             {0, 0, nan, 1},
                                                             {0, 0, 0, nan},
                                                             {0, 0, 0, 1.0000001f},
                                                             {0, 0, 0, -1e-30f},
                                                             {1e-30f, 0, 0, 0},
                                                             {infinity, 0, 0, 1}}) {
        std::vector<float> row(4 * 37, 0.5f);
        CHECK(coder.inRange(row.data(), 37));
        std::copy(pixel.begin(), pixel.end(), row.begin() + 4 * 20);
        CHECK_FALSE(coder.inRange(row.data(), 37));
    }
}

TEST_CASE("The bound of a format holds for 2, 64 and 4096 layers, and is not far from the truth", "[wire_format]")
{
    for (const float maxColor : {1.0f, 6.0f})
        for (const WireFormat format : lossy) {
            const dfb::detail::WireCoder coder(precisionOf(format, maxColor));
            for (const int layers : {2, 64, 4096}) {
                double worst = 0;
                Random random(static_cast<std::uint64_t>(layers));
                for (int pixel = 0; pixel < (layers > 1000 ? 300 : 3000); ++pixel) {
                    // Kinds of pixels: thin layers just beside a tie, all rounded the same way; extreme values; any
                    // values.
                    const int kind = pixel % 6;
                    const double step = format == WireFormat::Unorm8 ? 1.0 / 255 : 1.0 / 65535;
                    const float thin = static_cast<float>((kind == 0 ? 0.499 : 0.501) * step);
                    std::vector<float> rgba;
                    for (int i = 0; i < layers; ++i) {
                        const float alpha = kind < 2    ? thin
                                            : kind < 4  ? (1.0f + 0x1p-11f * (kind == 2 ? 0.99f : 1.01f)) * 0x1p-6f
                                            : kind == 4 ? dfb::testing::anyAlpha(random)
                                                        : uniform(random) * 2 / static_cast<float>(layers);
                        // Black in front and bright behind, as then an error of what is let through shows most.
                        const float bright = i < layers / 2 ? static_cast<float>(pixel / 6 % 2) : 1.0f;
                        for (int c = 0; c < 3; ++c)
                            rgba.push_back(
                                std::min(maxColor * alpha * (kind > 3 ? uniform(random) : bright), maxColor * alpha));
                        rgba.push_back(std::min(alpha, 1.0f));
                    }
                    REQUIRE(coder.inRange(rgba.data(), layers));
                    const std::vector<float> rounded = through(format, coder, rgba);
                    const auto blend = [&](const std::vector<float>& from, int channel) {
                        double sum = 0, transmittance = 1;
                        for (std::size_t i = 0; i < from.size(); i += 4) {
                            sum += transmittance * static_cast<double>(from[i + static_cast<std::size_t>(channel)]);
                            transmittance *= 1 - static_cast<double>(from[i + 3]);
                        }
                        return sum + transmittance * 0.5; // the background
                    };
                    for (const int channel : {0, 3})
                        worst = std::max(worst, std::abs(blend(rgba, channel) - blend(rounded, channel)));
                }
                const double bound = dfb::wireErrorBound(format, layers, static_cast<double>(maxColor), 0.5);
                INFO(dfb::nameOf(format) << ", " << layers << " layers, colours up to " << maxColor << ": " << worst
                                         << " of " << bound);
                CHECK(worst <= bound);
                if (layers == 2) // with more layers, those in front hide those behind
                    CHECK(worst > 0.2 * bound);
            }
        }
}

TEST_CASE("A budget gets the cheapest format that keeps it", "[wire_format]")
{
    CHECK(dfb::cheapestWithin(1e-2, 2, 1, 0) == WireFormat::Unorm8);
    CHECK(dfb::cheapestWithin(1e-2, 3, 1, 0) == WireFormat::Unorm16); // 2 bytes, and better than Float16 for so few
    CHECK(dfb::cheapestWithin(2e-3, 4, 1, 0) == WireFormat::Unorm16);
    CHECK(dfb::cheapestWithin(2e-3, 4096, 1, 0) == WireFormat::Float16);
    CHECK(dfb::cheapestWithin(2e-3, 0, 1, 0) == WireFormat::Float16);
    CHECK(dfb::cheapestWithin(5e-4, 8, 1, 0) == WireFormat::Unorm16);
    CHECK(dfb::cheapestWithin(5e-4, 64, 1, 0) == WireFormat::Float32);
    CHECK(dfb::cheapestWithin(1e-5, 2, 1, 0) == WireFormat::Float32);
    CHECK(dfb::cheapestWithin(2e-3, 0, 8, 0) == WireFormat::Float32);
    CHECK(dfb::cheapestWithin(2e-3, 0, 1, 8) == WireFormat::Float32); // a bright background shines through
}

namespace {

template <class Op>
std::size_t changedDepths(const dfb::testing::TileInputs<Op::tileSize>& in, WireFormat format)
{
    dfb::testing::TileWire wire;
    wire.precision = format;
    const auto exact = dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA32F);
    const auto out = dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA32F, true, wire);
    std::size_t changed = 0;
    for (std::size_t i = 0; i < exact.depth.size(); ++i)
        changed += out.depth[i] != exact.depth[i];
    return changed;
}

} // namespace

TEST_CASE("The image's depth is the same in any format, however thin a layer is", "[wire_format]")
{
    using Tile = dfb::testing::TileInputs<16>::Tile;
    for (const WireFormat format : lossy) {
        INFO(dfb::nameOf(format));
        for (std::uint64_t seed = 1; seed <= 12; ++seed) {
            const auto in = dfb::testing::adversarial<16>(seed, 3, 1 + static_cast<int>(seed % 2), false, true);
            CHECK(changedDepths<dfb::BasicAlphaBlend<16>>(in, format) == 0);
            CHECK(changedDepths<dfb::BasicOrderedBlend<16>>(in, format) == 0);
            CHECK(changedDepths<dfb::BasicDepthComposite<16>>(in, format) == 0);
            const auto image = dfb::testing::adversarial<16>(seed, 1, 2, true, true);
            CHECK(changedDepths<dfb::BasicImageParallel<16>>(image, format) == 0);
        }
        // Alphas that each format rounds to 0, in front of something solid.
        dfb::testing::TileInputs<16> in;
        Tile& front = in.add(0, 0);
        const float alphas[] = {1e-3f, 1e-6f, 1e-13f, 1e-45f};
        for (int i = 0; i < 256; ++i) {
            front.color[4 * i + 3] = alphas[i % 4];
            front.depth[i] = 1.5f;
        }
        in.add(0, 1).fill({0.5f, 0.5f, 0.5f, 0.5f}, 2.5f);
        CHECK(changedDepths<dfb::BasicAlphaBlend<16>>(in, format) == 0);
    }
}

TEST_CASE("Tiles in lossy formats are within the bound, those out of range are exact", "[wire_format]")
{
    using Op = dfb::BasicAlphaBlend<16>;
    for (std::uint64_t seed = 1; seed <= 24; ++seed)
        for (const WireFormat format : lossy) {
            const bool inRange = seed % 2 == 0;
            const int layers = 1 + static_cast<int>(seed % 7);
            const auto in = dfb::testing::adversarial<16>(seed, layers, 1 + static_cast<int>(seed % 3), false, inRange);
            const auto exact = dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA32F);
            dfb::testing::TileWire wire;
            wire.precision = format;
            const auto out = dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA32F, true, wire);
            CHECK(out.depth == exact.depth);
            CHECK(out.report.orderUndefinedPixels == 0);
            if (!inRange)
                continue;
            double worst = 0;
            for (std::size_t i = 0; i < out.color.size() / 4; ++i)
                worst =
                    std::max(worst, std::abs(static_cast<double>(out.value(i)) - static_cast<double>(exact.value(i))));
            INFO(dfb::nameOf(format) << ", seed " << seed);
            CHECK(worst <= dfb::wireErrorBound(format, layers, 1, 1) + 0x1p-23);
            CHECK(out.bytes <= exact.bytes);
        }
    // Emissive colours are above their alpha.
    dfb::testing::TileInputs<16> in;
    auto& tile = in.add(0, 1);
    for (int i = 0; i < 16 * 16; ++i)
        tile.color[4 * i] = 0.1f * static_cast<float>(i);
    dfb::testing::TileWire wire;
    wire.precision = WireFormat::Unorm8;
    CHECK(dfb::testing::runTileOp<Op>(in, {0}, dfb::OutputFormat::RGBA32F, true, wire)
          == dfb::testing::runTileOp<Op>(in, {0}, dfb::OutputFormat::RGBA32F));
}

TEST_CASE("What is behind opaque layers is left out, and changes pixels by no more than the threshold", "[wire_format]")
{
    Random random(7);
    dfb::testing::TileInputs<8> in;
    in.background = {0.5f, 1, 0, 1};
    for (std::uint32_t source = 0; source < 40; ++source) {
        auto& tile = in.add(0, source);
        for (int i = 0; i < 64; ++i) {
            const float alpha = i < 8 ? 1.0f : 0.3f * uniform(random);
            tile.color[4 * i] = alpha * uniform(random);
            tile.color[4 * i + 1] = alpha;
            tile.color[4 * i + 3] = alpha;
            tile.depth[i] = uniform(random);
        }
    }
    using Op = dfb::BasicAlphaBlend<8>;
    const auto exact = dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA32F);
    for (const float threshold : {0.2f, 0.01f, 1e-6f}) {
        dfb::testing::TileWire wire;
        wire.minTransmittance = threshold;
        const auto out = dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA32F, true, wire);
        CHECK(out.depth == exact.depth);
        double worst = 0;
        for (std::size_t i = 0; i < out.color.size() / 4; ++i)
            worst = std::max(worst, std::abs(static_cast<double>(out.value(i)) - static_cast<double>(exact.value(i))));
        INFO(threshold << ": " << worst);
        CHECK(worst <= static_cast<double>(threshold));
        CHECK((worst > 0.2 * static_cast<double>(threshold) || threshold < 1e-4f));
    }
}

#if defined(DFB_HAS_SNAPPY)
TEST_CASE("Compression changes nothing, in any format", "[wire_format]")
{
    using Op = dfb::BasicAlphaBlend<16>;
    const dfb::SnappyCodec codec;
    for (std::uint64_t seed = 1; seed <= 12; ++seed)
        for (const WireFormat format :
             {WireFormat::Float32, WireFormat::Float16, WireFormat::Unorm16, WireFormat::Unorm8}) {
            const auto in = dfb::testing::adversarial<16>(seed, 3, 1, false, seed % 2 == 0);
            dfb::testing::TileWire wire;
            wire.precision = format;
            const auto plain = dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA32F, true, wire);
            wire.codec = &codec;
            const auto packed = dfb::testing::runTileOp<Op>(in, in.order(), dfb::OutputFormat::RGBA32F, true, wire);
            CHECK(packed == plain);
            CHECK(packed.bytes <= plain.bytes);
        }
}
#endif

} // namespace wire_format_cases

// WireCodes: rows have the same codes and values, bit for bit, as single values.
namespace wire_codes_cases {

namespace {

using namespace dfb::detail; // NOLINT: all of it is looked at

constexpr float infinity = std::numeric_limits<float>::infinity();

// Floats from 0 to `most`: codes and ties between them, with their neighbours; denormals; any values.
std::vector<float> floatsUpTo(float most, const std::vector<double>& ties)
{
    std::vector<float> values{0.0f, -0.0f, 0x1p-149f, 0x1p-126f, 0x1p-25f, 0x1p-24f, 0x1p-14f, most};
    for (const double tie : ties) {
        auto below = static_cast<float>(tie), above = below;
        values.push_back(below);
        for (int i = 0; i < 3; ++i) {
            values.push_back(below = std::nextafter(below, 0.0f));
            values.push_back(above = std::nextafter(above, infinity));
        }
    }
    std::mt19937 random(7);
    std::uint32_t mostBits = bitsOf(most);
    for (int i = 0; i < 100000; ++i) {
        values.push_back(floatOf(static_cast<std::uint32_t>(random() % (std::uint64_t{mostBits} + 1))));
        values.push_back(most * static_cast<float>(random() >> 8) * 0x1p-24f);
    }
    values.erase(std::remove_if(values.begin(), values.end(), [&](float v) { return v > most; }), values.end());
    while (values.size() % 4)
        values.push_back(0);
    return values;
}

// The middles between neighbouring halves up to 2^15, and the halves themselves.
std::vector<double> tiesOfHalves()
{
    std::vector<double> ties;
    for (std::uint16_t half = 0; half < 0x7800; ++half) {
        const double low = positiveFromHalf(half), high = positiveFromHalf(static_cast<std::uint16_t>(half + 1));
        ties.push_back(low);
        ties.push_back(0.5 * (low + high));
    }
    return ties;
}
std::vector<double> tiesOfIntegers(int most)
{
    std::vector<double> ties;
    for (int i = 0; i < 2 * most; ++i)
        ties.push_back(0.5 * i);
    return ties;
}

// Encodes arbitrary pixels with scales of 1, all at once and in rows of any width and alignment.
template <class Code>
int wrongEncoded(const std::vector<float>& values)
{
    using Word = typename Code::Word;
    const WireScales one{1, 1};
    int wrong = 0;
    const auto check = [&](std::size_t first, int count, std::size_t offset) {
        const std::size_t bytes = 4 * sizeof(Word) * static_cast<std::size_t>(count);
        std::vector<std::byte> fast(bytes + offset + 64, std::byte{0xa5}), plain(fast);
        encodePixels<Code>(values.data() + first, count, one, plain.data() + offset);
        DFB_FASTEST(encodePixels<Code>, encodePixelsAvx2<Code>, values.data() + first, count, one,
                    fast.data() + offset);
        wrong += fast != plain;
        for (std::size_t i = 0; i < 4 * static_cast<std::size_t>(count); ++i) {
            Word word = 0;
            std::memcpy(&word, plain.data() + offset + sizeof word * i, sizeof word);
            wrong += word != Code::of(values[first + i]);
        }
        wrong +=
            std::count(plain.begin() + static_cast<std::ptrdiff_t>(offset + bytes), plain.end(), std::byte{0xa5}) != 64;
    };
    check(0, static_cast<int>(values.size() / 4), 0);
    for (int width = 0; width <= 70; ++width)
        for (std::size_t offset = 0; offset < 8; ++offset)
            check((static_cast<std::size_t>(width) * 509 + offset) % (values.size() - 300), width, offset);
    return wrong;
}

// Decodes the first `count` codes, all at once and in rows of any width and alignment.
template <class Code>
int wrongDecoded(std::size_t count)
{
    using Word = typename Code::Word;
    const WireScales by{0x1p-14f / 3, 1.0f / 7, 0x1p-60f};
    std::vector<std::byte> bytes(count * sizeof(Word));
    for (std::size_t i = 0; i < count; ++i) {
        const auto word = static_cast<Word>(i);
        std::memcpy(bytes.data() + i * sizeof word, &word, sizeof word);
    }
    int wrong = 0;
    const auto check = [&](std::size_t first, int pixels) { // begins within a word, which must work as well
        std::vector<float> fast(4 * static_cast<std::size_t>(pixels) + 8, -7), plain(fast);
        const bool plainIn = decodePixels<Code>(bytes.data() + first, pixels, by, plain.data());
        const bool fastIn =
            DFB_FASTEST(decodePixels<Code>, decodePixelsAvx2<Code>, bytes.data() + first, pixels, by, fast.data());
        bool isIn = true;
        wrong += std::memcmp(fast.data(), plain.data(), fast.size() * sizeof(float)) != 0;
        wrong += std::count(plain.end() - 8, plain.end(), -7.0f) != 8;
        for (std::size_t i = 0; i < 4 * static_cast<std::size_t>(pixels); ++i) {
            Word word = 0;
            std::memcpy(&word, bytes.data() + first + i * sizeof word, sizeof word);
            const float expected = i % 4 < 3   ? Code::valueOf(word) * by.color
                                   : word == 0 ? by.leastAlpha
                                               : Code::valueOf(word) * by.alpha;
            wrong += bitsOf(plain[i]) != bitsOf(expected);
            isIn = isIn && word <= Code::most;
        }
        wrong += plainIn != isIn || fastIn != isIn;
    };
    check(0, static_cast<int>(count / 4));
    for (int width = 0; width <= std::min(70, static_cast<int>(count / 4) - 3); ++width)
        for (std::size_t first = 0; first < 8; first += sizeof(Word))
            check(first, width);
    return wrong;
}

} // namespace

TEST_CASE("Rows of pixels are encoded as numbers alone are", "[wire_codes]")
{
    CHECK(wrongEncoded<HalfCode>(floatsUpTo(0x1p15f, tiesOfHalves())) == 0);
    CHECK(wrongEncoded<Unorm16Code>(floatsUpTo(65535, tiesOfIntegers(65535))) == 0);
    CHECK(wrongEncoded<Unorm8Code>(floatsUpTo(255, tiesOfIntegers(255))) == 0);
}

TEST_CASE("Each channel has its scale", "[wire_codes]")
{
    std::vector<float> rgba;
    std::vector<std::uint8_t> expected;
    for (int i = 0; i < 4 * 19; ++i) {
        rgba.push_back(static_cast<float>(i % 11) / (i % 4 == 3 ? 10.0f : 20.0f));
        expected.push_back(static_cast<std::uint8_t>(10 * (i % 11)));
    }
    const WireScales by{200, 100};
    std::vector<std::uint8_t> codes(rgba.size());
    encodePixels<Unorm8Code>(rgba.data(), 19, by, reinterpret_cast<std::byte*>(codes.data()));
    CHECK(codes == expected);
    codes.assign(codes.size(), 0);
    DFB_FASTEST(encodePixels<Unorm8Code>, encodePixelsAvx2<Unorm8Code>, rgba.data(), 19, by,
                reinterpret_cast<std::byte*>(codes.data()));
    CHECK(codes == expected);
}

TEST_CASE("Rows of codes are decoded as codes alone are, all of them", "[wire_codes]")
{
    CHECK(wrongDecoded<HalfCode>(0x7c00) == 0); // numbers from 0 on
    CHECK(wrongDecoded<Unorm16Code>(0x10000) == 0);
    CHECK(wrongDecoded<Unorm8Code>(0x100) == 0);
}

TEST_CASE("A pixel out of range is seen wherever it is", "[wire_codes]")
{
    const float nan = std::numeric_limits<float>::quiet_NaN();
    std::mt19937 random(4);
    int wrong = 0;
    for (const float maxColor : {1.0f, 0.3f, 1e30f, 1e-30f})
        for (int width = 1; width <= 70; ++width)
            for (int round = 0; round < 40; ++round) {
                std::vector<float> row(static_cast<std::size_t>(4 * width) + 3);
                float* rgba = row.data() + round % 4;
                for (int i = 0; i < 4 * width; ++i)
                    rgba[i] = i % 4 == 3 ? 1.0f : maxColor * static_cast<float>(random() >> 8) * 0x1p-24f;
                wrong += !arePixelsInRange(rgba, width, maxColor);
                wrong += !DFB_FASTEST(arePixelsInRange, arePixelsInRangeAvx2, rgba, width, maxColor);
                const std::size_t pixel = random() % static_cast<unsigned>(width), channel = random() % 4;
                float* at = rgba + 4 * pixel;
                const float alphas[] = {1.0f, 0.5f, 0x1p-149f, 0.0f, -0.0f};
                at[0] = at[1] = at[2] = 0;
                at[3] = alphas[random() % 5];
                const float limit = channel == 3 ? 1.0f : maxColor * at[3];
                const float values[] = {nan,
                                        infinity,
                                        -infinity,
                                        -0x1p-149f,
                                        -0.0f,
                                        0.0f,
                                        limit,
                                        std::nextafter(limit, 0.0f),
                                        std::nextafter(limit, infinity)};
                at[channel] = values[random() % 9];
                bool expected = at[3] >= 0 && at[3] <= 1;
                for (int c = 0; c < 3; ++c)
                    expected = expected && at[c] >= 0 && at[c] <= maxColor * at[3];
                wrong += arePixelsInRange(rgba, width, maxColor) != expected;
                wrong += DFB_FASTEST(arePixelsInRange, arePixelsInRangeAvx2, rgba, width, maxColor) != expected;
            }
    CHECK(wrong == 0);
}

} // namespace wire_codes_cases
