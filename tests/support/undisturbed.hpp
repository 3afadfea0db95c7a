// undisturbed: runs a case again if this process stood still meanwhile, as on a machine that is busy with other work.
// Then time-outs may pass that nothing in the case has caused.
#pragma once

#include <atomic>
#include <chrono>
#include <cstddef>
#include <functional>
#include <future>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <pthread.h>
#include <sched.h>
#endif

// Measures for how long a processor of this process stood still at most. On each processor a thread sleeps again and
// again, and may wake up late. It also sees how long the other threads have been asleep.
class StandStill {
public:
    using Clock = std::chrono::steady_clock;

    // `onLonger` is called when a standstill is longer than all before, by one thread at a time.
    explicit StandStill(std::function<void(Clock::duration)> onLonger = [](Clock::duration) {})
        : onLonger_(std::move(onLonger)), processors_(ownProcessors()), awake_(processors_.size(), Clock::now())
    {
        for (std::size_t i = 0; i < processors_.size(); ++i)
            threads_.emplace_back([this, i] { watch(i); });
    }
    StandStill(const StandStill&) = delete;
    StandStill& operator=(const StandStill&) = delete;
    ~StandStill() { end(); }

    // Ends the measurement and returns the longest standstill.
    Clock::duration end()
    {
        over_ = true;
        for (std::thread& thread : threads_)
            thread.join();
        threads_.clear();
        return longest_;
    }

private:
    // The processors that this process may run on; {-1} if they are not known.
    static std::vector<int> ownProcessors()
    {
        std::vector<int> processors;
#if defined(__linux__)
        cpu_set_t mask;
        if (sched_getaffinity(0, sizeof mask, &mask) == 0)
            for (int i = 0; i < CPU_SETSIZE; ++i)
                if (CPU_ISSET(static_cast<unsigned>(i), &mask))
                    processors.push_back(i);
#endif
        return processors.empty() ? std::vector<int>{-1} : processors;
    }

    void watch(std::size_t own)
    {
#if defined(__linux__)
        if (processors_[own] >= 0) {
            cpu_set_t mask;
            CPU_ZERO(&mask);
            CPU_SET(static_cast<unsigned>(processors_[own]), &mask);
            pthread_setaffinity_np(pthread_self(), sizeof mask, &mask);
        }
#endif
        while (!over_) {
            std::this_thread::sleep_for(std::chrono::milliseconds(5));
            const auto now = Clock::now();
            const std::lock_guard<std::mutex> lock(mutex_);
            for (const auto time : awake_)
                if (now - time > longest_) {
                    longest_ = now - time;
                    onLonger_(longest_);
                }
            awake_[own] = now;
        }
    }

    const std::function<void(Clock::duration)> onLonger_;
    const std::vector<int> processors_;
    std::mutex mutex_;
    std::vector<Clock::time_point> awake_; // when each thread was last awake
    Clock::duration longest_{};
    std::atomic<bool> over_{false};
    std::vector<std::thread> threads_; // one for each processor
};

struct IfItStoodStill {
    template <class Result>
    bool operator()(bool stoodStill, const Result&) const
    {
        return stoodStill;
    }
};

// Returns or throws what run() does. Calls run() up to four times, as long as `again(stoodStill, result)` returns true.
// `stoodStill` says whether this process stood still for 250 ms; `result` is a std::shared_future of what run() returns
// or throws.
template <class Run, class Again = IfItStoodStill>
auto undisturbed(const Run& run, const Again& again = Again())
{
    for (int left = 4;; --left) {
        StandStill standStill;
        const auto result = std::async(std::launch::deferred, run).share(); // the future keeps an exception
        result.wait();
        if (!again(standStill.end() >= std::chrono::milliseconds(250), result) || left == 1)
            return result.get();
    }
}
