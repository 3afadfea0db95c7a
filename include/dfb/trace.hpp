// TraceSink: gets events that say what a rank does for its frames, and when. TraceFile, in trace_file.hpp, is a sink
// that writes a file.
#pragma once

#include <dfb/version.hpp>

#include <chrono>
#include <cstdint>

DFB_NAMESPACE_BEGIN

// A span of time on one rank, by its steady_clock.
struct TraceEvent {
    using Clock = std::chrono::steady_clock;

    enum class Kind : std::uint8_t {
        // Spans of a frame, reported at its end, even if it failed:
        Frame,   // begin() to the return of end(): FrameReport::totalMs
        Render,  // begin() to the first call of isDone(), tryEnd() or end(): renderMs
        End,     // from that call to the return of end(): compositingOverheadMs
        Verdict, // from this rank's vote to the verdict of all; byteCount: this rank's part of FrameReport::bytesSent
        // Spans of a thread, which reports them itself. Two spans of a thread are nested, or do not overlap:
        Tile,    // a job of Frame::forEachTile()
        SetTile, // Frame::setTile(): the input is encoded and sent, or taken by this rank
        Input,   // an input is taken by the owner of its tile: TileOp::add(). peer: whose message it is, or -1
        Finish,  // tile operation and pixel operation of a tile, whose pixels go into the image or into a message
        Send,    // a message is given to the transport. peer: its receiver
        Receive, // a message from the inbox is handled. peer: its sender
        Wait     // for room, for a reduction such as the verdict, or for another rank. Other work may be within it
    };

    Kind kind = Kind::Frame;
    std::uint8_t message = 0; // for Send and Receive: a detail::MessageKind
    Clock::time_point begin{}, end{};
    std::int64_t frame = -1; // the frame's number; -1: it belongs to no frame
    std::int64_t byteCount = 0;
    std::int32_t tile = -1, peer = -1; // -1: none
    // For Send and Receive: together with both ranks, this identifies a message of a connection.
    std::uint32_t sequence = 0;
};

// The contract: add() is called by any thread, several at once, sometimes with a lock held. It is quick, waits for
// nothing, and calls nothing of the library. It must not throw: a sink handles its own failures.
class TraceSink {
public:
    virtual ~TraceSink() = default;
    virtual void add(const TraceEvent& event) noexcept = 0;
};

namespace detail {

// Reports the time from its construction to its destruction to a sink, if there is one.
class TraceSpan {
public:
    TraceSpan(TraceSink* sink, TraceEvent::Kind kind, std::int64_t frame, std::int64_t tile = -1) : sink_(sink)
    {
        if (!sink)
            return;
        event_.kind = kind;
        event_.frame = frame;
        event_.tile = static_cast<std::int32_t>(tile);
        event_.begin = TraceEvent::Clock::now();
    }
    TraceSpan(const TraceSpan&) = delete;
    TraceSpan& operator=(const TraceSpan&) = delete;
    ~TraceSpan()
    {
        if (!sink_)
            return;
        event_.end = TraceEvent::Clock::now();
        sink_->add(event_);
    }

    // The event, to be filled in. Null: there is no sink.
    TraceEvent* event() noexcept { return sink_ ? &event_ : nullptr; }

private:
    TraceSink* const sink_;
    TraceEvent event_;
};

} // namespace detail
DFB_NAMESPACE_END
