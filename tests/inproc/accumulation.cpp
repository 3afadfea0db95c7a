// The cases of tests/algorithms/accumulation.hpp.
#include "everywhere.hpp"

#include "../algorithms/accumulation.hpp"
