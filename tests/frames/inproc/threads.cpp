// The workers of a rank: how many a default executor has, as ranks that are threads of one process share its
// processors; and how tiles are handed out to them.
#include "catch.hpp"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <memory>
#include <mutex>
#include <optional>
#include <thread>
#include <vector>

#if defined(__linux__)
#include <sched.h>
#endif

namespace threads_cases {

namespace {

using FrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicImageParallel<16>, dfb::NoPixelOp, dfb::InprocTransport>;

// By rank: of the framebuffer's executor, and what the report says.
std::vector<std::vector<int>> threadsOf(int ranks, std::shared_ptr<dfb::Executor> executor = nullptr)
{
    std::vector<std::vector<int>> threads(static_cast<std::size_t>(ranks));
    std::mutex mutex;
    dfb::runRanks(ranks, [&](const dfb::InprocCommunicator& communicator) {
        dfb::FrameBufferConfig config;
        config.image.width = config.image.height = 20;
        config.executor = executor;
        FrameBuffer fb(communicator, config);
        const auto report = dfb::ImageParallelLoop(fb).render([](auto& tile) { tile.fill({0, 0, 0, 1}); });
        const std::lock_guard<std::mutex> lock(mutex);
        threads[static_cast<std::size_t>(fb.rank())] = {fb.executor().concurrency(), report.threads};
    });
    return threads;
}

} // namespace

TEST_CASE("Ranks that are threads divide the processors, and the report says how many threads each has", "[threads]")
{
    const int processors = dfb::Processors::ofThisThread().count();
    for (const int ranks : {1, 2, 3, 2 * processors}) {
        const int each = std::max(1, processors / ranks);
        CHECK(threadsOf(ranks) == std::vector<std::vector<int>>(static_cast<std::size_t>(ranks), {each, each}));
    }
    CHECK(threadsOf(1, std::make_shared<dfb::ThreadExecutor>(5)) == std::vector<std::vector<int>>{{5, 5}});
}

TEST_CASE("A worker that is in a tile for long holds up no other tile", "[threads]")
{
    for (const int ranks : {1, 2}) {
        constexpr int tiles = 10;
        std::atomic<int> rendered{0};
        std::atomic<bool> isFirst{true};
        dfb::runRanks(ranks, [&](const dfb::InprocCommunicator& communicator) {
            dfb::FrameBufferConfig config(16 * tiles, 16);
            config.executor = std::make_shared<dfb::ThreadExecutor>(2);
            FrameBuffer fb(communicator, config);
            dfb::ImageParallelLoop(fb, dfb::WorkDistribution::Dynamic).render([&](auto& tile) {
                if (isFirst.exchange(false)) {
                    const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(10);
                    while (rendered < tiles - 1 && std::chrono::steady_clock::now() < limit)
                        std::this_thread::yield();
                    rendered += rendered < tiles - 1 ? -tiles : 0;
                }
                ++rendered;
                tile.fill({0, 0, 0, 1});
            });
        });
        CHECK(rendered == tiles);
    }
}

#if defined(__linux__)
TEST_CASE("A process that may use one processor makes one thread", "[threads]")
{
    std::optional<int> inExecutor;
    std::vector<std::vector<int>> inFrame;
    std::thread([&] { // the mask is inherited by the threads that it starts, which are the ranks
        cpu_set_t all, one;
        sched_getaffinity(0, sizeof all, &all);
        int last = 0;
        for (int i = 0; i < CPU_SETSIZE; ++i)
            if (CPU_ISSET(static_cast<unsigned>(i), &all))
                last = i;
        CPU_ZERO(&one);
        CPU_SET(static_cast<unsigned>(last), &one);
        if (sched_setaffinity(0, sizeof one, &one) != 0)
            return;
        inExecutor = dfb::ThreadExecutor().concurrency();
        inFrame = threadsOf(1);
    })
        .join();
    REQUIRE(inExecutor);
    CHECK(*inExecutor == 1);
    CHECK(inFrame == std::vector<std::vector<int>>{{1, 1}});
}
#endif

} // namespace threads_cases
