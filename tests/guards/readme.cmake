# Run with: cmake -DROOT=<source dir> -P readme.cmake
# Checks that the program in the README is examples/minimal.cpp, without the comment at its top.
file(READ ${ROOT}/examples/minimal.cpp program)
file(READ ${ROOT}/README.md readme)
string(REGEX REPLACE "^(//[^\n]*\n)+" "" program "${program}")
string(FIND "${readme}" "```cpp\n${program}```" place)
if(place EQUAL -1)
  message(FATAL_ERROR "README.md does not show examples/minimal.cpp as it is")
endif()
