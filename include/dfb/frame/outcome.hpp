// FrameOutcome: how the open frame ends. It decides what makes the frame fail and what end() waits for, and has the
// reduction by which all ranks get one verdict.
#pragma once

#include <dfb/base/function_ref.hpp>
#include <dfb/comm/mailbox.hpp>
#include <dfb/comm/quiescence.hpp>
#include <dfb/frame/declarations.hpp>
#include <dfb/frame/open_frame.hpp>
#include <dfb/frame/tile_pipeline.hpp>
#include <dfb/frame/verdict.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <exception>
#include <functional>
#include <new>
#include <optional>
#include <string>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// Any thread may call the members, except newFrame(), beginEnd(), isConcluded() and conclude(): they are for the thread
// that begins and ends frames.
class FrameOutcome {
public:
    using Clock = std::chrono::steady_clock;
    using Bytes = ReductionTable::Bytes;
    // The kinds of its reductions.
    enum Scope : std::uint32_t { AllDeclared = Mailbox::ownScope + 1, FrameVerdict, Quiet = Mailbox::quietScope };

    // `quiet`: how long end() waits before it first looks whether any message is under way. `addFigures(verdict)` adds
    // this rank's counts of the frame to its vote. The others must live as long as this object.
    FrameOutcome(Mailbox& mailbox, OpenFrame& frame, TilePipeline& tiles, const Declarations& declarations,
                 std::chrono::milliseconds quiet, std::function<void(Verdict&)> addFigures)
        : mailbox_(mailbox), frame_(frame), tiles_(tiles), declarations_(declarations),
          addFigures_(std::move(addFigures)), quiescence_(quiet)
    {
    }

    // Call it before the frame is opened.
    void newFrame(const FrameTerms& terms)
    {
        terms_ = terms;
        verdict_.reset();
        isCreditInDoubt_ = false;
        givesUpAt_.reset();
        quiescence_.newFrame();
    }

    // Whether the frame has failed on some rank, or the transport has failed.
    bool failed() const noexcept { return frame_.failed() || mailbox_.failed(); }
    // Whether the last frame has ended with an error.
    bool lastFailed() const noexcept { return lastFailed_; }

    // ---- failure

    // Runs `body`. If it throws, calls fail() and returns false. `where`: the place of the error, as far as it is known
    // when `body` throws. If there is no memory to report the error, the connection fails.
    bool guarded(FunctionRef<void()> body, const ErrorInfo& where = {})
    {
        try {
            body();
            return true;
        } catch (...) {
            mailbox_.orGiveUp([&] { fail(errorInfoOf(std::current_exception(), where)); });
            return false;
        }
    }

    // Opens the next frame, as OpenFrame::open() does. With `reason` it fails before any message is taken, because this
    // rank's parameters may not be complete: messages could seem wrong.
    std::vector<Arrival>& open(std::optional<ErrorInfo> reason)
    {
        if (reason) {
            reason->rank = mailbox_.rank();
            reason->frame = frame_.next();
            tellOthers(*reason); // before this rank's vote
        }
        hasNotBegun_ = reason.has_value();
        auto& early = frame_.open(reason);
        if (reason) {
            dropRest(reason->kind);
            tryVote();
        }
        return early;
    }

    // Reports an error on this rank. The frame fails, or goes on without the lost part if it may be partial. Returns
    // false if this rank has voted already, so that its vote does not contain the error.
    bool fail(ErrorInfo reason)
    {
        if (!isBearable(reason.kind))
            return failWhole(std::move(reason));
        const bool inTime = frame_.note(placed(std::move(reason)));
        if (!inTime && !failed())
            frame_.countLate(); // the verdict will not contain it
        return inTime;
    }

    // Fails the frame even if it may be partial, because it cannot go on. Returns what fail() does.
    bool failWhole(ErrorInfo reason)
    {
        reason = placed(std::move(reason));
        const OpenFrame::Failure failure = frame_.fail(reason);
        if (failure.isFirst)
            tellOthers(reason);
        if (!failure.inTime)
            frame_.countLate(); // too late to matter to this frame
        dropRest(reason.kind);
        tryVote();
        return failure.inTime;
    }

