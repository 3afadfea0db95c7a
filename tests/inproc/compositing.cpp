// The cases of tests/algorithms/compositing.hpp.
#include "everywhere.hpp"

#include "../algorithms/compositing.hpp"
