// ImageParallelLoop (Listing 2 of the paper): all ranks have the scene, each tile and pass is rendered by one of
// them.
#pragma once

#include <dfb/frame.hpp>
#include <dfb/render/tile_loop.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <numeric>
#include <utility>
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

// One per rank, for any number of frames, which find its memory there; by one thread at a time. The framebuffer must
// outlive it.
template <class FrameBuffer>
class ImageParallelLoop {
public:
    // The distribution must be the same on all ranks.
    explicit ImageParallelLoop(FrameBuffer& fb, WorkDistribution distribution = WorkDistribution::Owned)
        : fb_(fb), distribution_(distribution), tiles_(fb.ownedTiles())
    {
    }

    // This rank renders these tiles, in this order; over all ranks each tile of the image is rendered once.
    ImageParallelLoop(FrameBuffer& fb, std::vector<int> tiles) : fb_(fb), tiles_(std::move(tiles)) {}

    // Renders this rank's share and returns the frame, which is to be ended; collective with WorkDistribution::Dynamic.
    // `renderTile(tile)` is called from several threads at once, for each pass with its own tile.pass and tile.sample;
    // it writes the pixels of tile.region into the cleared tile. Throws what FrameBuffer::begin() throws; an exception
    // of renderTile becomes a FrameError of Frame::end() on all ranks.
    template <class RenderTile>
    [[nodiscard]] typename FrameBuffer::Frame start(const RenderTile& renderTile, FrameParams params = {},
                                                    const typename FrameBuffer::TileFrameData& tileData = {},
                                                    const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        params.declared = false;
        params.maxLayers = 1;
        auto frame = fb_.begin(params, tileData, pixelData);
        frame.guard([&] {
            const bool hasList = distribution_ == WorkDistribution::Owned;
            const auto tileOf = [&](std::size_t item) { return hasList ? tiles_[item] : static_cast<int>(item); };
            jobs_.find(hasList ? tiles_.size() : static_cast<std::size_t>(fb_.layout().tileCount()),
                       [&](std::size_t item) { return frame.samples(tileOf(item)).count; });
            const std::int64_t count = jobs_.count(), rank = fb_.rank(), size = fb_.size();
            // `number` jobs: first, first + step and so on, modulo all there are.
            const auto run = [&](std::int64_t first, std::int64_t number, std::int64_t step = 1) {
                detail::forEachTile<RenderTile>(fb_, frame, number, [&](std::int64_t i, auto& tile) {
                    const auto [item, pass] = jobs_.at((first + i * step) % count);
                    frame.start(tile, tileOf(item), pass);
                    renderTile(tile);
                    frame.setTile(tile);
                });
            };
            switch (distribution_) {
            case WorkDistribution::Owned: run(0, count); break;
            case WorkDistribution::Linear:
                run(count * rank / size, count * (rank + 1) / size - count * rank / size);
                break;
            case WorkDistribution::RoundRobin: run(rank, (count - rank + size - 1) / size, size); break;
            case WorkDistribution::Dynamic: {
                const std::int64_t stride = detail::scatteringStride(count);
                for (auto range = frame.nextJobs(count); range.begin < range.end && !frame.failed();
                     range = frame.nextJobs(count))
                    run(range.begin * stride, range.end - range.begin, stride);
                break;
            }
            }
        });
        return frame;
    }

    // Collective. The same, and ends the frame. Throws what Frame::end() throws.
    template <class RenderTile>
    FrameReport render(const RenderTile& renderTile, const FrameParams& params = {},
                       const typename FrameBuffer::TileFrameData& tileData = {},
                       const typename FrameBuffer::PixelFrameData& pixelData = {})
    {
        return start(renderTile, params, tileData, pixelData).end();
    }

private:
    FrameBuffer& fb_;
    WorkDistribution distribution_ = WorkDistribution::Owned;
    std::vector<int> tiles_; // with WorkDistribution::Owned: what this rank renders
    detail::PassJobs jobs_;
};

} // namespace dfb
