// The cases of hidden.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "hidden.hpp"

template algorithms::Result algorithms::inProcess<algorithms::Hidden>(int);
