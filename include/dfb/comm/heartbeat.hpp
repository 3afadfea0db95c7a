// Heartbeat: decides which ranks this one listens for, when to ask them for a sign of life, and which of them is lost.
// The connection sends and receives the messages for it.
//
// It is needed because MPI does not report that a rank has ended or hangs: a receive from it never completes.
#pragma once

#include <dfb/version.hpp>

#include <chrono>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// Some minutes, as a batch system, swapping or a debugger may hold up a rank for a while. How long it renders does not
// matter, since its progress thread answers meanwhile.
inline constexpr std::chrono::milliseconds defaultPeerTimeout{300000};

namespace detail {

// 24 days. Clocks count nanoseconds, so times of centuries would overflow.
inline constexpr std::chrono::milliseconds longestTimeout{std::numeric_limits<std::int32_t>::max()};

class Heartbeat {
public:
    using Time = std::chrono::steady_clock::time_point;
    using Duration = Time::duration;

    // `neighbours`: the ranks that this one listens for, as they do for it. They are its neighbours in the tree of
    // reductions, whose messages it gets in each frame anyway. Of P > 1 ranks each has 1 to log2(P) neighbours, rounded
    // up. Whichever ranks are lost, one of them has a neighbour that is not. `timeout` 0: this rank listens for none.
    Heartbeat(const std::vector<int>& neighbours, std::chrono::milliseconds timeout) : timeout_(timeout)
    {
        for (const int rank : neighbours)
            if (timeout.count() > 0)
                peers_.push_back(Peer{rank});
    }

    bool isOn() const noexcept { return !peers_.empty(); }

    // A rank that has sent nothing for this long is asked. It must answer in the rest of the time-out.
    Duration patience() const noexcept { return timeout_ / 4; }
    // Whether it is time to call due().
    bool isDue(Time now) const { return now - last_ >= timeout_ / 32; }

    // A message has come from that rank. `promises`: by this message the rank says that it answers at any time. Until
    // it has said so, it is neither asked nor counted as lost.
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

    // Returns the ranks to ask, and the one that is lost. This rank must have polled since the last call. Time counts
    // only while this rank is `expecting` messages. It does not count if the last call was long ago: this rank was then
    // held up itself, and messages of the others may still wait.
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
        Time since{}, asked{}; // since when nothing was heard; when it was last asked
    };

    Duration timeout_;
    std::vector<Peer> peers_;
    bool isExpecting_ = false;
    Time last_{};
};

} // namespace detail

DFB_NAMESPACE_END
