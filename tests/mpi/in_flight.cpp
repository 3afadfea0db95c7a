// The cases of tests/algorithms/in_flight.hpp.
#include "everywhere.hpp"

#include "../algorithms/in_flight.hpp"
