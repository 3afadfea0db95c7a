// With compiled.cpp, a program in which one file uses the library as headers and the other links dfb::compiled.
#include <dfb/compiled.hpp>

int compiled();

int main() { return compiled(); }
