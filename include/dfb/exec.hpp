// Executor: runs the tasks of a framebuffer and the loops of a renderer. A ThreadExecutor runs them on its own
// std::threads, a CallerExecutor on the threads that call it, a TbbExecutor (tbb_executor.hpp) in its own oneTBB arena.
#pragma once

#include <dfb/base/fifo.hpp>
#include <dfb/base/function_ref.hpp>
#include <dfb/base/processors.hpp>
#include <dfb/version.hpp>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// Between two iterations of a loop a worker runs the tasks that wait, so that compositing goes on beside rendering. If
// all workers of a ThreadExecutor are in long iterations, the thread that waits for the loop does so.
class Executor {
public:
    using Task = std::function<void()>;

    virtual ~Executor() = default;
    Executor() { tasks_.reserve(256); } // more tasks rarely wait at once

    // The number of workers, at least 1.
    virtual int concurrency() const noexcept = 0;

    // Whether tasks run by themselves. False: only threads in help() or parallelFor() run them.
    virtual bool hasWorkers() const noexcept { return true; }

    // Queues a task, and does not wait for it. Any thread. The task must not throw, nor wait for other tasks. Throws
    // std::bad_alloc.
    void submit(Task task)
    {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            tasks_.push(std::move(task));
        }
        try {
            wake();
        } catch (...) { // the task is queued all the same: the next wake(), or a thread that waits, gets it run
        }
    }

    // Runs the oldest waiting task on the calling thread, and returns true when it has ended. Returns false at once if
    // no task waits. For threads that have to wait. Any thread.
    bool help()
    {
        Task task;
        {
            std::lock_guard<std::mutex> lock(mutex_);
            if (tasks_.empty())
                return false;
            task = tasks_.pop();
        }
        ++depth();
        task();
        --depth();
        return true;
    }
    bool hasTasks() // whether a task waits; any thread
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return !tasks_.empty();
    }

    // Calls body(i) for i in [0, count), in no particular order, on several workers at once. Any thread may call it,
    // several at once. Waits until all these calls have returned. If a worker of a ThreadExecutor calls it, that worker
    // alone runs the loop; with a TbbExecutor others may take part. Rethrows the first exception of a body; after it no
    // other body begins. A calling thread that runs no bodies calls meanwhile() every millisecond, which must not
    // throw. With a ThreadExecutor that thread also runs tasks that have waited for a millisecond.
    void parallelFor(std::size_t count, detail::FunctionRef<void(std::size_t)> body,
                     const std::function<void()>& meanwhile = nullptr)
    {
        if (count == 0)
            return;
        std::exception_ptr error; // of the body that has stopped the loop
        std::atomic<bool> stop{false};
        const auto guarded = [&](std::size_t i) {
            if (stop.load(std::memory_order_relaxed))
                return;
            try {
                body(i);
            } catch (...) {
                if (!stop.exchange(true))
                    error = std::current_exception();
            }
            while (!isInTask() && help()) {
            }
        };
        run(count, std::ref(guarded), meanwhile); // std::ref, unlike a copy, takes no memory
        if (error)
            std::rethrow_exception(error);
    }

protected:
    // Makes a worker call help() soon, unless hasWorkers() is false. Any thread calls it, also one that moves messages.
    // If it throws, a thread that waits for the frame runs the task.
    virtual void wake() = 0;
    // Calls body(i) for all i on the workers, and waits. Either the calling thread takes part, or it calls `meanwhile`
    // every millisecond, unless that is null. The body does not throw.
    virtual void run(std::size_t count, const std::function<void(std::size_t)>& body,
                     const std::function<void()>& meanwhile) = 0;

    // Whether the calling thread runs a task. Loops within tasks run no tasks: these would nest without a limit.
    static bool isInTask() noexcept { return depth() > 0; }

private:
    // How many tasks, one within the other, the calling thread is running.
    static int& depth() noexcept
    {
        static thread_local int depth = 0;
        return depth;
    }

    std::mutex mutex_;
    detail::Fifo<Task> tasks_;
};

// A fixed number of threads. The destructor runs the tasks that were submitted, then joins.
class ThreadExecutor final : public Executor {
public:
    // `threadCount` workers; 0: one for each processor that the calling thread may run on. That is too many if several
    // ranks share the processors: see Connection::threadShare(). Throws std::system_error if the system gives no more
    // threads.
    explicit ThreadExecutor(int threadCount = 0)
    {
        if (threadCount <= 0)
            threadCount = Processors::ofThisThread().count();
        threads_.reserve(static_cast<std::size_t>(threadCount));
        try {
            for (int i = 0; i < threadCount; ++i)
                threads_.push_back(std::thread([this] { work(); }));
        } catch (...) { // the system gives no more
            end();
            throw;
        }
    }

    ~ThreadExecutor() override { end(); }

    int concurrency() const noexcept override { return static_cast<int>(threads_.size()); }
    bool hasWorkers() const noexcept override { return resting_ == 0; }

