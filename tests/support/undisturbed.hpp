// undisturbed: runs a case again if this process stood still meanwhile, as on a machine that is busy with other work.
// Then time-outs may pass that nothing in the case has caused.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <future>
#include <thread>

// Measures for how long this process stood still at most: a thread sleeps again and again, and may wake up late.
class StandStill {
public:
    using Clock = std::chrono::steady_clock;

    StandStill() = default;
    StandStill(const StandStill&) = delete;
    StandStill& operator=(const StandStill&) = delete;
    ~StandStill() { end(); }

    // Ends the measurement and returns the longest standstill.
    Clock::duration end()
    {
        over_ = true;
        if (thread_.joinable())
            thread_.join();
        return longest_;
    }

private:
    void watch()
    {
        for (auto last = Clock::now(); !over_;) {
            std::this_thread::sleep_for(std::chrono::milliseconds(5));
            const auto now = Clock::now();
            longest_ = std::max(longest_, now - last);
            last = now;
        }
    }

    std::atomic<bool> over_{false};
    Clock::duration longest_{};
    std::thread thread_{[this] { watch(); }};
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
