// The cases of quiet.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "quiet.hpp"

template algorithms::Result algorithms::inProcess<algorithms::MissingInputs>(int);
template algorithms::Result algorithms::inProcess<algorithms::QuietOthers>(int);
template algorithms::Result algorithms::inProcess<algorithms::QuietWall>(int);
