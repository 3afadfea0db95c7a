// clip: the part of a ray that is in a box.
#pragma once

#include <dfb/render/world.hpp>

#include <algorithm>
#include <cmath>
#include <limits>

namespace bench {

// The distances at which a ray enters and leaves a box that is wider by `slack`; false if it misses.
inline bool clip(const dfb::Box3& box, float slack, const dfb::Vec3& origin, const dfb::Vec3& direction, float& enter,
                 float& leave)
{
    enter = 0;
    leave = std::numeric_limits<float>::max();
    const auto along = [&](float lower, float upper, float from, float to) {
        const float a = (lower - slack - from) / to, b = (upper + slack - from) / to;
        if (std::isnan(a) || std::isnan(b)) // 0 / 0: a ray within a face has no limit here
            return;
        enter = std::max(enter, std::min(a, b));
        leave = std::min(leave, std::max(a, b));
    };
    along(box.lower.x, box.upper.x, origin.x, direction.x);
    along(box.lower.y, box.upper.y, origin.y, direction.y);
    along(box.lower.z, box.upper.z, origin.z, direction.z);
    return enter <= leave;
}

} // namespace bench
