// The cases of tests/algorithms/corners.hpp.
#include "everywhere.hpp"

#include "../algorithms/corners.hpp"
