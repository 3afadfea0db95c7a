// The cases of tests/algorithms/quiet.hpp.
#include "everywhere.hpp"

#include "../algorithms/quiet.hpp"
