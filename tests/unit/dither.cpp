// Dither: levels stay, no value is off by a level, means are right, colour does not exceed alpha.
#include "catch.hpp"

#include <dfb/image.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <set>
#include <vector>

namespace dither_cases {

namespace {

using dfb::OutputFormat;

constexpr OutputFormat formats[] = {OutputFormat::RGBA8, OutputFormat::SRGBA8};

// The linear value of a level, which need not be whole.
double lightOf(OutputFormat format, double level)
{
    const double s = level / 255;
    if (format == OutputFormat::RGBA8)
        return s;
    return s <= 0.04045 ? s / 12.92 : std::pow((s + 0.055) / 1.055, 2.4);
}
double levelOf(OutputFormat format, double light)
{
    if (format == OutputFormat::RGBA8)
        return 255 * light;
    return 255 * (light <= 0.04045 / 12.92 ? 12.92 * light : 1.055 * std::pow(light, 1 / 2.4) - 0.055);
}

template <class Real>
std::array<int, 4> pixel(OutputFormat format, Real color, Real alpha, int x, int y)
{
    const Real rgba[4] = {color, Real(0), color, alpha};
    std::byte out[4];
    dfb::ditherPixels(rgba, 1, format, x, y, out);
    return {static_cast<int>(out[0]), static_cast<int>(out[1]), static_cast<int>(out[2]), static_cast<int>(out[3])};
}

// Floats from 0 to 1: in equal steps, and `count` neighbours of each level and of each place where one pixel changes.
std::vector<float> values(OutputFormat format, int steps, int count)
{
    std::vector<float> result;
    for (int i = 0; i <= steps; ++i)
        result.push_back(static_cast<float>(i) / static_cast<float>(steps));
    for (int i = 0; i <= 255 * 128; ++i) {
        const auto value = static_cast<float>(lightOf(format, i / 128.0));
        float below = value, above = value;
        for (int k = 0; k < count; ++k) {
            result.push_back(below = std::max(0.0f, std::nextafter(below, -1.0f)));
            result.push_back(above = std::min(1.0f, std::nextafter(above, 2.0f)));
        }
    }
    return result;
}

// Of a constant colour over 8x8 pixels from (x, y) on: its levels and their light.
struct Mean {
    double level = 0, light = 0;
};
Mean meanOf(OutputFormat format, float color, float alpha, int x, int y)
{
    std::vector<float> row;
    for (int i = 0; i < 8; ++i)
        row.insert(row.end(), {color, color, color, alpha});
    Mean mean;
    std::byte out[4 * 8];
    for (int dy = 0; dy < 8; ++dy) {
        dfb::ditherPixels(row.data(), 8, format, x, y + dy, out);
        for (std::size_t i = 0; i < 8; ++i) {
            mean.level += static_cast<int>(out[4 * i + 1]) / 64.0;
            mean.light += lightOf(format, static_cast<int>(out[4 * i + 1])) / 64;
        }
    }
    return mean;
}

} // namespace

TEST_CASE("The ranks are those of Bayer's matrix, and repeat", "[dither]")
{
    const int first[] = {0, 32, 8, 40, 2, 34, 10, 42}, second[] = {48, 16, 56, 24, 50, 18, 58, 26};
    std::set<int> all;
    for (int y = 0; y < 8; ++y)
        for (int x = 0; x < 8; ++x) {
            all.insert(dfb::detail::ditherRank(x, y));
            CHECK(dfb::detail::ditherRank(x + 65528, y + 80) == dfb::detail::ditherRank(x, y));
        }
    CHECK(all.size() == 64);
    CHECK(*all.begin() == 0);
    CHECK(*all.rbegin() == 63);
    for (int x = 0; x < 8; ++x) {
        CHECK(dfb::detail::ditherRank(x, 0) == first[x]);
        CHECK(dfb::detail::ditherRank(x, 1) == second[x]);
    }
}

TEST_CASE("What is a level stays it at every place, ends clamp, NaN is 0", "[dither]")
{
    using Limits = std::numeric_limits<double>;
    int wrong = 0;
    for (const OutputFormat format : formats)
        for (int y = 0; y < 8; ++y)
            for (int x = 0; x < 8; ++x) {
                for (int k = 0; k < 256; ++k) {
                    const double value = lightOf(format, k);
                    wrong += pixel(format, value, 1.0, x, y) != std::array<int, 4>{k, 0, k, 255};
                    wrong += pixel(format, static_cast<float>(value), 1.0f, x, y) != std::array<int, 4>{k, 0, k, 255};
                }
                for (const double v : {-1.0, -0.0, 0.0, Limits::denorm_min(), -Limits::infinity(), Limits::quiet_NaN()})
                    wrong += pixel(format, v, v, x, y) != std::array<int, 4>{0, 0, 0, 0};
                for (const double v : {1.0, 1.0000001, 1e300, Limits::infinity()})
                    wrong += pixel(format, v, v, x, y) != std::array<int, 4>{255, 0, 255, 255};
            }
    CHECK(wrong == 0);
}

TEST_CASE("No value is off by a level or more, and thresholds choose between neighbours", "[dither]")
{
    // The lowest and the highest threshold; the others are in between.
    int wrong = 0, up = 0;
    for (const OutputFormat format : formats)
        for (const float value : values(format, 1 << 16, 3)) {
            const int high = pixel(format, value, 1.0f, 0, 0)[0], low = pixel(format, value, 1.0f, 0, 7)[0];
            for (const int level : {low, high})
                wrong += !(lightOf(format, level - 1) < value && value < lightOf(format, level + 1));
            wrong += high != low && high != low + 1;
            up += high != low;
        }
    CHECK(dfb::detail::ditherRank(0, 0) == 0);
    CHECK(dfb::detail::ditherRank(0, 7) == 63);
    CHECK(wrong == 0);
    CHECK(up > 10000);
}

TEST_CASE("The mean over any 8x8 pixels is the value, in levels and in light", "[dither]")
{
    double worstLevel = 0, worstLight = 0;
    int place = 0;
    for (const OutputFormat format : formats)
        for (const float value : values(format, 5000, 0)) {
            ++place;
            const Mean mean = meanOf(format, value, 1.0f, place % 11, place % 13);
            const double level = levelOf(format, value), below = std::min(254.0, std::floor(level));
            worstLevel = std::max(worstLevel, std::abs(mean.level - level));
            worstLight = std::max(worstLight,
                                  std::abs(mean.light - value) / (lightOf(format, below + 1) - lightOf(format, below)));
        }
    CHECK(worstLevel <= 1.0 / 64);
    CHECK(worstLight <= 1.0001 / 128);
    CHECK(worstLight > 0.9 / 128); // or nothing was dithered, to finer steps than there are
}

TEST_CASE("Alpha is rounded, and a colour up to alpha does not exceed it", "[dither]")
{
    int wrong = 0, capped = 0;
    for (const OutputFormat format : formats)
        for (int i = 0; i <= 2040; ++i)
            for (const double alpha : {i / 2040.0, std::nextafter(i / 2040.0, 0.0), std::nextafter(i / 2040.0, 1.0)})
                for (const double part : {1.0, 0.999, 0.99})
                    for (int k = 0; k < 64; ++k) {
                        const int x = k % 8, y = k / 8;
                        const auto got = pixel(format, part * alpha, alpha, x, y);
                        wrong += got[3] != dfb::detail::toUnorm8(alpha);
                        const int most = format == OutputFormat::RGBA8 ? got[3] : dfb::detail::toSrgb8(alpha);
                        wrong += got[0] > most || got[0] <= levelOf(format, part * alpha) - 1.0001;
                        capped += got[0] != pixel(format, part * alpha, 1.0, x, y)[0];
                    }
    CHECK(wrong == 0);
    CHECK(capped > 1000);
}

TEST_CASE("The level of alpha may yet become the other one of a tie", "[dither]")
{
    for (int k = 0; k < 255; ++k)
        for (int at = 0; at < 64; ++at)
            CHECK(pixel(OutputFormat::RGBA8, (k + 0.5) / 255, (k + 0.5) / 255, at % 8, at / 8)[0] <= k);
}

TEST_CASE("Emission is dithered as it is", "[dither]")
{
    for (const float alpha : {0.0f, 0.125f, 0.3f})
        CHECK(std::abs(meanOf(OutputFormat::RGBA8, 0.3001f, alpha, 3, 5).level - 255 * 0.3001) <= 1.0 / 64);
}

TEST_CASE("A row says how far alpha is from a level, and other formats are as ever", "[dither]")
{
    const double rgba[8] = {0.5, 0.25, 1.0, 0.5, 0.3, -1.0, 2.0, 0.0};
    std::byte dithered[2 * 16], plain[2 * 16];
    for (const OutputFormat format : formats) {
        CHECK(dfb::ditherPixels(rgba, 2, format, 0, 0, dithered) == 0.5);
        CHECK(dfb::ditherPixels(rgba + 4, 1, format, 0, 0, dithered) == 0);
    }
    dfb::ditherPixels(rgba, 2, OutputFormat::RGBA32F, 0, 0, dithered);
    dfb::convertPixels(rgba, 2, OutputFormat::RGBA32F, plain);
    CHECK(std::equal(dithered, dithered + 32, plain));
    dfb::ditherPixels(rgba, 2, OutputFormat::None, 0, 0, dithered);
    CHECK(std::equal(dithered, dithered + 32, plain));
}

} // namespace dither_cases
