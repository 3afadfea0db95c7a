// The cases of compositing.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "compositing.hpp"

template algorithms::Result algorithms::inProcess<algorithms::AuxChannels>(int);
template algorithms::Result algorithms::inProcess<algorithms::AuxImageParallel>(int);
template algorithms::Result algorithms::inProcess<algorithms::Nearest>(int);
template algorithms::Result algorithms::inProcess<algorithms::BlackInFront>(int);
