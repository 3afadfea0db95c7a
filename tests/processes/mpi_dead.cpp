// A rank that dies or hangs under MPI: the other ranks must say which rank it is, in time, and come to an end.
//   mpirun -n 4 mpi_dead <how> <where> <reaction> <victim> <folder>
//     how:      kill (SIGKILL), exit (without MPI_Finalize), stop (SIGSTOP), resume (SIGSTOP, and SIGCONT later)
//     where:    constructor, frame (while rendering), pixels (the same, with tiles on their way to and from all ranks),
//               shared (the same, with pixels that others read in the memory of the rank), reduction (between frames),
//               end (destruction)
//     reaction: abort (the default: MPI_Abort), handler (the other ranks go on, as far as they can)
// Most launchers end a job when a rank dies, or do not let it live on. Therefore each process forks first. The process
// that the launcher sees lives until all ranks have got their errors, whatever happens to the rank itself. So only the
// library can notice the loss. mpi_dead.cmake starts this program and checks what it writes into <folder>, which must
// be empty:
//   told.<rank>   "rank 0 told of rank 3 after 1234 ms, gone after 5 ms: <error>"
//   lost_at       when the rank was lost, in s since 1970
//   stood_still   is there if another rank stood still, so that it may rightly have been taken for lost
#include "undisturbed.hpp"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <fstream>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <thread>

#include <sys/prctl.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <unistd.h>

