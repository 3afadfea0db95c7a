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
//   void start(TransportHandler&);               from here on the handler is called
//   void send(int destination, Buffer&&);        any thread; never blocks; destination is another rank; reliable,
//                                                in any order
//   bool poll();                                 one thread at a time; never blocks; moves what can be moved; true if
//                                                something was; calls the handler
//   bool quiet() const;                          nothing waits to be sent
//   void stop(bool orderly);                     afterwards the handler is not called. Orderly: no rank expects
//   anything
//                                                more; collective where the transport needs it. Else (it has
//                                                failed): waits for nobody
#pragma once

#include <dfb/buffer.hpp>
#include <dfb/error.hpp>

#include <memory>
#include <type_traits>
#include <utility>

namespace dfb {

// Who calls poll() of a transport that needs it.
enum class Progress {
    Thread, // a thread of the framebuffer's own; MPI must have been initialised with MPI_THREAD_MULTIPLE
    Caller  // the calls that wait (the constructor, Frame::end(), ...), made by one thread: MPI_THREAD_FUNNELED is
            // enough, but messages move only in those calls
};

// Where a transport delivers. The calls are quick, never block, and may come from any thread.
class TransportHandler {
public:
    virtual void receive(int source, Buffer&& message) = 0;
    virtual void fail(const ErrorInfo& error) = 0; // the transport can not go on
    virtual void wake() = 0;                       // poll() has something to do

protected:
    ~TransportHandler() = default;
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
                              decltype(std::declval<const T&>().quiet())>>
    : std::is_same<bool, decltype(std::declval<T&>().poll())> {
};

template <class T, class = void>
struct HasStartAndStop : std::false_type {
};
template <class T>
struct HasStartAndStop<T, std::void_t<decltype(std::declval<T&>().start(std::declval<TransportHandler&>())),
                                      decltype(std::declval<T&>().stop(true))>> : std::true_type {
};

} // namespace detail

template <class T>
inline constexpr bool is_transport_v = detail::HasCommunicator<T>::value&& detail::HasRankAndSize<T>::value&&
    detail::HasSend<T>::value&& detail::HasPoll<T>::value&& detail::HasStartAndStop<T>::value;

namespace detail {

template <class T>
constexpr bool checkTransport()
{
    static_assert(HasCommunicator<T>::value, "dfb: Transport must provide a type Communicator and a constructor "
                                             "(const Communicator&, std::shared_ptr<MemoryPool>, Progress)");
    static_assert(HasRankAndSize<T>::value, "dfb: Transport must provide int rank() const and int size() const");
    static_assert(HasSend<T>::value, "dfb: Transport must provide void send(int destination, Buffer&&)");
    static_assert(HasPoll<T>::value, "dfb: Transport must provide bool poll(), bool needsPolling() const "
                                     "and bool quiet() const");
    static_assert(HasStartAndStop<T>::value,
                  "dfb: Transport must provide void start(TransportHandler&) and void stop(bool orderly)");
    return is_transport_v<T>;
}

} // namespace detail

} // namespace dfb
