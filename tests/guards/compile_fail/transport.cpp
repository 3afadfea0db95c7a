// An archetype, which has only what a transport must have. Each case leaves out one part.
#include <dfb/dfb.hpp>

#if defined(CASE_NO_MPI) // expect: dfb: this Transport is only declared. For MpiTransport, compile with mpicxx
using Transport = dfb::MpiTransport;
#else
struct Transport {
#if defined(CASE_NO_COMMUNICATOR) // expect: dfb: Transport must provide a type Communicator and a constructor
    Transport(int, std::shared_ptr<dfb::MemoryPool>, dfb::Progress);
#elif defined(CASE_WRONG_CONSTRUCTOR) // expect: dfb: Transport must provide a type Communicator and a constructor
    using Communicator = int;
    explicit Transport(const Communicator&);
#else
    using Communicator = int;
    Transport(const Communicator&, std::shared_ptr<dfb::MemoryPool>, dfb::Progress);
#endif

    int rank() const;
#if defined(CASE_NO_SIZE) // expect: dfb: Transport must provide int rank() const and int size() const
#else
    int size() const;
#endif

    void start(dfb::TransportHandler&);
#if defined(CASE_NO_STOP) // expect: dfb: Transport must provide void start(TransportHandler&) and void stop(bool orderly)
#else
    void stop(bool orderly);
#endif

#if defined(CASE_NO_SEND) // expect: dfb: Transport must provide void send(int destination, Buffer&&)
#else
    void send(int destination, dfb::Buffer&&);
#endif

    bool needsPolling() const;
    bool mayPoll() const;
    bool quiet() const;
#if defined(CASE_NO_NAP) // expect: dfb: Transport must provide void nap(std::chrono::nanoseconds) and void interrupt()
#else
    void nap(std::chrono::nanoseconds);
#endif
    void interrupt();
#if defined(CASE_POLL_SAYS_NOTHING) // expect: dfb: Transport must provide bool poll(), bool needsPolling() const
    void poll();
#else
    bool poll();
#endif
};
#endif

template class dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, Transport>;
