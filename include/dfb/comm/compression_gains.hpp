// CompressionGains: for which ranks the messages of this one become smaller by being compressed. What goes to one can
// be noise, and to another all alike.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace dfb::detail {

// A rank for which nearly nothing was gained is left alone for some frames and then tried again, more and more seldom.
// add() may be called from any thread, the others between frames, as is isWorthwhile() during one.
class CompressionGains {
public:
    explicit CompressionGains(int rankCount) : peers_(static_cast<std::size_t>(rankCount)) {}

    bool isWorthwhile(int rank) const { return peers_[static_cast<std::size_t>(rank)].pause == 0; }

    // A message to that rank had `raw` bytes, and has `sent` after the codec had a go at it.
    void add(int rank, std::size_t raw, std::size_t sent)
    {
        Peer& peer = peers_[static_cast<std::size_t>(rank)];
        peer.raw += static_cast<std::int64_t>(raw);
        peer.sent += static_cast<std::int64_t>(sent);
    }

    // For how many ranks something was compressed since the last endFrame().
    std::int64_t links() const
    {
        return std::count_if(peers_.begin(), peers_.end(), [](const Peer& peer) { return peer.sent < peer.raw; });
    }

    void endFrame()
    {
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
    // What must be left over to give up, and what to come back.
    static constexpr double worse = 0.95, better = 0.9;
    static constexpr int firstInterval = 16, longestInterval = 512;

    struct Peer {
        std::atomic<std::int64_t> raw{0}, sent{0};
        int pause = 0, interval = firstInterval; // in frames
        Peer() = default;
        Peer(const Peer&) {} // for the vector, which never copies a used one
    };
    std::vector<Peer> peers_;
};

} // namespace dfb::detail
