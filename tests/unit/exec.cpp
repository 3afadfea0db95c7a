// Executors: loops and tasks on worker threads.
#include "catch.hpp"

#include <dfb/exec.hpp>
#if defined(DFB_HAS_TBB)
#include <dfb/tbb_executor.hpp>

#include <tbb/global_control.h>
#endif

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <new>
#include <set>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace exec_cases {

namespace {

template <class Executor, class... Arguments>
void check(Arguments... threads)
{
    SECTION("a loop calls each index once")
    {
        Executor executor(threads...);
        CHECK(executor.concurrency() >= 1);
        for (const std::size_t count : {0, 1, 2, 3, 17, 5000}) {
            std::vector<std::atomic<int>> calls(count);
            executor.parallelFor(count, [&](std::size_t i) { ++calls[i]; });
            CHECK(std::all_of(calls.begin(), calls.end(), [](const auto& n) { return n == 1; }));
        }
    }
    SECTION("loops nest, in loops and in tasks")
    {
        std::atomic<int> inner{0}, inTask{0};
        {
            Executor executor(threads...);
            executor.parallelFor(13, [&](std::size_t) {
                executor.parallelFor(7, [&](std::size_t) { executor.parallelFor(3, [&](std::size_t) { ++inner; }); });
            });
            CHECK(inner == 13 * 7 * 3);
            for (int i = 0; i < 5; ++i)
                executor.submit([&] { executor.parallelFor(11, [&](std::size_t) { ++inTask; }); });
        }
        CHECK(inTask == 55);
    }
    SECTION("tasks with loops do not run in each other, however many wait")
    {
        std::atomic<int> deepest{0};
        {
            Executor executor(threads...);
            for (int i = 0; i < 1000; ++i)
                executor.submit([&] {
                    static thread_local int depth = 0;
                    ++depth;
                    executor.parallelFor(2, [&](std::size_t) {
                        for (int seen = deepest; depth > seen && !deepest.compare_exchange_weak(seen, depth);) {
                        }
                    });
                    --depth;
                });
            while (executor.help()) {
            }
        }
        CHECK(deepest == 1);
    }
    SECTION("an exception of a body comes out of the loop, and the executor goes on")
    {
        Executor executor(threads...);
        for (const std::size_t culprit : {0, 50, 99}) {
            std::string what;
            try {
                executor.parallelFor(100, [&](std::size_t i) {
                    if (i == culprit)
                        throw std::runtime_error("body " + std::to_string(i));
                });
            } catch (const std::runtime_error& e) {
                what = e.what();
            }
            CHECK(what == "body " + std::to_string(culprit));
            std::atomic<int> calls{0};
            executor.parallelFor(10, [&](std::size_t) { ++calls; });
            CHECK(calls == 10);
        }
        // An exception must come out of a nested loop, too.
        CHECK_THROWS_AS(executor.parallelFor(3,
                                             [&](std::size_t) {
                                                 executor.parallelFor(3, [](std::size_t i) {
                                                     if (i == 1)
                                                         throw std::runtime_error("inner");
                                                 });
                                             }),
                        std::runtime_error);
    }
    SECTION("what was submitted has run when the executor is gone, also what tasks submit")
    {
        std::atomic<int> ran{0};
        {
            Executor executor(threads...);
            std::vector<std::thread> submitters;
            for (int t = 0; t < 3; ++t)
                submitters.emplace_back([&] {
                    for (int i = 0; i < 200; ++i)
                        executor.submit([&] {
                            ++ran;
                            if (ran % 2 == 0)
                                executor.submit([&] { ran += 1000000; });
                        });
                });
            for (std::thread& thread : submitters)
                thread.join();
        }
        CHECK(ran % 1000000 == 600);
        CHECK(ran >= 1000000);
    }
    SECTION("loops of several threads at once")
    {
        Executor executor(threads...);
        std::atomic<int> calls{0};
        std::vector<std::thread> callers;
        for (int t = 0; t < 4; ++t)
            callers.emplace_back([&] {
                for (int i = 0; i < 20; ++i)
                    executor.parallelFor(25, [&](std::size_t) { ++calls; });
            });
        for (std::thread& thread : callers)
            thread.join();
        CHECK(calls == 4 * 20 * 25);
    }
}

} // namespace

