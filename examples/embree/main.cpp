// dfb_render: renders volumes, meshes and spheres over several ranks; see --help.
#include "live_run.hpp"
#include "options.hpp"
#include "rank_run.hpp"

#include <dfb/dfb.hpp>

#if defined(DFB_HAS_TBB)
#include <tbb/global_control.h>
#endif

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <memory>
#include <mutex>
#include <optional>
#include <sstream>
#include <string>
#include <thread>
#include <utility>

namespace example {
namespace {

// Lets oneTBB have `threads` workers in this process, even if there are fewer cores.
class WorkerLimit {
public:
#if defined(DFB_HAS_TBB)
    explicit WorkerLimit(int threads)
        : limit_(tbb::global_control::max_allowed_parallelism,
                 std::max<std::size_t>(static_cast<std::size_t>(threads) + 1, std::thread::hardware_concurrency()))
    {
    }

private:
    tbb::global_control limit_;
#else
    explicit WorkerLimit(int) {}
#endif
};

// One rank's whole run. Returns the exit code, the same on all ranks. Exceptions are not caught.
int runRank(std::shared_ptr<dfb::Connection> connection, const char* transport, const Options& o)
{
    if (!o.live)
        return RankRun(std::move(connection), transport, o).run();
    if (o.mode == Mode::Image)
        return LiveRun<LiveSingle>(std::move(connection), o).run();
    return LiveRun<LiveBlend>(std::move(connection), o).run();
}

int runInThreads(const Options& o, int ranks)
{
    const WorkerLimit limit(std::max(1, o.threads) * ranks);
    std::mutex mutex;
    int code = 0;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        const int mine = runRank(dfb::connect<dfb::InprocTransport>(communicator, networkOf(o)), "inproc", o);
        const std::lock_guard<std::mutex> lock(mutex);
        code = std::max(code, mine);
    });
    return code;
}

int report(const ParsedOptions& parsed)
{
    std::fprintf(parsed.exitCode == 0 ? stdout : stderr, "%s\n", parsed.message.c_str());
    return parsed.exitCode;
}

#if defined(DFB_HAS_MPI)
// Returns the number that a launcher (MPICH's or Open MPI's) has told this process, or `otherwise`.
int fromLauncher(const char* mpich, const char* openMpi, int otherwise)
{
    for (const char* name : {mpich, openMpi})
        if (const char* value = std::getenv(name))
            return std::atoi(value);
    return otherwise;
}

// Returns "" if this rank has the options of rank 0, otherwise what differs. Ranks may differ in --threads. Collective.
std::string differenceOf(const Options& options, int rank)
{
    std::string own;
    for (const std::string& word : options.scene)
        own += word + '\n';
    for (const auto& [name, value] : options.values)
        if (name != "threads")
            own += "--" + name + ' ' + value + '\n';
    std::string first = own;
    int size = static_cast<int>(own.size());
    MPI_Bcast(&size, 1, MPI_INT, 0, MPI_COMM_WORLD);
    first.resize(static_cast<std::size_t>(size));
    MPI_Bcast(first.data(), size, MPI_CHAR, 0, MPI_COMM_WORLD);
    std::istringstream linesOfFirst(first), linesOfOwn(own);
    for (std::string theirs, mine; std::getline(linesOfOwn, mine);)
        if (!std::getline(linesOfFirst, theirs) || mine != theirs)
            return "all ranks need the same options, but rank " + std::to_string(rank) + " has '" + mine
                   + "' where rank 0 has '" + theirs + "'";
    return own == first ? "" : "all ranks need the same options, but rank 0 has more than rank " + std::to_string(rank);
}

int runWithMpi(int argc, char** argv, const ParsedOptions& parsed)
{
    const dfb::MpiSession mpi(argc, argv);
    const int rank = mpi.rank();
    // If ranks are wrong, the lowest of them says why, and all leave.
    const auto isWrongOnAny = [&](bool isWrong, const ParsedOptions& why) {
        int lowest = isWrong ? rank : mpi.size();
        MPI_Allreduce(MPI_IN_PLACE, &lowest, 1, MPI_INT, MPI_MIN, MPI_COMM_WORLD);
        if (lowest == rank)
            report(why);
        return lowest < mpi.size();
    };
    if (isWrongOnAny(!parsed.options, parsed))
        return parsed.options ? exitUsage : parsed.exitCode;
    const std::string difference = differenceOf(*parsed.options, rank);
    if (isWrongOnAny(!difference.empty(), {std::nullopt, exitUsage, "dfb_render: " + difference}))
        return exitUsage;
    int code = exitFailed;
    try {
        const WorkerLimit limit(parsed.options->threads);
        code = runRank(dfb::connect<dfb::MpiTransport>(MPI_COMM_WORLD, networkOf(*parsed.options)), "mpi",
                       *parsed.options);
    } catch (const dfb::InvalidArgument& e) { // this and the next are the same on all ranks
        if (rank == 0)
            std::fprintf(stderr, "dfb_render: %s\n", e.what());
    } catch (const dfb::FrameError& e) {
        if (rank == 0)
            std::fprintf(stderr, "dfb_render: %s\n", e.what());
    } catch (const std::exception& e) {
        std::fprintf(stderr, "dfb_render: rank %d: %s\n", rank, e.what());
        MPI_Abort(MPI_COMM_WORLD, exitFailed); // the others may wait for this rank
    }
    return code;
}
#endif

} // namespace
} // namespace example

int main(int argc, char** argv)
{
    using namespace example;
    const ParsedOptions parsed = parseOptions(argc, argv);
    try {
#if defined(DFB_HAS_MPI)
        if (!parsed.options || parsed.options->ranks == 0)
            return runWithMpi(argc, argv, parsed);
        if (fromLauncher("PMI_SIZE", "OMPI_COMM_WORLD_SIZE", 1) > 1) {
            if (fromLauncher("PMI_RANK", "OMPI_COMM_WORLD_RANK", 0) == 0)
                std::fprintf(stderr, "dfb_render: --ranks makes ranks of threads; start it without mpirun, or leave "
                                     "--ranks out\n");
            return exitUsage;
        }
#endif
        if (!parsed.options)
            return report(parsed);
        return runInThreads(*parsed.options, std::max(1, parsed.options->ranks));
    } catch (const std::exception& e) {
        std::fprintf(stderr, "dfb_render: %s\n", e.what());
        return exitFailed;
    }
}