    // Called when the frame has failed: drops the messages that have not left, except finished tiles if the frame may
    // be partial.
    void dropRest(ErrorKind why)
    {
        const bool isPartial = terms_.allowPartial;
        const auto matters = [isPartial](const Buffer& message) {
            return isPartial && GatheredImage::takes(loadAs<MessageHeader>(message.data()).kind);
        };
        // If something is missing, it may be credit: then do not wait for credit.
        if (isMissing(why))
            isCreditInDoubt_ = true;
        mailbox_.flow().drop(matters, isPartial && !isMissing(why));
        if (isPartial && !frame_.areTilesFinished())
            tiles_.flush();
    }

    // ---- messages

    void receiveAbort(const MessageHeader& header, const Buffer& message)
    {
        ByteReader body(message.data() + sizeof header, message.size() - sizeof header);
        ErrorInfo info = getErrorInfo(body);
        body.end();
        std::optional<ErrorInfo> mine;
        if (isMissing(info.kind)) {
            if (!failed())
                mine = missing(info.kind);  // this rank's part of the text
            info.tile = info.expected = -1; // weighs less than the list in its sender's own vote
        }
        frame_.fail(mine && Verdict::weight(*mine) > Verdict::weight(info) ? *mine : info);
        dropRest(info.kind);
        tryVote();
    }

    // Ranks with different parameters may wait for different things, and then none would ever be done. A partial result
    // from below in the tree shows the difference, because it was sent without waiting for this rank.
    void receiveReduction(int source, const MessageHeader& header, const Buffer& message)
    {
        const std::uint32_t scope = mailbox_.scopeOf(message);
        const bool isUp = header.kind == MessageKind::ReduceUp;
        bool differs = false;
        try {
            if (scope == FrameVerdict) {
                const Verdict verdict = Verdict::from(mailbox_.bytesOf(message));
                const int tileCount = tiles_.table().layout().tileCount();
                if (!verdict.fits(tileCount))
                    failMalformed("a verdict on tiles that there are not", tileCount - 1);
                // A rank that votes with an error has told all others why; in a frame that may be partial only if it
                // could not make its parameters.
                const bool isCause = verdict.error && (!terms_.allowPartial || verdict.hasNotBegun);
                differs = isUp && !isCause && !verdict.terms.difference(terms_).empty();
            } else if (scope == AllDeclared) {
                if (!mailbox_.bytesOf(message).empty())
                    failMalformed("a declaration's reduction that carries something");
                differs = isUp && !terms_.declared;
            } else if (scope == Quiet) {
                differs = !Round::from(mailbox_.bytesOf(message)).terms.difference(terms_).empty();
            } else {
                failMalformed("a reduction of a kind that there is not", FrameVerdict, scope);
            }
            if (differs)
                fail(Verdict::disagreement());
            mailbox_.receiveReduction(source, header, message);
        } catch (const Error& e) {
            // Without this message the reduction would never have a result.
            mailbox_.giveUp(source, e.info());
        } catch (const std::bad_alloc& e) {
            mailbox_.giveUp(source, errorInfo(ErrorKind::Transport, e.what()));
        }
    }

    // ---- the vote

    // Enters the reduction of the frame's verdict if this rank has nothing left to do, or the frame has failed on some
    // rank.
    void tryVote()
    {
        if (mailbox_.failed() || !frame_.vote([this] { return isDone(); }, [this] { return mayVote(); }))
            return;
        mailbox_.orGiveUp([&] {
            Verdict mine;
            mine.terms = terms_;
            mine.error = frame_.reason();
            mine.hasNotBegun = hasNotBegun_;
            addFigures_(mine);
            verdictSpan_.emplace(mailbox_.trace(), TraceEvent::Kind::Verdict, frame_.number());
            if (TraceEvent* event = verdictSpan_->event())
                event->byteCount = mine.sums.bytesSent;
            if (terms_.allowPartial)
                mine.incomplete = tiles_.table().unfinished();
            mailbox_.reductions().enter(verdictKey(), mine.bytes(), Verdict::combine, [this](const Bytes& result) {
                verdict_ = Verdict::from(result);
                verdictSpan_.reset();
                frame_.decide();
                mailbox_.notify();
            });
        });
    }

