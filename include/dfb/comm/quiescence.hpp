// Quiescence: whether anything is still under way among ranks that all wait. If not, they would wait for ever.
//
// They look together, in rounds. In each a rank says once, at a moment at which it rests, how many messages it has sent
// and how many it has taken that make a rank go on. A rank that has something to do lets the others wait with that. If
// two rounds, one after the other, have the same sums, and as many messages were taken as sent, then nobody has sent or
// taken anything in between, and nothing was on the way at the end of the first: so nothing ever will be (Mattern,
// "Algorithms for distributed termination detection", 1987). One round is no proof: a message may be taken by a rank
// that has not been asked yet from one that sent it after it had been.
#pragma once

#include <dfb/version.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <optional>

DFB_NAMESPACE_BEGIN
namespace detail {

// One per rank. newFrame() apart, members may be called from any thread; each round is entered and then ended.
class Quiescence {
public:
    // The counts of one rank, or the sums of several.
    struct Report {
        std::uint64_t sent = 0, taken = 0; // messages between ranks that make the one that takes them do something
        std::uint64_t unfinished = 0;      // ranks that wait for more than the others' word that all are done
    };
    static Report sum(const Report& a, const Report& b) noexcept
    {
        return {a.sent + b.sent, a.taken + b.taken, a.unfinished + b.unfinished};
    }

    // `first`: so long a rank waits before the first round; see interval().
    void newFrame(std::chrono::milliseconds first)
    {
        first_ = std::max(first, std::chrono::milliseconds(1));
        rounds_ = 0;
        last_.reset();
        isInRound_ = false;
    }

    // So long to wait until the next look: the longer the more rounds there were.
    std::chrono::milliseconds interval() const noexcept
    {
        return first_ * (std::int64_t{1} << std::clamp(rounds_ - 1, 0, 4));
    }

    // Begins a round, for a rank that is in none. Returns false if it is in one.
    bool tryEnter() noexcept { return !isInRound_.exchange(true); }

    // `all`: of the round that this rank has entered. True if it is proven that nothing is under way and that some rank
    // waits for more: on all ranks in the same round.
    bool endRound(const Report& all)
    {
        const bool isQuiet = last_ && all.sent == all.taken && last_->sent == all.sent && last_->taken == all.taken
                             && all.unfinished > 0;
        last_ = all;
        ++rounds_;
        isInRound_ = false; // last: then the next may be entered
        return isQuiet;
    }

private:
    std::chrono::milliseconds first_{1};
    std::atomic<int> rounds_{0};
    std::optional<Report> last_; // of the last round
    std::atomic<bool> isInRound_{false};
};

} // namespace detail
DFB_NAMESPACE_END
