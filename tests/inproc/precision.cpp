// The cases of tests/algorithms/precision.hpp.
#include "everywhere.hpp"

#include "../algorithms/precision.hpp"
