// The cases of distribution.hpp with ranks in one process.
#define ALGORITHMS_WITHOUT_TESTS
#include "distribution.hpp"

template algorithms::Result algorithms::inProcess<algorithms::Mixed>(int);
template algorithms::Result algorithms::inProcess<algorithms::OtherBounds>(int);
template algorithms::Result algorithms::inProcess<algorithms::Unbalanced>(int);
template algorithms::Result algorithms::inProcess<algorithms::Ordered>(int);
template algorithms::Result algorithms::inProcess<algorithms::WrongOwner>(int);
