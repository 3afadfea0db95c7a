// FrameGate: which messages belong to the frame that is open. Those of a frame to come are kept, those of a
// frame that is over are counted and dropped, and closing waits for what is being worked on.
#pragma once

#include <dfb/comm/message.hpp>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <utility>
#include <vector>

namespace dfb::detail {

// All members may be called from any thread.
class FrameGate {
public:
    struct Message {
        int source;
        MessageHeader header;
        Buffer bytes;
    };

    // Frames are numbered from `first`, every `step`.
    explicit FrameGate(std::int64_t first = 1, std::int64_t step = 1) : frame_(first - step), step_(step)
    {
        for (std::vector<Message>* messages : {&early_, &opened_})
            messages->reserve(256); // how many come early depends on time: mostly no more
    }

    // The last frame that was opened; not positive before the first. And the one that comes next.
    std::int64_t frame() const noexcept { return frame_; }
    std::int64_t next() const noexcept { return frame_ + step_; }
    void countLate() noexcept { ++late_; }
    std::int64_t takeLateCount() noexcept { return late_.exchange(0); }

    // Opens the next frame and returns the messages that came too early for it, to be taken before the next open().
    std::vector<Message>& open()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        frame_ += step_;
        open_ = true;
        opened_.clear();
        opened_.swap(early_);
        return opened_;
    }

    enum class Entry {
        Inside, // it may be worked on now; leave() must follow
        Kept,   // it belongs to the frame to come
        Late,   // it is of no use any more, and has been counted
        Absurd  // no rank can be so far ahead: a frame ends only when all ranks have begun it
    };

    Entry enter(int source, const MessageHeader& header, Buffer& message)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (header.number > next())
            return Entry::Absurd;
        if (header.number > frame_) {
            early_.push_back({source, header, std::move(message)});
            return Entry::Kept;
        }
        if (header.number < frame_ || !open_) {
            // Of control messages a late one is no sign of anything.
            late_ += header.kind == MessageKind::Fragment || header.kind == MessageKind::FinishedTiles;
            return Entry::Late;
        }
        ++inside_;
        return Entry::Inside;
    }

    // The same for work that is no message: whether it may go on.
    bool enter(std::int64_t frame)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (frame != frame_ || !open_)
            return false;
        ++inside_;
        return true;
    }

    // The same for work of whichever frame is open.
    bool enterAny()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        inside_ += open_;
        return open_;
    }

    // Once more, by somebody who is inside, for work that will go on after he has left: also while the gate closes,
    // which then waits for that, too.
    void enterAgain()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        ++inside_;
    }

    void leave()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (--inside_ == 0)
            empty_.notify_all();
    }

    // Lets nothing more in, and waits until all have left. `help()` runs what some of them may be waiting for, and is
    // false if there is nothing.
    template <class Help>
    void close(const Help& help)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        open_ = false;
        while (inside_ > 0) {
            lock.unlock();
            const bool did = help();
            lock.lock();
            if (!did)
                empty_.wait_for(lock, std::chrono::milliseconds(2), [this] { return inside_ == 0; });
        }
    }

private:
    std::mutex mutex_;
    std::condition_variable empty_;
    std::atomic<std::int64_t> frame_, late_{0};
    std::int64_t step_;
    bool open_ = false;
    int inside_ = 0;
    std::vector<Message> early_, opened_; // for the next frame; for the one that is open
};

} // namespace dfb::detail
