// The version of dfb, and its demands on the compiler.
#pragma once

#define DFB_VERSION_MAJOR 0
#define DFB_VERSION_MINOR 1
#define DFB_VERSION_PATCH 0

#if defined(__FAST_MATH__) || defined(__ASSOCIATIVE_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error \
    "dfb: -ffast-math and parts of it remove infinities, NaNs and rounding that compositing relies on; compile without"
#endif
