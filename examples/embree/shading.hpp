// Shading: the light on everything. Pure functions, in linear RGB.
#pragma once

#include "vec.hpp"

#include <cmath>

namespace example {

// One distant light that moves with the camera, so that every frame of an orbit is lit.
struct Light {
    Vec3 direction; // unit, from the surface to the light
    static constexpr float ambient = 0.30f;

    // Diffuse and ambient part for a unit normal; both sides of a surface are lit alike.
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
