// The cases of sampling.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "sampling.hpp"

template algorithms::Result algorithms::inProcess<algorithms::Distributions>(int);
template algorithms::Result algorithms::inProcess<algorithms::Dynamic>(int);
template algorithms::Result algorithms::inProcess<algorithms::Accumulation>(int);
template algorithms::Result algorithms::inProcess<algorithms::Reset>(int);
template algorithms::Result algorithms::inProcess<algorithms::Adaptive>(int);
template algorithms::Result algorithms::inProcess<algorithms::DarkCorners>(int);
