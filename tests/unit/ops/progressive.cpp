// growthOfM2: sums of squared deviations neither drift nor cancel.
#include "catch.hpp"

#include <dfb/ops/progressive.hpp>

#include <array>
#include <cmath>
#include <cstdint>
#include <random>
#include <vector>

namespace progressive_cases {

namespace {

using Sample = std::array<double, 4>;

// The sums that Progressive keeps for each pixel.
struct Sums {
    std::int64_t count = 0;
    Sample sum{};
    double m2 = 0;

    void add(const Sample& sample)
    {
        m2 += dfb::detail::growthOfM2(count++, sum.data(), sample.data());
        for (std::size_t c = 0; c < 4; ++c)
            sum[c] += sample[c];
    }
};

double relative(double value, long double exact)
{
    return static_cast<double>(std::fabs((static_cast<long double>(value) - exact) / exact));
}

} // namespace

TEST_CASE("Squared deviations from a mean a million times as large do not cancel", "[progressive]")
{
    std::mt19937_64 random(7);
    std::normal_distribution<double> noise(1000.0, 1e-3);
    std::vector<Sample> samples(1000);
    Sums sums;
    for (Sample& s : samples) {
        s = {noise(random), noise(random), noise(random), 1};
        sums.add(s);
    }
    long double m2 = 0; // in two passes
    for (std::size_t c = 0; c < 4; ++c) {
        long double mean = 0;
        for (const Sample& s : samples)
            mean += static_cast<long double>(s[c]) / static_cast<long double>(samples.size());
        for (const Sample& s : samples)
            m2 += (static_cast<long double>(s[c]) - mean) * (static_cast<long double>(s[c]) - mean);
    }
    CHECK(relative(sums.m2, m2) < 1e-6); // 1e6 times the rounding of samples that are 1e6 spreads away
    CHECK(Sums().m2 == 0);
}

TEST_CASE("Ten million samples do not drift", "[progressive]")
{
    const std::int64_t count = 10000000;
    Sums sums;
    long double sum = 0, squares = 0;
    std::uint64_t state = 1;
    for (std::int64_t i = 0; i < count; ++i) {
        state = state * 6364136223846793005u + 1442695040888963407u;
        const double x = static_cast<double>(static_cast<float>(state >> 40) * 0x1p-24f); // a float in [0, 1)
        sums.add({x, x, x, 1});
        sum += static_cast<long double>(x);
        squares += static_cast<long double>(x) * static_cast<long double>(x);
    }
    const long double mean = sum / count, m2 = 3 * (squares - count * mean * mean);
    CHECK(relative(sums.sum[0] / static_cast<double>(count), mean) < 1e-11); // a float has 6e-8
    CHECK(sums.sum[3] == static_cast<double>(count));
    CHECK(relative(sums.m2, m2) < 1e-10);
}

} // namespace progressive_cases