TEST_CASE("ThreadExecutor", "[executor]")
{
    for (const int threads : {1, 2, 3, 0})
        DYNAMIC_SECTION("threads: " << threads) { check<dfb::ThreadExecutor>(threads); }
}

TEST_CASE("CallerExecutor", "[executor]") { check<dfb::CallerExecutor>(); }

TEST_CASE("CallerExecutor has no workers", "[executor]")
{
    dfb::CallerExecutor executor;
    CHECK(executor.concurrency() == 1);
    CHECK(!executor.hasWorkers());
    bool ran = false;
    executor.submit([&] { ran = true; });
    CHECK(executor.hasTasks());
    std::set<std::thread::id> threads;
    executor.parallelFor(3, [&](std::size_t) { threads.insert(std::this_thread::get_id()); });
    CHECK(threads == std::set<std::thread::id>{std::this_thread::get_id()});
    CHECK(ran);
    CHECK(!executor.hasTasks());
    CHECK(!executor.help());
}

#if defined(DFB_HAS_TBB)
TEST_CASE("TbbExecutor", "[executor]")
{
    for (const int threads : {1, 2, 3, 0})
        DYNAMIC_SECTION("threads: " << threads) { check<dfb::TbbExecutor>(threads); }
}
#endif

TEST_CASE("A task is queued once, even if no worker can be woken", "[executor]")
{
    struct Sleeper final : dfb::Executor {
        int concurrency() const noexcept override { return 1; }
        void wake() override { throw std::bad_alloc(); }
        void run(std::size_t, const std::function<void(std::size_t)>&, const std::function<void()>&) override {}
    } executor;
    int runs = 0;
    executor.submit([&] { ++runs; });
    CHECK(executor.help());
    CHECK(runs == 1);
    CHECK(!executor.help());
}

TEST_CASE("ThreadExecutor has the workers it says, and they work at once", "[executor]")
{
    CHECK(dfb::ThreadExecutor(3).concurrency() == 3);
    dfb::ThreadExecutor executor(3);
    // Each body waits for the others, which would never end with fewer workers.
    std::mutex mutex;
    std::condition_variable changed;
    int arrived = 0;
    executor.parallelFor(3, [&](std::size_t) {
        std::unique_lock<std::mutex> lock(mutex);
        ++arrived;
        changed.notify_all();
        changed.wait(lock, [&] { return arrived == 3; });
    });
    CHECK(arrived == 3);
}

TEST_CASE("While the workers of a ThreadExecutor rest, the threads that call do their work", "[executor]")
{
    dfb::ThreadExecutor executor(1);
    executor.rest(true);
    executor.rest(true);
    CHECK(!executor.hasWorkers());
    std::mutex mutex;
    std::condition_variable changed;
    std::vector<std::thread::id> threads;
    const auto note = [&] {
        const std::lock_guard<std::mutex> lock(mutex);
        threads.push_back(std::this_thread::get_id());
        changed.notify_all();
    };
    executor.submit(note);
    executor.parallelFor(2, [&](std::size_t) { note(); });
    CHECK(threads == std::vector<std::thread::id>(3, std::this_thread::get_id()));

    executor.submit(note);
    executor.submit(note);
    executor.rest(false);
    CHECK(!executor.hasWorkers()); // one more caller still wants them to rest
    executor.rest(false);
    CHECK(executor.hasWorkers());
    std::unique_lock<std::mutex> lock(mutex);
    CHECK(changed.wait_for(lock, std::chrono::seconds(10), [&] { return threads.size() == 5; }));
    CHECK((threads[3] != std::this_thread::get_id() && threads[4] != std::this_thread::get_id()));
}

