// The cases of tests/algorithms/wall.hpp.
#include "everywhere.hpp"

#include "../algorithms/wall.hpp"
