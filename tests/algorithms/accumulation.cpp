// The cases of accumulation.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "accumulation.hpp"

template algorithms::Result algorithms::inProcess<algorithms::NextSamples>(int);
template algorithms::Result algorithms::inProcess<algorithms::MovingSamples>(int);
