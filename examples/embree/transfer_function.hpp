// TransferFunction: from a value of a volume to colour and opacity. Pure functions, in linear RGB.
#pragma once

#include "vec.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

namespace example {

// The colour and opacity of a value; linear between points. The opacity is that of a slab as thick as 1/256 of the
// volume's largest extent.
struct TransferPoint {
    float value = 0; // 0 to 1: from the least to the greatest of the range that is shown
    float r = 0, g = 0, b = 0, opacity = 0;
};

// Ascending by value, two or more.
using TransferPoints = std::vector<TransferPoint>;

// The look of generated volumes: a blue haze, embers in it.
inline const TransferPoints& emberPoints()
{
    static const TransferPoints points = {{0.00f, 0.30f, 0.45f, 0.60f, 0.000f}, {0.08f, 0.30f, 0.45f, 0.60f, 0.000f},
                                          {0.12f, 0.32f, 0.50f, 0.66f, 0.012f}, {0.22f, 0.55f, 0.66f, 0.70f, 0.022f},
                                          {0.30f, 0.80f, 0.66f, 0.42f, 0.020f}, {0.40f, 0.88f, 0.40f, 0.12f, 0.110f},
                                          {0.55f, 0.78f, 0.16f, 0.06f, 0.160f}, {0.80f, 0.90f, 0.50f, 0.10f, 0.240f},
                                          {1.00f, 0.98f, 0.88f, 0.62f, 0.400f}};
    return points;
}

// Interpolates between the points; beyond them, the outermost one holds.
inline TransferPoint at(const TransferPoints& points, float value)
{
    if (value < points.front().value)
        return points.front();
    if (value > points.back().value)
        return points.back();
    std::size_t segment = 0;
    while (segment + 2 < points.size() && value > points[segment + 1].value)
        ++segment;
    const TransferPoint &a = points[segment], &b = points[segment + 1];
    const float f = (value - a.value) / (b.value - a.value);
    return {value, a.r + f * (b.r - a.r), a.g + f * (b.g - a.g), a.b + f * (b.b - a.b),
            a.opacity + f * (b.opacity - a.opacity)};
}

// A table from a normalised value to colour and opacity, the opacity corrected for the distance between samples.
class TransferFunction {
public:
    struct Entry {
        float r = 0, g = 0, b = 0, alpha = 0;
    };

    // `step`: distance between samples in units of 1/256 of the volume's largest extent.
    explicit TransferFunction(float step, const TransferPoints& points = emberPoints())
        : size_(sizeFor(points)), table_(static_cast<std::size_t>(size_) + 2), opaqueBefore_(table_.size() + 1, 0)
    {
        for (std::size_t i = 0; i < table_.size(); ++i) {
            const TransferPoint p = at(points, std::min(1.0f, static_cast<float>(i) / static_cast<float>(size_)));
            table_[i] = {p.r, p.g, p.b, p.opacity > 0 ? 1 - std::pow(1 - p.opacity, step) : 0};
            opaqueBefore_[i + 1] = opaqueBefore_[i] + (table_[i].alpha > 0);
        }
    }

    // Clamps the value to [0, 1].
    Entry operator()(float value) const
    {
        const float at = std::clamp(value, 0.0f, 1.0f) * static_cast<float>(size_);
        const std::size_t i = static_cast<std::size_t>(at);
        const float f = at - static_cast<float>(i);
        const Entry &a = table_[i], &b = table_[i + 1];
        return {a.r + f * (b.r - a.r), a.g + f * (b.g - a.g), a.b + f * (b.b - a.b), a.alpha + f * (b.alpha - a.alpha)};
    }

    // Whether every value in [lo, hi] has opacity 0, with room for the rounding of an interpolated value.
    bool isTransparent(float lo, float hi) const
    {
        const auto at = [this](float value) {
            return static_cast<std::size_t>(std::clamp(value, 0.0f, 1.0f) * static_cast<float>(size_));
        };
        return opaqueBefore_[at(hi + 1e-5f) + 2] == opaqueBefore_[at(lo - 1e-5f)];
    }

private:
    // Four entries or more between any two points that are not closer than values of 16 bits.
    static int sizeFor(const TransferPoints& points)
    {
        float least = 1;
        for (std::size_t i = 1; i < points.size(); ++i)
            if (const float gap = points[i].value - points[i - 1].value; gap > 0)
                least = std::min(least, gap);
        return static_cast<int>(std::clamp(4 / least, 1024.0f, 262144.0f));
    }

    int size_;
    std::vector<Entry> table_;
    std::vector<int> opaqueBefore_; // number of entries before this one with opacity above 0
};

} // namespace example
