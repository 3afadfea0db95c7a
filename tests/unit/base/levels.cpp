// Levels: rows that are converted many values at a time have the same bytes as single values, and values that are said
// to be far from a tie are far from it.
#include "catch.hpp"

#include <dfb/base/levels.hpp>
#include <dfb/image.hpp>
#include <dfb/testing/adversarial.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <random>
#include <vector>

namespace levels_cases {

namespace {

using dfb::OutputFormat;

struct Levels {
    std::vector<std::uint8_t> bytes;
    double farthest = 0;
};

// Finds the level by search. `isNear`: whether a threshold is within 2^-35 of the value.
std::uint8_t searchedSrgb8(double value, bool& isNear)
{
    static const auto t = [] {
        std::array<double, 255> all{}; // the least value of each level from 1 on
        for (int k = 0; k < 255; ++k) {
            const auto boundary = dfb::detail::srgbBoundary(k);
            all[static_cast<std::size_t>(k)] = boundary.low > 0 ? std::nextafter(boundary.high, 2.0) : boundary.high;
        }
        return all;
    }();
    const std::ptrdiff_t level = value >= t.front() ? std::upper_bound(t.begin(), t.end(), value) - t.begin() : 0;
    const auto at = [&](std::ptrdiff_t k) { return t[static_cast<std::size_t>(k)]; };
    value = std::min(value, 2.0); // infinity is far from any threshold
    isNear = (level > 0 && value - at(level - 1) <= 0x1p-35 * value)
             || (level < 255 && at(level) - value <= 0x1p-35 * at(level));
    return static_cast<std::uint8_t>(level);
}

// Converts one value at a time.
template <class Real>
Levels oneByOne(const Real* rgba, int count, OutputFormat format)
{
    Levels result;
    for (int i = 0; i < 4 * count; ++i) {
        const auto value = static_cast<double>(rgba[i]);
        if (format == OutputFormat::SRGBA8 && i % 4 < 3) {
            bool isNear = false;
            result.bytes.push_back(searchedSrgb8(value, isNear));
            result.farthest = isNear ? 0.5 : result.farthest;
        } else {
            result.bytes.push_back(dfb::detail::toUnorm8(value));
            const double scaled = 255 * (value > 0 ? std::min(value, 1.0) : 0.0);
            result.farthest = std::max(result.farthest, std::abs(scaled - std::nearbyint(scaled)));
        }
    }
    return result;
}

constexpr std::uint8_t untouched = 0xa5;

// Converts with convertPixels() to memory at this offset.
template <class Real>
Levels together(const Real* rgba, int count, OutputFormat format, std::size_t offset = 0)
{
    Levels result;
    const auto size = static_cast<std::size_t>(4 * count);
    std::vector<std::uint8_t> bytes(size + offset + 64, untouched);
    result.farthest = dfb::convertPixels(rgba, count, format, reinterpret_cast<std::byte*>(bytes.data() + offset));
    CHECK(std::count(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(offset), untouched)
          == static_cast<std::ptrdiff_t>(offset));
    CHECK(std::count(bytes.end() - 64, bytes.end(), untouched) == 64);
    result.bytes.assign(bytes.begin() + static_cast<std::ptrdiff_t>(offset), bytes.end() - 64);
    return result;
}

// Converts in plain C++, where the processor has faster instructions.
template <class Real>
Levels plainly(const Real* rgba, int count, OutputFormat format)
{
    Levels result;
    result.bytes.resize(static_cast<std::size_t>(4 * count));
    result.farthest = format == OutputFormat::SRGBA8 ? dfb::detail::toLevels<true>(rgba, count, result.bytes.data())
                                                     : dfb::detail::toLevels<false>(rgba, count, result.bytes.data());
    return result;
}

// The distance from a tie may be given as too large, but only for a value that is no tie, and never as too small.
bool isRight(const Levels& result, const Levels& expected)
{
    return result.bytes == expected.bytes && result.farthest >= expected.farthest
           && result.farthest <= std::max(expected.farthest, std::min(expected.farthest + 0x1p-15, 0.5 - 0x1p-16));
}

// Tests each value among values that are exact levels, so that only this value decides how its block is converted. It
// takes each place in a block in turn.
template <class Real>
class Alone {
public:
    int wrong = 0;

    void add(double value)
    {
        for (const OutputFormat format : {OutputFormat::RGBA8, OutputFormat::SRGBA8}) {
            Real rgba[4 * pixels];
            for (std::size_t i = 0; i < 4 * pixels; ++i)
                rgba[i] = static_cast<Real>(static_cast<double>((37 * i + next_) % 256) / 255);
            rgba[next_++ % (4 * pixels)] = static_cast<Real>(value);
            const Levels expected = oneByOne(rgba, pixels, format);
            wrong += !isRight(together(rgba, pixels, format), expected);
            const Levels plain = plainly(rgba, pixels, format);
            wrong += plain.bytes != expected.bytes || plain.farthest < expected.farthest
                     || plain.farthest > expected.farthest;
        }
    }