    // Suspends (true) or resumes (false) the workers. Calls nest and must balance. While they rest, loops and tasks run
    // on the calling threads, as with a CallerExecutor. Any thread. Waits for nothing.
    void rest(bool more)
    {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            resting_ += more ? 1 : -1;
            if (resting_ > 0 || !hasTasks()) // a task that comes later will find them awake
                return;
            signals_ += threads_.size();
        }
        wakeUp_.notify_all();
    }

private:
    struct Loop {
        std::size_t count;
        const std::function<void(std::size_t)>* body;
        std::size_t next = 0; // under mutex_
        std::size_t done = 0; // under mutex_
    };

    void end()
    {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            stop_ = true;
        }
        wakeUp_.notify_all();
        for (std::thread& thread : threads_)
            thread.join();
    }

    void wake() override
    {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            if (resting_ > 0)
                return;
            ++signals_;
            if (watching_ > 0)
                loopDone_.notify_all();
        }
        wakeUp_.notify_one();
    }

    void run(std::size_t count, const std::function<void(std::size_t)>& body,
             const std::function<void()>& meanwhile) override
    {
        if (isWorker() || resting_ > 0) {
            for (std::size_t i = 0; i < count; ++i)
                body(i);
            return;
        }
        Loop loop{count, &body};
        std::unique_lock<std::mutex> lock(mutex_);
        loops_.push(&loop);
        wakeUp_.notify_all();
        // All workers may be in long iterations while other ranks wait for a task. So if tasks still wait after a
        // millisecond, this thread runs them, too. It then stands in for a worker: loops within tasks are its own.
        const auto isDone = [&] { return loop.done == loop.count; };
        const bool helps = !isInTask();
        for (;;) {
            if (!meanwhile && !isDone() && !(helps && hasTasks())) {
                ++watching_;
                loopDone_.wait(lock);
                --watching_;
            }
            if (loopDone_.wait_for(lock, std::chrono::milliseconds(1), isDone))
                return;
            lock.unlock();
            {
                const Role role(*this);
                do {
                    if (meanwhile)
                        meanwhile();
                } while (helps && help());
            }
            lock.lock();
        }
    }

    void work()
    {
        const Role role(*this);
        std::unique_lock<std::mutex> lock(mutex_);
        for (;;) {
            wakeUp_.wait(lock, [this] { return stop_ || signals_ > 0 || !loops_.empty(); });
            if (signals_ > 0) {
                --signals_;
                lock.unlock();
                while (help()) {
                }
                lock.lock();
            } else if (!loops_.empty()) {
                Loop* loop = loops_.front();
                const std::size_t i = loop->next++;
                if (loop->next == loop->count)
                    loops_.pop();
                lock.unlock();
                (*loop->body)(i);
                lock.lock();
                if (++loop->done == loop->count)
                    loopDone_.notify_all();
            } else {
                return;
            }
        }
    }

    // For as long as it lives, the thread that has made it is a worker: of several executors if a worker of one waits
    // for a loop of another.
    struct Role {
        const ThreadExecutor& executor;
        const Role* outer;

        explicit Role(const ThreadExecutor& its) : executor(its), outer(std::exchange(innermost(), this)) {}
        ~Role() { innermost() = outer; }
        Role(const Role&) = delete;
        Role& operator=(const Role&) = delete;

        static const Role*& innermost()
        {
            static thread_local const Role* role = nullptr;
            return role;
        }
    };

    bool isWorker() const // whether the calling thread is one
    {
        const Role* role = Role::innermost();
        while (role && &role->executor != this)
            role = role->outer;
        return role != nullptr;
    }

    std::mutex mutex_;
    std::condition_variable wakeUp_, loopDone_;
    detail::Fifo<Loop*> loops_;
    std::size_t signals_ = 0;
    int watching_ = 0;            // threads that wait for their loop, or for a task
    std::atomic<int> resting_{0}; // changes under mutex_
    bool stop_ = false;
    std::vector<std::thread> threads_;
};

// Has no threads of its own. Loops run on the thread that calls parallelFor(). Tasks run on that thread between two
// iterations, on threads that call setTile() or poll(), and on a thread that waits for a frame. For ranks that have one
// core each. With Progress::Caller as well, the library works only while the program calls it, and other ranks may wait
// for that. Framebuffers whose frames are open at the same time must share one executor. A rank that waits in one frame
// then runs the tasks of all, so that other ranks find room for their messages. Make and destroy connections while no
// frame is open: a rank that waits there runs no tasks.
class CallerExecutor final : public Executor {
public:
    ~CallerExecutor() override
    {
        while (help()) {
        }
    }

    int concurrency() const noexcept override { return 1; }
    bool hasWorkers() const noexcept override { return false; }

private:
    void wake() override {}
    void run(std::size_t count, const std::function<void(std::size_t)>& body, const std::function<void()>&) override
    {
        for (std::size_t i = 0; i < count; ++i)
            body(i);
    }
};

DFB_NAMESPACE_END
