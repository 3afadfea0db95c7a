// The cases of corners.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "corners.hpp"

template algorithms::Result algorithms::inProcess<algorithms::Corners>(int);
