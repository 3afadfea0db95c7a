// By default each source file compiles the functions of dfb that it uses. The target dfb::compiled compiles them once,
// and defines DFB_COMPILED for all that link it. A function that can be compiled once stands in its header as
//
//   DFB_COMPILED_ONCE void f();
//
// Its body, with the same macro before it, stands where DFB_HAS_BODIES is 1. An instantiation of a template stands as
//
//   DFB_COMPILED_TEMPLATE(class Template<Argument>);
#pragma once

#include <dfb/version.hpp>

#if defined(DFB_COMPILED)
#define DFB_COMPILED_ONCE
#else
#define DFB_COMPILED_ONCE inline
#endif

#if !defined(DFB_COMPILED) || defined(DFB_COMPILING) // the latter in dfb/compiled.cpp alone
#define DFB_HAS_BODIES 1
#else
#define DFB_HAS_BODIES 0
#endif

#if defined(DFB_COMPILING)
#define DFB_COMPILED_TEMPLATE(...) template __VA_ARGS__
#elif defined(DFB_COMPILED)
#define DFB_COMPILED_TEMPLATE(...) extern template __VA_ARGS__
#else
#define DFB_COMPILED_TEMPLATE(...) static_assert(true)
#endif

// Either all files of a program or of a shared library use dfb::compiled, or none. Files that do not use it have this
// variable as thread_local. dfb::compiled has it as an ordinary one, to which the files that use it point. So the
// linker refuses a mixture. The variable is hidden: a library that uses dfb::compiled may be linked with one that does
// not.
#if defined(__ELF__)
extern "C" {
#if defined(DFB_COMPILING)
__attribute__((visibility("hidden"))) int dfb_either_all_files_with_dfb_compiled_or_none = 0;
#elif !defined(DFB_COMPILED)
__attribute__((used, weak, visibility("hidden"))) thread_local int dfb_either_all_files_with_dfb_compiled_or_none = 0;
#else
extern __attribute__((visibility("hidden"))) int dfb_either_all_files_with_dfb_compiled_or_none;
__attribute__((used)) static int* const dfb_uses_dfb_compiled = &dfb_either_all_files_with_dfb_compiled_or_none;
#endif
}
#endif
