// ProgressThread: calls poll() of a link so that messages move while the renderer works. It polls for a few
// microseconds after the last message, then naps. Naps are longer if fewer messages come, and shorter while a thread
// waits. Between polls it calls a function for work that is due at certain times, such as the heartbeat. Where there
// may be no thread, threads that wait poll the link: see leaveToCallers().
#pragma once

#include <dfb/comm/transport.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <functional>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/prctl.h>
#endif

DFB_NAMESPACE_BEGIN

class ProgressThread {
public:
    using Clock = std::chrono::steady_clock;

    // Does not start the thread yet. `link` must live until stop(). Between polls the thread calls `between`. With
    // nothing to do it sleeps for `longestNap` at most.
    ProgressThread(Link& link, Clock::duration longestNap, std::function<void(Clock::time_point now)> between)
        : link_(link), longestNap_(longestNap), between_(std::move(between))
    {
    }
    ProgressThread(const ProgressThread&) = delete;
    ProgressThread& operator=(const ProgressThread&) = delete;
    ~ProgressThread() { stop(); }

    void start()
    {
        thread_ = std::thread([this] { run(); });
    }

    // In place of start(), if only the calling thread may poll: from now on pollOthers() polls this link, too.
    void leaveToCallers()
    {
        const std::lock_guard<std::mutex> lock(left().mutex);
        maker_ = std::this_thread::get_id();
        left().all.push_back(this);
    }

    // For a thread that waits: polls the links that it has left to callers, but not that of `own`. A rank that waits
    // with one connection may be needed in another. Returns whether anything moved.
    static bool pollOthers(const ProgressThread* own = nullptr)
    {
        static thread_local bool isPolling = false; // a link that is polled does not poll others
        if (isPolling)
            return false;
        const std::unique_lock<std::mutex> lock(left().mutex, std::try_to_lock);
        if (!lock.owns_lock())
            return false;
        isPolling = true;
        bool moved = false;
        try {
            for (ProgressThread* each : left().all)
                moved = (each != own && each->maker_ == std::this_thread::get_id() && each->link_.mayPoll()
                         && each->tryPoll())
                        || moved;
        } catch (const std::exception&) { // of a transport that throws: its own callers will see it
        }
        isPolling = false;
        return moved;
    }

    // Ends the thread: after this neither it nor pollOthers() calls poll(). The other members may still be called.
    void stop()
    {
        {
            const std::lock_guard<std::mutex> lock(left().mutex);
            left().all.erase(std::remove(left().all.begin(), left().all.end(), this), left().all.end());
        }
        stop_ = true;
        link_.interrupt();
        if (thread_.joinable())
            thread_.join();
    }

    bool running() const noexcept { return thread_.joinable(); }

    // Polls on the calling thread, unless another thread is polling. Returns whether anything moved. From any thread
    // that may call poll() of the link.
    bool tryPoll()
    {
        const std::unique_lock<std::mutex> lock(pollMutex_, std::try_to_lock);
        if (!lock.owns_lock())
            return false;
        const bool moved = link_.poll();
        hasPolled_ = true;
        return moved;
    }

    // Says whether messages may come in; each true is followed by one false. If none may, and nothing waits to be sent,
    // the thread sleeps. From any thread.
    void expectMessages(bool expect)
    {
        expecting_ += expect ? 1 : -1;
        if (expect)
            link_.interrupt();
    }
    bool expectsMessages() const noexcept { return expecting_ > 0; }

    // True: a thread that calls tryPoll() all the time now stands in for this one, which meanwhile polls only every few
    // milliseconds. False: it does so no more. Calls nest and must balance. From any thread.
    void standIn(bool more)
    {
        standIns_ += more ? 1 : -1;
        if (!more && expecting_)
            standInLeft_.interrupt();
    }
    bool hasStandIn() const noexcept { return standIns_ > 0; }
    // Whether threads that wait must poll: this one does not run, or has a stand-in.
    bool needsCaller() const noexcept { return !running() || hasStandIn(); }

    // True: from now on somebody waits for messages. False: no more. Each true is followed by one false. From any
    // thread.
    void hurry(bool more)
    {
        if (more && waiting_++ == 0)
            link_.interrupt();
        if (!more)
            --waiting_;
    }

private:
    static constexpr std::chrono::microseconds pollTime{5};

    struct Left { // to callers, in this process. Where ranks are threads, each polls only its own.
        std::mutex mutex;
        std::vector<ProgressThread*> all; // under mutex
    };
    static Left& left()
    {
        static Left& links = *new Left; // never destroyed: connections may be, after it
        return links;
    }

    // Waking up costs rendering threads some 10 us of a core. While no thread waits here, a message may be taken a
    // little later. A message that this rank sends ends the nap anyway.
    Clock::duration napAfter(Clock::duration idle, bool quiet) const
    {
        using std::chrono::microseconds;
        const auto between = [&](int shortest, int longest) {
            return std::clamp<Clock::duration>(idle / 8, microseconds(shortest), microseconds(longest));
        };
        // Only after a while, as the network library may need more calls to finish messages that it has taken.
        if (!expectsMessages() && quiet && idle > std::chrono::milliseconds(10))
            return longestNap_;
        return waiting_ > 0 ? between(50, 200) : between(1000, 2000);
    }

    void run()
    {
#if defined(__linux__)
        prctl(PR_SET_TIMERSLACK, 1000, 0, 0, 0); // in ns: the default would double the nap
#endif
        auto last = Clock::now();
        while (!stop_) {
            if (hasStandIn())
                standInLeft_.nap(std::chrono::milliseconds(2));
            const bool moved = tryPoll();
            const auto now = Clock::now();
            if (hasPolled_.exchange(false))
                between_(now);
            if (moved)
                last = now;
            if (const Clock::duration idle = now - last; idle >= pollTime)
                link_.nap(napAfter(idle, link_.quiet()));
        }
    }

    Link& link_;
    const Clock::duration longestNap_;
    const std::function<void(Clock::time_point)> between_;
    std::thread::id maker_; // that of leaveToCallers()
    std::mutex pollMutex_;
    std::atomic<bool> stop_{false};
    std::atomic<bool> hasPolled_{false}; // since `between` was called
    std::atomic<int> expecting_{0}, waiting_{0}, standIns_{0};
    NapSignal standInLeft_;
    std::thread thread_;
};

DFB_NAMESPACE_END
