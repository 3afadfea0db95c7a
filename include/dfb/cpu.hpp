// Cpu: loops that are compiled a second time for processors with AVX2, which is asked for at run time. Not for FMA: the
// results are the same, bit for bit.
//
//   DFB_INLINE void body(...) { ... }
//   DFB_AVX2 inline void bodyAvx2(...) { body(...); }
//   cpuHasAvx2() ? bodyAvx2(...) : body(...);
#pragma once

#include <dfb/version.hpp>

#if (defined(__GNUC__) || defined(__clang__)) && defined(__x86_64__)
#include <immintrin.h>
#define DFB_HAS_AVX2_CLONES 1
#define DFB_AVX2 __attribute__((target("avx2")))
#define DFB_INLINE inline __attribute__((always_inline))
#else
#define DFB_AVX2
#define DFB_INLINE inline
#endif

namespace dfb::detail {

inline bool cpuHasAvx2() noexcept
{
#if defined(DFB_HAS_AVX2_CLONES)
    static const bool has = [] {
        __builtin_cpu_init();
        return __builtin_cpu_supports("avx2") != 0;
    }();
    return has;
#else
    return false;
#endif
}

} // namespace dfb::detail
