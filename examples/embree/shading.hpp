// Shading: the transfer function of volumes and the light on everything. Pure functions, in linear RGB.
#pragma once

#include "vec.hpp"

#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

namespace example {

// A table from a normalised value to colour and opacity, the opacity corrected for the distance between samples.
class TransferFunction {
public:
    struct Entry {
        float r = 0, g = 0, b = 0, alpha = 0;
    };

    // `step`: distance between samples in units of 1/256 of the volume's largest extent, to which the opacities of
    // the control points below refer.
    explicit TransferFunction(float step) : table_(size + 2), opaqueBefore_(size + 3, 0)
    {
        struct Point {
            float value, r, g, b, alpha;
        };
        static const Point points[] = {{0.00f, 0.30f, 0.45f, 0.60f, 0.000f}, {0.08f, 0.30f, 0.45f, 0.60f, 0.000f},
                                       {0.12f, 0.32f, 0.50f, 0.66f, 0.012f}, {0.22f, 0.55f, 0.66f, 0.70f, 0.022f},
                                       {0.30f, 0.80f, 0.66f, 0.42f, 0.020f}, {0.40f, 0.88f, 0.40f, 0.12f, 0.110f},
                                       {0.55f, 0.78f, 0.16f, 0.06f, 0.160f}, {0.80f, 0.90f, 0.50f, 0.10f, 0.240f},
                                       {1.00f, 0.98f, 0.88f, 0.62f, 0.400f}};
        std::size_t segment = 0;
        for (std::size_t i = 0; i < table_.size(); ++i) {
            const float value = std::min(1.0f, static_cast<float>(i) / static_cast<float>(size));
            while (segment + 2 < std::size(points) && value > points[segment + 1].value)
                ++segment;
            const Point &a = points[segment], &b = points[segment + 1];
            const float f = (value - a.value) / (b.value - a.value);
            const float alpha = a.alpha + f * (b.alpha - a.alpha);
            table_[i] = {a.r + f * (b.r - a.r), a.g + f * (b.g - a.g), a.b + f * (b.b - a.b),
                         alpha > 0 ? 1 - std::pow(1 - alpha, step) : 0};
            opaqueBefore_[i + 1] = opaqueBefore_[i] + (table_[i].alpha > 0);
        }
    }

    // Clamps the value to [0, 1].
    Entry operator()(float value) const
    {
        const float at = std::clamp(value, 0.0f, 1.0f) * static_cast<float>(size);
        const std::size_t i = static_cast<std::size_t>(at);
        const float f = at - static_cast<float>(i);
        const Entry &a = table_[i], &b = table_[i + 1];
        return {a.r + f * (b.r - a.r), a.g + f * (b.g - a.g), a.b + f * (b.b - a.b), a.alpha + f * (b.alpha - a.alpha)};
    }

    // Whether every value in [lo, hi] has opacity 0, with room for the rounding of an interpolated value.
    bool isTransparent(float lo, float hi) const
    {
        const auto at = [](float value) {
            return static_cast<std::size_t>(std::clamp(value, 0.0f, 1.0f) * static_cast<float>(size));
        };
        return opaqueBefore_[at(hi + 1e-5f) + 2] == opaqueBefore_[at(lo - 1e-5f)];
    }

private:
    static constexpr int size = 1024;
    std::vector<Entry> table_;
    std::vector<int> opaqueBefore_; // number of entries before this one with opacity above 0
};

// One distant light that moves with the camera, so that every frame of an orbit is lit.
struct Light {
    Vec3 direction; // unit, from the surface to the light
    static constexpr float ambient = 0.30f;

    // Diffuse and ambient part for a unit normal of which either side counts.
    float diffuse(const Vec3& normal) const { return ambient + 0.80f * std::fabs(dot(normal, direction)); }

    // Highlight for a unit normal and the unit direction of the view ray.
    float specular(const Vec3& normal, const Vec3& view) const
    {
        const float c = std::fabs(dot(normal, unit(direction - view)));
        const float c2 = c * c, c4 = c2 * c2, c8 = c4 * c4, c16 = c8 * c8;
        return 0.22f * c16 * c16;
    }

    Vec3 shade(const Vec3& color, const Vec3& normal, const Vec3& view) const
    {
        const float s = specular(normal, view);
        return color * diffuse(normal) + Vec3{s, s, s};
    }
};

} // namespace example
