// What goes into a frame and what comes out of it: configuration, parameters, report.
#pragma once

#include <dfb/comm/compression.hpp>
#include <dfb/comm/transport.hpp>
#include <dfb/exec.hpp>
#include <dfb/tile_layout.hpp>

#include <array>
#include <cstdint>
#include <memory>

namespace dfb {

// What a framebuffer is made with. Everything but executor and progress must be the same on all ranks, which is
// checked when it is made.
struct FrameBufferConfig {
    int width = 0, height = 0;                 // pixels, 1 to 65536
    OutputFormat format = OutputFormat::RGBA8; // of the image on the display rank
    bool depth = false;                        // the image has depth as well
    int displayRank = 0;
    OwnerMap ownerMap = latticeOwner;     // null: latticeOwner
    std::shared_ptr<const Codec> codec{}; // null: messages are not compressed
    std::uint32_t id = 0;                 // stands in every message
    std::shared_ptr<Executor> executor{}; // null: a ThreadExecutor with one thread per core
    Progress progress = Progress::Thread;
};

// What a frame begins with; the same on all ranks, which is checked in the verdict.
struct FrameParams {
    std::array<float, 4> background{0, 0, 0, 0}; // premultiplied linear RGBA behind everything
    int passes = 1;                              // samples a pixel, each a pass
    // False: the inputs of generation 0 say what follows, as in the paper; every owned tile needs one per pass.
    // True: each rank says with Frame::declare() what it will send, and owners count on that.
    bool declared = false;
    // Not 0 and the same as in the last frame, which succeeded: what was declared then still holds, and declare() must
    // not be called. Change it when bricks or camera change.
    std::uint64_t declarationKey = 0;
};

// Figures of a finished frame. "All" are sums or maxima over the ranks and the same everywhere, up to the moment when
// each rank entered the verdict; the others are this rank's own.
struct FrameReport {
    std::int64_t frame = 0;
    double totalMs = 0;               // begin() to the return of end(), this rank
    double renderMs = 0;              // begin() to the call of end(), this rank
    double compositingOverheadMs = 0; // the call of end() to its return, this rank
    double renderMsMax = 0;           // all: the longest renderMs
    std::int64_t bytesSent = 0;       // all: message bytes to other ranks, without the transport's own
    std::int64_t messagesSent = 0;    // all
    std::int64_t tilesTotal = 0;      // in the image
    std::int64_t tilesTouched = 0;    // all: tiles that had an input
    std::int64_t nonFinitePixels = 0; // all: input pixels with an infinity or NaN (see detail/wire.hpp)
    std::int64_t lateMessages = 0;    // all: of cancelled or failed frames, dropped since the last verdict
    std::int64_t peakMemoryBytes = 0; // all: most that one rank's framebuffer ever held in message and image memory
};

} // namespace dfb
