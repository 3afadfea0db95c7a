// With DFB_TEST_BRIEF in the environment, tests that repeat something with other random numbers do so a quarter as
// often, and frames in one process run on fewer numbers of ranks. The brief presets of the sanitizers set it.
#pragma once

#include <cstdlib>

inline bool isBrief()
{
    static const bool is = std::getenv("DFB_TEST_BRIEF") != nullptr;
    return is;
}

// How often to repeat what is repeated `all` times otherwise.
inline int repeats(int all) { return isBrief() ? (all + 3) / 4 : all; }
