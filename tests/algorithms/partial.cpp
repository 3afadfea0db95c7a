// The cases of partial.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "partial.hpp"

template algorithms::Result algorithms::inProcess<algorithms::PartialFrames>(int);
template algorithms::Result algorithms::inProcess<algorithms::CancelledFrames>(int);
template algorithms::Result algorithms::inProcess<algorithms::ImageOfFrame>(int);
