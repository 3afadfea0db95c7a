// FlowControl: limits how many bytes a rank may send to another one before the receiver has room again. The limit is
// called credit, and comes from one pool per receiver.
//
// Half of a pool is divided among the senders, who use their parts without asking. A sender that needs more asks for it
// (CreditRequest) and gets it from the other half. Credit is granted in the order of asking, and for whole messages: so
// all of it is used and comes back. A credit returns when the receiver has taken the message out of its inbox. Thus the
// messages on the way to a rank and in its inbox never exceed its pool, however many senders there are. Counts are
// running totals within an epoch (a frame): a Credit may overtake another, and a lost one has no effect after its
// epoch.
#pragma once

#include <dfb/base/fifo.hpp>
#include <dfb/comm/message.hpp>

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <mutex>
#include <string>
#include <unordered_map>
#include <utility>

DFB_NAMESPACE_BEGIN
namespace detail {

// All members may be called from any thread. The callbacks are called without a lock held.
class FlowControl {
public:
    // The bodies of CreditRequest and Credit messages.
    struct Request {
        std::uint64_t first = 0; // the total that is needed for the first message that waits
        std::uint64_t all = 0;   // the total for as many as should come at once
    };
    struct Credit {
        std::uint64_t granted = 0;  // the total that may be sent
        std::uint64_t consumed = 0; // the total that has left the inbox
    };

    struct Callbacks {
        std::function<void(int destination, Buffer&& message)> transmit;
        std::function<void(int destination, const Request&)> request;
        std::function<void(int source, const Credit&)> credit;
    };

    // `poolBytes` is the same on all ranks, and at least 4 times the largest message.
    FlowControl(int rankCount, std::size_t poolBytes, Callbacks callbacks)
        : pool_(poolBytes), allowance_(rankCount > 1 ? poolBytes / 2 / static_cast<std::size_t>(rankCount - 1) : 0),
          free_(poolBytes - allowance_ * static_cast<std::size_t>(rankCount - 1)), callbacks_(std::move(callbacks))
    {
    }

    std::size_t poolBytes() const noexcept { return pool_; }

    // After so many consumed bytes the sender gets a Credit unasked. Bytes that it has not been told of must stay below
    // its part of the pool, as it may wait for them. Also below 4 MiB: a Credit shows that messages are taken.
    static std::uint64_t bytesPerCredit(std::size_t allowance)
    {
        return std::min<std::uint64_t>(allowance / 2, 4 << 20);
    }

    // Forgets everything: all that was sent before has arrived or does not matter any more.
    void newEpoch()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        for (auto& [rank, peer] : peers_) {
            free_ += extraOf(peer.in, peer.in.granted);
            peer.reset(allowance_);
        }
        asking_.clear();
        grants_.clear(); // those that could not be told for lack of memory
        underWay_ = 0;
        peakInboxBytes_ = inboxBytes_; // the next epoch's first messages may be there already
        matters_ = nullptr;
    }

