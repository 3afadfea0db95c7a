// Progress by the caller: a rank that has left end() may go into MPI calls that do not move messages of dfb. No other
// rank may wait for it then. Over MPI, on any number of ranks.
#include "catch.hpp"
#include "random_scene.hpp"
#include "ranks.hpp"

#include <dfb/comm/mpi_transport.hpp>
#include <dfb/dfb.hpp>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace caller_cases {

namespace {

using Op = dfb::BasicOrderedBlend<64>;
using Fb = dfb::DistributedFrameBuffer<Op>;

// The program's own barrier. Returns false if it takes more than 20 seconds; then it moves messages until it is over.
bool passesBarrier(Fb& fb, MPI_Comm comm = MPI_COMM_WORLD)
{
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Ibarrier(comm, &request);
    const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(20);
    bool inTime = true;
    for (int done = 0; MPI_Test(&request, &done, MPI_STATUS_IGNORE), !done;) {
        if (std::chrono::steady_clock::now() > limit)
            inTime = false;
        if (!inTime)
            fb.poll();
        std::this_thread::sleep_for(std::chrono::microseconds(200));
    }
    return inTime;
}

// The caller moves messages, and all of them go through MPI.
dfb::NetworkConfig byCaller()
{
    dfb::NetworkConfig network;
    network.progress = dfb::Progress::Caller;
    network.sharedMemory = false;
    return network;
}

} // namespace

TEST_CASE("Who has left end() is not needed to take what a frame did not need", "[mpi]")
{
    const int rank = rankIn(MPI_COMM_WORLD), last = sizeOf(MPI_COMM_WORLD) - 1;
    constexpr int tiles = 400; // of 80 KiB, far more than MPI has under way at once
    dfb::FrameBufferConfig config;
    config.image.width = config.image.height = 64 * 20;
    config.image.format = dfb::OutputFormat::None;
    config.executor = std::make_shared<dfb::CallerExecutor>();
    config.messages.poolBytes = std::size_t{1} << 30;
    const int owner = last > 1 ? 1 : 0;
    config.image.ownerMap = [owner](int, const dfb::TileLayout&, int) { return owner; };
    Fb fb(MPI_COMM_WORLD, config, byCaller());
    std::vector<float> pixels(4 * 64 * 64);
    for (std::size_t i = 0; i < pixels.size(); ++i)
        pixels[i] = i % 4 == 3 ? 1.0f : static_cast<float>(i % 1009) / 1009;
    for (const bool cancelled : {false, true}) {
        std::string failure;
        auto frame = fb.begin();
        const auto send = [&](int generation, int children) {
            for (int index = 0; index < tiles; ++index) {
                Fb::TileView view;
                frame.start(view, index);
                view.generation = generation;
                view.children = children;
                view.stride = 64;
                view.color = pixels.data();
                view.depth = pixels.data();
                frame.setTile(view);
            }
        };
        // The owner has an opaque input in front of all that the last rank sends, or the frame is cancelled first.
        if (rank == owner && !cancelled)
            send(0, last == owner ? 0 : 1);
        if (rank == last && last != owner)
            send(1, 0);
        if (cancelled && rank == 0)
            std::thread([&] { frame.cancel(); }).join(); // any thread may cancel
        try {
            frame.end();
        } catch (const dfb::FrameError& e) {
            failure = e.what();
        }
        CHECK(failure.empty() == !cancelled);
        CHECK(passesBarrier(fb));
    }
}

TEST_CASE("Who comes last to a reduction has sent its result on when it leaves", "[mpi]")
{
    const int rank = rankIn(MPI_COMM_WORLD);
    MPI_Comm pair = MPI_COMM_NULL; // in which rank 0 waits for a single message
    MPI_Comm_split(MPI_COMM_WORLD, rank < 2 ? 0 : MPI_UNDEFINED, rank, &pair);
    if (pair == MPI_COMM_NULL)
        return;
    {
        dfb::FrameBufferConfig config;
        config.image.width = config.image.height = 64;
        config.executor = std::make_shared<dfb::CallerExecutor>();
        dfb::NetworkConfig options;
        options.progress = dfb::Progress::Caller;
        Fb fb(pair, config, options);
        for (int round = 0; round < 3; ++round) {
            while (fb.poll()) {
            }
            REQUIRE(passesBarrier(fb, pair));
            while (rank == 0 && fb.size() > 1 && !fb.poll()) // until the other rank's part is here
                std::this_thread::sleep_for(std::chrono::microseconds(200));
            CHECK(fb.allReduce({rank + 1}, dfb::Reduce::Sum).front() == fb.size() * (fb.size() + 1) / 2);
            CHECK(passesBarrier(fb, pair));
        }
    }
    MPI_Comm_free(&pair);
}

TEST_CASE("Frames that an exception leaves, the newest first, do not keep others in end() of the oldest", "[mpi]")
{
    const int rank = rankIn(MPI_COMM_WORLD);
    dfb::FrameBufferConfig config(64 * 20, 64 * 20, dfb::OutputFormat::None);
    config.executor = std::make_shared<dfb::CallerExecutor>();
    config.framesInFlight = 2;
    config.messages.poolBytes = std::size_t{1} << 30;
    config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
    Fb fb(MPI_COMM_WORLD, config, byCaller());
    std::vector<float> pixels(4 * 64 * 64);
    for (std::size_t i = 0; i < pixels.size(); ++i)
        pixels[i] = static_cast<float>(i % 1009) / 1009;
    dfb::FrameConfig params;
    params.timeout = std::chrono::seconds(10); // an error in place of a hang
    const std::string left = scene::outcomeOf([&] {
        auto first = fb.begin(params), second = fb.begin(params);
        for (int index = 0; index < 200 && rank > 0; ++index) { // some are still under way when rank 0 leaves
            Fb::TileView view;
            second.start(view, index);
            view.generation = 1;
            view.source = static_cast<std::uint32_t>(rank);
            view.stride = 64;
            view.color = pixels.data();
            second.setTile(view);
        }
        MPI_Barrier(MPI_COMM_WORLD);
        if (rank == 0)
            throw std::runtime_error("on purpose");
        for (auto* frame : {&first, &second}) {
            const std::string text = scene::outcomeOf([&] { frame->end(); });
            INFO(text);
            CHECK(scene::has(text, "frame cancelled: rank 0"));
        }
    });
    CHECK(left == (rank == 0 ? "exception: on purpose" : "fine"));
}

} // namespace caller_cases
