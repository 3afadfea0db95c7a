// The cases of tests/algorithms/hidden.hpp.
#include "everywhere.hpp"

#include "../algorithms/hidden.hpp"
