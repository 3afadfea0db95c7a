// CompressionTrial: whether a framebuffer's messages are worth compressing, found out by trying: what a network, a
// codec and the cores beside them do together no formula knows.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <vector>

namespace dfb::detail {

// Ranks that are told the same times choose the same. To begin with, frames with and without take turns. Then those of
// the better kind are made, and of the other one a few now and then, more and more seldom, and when frames have become
// much slower or faster. Only who was better by a tenth replaces the other.
class CompressionTrial {
public:
    // Whether the next frame is to be compressed.
    bool compresses() const noexcept { return mode_; }

    // Whether that is more than a trial.
    bool isChosen() const noexcept { return phase_ == Phase::Settled; }

    // The frame with compresses() has taken so long, in any unit. Not to be told of frames that have failed.
    void took(double time)
    {
        switch (phase_) {
        case Phase::WarmUp:
            mode_ = !mode_;
            if (++frames_ == 2)
                begin(Phase::Turns);
            break;
        case Phase::Turns:
            times_[mode_].push_back(time);
            mode_ = !mode_;
            if (++frames_ == 2 * turns)
                settle(median(times_[1]) < 0.95 * median(times_[0]));
            break;
        case Phase::Settled: settled(time); break;
        case Phase::Probe:
            times_[mode_].push_back(time);
            if (++frames_ == probes)
                probed();
            break;
        }
    }

private:
    enum class Phase { WarmUp, Turns, Settled, Probe };
    static constexpr std::size_t turns = 4, probes = 2, remembered = 7, surprise = 3;
    static constexpr std::size_t firstInterval = 32, longestInterval = 512;

    static double median(std::vector<double> times)
    {
        const auto middle = times.begin() + static_cast<std::ptrdiff_t>(times.size() / 2);
        std::nth_element(times.begin(), middle, times.end());
        return *middle;
    }

    void begin(Phase phase)
    {
        phase_ = phase;
        frames_ = 0;
    }

    void settle(bool mode)
    {
        mode_ = mode;
        usual_ = median(times_[mode]);
        interval_ = firstInterval;
        strange_ = 0;
        begin(Phase::Settled);
    }

    void settled(double time)
    {
        std::vector<double>& mine = times_[mode_];
        mine.push_back(time);
        if (mine.size() > remembered)
            mine.erase(mine.begin());
        strange_ = time > 1.5 * usual_ || time < usual_ / 1.5 ? strange_ + 1 : 0;
        if (++frames_ < interval_ && strange_ < surprise)
            return;
        mine.erase(mine.begin(), mine.end() - static_cast<std::ptrdiff_t>(std::min(mine.size(), surprise)));
        strange_ = 0;
        mode_ = !mode_;
        times_[mode_].clear();
        begin(Phase::Probe);
    }

    void probed()
    {
        const double other = median(times_[mode_]), mine = median(times_[!mode_]);
        if (other < 0.9 * mine) { // or so it seems
            times_ = {};
            begin(Phase::Turns);
            return;
        }
        mode_ = !mode_;
        usual_ = mine;
        interval_ = std::min(2 * interval_, longestInterval);
        begin(Phase::Settled);
    }

    Phase phase_ = Phase::WarmUp;
    bool mode_ = false;
    std::size_t frames_ = 0, interval_ = firstInterval, strange_ = 0; // frames in this phase
    double usual_ = 0;                                                // when it was last looked at
    std::array<std::vector<double>, 2> times_;                        // without, with
};

} // namespace dfb::detail
