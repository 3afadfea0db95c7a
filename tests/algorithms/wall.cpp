// The cases of wall.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "wall.hpp"

template algorithms::Result algorithms::inProcess<algorithms::Wall>(int);
template algorithms::Result algorithms::inProcess<algorithms::WallProgressive>(int);
