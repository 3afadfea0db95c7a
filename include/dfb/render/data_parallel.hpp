// The data-parallel rendering loop (Listing 3 of the paper): each rank renders its bricks wherever they project.
#pragma once

#include <dfb/frame.hpp>
#include <dfb/render/tile_loop.hpp>
#include <dfb/render/visibility.hpp>
#include <dfb/render/world.hpp>

#include <cstddef>
#include <vector>

namespace dfb {

// Renders all bricks of `world` into the tiles that they may project to, and returns the frame, which is to be ended;
// every brick must be in the world of one rank only. `renderBrick(brick, tile)` is called from several threads at once,
// for each pass with its own tile.pass; it writes colour and depth of the pixels of tile.region that rays meet within
// brick.bounds into the cleared tile, depth growing away from the camera. Unlike in Listing 3 the owners do not count
// the bricks that project to their tiles: each rank declares what it will send, so the two can not disagree. Throws
// what FrameBuffer::begin() throws; an exception of renderBrick becomes a FrameError of Frame::end() on all ranks.
template <class FrameBuffer, class Camera, class RenderBrick>
[[nodiscard]] typename FrameBuffer::Frame startDataParallel(FrameBuffer& fb, const World& world, const Camera& camera,
                                                            const RenderBrick& renderBrick, FrameParams params = {},
                                                            const typename FrameBuffer::TileFrameData& tileData = {},
                                                            const typename FrameBuffer::PixelFrameData& pixelData = {})
{
    params.declared = true;
    auto frame = fb.begin(params, tileData, pixelData);
    frame.guard([&] {
        auto& work = detail::workOf<detail::OwnBricks>(frame);
        work.find(world, camera, fb.layout());
        frame.declare(work.inputs);
        const std::vector<BrickInTile>& pairs = work.pairs;
        const detail::PassJobs jobs(pairs.size(), [&](std::size_t i) { return frame.samples(pairs[i].tile).count; });
        detail::TileLoop<FrameBuffer, RenderBrick> loop(fb, frame);
        loop.run(static_cast<std::size_t>(jobs.count()), [&](std::size_t i, auto& tile) {
            const auto job = jobs.at(static_cast<std::int64_t>(i));
            const Brick& brick = world.bricks()[static_cast<std::size_t>(pairs[job.item].brick)];
            frame.start(tile, pairs[job.item].tile, job.pass);
            tile.generation = 1;
            tile.source = brick.id;
            renderBrick(brick, tile);
            frame.setTile(tile);
        });
    });
    return frame;
}

// Collective. The same, and ends the frame. Throws what Frame::end() throws.
template <class FrameBuffer, class Camera, class RenderBrick>
FrameReport renderDataParallel(FrameBuffer& fb, const World& world, const Camera& camera,
                               const RenderBrick& renderBrick, const FrameParams& params = {},
                               const typename FrameBuffer::TileFrameData& tileData = {},
                               const typename FrameBuffer::PixelFrameData& pixelData = {})
{
    return startDataParallel(fb, world, camera, renderBrick, params, tileData, pixelData).end();
}

} // namespace dfb
