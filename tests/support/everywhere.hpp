// Everywhere: runs a case on several numbers of ranks in one process (test_inproc), or on all ranks of MPI and on one
// rank in this process (test_mpi). All images must be the same bit for bit.
//
// A case has   static Result run(const Transport::Communicator&);
// It is called on each rank, must not use Catch, and takes at most a second.
#pragma once

#include "any_transport.hpp"
#include "catch.hpp"
#include "random_scene.hpp"
#include "shuffled.hpp"

#include <cstddef>
#include <cstdint>
#include <mutex>
#include <string>

namespace frame_cases {

struct Result {
    std::string wrong;      // empty if nothing is wrong
    std::uint64_t hash = 0; // of the image, on the display rank

    void expect(bool condition, const std::string& what)
    {
        if (!condition && wrong.size() < 2000)
            wrong += (wrong.empty() ? "" : "; ") + what;
    }
};

// Expects the display rank to have the image of a scene. Returns the image's hash there, and 0 on other ranks.
template <class FrameBuffer>
std::uint64_t checkedHash(Result& result, const FrameBuffer& fb, const dfb::FrameReport& report, const scene::Scene& s,
                          const std::string& what)
{
    if (!fb.isDisplayRank())
        return 0;
    const scene::Picture picture(fb.image(), report);
    const std::size_t wrong = wrongValues(picture, referenceOf(s));
    result.expect(wrong == 0, what + ": " + std::to_string(wrong) + " values");
    return picture.hash();
}

using Transport = AnyTransport; // of all cases
using Run = Result (*)(const Transport::Communicator&);

// Returns the result of rank 0, with the errors of all ranks.
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

// Defined in everywhere_inproc.cpp and everywhere_mpi.cpp; each test program links one of them. In one process,
// `atOnce` runs all numbers of ranks at the same time, for a case that mostly waits.
void runEverywhere(Run run, bool atOnce);

} // namespace frame_cases

template <class Case>
void everywhere()
{
    frame_cases::runEverywhere(&Case::run, false);
}

template <class Case>
void everywhereAtOnce()
{
    frame_cases::runEverywhere(&Case::run, true);
}
