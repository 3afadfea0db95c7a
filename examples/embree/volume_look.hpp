// VolumeLook: in which colours a volume is shown, over which values, and its isosurfaces.
#pragma once

#include "transfer_function.hpp"

#include <algorithm>
#include <optional>
#include <vector>

namespace example {

struct VolumeLook {
    TransferPoints points = emberPoints();
    float lo = 0, hi = 255;          // values of the data that the points' 0 and 1 stand for
    std::vector<float> isovalues;    // of the data, ascending
    std::vector<Vec3> isoColors;     // of each, linear RGB
    std::optional<float> isoOpacity; // none: that of the run's surfaces
    float standsOutFrom = 0.006f;    // the opacity of what a camera has to show
    bool isTomography = false;       // of a body, as far as the values tell

    float scale() const { return 1 / (hi - lo); }
    bool hasIsovalueIn(float least, float greatest) const
    {
        const auto first = std::lower_bound(isovalues.begin(), isovalues.end(), least);
        return first != isovalues.end() && *first <= greatest;
    }
    // Whether the camera has to show a value.
    bool standsOut(float value) const
    {
        return at(points, (value - lo) * scale()).opacity > standsOutFrom
               || (!isovalues.empty() && value >= isovalues.front());
    }
};

} // namespace example
