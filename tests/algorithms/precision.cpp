// The cases of precision.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "precision.hpp"

template algorithms::Result algorithms::inProcess<algorithms::Precision>(int);
template algorithms::Result algorithms::inProcess<algorithms::OtherChannels>(int);
template algorithms::Result algorithms::inProcess<algorithms::NoPrecision>(int);