namespace {

using Clock = std::chrono::steady_clock;
using std::chrono::milliseconds;
using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend>;
constexpr int timeoutMs = 1500;

struct Run {
    std::string how, where, reaction;
    int victim = 0;
    std::string folder;
};

double msSince(Clock::time_point start)
{
    return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

std::string noteOf(const Run& run, int rank) { return run.folder + "/told." + std::to_string(rank); }
bool exists(const std::string& path)
{
    struct stat status;
    return stat(path.c_str(), &status) == 0;
}

// Writes a file that is complete as soon as it is there.
void write(const std::string& path, const std::string& text)
{
    std::ofstream(path + ".new") << text << '\n';
    std::rename((path + ".new").c_str(), path.c_str());
}

// Whether all ranks that can be told have been. The size of the job is in a file, as this process is not in MPI.
bool allTold(const Run& run)
{
    int size = 0;
    std::ifstream(run.folder + "/size") >> size;
    bool all = size > 0;
    for (int rank = 0; rank < size; ++rank)
        all = all && ((rank == run.victim && run.how != "resume") || exists(noteOf(run, rank)));
    return all;
}
bool othersTold(const Run& run)
{
    Run others = run;
    others.how = "kill";
    return allTold(others);
}

// The other ranks read the time of the loss from a file. The clock is that of the host.
void die(const Run& run)
{
    using namespace std::chrono;
    std::ofstream(run.folder + "/lost_at")
        << duration_cast<seconds>(system_clock::now().time_since_epoch()).count() << '\n';
    std::ofstream(run.folder + "/lost") << Clock::now().time_since_epoch().count();
    if (run.how == "kill")
        raise(SIGKILL);
    else if (run.how == "exit")
        _exit(0);
    else
        raise(SIGSTOP);
}

// When the rank was lost, or `start` if that is later.
Clock::time_point timeOfLoss(Clock::time_point start, const Run& run)
{
    Clock::rep ticks = 0;
    std::ifstream(run.folder + "/lost") >> ticks;
    return std::max(start, Clock::time_point(Clock::duration(ticks)));
}

void emptyFrame(
    FrameBuffer& fb, const std::function<void()>& render = [] {})
{
    dfb::FrameConfig params;
    params.declared = true;
    auto frame = fb.begin(params);
    frame.declare({});
    render();
    frame.end();
}

// Each rank sends all tiles; after one half of them calls `halfway`. `shared`: memory for the pixels, or empty.
void fullFrame(FrameBuffer& fb, dfb::Buffer& shared, const std::function<void()>& halfway)
{
    auto* pixels = reinterpret_cast<float*>(shared.data());
    std::fill_n(pixels, shared.size() / sizeof(float), 0.5f);
    auto frame = fb.begin({});
    const auto tile = std::make_unique<FrameBuffer::Tile>();
    for (const int index : fb.ownedTiles()) {
        frame.start(*tile, index);
        tile->children = fb.size();
        frame.setTile(*tile);
    }
    for (int index = 0; index < fb.layout().tileCount(); ++index) {
        if (index == fb.layout().tileCount() / 2)
            halfway();
        if (!shared.empty()) {
            FrameBuffer::TileView view;
            frame.start(view, index);
            view.generation = 1;
            view.stride = fb.layout().width();
            const auto first = static_cast<std::size_t>(view.region.y0 * fb.layout().width() + view.region.x0);
            view.color = pixels + 4 * first;
            view.depth = pixels + 4 * static_cast<std::size_t>(fb.layout().width() * fb.layout().height()) + first;
            view.staysUntilEnd = true;
            frame.setTile(view);
            continue;
        }
        frame.start(*tile, index);
        tile->generation = 1;
        tile->fill({0.5f, 0.25f, 0, 0.5f});
        frame.setTile(*tile);
    }
    frame.end();
}

void runRank(const Run& run, int& argc, char**& argv)
{
    dfb::MpiSession mpi(argc, argv);
    mpi.giveUp(); // MPI_Finalize would wait for ever
    if (mpi.rank() == 0)
        write(run.folder + "/size", std::to_string(mpi.size()));
    const bool isVictim = mpi.rank() == run.victim;
    std::optional<StandStill> standStill;
    if (!isVictim)
        standStill.emplace([&run](Clock::duration longest) {
            if (longest >= milliseconds(300))
                std::ofstream(run.folder + "/stood_still") << '\n';
        });
    std::atomic<bool> handlerCalled{false};
    std::string text, lateText;
    dfb::NetworkConfig options;
    options.peerTimeout = std::chrono::milliseconds(timeoutMs);
    if (run.reaction == "handler")
        options.onPeerLost = [&](const dfb::ErrorInfo& error) {
            handlerCalled = true;
            lateText = error.describe();
        };
    auto start = Clock::now();
    int lost = -1;
    double toldMs = 0;
    {
        auto connection = dfb::connect<dfb::MpiTransport>(mpi.communicator(), options);
        try {
            const auto make = [&] {
                dfb::FrameBufferConfig config{256, 256};
                if (run.where == "pixels" || run.where == "shared") {
                    config.image.width = config.image.height = 2048;
                    config.messages.poolBytes = 0; // as small as can be: who sends waits for who takes
                }
                return std::make_unique<FrameBuffer>(connection, config);
            };
            std::unique_ptr<FrameBuffer> fb;
            if (run.where == "constructor") {
                MPI_Barrier(mpi.communicator());
                std::this_thread::sleep_for(milliseconds(500)); // until each has heard that the others answer
            } else {
                fb = make();
                emptyFrame(*fb);
            }
            dfb::Buffer pixels; // of floats, 5 a pixel
            if (run.where == "shared")
                pixels = fb->sharedMemory(std::size_t{2048} * 2048 * 20);
            start = Clock::now();
            if (isVictim && run.where != "frame" && run.where != "pixels" && run.where != "shared")
                die(run);
            if (run.where == "constructor")
                fb = make();
            else if (run.where == "frame")
                emptyFrame(*fb, [&] {
                    std::this_thread::sleep_for(milliseconds(50));
                    if (isVictim)
                        die(run);
                });
            else if (run.where == "pixels" || run.where == "shared")
                fullFrame(*fb, pixels, [&] {
                    if (isVictim)
                        die(run);
                });
            else if (run.where == "reduction")
                fb->allReduce({1}, FrameBuffer::Reduce::Sum);
        } catch (const dfb::TransportError& e) {
            text = e.what();
            lost = e.info().rank;
        }
        toldMs = msSince(timeOfLoss(start, run));
        start = Clock::now();
    }
    const double goneMs = msSince(start);
    if (run.where == "end" && handlerCalled) {
        text = lateText;
        lost = run.victim;
        toldMs = goneMs;
    }
    standStill.reset();
    char told[100];
    std::snprintf(told, sizeof told, "rank %d told of rank %d after %.0f ms, gone after %.0f ms: ", mpi.rank(), lost,
                  toldMs, goneMs);
    write(noteOf(run, mpi.rank()), told + text);
}

// What the launcher sees: goes on until all have been told.
int watch(const Run& run, pid_t child)
{
    bool childIsThere = true;
    for (const auto end = Clock::now() + std::chrono::seconds(80); Clock::now() < end && !allTold(run);) {
        int status = 0;
        if (childIsThere && waitpid(child, &status, WNOHANG) == child)
            childIsThere = false;
        if (run.how == "resume" && childIsThere && othersTold(run))
            kill(child, SIGCONT); // again and again, as it may not have stopped yet
        std::this_thread::sleep_for(milliseconds(20));
    }
    if (childIsThere) {
        kill(child, SIGKILL);
        waitpid(child, nullptr, 0);
    }
    return 0;
}

} // namespace

int main(int argc, char** argv)
{
    if (argc != 6) {
        std::fprintf(stderr, "mpi_dead: five arguments\n");
        return 2;
    }
    const Run run{argv[1], argv[2], argv[3], std::atoi(argv[4]), argv[5]};
    const pid_t parent = getpid();
    const pid_t child = fork();
    if (child < 0)
        return 2;
    if (child > 0)
        return watch(run, child);
    prctl(PR_SET_PDEATHSIG, SIGKILL); // stopped or not, it does not outlive its parent
    if (getppid() != parent)
        _exit(2);
    int code = 0;
    try {
        runRank(run, argc, argv);
    } catch (const std::exception& e) {
        std::printf("mpi_dead: unexpected: %s\n", e.what());
        code = 1;
    }
    std::fflush(stdout);
    _exit(code); // nothing of MPI is orderly any more
}
