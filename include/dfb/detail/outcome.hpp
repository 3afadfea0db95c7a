// FrameOutcome: how a frame ends: the first failure on this rank, the abort that tells the others, and the one
// reduction in which all ranks learn the same verdict.
#pragma once

#include <dfb/comm/mailbox.hpp>
#include <dfb/detail/frame_gate.hpp>
#include <dfb/detail/verdict.hpp>

#include <atomic>
#include <chrono>
#include <cstdint>
#include <exception>
#include <mutex>
#include <optional>
#include <string>
#include <utility>

namespace dfb::detail {

class FrameOutcome {
public:
    FrameOutcome(Mailbox& mailbox, const FrameGate& gate, std::uint32_t scope)
        : mailbox_(mailbox), gate_(gate), scope_(scope)
    {
    }

    // No other member may be running.
    void newFrame()
    {
        error_.reset();
        verdict_.reset();
        hasVerdict_ = failed_ = damaged_ = voted_ = told_ = false;
    }

    // The frame has failed on some rank, or the transport has. From any thread, as the rest.
    bool failed() const noexcept { return failed_.load(std::memory_order_relaxed) || mailbox_.failed(); }

    // A message was damaged, here or where the frame failed first: it may be one that the verdict needs.
    bool isDamaged() const noexcept { return damaged_; }

    // It has failed here: takes note of the reason, the first one, and tells the others. vote() must follow. False if
    // this rank has voted: then it is up to the others, and if they all have, it is too late.
    bool fail(const std::exception_ptr& reason, const ErrorInfo& where)
    {
        ErrorInfo info = errorInfoOf(reason, where);
        info.rank = mailbox_.rank();
        info.frame = gate_.frame();
        bool first = false, late = false;
        damaged_ = damaged_ || info.kind == ErrorKind::MalformedMessage;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            late = voted_;
            first = !std::exchange(told_, true);
            if (!error_) // else one that the frame could bear
                error_ = info;
        }
        failed_ = true;
        if (first) {
            ByteWriter body;
            put(body, info);
            for (int other = 0; other < mailbox_.size(); ++other)
                if (other != mailbox_.rank())
                    mailbox_.send(other, MessageKind::Abort, gate_.frame(), body.bytes());
        }
        return !late;
    }

    // Something was lost, but the frame goes on: the verdict will say so. False if this rank has voted: then it will
    // not.
    bool note(const std::exception_ptr& reason, const ErrorInfo& where)
    {
        ErrorInfo info = errorInfoOf(reason, where);
        info.rank = mailbox_.rank();
        info.frame = gate_.frame();
        const std::lock_guard<std::mutex> lock(mutex_);
        if (!error_)
            error_ = info;
        return !voted_;
    }

    // The first thing that went wrong as far as this rank knows, also if the frame goes on without it.
    std::optional<ErrorInfo> reason()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return error_;
    }

    // Another rank says that it has failed, and why. vote() must follow.
    void failElsewhere(const ErrorInfo& info)
    {
        damaged_ = damaged_ || info.kind == ErrorKind::MalformedMessage;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (!error_)
                error_ = info; // in case that rank has voted already
            told_ = true;
        }
        failed_ = true;
    }

    // Enters the verdict, once: when `done()`, or when the frame has failed, and this rank `may()`. `figures()` gives
    // its Verdict.
    template <class IsDone, class May, class Figures>
    void vote(const IsDone& done, const May& may, const Figures& figures)
    {
        Verdict mine;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (voted_ || mailbox_.failed() || !(failed_ || done()) || !may())
                return;
            voted_ = true;
            mine = figures();
            mine.error = error_;
        }
        mailbox_.reductions().enter(key(), mine.bytes(), Verdict::combine, [this](const ReductionTable::Bytes& result) {
            verdict_ = Verdict::from(result);
            hasVerdict_ = true;
            mailbox_.notify();
        });
    }

    // Waits for the verdict of all ranks: null if it has not come before `deadline`. Throws TransportError.
    const Verdict* wait(std::optional<std::chrono::steady_clock::time_point> deadline = std::nullopt)
    {
        return mailbox_.wait([this] { return hasVerdict_.load(); }, deadline) ? &*verdict_ : nullptr;
    }

    // Of the reduction in which the verdict comes.
    ReductionKey key() const { return {scope_, gate_.frame()}; }

private:
    Mailbox& mailbox_;
    const FrameGate& gate_;
    std::uint32_t scope_;
    std::atomic<bool> failed_{false}, damaged_{false}, hasVerdict_{false};
    std::optional<Verdict> verdict_; // set once, before hasVerdict_
    std::mutex mutex_;
    // Under mutex_:
    bool voted_ = false;
    bool told_ = false; // all ranks, by this one or another, that the frame has failed
    std::optional<ErrorInfo> error_;
};

} // namespace dfb::detail
