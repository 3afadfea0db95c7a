// The image-parallel rendering loop (Listing 2 of the paper): all ranks have the scene, each tile is rendered by
// one of them.
#pragma once

#include <dfb/render/tile_loop.hpp>

#include <cstddef>
#include <vector>

namespace dfb {

// Collective. Renders the tiles in `assigned` (over all ranks: each tile of the image once) with `renderTile` and ends
// the frame. `renderTile(tile)` is called from several threads at once, for each pass with its own tile.pass; it
// writes the pixels of tile.region into the cleared tile. Throws what Frame::end() throws; an exception of renderTile
// becomes a FrameError on all ranks.
template <class FrameBuffer, class RenderTile>
FrameReport renderImageParallel(FrameBuffer& fb, const std::vector<int>& assigned, const RenderTile& renderTile,
                                FrameParams params = {}, const typename FrameBuffer::TileFrameData& tileData = {},
                                const typename FrameBuffer::PixelFrameData& pixelData = {})
{
    params.declared = false;
    params.declarationKey = 0;
    auto frame = fb.begin(params, tileData, pixelData);
    const auto passes = static_cast<std::size_t>(params.passes);
    return detail::runTileJobs(fb, frame, assigned.size() * passes, [&](std::size_t i, auto& tile) {
        frame.start(tile, assigned[i / passes], static_cast<int>(i % passes));
        renderTile(tile);
        frame.setTile(tile);
    });
}

// The same, each rank rendering the tiles that it owns: no input travels.
template <class FrameBuffer, class RenderTile>
FrameReport renderImageParallel(FrameBuffer& fb, const RenderTile& renderTile, const FrameParams& params = {},
                                const typename FrameBuffer::TileFrameData& tileData = {},
                                const typename FrameBuffer::PixelFrameData& pixelData = {})
{
    return renderImageParallel(fb, fb.ownedTiles(), renderTile, params, tileData, pixelData);
}

} // namespace dfb
