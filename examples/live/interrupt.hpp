// Interrupt: turns Ctrl-C, or the signal with which a launcher ends a job, into a flag that a loop can test.
#pragma once

#include <atomic>
#include <csignal>
#include <ctime>

namespace example {

// From the construction of an object on, SIGINT and SIGTERM set the flag. A signal that comes more than two seconds
// after the first ends the process as usual, because the job has not reacted. (Earlier ones do not: both a terminal and
// a launcher may send the first signal.) The destructor ends this, unless the flag is set: a launcher may be late with
// the signal for this process, which should end with its own exit code.
class Interrupt {
public:
    Interrupt() : beforeInt_(install(SIGINT)), beforeTerm_(install(SIGTERM)) {}
    ~Interrupt()
    {
        if (happened())
            return;
        sigaction(SIGINT, &beforeInt_, nullptr);
        sigaction(SIGTERM, &beforeTerm_, nullptr);
    }
    Interrupt(const Interrupt&) = delete;
    Interrupt& operator=(const Interrupt&) = delete;

    // Whether this process was told to end. Any thread.
    static bool happened() { return first_ != 0; }

private:
    // When the first signal came, in seconds of a clock that begins with 1; 0: none has come.
    static inline std::atomic<std::sig_atomic_t> first_{0};
    static_assert(decltype(first_)::is_always_lock_free, "a signal handler may not lock");

    static void note(int signal)
    {
        timespec now{};
        clock_gettime(CLOCK_MONOTONIC, &now);
        const auto seconds = static_cast<std::sig_atomic_t>(now.tv_sec + 1);
        if (first_ == 0) {
            first_ = seconds;
        } else if (seconds - first_ > 2) {
            std::signal(signal, SIG_DFL);
            std::raise(signal);
        }
    }

    static struct sigaction install(int signal)
    {
        struct sigaction action {
        }, before{};
        action.sa_handler = note;
        action.sa_flags = SA_RESTART;
        sigemptyset(&action.sa_mask);
        sigaction(signal, &action, &before);
        return before;
    }

    struct sigaction beforeInt_, beforeTerm_;
};

} // namespace example
