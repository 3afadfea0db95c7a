// The contract of a transport: how bytes get from rank to rank. A transport is passive: whoever needs progress
// calls poll(). It knows nothing of tiles.
//
//   using Communicator = ...;                    what a user has: a group of ranks, and which of them is this one
//   static constexpr const char* name;           for reports
//   T(const Communicator&, std::shared_ptr<MemoryPool>, Progress);
//                                                collective over the communicator; messages of two transports on one
//                                                communicator do not mix; throws TransportError
//   int rank() const; int size() const;
//   bool needsPolling() const;                   false: messages are delivered without poll()
//   bool mayPoll() const;                        whether the calling thread may call poll()
//   bool wakesOnArrival() const;                 nap() ends by itself when a message has come that needs poll(), from
//                                                whichever rank; a few polls may be needed to bring it
//   void start(TransportHandler&);               from here on the handler is called
//   void send(int destination, Buffer&&);        after start(); any thread; never blocks; destination is another rank;
//                                                reliable, in any order; of any size, 0 included. To a rank that has
//                                                stopped: nothing happens
//   bool poll();                                 between start() and stop(), one thread at a time; never blocks; moves
//                                                what can be moved; true if something was; calls the handler
//   bool quiet() const;                          any thread; nothing waits to be sent: what was sent arrives although
//                                                this rank polls no more
//   void nap(std::chrono::nanoseconds limit);    the thread that polls; sleeps until poll() has something to send,
//                                                interrupt() is called, or `limit` has passed
//   void interrupt();                            any thread; ends the nap under way, else the next one
//   void stop(bool orderly);                     once, after start(), when no thread is in another member; afterwards
//                                                the handler is not called. Orderly: this rank expects nothing more;
//                                                what it has sent still reaches the ranks that have not called stop().
//                                                May wait until all ranks have called it or the handler has failed().
//                                                Else: waits for nobody; other ranks may get fail(), and what was under
//                                                way may be lost
//
// And, if other ranks can see memory of this one (see comm/mpi_transport.hpp):
//   bool lendsTo(int other) const;  std::int32_t placeOf(const std::byte* block) const;
//   std::byte* blockAt(int other, std::int32_t place, std::size_t byteCount) const;
//
// And, if a thread of the library's own may not always poll (without this it always may):
//   static bool mayHaveThread(const Communicator&);
//                                                whether the constructor accepts Progress::Thread on this rank; never
//                                                throws. Progress::Auto becomes Thread or Caller by it, so that the
//                                                constructor gets no Auto
//
// And, if it knows (without this a rank has its processors for itself):
//   int sharingRanks() const;                    how many ranks may run on processors that this one may run on, this one
//                                                included
//
// And, if it can end the job of which the ranks are processes:
//   void abort(const std::string& text);         between start() and stop(), or in waiting(), on the thread that polls;
//                                                says why on standard error and ends all ranks; does not return
//
// Messages may outlive the transport.
// testing/transport_conformance.hpp checks whether a transport keeps this contract.
#pragma once

#include <dfb/buffer.hpp>
#include <dfb/error.hpp>

#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <string>
#include <type_traits>
#include <utility>

namespace dfb {

// Who calls poll() of a transport that needs it. Ranks may differ.
enum class Progress {
    // Thread where the transport allows it, else Caller: with MPI the thread level decides, on each rank.
    Auto,
    // A thread of the library's own. MPI must have been initialised with MPI_THREAD_MULTIPLE.
    Thread,
    // The calls of the user: DistributedFrameBuffer::poll(), Frame::setTile(), and those that wait (the constructor,
    // Frame::end(), ...). Messages move only in those calls. At MPI_THREAD_SINGLE and MPI_THREAD_FUNNELED those that
    // wait belong to the thread that initialised MPI; at MPI_THREAD_SERIALIZED no other thread may be in MPI meanwhile.
    Caller
};

// Where a transport delivers. The calls are quick, never block, may come from any thread, and must not call the
// transport.
class TransportHandler {
public:
    virtual void receive(int source, Buffer&& message) = 0;
    virtual void fail(const ErrorInfo& error) = 0; // the transport cannot go on
    virtual bool failed() const = 0;               // it cannot, or another rank has said that it cannot
    // Called over and over by a stop() that waits for other ranks, on its thread: here, alone, send() may be called.
    virtual void waiting() {}

protected:
    ~TransportHandler() = default;
};

// nap() and interrupt() for transports that have nothing better to sleep on.
class NapSignal {
public:
    void nap(std::chrono::nanoseconds limit)
    {
        std::unique_lock<std::mutex> lock(mutex_);
        changed_.wait_for(lock, limit, [this] { return interrupted_; });
        interrupted_ = false;
    }

    void interrupt()
    {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            interrupted_ = true;
        }
        changed_.notify_one();
    }

private:
    std::mutex mutex_;
    std::condition_variable changed_;
    bool interrupted_ = false;
};

