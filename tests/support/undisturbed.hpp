// Undisturbed: runs a case again if this process stood still meanwhile, as on a machine that is busy with other things.
// Time-outs pass then that nothing in the case has caused.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <future>
#include <thread>

// Notices how long this process stood still, at most: by that much a nap of a thread of its own was late.
class StandStill {
public:
    using Clock = std::chrono::steady_clock;

    StandStill() = default;
    StandStill(const StandStill&) = delete;
    StandStill& operator=(const StandStill&) = delete;
    ~StandStill() { end(); }

    // Ends the watch, and says how long.
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

// Returns or throws what run() does. Runs it up to four times, as long as `again(stoodStill, result)`: whether this
// process stood still for a quarter of a second, and the std::shared_future of what came of it.
template <class Run, class Again = IfItStoodStill>
auto undisturbed(const Run& run, const Again& again = Again())
{
    for (int left = 4;; --left) {
        StandStill standStill;
        const auto result = std::async(std::launch::deferred, run).share(); // which keeps what it throws
        result.wait();
        if (!again(standStill.end() >= std::chrono::milliseconds(250), result) || left == 1)
            return result.get();
    }
}
