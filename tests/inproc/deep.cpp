// The cases of tests/algorithms/deep.hpp.
#include "everywhere.hpp"

#include "../algorithms/deep.hpp"
