// Runs the cases of everywhere.hpp on all ranks of MPI_COMM_WORLD.
#include "everywhere.hpp"
#include "ranks.hpp"

#include <exception>
#include <future>

void frame_cases::runEverywhere(Run run, bool)
{
    // Meanwhile, rank 0 runs the case on one rank in this process and compares the images. Some cases mostly wait.
    std::future<Result> one;
    const bool isFirst = rankIn(MPI_COMM_WORLD) == 0;
    if (isFirst)
        one = std::async(std::launch::async, [run] {
            return undisturbed(
                [run] { return inProcess(run, 1); },
                [](bool stoodStill, const auto& result) { return stoodStill && !result.get().wrong.empty(); });
        });
    const auto runCase = [&] {
        Result mine;
        try {
            const MPI_Comm world = MPI_COMM_WORLD;
            mine = run(AnyTransport::Communicator::of<dfb::MpiTransport>(world, false));
        } catch (const std::exception& e) {
            mine.wrong += std::string("thrown: ") + e.what();
        }
        return mine;
    };
    const Result result = undisturbed(runCase, [](bool stoodStill, const auto& mine) {
        bool any[] = {stoodStill, !mine.get().wrong.empty()};
        MPI_Allreduce(MPI_IN_PLACE, any, 2, MPI_CXX_BOOL, MPI_LOR, MPI_COMM_WORLD);
        return any[0] && any[1];
    });
    CHECK(result.wrong == "");
    if (isFirst) {
        const Result alone = one.get();
        CHECK(alone.wrong == "");
        CHECK(result.hash == alone.hash);
    }
}
