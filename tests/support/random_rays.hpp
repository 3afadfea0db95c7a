// Random points, and whether a ray meets a box, for tests of cameras.
#pragma once

#include <dfb/render/world.hpp>

#include <algorithm>
#include <limits>
#include <random>

namespace rays {

using Random = std::mt19937_64;

inline double uniform(Random& random, double low, double high)
{
    return low + (high - low) * static_cast<double>(random() >> 11) * 0x1p-53;
}

inline dfb::Vec3 point(Random& random, double extent)
{
    return {static_cast<float>(uniform(random, -extent, extent)), static_cast<float>(uniform(random, -extent, extent)),
            static_cast<float>(uniform(random, -extent, extent))};
}

// Whether a ray meets a box at a positive distance, in double.
inline bool meets(const dfb::Vec3& eye, const dfb::Vec3& direction, const dfb::Box3& box)
{
    const double o[3] = {eye.x, eye.y, eye.z}, d[3] = {direction.x, direction.y, direction.z};
    const double lower[3] = {box.lower.x, box.lower.y, box.lower.z}, upper[3] = {box.upper.x, box.upper.y, box.upper.z};
    double from = 0, to = std::numeric_limits<double>::infinity();
    for (int a = 0; a < 3; ++a) {
        if (d[a] == 0) {
            if (o[a] < lower[a] || o[a] > upper[a])
                return false;
            continue;
        }
        const double t0 = (lower[a] - o[a]) / d[a], t1 = (upper[a] - o[a]) / d[a];
        from = std::max(from, std::min(t0, t1));
        to = std::min(to, std::max(t0, t1));
    }
    return from <= to;
}

} // namespace rays
