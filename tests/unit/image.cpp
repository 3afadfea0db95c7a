// Image: exact rounding to the output formats, and access to the channels of an image.
#include "catch.hpp"

#include <dfb/base/levels.hpp>
#include <dfb/image.hpp>
#include <dfb/testing/reference.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iterator>
#include <limits>
#include <random>
#include <set>
#include <string>
#include <vector>

namespace image_cases {

namespace {

// The value, and `count` neighbours on each side.
template <class Real>
std::vector<Real> neighbourhood(Real value, int count)
{
    std::vector<Real> result{value};
    Real below = value, above = value;
    for (int i = 0; i < count; ++i) {
        result.push_back(below = std::nextafter(below, Real(-1)));
        result.push_back(above = std::nextafter(above, Real(2)));
    }
    return result;
}

// The double or float nearest to the threshold between sRGB level `level` and the next one.
template <class Real>
Real srgbThreshold(int level)
{
    const long double s = (2.0L * level + 1.0L) / 510.0L;
    return static_cast<Real>(s <= 0.04045L ? s / 12.92L : std::pow((s + 0.055L) / 1.055L, 2.4L));
}

template <class Real>
std::size_t wrongLinear()
{
    std::size_t wrong = 0;
    for (int k = 0; k <= 510; ++k) // levels and the ties between them
        for (Real v : neighbourhood(static_cast<Real>(k / 510.0L), 40))
            wrong += dfb::detail::toUnorm8(static_cast<double>(v)) != dfb::testing::toUnorm8(v);
    return wrong;
}

template <class Real>
std::size_t wrongSrgb()
{
    std::size_t wrong = 0;
    for (int k = 0; k < 255; ++k)
        for (Real v : neighbourhood(srgbThreshold<Real>(k), 6))
            wrong += dfb::detail::toSrgb8(static_cast<double>(v)) != dfb::testing::toSrgb8(v);
    return wrong;
}

} // namespace

TEST_CASE("toUnorm8 is exact rounding of every float, ties to even", "[image]")
{
    CHECK(wrongLinear<float>() == 0);
    CHECK(dfb::detail::toUnorm8(0.5) == 128); // 127.5
}

TEST_CASE("toUnorm8 is exact rounding of doubles, and the double nearest to a tie counts as the tie", "[image]")
{
    // An exact result can be a tie that is not a double, such as 1/6 = 42.5 / 255 after 3 passes. It is known to half
    // an ulp, and must still round to even. The next 2 doubles may round like it, or to their own side.
    std::size_t wrong = 0;
    for (int k = 0; k < 255; ++k) {
        const double tie = (k + 0.5) / 255;
        wrong += dfb::detail::toUnorm8(tie) != k + k % 2;
        double below = tie, above = tie;
        for (int i = 1; i <= 40; ++i) {
            below = std::nextafter(below, 0.0);
            above = std::nextafter(above, 1.0);
            const int low = dfb::detail::toUnorm8(below), high = dfb::detail::toUnorm8(above);
            wrong += !(low == k || (i <= 2 && low == k + k % 2)) + !(high == k + 1 || (i <= 2 && high == k + k % 2));
        }
    }
    CHECK(wrong == 0);
    CHECK(dfb::detail::toUnorm8(1.0 / 6) == 42);
    CHECK(dfb::detail::toUnorm8(5.0 / 6) == 212);
}

TEST_CASE("toSrgb8 is the exact level of every float", "[image]") { CHECK(wrongSrgb<float>() == 0); }

TEST_CASE("toSrgb8 is the exact level of every double", "[image]") { CHECK(wrongSrgb<double>() == 0); }

TEST_CASE("8-bit levels come back, ends clamp, NaN is 0", "[image]")
{
    for (int k = 0; k < 256; ++k)
        CHECK(dfb::detail::toUnorm8(k / 255.0) == k);
    using Limits = std::numeric_limits<double>;
    for (const double v : {-1.0, -0.0, 0.0, Limits::denorm_min(), -Limits::infinity(), Limits::quiet_NaN()}) {
        CHECK(dfb::detail::toUnorm8(v) == 0);
        CHECK(dfb::detail::toSrgb8(v) == 0);
    }
    for (const double v : {1.0, 1.0000001, 1e300, Limits::infinity()}) {
        CHECK(dfb::detail::toUnorm8(v) == 255);
        CHECK(dfb::detail::toSrgb8(v) == 255);
    }
    int last = -1;
    bool rising = true;
    for (int i = 0; i <= 20000; ++i) {
        const int level = dfb::detail::toSrgb8(i / 20000.0);
        rising = rising && level >= last && level <= last + 1;
        last = level;
    }
    CHECK(rising);
}

TEST_CASE("writePpm writes what a viewer shows, and says what it cannot write", "[image]")
{
    const std::string path = "image_test_" + std::to_string(std::random_device()()) + ".ppm";
    const auto pool = dfb::MemoryPool::create();
    const auto written = [&](dfb::OutputFormat format, const auto& fill) {
        dfb::Image image(*pool, 2, 2, format, 0);
        fill(image.bytes());
        dfb::writePpm(path, image);
        std::ifstream file(path, std::ios::binary);
        const std::string text{std::istreambuf_iterator<char>(file), {}};
        return text;
    };
    const std::string bytes = written(dfb::OutputFormat::RGBA8, [](std::byte* out) {
        for (int i = 0; i < 16; ++i)
            out[i] = static_cast<std::byte>(i);
    });
    CHECK(bytes == std::string("P6 2 2 255\n") + std::string("\0\1\2\4\5\6\10\11\12\14\15\16", 12));
    const std::string floats = written(dfb::OutputFormat::RGBA32F, [](std::byte* out) {
        const std::vector<float> values{0, 1, 0.5f, 1, 0.25f, 0, 2, 0, 1, 1, 1, 1, 0, 0, 0, 0};
        std::memcpy(out, values.data(), 16 * sizeof(float));
    });
    CHECK(floats == std::string("P6 2 2 255\n") + std::string("\0\377\274\211\0\377\377\377\377\0\0\0", 12));
    CHECK_THROWS_AS(dfb::writePpm(path, dfb::Image()), dfb::InvalidArgument);
    dfb::Image image(*pool, 1, 1, dfb::OutputFormat::RGBA8, 0);
    CHECK_THROWS_AS(dfb::writePpm("no_such_folder/" + path, image), dfb::InvalidArgument);
    CHECK_THROWS_WITH(dfb::writePpm("no_such_folder/a.ppm", image),
                      "dfb: invalid argument: cannot write no_such_folder/a.ppm: No such file or directory");
    std::remove(path.c_str());
}

TEST_CASE("convertPixels writes each format", "[image]")
{
    const double rgba[8] = {0.5, 0.25, 1.0, 0.5, 1.0 / 3.0, -1.0, 2.0, 0.0};
    std::vector<std::byte> out(2 * 16);
    dfb::convertPixels(rgba, 2, dfb::OutputFormat::RGBA32F, out.data());
    for (std::size_t i = 0; i < 8; ++i) {
        float v = 0;
        std::memcpy(&v, out.data() + 4 * i, 4);
        CHECK(v == static_cast<float>(rgba[i]));
    }
    dfb::convertPixels(rgba, 2, dfb::OutputFormat::RGBA8, out.data());
    const int linear[8] = {128, 64, 255, 128, 85, 0, 255, 0};
    for (std::size_t i = 0; i < 8; ++i)
        CHECK(static_cast<int>(out[i]) == linear[i]);
    dfb::convertPixels(rgba, 2, dfb::OutputFormat::SRGBA8, out.data());
    const int srgb[8] = {188, 137, 255, 128, 156, 0, 255, 0}; // alpha stays linear
    for (std::size_t i = 0; i < 8; ++i)
        CHECK(static_cast<int>(out[i]) == srgb[i]);
    out.assign(out.size(), std::byte{7});
    dfb::convertPixels(rgba, 2, dfb::OutputFormat::None, out.data());
    CHECK(out == std::vector<std::byte>(out.size(), std::byte{7}));
}

namespace {

// Number of bytes that differ between streamPixels(), with the remainder converted, and convertPixels(). Pixels begin
// `first` pixels behind the start of a cache line; bytes around them must not change.
template <class Real>
int wrongPastCache(int first, int count)
{
    alignas(64) static float plain[4 * 300], past[4 * 300];
    std::fill(std::begin(plain), std::end(plain), 7.0f);
    std::fill(std::begin(past), std::end(past), 7.0f);
    std::vector<Real> rgba;
    for (int i = 0; i < 4 * count; ++i)
        rgba.push_back(static_cast<Real>(i % 5 == 0 ? 1e-40 : i % 7 == 0 ? 3e38 : 1.0 / 3 * (i % 11 - 5)));
    if (count > 20) {
        rgba[70] = std::numeric_limits<Real>::infinity();
        rgba[71] = std::numeric_limits<Real>::quiet_NaN();
    }
    dfb::convertPixels(rgba.data(), count, dfb::OutputFormat::RGBA32F, reinterpret_cast<std::byte*>(plain + 4 * first));
    const int stored = dfb::detail::streamPixels(rgba.data(), count, past + 4 * first);
    dfb::detail::storesAreDone();
    if (stored < 0 || stored > count)
        return -1;
    dfb::convertPixels(rgba.data() + 4 * stored, count - stored, dfb::OutputFormat::RGBA32F,
                       reinterpret_cast<std::byte*>(past + 4 * (first + stored)));
    int wrong = 0;
    for (std::size_t i = 0; i < 4 * 300; ++i)
        wrong += std::memcmp(&plain[i], &past[i], sizeof plain[i]) != 0;
    return wrong;
}

} // namespace

TEST_CASE("Pixels stored past the cache are those of convertPixels(), at every place in a line", "[image]")
{
    for (const int first : {4, 5, 6, 7})
        for (const int count : {0, 1, 15, 16, 17, 18, 19, 20, 33, 64, 255}) {
            INFO(first << ", " << count);
            CHECK(wrongPastCache<double>(first, count) == 0);
            CHECK(wrongPastCache<float>(first, count) == 0);
        }
    float value[4] = {-0.0f, 0, 0, 0}, out[4 * 16];
    std::vector<float> zeros(4 * 16, -0.0f);
    if (dfb::detail::streamPixels(zeros.data(), 16, out) > 0)
        CHECK(std::memcmp(out, value + 1, sizeof(float)) == 0); // +0
}

TEST_CASE("An image shows what it has and says what it has not", "[image]")
{
    const auto pool = dfb::MemoryPool::create();
    const dfb::Image none;
    CHECK(none.empty());
    CHECK_THROWS_AS(none.rgba8(), dfb::InvalidArgument);
    CHECK_THROWS_AS(none.rgba32f(), dfb::InvalidArgument);
    CHECK_THROWS_AS(none.depth(), dfb::InvalidArgument);

    const dfb::Image bytes(*pool, 3, 5, dfb::OutputFormat::SRGBA8, 0);
    CHECK(bytes.pixelCount() == 15);
    CHECK_FALSE(bytes.empty());
    CHECK_FALSE(bytes.hasDepth());
    CHECK(bytes.rgba8() != nullptr);
    CHECK_THROWS_AS(bytes.rgba32f(), dfb::InvalidArgument);
    CHECK_THROWS_AS(bytes.depth(), dfb::InvalidArgument);

    const dfb::Image floats(*pool, 3, 5, dfb::OutputFormat::RGBA32F, dfb::depthChannel);
    CHECK(floats.rgba32f() != nullptr);
    CHECK(floats.depth() != nullptr);
    CHECK_THROWS_AS(floats.rgba8(), dfb::InvalidArgument);
}

TEST_CASE("sRGB levels of values that a double cannot tell from a boundary", "[image]")
{
    using dfb::detail::DoubleDouble;
    int wrong = 0;
    for (int k = 0; k < 255; ++k) {
        const DoubleDouble boundary = dfb::detail::srgbBoundary(k);
        for (const double off : {-1e-25, 1e-25, -1e-19, 1e-19, -1e-12, 1e-12}) {
            const DoubleDouble value = boundary * DoubleDouble::sum(1.0, off);
            const auto exact =
                static_cast<dfb::testing::Exact>(value.high) + static_cast<dfb::testing::Exact>(value.low);
            wrong += dfb::detail::toSrgb8(value) != dfb::testing::toSrgb8(exact);
            bool isNear = false;
            dfb::detail::srgbCells().levelOf(value.high, isNear);
            wrong += std::abs(off) < 1e-15 && !isNear;
        }
    }
    CHECK(wrong == 0);
}

} // namespace image_cases

// Dither: exact levels stay, no value is off by a level, means are right, and colour does not exceed alpha.
namespace dither_cases {

namespace {

using dfb::OutputFormat;

constexpr OutputFormat formats[] = {OutputFormat::RGBA8, OutputFormat::SRGBA8};

// The linear value of a level, which may be fractional.
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

// Floats from 0 to 1 in equal steps, and `count` neighbours of each level and of each value at which one pixel changes.
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

// The mean level and the mean light of a constant colour over 8x8 pixels from (x, y) on.
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
    // The lowest and the highest threshold. All others are in between.
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
    CHECK(worstLight > 0.9 / 128); // otherwise nothing was dithered
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
