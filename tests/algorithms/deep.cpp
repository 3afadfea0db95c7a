// The cases of deep.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "deep.hpp"

template algorithms::Result algorithms::inProcess<algorithms::Deep>(int);
