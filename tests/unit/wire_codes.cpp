// WireCodes: rows have the codes and values, bit for bit, that numbers alone have.
#include "catch.hpp"

#include <dfb/wire/wire_format.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <random>
#include <vector>

namespace wire_codes_cases {

namespace {

using namespace dfb::detail; // NOLINT: all of it is looked at

constexpr float infinity = std::numeric_limits<float>::infinity();

// Floats from 0 to `most`: codes and ties between two by `step`, and their neighbours; denormals; any.
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

// Where neighbouring halves up to 2^15 are equally near, and the halves.
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

// Pixels as they come, encoded with scales of 1, all in one and in rows of any width and alignment.
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
        if (cpuHasF16c())
            encodePixelsAvx2<Code>(values.data() + first, count, one, fast.data() + offset);
        else
            encodePixels<Code>(values.data() + first, count, one, fast.data() + offset);
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

// All of the first `count` codes, and rows of any width and alignment.
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
    const auto check = [&](std::size_t first, int pixels) { // not at the start of a word: as bytes they are as good
        std::vector<float> fast(4 * static_cast<std::size_t>(pixels) + 8, -7), plain(fast);
        const bool plainIn = decodePixels<Code>(bytes.data() + first, pixels, by, plain.data());
        const bool fastIn = cpuHasF16c() ? decodePixelsAvx2<Code>(bytes.data() + first, pixels, by, fast.data())
                                         : decodePixels<Code>(bytes.data() + first, pixels, by, fast.data());
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
    if (cpuHasF16c()) {
        codes.assign(codes.size(), 0);
        encodePixelsAvx2<Unorm8Code>(rgba.data(), 19, by, reinterpret_cast<std::byte*>(codes.data()));
        CHECK(codes == expected);
    }
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
                wrong += cpuHasF16c() && !arePixelsInRangeAvx2(rgba, width, maxColor);
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
                wrong += cpuHasF16c() && arePixelsInRangeAvx2(rgba, width, maxColor) != expected;
            }
    CHECK(wrong == 0);
}

} // namespace wire_codes_cases
