# Looks for another compiler than the one in use: clang++ if that is GCC, g++ if it is Clang. Sets DFB_OTHER_CXX to its
# path, and DFB_OTHER_CXX_WORKS to whether it really is that compiler (g++ may be Clang) and can build what the tests
# need.
set(DFB_OTHER_CXX_WORKS OFF)
if(CMAKE_CROSSCOMPILING OR NOT CMAKE_CXX_COMPILER_ID MATCHES "^(GNU|Clang|AppleClang)$")
  message(STATUS "dfb: no results are compared with another compiler's: there is none to go with this one")
  return()
endif()
if(CMAKE_CXX_COMPILER_ID STREQUAL "GNU")
  set(_other clang++)
  set(_is_other "defined(__clang__)")
else()
  set(_other g++)
  set(_is_other "!defined(__clang__)")
endif()
find_program(DFB_OTHER_CXX ${_other})
mark_as_advanced(DFB_OTHER_CXX)
if(NOT DFB_OTHER_CXX)
  message(STATUS "dfb: no results are compared with another compiler's: there is no ${_other}")
  return()
endif()
set(_probe ${CMAKE_CURRENT_BINARY_DIR}/other_compiler)
file(WRITE ${_probe}.cpp "#include <cstdio>
#include <string>
#include <vector>
#if !(${_is_other})
#error another name for the compiler in use
#endif
int main(int argc, char**) { std::puts(std::vector<std::string>(std::size_t(argc), \"works\").front().c_str()); }
")
execute_process(
  COMMAND ${DFB_OTHER_CXX} -std=c++17 -O2 -march=native -ffp-contract=off -pthread ${_probe}.cpp -o ${_probe}
  RESULT_VARIABLE _code OUTPUT_QUIET ERROR_VARIABLE _error)
if(_code EQUAL 0)
  set(DFB_OTHER_CXX_WORKS ON)
  message(STATUS "dfb: results are compared with those of ${DFB_OTHER_CXX}")
else()
  string(REGEX MATCH "[^\n]*error[^\n]*" _error "${_error}")
  message(STATUS "dfb: no results are compared with another compiler's: ${DFB_OTHER_CXX} makes no program: ${_error}")
endif()