TEST_CASE("A thread that waits for a loop does something else meanwhile", "[executor]")
{
    const auto self = std::this_thread::get_id();
    std::atomic<int> calls{0}, elsewhere{0};
    const auto meanwhile = [&] {
        ++calls;
        elsewhere += std::this_thread::get_id() != self;
    };
    dfb::ThreadExecutor threads(2);
    const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(10);
    threads.parallelFor(
        3,
        [&](std::size_t) {
            for (const int before = calls; calls == before && std::chrono::steady_clock::now() < limit;)
                std::this_thread::yield();
        },
        meanwhile);
    CHECK(calls >= 2); // two of the loop's three calls may have waited for the same one
    CHECK(elsewhere == 0);

    calls = 0;
    dfb::CallerExecutor caller;
    caller.parallelFor(
        3, [](std::size_t) {}, meanwhile); // takes part
    CHECK(calls == 0);
}

TEST_CASE("Waiting tasks run between the iterations of a loop", "[executor]")
{
    const auto check = [](dfb::Executor& executor) {
        std::atomic<int> tasks{0};
        std::vector<int> seen(5);
        executor.parallelFor(5, [&](std::size_t i) {
            seen[i] = tasks;
            executor.submit([&] { ++tasks; });
        });
        std::sort(seen.begin(), seen.end());
        CHECK(seen == std::vector<int>{0, 1, 2, 3, 4});
    };
    dfb::CallerExecutor caller;
    check(caller);
    dfb::ThreadExecutor thread(1);
    caller.submit([&] { check(thread); }); // a thread in a task only waits, so the worker runs all
    caller.help();
}

TEST_CASE("A thread that waits for a loop runs tasks while the workers are busy", "[executor]")
{
    dfb::ThreadExecutor executor(1);
    std::thread::id runner;
    std::atomic<bool> hasRun{false};
    executor.parallelFor(1, [&](std::size_t) {
        executor.submit([&] {
            runner = std::this_thread::get_id();
            hasRun = true;
        });
        const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(10);
        while (!hasRun && std::chrono::steady_clock::now() < limit)
            std::this_thread::yield();
    });
    REQUIRE(hasRun);
    CHECK(runner == std::this_thread::get_id());
}

TEST_CASE("A worker of one ThreadExecutor that runs a task of another may run loops of both", "[executor]")
{
    dfb::ThreadExecutor a(1), b(1);
    std::atomic<int> hasRun{0};
    a.parallelFor(1, [&](std::size_t) {
        b.parallelFor(1, [&](std::size_t) { // meanwhile a's worker runs tasks of b
            b.submit([&] { a.parallelFor(2, [&](std::size_t) { ++hasRun; }); });
            const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(10);
            while (hasRun < 2 && std::chrono::steady_clock::now() < limit)
                std::this_thread::yield();
        });
    });
    CHECK(hasRun == 2);
}

#if defined(DFB_HAS_TBB)
TEST_CASE("A TbbExecutor begins no body of a loop on a thread that is in one, while that waits for an inner loop",
          "[executor]")
{
    const tbb::global_control threads(tbb::global_control::max_allowed_parallelism, 6);
    dfb::TbbExecutor executor(6);
    static thread_local bool isInside = false;
    std::atomic<int> nested{0};
    std::atomic<std::int64_t> sum{0};
    for (int round = 0; round < 20; ++round)
        executor.parallelFor(64, [&](std::size_t) {
            nested += std::exchange(isInside, true);
            executor.parallelFor(16, [&](std::size_t i) {
                std::this_thread::yield();
                sum += static_cast<std::int64_t>(i);
            });
            isInside = false;
        });
    CHECK(nested == 0);
    CHECK(sum == 20 * 64 * 120);
}

TEST_CASE("With a TbbExecutor, a thread that waits for a loop runs tasks while the other is in a long body",
          "[executor]")
{
    const tbb::global_control threads(tbb::global_control::max_allowed_parallelism, 2);
    dfb::TbbExecutor executor(2);
    for (int round = 0; round < 5; ++round) {
        std::atomic<bool> hasRun{false};
        std::atomic<int> bodies{0};
        executor.parallelFor(2, [&](std::size_t) {
            const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(2);
            const bool isLong = ++bodies == 2; // the other one waits until this has begun, on another thread
            if (isLong)
                executor.submit([&] { hasRun = true; });
            while (!(isLong ? hasRun.load() : bodies == 2) && std::chrono::steady_clock::now() < limit)
                std::this_thread::yield();
        });
        CHECK(hasRun);
    }
}
#endif

} // namespace exec_cases
