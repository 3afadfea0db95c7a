// Spheres: the atoms of a molecule.
#pragma once

#include "vec.hpp"

#include <cstdint>
#include <vector>

namespace example {

struct Sphere {
    Vec3 center;
    float radius = 0;
    Vec3 color; // linear RGB
};

// A rank's run of the spheres of a file that several ranks have read together.
struct SphereShare {
    std::vector<Sphere> spheres;
    std::uint64_t first = 0; // the number of the first in the file
};

} // namespace example
