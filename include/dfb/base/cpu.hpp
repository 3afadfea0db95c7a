// Cpu: loops that are compiled a second time for processors with AVX2, which is asked for at run time. Not for FMA: the
// results are the same, bit for bit. DFB_AVX2_F16C and cpuHasF16c() are the same where halves are converted.
//
//   DFB_INLINE void body(...) { ... }
//   DFB_AVX2 inline void bodyAvx2(...) { body(...); }
//   cpuHasAvx2() ? bodyAvx2(...) : body(...);
#pragma once

#include <dfb/version.hpp>

#include <cstdint>

#if (defined(__GNUC__) || defined(__clang__)) && defined(__x86_64__)
#include <immintrin.h>
#define DFB_HAS_AVX2_CLONES 1
#define DFB_AVX2 __attribute__((target("avx2")))
#define DFB_AVX2_F16C __attribute__((target("avx2,f16c")))
#define DFB_INLINE inline __attribute__((always_inline))
#include <cpuid.h>
#else
#define DFB_AVX2
#define DFB_AVX2_F16C
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

// Whether there is AVX2, and F16C as well: conversion of halves, which all such processors have, but not all
// hypervisors show.
inline bool cpuHasF16c() noexcept
{
#if defined(DFB_HAS_AVX2_CLONES)
    static const bool has = [] { // Clang 14 knows no name for it
        unsigned a = 0, b = 0, c = 0, d = 0;
        return cpuHasAvx2() && __get_cpuid(1, &a, &b, &c, &d) != 0 && (c & bit_F16C) != 0;
    }();
    return has;
#else
    return false;
#endif
}

// How many bits are below the lowest that is set; there is one.
inline int zerosBelow(std::uint64_t bits) noexcept
{
#if defined(__GNUC__)
    return __builtin_ctzll(bits);
#else
    int count = 0;
    for (; !(bits & 1); bits >>= 1)
        ++count;
    return count;
#endif
}

// Calls f(first, count) for each run of bits that are set, from the lowest on.
template <class F>
void forEachRun(std::uint64_t bits, const F& f)
{
    for (int at = 0; bits != 0;) {
        const int skipped = zerosBelow(bits);
        bits >>= skipped;
        at += skipped;
        const int run = ~bits == 0 ? 64 : zerosBelow(~bits);
        f(at, run);
        bits = run == 64 ? 0 : bits >> run;
        at += run;
    }
}

} // namespace dfb::detail
