// The data-parallel rendering loop with deep fragments: bricks need not be convex, and may be interleaved (A before B
// before A along a ray).
#pragma once

#include <dfb/deep_tile.hpp>
#include <dfb/frame.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/render/tile_loop.hpp>
#include <dfb/render/visibility.hpp>
#include <dfb/render/world.hpp>

#include <cstddef>
#include <memory>
#include <mutex>
#include <utility>
#include <vector>

namespace dfb {

// Sorts segments, also those of one brick, and counts the pixels in which some overlap:
// FrameReport::orderUndefinedPixels.
template <int TileSize = 64>
using BasicDeepBlend = BasicAlphaBlend<TileSize, colorChannel | depthChannel | farChannel>;
using DeepBlend = BasicDeepBlend<>;

// As startDataParallel(), with the bounds of bricks enclosing what they have; they may overlap.
// `renderBrick(brick, deep)` adds the segments of the pixels of deep.header().region to the empty DeepTile, of which
// each pixel keeps `maxSegments` at most. FrameReport::mergeErrorBound is how much that may have changed a pixel. The
// first segments of a brick's pixels announce the others as children: a pixel with one costs what it costs without.
template <class FrameBuffer, class Camera, class RenderBrick>
[[nodiscard]] typename FrameBuffer::Frame startDeepParallel(FrameBuffer& fb, const World& world, const Camera& camera,
                                                            int maxSegments, const RenderBrick& renderBrick,
                                                            FrameParams params = {},
                                                            const typename FrameBuffer::TileFrameData& tileData = {},
                                                            const typename FrameBuffer::PixelFrameData& pixelData = {})
{
    if (maxSegments < 1 || maxSegments > 65535)
        throw InvalidArgument("a pixel has 1 to 65535 segments");
    params.declared = true;
    auto frame = fb.begin(params, tileData, pixelData);
    frame.guard([&] {
        auto& work = detail::workOf<detail::OwnBricks>(frame);
        work.find(world, camera, fb.layout());
        frame.declare(work.inputs);
        const std::vector<BrickInTile>& pairs = work.pairs;
        const detail::PassJobs jobs(pairs.size(), [&](std::size_t i) { return frame.samples(pairs[i].tile).count; });
        std::mutex mutex;
        std::vector<std::unique_ptr<DeepTile>> spare;
        detail::TileLoop<FrameBuffer, void> loop(fb, frame);
        loop.run(static_cast<std::size_t>(jobs.count()), [&](std::size_t i, auto& tile) {
            const auto job = jobs.at(static_cast<std::int64_t>(i));
            const Brick& brick = world.bricks()[static_cast<std::size_t>(pairs[job.item].brick)];
            std::unique_ptr<DeepTile> deep;
            {
                const std::lock_guard<std::mutex> lock(mutex);
                if (!spare.empty()) {
                    deep = std::move(spare.back());
                    spare.pop_back();
                }
            }
            if (!deep)
                deep = std::make_unique<DeepTile>(maxSegments);
            frame.start(tile, pairs[job.item].tile, job.pass);
            tile.generation = 1;
            tile.source = brick.id;
            deep->reset(tile);
            renderBrick(brick, *deep);
            const TileHeader header = tile;
            for (int layer = 0; layer == 0 || layer < deep->layers(); ++layer) {
                if (layer > 0)
                    tile.clear();
                static_cast<TileHeader&>(tile) = header;
                tile.generation = layer == 0 ? 1 : 2;
                tile.children = layer == 0 && deep->layers() > 1 ? deep->layers() - 1 : 0;
                tile.part = static_cast<std::uint16_t>(layer);
                deep->writeLayer(layer, tile);
                frame.setTile(tile);
            }
            if (deep->errorBound() > 0)
                frame.noteMergeError(tile.tile, deep->errorBound());
            const std::lock_guard<std::mutex> lock(mutex);
            spare.push_back(std::move(deep));
        });
    });
    return frame;
}

// Collective. The same, and ends the frame. Throws what Frame::end() throws.
template <class FrameBuffer, class Camera, class RenderBrick>
FrameReport renderDeepParallel(FrameBuffer& fb, const World& world, const Camera& camera, int maxSegments,
                               const RenderBrick& renderBrick, const FrameParams& params = {},
                               const typename FrameBuffer::TileFrameData& tileData = {},
                               const typename FrameBuffer::PixelFrameData& pixelData = {})
{
    return startDeepParallel(fb, world, camera, maxSegments, renderBrick, params, tileData, pixelData).end();
}

} // namespace dfb
