// Runs the cases of tests/algorithms with ranks in this process.
#pragma once

#include "../algorithms/everywhere.hpp"

template <class Case>
void everywhere()
{
    const algorithms::Result one = algorithms::inProcess<Case>(1);
    CHECK(one.wrong == "");
    for (const int ranks : {2, 3, 4, 7}) {
        const algorithms::Result result = algorithms::inProcess<Case>(ranks);
        INFO(ranks << " ranks");
        CHECK(result.wrong == "");
        CHECK(result.hash == one.hash);
    }
}
