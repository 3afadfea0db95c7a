// Heartbeat: which ranks this one listens for, when to ask them for a sign of life, and which of them is lost. It only
// says so: the connection sends and receives.
//
// Needed as MPI tells nobody that a rank has ended or hangs: a receive from it just never completes.
#pragma once

#include <dfb/version.hpp>

#include <chrono>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// Minutes, as a rank may be held for a while and then go on: stopped by a batch system, by swapping, in a debugger. How
// long it renders does not matter, since its progress thread answers meanwhile.
inline constexpr std::chrono::milliseconds defaultPeerTimeout{300000};

namespace detail {

// 24 days. Clocks count nanoseconds, so that times of centuries overflow.
inline constexpr std::chrono::milliseconds longestTimeout{std::numeric_limits<std::int32_t>::max()};

class Heartbeat {
public:
    using Time = std::chrono::steady_clock::time_point;
    using Duration = Time::duration;

    // `neighbours`: the ranks that this one listens for, and they for it: those in the tree of reductions, whose
    // messages they get in each frame anyway. Each rank has one at least and no more than log2 of their number, and
    // whichever ranks are lost, one of them has a neighbour that is not. `timeout` 0: it listens for nobody.
    Heartbeat(const std::vector<int>& neighbours, std::chrono::milliseconds timeout) : timeout_(timeout)
    {
        for (const int rank : neighbours)
            if (timeout.count() > 0)
                peers_.push_back(Peer{rank});
    }

    bool isOn() const noexcept { return !peers_.empty(); }

    // Without a message for so long, a rank is asked; and it must answer sooner than that.
    Duration patience() const noexcept { return timeout_ / 4; }
    // How often to call due().
    Duration interval() const noexcept { return timeout_ / 32; }

    // A message has come from that rank. `promises`: it says by it that it answers at any time; before that nobody
    // counts on it.
    void heard(int rank, bool promises)
    {
        for (Peer& peer : peers_)
            if (peer.rank == rank) {
                peer.heard = true;
                peer.promises = peer.promises || promises;
                return;
            }
    }

    struct Due {
        std::vector<int> ask;
        int lost = -1; // nothing has been heard of this rank for the whole time-out
    };

    // Returns the messages that are due, for a rank that has polled since the last call. Time counts only while the
    // rank is `expecting` messages. It does not count after a long time without a call: this rank was then held up
    // itself, and messages of the others may still wait to be received.
    Due due(Time now, bool expecting)
    {
        const bool wasHere = isExpecting_ && now - last_ <= patience();
        isExpecting_ = expecting;
        last_ = now;
        Due result;
        for (Peer& peer : peers_) {
            const bool heard = std::exchange(peer.heard, false);
            if (!expecting || !wasHere || heard) {
                peer.since = peer.asked = now;
            } else if (peer.promises && now - peer.since >= timeout_) {
                result.lost = peer.rank;
            } else if (peer.promises && now - peer.asked >= patience()) {
                peer.asked = now;
                result.ask.push_back(peer.rank);
            }
        }
        return result;
    }

private:
    struct Peer {
        int rank;
        bool heard = false, promises = false;
        Time since{}, asked{}; // nothing was heard since; or asked last
    };

    Duration timeout_;
    std::vector<Peer> peers_;
    bool isExpecting_ = false;
    Time last_{};
};

} // namespace detail

DFB_NAMESPACE_END
