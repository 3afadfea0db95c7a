// TileLoop: what the rendering loops have in common: tiles to render into, a job per tile and pass on all
// workers, and the end of a frame in which a renderer may have thrown.
#pragma once

#include <dfb/frame.hpp>

#include <cstddef>
#include <exception>
#include <memory>
#include <mutex>
#include <utility>
#include <vector>

namespace dfb::detail {

// Calls job(i, tile) for i in [0, count) on the framebuffer's executor, each with a tile of its own, then ends the
// frame. An exception of a job makes the frame fail on all ranks. Throws what Frame::end() throws.
template <class FrameBuffer, class Job>
FrameReport runTileJobs(FrameBuffer& fb, typename FrameBuffer::Frame& frame, std::size_t count, const Job& job)
{
    using Tile = typename FrameBuffer::Tile;
    std::mutex mutex;
    std::vector<std::unique_ptr<Tile>> spare;
    try {
        fb.executor().parallelFor(count, [&](std::size_t i) {
            if (frame.failed())
                return;
            // Not one per thread: a renderer that waits inside a job may be given another job on the same thread.
            std::unique_ptr<Tile> tile;
            {
                const std::lock_guard<std::mutex> lock(mutex);
                if (!spare.empty()) {
                    tile = std::move(spare.back());
                    spare.pop_back();
                }
            }
            if (!tile)
                tile.reset(new Tile); // start() clears it
            job(i, *tile);
            const std::lock_guard<std::mutex> lock(mutex);
            spare.push_back(std::move(tile));
        });
    } catch (...) {
        frame.abort(std::current_exception());
    }
    return frame.end();
}

} // namespace dfb::detail
