// Everywhere: runs a case on 1, 2, 3, 4 and 7 ranks in one process (test_inproc), or on all ranks of MPI and on one in
// this process (test_mpi); the image must be the same bit for bit.
//
// A case has   template <class Transport> static Result run(const typename Transport::Communicator&);
// which is called on each rank, makes no use of Catch, and takes a second at most. Transport is AnyTransport.
#pragma once

#include "any_transport.hpp"
#include "catch.hpp"
#include "random_scene.hpp"
#include "shuffled.hpp"

#include <cstdint>
#include <mutex>
#include <string>

namespace frame_cases {

struct Result {
    std::string wrong;      // "" or what is
    std::uint64_t hash = 0; // of the image, on the display rank

    void expect(bool condition, const std::string& what)
    {
        if (!condition && wrong.size() < 2000)
            wrong += (wrong.empty() ? "" : "; ") + what;
    }
};

using Run = Result (*)(const AnyTransport::Communicator&);

// What rank 0 had, with what was wrong on any.
inline Result inProcess(Run run, int ranks)
{
    Result first;
    std::mutex mutex;
    std::string wrong;
    try {
        dfb::runRanks(ranks, [&](const dfb::InprocCommunicator& inOrder) {
            const ShuffledTransport::Communicator communicator(inOrder, static_cast<std::uint64_t>(ranks));
            const Result mine = run(AnyTransport::Communicator::of<ShuffledTransport>(communicator, true));
            const std::lock_guard<std::mutex> lock(mutex);
            if (communicator.rank() == 0)
                first = mine;
            if (!mine.wrong.empty())
                wrong += "rank " + std::to_string(communicator.rank()) + ": " + mine.wrong + "\n";
        });
    } catch (const std::exception& e) {
        wrong += std::string("thrown: ") + e.what();
    }
    first.wrong = wrong;
    return first;
}

// Of the program: run/inproc.cpp or run/mpi.cpp. `atOnce`: with all numbers of ranks at once, for a case that mostly
// waits.
void runEverywhere(Run run, bool atOnce);

} // namespace frame_cases

template <class Case>
void everywhere()
{
    frame_cases::runEverywhere(&Case::template run<AnyTransport>, false);
}

template <class Case>
void everywhereAtOnce()
{
    frame_cases::runEverywhere(&Case::template run<AnyTransport>, true);
}
