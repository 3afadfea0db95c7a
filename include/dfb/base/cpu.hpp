// Cpu: compiles loops a second time for processors with AVX2 and F16C (conversion of half floats), and picks one at run
// time. FMA is not used, so that both give the same bits. One loop also exists for AVX-512.
//
//   DFB_INLINE void body(...) { ... }
//   fastest<body>(...);
//
// Where the loop for AVX2 is written by hand:
//
//   DFB_FASTEST(body, bodyAvx2, ...);
#pragma once

#include <dfb/version.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>

#define DFB_INLINE inline __attribute__((always_inline))
#if defined(__x86_64__)
#define DFB_HAS_AVX2_CLONES 1
#if defined(__clang__)
#define DFB_AVX2 __attribute__((target("avx2,f16c")))
#define DFB_AVX512 __attribute__((target("avx2,f16c,avx512f")))
#else // GCC 12 vectorizes few loops at -O2
#define DFB_AVX2 __attribute__((target("avx2,f16c"), optimize("O3")))
#define DFB_AVX512 __attribute__((target("avx2,f16c,avx512f"), optimize("O3")))
#endif
// Calls one of two functions with the same arguments: the second one if cpuHasAvx2(). On other architectures the second
// one need not exist.
#define DFB_FASTEST(plain, avx2, ...) (::dfb::detail::cpuHasAvx2() ? avx2(__VA_ARGS__) : plain(__VA_ARGS__))
#include <cpuid.h>
#else
#define DFB_FASTEST(plain, avx2, ...) plain(__VA_ARGS__)
#define DFB_AVX2
#endif

#if defined(__SSE2__)
#include <xmmintrin.h>
#endif

DFB_NAMESPACE_BEGIN
namespace detail {

// Whether the processor has AVX2 and F16C. All processors with AVX2 have F16C, but not all hypervisors show it.
inline bool cpuHasAvx2() noexcept
{
#if defined(DFB_HAS_AVX2_CLONES)
    // Not inline, so that this function is.
    static const bool has = []() __attribute__((noinline))
    {
        __builtin_cpu_init();
        unsigned a = 0, b = 0, c = 0, d = 0; // Clang 14 knows no name for F16C
        return __builtin_cpu_supports("avx2") != 0 && __get_cpuid(1, &a, &b, &c, &d) != 0 && (c & bit_F16C) != 0;
    }
    ();
    return has;
#else
    return false;
#endif
}

// Whether the processor has AVX-512 and does not lower its clock for it. Those that lower it lack VBMI2.
inline bool cpuHasAvx512() noexcept
{
#if defined(DFB_HAS_AVX2_CLONES)
    static const bool has = cpuHasAvx2() && __builtin_cpu_supports("avx512vbmi2") != 0;
    return has;
#else
    return false;
#endif
}

// fastest<Body>(...) calls Body, which is DFB_INLINE, in the version compiled for AVX2 if the processor has that.
template <auto Body, class... Arguments>
DFB_AVX2 inline auto withAvx2(Arguments... arguments) noexcept
{
    return Body(arguments...);
}
template <auto Body, class... Arguments>
inline auto fastest(Arguments... arguments) noexcept
{
    return DFB_FASTEST(Body, withAvx2<Body>, arguments...);
}

// Prefetches a piece of a row into the second-level cache, as processors do not predict where the next row begins. The
// first-level cache is too small: rows of an image are often a multiple of 4 KiB apart, so that rows of several inputs
// evict each other. Always inlined, as GCC removes calls of functions that only prefetch.
DFB_INLINE void prefetch(const std::byte* from, std::size_t bytes)
{
    for (std::size_t i = 0; i < bytes; i += 64)
        __builtin_prefetch(from + i, 0, 2);
}

// How many zeros are below the lowest bit that is set. At least one bit must be set.
inline int zerosBelow(std::uint64_t bits) noexcept { return __builtin_ctzll(bits); }

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

// Calls f(word, bits) for each word of 64 bits that has some of the bits [begin, end): its index, and which bits those
// are.
template <class F>
void forEachWord(int begin, int end, const F& f)
{
    for (int first = begin / 64 * 64; first < end; first += 64) {
        const int low = std::max(begin, first) - first, high = std::min(end, first + 64) - first;
        f(static_cast<std::size_t>(first / 64), ~std::uint64_t{0} << low & ~std::uint64_t{0} >> (64 - high));
    }
}

// FloatEnvironment: while it lives, its thread computes with denormals. Renderers turn flush-to-zero on for their
// threads, and compositing may run on those.
class FloatEnvironment {
public:
    FloatEnvironment(const FloatEnvironment&) = delete;
    FloatEnvironment& operator=(const FloatEnvironment&) = delete;
#if defined(__SSE2__)
    FloatEnvironment() : saved_(_mm_getcsr()) { _mm_setcsr(saved_ & ~flushAndDenormalsZero); }
    ~FloatEnvironment() { _mm_setcsr(saved_); }

private:
    static constexpr unsigned flushAndDenormalsZero = 0x8040;
    unsigned saved_;
#elif defined(__aarch64__)
    FloatEnvironment() : saved_(controlRegister()) { setControlRegister(saved_ & ~flushToZero); }
    ~FloatEnvironment() { setControlRegister(saved_); }

    static std::uint64_t controlRegister() noexcept
    {
        std::uint64_t value = 0;
        __asm__ volatile("mrs %0, fpcr" : "=r"(value));
        return value;
    }
    static void setControlRegister(std::uint64_t value) noexcept { __asm__ volatile("msr fpcr, %0" : : "r"(value)); }
    static constexpr std::uint64_t flushToZero = std::uint64_t{1} << 24;

private:
    std::uint64_t saved_;
#else
    FloatEnvironment() {} // not defaulted: compilers would call a variable of it unused
#endif
};

} // namespace detail

DFB_NAMESPACE_END
