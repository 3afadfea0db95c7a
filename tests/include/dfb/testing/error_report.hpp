// ErrorReport: how much an image differs from the exact one.
#pragma once

#include <dfb/testing/reference.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <string>

namespace dfb::testing {

// All figures but `others` and `wrongOthers` are of values of colour and alpha, 4 to a pixel. add() adds the values of
// an image, one by one, or another report.
struct ErrorReport {
    std::int64_t values = 0;
    double maxAbs = 0; // of finite values
    double sumSquares = 0;
    double peak = 0; // the largest exact value
    // How many values are this far from the rounded exact value, in ulps: 0, 1, 2 to 3, 4 to 7, ..., and last 2^14 or
    // more. Values that are not finite where the exact one is count in the last place, too.
    std::array<std::int64_t, 16> ulps{};
    std::int64_t bytes = 0, wrongBytes = 0;   // of 8-bit values: all, and those that are not the exact value rounded
    int maxLevels = 0;                        // the most levels by which such a value is off
    std::int64_t others = 0, wrongOthers = 0; // values of depth and auxiliary channels: all, and those that are wrong

    // If the exact value is not finite, or rounds to no finite float, every measured value counts as right.
    void add(float measured, Exact exact)
    {
        ++values;
        const float rounded = toFloat(exact);
        std::int64_t distance = ulpsBetween(measured, rounded);
        if (!std::isfinite(measured) || !std::isfinite(rounded)) {
            ++ulps[distance == 0 || !std::isfinite(rounded) ? 0 : ulps.size() - 1];
            return;
        }
        const double error = std::abs(static_cast<double>(static_cast<Exact>(measured) - exact));
        maxAbs = std::max(maxAbs, error);
        sumSquares += error * error;
        peak = std::max(peak, std::abs(static_cast<double>(exact)));
        std::size_t bin = 0;
        for (; distance > 0 && bin + 1 < ulps.size(); distance /= 2)
            ++bin;
        ++ulps[bin];
    }

    // `expected`: toUnorm8() or toSrgb8() of the exact value.
    void addByte(std::uint8_t measured, std::uint8_t expected)
    {
        ++bytes;
        wrongBytes += measured != expected;
        maxLevels = std::max(maxLevels, std::abs(int{measured} - int{expected}));
    }

    // Adds a value of depth or of an auxiliary channel.
    void addOther(bool isWrong)
    {
        ++others;
        wrongOthers += isWrong;
    }

    void add(const ErrorReport& other)
    {
        values += other.values;
        maxAbs = std::max(maxAbs, other.maxAbs);
        sumSquares += other.sumSquares;
        peak = std::max(peak, other.peak);
        for (std::size_t i = 0; i < ulps.size(); ++i)
            ulps[i] += other.ulps[i];
        bytes += other.bytes;
        wrongBytes += other.wrongBytes;
        maxLevels = std::max(maxLevels, other.maxLevels);
        others += other.others;
        wrongOthers += other.wrongOthers;
    }

    double rmse() const { return values > 0 ? std::sqrt(sumSquares / static_cast<double>(values)) : 0.0; }
    // In decibels; infinite if there is no error.
    double psnr() const
    {
        return sumSquares > 0 ? 20 * std::log10(peak / rmse()) : std::numeric_limits<double>::infinity();
    }
    // All distances, in ulps, are less than this.
    std::int64_t ulpsBelow() const
    {
        std::size_t last = ulps.size() - 1;
        while (last > 0 && ulps[last] == 0)
            --last;
        return last + 1 == ulps.size() ? std::numeric_limits<std::int64_t>::max() : std::int64_t{1} << last;
    }

    std::string text() const
    {
        std::string all = std::to_string(values) + " values, max abs " + std::to_string(maxAbs) + ", RMSE "
                          + std::to_string(rmse()) + ", PSNR " + std::to_string(psnr()) + " dB; by ulps:";
        for (const std::int64_t count : ulps)
            all += ' ' + std::to_string(count);
        return all + "; " + std::to_string(wrongBytes) + " of " + std::to_string(bytes) + " bytes wrong, by up to "
               + std::to_string(maxLevels) + "; " + std::to_string(wrongOthers) + " of " + std::to_string(others)
               + " values of depth and auxiliary channels wrong";
    }
};

} // namespace dfb::testing
