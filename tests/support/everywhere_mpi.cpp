// Runs the cases over MPI.
#include "ranks.hpp"
#include "everywhere.hpp"

#include <exception>
#include <future>

void frame_cases::runEverywhere(Run run, bool)
{
    // With one rank in this process, to compare with, at the same time: some cases mostly wait.
    std::future<Result> one;
    const bool isFirst = rankIn(MPI_COMM_WORLD) == 0;
    if (isFirst)
        one = std::async(std::launch::async, inProcess, run, 1);
    Result result;
    try {
        const MPI_Comm world = MPI_COMM_WORLD;
        result = run(AnyTransport::Communicator::of<dfb::MpiTransport>(world, false));
    } catch (const std::exception& e) {
        result.wrong += std::string("thrown: ") + e.what();
    }
    CHECK(result.wrong == "");
    if (isFirst)
        CHECK(result.hash == one.get().hash);
}
