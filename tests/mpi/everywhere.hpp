// Runs the cases of tests/algorithms over MPI.
#pragma once

#include "../algorithms/everywhere.hpp"
#include "ranks.hpp"

template <class Case>
void everywhere()
{
    algorithms::Result result;
    try {
        result = Case::template run<dfb::MpiTransport>(MPI_COMM_WORLD);
    } catch (const std::exception& e) {
        result.wrong += std::string("thrown: ") + e.what();
    }
    CHECK(result.wrong == "");
    if (rankIn(MPI_COMM_WORLD) == 0)
        CHECK(result.hash == algorithms::inProcess<Case>(1).hash);
}
