// DisplayWall: finished tiles straight from their owners to the ranks that drive the displays (section 4.4 of the
// paper). The framebuffer's own image format is None: no rank gets the pixels of another's displays.
#pragma once

#include <dfb/comm/connection.hpp>
#include <dfb/compiled.hpp>
#include <dfb/frame.hpp>
#include <dfb/image.hpp>
#include <dfb/pixel_op.hpp>
#include <dfb/tile_layout.hpp>

#include <cstddef>
#include <cstdint>
#include <memory>

namespace dfb {

namespace detail {
class Wall; // gather/wall.hpp
}

class DisplayWall;

// The pixel operation that sends tiles to a wall. Works after every tile operation, and as the last of a PixelOpChain.
struct ToWall {
    DisplayWall* wall = nullptr; // outlives the framebuffer

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
// Memory: on the ranks that drive displays two images of each, one that is shown and one that comes; on the way to them
// at most `poolBytes` each.
class DisplayWall {
public:
    // Collective, in the same order as the framebuffers of the connection. `format`: of the displays' images. Throws
    // InvalidArgument on all ranks if the layout is none, is not the same on all, or some rank has no memory for it.
    DisplayWall(std::shared_ptr<Connection> connection, const WallLayout& layout, OutputFormat format,
                std::shared_ptr<Executor> executor = {}, std::size_t poolBytes = std::size_t{64} << 20);

    DisplayWall(const DisplayWall&) = delete;
    DisplayWall& operator=(const DisplayWall&) = delete;
    // Collective. After the framebuffers whose pixel operation sends here.
    ~DisplayWall();

    const WallLayout& layout() const noexcept { return layout_; }

    // A configuration of the wall's size whose image goes nowhere else.
    FrameBufferConfig frameBufferConfig() const
    {
        FrameBufferConfig config;
        config.image.width = layout_.width();
        config.image.height = layout_.height();
        config.image.format = OutputFormat::None;
        return config;
    }

    // Collective, after the frame of that number has ended on all ranks: returns when all displays have it, which is
    // the moment to show it on all of them. Throws Error, the same on all ranks, if some display has not got all of it
    // within `timeout` (TimedOut; 0: no limit), if no rank has sent all of it, as of a frame that ended partial or
    // failed (MissingInput), or if a part of it, or of a later frame, was not to be believed (MalformedMessage). What
    // the displays show stays. Whatever the limit, waits for all ranks to call it, as
    // allReduce() does. Throws TransportError.
    void finish(std::int64_t frame, std::chrono::milliseconds timeout = std::chrono::milliseconds(0));

    // What this rank's display shows: the last frame that was finished well, which stays until the next one is. Empty
    // before the first. Throws InvalidArgument if another rank drives it. By the thread that calls finish(), as the
    // next.
    const Image& image(int display) const;

    // Which frame all displays show, as in FrameReport::frame; the same on all ranks. -1 before the first.
    std::int64_t imageFrame() const noexcept;

    // Called by ToWall, from any thread.
    void put(const PixelTile& tile);

private:
    WallLayout layout_;
    std::unique_ptr<detail::Wall> wall_;
};

inline void ToWall::process(PixelTile& tile) const { wall->put(tile); }

static_assert(is_pixel_op_v<ToWall>);

} // namespace dfb

#if DFB_HAS_BODIES
#include <dfb/gather/wall.hpp>

#include <utility>

namespace dfb {

DFB_COMPILED_ONCE DisplayWall::DisplayWall(std::shared_ptr<Connection> connection, const WallLayout& layout,
                                           OutputFormat format, std::shared_ptr<Executor> executor,
                                           std::size_t poolBytes)
    : layout_(layout),
      wall_(std::make_unique<detail::Wall>(std::move(connection), layout, format, std::move(executor), poolBytes))
{
}
DFB_COMPILED_ONCE DisplayWall::~DisplayWall() = default;

DFB_COMPILED_ONCE void DisplayWall::finish(std::int64_t frame, std::chrono::milliseconds timeout) { wall_->finish(frame, timeout); }
DFB_COMPILED_ONCE const Image& DisplayWall::image(int display) const { return wall_->image(display); }
DFB_COMPILED_ONCE std::int64_t DisplayWall::imageFrame() const noexcept { return wall_->imageFrame(); }
DFB_COMPILED_ONCE void DisplayWall::put(const PixelTile& tile) { wall_->put(tile); }

} // namespace dfb
#endif
