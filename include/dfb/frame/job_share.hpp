// The jobs of a frame that any rank can do. Half of them are shared out beforehand, the other half on demand by guided
// self-scheduling (Polychronopoulos and Kuck 1987): shares shrink with the work that is left. JobShare has the numbers,
// JobExchange the messages.
#pragma once

#include <dfb/comm/mailbox.hpp>
#include <dfb/comm/message.hpp>
#include <dfb/frame/outcome.hpp>

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <exception>
#include <mutex>
#include <new>
#include <optional>
#include <utility>

DFB_NAMESPACE_BEGIN
namespace detail {

// Jobs [begin, end).
struct JobRange {
    std::int64_t begin = 0, end = 0;

    std::int64_t count() const noexcept { return end - begin; }
};

// A rank's request for jobs. It also carries the number of all jobs, as the rank that gets it may not know that yet.
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
        firstToAsk_ = -1;
        count_ = -1;
        mine_ = ahead_ = {};
        asked_ = exhausted_ = false;
    }

    // On the rank that hands out jobs: returns the next range, for rank `to`. Throws Error (MalformedMessage, or
    // Disagreement if another rank asked for another number of jobs).
    JobRange give(const JobRequest& request, int to, int rankCount)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (request.count < 0 || request.workers < 1)
            failMalformed("a request for jobs that cannot be", 1,
                          std::min(request.count, std::int64_t{request.workers}));
        if (firstToAsk_ < 0) {
            firstToAsk_ = to;
            askedOf_ = request.count;
            next_ = fixedPart(request.count);
        } else if (request.count != askedOf_) {
            throw Error(
                errorInfo(ErrorKind::Disagreement, printed("nextJob() of %lld jobs on rank %d and of %lld on rank %d",
                                                           static_cast<long long>(askedOf_), firstToAsk_,
                                                           static_cast<long long>(request.count), to)));
        }
        const std::int64_t left = request.count - next_;
        const std::int64_t size =
            std::min(left, std::max<std::int64_t>(request.workers, left / (2 * static_cast<std::int64_t>(rankCount))));
        next_ += size;
        return {next_ - size, next_};
    }

    // Takes a range that was handed out to this rank; an empty one says that there are no more. Throws Error
    // (MalformedMessage).
    void receive(const JobRange& range)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (!asked_ || range.begin < 0 || range.end < range.begin || range.end > count_)
            failMalformed("jobs that there are not", count_, range.end);
        asked_ = false;
        ahead_ = range;
        exhausted_ = range.count() == 0;
    }

    // Returns the next job to do: nullopt if jobs have been asked for and have not come yet; -1 if there are no more.
    // Sets `asks` if the caller must send a request now, which is when one job is left: more jobs then come in time,
    // and this rank holds few that others could begin sooner. At most one request is out.
    std::optional<std::int64_t> take(std::int64_t count, int rank, int rankCount, bool& asks)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (std::exchange(count_, count) < 0) {
            const std::int64_t fixed = fixedPart(count);
            mine_ = {fixed * rank / rankCount, fixed * (rank + 1) / rankCount};
        }
        if (mine_.count() == 0)
            mine_ = std::exchange(ahead_, {});
        std::optional<std::int64_t> job;
        if (mine_.count() > 0)
            job = mine_.begin++;
        else if (exhausted_)
            job = -1;
        asks = !asked_ && !exhausted_ && mine_.count() <= 1 && ahead_.count() == 0;
        asked_ = asked_ || asks;
        return job;
    }

    // Whether take() would return a job, or -1.
    bool ready() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return mine_.count() > 0 || ahead_.count() > 0 || exhausted_;
    }

private:
    static std::int64_t fixedPart(std::int64_t count) { return count / 2; }

    mutable std::mutex mutex_;
    int firstToAsk_ = -1;                 // the rank; -1: nobody has asked yet
    std::int64_t askedOf_ = 0, next_ = 0; // the number of all jobs, from requests; the next to hand out
    std::int64_t count_ = -1;             // of all jobs; -1: nothing was taken yet
    JobRange mine_, ahead_;               // not taken yet; those ahead come after the others
    bool asked_ = false, exhausted_ = false;
};

// One per rank. Rank `server` hands out the jobs.
class JobExchange {
public:
    // All must live as long as this.
    JobExchange(Mailbox& mailbox, const OpenFrame& frame, FrameOutcome& outcome, int server)
        : mailbox_(mailbox), frame_(frame), outcome_(outcome), server_(server)
    {
    }

    void newFrame() { share_.newFrame(); }

    // The next of `count` jobs; -1 if there are no more, or the frame has failed. May wait for the rank that hands out
    // jobs. If that takes longer than `timeout`, the frame fails; 0: it waits without a limit.
    std::int64_t next(std::int64_t count, std::chrono::milliseconds timeout)
    {
        while (!outcome_.failed()) {
            if (const auto job = take(count))
                return *job;
            std::optional<Mailbox::Clock::time_point> deadline;
            if (timeout.count() > 0)
                deadline = Mailbox::Clock::now() + timeout;
            const Mailbox::WorkerWaits waits(mailbox_);
            if (!mailbox_.wait([this] { return share_.ready() || outcome_.failed(); }, deadline)) {
                ErrorInfo info =
                    errorInfo(ErrorKind::TimedOut, printed("no word of rank %d on what there is to render", server_));
                info.from = server_;
                outcome_.fail(std::move(info));
            }
        }
        return -1;
    }

    // Throws what JobShare::give() does.
    void receive(int source, const MessageHeader& header, const Buffer& message)
    {
        if (header.kind == MessageKind::JobRequest) {
            if (mailbox_.rank() != server_)
                failMalformed("a request for jobs to a rank that hands out none", server_, mailbox_.rank());
            const JobRange jobs = share_.give(bodyOf<JobRequest>(message), source, mailbox_.size());
            return send(source, MessageKind::Jobs, jobs);
        }
        if (header.kind != MessageKind::Jobs || source != server_)
            failMalformed("jobs from a rank that hands out none", server_, source);
        receiveMine(bodyOf<JobRange>(message));
    }

private:
    // Others wait for the message. So if it cannot be sent, the frame fails, even if it may be partial.
    template <class Body>
    void send(int to, MessageKind kind, const Body& body)
    {
        try {
            mailbox_.sendBody(to, kind, frame_.number(), body);
        } catch (const std::bad_alloc&) {
            mailbox_.orGiveUp([&] { outcome_.failWhole(errorInfoOf(std::current_exception(), {})); });
        }
    }

    void receiveMine(const JobRange& jobs)
    {
        share_.receive(jobs);
        mailbox_.notify(); // other workers may wait for them
    }

    // Also asks for more jobs, so that they come while this one is done.
    std::optional<std::int64_t> take(std::int64_t count)
    {
        bool asks = false;
        const auto job = share_.take(count, mailbox_.rank(), mailbox_.size(), asks);
        if (asks) {
            const JobRequest request{count, mailbox_.executor().concurrency(), 0};
            if (mailbox_.rank() == server_)
                outcome_.guarded([&] { receiveMine(share_.give(request, server_, mailbox_.size())); });
            else
                send(server_, MessageKind::JobRequest, request);
        }
        return job;
    }

    Mailbox& mailbox_;
    const OpenFrame& frame_;
    FrameOutcome& outcome_;
    const int server_;
    JobShare share_;
};

} // namespace detail
DFB_NAMESPACE_END
