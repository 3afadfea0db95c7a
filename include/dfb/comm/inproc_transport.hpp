// InprocTransport: ranks are threads of one process; no launcher and no MPI. A message is handed to its receiver
// by the sending thread.
#pragma once

#include <dfb/comm/connection.hpp>
#include <dfb/comm/transport.hpp>
#include <dfb/compiled.hpp>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <exception>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

namespace detail {

// Shared state of the ranks of one process. Each transport that a rank makes opens the next channel.
class InprocHub {
public:
    // One rank's end of a channel.
    struct Endpoint {
        std::mutex mutex;
        TransportHandler* handler = nullptr;
        bool stopped = false;
        std::vector<std::pair<int, Buffer>> waiting; // came before start(), or are held back to be shuffled
        std::uint64_t random = 0;
        int patience = 0; // polls without an arrival
        NapSignal signal;
    };
    using Channel = std::vector<Endpoint>;

    InprocHub(int size, std::optional<std::uint64_t> shuffleSeed)
        : size_(size), shuffleSeed_(shuffleSeed), opened_(static_cast<std::size_t>(size))
    {
    }

    int size() const noexcept { return size_; }
    bool shuffles() const noexcept { return shuffleSeed_.has_value(); }

    Channel& open(int rank)
    {
        std::lock_guard<std::mutex> lock(mutex_);
        const std::size_t index = opened_[static_cast<std::size_t>(rank)]++;
        if (index == channels_.size()) {
            channels_.emplace_back(static_cast<std::size_t>(size_));
            for (std::size_t r = 0; shuffleSeed_ && r < channels_.back().size(); ++r)
                channels_.back()[r].random = *shuffleSeed_ + 1000003 * index + 7919 * r;
        }
        return channels_[index];
    }

    // The first failure; a rank that starts later gets it too.
    std::optional<ErrorInfo> failure()
    {
        std::lock_guard<std::mutex> lock(mutex_);
        return failure_;
    }

    // Tells all ranks that one of them has gone.
    void fail(const ErrorInfo& error)
    {
        std::vector<Channel*> channels;
        {
            std::lock_guard<std::mutex> lock(mutex_);
            if (failure_)
                return;
            failure_ = error;
            for (Channel& channel : channels_)
                channels.push_back(&channel);
        }
        for (Channel* channel : channels)
            for (Endpoint& endpoint : *channel) {
                std::lock_guard<std::mutex> lock(endpoint.mutex);
                if (endpoint.handler)
                    endpoint.handler->fail(error);
            }
    }

private:
    int size_;
    std::optional<std::uint64_t> shuffleSeed_;
    std::mutex mutex_;
    std::vector<std::size_t> opened_;
    std::deque<Channel> channels_;
    std::optional<ErrorInfo> failure_;
};

} // namespace detail

// One rank of a group of threads; see runRanks().
class InprocCommunicator {
public:
    InprocCommunicator(std::shared_ptr<detail::InprocHub> hub, int rank) : hub_(std::move(hub)), rank_(rank) {}
    int rank() const noexcept { return rank_; }
    int size() const noexcept { return hub_->size(); }

private:
    friend class InprocTransport;
    std::shared_ptr<detail::InprocHub> hub_;
    int rank_;
};

class InprocTransport {
public:
    using Communicator = InprocCommunicator;

    InprocTransport(const Communicator& communicator, std::shared_ptr<MemoryPool>, Progress)
        : hub_(communicator.hub_), rank_(communicator.rank()), channel_(&hub_->open(rank_))
    {
    }

    InprocTransport(const InprocTransport&) = delete;
    InprocTransport& operator=(const InprocTransport&) = delete;
    ~InprocTransport() { stop(false); }

    int rank() const noexcept { return rank_; }
    int size() const noexcept { return hub_->size(); }
    int sharingRanks() const noexcept { return size(); }
    bool needsPolling() const noexcept { return hub_->shuffles(); }
    bool mayPoll() const noexcept { return true; }
    bool wakesOnArrival() const noexcept { return true; }
    bool quiet() const noexcept { return true; }
    void nap(std::chrono::nanoseconds limit) { endpoint(rank_).signal.nap(limit); }
    void interrupt() { endpoint(rank_).signal.interrupt(); }

