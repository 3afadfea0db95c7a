// The cases of moving.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "moving.hpp"

template algorithms::Result algorithms::inProcess<algorithms::MovingBricks>(int);
template algorithms::Result algorithms::inProcess<algorithms::ChangingDeclarations>(int);
