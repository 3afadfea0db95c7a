// Forward: a transport that passes every call on to another transport. Transports of tests derive from it and redefine
// only the members that they change.
#pragma once

#include <dfb/comm/transport.hpp>

#include <chrono>
#include <memory>
#include <utility>

template <class Inner>
class Forward {
public:
    Forward(const typename Inner::Communicator& communicator, std::shared_ptr<dfb::MemoryPool> pool,
            dfb::Progress progress)
        : inner_(communicator, std::move(pool), progress)
    {
    }
    int rank() const { return inner_.rank(); }
    int size() const { return inner_.size(); }
    bool needsPolling() const { return inner_.needsPolling(); }
    bool mayPoll() const { return inner_.mayPoll(); }
    bool quiet() const { return inner_.quiet(); }
    bool poll() { return inner_.poll(); }
    void nap(std::chrono::nanoseconds limit) { inner_.nap(limit); }
    void interrupt() { inner_.interrupt(); }
    void start(dfb::TransportHandler& handler) { inner_.start(handler); }
    void stop(bool orderly) { inner_.stop(orderly); }
    void send(int destination, dfb::Buffer&& message) { inner_.send(destination, std::move(message)); }

protected:
    Inner inner_;
};
