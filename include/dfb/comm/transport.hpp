// The contract of a transport, which carries bytes from rank to rank. It is passive: it moves messages only in poll(),
// unless needsPolling() is false. It knows nothing of tiles.
//
//   using Communicator = ...;                   the program's handle of a group of ranks and of this rank in it
//   T(const Communicator&, std::shared_ptr<MemoryPool>, Progress);
//                                               collective over the communicator. Messages of two transports on one
//                                               communicator do not mix. Throws TransportError
//   int rank() const; int size() const;
//   bool needsPolling() const;                  false: messages are delivered without poll()
//   bool mayPoll() const;                       whether the calling thread may call poll()
//   void start(TransportHandler&);              from now on the handler may be called
//   void send(int destination, Buffer&&);       after start(). Any thread. Never blocks nor throws TransportError.
//                                               `destination` is another rank. A message arrives once; messages arrive
//                                               in any order. They may have any size, also 0. A message to a rank that
//                                               has stopped is dropped
//   bool poll();                                between start() and stop(), one thread at a time. Never blocks. Sends
//                                               and receives what it can, and calls the handler. Returns whether
//                                               anything moved
//   bool quiet() const;                         any thread. Whether nothing waits to be sent: all messages will then
//                                               arrive even if this rank does not poll any more
//   void nap(std::chrono::nanoseconds limit);   on the thread that polls. Sleeps until there is something to send,
//                                               interrupt() is called, or `limit` has passed. May end a little
//                                               later. Better if it also ends when a message comes
//   void interrupt();                           any thread, also within a call of the handler. Ends the nap under way,
//                                               or else the next one
//   void stop(bool orderly);                    once, after start(), when no thread is in another member. Afterwards
//                                               the handler is not called. Orderly: this rank expects no more messages;
//                                               what it has sent reaches all ranks that have not called stop();
//                                               the call may wait until all ranks have made it or the handler has
//                                               failed(). Not orderly: it waits for nobody; other ranks may get fail(),
//                                               and messages under way may be lost
//
// Optional, if other ranks can see memory of this one (see comm/mpi_transport.hpp). Places in that memory are counted
// in units of bytesOfPlace, at which the memory is aligned:
//   bool lendsTo(int other) const;              whether that rank sees this rank's memory
//   std::int32_t placeOf(const std::byte* p) const;
//                                               the place that holds *p, or -1 if others do not see it
//   std::byte* blockAt(int other, std::int32_t place, std::size_t byteCount) const;
//                                               the first of `byteCount` bytes at a place in another rank's memory, or
//                                               null. They can be read as long as the transport lives
//
// Optional, if a thread of the library's own may not always poll:
//   static bool mayHaveThread(const Communicator&);
//                                               whether the constructor accepts Progress::Thread on this rank. Never
//                                               throws. Decides between Thread and Caller for Progress::Auto, which the
//                                               constructor never gets
//
// Optional, if ranks may share processors:
//   int sharingRanks() const;                   how many ranks, this one included, may run on this rank's processors
//
// Optional, if it can end the job whose processes the ranks are:
//   void abort(const std::string& text);        between start() and stop(), or in TransportHandler::waiting(), on the
//                                               thread that polls. Prints `text` on standard error and ends all ranks.
//                                               Does not return
//
// Messages may outlive the transport.
// testing/transport_conformance.hpp checks whether a transport keeps this contract.
#pragma once

#include <dfb/base/detect.hpp>
#include <dfb/buffer.hpp>
#include <dfb/error.hpp>

#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <string>
#include <utility>

DFB_NAMESPACE_BEGIN

// Which thread moves messages. Ranks may differ.
enum class Progress {
    // Thread if the transport allows it, else Caller. With MPI the thread level of each rank decides.
    Auto,
    // A thread of the library's own. With MPI it needs MPI_THREAD_MULTIPLE.
    Thread,
    // The program's own threads: messages move in DistributedFrameBuffer::poll(), in Frame::setTile(), and in calls
    // that wait, such as the constructor, Frame::forEachTile() and Frame::end(). At MPI_THREAD_SINGLE and
    // MPI_THREAD_FUNNELED only the thread that initialised MPI may make calls that wait for other ranks, and on other
    // threads poll() and setTile() move nothing. At MPI_THREAD_SERIALIZED no other thread may call MPI meanwhile.
    Caller
};

// Gets the messages that a transport delivers. Its members are quick and never block. Any thread may call receive(),
// fail() and failed(); these call nothing of the transport but interrupt().
class TransportHandler {
public:
    virtual void receive(int source, Buffer&& message) = 0;
    virtual void fail(const ErrorInfo& error) = 0; // the transport cannot go on
    virtual bool failed() const = 0;               // the transport cannot go on, or another rank has said so
    // Called repeatedly by a stop() that waits for other ranks, on the thread that called it. It may call send().
    virtual void waiting() {}

protected:
    ~TransportHandler() = default;
};

// nap() and interrupt() by a condition variable, for transports without a way of their own.
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

DFB_DETECTS(is_complete_v, sizeof(T));
DFB_DETECTS(has_communicator_v,
            T(std::declval<const typename T::Communicator&>(), std::shared_ptr<MemoryPool>(), Progress()));
DFB_DETECTS(has_rank_and_size_v, std::declval<const T&>().rank(), std::declval<const T&>().size());
DFB_DETECTS(has_send_v, std::declval<T&>().send(0, std::declval<Buffer&&>()));

DFB_DETECTS(has_poll_v, bool{std::declval<T&>().poll()}, std::declval<const T&>().needsPolling(),
            std::declval<const T&>().mayPoll(), std::declval<const T&>().quiet());
