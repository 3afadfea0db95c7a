// FrameTimer: the time of a frame over all ranks, also if these have different clocks.
#pragma once

#include "baselines.hpp"

#include <chrono>
#include <cstddef>
#include <cstring>
#include <limits>
#include <thread>
#include <vector>

namespace bench {

// In ms, from when the first rank began.
struct Times {
    double image = 0;    // until rank 0 has it; without compositing, until all ranks have rendered
    double rendered = 0; // until the slowest rank has rendered
    double cpu = 0;      // of all ranks
    double busiest = 0;  // CPU time of the rank with the most: near the frame's time where each has a core

    // The paper's compositing overhead.
    double overhead() const { return image - rendered; }
};

// Ranks on other nodes ask rank 0 for its time before each frame, because clocks drift. They use the answer that came
// back soonest, whose error is at most half of the time that it took.
class FrameTimer {
public:
    // Collective, as is all that it does. The communicator remains the caller's.
    explicit FrameTimer(MPI_Comm comm) : comm_(comm)
    {
        char own[MPI_MAX_PROCESSOR_NAME] = {}, first[MPI_MAX_PROCESSOR_NAME] = {};
        int length = 0;
        MPI_Get_processor_name(own, &length);
        std::memcpy(first, own, sizeof first);
        MPI_Request request = MPI_REQUEST_NULL;
        MPI_Ibcast(first, MPI_MAX_PROCESSOR_NAME, MPI_CHAR, 0, comm, &request);
        napThrough(request);
        isElsewhere_ = std::strcmp(own, first) != 0;
        const std::vector<double> all = collect(comm, {isElsewhere_ ? 1.0 : 0.0});
        for (std::size_t r = 0; r < all.size(); ++r)
            if (all[r] > 0)
                elsewhere_.push_back(static_cast<int>(r));
    }

    // All ranks call `frame()` at once; it returns when (by now()) this rank had rendered.
    template <class Frame>
    Times time(const Frame& frame, bool makesImage = true)
    {
        meet(comm_);
        synchronize();
        const double begin = agree(comm_, clock() + 2e-3);
        if (const double wait = begin - clock(); wait > 0)
            std::this_thread::sleep_for(std::chrono::duration<double>(wait));
        const double cpuBefore = processCpuSeconds();
        const double start = clock(), rendered = frame() + offset_, end = clock();
        const double cpu = processCpuSeconds() - cpuBefore;
        const double first = reduce(comm_, start, MPI_MIN);
        Times t;
        t.rendered = 1e3 * (reduce(comm_, rendered, MPI_MAX) - first);
        t.image = makesImage ? 1e3 * (agree(comm_, end) - first) : t.rendered;
        t.cpu = 1e3 * reduce(comm_, cpu, MPI_SUM);
        t.busiest = 1e3 * reduce(comm_, cpu, MPI_MAX);
        return t;
    }

    // The time of rank 0's clock, as far as this rank knew it at the last synchronize().
    double clock() const { return now() + offset_; }

    // Collective. Does nothing where all ranks are on one node.
    void synchronize()
    {
        constexpr int rounds = 12, tag = 77;
        double soonest = std::numeric_limits<double>::max();
        const auto send = [&](double value, int to) {
            plainSend(reinterpret_cast<const std::byte*>(&value), sizeof value, to, tag, comm_, Waiting::Yield);
        };
        const auto receive = [&](int from) {
            double value = 0;
            plainReceive(reinterpret_cast<std::byte*>(&value), sizeof value, from, tag, comm_, Waiting::Yield);
            return value;
        };
        for (const int other : elsewhere_) // only rank 0 has any
            for (int i = 0; i < rounds; ++i) {
                receive(other);
                send(now(), other);
            }
        for (int i = 0; isElsewhere_ && i < rounds; ++i) {
            const double asked = now();
            send(asked, 0);
            const double theirs = receive(0), answered = now();
            if (answered - asked < soonest) {
                soonest = answered - asked;
                offset_ = theirs - 0.5 * (asked + answered);
            }
        }
    }

private:
    MPI_Comm comm_;
    bool isElsewhere_ = false;
    std::vector<int> elsewhere_; // on rank 0: the ranks that ask
    double offset_ = 0;          // to rank 0's clock
};

} // namespace bench
