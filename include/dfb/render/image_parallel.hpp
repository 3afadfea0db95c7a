// The image-parallel rendering loop (Listing 2 of the paper): all ranks have the scene, each tile and pass is
// rendered by one of them.
#pragma once

#include <dfb/frame.hpp>
#include <dfb/render/tile_loop.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <numeric>
#include <vector>

namespace dfb {

// Which rank renders what (section 4.1.1 of the paper). Passes are dealt out like tiles, so a tile that needs many
// samples is rendered by many ranks; the image does not depend on who renders what.
enum class WorkDistribution : std::uint8_t {
    Owned,      // a rank renders the tiles that it owns: no input travels
    Linear,     // equal contiguous shares in the order of tiles
    RoundRobin, // dealt out one by one
    Dynamic     // one half dealt out evenly, the other handed out on demand, in shares that shrink
};

namespace detail {

// The multiples of it, modulo `count`, are all numbers below that, and any few in a row are spread evenly: neighbours
// in an image cost alike, so who gets some of these gets a fair share.
inline std::int64_t scatteringStride(std::int64_t count)
{
    auto stride = static_cast<std::int64_t>(0.6180339887498949 * static_cast<double>(count)); // the golden section
    while (stride > 1 && std::gcd(stride, count) != 1)
        --stride;
    return std::max<std::int64_t>(stride, 1);
}

} // namespace detail

// Renders the tiles in `assigned` (over all ranks: each tile of the image once) with `renderTile` and returns the
// frame, which is to be ended. `renderTile(tile)` is called from several threads at once, for each pass with its own
// tile.pass and tile.sample; it writes the pixels of tile.region into the cleared tile. Throws what
// FrameBuffer::begin() throws; an exception of renderTile becomes a FrameError of Frame::end() on all ranks.
template <class FrameBuffer, class RenderTile>
[[nodiscard]] typename FrameBuffer::Frame startImageParallel(FrameBuffer& fb, const std::vector<int>& assigned,
                                                             const RenderTile& renderTile, FrameParams params = {},
                                                             const typename FrameBuffer::TileFrameData& tileData = {},
                                                             const typename FrameBuffer::PixelFrameData& pixelData = {})
{
    params.declared = false;
    params.maxLayers = 1;
    auto frame = fb.begin(params, tileData, pixelData);
    const detail::PassJobs jobs(assigned.size(), [&](std::size_t i) { return frame.samples(assigned[i]).count; });
    detail::TileLoop<FrameBuffer, RenderTile> loop(fb, frame);
    loop.run(static_cast<std::size_t>(jobs.count()), [&](std::size_t i, auto& tile) {
        const auto job = jobs.at(static_cast<std::int64_t>(i));
        frame.start(tile, assigned[job.item], job.pass);
        renderTile(tile);
        frame.setTile(tile);
    });
    return frame;
}

// The same, the tiles and passes distributed in one of these ways, the same on all ranks. Collective with
// WorkDistribution::Dynamic.
template <class FrameBuffer, class RenderTile>
[[nodiscard]] typename FrameBuffer::Frame startImageParallel(FrameBuffer& fb, WorkDistribution distribution,
                                                             const RenderTile& renderTile, FrameParams params = {},
                                                             const typename FrameBuffer::TileFrameData& tileData = {},
                                                             const typename FrameBuffer::PixelFrameData& pixelData = {})
{
    if (distribution == WorkDistribution::Owned)
        return startImageParallel(fb, fb.ownedTiles(), renderTile, params, tileData, pixelData);
    params.declared = false;
    params.maxLayers = 1;
    auto frame = fb.begin(params, tileData, pixelData);
    const detail::PassJobs jobs(static_cast<std::size_t>(fb.layout().tileCount()),
                                [&](std::size_t tile) { return frame.samples(static_cast<int>(tile)).count; });
    detail::TileLoop<FrameBuffer, RenderTile> loop(fb, frame);
    const auto render = [&](std::int64_t job, auto& tile) {
        const auto at = jobs.at(job);
        frame.start(tile, static_cast<int>(at.item), at.pass);
        renderTile(tile);
        frame.setTile(tile);
    };
    const std::int64_t count = jobs.count(), rank = fb.rank(), size = fb.size();
    // Jobs begin + i, each times `stride`.
    const auto renderRange = [&](std::int64_t begin, std::int64_t end, std::int64_t stride = 1) {
        loop.run(static_cast<std::size_t>(end - begin), [&](std::size_t i, auto& tile) {
            render((begin + static_cast<std::int64_t>(i)) * stride % count, tile);
        });
    };
    switch (distribution) {
    case WorkDistribution::Linear: renderRange(count * rank / size, count * (rank + 1) / size); break;
    case WorkDistribution::RoundRobin:
        loop.run(static_cast<std::size_t>((count - rank + size - 1) / size),
                 [&](std::size_t i, auto& tile) { render(rank + static_cast<std::int64_t>(i) * size, tile); });
        break;
    case WorkDistribution::Dynamic:
        frame.guard([&] {
            for (auto range = frame.nextJobs(count); range.begin < range.end && !frame.failed();
                 range = frame.nextJobs(count))
                renderRange(range.begin, range.end, detail::scatteringStride(count));
        });
        break;
    case WorkDistribution::Owned: break;
    }
    return frame;
}

// Collective. Renders the tiles of startImageParallel() and ends the frame. Throws what Frame::end() throws.
template <class FrameBuffer, class RenderTile>
FrameReport renderImageParallel(FrameBuffer& fb, const std::vector<int>& assigned, const RenderTile& renderTile,
                                const FrameParams& params = {},
                                const typename FrameBuffer::TileFrameData& tileData = {},
                                const typename FrameBuffer::PixelFrameData& pixelData = {})
{
    return startImageParallel(fb, assigned, renderTile, params, tileData, pixelData).end();
}

template <class FrameBuffer, class RenderTile>
FrameReport renderImageParallel(FrameBuffer& fb, WorkDistribution distribution, const RenderTile& renderTile,
                                const FrameParams& params = {},
                                const typename FrameBuffer::TileFrameData& tileData = {},
                                const typename FrameBuffer::PixelFrameData& pixelData = {})
{
    return startImageParallel(fb, distribution, renderTile, params, tileData, pixelData).end();
}

// The same, each rank rendering the tiles that it owns.
template <class FrameBuffer, class RenderTile>
FrameReport renderImageParallel(FrameBuffer& fb, const RenderTile& renderTile, const FrameParams& params = {},
                                const typename FrameBuffer::TileFrameData& tileData = {},
                                const typename FrameBuffer::PixelFrameData& pixelData = {})
{
    return renderImageParallel(fb, WorkDistribution::Owned, renderTile, params, tileData, pixelData);
}

} // namespace dfb
