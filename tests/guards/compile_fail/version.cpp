#if defined(CASE_FAST_MATH) // flags: -ffast-math expect: dfb: -ffast-math
#endif
#include <dfb/version.hpp>
