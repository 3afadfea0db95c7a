// PhaseClock: where a rank's time goes. Each moment counts for one phase.
#pragma once

#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>

namespace example {

enum class Phase { Load, Render, Compositing, Write };

class PhaseClock {
public:
    using Clock = std::chrono::steady_clock;

    // Begins with loading.
    PhaseClock() : begin_(Clock::now()), since_(begin_) {}

    // From now on time counts for `phase`. Returns how long the phase before has lasted, in ns.
    std::int64_t enter(Phase phase)
    {
        const Clock::time_point now = Clock::now();
        const std::int64_t lasted = nanoseconds(now - since_);
        ns_[static_cast<std::size_t>(phase_)] += lasted;
        since_ = now;
        phase_ = phase;
        return lasted;
    }

    // Of a phase, without what has passed since the last enter().
    std::int64_t ns(Phase phase) const { return ns_[static_cast<std::size_t>(phase)]; }
    // By the clock, from the beginning to now.
    std::int64_t totalNs() const { return nanoseconds(Clock::now() - begin_); }

private:
    static std::int64_t nanoseconds(Clock::duration time)
    {
        return std::chrono::duration_cast<std::chrono::nanoseconds>(time).count();
    }

    Clock::time_point begin_, since_;
    Phase phase_ = Phase::Load;
    std::array<std::int64_t, 4> ns_{};
};

} // namespace example
