// The cases of tests/algorithms/sampling.hpp.
#include "everywhere.hpp"

#include "../algorithms/sampling.hpp"