namespace detail {

template <class T, class = void>
struct HasCommunicator : std::false_type {
};
template <class T>
struct HasCommunicator<T, std::void_t<typename T::Communicator>>
    : std::is_constructible<T, const typename T::Communicator&, std::shared_ptr<MemoryPool>, Progress> {
};

template <class T, class = void>
struct HasRankAndSize : std::false_type {
};
template <class T>
struct HasRankAndSize<T,
                      std::void_t<decltype(std::declval<const T&>().rank()), decltype(std::declval<const T&>().size())>>
    : std::true_type {
};

template <class T, class = void>
struct HasSend : std::false_type {
};
template <class T>
struct HasSend<T, std::void_t<decltype(std::declval<T&>().send(0, std::declval<Buffer&&>()))>> : std::true_type {
};

template <class T, class = void>
struct HasPoll : std::false_type {
};
template <class T>
struct HasPoll<T, std::void_t<decltype(std::declval<T&>().poll()), decltype(std::declval<const T&>().needsPolling()),
                              decltype(std::declval<const T&>().mayPoll()), decltype(std::declval<const T&>().quiet())>>
    : std::is_same<bool, decltype(std::declval<T&>().poll())> {
};

template <class T, class = void>
struct HasNap : std::false_type {
};
template <class T>
struct HasNap<
    T, std::void_t<decltype(std::declval<T&>().nap(std::chrono::nanoseconds())),
                   decltype(std::declval<T&>().interrupt()), decltype(std::declval<const T&>().wakesOnArrival())>>
    : std::true_type {
};

template <class T, class = void>
struct HasStartAndStop : std::false_type {
};
template <class T>
struct HasStartAndStop<T, std::void_t<decltype(std::declval<T&>().start(std::declval<TransportHandler&>())),
                                      decltype(std::declval<T&>().stop(true))>> : std::true_type {
};

// Optional.
template <class T, class = void>
struct SharesMemory : std::false_type {
};
template <class T>
struct SharesMemory<T, std::void_t<decltype(std::declval<const T&>().lendsTo(0)),
                                   decltype(std::declval<const T&>().placeOf(nullptr)),
                                   decltype(std::declval<const T&>().blockAt(0, 0, 0))>> : std::true_type {
};

// Optional.
template <class T, class = void>
struct LimitsThreads : std::false_type {
};
template <class T>
struct LimitsThreads<T, std::void_t<decltype(T::mayHaveThread(std::declval<const typename T::Communicator&>()))>>
    : std::true_type {
};

// What Progress::Auto is with this transport.
template <class T>
Progress resolved(Progress progress, [[maybe_unused]] const typename T::Communicator& communicator)
{
    if (progress != Progress::Auto)
        return progress;
    if constexpr (LimitsThreads<T>::value)
        return T::mayHaveThread(communicator) ? Progress::Thread : Progress::Caller;
    else
        return Progress::Thread;
}

// Optional.
template <class T, class = void>
struct KnowsSharing : std::false_type {
};
template <class T>
struct KnowsSharing<T, std::void_t<decltype(std::declval<const T&>().sharingRanks())>> : std::true_type {
};

// Optional.
template <class T, class = void>
struct CanAbort : std::false_type {
};
template <class T>
struct CanAbort<T, std::void_t<decltype(std::declval<T&>().abort(std::declval<const std::string&>()))>>
    : std::true_type {
};

} // namespace detail

template <class T>
inline constexpr bool is_transport_v =
    detail::HasCommunicator<T>::value&& detail::HasRankAndSize<T>::value&& detail::HasSend<T>::value&&
        detail::HasPoll<T>::value&& detail::HasNap<T>::value&& detail::HasStartAndStop<T>::value;

namespace detail {

template <class T>
constexpr bool checkTransport()
{
    static_assert(HasCommunicator<T>::value, "dfb: Transport must provide a type Communicator and a constructor "
                                             "(const Communicator&, std::shared_ptr<MemoryPool>, Progress)");
    static_assert(HasRankAndSize<T>::value, "dfb: Transport must provide int rank() const and int size() const");
    static_assert(HasSend<T>::value, "dfb: Transport must provide void send(int destination, Buffer&&)");
    static_assert(HasPoll<T>::value, "dfb: Transport must provide bool poll(), bool needsPolling() const, "
                                     "bool mayPoll() const and bool quiet() const");
    static_assert(HasNap<T>::value, "dfb: Transport must provide void nap(std::chrono::nanoseconds), void interrupt() "
                                    "and bool wakesOnArrival() const");
    static_assert(HasStartAndStop<T>::value,
                  "dfb: Transport must provide void start(TransportHandler&) and void stop(bool orderly)");
    return is_transport_v<T>;
}

} // namespace detail

// Link: a transport of any type, behind one abstract class. What uses it is no template.
//
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
    // itself, and the job cannot be ended.
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
