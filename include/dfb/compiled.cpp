// All that dfb::compiled compiles once; see compiled.hpp.
#define DFB_COMPILING
#include <dfb/dfb.hpp>
