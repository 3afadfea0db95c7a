// TbbExecutor: an Executor in a oneTBB arena of its own. The only header that includes oneTBB.
#pragma once

#include <dfb/exec.hpp>

#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <atomic>
#include <cstddef>
#include <functional>
#include <thread>
#include <utility>

DFB_NAMESPACE_BEGIN

// The arena has room for `threadCount` threads. oneTBB itself limits the workers of a process to one less than
// its cores; the thread that calls parallelFor() takes part. If several ranks are threads of one process, give them
// ThreadExecutors: they would share oneTBB's few workers, and one that waits for another rank would hold up its tasks.
class TbbExecutor final : public Executor {
public:
    // `threadCount` 0: one thread for each processor that oneTBB finds for this process. That is too many if several
    // ranks share the processors: see Connection::threadShare(). Throws what oneTBB throws.
    explicit TbbExecutor(int threadCount = 0) : arena_(threadCount > 0 ? threadCount : tbb::task_arena::automatic, 1)
    {
        arena_.initialize();
    }

    // Waits until all submitted tasks have run. No loop may be under way.
    ~TbbExecutor() override
    {
        while (help()) { // tasks that no thread could be woken for
        }
        while (enqueued_ > 0)
            std::this_thread::yield();
    }

    int concurrency() const noexcept override { return arena_.max_concurrency(); }

private:
    void wake() override
    {
        ++enqueued_;
        try {
            arena_.enqueue([this] {
                help();
                --enqueued_; // last: the destructor waits for it
            });
        } catch (...) {
            --enqueued_;
            throw;
        }
    }

    void run(std::size_t count, const std::function<void(std::size_t)>& body, const std::function<void()>&) override
    {
        const auto inBody = [&](std::size_t i) {
            const bool before = std::exchange(isInBody(), true);
            body(i);
            isInBody() = before;
        };
        const auto loop = [&] { tbb::parallel_for(std::size_t{0}, count, inBody, tbb::simple_partitioner()); };
        arena_.execute([&] {
            if (count == 1)
                inBody(0); // a loop within a loop, as a rule: quicker, and not on another thread
            else if (isInBody() || isInTask())
                tbb::this_task_arena::isolate(loop); // a thread that waits for this loop begins no other body meanwhile
            else
                loop();
        });
    }

    // Whether the calling thread is in a loop's body.
    static bool& isInBody() noexcept
    {
        static thread_local bool isInBody = false;
        return isInBody;
    }

    tbb::task_arena arena_;
    std::atomic<std::size_t> enqueued_{0};
};

DFB_NAMESPACE_END