    // Adds the value and its neighbours: floats, doubles, and steps of a sixteenth of a float.
    void addAround(double value)
    {
        auto low = static_cast<float>(value), high = low;
        double below = value, above = value;
        add(value);
        for (int i = 0; i < 12; ++i) {
            add(static_cast<double>(low));
            add(static_cast<double>(high));
            add(below);
            add(above);
            low = std::nextafter(low, -1.0f);
            high = std::nextafter(high, 2.0f);
            below = std::nextafter(below, -1.0);
            above = std::nextafter(above, 2.0);
        }
        for (int i = -64; i <= 64; ++i)
            add(value * (1 + i * 0x1p-28));
        for (const double off : {0x1p-37, 0x1.fp-36, 0x1.08p-35, 0x1p-34, 0x1p-30}) { // of what is near for sRGB
            add(value * (1 - off));
            add(value * (1 + off));
        }
    }

private:
    static constexpr int pixels = 8;
    std::size_t next_ = 0;
};

template <class Real>
int wrongAround()
{
    Alone<Real> alone;
    for (int k = 0; k < 255; ++k) {
        alone.addAround((k + 0.5) / 255);
        alone.addAround(dfb::detail::srgbBoundary(k).high);
    }
    return alone.wrong;
}

template <class Real>
int wrongAtEnds()
{
    using Limits = std::numeric_limits<Real>;
    Alone<Real> alone;
    std::vector<Real> values{
        Limits::quiet_NaN(), Limits::infinity(), Limits::max(), Limits::min(), Limits::denorm_min(),
        Real(0x1p-126),      Real(0x1p-149),     Real(1),       Real(2),       Real(255),
        Real(0x1p31),        Real(0x1p40),       Real(0x1p-13), Real(1e-3),    Real(0)};
    for (const Real value : std::vector<Real>(values)) {
        values.push_back(std::nextafter(value, Real(-1)));
        values.push_back(std::nextafter(value, Real(3)));
    }
    for (int round = 0; round < 32; ++round) // one round for each place in a block
        for (const Real value : values) {
            alone.add(static_cast<double>(value));
            alone.add(static_cast<double>(-value));
        }
    return alone.wrong;
}

template <class Real>
int wrongInRows()
{
    using Limits = std::numeric_limits<Real>;
    const Real strange[] = {Limits::quiet_NaN(),
                            Limits::infinity(),
                            -Limits::infinity(),
                            Limits::denorm_min(),
                            -Limits::min(),
                            Real(-0.0),
                            Real(1.5),
                            Real(-1),
                            Real(0.5)};
    std::mt19937 random(5);
    int wrong = 0;
    for (int width = 0; width <= 70; ++width)
        for (std::size_t offset = 0; offset < 9; ++offset) {
            std::vector<Real> row(offset + static_cast<std::size_t>(4 * width));
            for (Real& value : row)
                value = random() % 64 == 0 ? strange[random() % 9]
                                           : static_cast<Real>(static_cast<double>(random()) / 0x1p32);
            for (const OutputFormat format : {OutputFormat::RGBA8, OutputFormat::SRGBA8}) {
                const Real* rgba = row.data() + offset;
                wrong += !isRight(together(rgba, width, format, offset), oneByOne(rgba, width, format));
            }
        }
    return wrong;
}

} // namespace

TEST_CASE("Rows have the levels that values alone have, next to every tie and threshold", "[levels]")
{
    CHECK(wrongAround<float>() == 0);
    CHECK(wrongAround<double>() == 0);
}

TEST_CASE("Rows have the levels that values alone have, also of what is no colour", "[levels]")
{
    CHECK(wrongAtEnds<float>() == 0);
    CHECK(wrongAtEnds<double>() == 0);
}

TEST_CASE("Rows of any width and alignment are converted, and nothing beside them", "[levels]")
{
    CHECK(wrongInRows<float>() == 0);
    CHECK(wrongInRows<double>() == 0);
}

TEST_CASE("The cells of the sRGB curve say what a search says, at their edges and within", "[levels]")
{
    using dfb::detail::SrgbCells;
    const SrgbCells& cells = dfb::detail::srgbCells();
    int wrong = 0;
    const auto check = [&](double value) {
        bool expected = false, isNear = false;
        const std::uint8_t level = searchedSrgb8(value, expected);
        wrong += cells.levelOf(value, isNear) != level || isNear != expected;
    };
    std::size_t thresholds = 0;
    for (std::uint32_t cell = 0; cell < SrgbCells::count; ++cell) {
        const float start = dfb::detail::floatOf((SrgbCells::first + cell) << 16);
        for (const double end : {-1.0, 2.0})
            check(std::nextafter(static_cast<double>(start), end));
        check(static_cast<double>(start));
        for (std::uint32_t i = 0; i < 0x10000; i += 97)
            check(static_cast<double>(dfb::detail::floatOf(((SrgbCells::first + cell) << 16) + i)));
        // There must be room around the edges of a cell for values that are near a threshold.
        const std::uint32_t place = cells.data()[cell] & 0x1ffff;
        thresholds += place != SrgbCells::none;
        wrong += place != SrgbCells::none && (place < 8 || place > 0xfff8);
    }
    CHECK(wrong == 0);
    CHECK(thresholds == 255);
}

TEST_CASE("Floats are copied, doubles rounded", "[levels]")
{
    dfb::testing::Random random(2);
    std::vector<float> row;
    for (int i = 0; i < 4 * 70; ++i)
        row.push_back(dfb::testing::anyColor(random, 1));
    row[5] = std::numeric_limits<float>::infinity();
    row[6] = std::numeric_limits<float>::denorm_min();
    row[7] = -0.0f;
    const std::vector<double> doubles(row.begin(), row.end());
    for (int width = 0; width <= 70; ++width) {
        std::vector<float> a(row.size(), -7), b(a);
        std::vector<float> expected(a);
        std::copy_n(row.begin(), 4 * width, expected.begin());
        CHECK(dfb::convertPixels(row.data(), width, OutputFormat::RGBA32F, reinterpret_cast<std::byte*>(a.data()))
              <= 0);
        CHECK(dfb::convertPixels(doubles.data(), width, OutputFormat::RGBA32F, reinterpret_cast<std::byte*>(b.data()))
              <= 0);
        CHECK(a == expected);
        CHECK(b == expected);
    }
}

} // namespace levels_cases
