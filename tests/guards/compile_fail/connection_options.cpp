// NetworkConfig is given to the connection, so a framebuffer on an existing connection does not accept it again.
#include <dfb/dfb.hpp>

#include <memory>
#include <type_traits>

using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, dfb::InprocTransport>;
using Given = std::shared_ptr<dfb::Connection>;

inline void make(dfb::FrameBufferConfig& config, dfb::NetworkConfig& options)
{
#if defined(CASE_PROGRESS_IN_CONFIG) // expect: no member named
    config.progress = dfb::Progress::Caller;
#elif defined(CASE_CHECKSUMS_IN_CONFIG) // expect: no member named
    config.checksums = true;
#elif defined(CASE_MEMORY_IN_CONFIG) // expect: no member named
    config.sharedMemory = false;
#elif defined(CASE_TIMEOUT_IN_CONFIG) // expect: no member named
    config.peerTimeout = std::chrono::milliseconds(4000);
#elif defined(CASE_HANDLER_IN_CONFIG) // expect: no member named
    config.onPeerLost = [](const dfb::ErrorInfo&) {};
#elif defined(CASE_OPTIONS_WITH_A_CONNECTION) // expect: no matching
    using Made = decltype(FrameBuffer(std::declval<Given>(), config, options));
#else
    options.peerTimeout = std::chrono::milliseconds(4000);
    using Made = decltype(FrameBuffer(std::declval<const dfb::InprocCommunicator&>(), config, options));
    using WithGiven = decltype(FrameBuffer(std::declval<Given>(), config));
    static_assert(std::is_same_v<Made, WithGiven>);
#endif
    (void)config;
    (void)options;
}