    // From now on only those messages of this epoch are sent for which `matters(message)` is true. Drops the others,
    // those that wait and those that are given to send() later. `keepsAsked`: keeps messages for which credit was
    // asked, because the receiver has set aside room for them that other senders need.
    void drop(std::function<bool(const Buffer&)> matters, bool keepsAsked)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        matters_ = std::move(matters);
        for (auto& [rank, peer] : peers_) {
            Outgoing& out = peer.out;
            std::uint64_t total = out.sent;
            for (std::size_t left = out.queue.size(); left > 0; --left) {
                Buffer message = out.queue.pop();
                total += message.size();
                if ((keepsAsked && total <= out.request.all) || matters_(message))
                    out.queue.push(std::move(message));
                else
                    underWay_ -= message.size();
            }
        }
    }

    // Whether every message that was given to send() has been transmitted or dropped.
    bool allSent() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return transmitting_ == 0
               && std::all_of(peers_.begin(), peers_.end(), [](const auto& p) { return p.second.out.queue.empty(); });
    }

    // ---- the sender's side

    // Transmits the message, or keeps it until there is credit. Never blocks.
    void send(int destination, Buffer&& message)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        if (matters_ && !matters_(message))
            return;
        Outgoing& out = peerOf(destination).out;
        underWay_ += message.size();
        if (out.queue.empty() && out.sent + message.size() <= out.granted)
            return transmit(destination, out, std::move(message), lock);
        out.queue.push(std::move(message));
        ask(destination, out, lock);
    }

    // Bytes that were given to send() and that, as far as is known, no receiver has taken out of its inbox.
    std::size_t underWay() const noexcept { return underWay_; }

    // A text that says which ranks have not taken how many bytes.
    std::string notTaken() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        std::string text;
        for (const auto& [destination, peer] : peers_) {
            std::uint64_t bytes = peer.out.sent - peer.out.consumed;
            for (const Buffer& message : peer.out.queue)
                bytes += message.size();
            if (bytes > 0)
                text += printed("%srank %d has not taken %llu bytes", text.empty() ? "" : ", ", destination,
                                static_cast<unsigned long long>(bytes));
        }
        return text;
    }

    // Takes a Credit of rank `from`. Throws Error (MalformedMessage) if it grants more bytes than a pool has, or says
    // that more were consumed than were sent.
    void credited(int from, const Credit& credit)
    {
        if (credit.granted > credit.consumed && credit.granted - credit.consumed > pool_)
            failMalformed("credit for more than a pool", static_cast<std::int64_t>(pool_),
                          static_cast<std::int64_t>(credit.granted - credit.consumed));
        std::unique_lock<std::mutex> lock(mutex_);
        Outgoing& out = peerOf(from).out;
        if (credit.consumed > out.sent)
            failMalformed("credit for more than was sent", static_cast<std::int64_t>(out.sent),
                          static_cast<std::int64_t>(credit.consumed));
        out.granted = std::max(out.granted, credit.granted);
        if (credit.consumed > out.consumed)
            underWay_ -= credit.consumed - std::exchange(out.consumed, credit.consumed);
        while (!out.queue.empty() && out.sent + out.queue.front().size() <= out.granted) {
            transmit(from, out, out.queue.pop(), lock);
            lock.lock();
        }
        ask(from, out, lock);
    }

    // ---- the receiver's side

    // A message with credit, of whichever epoch, is in the inbox.
    void arrived(std::size_t byteCount)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        inboxBytes_ += byteCount;
        peakInboxBytes_ = std::max(peakInboxBytes_.load(), inboxBytes_);
    }

    // A message that has arrived is of another epoch, and has been thrown away.
    void discarded(std::size_t byteCount)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        inboxBytes_ -= byteCount;
    }

    // A message of this epoch has been taken out of the inbox.
    void consumed(int source, std::size_t byteCount)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        Incoming& in = peerOf(source).in;
        free_ += extraOf(in, in.granted);
        in.consumed += byteCount;
        free_ -= extraOf(in, in.granted);
        inboxBytes_ -= byteCount;
        if (in.consumed - in.told >= bytesPerCredit(allowance_))
            grant(source, in, in.consumed + allowance_);
        serve(lock);
    }

    // Throws Error (MalformedMessage) for a request that could never be met: others would wait behind it. An honest
    // sender has sent no more than it was granted, and asks for one message at least.
    void requested(int source, const Request& request)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        Incoming& in = peerOf(source).in;
        if (request.all < request.first || (request.all > in.granted && request.all - in.granted > pool_))
            failMalformed("a request for more than a pool", static_cast<std::int64_t>(pool_),
                          static_cast<std::int64_t>(request.all - in.granted));
        if (request.first > in.granted && request.first - in.granted > pool_ / 4)
            failMalformed("a request for more than the largest message", static_cast<std::int64_t>(pool_ / 4),
                          static_cast<std::int64_t>(request.first - in.granted));
        if (request.first <= in.granted || (in.asks() && request.first <= in.request.first))
            return; // it has been answered, or a later request has overtaken it
        if (!in.asks())
            asking_.push(source);
        in.request = request;
        serve(lock);
    }

    // The most that was in the inbox at one time in this epoch.
    std::size_t peakInboxBytes() const noexcept { return peakInboxBytes_; }

