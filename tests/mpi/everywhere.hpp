// Runs the cases of tests/algorithms over MPI.
#pragma once

#include "../algorithms/everywhere.hpp"
#include "ranks.hpp"

#include <future>

template <class Case>
void everywhere()
{
    // What it is compared with, with one rank in this process, at the same time: some cases mostly wait.
    std::future<algorithms::Result> one;
    const bool isFirst = rankIn(MPI_COMM_WORLD) == 0;
    if (isFirst)
        one = std::async(std::launch::async, algorithms::inProcess<Case>, 1);
    algorithms::Result result;
    try {
        result = Case::template run<dfb::MpiTransport>(MPI_COMM_WORLD);
    } catch (const std::exception& e) {
        result.wrong += std::string("thrown: ") + e.what();
    }
    CHECK(result.wrong == "");
    if (isFirst)
        CHECK(result.hash == one.get().hash);
}

// See inproc/everywhere.hpp.
template <class Case>
void everywhereAtOnce()
{
    everywhere<Case>();
}
