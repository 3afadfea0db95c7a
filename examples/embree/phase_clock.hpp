// PhaseClock: where a rank's time goes. Each moment counts for one phase.
#pragma once

#include <array>
#include <chrono>
#include <cstddef>

namespace example {

enum class Phase { Load, Render, Compositing, Write };

class PhaseClock {
public:
    using Clock = std::chrono::steady_clock;

    // Begins with loading.
    PhaseClock() : begin_(Clock::now()), since_(begin_) {}

    // From now on time counts for `phase`. Returns how long the phase before has lasted, in ms.
    double enter(Phase phase)
    {
        const Clock::time_point now = Clock::now();
        const double lasted = Milliseconds(now - since_).count();
        ms_[static_cast<std::size_t>(phase_)] += lasted;
        since_ = now;
        phase_ = phase;
        return lasted;
    }

    // The time in a phase, in ms, without what has passed since the last enter().
    double ms(Phase phase) const { return ms_[static_cast<std::size_t>(phase)]; }
    // The time of all phases, in ms: from the beginning to the last enter().
    double totalMs() const { return Milliseconds(since_ - begin_).count(); }

private:
    using Milliseconds = std::chrono::duration<double, std::milli>;

    Clock::time_point begin_, since_;
    Phase phase_ = Phase::Load;
    std::array<double, 4> ms_{};
};

} // namespace example
