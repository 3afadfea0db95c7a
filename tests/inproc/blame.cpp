// The cases of tests/algorithms/blame.hpp.
#include "everywhere.hpp"

#include "../algorithms/blame.hpp"
