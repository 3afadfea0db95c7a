// The cases of in_flight.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "in_flight.hpp"

template algorithms::Result algorithms::inProcess<algorithms::TwoFrames>(int);
template algorithms::Result algorithms::inProcess<algorithms::LoopsInFlight>(int);
template algorithms::Result algorithms::inProcess<algorithms::TwoFrameBuffers>(int);
