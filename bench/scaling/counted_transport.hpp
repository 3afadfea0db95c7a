// CountedTransport: ranks as threads of one process; it counts what each of them sends and receives, by kind of
// message. It counts the messages that the library gives to the transport. MpiTransport then puts several messages of
// up to 8 KiB to one rank into one packet; this transport delivers each by itself.
#pragma once

#include <dfb/comm/inproc_transport.hpp>
#include <dfb/comm/message.hpp>

#include <algorithm>
#include <array>
#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <memory>
#include <mutex>
#include <utility>
#include <vector>

namespace bench {

using Kind = dfb::detail::MessageKind;

struct MessageCount {
    std::int64_t messages = 0, bytes = 0;

    void add(std::int64_t byteCount, std::int64_t messageCount = 1)
    {
        messages += messageCount;
        bytes += byteCount;
    }
    MessageCount& operator+=(const MessageCount& o)
    {
        messages += o.messages;
        bytes += o.bytes;
        return *this;
    }
};

// The traffic of one rank. Any thread may call add().
class Traffic {
public:
    void add(Kind kind, std::size_t byteCount)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        counts_.at(static_cast<std::size_t>(kind)).add(static_cast<std::int64_t>(byteCount));
    }
    MessageCount of(std::initializer_list<Kind> kinds) const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        MessageCount sum;
        for (const Kind kind : kinds)
            sum += counts_.at(static_cast<std::size_t>(kind));
        return sum;
    }
    MessageCount all() const
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        MessageCount sum;
        for (const MessageCount& count : counts_)
            sum += count;
        return sum;
    }
    void reset()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        counts_ = {};
    }

private:
    mutable std::mutex mutex_;
    std::array<MessageCount, static_cast<std::size_t>(Kind::End)> counts_{};
};

// Shared by the counted ranks: their traffic, and a place to meet without messages.
class Counters {
public:
    explicit Counters(int ranks) : ranks_(ranks), sent(static_cast<std::size_t>(ranks)), received(sent.size()) {}

    // Waits until all ranks are here.
    void meet()
    {
        std::unique_lock<std::mutex> lock(mutex_);
        const std::int64_t round = rounds_;
        if (++here_ == ranks_) {
            here_ = 0;
            ++rounds_;
            changed_.notify_all();
            return;
        }
        changed_.wait(lock, [&] { return rounds_ != round; });
    }

private:
    int ranks_, here_ = 0;
    std::int64_t rounds_ = 0;
    std::mutex mutex_;
    std::condition_variable changed_;

public:
    std::vector<Traffic> sent, received; // by rank
};

class CountedTransport {
public:
    struct Communicator {
        dfb::InprocCommunicator ranks;
        std::shared_ptr<Counters> counters;
    };

    CountedTransport(const Communicator& communicator, std::shared_ptr<dfb::MemoryPool> pool, dfb::Progress progress)
        : inner_(communicator.ranks, std::move(pool), progress), counters_(communicator.counters)
    {
    }

    int rank() const noexcept { return inner_.rank(); }
    int size() const noexcept { return inner_.size(); }
    bool needsPolling() const noexcept { return inner_.needsPolling(); }
    bool mayPoll() const noexcept { return inner_.mayPoll(); }
    bool quiet() const noexcept { return inner_.quiet(); }
    void nap(std::chrono::nanoseconds limit) { inner_.nap(limit); }
    void interrupt() { inner_.interrupt(); }
    void start(dfb::TransportHandler& handler) { inner_.start(handler); }
    bool poll() { return inner_.poll(); }
    void stop(bool orderly) { inner_.stop(orderly); }

    void send(int destination, dfb::Buffer&& message)
    {
        const auto header = dfb::detail::loadAs<dfb::detail::MessageHeader>(message.data());
        counters_->sent[static_cast<std::size_t>(rank())].add(header.kind, message.size());
        counters_->received[static_cast<std::size_t>(destination)].add(header.kind, message.size());
        inner_.send(destination, std::move(message));
    }

private:
    dfb::InprocTransport inner_;
    std::shared_ptr<Counters> counters_;
};
static_assert(dfb::is_transport_v<CountedTransport>);

} // namespace bench
