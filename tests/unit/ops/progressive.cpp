// Moments: merged in any tree they are the same as added one by one, and do not drift.
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

// In two passes and long double.
std::array<long double, 2> exactOf(const std::vector<Sample>& samples)
{
    long double sum = 0, m2 = 0;
    for (const Sample& s : samples)
        sum += static_cast<long double>(s[0]);
    for (std::size_t c = 0; c < 4; ++c) {
        long double mean = 0;
        for (const Sample& s : samples)
            mean += static_cast<long double>(s[c]);
        mean /= static_cast<long double>(samples.size());
        for (const Sample& s : samples)
            m2 += (static_cast<long double>(s[c]) - mean) * (static_cast<long double>(s[c]) - mean);
    }
    return {sum / static_cast<long double>(samples.size()), m2};
}

double relative(double value, long double exact)
{
    return static_cast<double>(std::fabs((static_cast<long double>(value) - exact) / exact));
}

} // namespace

TEST_CASE("Moments of parts merge in any tree", "[moments]")
{
    std::mt19937_64 random(7);
    std::normal_distribution<double> noise(1000.0, 1e-3); // a mean a million times the spread
    std::vector<Sample> samples(1000);
    for (Sample& s : samples)
        s = {noise(random), noise(random), noise(random), 1};
    const auto exact = exactOf(samples);
    for (int round = 0; round < 50; ++round) {
        std::vector<dfb::Moments> parts;
        for (std::size_t i = 0; i < samples.size();) {
            dfb::Moments m;
            for (std::size_t n = 1 + random() % 40; n > 0 && i < samples.size(); --n)
                m.add(samples[i++]);
            parts.push_back(m);
            if (random() % 5 == 0)
                parts.emplace_back(); // an empty one changes nothing
        }
        while (parts.size() > 1) {
            const std::size_t a = random() % parts.size();
            std::size_t b = random() % parts.size();
            b = a == b ? (b + 1) % parts.size() : b;
            parts[a].merge(parts[b]);
            parts.erase(parts.begin() + static_cast<std::ptrdiff_t>(b));
        }
        REQUIRE(parts[0].count == 1000);
        CHECK(relative(parts[0].mean(0), exact[0]) < 1e-15);
        CHECK(relative(parts[0].m2, exact[1]) < 1e-6); // 1e6 times the rounding of samples that are 1e6 spreads away
    }
    CHECK(dfb::Moments().variance() == 0);
    CHECK(dfb::Moments().mean(2) == 0);
}

TEST_CASE("Ten million samples do not drift", "[moments]")
{
    const std::int64_t count = 10000000;
    dfb::Moments m;
    long double sum = 0, squares = 0;
    std::uint64_t state = 1;
    for (std::int64_t i = 0; i < count; ++i) {
        state = state * 6364136223846793005u + 1442695040888963407u;
        const double x = static_cast<double>(static_cast<float>(state >> 40) * 0x1p-24f); // a float in [0, 1)
        m.add({x, x, x, 1});
        sum += static_cast<long double>(x);
        squares += static_cast<long double>(x) * static_cast<long double>(x);
    }
    const long double mean = sum / count, m2 = 3 * (squares - count * mean * mean);
    CHECK(m.count == count);
    CHECK(relative(m.mean(0), mean) < 1e-11); // a float has 6e-8
    CHECK(m.mean(3) == 1.0);
    CHECK(relative(m.m2, m2) < 1e-10);
    CHECK(relative(m.varianceOfMean(), m2 / 4 / (count - 1) / count) < 1e-10);
}

} // namespace progressive_cases
