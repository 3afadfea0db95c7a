// The cases of blame.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "blame.hpp"

template algorithms::Result algorithms::inProcess<algorithms::BlamedLoop>(int);
