// FloatEnvironment: while it lives, the thread computes with denormals. Renderers turn flush-to-zero on for
// their threads, and compositing may run on those.
#pragma once

#include <dfb/version.hpp>

#if defined(__SSE2__) || defined(_M_X64)
#include <xmmintrin.h>
#endif

namespace dfb::detail {

class FloatEnvironment {
public:
    FloatEnvironment(const FloatEnvironment&) = delete;
    FloatEnvironment& operator=(const FloatEnvironment&) = delete;
#if defined(__SSE2__) || defined(_M_X64)
    FloatEnvironment() : saved_(_mm_getcsr()) { _mm_setcsr(saved_ & ~flushAndDenormalsZero); }
    ~FloatEnvironment() { _mm_setcsr(saved_); }

private:
    static constexpr unsigned flushAndDenormalsZero = 0x8040;
    unsigned saved_;
#else
    FloatEnvironment() = default;
#endif
};

} // namespace dfb::detail
