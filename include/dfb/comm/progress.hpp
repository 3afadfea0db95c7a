// ProgressThread: calls poll() of a transport so that messages move while the renderer works. It polls for a
// few microseconds after the last message, then naps, the longer the less comes, and shorter while somebody waits.
#pragma once

#include <dfb/version.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <mutex>
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

    // Polls on the calling thread, unless another one is doing so; true if anything moved. From any thread that may.
    bool tryPoll()
    {
        const std::unique_lock<std::mutex> lock(pollMutex_, std::try_to_lock);
        return lock.owns_lock() && transport_.poll();
    }

    // Whether messages may come in: if not, and nothing waits to be sent, the thread sleeps. From any thread.
    void expectMessages(bool expect)
    {
        expecting_ = expect;
        if (expect)
            transport_.interrupt();
    }

    // Somebody waits for messages from now on, or no more; as often false as true. From any thread.
    void hurry(bool more)
    {
        if (more && waiting_++ == 0)
            transport_.interrupt();
        if (!more)
            --waiting_;
    }

private:
    using Clock = std::chrono::steady_clock;
    static constexpr std::chrono::microseconds pollTime{5};

    // Waking up costs some 10 us of a core, which rendering threads lose. While nobody waits here, a message that is
    // taken a little later delays nobody; what this rank sends interrupts the nap anyway.
    Clock::duration napAfter(Clock::duration idle, bool quiet) const
    {
        using std::chrono::microseconds;
        const auto between = [&](int shortest, int longest) {
            return std::clamp<Clock::duration>(idle / 8, microseconds(shortest), microseconds(longest));
        };
        // What the network library has taken may need it for a moment more.
        if (!expecting_ && quiet && idle > std::chrono::milliseconds(10))
            return std::chrono::seconds(1);
        if (transport_.wakesOnArrival())
            return between(waiting_ > 0 ? 50 : 200, 2000);
        return waiting_ > 0 ? between(50, 200) : between(1000, 2000);
    }

    void run()
    {
#if defined(__linux__)
        prctl(PR_SET_TIMERSLACK, 1000, 0, 0, 0); // in ns: the default would double the nap
#endif
        auto last = Clock::now();
        while (!stop_) {
            if (tryPoll()) {
                last = Clock::now();
                continue;
            }
            const Clock::duration idle = Clock::now() - last;
            if (idle < pollTime)
                continue;
            transport_.nap(napAfter(idle, transport_.quiet()));
        }
    }

    Transport& transport_;
    std::mutex pollMutex_;
    std::atomic<bool> stop_{false}, expecting_{false};
    std::atomic<int> waiting_{0};
    std::thread thread_;
};

} // namespace dfb
