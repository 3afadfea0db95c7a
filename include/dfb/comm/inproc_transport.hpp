// InprocTransport: ranks are threads of one process, without launcher and MPI. The sending thread hands a message to
// its receiver.
#pragma once

#include <dfb/comm/connection.hpp>
#include <dfb/comm/transport.hpp>
#include <dfb/compiled.hpp>

#include <chrono>
#include <cstddef>
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
        std::vector<std::pair<int, Buffer>> waiting; // came before start()
    };
    using Channel = std::vector<Endpoint>;

    explicit InprocHub(int size) : opened_(static_cast<std::size_t>(size)) {}

    int size() const noexcept { return static_cast<int>(opened_.size()); }

    Channel& open(int rank)
    {
        std::lock_guard<std::mutex> lock(mutex_);
        const std::size_t index = opened_[static_cast<std::size_t>(rank)]++;
        if (index == channels_.size())
            channels_.emplace_back(opened_.size());
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
        std::lock_guard<std::mutex> lock(mutex_);
        if (failure_)
            return;
        failure_ = error;
        for (Channel& channel : channels_)
            for (Endpoint& endpoint : channel) {
                std::lock_guard<std::mutex> endpointLock(endpoint.mutex);
                if (endpoint.handler)
                    endpoint.handler->fail(error);
            }
    }

private:
    std::mutex mutex_;
    std::vector<std::size_t> opened_; // by each rank; under mutex_, but its size is fixed
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

// The transport between the ranks of runRanks(). Its members are those of the contract in transport.hpp. All ranks make
// their transports in the same order. A message is delivered by send(), on the thread that calls it.
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
    bool needsPolling() const noexcept { return false; }
    bool mayPoll() const noexcept { return true; }
    bool quiet() const noexcept { return true; }
    bool poll() noexcept { return false; }
    void nap(std::chrono::nanoseconds limit) { signal_.nap(limit); }
    void interrupt() { signal_.interrupt(); }

    void start(TransportHandler& handler)
    {
        Endpoint& self = endpoint(rank_);
        {
            std::lock_guard<std::mutex> lock(self.mutex);
            self.handler = &handler;
            for (auto& [source, message] : self.waiting)
                handler.receive(source, std::move(message));
            self.waiting.clear();
        }
        if (const auto failure = hub_->failure())
            handler.fail(*failure);
    }

    void send(int destination, Buffer&& message)
    {
        Endpoint& peer = endpoint(destination);
        std::lock_guard<std::mutex> lock(peer.mutex);
        if (peer.stopped)
            return; // it has left, and needs no more messages
        if (peer.handler)
            peer.handler->receive(rank_, std::move(message));
        else
            peer.waiting.emplace_back(rank_, std::move(message));
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
    NapSignal signal_;
};

static_assert(is_transport_v<InprocTransport>);
DFB_COMPILED_TEMPLATE(std::shared_ptr<Connection> connect<InprocTransport>(const InprocCommunicator&, NetworkConfig));

// Calls `body(communicator)` on `rankCount` new threads, one for each rank. Any thread may call it. Waits until all
// have returned. If a body throws, the connections of the other ranks fail with a TransportError, and the first
// exception is rethrown here. Throws InvalidArgument for less than 1 rank. Throws std::system_error if the system gives
// no more threads; the ranks that have begun then get a TransportError.
inline void runRanks(int rankCount, const std::function<void(InprocCommunicator)>& body)
{
    if (rankCount < 1)
        detail::failArgument("the number of ranks is %d, it must be at least 1", rankCount);
    const auto hub = std::make_shared<detail::InprocHub>(rankCount);
    std::mutex mutex;
    std::exception_ptr first;
    const auto leave = [&](int rank, const std::string& why) { // called in a catch block
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
