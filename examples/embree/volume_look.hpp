// VolumeLook: the colours and opacities of a volume, the range of values that they cover, and its isosurfaces.
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
    float standsOutFrom = 0.006f;    // the camera has to show more opaque values
    bool isTomography = false;       // its values look like those of a body

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
