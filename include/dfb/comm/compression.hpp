// Codec: the contract of a lossless compressor for message payloads; and which messages are compressed.
#pragma once

#include <dfb/version.hpp>

#include <algorithm>
#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// A lossless compressor for message payloads. A payload that does not get smaller travels as it is. Stateless: all
// members are called from several threads at once. An exception makes the frame fail on all ranks.
class Codec {
public:
    virtual ~Codec() = default;

    // The codec's number in messages, not 0; that of SnappyCodec is 1. A number must mean one format on all ranks.
    virtual std::uint8_t id() const noexcept = 0;
    // The most that compress() writes for `byteCount` bytes.
    virtual std::size_t bound(std::size_t byteCount) const = 0;
    // Returns the number of bytes written.
    virtual std::size_t compress(const std::byte* in, std::size_t byteCount, std::byte* out) const = 0;
    // False if `in` does not decompress to exactly `rawByteCount` bytes; never writes more than that.
    virtual bool decompress(const std::byte* in, std::size_t byteCount, std::byte* out,
                            std::size_t rawByteCount) const = 0;
};

// When messages are compressed, if there is a codec.
enum class CompressionMode : std::uint8_t {
    Always, // every message with pixels for another rank, also within a node
    // Only between nodes, and only if frames are faster with it. All ranks measure a few frames with and a few without,
    // take the faster way, and now and then try the other again. Each rank leaves out the ranks for which its messages
    // do not become smaller.
    Auto
};

namespace detail {

// CompressionTrial: measures whether compression makes frames faster. No formula could tell: it depends on the network,
// the codec and the cores.
//
// Ranks that get the same times make the same choice. At first, frames with and without compression take turns. Then
// the faster way is used. The other is tried again more and more seldom, and also after some frames in a row that are
// much slower or faster than usual. Each such trial doubles their number, as times that vary need no trial. If it seems
// faster by a tenth, both take turns again.
class CompressionTrial {
public:
    // Whether the next frame is to be compressed.
    bool compresses() const noexcept { return mode_; }

    // The frame with compresses() took this `time`, in any unit. Not to be called for frames that have failed.
    void took(double time)
    {
        switch (phase_) {
        case Phase::Turns:
            if (frames_ >= 0)
                times_[mode_].push_back(time);
            mode_ = !mode_;
            if (++frames_ == 2 * turns)
                settle(median(times_[1]) < 0.95 * median(times_[0]), firstInterval);
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
    enum class Phase { Turns, Settled, Probe };
    static constexpr int turns = 4, probes = 2, firstInterval = 32, longestInterval = 512; // in frames
    static constexpr std::size_t remembered = 7, surprise = 3, longestPatience = 24;

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
        strange_ = 0;
    }

    void settle(bool mode, int interval)
    {
        usual_ = median(times_[mode]);
        mode_ = mode;
        interval_ = interval;
        begin(Phase::Settled);
    }

    void settled(double time)
    {
        std::vector<double>& mine = times_[mode_];
        mine.push_back(time);
        if (mine.size() > remembered)
            mine.erase(mine.begin());
        strange_ = time > 1.5 * usual_ || time < usual_ / 1.5 ? strange_ + 1 : 0;
        const bool isStrange = strange_ >= patience_;
        if (++frames_ < interval_ && !isStrange)
            return;
        if (isStrange)
            patience_ = std::min(2 * patience_, longestPatience);
        mine.erase(mine.begin(), mine.end() - static_cast<std::ptrdiff_t>(std::min(mine.size(), surprise)));
        mode_ = !mode_;
        times_[mode_].clear();
        begin(Phase::Probe);
    }

    void probed()
    {
        if (median(times_[mode_]) < 0.9 * median(times_[!mode_])) { // or so it seems: compare again
            times_ = {};
            patience_ = surprise;
            begin(Phase::Turns);
        } else {
            settle(!mode_, std::min(2 * interval_, longestInterval));
        }
    }

    Phase phase_ = Phase::Turns;
    bool mode_ = false;
    int frames_ = -2; // in this phase; below 0: the first frames of all, whose times do not count
    int interval_ = firstInterval;
    std::size_t patience_ = surprise;          // how many strange frames, one after the other, call for a trial
    std::size_t strange_ = 0;                  // frames, one after the other, that took an unusual time
    double usual_ = 0;                         // the median time when it was last found out
    std::array<std::vector<double>, 2> times_; // without, with
};

// Compression: which messages of a rank are compressed in a frame. The pixels for one rank can be noise, those for
// another all equal. A receiver whose messages hardly get smaller is left out for some frames, and then tried again,
// more and more seldom. sent() and codecFor() may be called from any thread, endFrame() between frames.
class Compression {
public:
    // `codec` may be null: then no message is compressed.
    Compression(std::shared_ptr<const Codec> codec, CompressionMode mode, int rankCount)
        : codec_(std::move(codec)), mode_(mode), peers_(codec_ ? static_cast<std::size_t>(rankCount) : 0)
    {
    }

    // Whether messages of this frame may be compressed.
    bool isOn() const { return codec_ && (mode_ == CompressionMode::Always || trial_.compresses()); }

    // Whether messages to that rank are worth compressing in this frame. There must be a codec.
    bool isWorthwhile(int other) const { return peers_[static_cast<std::size_t>(other)].pause == 0; }

    // Returns the codec for messages with pixels to another rank in this frame, or null for none. `isNear`: that rank
    // sees this one's memory.
    const Codec* codecFor(int other, bool isNear) const
    {
        const bool isLeftOut = !isOn() || (mode_ == CompressionMode::Auto && (isNear || !isWorthwhile(other)));
        return isLeftOut ? nullptr : codec_.get();
    }

    // A message to that rank had `raw` bytes before the codec, and `sent` after it.
    void sent(int other, std::size_t raw, std::size_t sent)
    {
        Peer& peer = peers_[static_cast<std::size_t>(other)];
        peer.raw += static_cast<std::int64_t>(raw);
        peer.sent += static_cast<std::int64_t>(sent);
    }

    // The number of ranks for which something was compressed in this frame.
    std::int64_t links() const
    {
        return std::count_if(peers_.begin(), peers_.end(), [](const Peer& peer) { return peer.sent < peer.raw; });
    }

    // Notes that the frame has not failed, and took this `time` on the slowest rank.
    void endFrame(double time)
    {
        if (codec_)
            trial_.took(time);
        for (Peer& peer : peers_) {
            const auto raw = static_cast<double>(peer.raw.exchange(0)),
                       sent = static_cast<double>(peer.sent.exchange(0));
            if (peer.pause > 0) {
                --peer.pause;
            } else if (raw > 0 && sent > (peer.interval > firstInterval ? better : worse) * raw) {
                peer.pause = peer.interval;
                peer.interval = std::min(2 * peer.interval, longestInterval);
            } else if (raw > 0) {
                peer.interval = firstInterval;
            }
        }
    }

private:
    // Of compressed to raw bytes: above `worse` compression stops, and only below `better` it starts again.
    static constexpr double worse = 0.95, better = 0.9;
    static constexpr int firstInterval = 16, longestInterval = 64; // in frames: a trial costs little

    struct Peer {
        std::atomic<std::int64_t> raw{0}, sent{0};
        int pause = 0, interval = firstInterval;
    };

    std::shared_ptr<const Codec> codec_;
    CompressionMode mode_;
    CompressionTrial trial_;
    std::vector<Peer> peers_;
};

} // namespace detail
DFB_NAMESPACE_END
