// Everywhere: runs a case on 1, 2, 3, 4 and 7 ranks in one process, or on all ranks of MPI and on one in this process;
// the image must be the same bit for bit.
//
// A case has   template <class Transport> static Result run(const typename Transport::Communicator&);
// which is called on each rank, makes no use of Catch, and takes a second at most.
#pragma once

#include "../inproc/scene.hpp"
#include "catch.hpp"

#include <cstdint>
#include <functional>
#include <mutex>
#include <string>
#include <vector>

namespace algorithms {

struct Result {
    std::string wrong;      // "" or what is
    std::uint64_t hash = 0; // of the image, on the display rank

    void expect(bool condition, const std::string& what)
    {
        if (!condition && wrong.size() < 2000)
            wrong += (wrong.empty() ? "" : "; ") + what;
    }
};

// What rank 0 had, with what was wrong on any.
template <class Case>
Result inProcess(int ranks)
{
    Result first;
    std::mutex mutex;
    std::string wrong;
    try {
        dfb::runRanks(
            ranks,
            [&](dfb::InprocCommunicator communicator) {
                const Result mine = Case::template run<dfb::InprocTransport>(communicator);
                const std::lock_guard<std::mutex> lock(mutex);
                if (communicator.rank() == 0)
                    first = mine;
                if (!mine.wrong.empty())
                    wrong += "rank " + std::to_string(communicator.rank()) + ": " + mine.wrong + "\n";
            },
            static_cast<std::uint64_t>(ranks));
    } catch (const std::exception& e) {
        wrong += std::string("thrown: ") + e.what();
    }
    first.wrong = wrong;
    return first;
}

} // namespace algorithms
