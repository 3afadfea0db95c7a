// ProgressThread: calls poll() of a transport so that messages move while the renderer works. It polls for a
// few microseconds after the last message, then naps; with nothing in flight it sleeps until it is woken.
#pragma once

#include <dfb/version.hpp>

#include <chrono>
#include <condition_variable>
#include <functional>
#include <mutex>
#include <thread>
#include <utility>

#if defined(__linux__)
#include <sys/prctl.h>
#endif

namespace dfb {

class ProgressThread {
public:
    // `poll`: true if something moved. `quiet`: nothing waits to be sent. Neither may throw or block. Does not start
    // yet.
    ProgressThread(std::function<bool()> poll, std::function<bool()> quiet)
        : poll_(std::move(poll)), quiet_(std::move(quiet))
    {
    }
    ProgressThread(const ProgressThread&) = delete;
    ProgressThread& operator=(const ProgressThread&) = delete;
    ~ProgressThread() { stop(); }

    void start()
    {
        thread_ = std::thread([this] { run(); });
    }

    // After this poll() is not called any more; the other members may be.
    void stop()
    {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            stop_ = true;
        }
        changed_.notify_one();
        if (thread_.joinable())
            thread_.join();
    }

    bool running() const noexcept { return thread_.joinable(); }

    // There is something to send. From any thread.
    void wake()
    {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            awake_ = true;
        }
        changed_.notify_one();
    }

    // Whether messages may come in: if not, and nothing waits to be sent, the thread sleeps. From any thread.
    void expectMessages(bool expect)
    {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            expecting_ = expect;
        }
        changed_.notify_one();
    }

private:
    using Clock = std::chrono::steady_clock;
    static constexpr std::chrono::microseconds pollTime{5};
    static constexpr std::chrono::microseconds napTime{50};

    void run()
    {
#if defined(__linux__)
        prctl(PR_SET_TIMERSLACK, 1000, 0, 0, 0); // in ns: the default would double the nap
#endif
        auto last = Clock::now();
        for (;;) {
            if (poll_()) {
                last = Clock::now();
                continue;
            }
            if (Clock::now() - last < pollTime)
                continue;
            std::unique_lock<std::mutex> lock(mutex_);
            if (stop_)
                return;
            if (!awake_) {
                if (expecting_ || !quiet_())
                    changed_.wait_for(lock, napTime);
                else
                    changed_.wait(lock, [this] { return stop_ || awake_ || expecting_; });
            }
            awake_ = false;
        }
    }

    std::function<bool()> poll_, quiet_;
    std::mutex mutex_;
    std::condition_variable changed_;
    bool awake_ = false, expecting_ = false, stop_ = false;
    std::thread thread_;
};

} // namespace dfb
