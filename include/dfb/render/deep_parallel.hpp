// DeepParallelLoop: data-parallel rendering with deep fragments: bricks need not be convex, and may be interleaved (A
// before B before A along a ray).
#pragma once

#include <dfb/deep_tile.hpp>
#include <dfb/frame.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/render/data_parallel.hpp>
#include <dfb/render/world.hpp>

#include <cstdint>
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

// As DataParallelLoop, with bricks that may overlap: their bounds enclose what they have.
template <class FrameBuffer>
class DeepParallelLoop {
public:
    // Each pixel of a brick keeps `maxSegments` at most. Throws InvalidArgument if they are not 1 to 65535.
    DeepParallelLoop(FrameBuffer& fb, const World& world, int maxSegments)
        : fb_(fb), world_(world), maxSegments_(maxSegments)
    {
        if (maxSegments < 1 || maxSegments > 65535)
            throw InvalidArgument("a pixel has 1 to 65535 segments");
    }

    // As DataParallelLoop::start(), but `renderBrick(brick, deep)` adds the segments of the pixels of
    // deep.header().region to the empty DeepTile. FrameReport::mergeErrorBound is how much merging what is too many may
    // have changed a pixel. The first segments of a brick's pixels announce the others as children: a pixel with one
    // costs what it costs without.
    template <class Camera, class RenderBrick>
    [[nodiscard]] typename FrameBuffer::Frame start(const Camera& camera, const RenderBrick& renderBrick,
                                                    FrameParams params = {},
                                                    const typename FrameBuffer::TileFrameData& tileData = {},
                                                    const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        params.declared = true;
        auto frame = fb_.begin(params, tileData, pixelData);
        bricks_.template forEach<void>(fb_, frame, world_, camera, [&](const Brick& brick, auto& tile) {
            std::unique_ptr<DeepTile> deep = takeSpare();
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
            const std::lock_guard<std::mutex> lock(mutex_);
            spare_.push_back(std::move(deep));
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
    std::unique_ptr<DeepTile> takeSpare()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (spare_.empty())
            return std::make_unique<DeepTile>(maxSegments_);
        std::unique_ptr<DeepTile> deep = std::move(spare_.back());
        spare_.pop_back();
        return deep;
    }

    FrameBuffer& fb_;
    const World& world_;
    int maxSegments_;
    detail::OwnBricks bricks_;
    std::mutex mutex_;
    std::vector<std::unique_ptr<DeepTile>> spare_;
};

} // namespace dfb
