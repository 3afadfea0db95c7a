// DataParallelLoop (Listing 3 of the paper): each rank renders its bricks wherever they project.
#pragma once

#include <dfb/frame.hpp>
#include <dfb/render/tile_loop.hpp>
#include <dfb/render/visibility.hpp>
#include <dfb/render/world.hpp>

#include <cstddef>
#include <cstdint>
#include <vector>

namespace dfb {

namespace detail {

// What there is to do for a rank that renders its own bricks, and what it declares.
class OwnBricks {
public:
    // Calls job(brick, tile) for each brick, tile and pass, with a tile that has been started for them.
    template <class Render, class FrameBuffer, class Camera, class Job>
    void forEach(FrameBuffer& fb, typename FrameBuffer::Frame& frame, const World& world, const Camera& camera,
                 const Job& job)
    {
        frame.guard([&] {
            findVisibleTiles(world, camera, fb.layout(), pairs_);
            findInputs(world, pairs_, inputs_);
            frame.declare(inputs_);
            jobs_.find(pairs_.size(), [&](std::size_t i) { return frame.samples(pairs_[i].tile).count; });
            forEachTile<Render>(fb, frame, jobs_.count(), [&](std::int64_t i, auto& tile) {
                const auto [item, pass] = jobs_.at(i);
                const Brick& brick = world.bricks()[static_cast<std::size_t>(pairs_[item].brick)];
                frame.start(tile, pairs_[item].tile, pass);
                tile.generation = 1;
                tile.source = brick.id;
                job(brick, tile);
            });
        });
    }

private:
    std::vector<BrickInTile> pairs_;
    std::vector<TileInput> inputs_;
    PassJobs jobs_;
};

} // namespace detail

// One per rank, for any number of frames, which find its memory there; by one thread at a time. Framebuffer and world
// must outlive it; the world may change between frames. Every brick must be in the world of one rank only.
template <class FrameBuffer>
class DataParallelLoop {
public:
    DataParallelLoop(FrameBuffer& fb, const World& world) : fb_(fb), world_(world) {}

    // Renders all bricks of the world into the tiles that they may project to, and returns the frame, which is to be
    // ended. `renderBrick(brick, tile)` is called from several threads at once, for each pass with its own tile.pass;
    // it writes colour and depth of the pixels of tile.region that rays meet within brick.bounds into the cleared tile,
    // depth growing away from the camera. Unlike in Listing 3 the owners do not count the bricks that project to their
    // tiles: each rank declares what it will send, so the two can not disagree. Throws what FrameBuffer::begin()
    // throws; an exception of renderBrick becomes a FrameError of Frame::end() on all ranks.
    template <class Camera, class RenderBrick>
    [[nodiscard]] typename FrameBuffer::Frame start(const Camera& camera, const RenderBrick& renderBrick,
                                                    FrameParams params = {},
                                                    const typename FrameBuffer::TileFrameData& tileData = {},
                                                    const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        params.declared = true;
        auto frame = fb_.begin(params, tileData, pixelData);
        bricks_.template forEach<RenderBrick>(fb_, frame, world_, camera, [&](const Brick& brick, auto& tile) {
            renderBrick(brick, tile);
            frame.setTile(tile);
        });
        return frame;
    }

    // Collective. The same, and ends the frame. Throws what Frame::end() throws.
    template <class Camera, class RenderBrick>
    FrameReport render(const Camera& camera, const RenderBrick& renderBrick, const FrameParams& params = {},
                       const typename FrameBuffer::TileFrameData& tileData = {},
                       const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        return start(camera, renderBrick, params, tileData, pixelData).end();
    }

private:
    FrameBuffer& fb_;
    const World& world_;
    detail::OwnBricks bricks_;
};

} // namespace dfb