    void start(TransportHandler& handler)
    {
        Endpoint& self = endpoint(rank_);
        {
            std::lock_guard<std::mutex> lock(self.mutex);
            self.handler = &handler;
            if (!hub_->shuffles()) {
                for (auto& [source, message] : self.waiting)
                    handler.receive(source, std::move(message));
                self.waiting.clear();
            }
        }
        if (const auto failure = hub_->failure())
            handler.fail(*failure);
    }

    void send(int destination, Buffer&& message)
    {
        Endpoint& peer = endpoint(destination);
        std::lock_guard<std::mutex> lock(peer.mutex);
        if (peer.stopped)
            return; // it has its verdict and left: nothing that it could still need
        if (!peer.handler || hub_->shuffles()) {
            peer.waiting.emplace_back(rank_, std::move(message));
            peer.patience = 0;
            peer.signal.interrupt();
        } else {
            peer.handler->receive(rank_, std::move(message));
        }
    }

    // SplitMix64 (Steele, Lea and Flood 2014).
    static std::uint64_t nextRandom(std::uint64_t& state)
    {
        std::uint64_t z = state += 0x9e3779b97f4a7c15u;
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
        z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
        return z ^ (z >> 31);
    }

    // Only where arrivals are shuffled: waits until some have gathered or no more come, then delivers any one.
    bool poll()
    {
        Endpoint& self = endpoint(rank_);
        std::lock_guard<std::mutex> lock(self.mutex);
        if (!self.handler || self.waiting.empty())
            return false;
        if (self.waiting.size() < 16 && self.patience++ < 3) {
            self.signal.interrupt(); // to be asked again soon
            return false;
        }
        std::swap(self.waiting[static_cast<std::size_t>(nextRandom(self.random) % self.waiting.size())],
                  self.waiting.back());
        auto [source, message] = std::move(self.waiting.back());
        self.waiting.pop_back();
        self.handler->receive(source, std::move(message));
        return true;
    }

    void stop(bool)
    {
        Endpoint& self = endpoint(rank_);
        std::lock_guard<std::mutex> lock(self.mutex);
        self.handler = nullptr;
        self.stopped = true;
        self.waiting.clear();
    }

private:
    using Endpoint = detail::InprocHub::Endpoint;
    Endpoint& endpoint(int rank) { return (*channel_)[static_cast<std::size_t>(rank)]; }

    std::shared_ptr<detail::InprocHub> hub_;
    int rank_;
    detail::InprocHub::Channel* channel_;
};

static_assert(is_transport_v<InprocTransport>);
DFB_COMPILED_TEMPLATE(std::shared_ptr<Connection> connect<InprocTransport>(const InprocCommunicator&, NetworkConfig));

// Calls `body(communicator)` on `rankCount` threads, one per rank, and waits for all. If a body throws, the ranks that
// wait for it get a TransportError, and the first exception is rethrown. With `shuffleSeed` messages arrive in a
// pseudo-random order (for tests of order independence).
inline void runRanks(int rankCount, const std::function<void(InprocCommunicator)>& body,
                     std::optional<std::uint64_t> shuffleSeed = std::nullopt)
{
    if (rankCount < 1)
        detail::failArgument("the number of ranks is %d, it must be at least 1", rankCount);
    const auto hub = std::make_shared<detail::InprocHub>(rankCount, shuffleSeed);
    std::mutex mutex;
    std::exception_ptr first;
    const auto leave = [&](int rank, const std::string& why) { // in a handler of an exception
        {
            const std::lock_guard<std::mutex> lock(mutex);
            if (!first)
                first = std::current_exception();
        }
        hub->fail(detail::errorInfo(ErrorKind::Transport, "this rank has left: " + why, rank));
    };
    std::vector<std::thread> threads;
    try {
        for (int rank = 0; rank < rankCount; ++rank)
            threads.emplace_back([&, rank] {
                try {
                    body(InprocCommunicator(hub, rank));
                } catch (const std::exception& e) {
                    leave(rank, e.what());
                } catch (...) {
                    leave(rank, "it ended with an exception that is not a std::exception");
                }
            });
    } catch (const std::exception& e) { // the system gives no more threads
        leave(static_cast<int>(threads.size()), e.what());
    }
    for (std::thread& thread : threads)
        thread.join();
    if (first)
        std::rethrow_exception(first);
}

DFB_NAMESPACE_END
