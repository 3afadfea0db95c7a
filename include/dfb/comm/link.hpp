// Link: a transport of any type, behind one abstract class. What uses it is no template.
#pragma once

#include <dfb/comm/transport.hpp>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <utility>

namespace dfb {

// Its members are those of the contract in comm/transport.hpp.
class Link {
public:
    virtual ~Link() = default;

    virtual int rank() const = 0;
    virtual int size() const = 0;
    virtual bool needsPolling() const = 0;
    virtual bool mayPoll() const = 0;
    virtual bool wakesOnArrival() const = 0;
    virtual bool quiet() const = 0;
    virtual void start(TransportHandler& handler) = 0;
    virtual void send(int destination, Buffer&& message) = 0;
    virtual bool poll() = 0;
    virtual void nap(std::chrono::nanoseconds limit) = 0;
    virtual void interrupt() = 0;
    virtual void stop(bool orderly) = 0;

    // What a transport may leave out. Without it other ranks see no memory of this one, a rank has its processors for
    // itself, and the job can not be ended.
    virtual bool lendsTo(int other) const = 0;
    virtual std::int32_t placeOf(const std::byte* block) const = 0;
    virtual std::byte* blockAt(int other, std::int32_t place, std::size_t byteCount) const = 0;
    virtual int sharingRanks() const = 0;
    virtual bool canAbort() const = 0;
    virtual void abort(const std::string& text) = 0;
};

namespace detail {

template <class Transport>
class LinkOver final : public Link {
    static_assert(checkTransport<Transport>());

public:
    LinkOver(const typename Transport::Communicator& communicator, std::shared_ptr<MemoryPool> pool, Progress progress)
        : transport_(communicator, std::move(pool), progress)
    {
    }

    int rank() const override { return transport_.rank(); }
    int size() const override { return transport_.size(); }
    bool needsPolling() const override { return transport_.needsPolling(); }
    bool mayPoll() const override { return transport_.mayPoll(); }
    bool wakesOnArrival() const override { return transport_.wakesOnArrival(); }
    bool quiet() const override { return transport_.quiet(); }
    void start(TransportHandler& handler) override { transport_.start(handler); }
    void send(int destination, Buffer&& message) override { transport_.send(destination, std::move(message)); }
    bool poll() override { return transport_.poll(); }
    void nap(std::chrono::nanoseconds limit) override { transport_.nap(limit); }
    void interrupt() override { transport_.interrupt(); }
    void stop(bool orderly) override { transport_.stop(orderly); }

    bool lendsTo([[maybe_unused]] int other) const override
    {
        if constexpr (SharesMemory<Transport>::value)
            return transport_.lendsTo(other);
        else
            return false;
    }
    std::int32_t placeOf([[maybe_unused]] const std::byte* block) const override
    {
        if constexpr (SharesMemory<Transport>::value)
            return transport_.placeOf(block);
        else
            return -1;
    }
    std::byte* blockAt([[maybe_unused]] int other, [[maybe_unused]] std::int32_t place,
                       [[maybe_unused]] std::size_t byteCount) const override
    {
        if constexpr (SharesMemory<Transport>::value)
            return transport_.blockAt(other, place, byteCount);
        else
            return nullptr;
    }
    int sharingRanks() const override
    {
        if constexpr (KnowsSharing<Transport>::value)
            return transport_.sharingRanks();
        else
            return 1;
    }
    bool canAbort() const override { return CanAbort<Transport>::value; }
    void abort([[maybe_unused]] const std::string& text) override
    {
        if constexpr (CanAbort<Transport>::value)
            transport_.abort(text);
    }

private:
    Transport transport_;
};

} // namespace detail

} // namespace dfb
