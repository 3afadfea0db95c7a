// The version of dfb, the namespace of that version, and its demands on the compiler.
#pragma once

#define DFB_VERSION_MAJOR 0
#define DFB_VERSION_MINOR 2
#define DFB_VERSION_PATCH 0
#define DFB_TEXT_OF_(number) #number
#define DFB_TEXT_(number) DFB_TEXT_OF_(number)
// As text, such as "0.2.0".
#define DFB_VERSION DFB_TEXT_(DFB_VERSION_MAJOR) "." DFB_TEXT_(DFB_VERSION_MINOR) "." DFB_TEXT_(DFB_VERSION_PATCH)

// Everything stands in an inline namespace named after the version, such as dfb::v0_2. A program writes dfb::Image. If
// a process contains two versions, for example in two plugins, neither calls the functions of the other. Versions that
// differ only in the patch share the namespace: their classes and inline functions work together.
#define DFB_NAMESPACE_OF_(major, minor) v##major##_##minor
#define DFB_NAMESPACE_OF(major, minor) DFB_NAMESPACE_OF_(major, minor)
// clang-format off
#define DFB_NAMESPACE_BEGIN namespace dfb { inline namespace DFB_NAMESPACE_OF(DFB_VERSION_MAJOR, DFB_VERSION_MINOR) {
#define DFB_NAMESPACE_END } }
// clang-format on

// MPI is used where the CMake target dfb::mpi is linked. Without CMake's targets and pkg-config, which define
// DFB_COMPONENTS, it is used where the compiler finds mpi.h by itself, as mpicxx does.
#if !defined(DFB_HAS_MPI) && !defined(DFB_COMPONENTS) && !defined(DFB_COMPILED) && defined(__has_include)
#if __has_include(<mpi.h>)
#define DFB_HAS_MPI 1
#endif
#endif

#if !defined(__GNUC__) // defined by Clang as well
#error "dfb needs GCC or Clang"
#endif

#if __cplusplus < 201703L
#error "dfb needs C++17: compile with -std=c++17"
#endif

#if !defined(__EXCEPTIONS) || !defined(__GXX_RTTI)
#error "dfb needs exceptions and RTTI: compile without -fno-exceptions and -fno-rtti"
#endif

#if defined(None) || defined(Always)
#error "dfb: X11 defines None and Always as macros: include dfb before X11, or #undef both in between"
#endif

#if defined(__FAST_MATH__) || defined(__ASSOCIATIVE_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error \
    "dfb: -ffast-math and parts of it remove infinities, NaNs and rounding that compositing relies on; compile without"
#endif
