// JobShare: the jobs of a frame that every rank could do, half of them shared out beforehand, the other half on
// demand (guided self-scheduling, Polychronopoulos and Kuck 1987): shares shrink with what is left.
#pragma once

#include <dfb/base/fifo.hpp>
#include <dfb/comm/message.hpp>
#include <dfb/frame.hpp>

#include <algorithm>
#include <cstdint>
#include <mutex>
#include <optional>

namespace dfb::detail {

// What a rank asks for: it says how many there are, as the one that it asks may not have come to that yet.
struct JobRequest {
    std::int64_t count = 0;
    std::int32_t workers = 1;
    std::int32_t reserved = 0;
};

// One per rank. All members may be called from any thread.
class JobShare {
public:
    void newFrame()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        next_ = -1;
        mine_.clear();
        asked_ = began_ = exhausted_ = false;
    }

    // On the rank that hands out. Throws Error (MalformedMessage).
    JobRange give(const JobRequest& request, int rankCount)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (request.count < 0 || request.workers < 1 || (next_ >= 0 && request.count != handedOutOf_))
            failMalformed("a request for jobs that can not be", next_ < 0 ? -1 : handedOutOf_, request.count);
        handedOutOf_ = request.count;
        if (next_ < 0)
            next_ = fixedPart(request.count);
        const std::int64_t left = request.count - next_;
        const std::int64_t size =
            std::min(left, std::max<std::int64_t>(request.workers, left / (2 * static_cast<std::int64_t>(rankCount))));
        next_ += size;
        return {next_ - size, next_};
    }

    // A range that was handed out to this rank; an empty one: there are no more. Throws Error (MalformedMessage).
    void receive(const JobRange& range)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (!asked_ || range.begin < 0 || range.end < range.begin || range.end > count_)
            failMalformed("jobs that there are not", count_, range.end);
        asked_ = false;
        if (range.begin < range.end)
            mine_.push(range);
        else
            exhausted_ = true;
    }

    // The next range to do: nullopt if it has been asked for and has not come yet; empty if there are no more.
    std::optional<JobRange> take(std::int64_t count, int rank, int rankCount)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        count_ = count;
        if (!began_) {
            began_ = true;
            const std::int64_t fixed = fixedPart(count);
            const JobRange share{fixed * rank / rankCount, fixed * (rank + 1) / rankCount};
            if (share.begin < share.end)
                mine_.push(share);
        }
        if (!mine_.empty())
            return mine_.pop();
        return exhausted_ ? std::optional<JobRange>(JobRange{}) : std::nullopt;
    }

    // Whether it is time to ask for more: at most one request is out. True once for each.
    bool shouldAsk()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (asked_ || exhausted_ || !mine_.empty())
            return false;
        asked_ = true;
        return true;
    }

    // take() would return something.
    bool ready() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return !mine_.empty() || exhausted_;
    }

private:
    static std::int64_t fixedPart(std::int64_t count) { return count / 2; }

    mutable std::mutex mutex_;
    std::int64_t next_ = -1; // to hand out; -1: nobody has asked yet
    std::int64_t handedOutOf_ = 0, count_ = 0;
    Fifo<JobRange> mine_;
    bool began_ = false, asked_ = false, exhausted_ = false;
};

} // namespace dfb::detail
