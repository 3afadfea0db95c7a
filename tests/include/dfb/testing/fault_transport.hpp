// FaultTransport: wraps any transport and puts in faults on the sending side. For tests. Messages that are late or out
// of order keep the contract of a transport. Messages that are repeated, lost or damaged break it.
#pragma once

#include <dfb/comm/inproc_transport.hpp>
#include <dfb/comm/transport.hpp>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <functional>
#include <iterator>
#include <limits>
#include <memory>
#include <mutex>
#include <string>
#include <utility>
#include <vector>

namespace dfb::testing {

// Counts of the faults so far, of all transports that share it. Read it at any time.
struct FaultCounts {
    std::atomic<std::int64_t> sent{0}; // calls of send()
    std::atomic<std::int64_t> reordered{0}, delayed{0}, duplicated{0}, dropped{0}, corrupted{0};
};

// The probabilities are per message and independent of each other. A message that is dropped counts as nothing else;
// one that would be delayed and reordered is only delayed.
struct FaultOptions {
    std::uint64_t seed = 0;
    double reorder = 0;   // 1 to 4 later messages to that rank overtake it, if they come within maxDelay
    double delay = 0;     // it is held for up to maxDelay
    double duplicate = 0; // a copy follows within maxDelay
    double drop = 0;
    double corrupt = 0; // 1 to 8 bytes are changed, or the end is missing; an empty message stays as it is
    std::chrono::microseconds maxDelay{2000};
    int maxLethal = std::numeric_limits<int>::max(); // messages that one transport drops or corrupts, at most
    std::function<bool(int destination, const Buffer& message)> only; // if set: which messages to touch. Any thread
    std::shared_ptr<FaultCounts> counts;
};

// The faults of one message.
struct FaultDecision {
    bool reorder = false, delay = false, duplicate = false, drop = false, corrupt = false;
    std::chrono::nanoseconds delayBy{0}, copyDelayBy{0};
    int overtakenBy = 0;
    std::uint64_t random = 0; // decides where the message is corrupted
};

namespace detail {

inline std::uint64_t scramble(std::uint64_t x) noexcept // splitmix64
{
    x += 0x9e3779b97f4a7c15u;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return x ^ (x >> 31);
}

} // namespace detail

// The decision for the message with this running number from `rank` to `destination`: the same at every call, whatever
// threads do. Each probability has its own part of the random sequence, so changing one does not change which messages
// the others affect.
inline FaultDecision decideFault(const FaultOptions& options, int rank, int destination, std::uint64_t number)
{
    std::uint64_t state = options.seed;
    for (const std::uint64_t part : {static_cast<std::uint64_t>(rank), static_cast<std::uint64_t>(destination), number})
        state = detail::scramble(state) ^ part;
    const auto draw = [&state] { return state = detail::scramble(state); };
    const auto fraction = [&draw] { return static_cast<double>(draw() >> 11) * 0x1p-53; }; // in [0, 1)
    const auto upToMaxDelay = [&] {
        const std::chrono::nanoseconds limit = options.maxDelay;
        return std::chrono::nanoseconds(static_cast<std::int64_t>(fraction() * static_cast<double>(limit.count())));
    };
    FaultDecision decision;
    decision.reorder = fraction() < options.reorder;
    decision.delay = fraction() < options.delay;
    decision.duplicate = fraction() < options.duplicate;
    decision.drop = fraction() < options.drop;
    decision.corrupt = fraction() < options.corrupt;
    decision.delayBy = upToMaxDelay();
    decision.copyDelayBy = upToMaxDelay();
    decision.overtakenBy = 1 + static_cast<int>(draw() % 4);
    decision.random = draw();
    return decision;
}

// Keeps the contract of a transport (comm/transport.hpp) as far as Base and the faults do. Needs polling if messages
// are held back, even if Base needs none.
template <class Base>
class FaultTransport {
public:
    struct Communicator {
        typename Base::Communicator communicator;
        FaultOptions faults;
    };

    FaultTransport(const Communicator& communicator, std::shared_ptr<MemoryPool> pool, Progress progress)
        : pool_(pool), base_(communicator.communicator, std::move(pool), progress), options_(communicator.faults),
          counts_(options_.counts ? options_.counts : std::make_shared<FaultCounts>()),
          numbers_(static_cast<std::size_t>(base_.size())), lethalLeft_(options_.maxLethal)
    {
    }

    static bool mayHaveThread(const Communicator& communicator)
    {
        return dfb::detail::resolved<Base>(Progress::Auto, communicator.communicator) == Progress::Thread;
    }

    int rank() const { return base_.rank(); }
    int size() const { return base_.size(); }
    bool needsPolling() const
    {
        return base_.needsPolling() || options_.reorder > 0 || options_.delay > 0 || options_.duplicate > 0;
    }
    bool mayPoll() const { return base_.mayPoll(); }
    void interrupt() { base_.interrupt(); }
    void start(TransportHandler& handler) { base_.start(handler); }

