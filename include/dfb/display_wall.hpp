// DisplayWall: sends finished tiles from their owners straight to the ranks that drive the displays (section 4.4 of the
// paper). The framebuffer's own image format is None: a rank gets the pixels of its own displays only.
#pragma once

#include <dfb/comm/connection.hpp>
#include <dfb/compiled.hpp>
#include <dfb/frame.hpp>
#include <dfb/image.hpp>
#include <dfb/pixel_op.hpp>
#include <dfb/tile_layout.hpp>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>

DFB_NAMESPACE_BEGIN

namespace detail {
class Wall; // gather/wall.hpp
}

class DisplayWall;

// The pixel operation that sends tiles to a wall. Works after every tile operation, and as the last of a PixelOpChain.
struct ToWall {
    DisplayWall* wall = nullptr; // must outlive the framebuffer

    void newFrame(const NoFrameData&);
    void process(PixelTile& tile) const;
};

// One object per rank, over the connection that the framebuffer uses as well:
//
//   auto connection = dfb::connect<dfb::MpiTransport>(communicator);
//   dfb::DisplayWall wall(connection, layout, dfb::OutputFormat::SRGBA8);
//   dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::ToWall> fb(connection, wall.frameBufferConfig(), {&wall});
//   dfb::DataParallelLoop loop(fb, world);
//   const auto report = loop.render(...);
//   wall.finish(report.frame);
//   ... wall.image(display) on the rank that drives it
//
// Memory: for each display that it drives, a rank has the image that is shown, and an image for each unfinished frame
// of which parts have come (16 at most). The constructor allocates two images for each display. If a later one cannot
// be allocated, the connection fails. At most `poolBytes` are on the way to such a rank. A frame without finish() keeps
// some bytes on every rank until the next finish().
class DisplayWall {
public:
    // Makes a wall whose displays show images in `format`. `executor` runs its work; null: threads of its own, beside
    // those of the framebuffers. `poolBytes`: as MessageConfig::poolBytes. Collective, in the same order as the
    // framebuffers of the connection. Waits for all ranks. Throws InvalidArgument on all ranks if the layout is wrong,
    // if `layout`, `format` or `poolBytes` differ between ranks, or if a rank lacks memory. Throws TransportError.
    DisplayWall(std::shared_ptr<Connection> connection, const WallLayout& layout, OutputFormat format,
                std::shared_ptr<Executor> executor = {}, std::size_t poolBytes = std::size_t{64} << 20);

    DisplayWall(const DisplayWall&) = delete;
    DisplayWall& operator=(const DisplayWall&) = delete;
    // Collective. Destroy the framebuffers that send to it first. Whoever releases the connection last waits for all
    // ranks.
    ~DisplayWall();

    const WallLayout& layout() const noexcept { return layout_; }

    // The configuration of a framebuffer of the wall's size, whose image goes to the wall only. Any thread.
    FrameBufferConfig frameBufferConfig() const { return {layout_.width(), layout_.height(), OutputFormat::None}; }

    // Waits until all displays have frame number `frame`, so that all can show it now. Collective. Call it once, after
    // the frame has ended, in the order of the frames. A frame may be left out. A display's rank keeps parts of 16
    // frames at most, and drops the oldest if later ones come. All frames of a wall must be of one framebuffer, before
    // its resize(). Waits for all ranks to call it, whatever `timeout` is. Throws Error, the same on all ranks.
    // TimedOut: a display has not got the whole frame within `timeout` (0: no limit). MissingInput: the ranks have not
    // sent all of it, because it failed or was partial, or a display has dropped it. MalformedMessage: a part of it
    // cannot be right. The displays then keep their picture. Throws TransportError if the connection fails. Throws
    // InvalidArgument, on this rank alone, on a thread that may not call MPI, or for a frame that is not later than the
    // last or that no rank can have begun. A number that is too large by at most 16 is not noticed: the frames before
    // it can then no longer be finished.
    void finish(std::int64_t frame, std::chrono::milliseconds timeout = std::chrono::milliseconds(0));

    // The image of a display of this rank: the last frame that was finished well, until the next one is. Empty before
    // the first. Only the thread that calls finish() may call it. Throws InvalidArgument if another rank drives the
    // display.
    const Image& image(int display) const;

    // The number of the frame that all displays show, as in FrameReport::frame; -1 before the first. Only the thread
    // that calls finish() may call it.
    std::int64_t imageFrame() const noexcept;

private:
    friend struct ToWall;

    WallLayout layout_;
    std::unique_ptr<detail::Wall> wall_;
};

static_assert(is_pixel_op_v<ToWall>);

DFB_NAMESPACE_END

#if DFB_HAS_BODIES
#include <dfb/gather/wall.hpp>

#include <utility>

DFB_NAMESPACE_BEGIN

DFB_COMPILED_ONCE DisplayWall::DisplayWall(std::shared_ptr<Connection> connection, const WallLayout& layout,
                                           OutputFormat format, std::shared_ptr<Executor> executor,
                                           std::size_t poolBytes)
{
    connection->giveUpWithoutMemory([&] {
        layout_ = layout;
        wall_ = std::make_unique<detail::Wall>(connection, layout, format, std::move(executor), poolBytes);
    });
}
DFB_COMPILED_ONCE DisplayWall::~DisplayWall() = default;

DFB_COMPILED_ONCE void DisplayWall::finish(std::int64_t frame, std::chrono::milliseconds timeout)
{
    wall_->finish(frame, timeout);
}
DFB_COMPILED_ONCE const Image& DisplayWall::image(int display) const { return wall_->image(display); }
DFB_COMPILED_ONCE std::int64_t DisplayWall::imageFrame() const noexcept { return wall_->imageFrame(); }

DFB_COMPILED_ONCE void ToWall::newFrame(const NoFrameData&)
{
    if (!wall)
        detail::failArgument("ToWall without a DisplayWall");
    wall->wall_->begin();
}
DFB_COMPILED_ONCE void ToWall::process(PixelTile& tile) const { wall->wall_->put(tile); }

DFB_NAMESPACE_END
#endif
