// Image: rounding to the output formats, exactly; and what an image lets one see.
#include "catch.hpp"

#include <dfb/image.hpp>
#include <dfb/testing/reference.hpp>

#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

namespace image_cases {

namespace {

// `count` neighbours of a value on each side, and the value.
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

// The double or float nearest to where sRGB level `level` becomes the next.
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
    // An exact result can be a tie that is not a double, as 1/6 = 42.5 / 255 from 3 passes. It is known to half an ulp,
    // and must round to even all the same. The next 2 doubles may go with it, or to their own side.
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

TEST_CASE("sRGB levels of values that a double can not tell from a boundary", "[image]")
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
