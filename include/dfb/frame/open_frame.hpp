// OpenFrame: the frame that is open on this rank, as a state machine (drawn in docs/architecture.md). It knows which
// messages and tasks belong to the frame, and what the frame still waits for.
//
// The thread that is in begin() or end() calls open(), closeInputs() and close(). Any thread calls fail(). Any thread
// calls vote() when it has done something that the vote may have waited for. The thread that takes the result of the
// vote calls decide(). close() may be called in every state: if the transport has failed, no verdict comes.
#pragma once

#include <dfb/comm/message.hpp>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <memory>
#include <mutex>
#include <optional>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

enum class FrameState : std::uint8_t {
    Closed,    // before begin() and after end()
    Rendering, // this rank may still set tiles: closeInputs() has not been called
    Finishing, // waits for the tiles that this rank owns and, on the display rank, for those of the others
    Failed,    // on this rank or another; this rank has not voted yet
    Voted,     // this rank has said how the frame went for it, and waits for the others
    Decided    // all ranks have voted; work that is running may come to its end
};

// Any thread may call the members, except open(), closeInputs() and close(): one thread at a time.
class OpenFrame {
public:
    // Frames have the numbers `first`, `first` + `step`, and so on.
    explicit OpenFrame(std::int64_t first = 1, std::int64_t step = 1) : number_(first - step), step_(step)
    {
        for (std::vector<Arrival>* messages : {&early_, &opened_})
            messages->reserve(256); // how many come early depends on timing; rarely more
    }

    FrameState state() const noexcept { return state_; }
    // The number of the frame that was opened last (not positive before the first), and of the one that comes next.
    std::int64_t number() const noexcept { return number_; }
    std::int64_t next() const noexcept { return number_ + step_; }

    // ---- transitions

