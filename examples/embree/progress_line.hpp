// ProgressLine: on a terminal, when rendering takes long, one line that tells how far it is.
#pragma once

#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdio>

#include <unistd.h>

namespace example {

class ProgressLine {
public:
    // Silent unless `enabled` and standard error is a terminal.
    ProgressLine(bool enabled, int frameCount) : enabled_(enabled && isatty(STDERR_FILENO)), frameCount_(frameCount) {}

    void beginFrame(int frame) { frame_ = frame; }

    // A tile of this rank has been rendered. From any thread.
    void tileDone()
    {
        if (!enabled_)
            return;
        const std::int64_t tiles = ++tiles_;
        const std::int64_t now = std::chrono::nanoseconds(std::chrono::steady_clock::now() - begin_).count();
        std::int64_t due = nextNs_.load();
        if (now < due || !nextNs_.compare_exchange_strong(due, now + intervalNs))
            return;
        std::fprintf(stderr, "\rframe %d of %d, %lld tiles rendered on this rank, %.0f s ", frame_ + 1, frameCount_,
                     static_cast<long long>(tiles), static_cast<double>(now) / 1e9);
        shown_ = true;
    }

    void end()
    {
        if (shown_)
            std::fputc('\n', stderr);
        shown_ = false;
    }

private:
    static constexpr std::int64_t intervalNs = 500000000;

    bool enabled_;
    int frameCount_;
    std::atomic<int> frame_{0};
    std::atomic<std::int64_t> tiles_{0}, nextNs_{4 * intervalNs};
    std::atomic<bool> shown_{false};
    std::chrono::steady_clock::time_point begin_ = std::chrono::steady_clock::now();
};

} // namespace example
