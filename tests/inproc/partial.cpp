// The cases of tests/algorithms/partial.hpp.
#include "everywhere.hpp"

#include "../algorithms/partial.hpp"
