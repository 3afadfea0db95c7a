// ProgressThread: calls poll() of a transport so that messages move while the renderer works. It polls for a
// few microseconds after the last message, then naps, the longer the less comes.
#pragma once

#include <dfb/version.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <thread>

#if defined(__linux__)
#include <sys/prctl.h>
#endif

namespace dfb {

template <class Transport>
class ProgressThread {
public:
    // Does not start yet. `transport` must live until stop().
    explicit ProgressThread(Transport& transport) : transport_(transport) {}
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
        stop_ = true;
        transport_.interrupt();
        if (thread_.joinable())
            thread_.join();
    }

    bool running() const noexcept { return thread_.joinable(); }

    // Whether messages may come in: if not, and nothing waits to be sent, the thread sleeps. From any thread.
    void expectMessages(bool expect)
    {
        expecting_ = expect;
        if (expect)
            transport_.interrupt();
    }

private:
    using Clock = std::chrono::steady_clock;
    static constexpr std::chrono::microseconds pollTime{5}, shortestNap{50}, longestNap{200}, longestRungNap{2000};

    void run()
    {
#if defined(__linux__)
        prctl(PR_SET_TIMERSLACK, 1000, 0, 0, 0); // in ns: the default would double the nap
#endif
        auto last = Clock::now();
        while (!stop_) {
            if (transport_.poll()) {
                last = Clock::now();
                continue;
            }
            const Clock::duration idle = Clock::now() - last;
            if (idle < pollTime)
                continue;
            if (!expecting_ && transport_.quiet())
                transport_.nap(std::chrono::seconds(1));
            else if (transport_.wakesOnArrival())
                transport_.nap(std::clamp<Clock::duration>(idle / 8, shortestNap, longestRungNap));
            else
                transport_.nap(std::clamp<Clock::duration>(idle / 8, shortestNap, longestNap));
        }
    }

    Transport& transport_;
    std::atomic<bool> stop_{false}, expecting_{false};
    std::thread thread_;
};

} // namespace dfb
