// The cases of tests/algorithms/moving.hpp.
#include "everywhere.hpp"

#include "../algorithms/moving.hpp"
