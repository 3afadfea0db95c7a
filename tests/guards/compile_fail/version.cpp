#if defined(CASE_FAST_MATH) // flags: -ffast-math expect: dfb: -ffast-math
#elif defined(CASE_X11) // expect: dfb: X11 defines None
#define None 0L
#endif
#include <dfb/version.hpp>
