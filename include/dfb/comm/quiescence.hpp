// Quiescence: finds out whether anything is still under way among ranks that all wait. If not, they would wait for
// ever.
//
// The ranks do this together, in rounds. In each round a rank reports once, when it rests, how many messages it has
// sent and how many it has taken. Only messages that make their receiver do something count. A rank that has something
// to do reports later, and the others wait for its report. Suppose that two consecutive rounds have the same sums, and
// that as many messages were taken as sent. Then no rank has sent or taken anything in between, and nothing was on the
// way at the end of the first round: so nothing ever will be (Mattern, "Algorithms for distributed termination
// detection", 1987). One round is no proof: a rank that has reported may send a message to one that has not, which
// takes it before it reports.
#pragma once

#include <dfb/version.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <optional>

DFB_NAMESPACE_BEGIN
namespace detail {

// Each rank has one. All members but newFrame() may be called from any thread. Each round is entered and then ended.
class Quiescence {
public:
    // The counts of one rank, or the sums of several.
    struct Report {
        std::uint64_t sent = 0, taken = 0; // messages between ranks that make their receiver do something
        std::uint64_t unfinished = 0;      // ranks that wait for more than the others to be done
    };
    static Report sum(const Report& a, const Report& b) noexcept
    {
        return {a.sent + b.sent, a.taken + b.taken, a.unfinished + b.unfinished};
    }

    // `first`: how long a rank waits before the first round; see interval().
    explicit Quiescence(std::chrono::milliseconds first) : first_(std::max(first, std::chrono::milliseconds(1))) {}

    void newFrame()
    {
        rounds_ = 0;
        last_.reset();
        isInRound_ = false;
    }

    // How long to wait until the next look. It grows with the number of rounds.
    std::chrono::milliseconds interval() const noexcept
    {
        return first_ * (std::int64_t{1} << std::clamp(rounds_ - 1, 0, 4));
    }

    // Begins a round. Returns false if this rank is in one already.
    bool tryEnter() noexcept { return !isInRound_.exchange(true); }

    // `all`: the sums of the round that this rank has entered. Returns true if they prove that nothing is under way
    // although some rank waits for more. The result of a round is the same on all ranks.
    bool endRound(const Report& all)
    {
        const bool isQuiet = last_ && all.sent == all.taken && last_->sent == all.sent && last_->taken == all.taken
                             && all.unfinished > 0;
        last_ = all;
        ++rounds_;
        isInRound_ = false; // last: after this the next round may be entered
        return isQuiet;
    }

private:
    const std::chrono::milliseconds first_;
    std::atomic<int> rounds_{0};
    std::optional<Report> last_; // of the last round
    std::atomic<bool> isInRound_{false};
};

} // namespace detail
DFB_NAMESPACE_END