    // Called once a frame, when this rank has set its last tile: from now on it votes as soon as it can.
    void closeInputs()
    {
        frame_.closeInputs();
        tryVote();
    }

    // Called once a frame after closeInputs(), when the program first asks for the end: time-outs count from now.
    void beginEnd()
    {
        endedAt_ = Clock::now();
        nextLook_ = endedAt_ + quiescence_.interval();
        if (hasTimeout())
            givesUpAt_ = endedAt_ + 2 * terms_.timeout();
    }

    // After beginEnd(): whether conclude() need not wait for the verdict any longer, because it is here or will not
    // come. It also checks now and then whether any message is under way, and makes the frame fail when its time is up.
    bool isConcluded()
    {
        if (isDecided() || mailbox_.failed())
            return true;
        const auto now = Clock::now();
        if (now >= nextLook_) {
            nextLook_ = now + quiescence_.interval();
            look();
        }
        if (hasTimeout() && now >= endedAt_ + terms_.timeout() && !failed())
            fail(missing(ErrorKind::TimedOut));
        if (isVerdictInDoubt())
            givesUpAt_ = now + mailbox_.connection().config().peerTimeout;
        return givesUpAt_ && now >= *givesUpAt_;
    }

    // After beginEnd(): waits for the verdict of all ranks and closes the frame, also when it throws. Throws
    // TransportError, or std::bad_alloc, which ends the connection.
    Verdict conclude()
    {
        std::exception_ptr failure;
        const auto attempt = [&](FunctionRef<void()> step) {
            try {
                mailbox_.makePart(step);
            } catch (const TransportError&) {
                failure = std::current_exception();
            } catch (const std::bad_alloc&) {
                failure = std::current_exception();
            }
        };
        Verdict verdict;
        attempt([&] {
            do { // at least once: with Progress::Caller, wait() moves messages that others need
                mailbox_.wait([this] { return isDecided() || isVerdictInDoubt(); }, nextEvent());
            } while (!isConcluded());
            if (!isDecided())
                giveUpVerdict();
            verdict = *verdict_;
            if (!verdict.error)
                verdict.error = verdict.strayInputs();
            if (verdict.error && verdict.error->frame < 0) // an error that was found when verdicts were combined
                verdict.error->frame = frame_.number();
            if (isPartial(verdict)) // only then do all ranks send theirs
                waitForFinishedTiles();
        });
        frame_.close([this] { return mailbox_.executor().help(); });
        verdictSpan_.reset(); // if there is no verdict
        attempt([&] {
            mailbox_.reductions().forget(AllDeclared, frame_.number());
            mailbox_.reductions().forget(Quiet, frame_.number());
        });
        mailbox_.connection().expectMessages(false);
        lastFailed_ = failure || verdict.error;
        if (tiles_.image())
            tiles_.image()->close();
        if (!failure && isPartial(verdict))
            tiles_.setIncomplete(verdict.incomplete);
        else if (lastFailed_)
            tiles_.invalidateImage();
        if (failure)
            std::rethrow_exception(failure);
        return verdict;
    }

    // Whether the frame has an image although something is missing.
    bool isPartial(const Verdict& verdict) const
    {
        return terms_.allowPartial && verdict.error && verdict.error->kind != ErrorKind::Disagreement
               && verdict.differing.empty();
    }

private:
    ReductionKey verdictKey() const { return {FrameVerdict, frame_.number()}; }

    void tellOthers(const ErrorInfo& info)
    {
        mailbox_.orGiveUp([&] {
            Bytes body;
            put(body, info);
            for (int other = 0; other < mailbox_.size(); ++other)
                if (other != mailbox_.rank())
                    mailbox_.send(other, MessageKind::Abort, info.frame, body);
        });
    }

    ErrorInfo placed(ErrorInfo info) const
    {
        info.rank = mailbox_.rank();
        info.frame = frame_.number();
        return info;
    }

