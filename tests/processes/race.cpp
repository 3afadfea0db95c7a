// Two threads of the library that write the same ints without synchronisation. ThreadSanitizer must find this race,
// otherwise its silence in the other tests means nothing. Only built with -fsanitize=thread.
//   test_race executor     two threads of a ThreadExecutor
//   test_race ranks        two ranks in one process, each in its renderer
#include <dfb/dfb.hpp>

#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdio>
#include <memory>
#include <string>
#include <thread>

namespace {

std::atomic<int> here{0};
int values[256] = {}; // many, as it may miss one that both write at the very same moment

// When two threads are here; relaxed, so that neither waits for what the other has done.
void write()
{
    const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(10);
    here.fetch_add(1, std::memory_order_relaxed);
    while (here.load(std::memory_order_relaxed) < 2 && std::chrono::steady_clock::now() < end)
        std::this_thread::yield();
    for (int& value : values)
        ++value;
}

void ranks()
{
    dfb::runRanks(2, [](const dfb::InprocCommunicator& communicator) {
        dfb::FrameBufferConfig config{128, 128};
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        dfb::DistributedFrameBuffer<dfb::ImageParallel, dfb::NoPixelOp, dfb::InprocTransport> fb(communicator, config);
        dfb::ImageParallelLoop(fb).render([](auto& tile) {
            write();
            tile.fill({0, 0, 0, 1});
        });
    });
}

} // namespace

int main(int argc, char** argv)
{
    if (argc > 1 && std::string(argv[1]) == "ranks")
        ranks();
    else
        dfb::ThreadExecutor(2).parallelFor(2, [](std::size_t) { write(); });
    std::printf("%d\n", values[0]);
}
