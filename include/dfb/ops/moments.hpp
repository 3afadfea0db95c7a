// Moments: mean and variance of pixels, in a form whose partial results merge in any tree.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

namespace dfb {

// Of samples of 4 channels: their number, their sum, and the sum over the channels of squared deviations from the mean
// (M2), merged by the pairwise formula of Chan, Golub and LeVeque (1979). For n samples that are floats the mean is
// within n * 2^-53 of exact, relative to the mean of |x|: for 10^7 of them far below the last bit of a float. M2 is
// free of cancellation, however large the mean is beside the spread.
struct Moments {
    std::int64_t count = 0;
    std::array<double, 4> sum{};
    double m2 = 0;

    // By how much M2 of `n` samples of this sum grows by `k` more that have a sum and no spread of their own.
    static double growth(std::int64_t n, const double* sum, std::int64_t k, const double* other) noexcept
    {
        if (n == 0 || k == 0)
            return 0;
        const double a = static_cast<double>(n), b = static_cast<double>(k);
        double squares = 0;
        for (std::size_t c = 0; c < 4; ++c) {
            const double difference = other[c] / b - sum[c] / a;
            squares += difference * difference;
        }
        return squares * (a * b / (a + b));
    }

    void add(const std::array<double, 4>& sample) noexcept { merge({1, sample, 0}); }

    void merge(const Moments& other) noexcept
    {
        m2 += other.m2 + growth(count, sum.data(), other.count, other.sum.data());
        for (std::size_t c = 0; c < 4; ++c)
            sum[c] += other.sum[c];
        count += other.count;
    }

    double mean(std::size_t channel) const noexcept
    {
        return count > 0 ? sum[channel] / static_cast<double>(count) : 0;
    }
    // Mean over the channels of the variance of the samples, unbiased; 0 for fewer than 2.
    double variance() const noexcept { return count > 1 ? m2 / (4 * static_cast<double>(count - 1)) : 0; }
    // The same of the mean: the square of its standard error.
    double varianceOfMean() const noexcept { return count > 1 ? variance() / static_cast<double>(count) : 0; }
};

} // namespace dfb