    // Whether a frame that may be partial goes on without the tile of this error.
    bool isBearable(ErrorKind kind) const
    {
        return terms_.allowPartial && !isMissing(kind) && kind != ErrorKind::Cancelled
               && kind != ErrorKind::Disagreement
               && (kind != ErrorKind::MalformedMessage || hasTimeout()); // it is waited for until the time-out
    }

    // Whether this rank has nothing left to do and only waits for other ranks.
    bool isDone() const { return frame_.areTilesFinished() && tiles_.table().isSaid() && tiles_.isImageComplete(); }

    // A rank with a progress thread may vote before all of its messages have left. There are two exceptions. If only
    // end() moves messages, all must have left: ranks that are out of end() take none. In a frame that may be partial,
    // none may wait for credit, as ranks that are out of end() give none. But credit that may be lost does not hold up
    // the vote: finished tiles then have the time of waitForFinishedTiles().
    bool mayVote() const
    {
        const bool onlyCallers = mailbox_.connection().hasOnlyCallers();
        return ((!onlyCallers && !terms_.allowPartial) || isCreditInDoubt_ || mailbox_.flow().allSent())
               && (!onlyCallers || mailbox_.connection().quiet());
    }

    // ---- waiting

    bool isDecided() const noexcept { return frame_.state() == FrameState::Decided; }
    bool hasTimeout() const noexcept { return terms_.timeoutMs > 0; }

    // Whether a damaged message may have been part of the verdict, and the wait has no end yet. isConcluded() then sets
    // one: it waits for the verdict as long as for a rank that is silent.
    bool isVerdictInDoubt() const
    {
        return !givesUpAt_ && frame_.isDamaged() && mailbox_.connection().config().peerTimeout.count() > 0;
    }

    // The time at which isConcluded() next has something to do.
    Clock::time_point nextEvent() const
    {
        auto next = nextLook_;
        if (hasTimeout() && !failed())
            next = std::min(next, endedAt_ + terms_.timeout());
        return givesUpAt_ ? std::min(next, *givesUpAt_) : next;
    }

    // If a frame failed and may be partial, tiles that other ranks have finished may still be on their way. This rank
    // may still be about to send some, and takes credit for them only while the frame is open.
    void waitForFinishedTiles()
    {
        const auto areThere = [this] {
            return tiles_.isImageComplete() && frame_.isIdle() && mailbox_.flow().allSent();
        };
        if (!hasTimeout()) // a message that could not be read does not come again
            mailbox_.wait(
                [&] { return areThere() || frame_.isDamaged() || (tiles_.image() && tiles_.image()->hasLost()); });
        mailbox_.wait(areThere, Clock::now() + (hasTimeout() ? terms_.timeout() : std::chrono::seconds(2)));
    }

    // The message of one round of quiescence_. It carries the parameters, because ranks with different ones could wait
    // for each other for ever. A round shows a difference on its way up the tree as soon as two such ranks are in
    // end(); see receiveReduction().
    struct Round {
        FrameTerms terms;
        Quiescence::Report report;

        Bytes bytes() const
        {
            Bytes out;
            out.put(*this);
            return out;
        }
        static Round from(const Bytes& bytes)
        {
            ByteReader in(bytes);
            const auto round = in.get<Round>();
            in.end();
            return round;
        }
        static Bytes combine(const Bytes& first, const Bytes& second)
        {
            const Round a = from(first), b = from(second);
            return Round{a.terms, Quiescence::sum(a.report, b.report)}.bytes();
        }
    };

    // Enters a round if this rank is at rest and the last round is over. Only the thread that is in end() calls it.
    void look()
    {
        tryVote();
        auto counts = mailbox_.countsAtRest();
        if (!counts || !quiescence_.tryEnter())
            return;
        const auto isWaiting = [this] { return !isDone() && !failed(); };
        counts->unfinished = isWaiting() ? 1 : 0;
        const Round mine{terms_, *counts};
        mailbox_.reductions().enter({Quiet, frame_.number()}, mine.bytes(), Round::combine,
                                    [this, isWaiting](const Bytes& all) {
                                        if (quiescence_.endRound(Round::from(all).report) && isWaiting())
                                            fail(missing(ErrorKind::MissingInput));
                                    });
    }

    // ---- missing inputs

