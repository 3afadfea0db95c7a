// TilePipeline: the way of a tile on this rank (Figure 2 of the paper): input, tile operation, pixel operation,
// conversion, display rank.
#pragma once

#include <dfb/detail/final_gather.hpp>
#include <dfb/detail/float_environment.hpp>
#include <dfb/detail/tile_table.hpp>
#include <dfb/detail/wire.hpp>
#include <dfb/frame.hpp>
#include <dfb/ops/pixel_ops.hpp>

#include <algorithm>
#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <limits>
#include <memory>
#include <type_traits>
#include <utility>

namespace dfb::detail {

template <class TileOp, class PixelOp>
class TilePipeline {
public:
    using Tile = dfb::Tile<TileOp::channels, TileSizeOf<TileOp>::value>;

    // Throws InvalidArgument for a configuration that can not be.
    TilePipeline(std::shared_ptr<MemoryPool> pool, const FrameBufferConfig& config, PixelOp pixelOp, int rank,
                 int rankCount, std::uint32_t address, FinalGather::Send sendToDisplay)
        : pool_(std::move(pool)), config_(config), address_(address), pixelOp_(std::move(pixelOp)),
          table_(TileLayout(config.width, config.height, Tile::size), config.ownerMap ? config.ownerMap : latticeOwner,
                 rank, rankCount),
          gather_(pool_, table_.layout(),
                  {config.format, config.depth, address, config.codec, config.gather == GatherMode::AtEnd},
                  rank == config.displayRank, rank, rankCount, std::move(sendToDisplay))
    {
    }

    // The most that one message with pixels can have.
    static std::size_t largestMessage(const FrameBufferConfig& config)
    {
        return std::max(largestFragment(Tile::size),
                        FinalGather::largestMessage(Tile::size, config.format, config.depth));
    }

    TileTable<TileOp>& table() noexcept { return table_; }
    const TileTable<TileOp>& table() const noexcept { return table_; }
    FinalGather& gather() noexcept { return gather_; }
    const FinalGather& gather() const noexcept { return gather_; }

    // No other member may be running.
    void newFrame(const TileInfo& info, const typename FrameDataOf<TileOp>::type& tileData,
                  const typename FrameDataOf<PixelOp>::type& pixelData)
    {
        nonFinite_ = 0;
        gather_.newFrame(info.frame);
        table_.newFrame(info, tileData);
        if constexpr (HasPixelNewFrame<PixelOp>::value)
            pixelOp_.newFrame(pixelData);
        else
            (void)pixelData;
    }

    // Makes `tile` a cleared tile of this frame. Throws InvalidArgument.
    void start(Tile& tile, int index, int pass) const
    {
        const TileInfo& frame = table_.frameInfo();
        if (index < 0 || index >= table_.layout().tileCount())
            throw InvalidArgument("tile " + std::to_string(index) + " of an image of "
                                  + std::to_string(table_.layout().tileCount()) + " tiles");
        if (pass < 0 || pass >= frame.passes)
            throw InvalidArgument("pass " + std::to_string(pass) + " of a frame of " + std::to_string(frame.passes));
        static_cast<TileHeader&>(tile) = {frame.frame, index, table_.layout().region(index),          pass,
                                          0,           0,     static_cast<std::uint32_t>(frame.rank), 0};
        tile.clear();
    }

    // The message for a tile that has been checked; compressed only if it travels.
    Buffer encode(const Tile& tile)
    {
        const FloatEnvironment floatEnvironment;
        const auto wanted =
            static_cast<ChannelMask>(NeededChannelsOf<TileOp>::value | (config_.depth ? depthChannel : 0));
        std::uint64_t nonFinite = 0;
        Buffer message = encodeFragment(*pool_, tile, wanted, address_,
                                        table_.isMine(tile.tile) ? nullptr : config_.codec.get(), nonFinite);
        if (nonFinite)
            nonFinite_ += static_cast<std::int64_t>(nonFinite);
        return message;
    }

    // Takes an input. Returns the tile if its inputs are now complete: call finish() for it, once; else -1. `where`
    // gets what is known of the place when this throws Error.
    int arrive(Buffer&& message, ErrorInfo& where)
    {
        Fragment fragment =
            decodeFragment(*pool_, std::move(message), table_.layout(), table_.frameInfo().passes, config_.codec.get());
        const TileHeader& h = fragment.header();
        const int tile = h.tile;
        where.tile = tile;
        where.pass = h.pass;
        where.generation = h.generation;
        where.source = h.source;
        if (!table_.isMine(tile))
            failMalformed("an input for a tile of another owner");
        return table_.arrive(std::move(fragment)) ? tile : -1;
    }

    // Runs both operations on a complete tile and hands it on.
    void finish(int tile)
    {
        const FloatEnvironment floatEnvironment;
        const Region region = table_.layout().region(tile);
        if constexpr (std::is_same_v<PixelOp, NoPixelOp>) {
            auto place = gather_.reserve(tile);
            FinishedTile out(region, config_.format, place.color, place.colorStride, place.depth, place.depthStride);
            table_.finish(tile, out);
            gather_.commit(tile, std::move(place));
        } else {
            const auto width = static_cast<std::size_t>(region.width()),
                       height = static_cast<std::size_t>(region.height());
            Buffer color = pool_->acquire(width * height * 4 * sizeof(float));
            Buffer depth = config_.depth ? pool_->acquire(width * height * sizeof(float)) : Buffer();
            auto* depthData = reinterpret_cast<float*>(depth.data());
            FinishedTile out(region, OutputFormat::RGBA32F, color.data(), width * 4 * sizeof(float), depthData, width);
            table_.finish(tile, out);
            PixelTile pixels{tile, region, reinterpret_cast<float*>(color.data()), depthData};
            std::as_const(pixelOp_).process(pixels);
            auto place = gather_.reserve(tile);
            for (std::size_t y = 0; y < height && place.color; ++y) {
                convertPixels(pixels.color + 4 * width * y, region.width(), config_.format,
                              place.color + y * place.colorStride);
                if (place.depth)
                    std::copy_n(depthData + y * width, width, place.depth + y * place.depthStride);
            }
            gather_.commit(tile, std::move(place));
        }
    }

    // What the pixel operation makes of the background; throws what it throws.
    void finishBackground()
    {
        background_ = table_.frameInfo().background;
        if constexpr (IsPointwise<PixelOp>::value) {
            const float depth = std::numeric_limits<float>::infinity();
            PixelTile pixel{0, {0, 0, 1, 1}, background_.data(), config_.depth ? &depth : nullptr};
            std::as_const(pixelOp_).process(pixel);
        }
    }

    // On the display rank, when all tiles are there: fills in those that nobody touched.
    void fillBackground() { gather_.fillBackground(background_); }

    // Input pixels of this frame, set on this rank, that had an infinity or NaN.
    std::int64_t nonFinitePixels() const noexcept { return nonFinite_; }

private:
    std::shared_ptr<MemoryPool> pool_;
    const FrameBufferConfig& config_;
    std::uint32_t address_; // of the framebuffer
    PixelOp pixelOp_;
    TileTable<TileOp> table_;
    FinalGather gather_;
    std::array<float, 4> background_{};
    std::atomic<std::int64_t> nonFinite_{0};
};

} // namespace dfb::detail