    void send(int destination, Buffer&& message)
    {
        const std::uint64_t number = numbers_[static_cast<std::size_t>(destination)]++;
        ++counts_->sent;
        FaultDecision decision;
        if (!isStopping_ && (!options_.only || options_.only(destination, message)))
            decision = decideFault(options_, rank(), destination, number);
        if (decision.drop && lethalLeft_-- > 0) {
            ++counts_->dropped;
            message = Buffer(); // the caller may keep the moved-from object alive
            return;
        }
        if (decision.corrupt && !message.empty() && lethalLeft_-- > 0) {
            corrupt(message, decision.random);
            ++counts_->corrupted;
        }
        if (decision.duplicate) {
            Buffer copy = pool_->acquire(message.size());
            if (!message.empty())
                std::memcpy(copy.data(), message.data(), message.size());
            hold({destination, std::move(copy), Clock::now() + decision.copyDelayBy, never});
            ++counts_->duplicated;
        }
        if (decision.delay) {
            ++counts_->delayed;
            hold({destination, std::move(message), Clock::now() + decision.delayBy, never});
        } else if (decision.reorder) {
            ++counts_->reordered;
            hold({destination, std::move(message), Clock::now() + options_.maxDelay,
                  number + 1 + static_cast<std::uint64_t>(decision.overtakenBy)});
        } else {
            base_.send(destination, std::move(message));
        }
        if (heldCount_ > 0)
            base_.interrupt(); // poll() releases what this message has overtaken; nap() learns when to wake
    }

    bool poll()
    {
        const bool letGo = heldCount_ > 0 && release(false);
        return base_.poll() || letGo;
    }

    // The order of the two matters: a message that is released reaches base_ before it stops counting as held.
    bool quiet() const { return heldCount_ == 0 && base_.quiet(); }

    void nap(std::chrono::nanoseconds limit)
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            const auto now = Clock::now();
            for (const Held& held : held_)
                limit = std::min<std::chrono::nanoseconds>(limit, std::max(held.due - now, Clock::duration::zero()));
        }
        base_.nap(limit);
    }

    void stop(bool orderly)
    {
        if (orderly) {
            isStopping_ = true; // base_ polls from now on, so nothing that the handler sends may be held back
            release(true);
        }
        base_.stop(orderly);
    }

    // Optional members: this class has them if Base has. Data that goes through shared memory without a message is not
    // harmed.
    template <class B = Base>
    auto abort(const std::string& text) -> decltype(std::declval<B&>().abort(text))
    {
        base_.abort(text);
    }
    template <class B = Base>
    auto sharingRanks() const -> decltype(std::declval<const B&>().sharingRanks())
    {
        return base_.sharingRanks();
    }
    template <class B = Base>
    auto lendsTo(int other) const -> decltype(std::declval<const B&>().lendsTo(other))
    {
        return base_.lendsTo(other);
    }
    template <class B = Base>
    auto placeOf(const std::byte* block) const -> decltype(std::declval<const B&>().placeOf(block))
    {
        return base_.placeOf(block);
    }
    template <class B = Base>
    auto blockAt(int other, std::int32_t place, std::size_t byteCount) const
        -> decltype(std::declval<const B&>().blockAt(other, place, byteCount))
    {
        return base_.blockAt(other, place, byteCount);
    }

private:
    using Clock = std::chrono::steady_clock;
    static constexpr std::uint64_t never = std::numeric_limits<std::uint64_t>::max();

    struct Held {
        int destination;
        Buffer message;
        Clock::time_point due;
        std::uint64_t dueNumber; // also due once so many messages to the destination have been sent
    };

    static void corrupt(Buffer& message, std::uint64_t random)
    {
        const auto draw = [&random](std::size_t bound) { return (random = detail::scramble(random)) % bound; };
        if (draw(4) == 0) {
            message.shrink(draw(message.size()));
            return;
        }
        // The places must differ: a byte that is changed twice could become the old one again.
        std::array<std::size_t, 8> places{};
        const std::size_t wanted = 1 + draw(std::min(places.size(), message.size()));
        for (std::size_t done = 0; done < wanted;) {
            const std::size_t place = draw(message.size());
            const auto end = places.begin() + static_cast<std::ptrdiff_t>(done);
            if (std::find(places.begin(), end, place) != end)
                continue;
            places[done++] = place;
            message.data()[place] ^= static_cast<std::byte>(1 + draw(255));
        }
    }

    void hold(Held&& held)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        ++heldCount_;
        held_.push_back(std::move(held));
    }

    bool release(bool all)
    {
        std::vector<Held> due;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            const auto now = Clock::now();
            const auto first = std::partition(held_.begin(), held_.end(), [&](const Held& held) {
                return !all && held.due > now && held.dueNumber > numbers_[static_cast<std::size_t>(held.destination)];
            });
            std::move(first, held_.end(), std::back_inserter(due));
            held_.erase(first, held_.end());
        }
        for (Held& held : due)
            base_.send(held.destination, std::move(held.message));
        heldCount_ -= due.size();
        return !due.empty();
    }

    std::shared_ptr<MemoryPool> pool_;
    Base base_;
    FaultOptions options_;
    std::shared_ptr<FaultCounts> counts_;
    std::vector<std::atomic<std::uint64_t>> numbers_; // of messages so far, per destination
    std::atomic<std::int64_t> lethalLeft_;            // none if negative

    std::atomic<bool> isStopping_{false};
    std::mutex mutex_;
    std::vector<Held> held_;                // under mutex_
    std::atomic<std::size_t> heldCount_{0}; // how many are in held_ or on their way from it to base_
};

static_assert(is_transport_v<FaultTransport<InprocTransport>>);

} // namespace dfb::testing
