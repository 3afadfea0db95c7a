// ProgressLine: when rendering takes long, tells how far it is: on a terminal in one line that changes, elsewhere, as
// under mpirun and in the log of a batch job, in a line every 10 s.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <string>

#include <unistd.h>

namespace example {

// "frame 2 of 8, 120 of 260 tiles of this rank, 12 s, 35 s to go": `tiles` of about `expected` tiles of the frame are
// done, from which the time to go is estimated.
inline std::string progressText(int frame, int frameCount, std::int64_t tiles, std::int64_t expected, double seconds)
{
    const std::int64_t all = std::max({expected, tiles, std::int64_t{1}});
    const double done = (frame + static_cast<double>(tiles) / static_cast<double>(all)) / std::max(1, frameCount);
    char text[160];
    const int length =
        std::snprintf(text, sizeof text, "frame %d of %d, %lld of %lld tiles of this rank, %.0f s", frame + 1,
                      frameCount, static_cast<long long>(tiles), static_cast<long long>(all), seconds);
    if (done > 0)
        std::snprintf(text + length, sizeof text - static_cast<std::size_t>(length), ", %.0f s to go",
                      seconds / done * (1 - done));
    return text;
}

class ProgressLine {
public:
    // Silent unless `enabled`.
    ProgressLine(bool enabled, int frameCount) : enabled_(enabled), frameCount_(frameCount) {}

    // `tiles`: about how many tiles this rank renders in the frame.
    void beginFrame(int frame, std::int64_t tiles)
    {
        frame_ = frame;
        expected_ = tiles;
        tiles_ = 0;
    }
    bool isEnabled() const { return enabled_; }

    // A tile of this rank has been rendered. From any thread.
    void tileDone()
    {
        if (!enabled_)
            return;
        const std::int64_t tiles = ++tiles_;
        const std::int64_t now = std::chrono::nanoseconds(std::chrono::steady_clock::now() - begin_).count();
        std::int64_t due = nextNs_.load();
        if (now < due || !nextNs_.compare_exchange_strong(due, now + intervalNs_))
            return;
        const std::string text = progressText(frame_, frameCount_, tiles, expected_, static_cast<double>(now) / 1e9);
        std::fprintf(stderr, isTerminal_ ? "\r%s   " : "%s\n", text.c_str());
        shown_ = isTerminal_;
    }

    void end()
    {
        if (shown_)
            std::fputc('\n', stderr);
        shown_ = false;
    }

private:
    bool enabled_;
    const bool isTerminal_ = isatty(STDERR_FILENO) != 0;
    const std::int64_t intervalNs_ = isTerminal_ ? 500000000 : 10000000000;
    int frameCount_;
    std::atomic<int> frame_{0};
    std::atomic<std::int64_t> tiles_{0}, expected_{0}, nextNs_{isTerminal_ ? 2000000000 : intervalNs_};
    std::atomic<bool> shown_{false};
    std::chrono::steady_clock::time_point begin_ = std::chrono::steady_clock::now();
};

} // namespace example
