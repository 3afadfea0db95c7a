// With compiled.cpp: a program of which one file has the library as headers, and one links dfb::compiled.
#include <dfb/compiled.hpp>

int compiled();

int main() { return compiled(); }