    // Opens the next frame and returns its messages that came before. The caller must take them before the next open().
    // With an error the frame has failed from the start, and the caller tells the others. Throws InvalidArgument if a
    // frame is open.
    std::vector<Arrival>& open(const std::optional<ErrorInfo>& error = std::nullopt)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (state_ != FrameState::Closed)
            failArgument("begin() while a frame is open: end() it first");
        number_ += step_;
        state_ = error ? FrameState::Failed : FrameState::Rendering;
        error_ = error;
        failed_ = error.has_value();
        damaged_ = false;
        tilesLeft_ = 0;
        areTilesKnown_ = areTilesFinished_ = false;
        hasInPlace_ = false;
        opened_.clear();
        opened_.swap(early_);
        return opened_;
    }

    // This rank has set its last tile, and only waits from now on.
    void closeInputs()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (state_ == FrameState::Rendering)
            state_ = FrameState::Finishing;
    }

    struct Failure {
        bool isFirst; // the other ranks must be told
        bool inTime;  // this rank's vote will say so
    };
    // Fails the frame because of an error on this rank, or on one that has told all others. The first reason counts.
    Failure fail(const ErrorInfo& info)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        damaged_ = damaged_ || info.kind == ErrorKind::MalformedMessage;
        if (!error_) // else an error that the frame could bear, or the first reason, stays
            error_ = info;
        const Failure result{!failed_.exchange(true), isBeforeVote()};
        if (result.inTime)
            state_ = FrameState::Failed;
        return result;
    }
    // Notes that something was lost, but the frame goes on. Returns whether this rank's vote will say so: not if it has
    // voted already.
    bool note(const ErrorInfo& info)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (!error_)
            error_ = info;
        return isBeforeVote();
    }

    // Returns true, once, if this rank is to vote now. It votes when its inputs are closed and `isDone()` is true, or
    // when the frame has failed and nobody reads inputs in place any more. In both cases `may()` must be true.
    template <class IsDone, class May>
    bool vote(const IsDone& isDone, const May& may)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        const bool isReading = hasInPlace_ && readers_ > 0;
        const bool isReady = state_ == FrameState::Failed ? !isReading : state_ == FrameState::Finishing && isDone();
        if (!isReady || !may())
            return false;
        state_ = FrameState::Voted;
        return true;
    }

    // Called when the verdict of all ranks is here.
    void decide()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (state_ == FrameState::Voted)
            state_ = FrameState::Decided;
    }

    // Lets no thread enter any more, and waits until all have left. `help()` runs work that they may be waiting for,
    // and returns false if there is none.
    template <class Help>
    void close(const Help& help)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        state_ = FrameState::Closed;
        while (inside_ > 0) {
            lock.unlock();
            const bool did = help();
            lock.lock();
            if (!did)
                empty_.wait_for(lock, std::chrono::milliseconds(2), [this] { return inside_ == 0; });
        }
    }

    // ---- how it goes

    // Whether the frame has failed on some rank, as far as this one knows. After close(): whether the last frame had
    // failed.
    bool failed() const noexcept { return failed_.load(std::memory_order_relaxed); }
    // Whether a message was damaged, here or where the frame failed first. It may be one that the verdict needs.
    bool isDamaged() const noexcept { return damaged_; }
    // The first error that this rank knows of, also if the frame goes on in spite of it.
    std::optional<ErrorInfo> reason() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return error_;
    }

    // ---- the tiles of this rank

    // `count` more tiles are to be finished.
    void expectTiles(std::int64_t count)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        tilesLeft_ += count;
    }
    // One tile has been finished. Returns whether it was the last of all.
    bool tileFinished()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        --tilesLeft_;
        return finishesTiles();
    }
    // No more tiles will be expected. Returns whether none is left.
    bool expectNoMore()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        areTilesKnown_ = true;
        return finishesTiles();
    }
    bool areTilesKnown() const noexcept { return areTilesKnown_; }
    bool areTilesFinished() const noexcept { return areTilesFinished_; }
    // Call it before vote(), when the work that follows the last finished tile is done.
    void setTilesFinished() noexcept { areTilesFinished_ = true; }

    // ---- entering and leaving

    enum class Entry : std::uint8_t {
        Inside, // the message may be worked on now; leave() must follow
        Kept,   // it belongs to the next frame
        Late,   // it is of no use any more; counted if it has pixels
        Absurd  // no rank can be so far ahead: a frame ends only when all ranks have begun it
    };

    Entry enter(int source, const MessageHeader& header, Buffer& message)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (header.number > next())
            return Entry::Absurd;
        if (header.number > number_) {
            early_.push_back({source, header, std::move(message)});
            return Entry::Kept;
        }
        if (header.number < number_ || state_ == FrameState::Closed) {
            // A late control message is no sign of anything.
            late_ += header.kind == MessageKind::Fragment || header.kind == MessageKind::FinishedTiles;
            return Entry::Late;
        }
        ++inside_;
        return Entry::Inside;
    }

    void leave()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (--inside_ == 0)
            empty_.notify_all();
    }

    struct Leave {
        void operator()(OpenFrame* frame) const { frame->leave(); }
    };
    // One entry, which ends when this is destroyed. Null: none.
    using Inside = std::unique_ptr<OpenFrame, Leave>;

    // Whether no thread is inside.
    bool isIdle() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return inside_ == 0;
    }

    // Enters for work that is not a message. Null: frame `number` is not open, so the work must not go on.
    Inside enter(std::int64_t number)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        const bool isOpen = number == number_ && state_ != FrameState::Closed;
        inside_ += isOpen;
        return Inside(isOpen ? this : nullptr);
    }

    // Enters once more from inside, for work that goes on after the caller has left. close() waits for that work, too,
    // even if it is waiting already.
    Inside enterAgain()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        ++inside_;
        return Inside(this);
    }

    // Inputs that are read in place lie in memory that their renderers use again after the frame. So once the frame has
    // an input that `isInPlace`, this rank does not vote while a task reads inputs. Returns false if the frame has
    // failed: inputs must then not be read. Otherwise endReading() must follow.
    bool beginReading(bool isInPlace = false)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        hasInPlace_ = hasInPlace_ || isInPlace;
        readers_ += !failed_;
        return !failed_;
    }
    // Returns whether vote() has to be tried, because the frame has failed meanwhile.
    bool endReading()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return --readers_ == 0 && failed_;
    }

    void countLate() noexcept { ++late_; }
    std::int64_t takeLateCount() noexcept { return late_.exchange(0); }

private:
    // Call this and the next one under mutex_.
    bool isBeforeVote() const noexcept
    {
        return state_ == FrameState::Rendering || state_ == FrameState::Finishing || state_ == FrameState::Failed;
    }
    bool finishesTiles() const noexcept { return areTilesKnown_ && tilesLeft_ == 0; }

    mutable std::mutex mutex_;
    std::condition_variable empty_;
    std::atomic<FrameState> state_{FrameState::Closed};
    std::atomic<std::int64_t> number_, late_{0};
    std::int64_t step_;
    std::atomic<bool> failed_{false}, damaged_{false};
    std::atomic<bool> areTilesKnown_{false}, areTilesFinished_{false};
    // Under mutex_:
    std::optional<ErrorInfo> error_;
    std::int64_t tilesLeft_ = 0;
    int inside_ = 0, readers_ = 0;
    bool hasInPlace_ = false;
    std::vector<Arrival> early_, opened_; // for the next frame; for the one that is open
};

} // namespace detail
DFB_NAMESPACE_END
