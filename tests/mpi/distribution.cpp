// The cases of tests/algorithms/distribution.hpp.
#include "everywhere.hpp"

#include "../algorithms/distribution.hpp"