    // Returns an error of this kind that names the inputs this rank waits for.
    ErrorInfo missing(ErrorKind kind)
    {
        ErrorInfo info;
        if (!frame_.areTilesKnown()) {
            info.message = "not all ranks have declared their inputs";
            info.expected = mailbox_.size();
            const std::vector<int> silent = declarations_.unanswered();
            if (silent.empty())
                addWaitedFor(info, {AllDeclared, frame_.number()});
            else
                addSilent(info, silent);
        } else if (!frame_.areTilesFinished()) {
            info = tiles_.table().missing();
            if (info.message.empty())
                info.message = "tiles that have all their inputs are still being finished";
        } else if (!tiles_.isImageComplete()) {
            info = tiles_.image()->missing();
        } else {
            info.message = "not all ranks have ended this frame";
            addWaitedFor(info, verdictKey());
        }
        info.kind = kind;
        if (const std::string lost = mailbox_.connection().lost(); kind == ErrorKind::TimedOut && !lost.empty())
            info.message += (info.message.empty() ? "" : "; ") + lost;
        return placed(std::move(info));
    }

    // Adds to the message, which has a text, the ranks whose parts of a reduction are missing here. Sets `from` if it
    // can only be one rank.
    void addWaitedFor(ErrorInfo& info, const ReductionKey& key)
    {
        const auto missing = mailbox_.reductions().missing(key);
        const char* separator = ", waiting for";
        for (const auto& part : missing) {
            info.message += printed("%s rank %d", std::exchange(separator, ","), part.rank);
            if (part.rank < mailbox_.rank())
                info.message += ", through which the result comes";
            else if (part.last > part.rank)
                info.message += printed(" or another up to %d, whose part comes with that one's", part.last);
        }
        if (missing.size() == 1 && missing.front().rank > mailbox_.rank()
            && missing.front().last == missing.front().rank)
            info.from = missing.front().rank;
    }

    // Adds to the message the ranks that have not answered this rank's manifest: they have not begun this frame.
    static void addSilent(ErrorInfo& info, const std::vector<int>& ranks)
    {
        constexpr std::size_t most = 8;
        const char* separator = ", waiting for";
        for (std::size_t i = 0; i < std::min(most, ranks.size()); ++i)
            info.message += printed("%s rank %d", std::exchange(separator, ","), ranks[i]);
        if (ranks.size() > most)
            info.message += printed(" and %zu more", ranks.size() - most);
        if (ranks.size() == 1)
            info.from = ranks.front();
    }

    [[noreturn]] void giveUpVerdict()
    {
        mailbox_.connection().throwIfFailed();
        const auto after = hasTimeout() ? 2 * terms_.timeout() : mailbox_.connection().config().peerTimeout;
        ErrorInfo info =
            placed(errorInfo(ErrorKind::Transport, printed("not all ranks have ended this frame after %lld ms",
                                                           static_cast<long long>(after.count()))));
        addWaitedFor(info, verdictKey());
        if (const auto reason = frame_.reason(); reason && isMissing(reason->kind))
            info.message += "; " + reason->message;
        if (const std::string lost = mailbox_.connection().lost(); !lost.empty())
            info.message += "; " + lost;
        mailbox_.connection().giveUp(info);
        throw TransportError(std::move(info));
    }

    Mailbox& mailbox_;
    OpenFrame& frame_;
    TilePipeline& tiles_;
    const Declarations& declarations_;
    std::function<void(Verdict&)> addFigures_;
    FrameTerms terms_;
    bool lastFailed_ = false, hasNotBegun_ = false;
    std::atomic<bool> isCreditInDoubt_{false}; // something is missing that may be credit
    std::optional<Verdict> verdict_;           // set once, before the frame is Decided
    std::optional<TraceSpan> verdictSpan_;     // from this rank's vote on
    Quiescence quiescence_;
    // Only for the thread that is in end():
    Clock::time_point endedAt_;                  // when beginEnd() was called
    Clock::time_point nextLook_;                 // when to call look() next
    std::optional<Clock::time_point> givesUpAt_; // when to stop waiting for the verdict
};

} // namespace detail
DFB_NAMESPACE_END