DFB_DETECTS(has_nap_v, std::declval<T&>().nap(std::chrono::nanoseconds()), std::declval<T&>().interrupt());
DFB_DETECTS(has_start_and_stop_v, std::declval<T&>().start(std::declval<TransportHandler&>()),
            std::declval<T&>().stop(true));

// Optional.
DFB_DETECTS(shares_memory_v, std::declval<const T&>().lendsTo(0), std::declval<const T&>().placeOf(nullptr),
            std::declval<const T&>().blockAt(0, 0, 0));
DFB_DETECTS(limits_threads_v, T::mayHaveThread(std::declval<const typename T::Communicator&>()));
DFB_DETECTS(knows_sharing_v, std::declval<const T&>().sharingRanks());
DFB_DETECTS(can_abort_v, std::declval<T&>().abort(std::declval<const std::string&>()));

// Replaces Progress::Auto by Thread or Caller.
template <class T>
Progress resolved(Progress progress, [[maybe_unused]] const typename T::Communicator& communicator)
{
    if (progress != Progress::Auto)
        return progress;
    if constexpr (limits_threads_v<T>)
        return T::mayHaveThread(communicator) ? Progress::Thread : Progress::Caller;
    else
        return Progress::Thread;
}

template <class T>
constexpr bool checkTransport()
{
    static_assert(is_complete_v<T>, "dfb: this Transport is only declared. For MpiTransport, compile with mpicxx, or "
                                    "link the CMake target dfb::mpi");
    if constexpr (is_complete_v<T>) { // else one message is enough
        static_assert(has_communicator_v<T>, "dfb: Transport must provide a type Communicator and a constructor "
                                             "(const Communicator&, std::shared_ptr<MemoryPool>, Progress)");
        static_assert(has_rank_and_size_v<T>, "dfb: Transport must provide int rank() const and int size() const");
        static_assert(has_send_v<T>, "dfb: Transport must provide void send(int destination, Buffer&&)");
        static_assert(has_poll_v<T>, "dfb: Transport must provide bool poll(), bool needsPolling() const, "
                                     "bool mayPoll() const and bool quiet() const");
        static_assert(has_nap_v<T>,
                      "dfb: Transport must provide void nap(std::chrono::nanoseconds) and void interrupt()");
        static_assert(has_start_and_stop_v<T>,
                      "dfb: Transport must provide void start(TransportHandler&) and void stop(bool orderly)");
    }
    return true;
}

} // namespace detail

template <class T>
inline constexpr bool is_transport_v = detail::has_communicator_v<T>&& detail::has_rank_and_size_v<T>&&
    detail::has_send_v<T>&& detail::has_poll_v<T>&& detail::has_nap_v<T>&& detail::has_start_and_stop_v<T>;

inline constexpr std::int64_t bytesOfPlace = 64;

// Link: an abstract class that hides the type of a transport, so that its users need not be templates. For its members
// see the contract above.
class Link {
public:
    virtual ~Link() = default;

    virtual int rank() const = 0;
    virtual int size() const = 0;
    virtual bool needsPolling() const = 0;
    virtual bool mayPoll() const = 0;
    virtual bool quiet() const = 0;
    virtual void start(TransportHandler& handler) = 0;
    virtual void send(int destination, Buffer&& message) = 0;
    virtual bool poll() = 0;
    virtual void nap(std::chrono::nanoseconds limit) = 0;
    virtual void interrupt() = 0;
    virtual void stop(bool orderly) = 0;

    // The optional members. A transport without them lends no memory, shares no processors, and cannot end the job.
    virtual bool knowsSharedMemory() const = 0; // whether it has the next three
    virtual bool lendsTo(int other) const = 0;
    virtual std::int32_t placeOf(const std::byte* block) const = 0;
    virtual std::byte* blockAt(int other, std::int32_t place, std::size_t byteCount) const = 0;
    virtual int sharingRanks() const = 0;
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
    bool quiet() const override { return transport_.quiet(); }
    void start(TransportHandler& handler) override { transport_.start(handler); }
    void send(int destination, Buffer&& message) override { transport_.send(destination, std::move(message)); }
    bool poll() override { return transport_.poll(); }
    void nap(std::chrono::nanoseconds limit) override { transport_.nap(limit); }
    void interrupt() override { transport_.interrupt(); }
    void stop(bool orderly) override { transport_.stop(orderly); }

    bool knowsSharedMemory() const override { return shares_memory_v<Transport>; }
    bool lendsTo(int other) const override { return with<shares_memory_v<Transport>>().lendsTo(other); }
    std::int32_t placeOf(const std::byte* block) const override
    {
        return with<shares_memory_v<Transport>>().placeOf(block);
    }
    std::byte* blockAt(int other, std::int32_t place, std::size_t byteCount) const override
    {
        return with<shares_memory_v<Transport>>().blockAt(other, place, byteCount);
    }
    int sharingRanks() const override { return with<knows_sharing_v<Transport>>().sharingRanks(); }
    void abort([[maybe_unused]] const std::string& text) override
    {
        if constexpr (can_abort_v<Transport>)
            transport_.abort(text);
    }

private:
    struct Without {
        bool lendsTo(int) const { return false; }
        std::int32_t placeOf(const std::byte*) const { return -1; }
        std::byte* blockAt(int, std::int32_t, std::size_t) const { return nullptr; }
        int sharingRanks() const { return 1; }
    };
    // The transport, if it has these optional members; else a stand-in for them.
    template <bool Has>
    decltype(auto) with() const
    {
        if constexpr (Has)
            return (transport_);
        else
            return Without();
    }

    Transport transport_;
};

} // namespace detail

DFB_NAMESPACE_END