private:
    struct Outgoing {
        std::uint64_t sent = 0, granted = 0, consumed = 0; // totals
        Request request;                                   // the last
        Fifo<Buffer> queue;

        bool asks() const { return request.first > granted; } // and has no answer yet
    };
    struct Incoming {
        std::uint64_t granted = 0, consumed = 0; // totals
        std::uint64_t told = 0;                  // how much of `consumed` the sender was told
        Request request;

        bool asks() const { return request.first > granted; } // once answered, it will ask again if it wants more
    };

    struct Peer {
        Outgoing out;
        Incoming in;

        explicit Peer(std::uint64_t allowance) { reset(allowance); }
        void reset(std::uint64_t allowance)
        {
            out.queue.clear();
            out.sent = out.consumed = 0;
            out.request = Request();
            in = Incoming();
            out.granted = in.granted = allowance;
        }
    };

    Peer& peerOf(int rank) { return peers_.try_emplace(rank, allowance_).first->second; }

    // Transmits a message, which there is credit for. Releases the lock.
    void transmit(int destination, Outgoing& out, Buffer&& message, std::unique_lock<std::mutex>& lock)
    {
        out.sent += message.size();
        ++transmitting_; // under the lock, so that allSent() always sees the message
        struct End {
            std::atomic<int>& count;
            ~End() { --count; }
        } end{transmitting_};
        lock.unlock();
        callbacks_.transmit(destination, std::move(message));
    }

    // Asks for credit if messages wait and no request is out. Releases the lock.
    void ask(int destination, Outgoing& out, std::unique_lock<std::mutex>& lock)
    {
        if (out.queue.empty() || out.asks())
            return;
        const Request request = requestOf(out);
        lock.unlock();
        callbacks_.request(destination, request);
    }

    // A request for the first message that waits, and for as many of the next as fit in a quarter of the pool with it.
    Request requestOf(Outgoing& out) const
    {
        Request request;
        std::uint64_t total = out.sent;
        for (const Buffer& message : out.queue) {
            if (request.first > 0 && total + message.size() - out.sent > pool_ / 4)
                break;
            total += message.size();
            if (request.first == 0)
                request.first = total;
            request.all = total;
        }
        return out.request = request;
    }

    // The part of `granted` that is beyond the allowance and not consumed.
    std::uint64_t extraOf(const Incoming& in, std::uint64_t granted) const
    {
        const std::uint64_t covered = in.consumed + allowance_;
        return granted > covered ? granted - covered : 0;
    }

    void grant(int source, Incoming& in, std::uint64_t total)
    {
        free_ += extraOf(in, in.granted);
        in.granted = std::max(in.granted, total);
        free_ -= extraOf(in, in.granted);
        in.told = in.consumed;
        grants_.push({source, {in.granted, in.consumed}});
    }

    // Grants credit to the senders that have asked, in that order, as far as the pool reaches; then sends them their
    // Credits.
    void serve(std::unique_lock<std::mutex>& lock)
    {
        while (!asking_.empty()) {
            const int source = asking_.front();
            Incoming& in = peerOf(source).in;
            if (in.asks()) {
                const auto fits = [&](std::uint64_t total) {
                    return extraOf(in, total) <= free_ + extraOf(in, in.granted);
                };
                if (fits(in.request.all))
                    grant(source, in, in.request.all);
                else if (fits(in.request.first))
                    grant(source, in, in.request.first);
                else
                    break;
            }
            asking_.pop();
        }
        while (!grants_.empty()) {
            const auto [source, credit] = grants_.pop();
            lock.unlock();
            callbacks_.credit(source, credit);
            lock.lock();
        }
    }

    const std::size_t pool_, allowance_;
    mutable std::mutex mutex_;
    std::size_t free_; // bytes of the half that is granted on request which are in nobody's extraOf()
    // For each rank, from when it was first met:
    std::unordered_map<int, Peer> peers_;
    std::atomic<int> transmitting_{0}; // messages that are with the callback
    Fifo<int> asking_;
    Fifo<std::pair<int, Credit>> grants_; // not yet sent to their ranks
    std::size_t inboxBytes_ = 0;
    std::atomic<std::size_t> underWay_{0}, peakInboxBytes_{0}; // may be read without it
    std::function<bool(const Buffer&)> matters_;               // null: all messages matter
    Callbacks callbacks_;
};

} // namespace detail
DFB_NAMESPACE_END
