// The frames of a run, for each way of compositing.
#include "camera.hpp"
#include "run_config.hpp"
#include "run_frames.hpp"

#include <dfb/dfb.hpp>
#include <dfb/testing/verified.hpp>

#include <algorithm>
#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <type_traits>
#include <utility>
#include <vector>

namespace example {

namespace {

using OrderedOp = dfb::BasicOrderedBlend<64, tileChannels>;
using ToneMapToWall = dfb::PixelOpChain<dfb::ToneMap, dfb::ToWall>;

enum class LoopOver { Tiles, Bricks, BricksInOrder, DeepBricks };

// Frames with given tile and pixel operations.
template <LoopOver loopOver, class TileOp, class PixelOp>
class FramesBy final : public RunFrames {
    // It is made over a connection, so this transport need not be that of the connection.
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, PixelOp, dfb::InprocTransport>;
    static constexpr bool hasWall = std::is_same_v<PixelOp, dfb::ToWall> || std::is_same_v<PixelOp, ToneMapToWall>;

public:
    FramesBy(std::shared_ptr<dfb::Connection> connection, const Options& o, dfb::FrameBufferConfig config,
             dfb::testing::Verification& verification)
        : o_(o), verification_(verification)
    {
        PixelOp pixelOp{};
        if constexpr (hasWall) {
            // No rank has the whole image of a wall.
            const auto format = wantsFloat(o) ? dfb::OutputFormat::RGBA32F : dfb::OutputFormat::SRGBA8;
            wall_ =
                std::make_unique<dfb::DisplayWall>(connection, wallOf(o, connection->size()), format, config.executor);
            if constexpr (std::is_same_v<PixelOp, dfb::ToWall>)
                pixelOp.wall = wall_.get();
            else
                pixelOp.second.wall = wall_.get();
            config.image.format = dfb::OutputFormat::None;
        }
        try {
            fb_ = std::make_unique<FrameBuffer>(connection, config, pixelOp);
        } catch (const dfb::InvalidArgument&) {
            wall_.reset(); // destroyed before the exception leaves, in order; all ranks throw it
            throw;
        }
    }

    dfb::FrameBufferBase& framebuffer() override { return *fb_; }
    const dfb::DisplayWall* wall() const override { return wall_.get(); }

    void start(int frame, const RankWork& work, const dfb::FrameConfig& params) override
    {
        open_.push_back(render(frame, work, params));
    }
    int openCount() const override { return static_cast<int>(open_.size()); }
    dfb::FrameBase& oldest() override { return open_.front(); }

    dfb::FrameReport end() override
    {
        const dfb::FrameReport report = open_.front().end();
        open_.pop_front();
        if constexpr (hasWall)
            wall_->finish(report.frame);
        if (loopByCost_ && !isAdaptive(compositingOf(o_)))
            byCost_.update(report);
        return report;
    }
    void leaveAll() override { open_.clear(); }

private:
    // The loop, made for the first frame.
    template <class Loop, class... Arguments>
    static Loop& once(std::optional<Loop>& loop, Arguments&&... arguments)
    {
        return loop ? *loop : loop.emplace(std::forward<Arguments>(arguments)...);
    }

    typename FrameBuffer::Frame render(int frame, const RankWork& work, const dfb::FrameConfig& params)
    {
        const RankScene& scene = *work.scene;
        const FrameCamera camera = frameCamera(scene.info, work.settings, frame);
        typename FrameBuffer::PixelFrameData pixelData{};
        if constexpr (std::is_same_v<PixelOp, dfb::ToneMap>)
            pixelData.exposure = o_.exposure;
        if constexpr (std::is_same_v<PixelOp, ToneMapToWall>)
            pixelData.first.exposure = o_.exposure;
        typename FrameBuffer::TileFrameData tileData{};
        if constexpr (std::is_same_v<decltype(tileData), dfb::testing::Verification*>)
            tileData = &verification_;
        if constexpr (loopOver == LoopOver::DeepBricks) {
            return once(deepLoop_, *fb_, work.world, std::max(1, o_.deep))
                .start(
                    camera,
                    [&](const dfb::Brick& brick, dfb::DeepTile& deep) {
                        std::int64_t cost = 0;
                        for (const Renderer& cell : scene.of(brick.id))
                            cost += cell.renderDeep(deep, frame);
                        work.tileDone(cost);
                    },
                    params, tileData, pixelData);
        } else if constexpr (loopOver == LoopOver::Tiles) {
            const auto distribution = o_.distribution == Distribution::Linear       ? dfb::WorkDistribution::Linear
                                      : o_.distribution == Distribution::RoundRobin ? dfb::WorkDistribution::RoundRobin
                                      : o_.distribution == Distribution::Dynamic    ? dfb::WorkDistribution::Dynamic
                                                                                    : dfb::WorkDistribution::Owned;
            return once(imageLoop_, *fb_, distribution)
                .start([&](auto& tile) { work.tileDone(scene.renderers.front().front().renderTile(tile, frame)); },
                       params, tileData, pixelData);
        } else {
            const auto renderBrick = [&](const dfb::Brick& brick, auto& tile) {
                const std::int64_t cost = scene.of(brick.id).front().renderTile(tile, frame);
                work.tileDone(cost);
                return static_cast<double>(cost);
            };
            if constexpr (loopOver == LoopOver::BricksInOrder) {
                const std::vector<int> order = dfb::visibilityOrder(*work.shared, camera.pinhole().eye());
                return once(orderedLoop_, *fb_, *work.shared, inTurn_)
                    .start(camera, order, renderBrick, params, tileData, pixelData);
            } else if (o_.mode == Mode::Data) {
                return once(dataLoop_, *fb_, work.world, *work.shared)
                    .start(camera, renderBrick, params, tileData, pixelData);
            } else if (o_.balance == Balance::Cost) {
                return once(loopByCost_, *fb_, *work.shared, byCost_)
                    .start(camera, renderBrick, params, tileData, pixelData);
            } else {
                return once(loopInTurn_, *fb_, *work.shared, inTurn_)
                    .start(camera, renderBrick, params, tileData, pixelData);
            }
        }
    }

    const Options& o_;
    dfb::testing::Verification& verification_;
    std::unique_ptr<dfb::DisplayWall> wall_; // outlives the framebuffer that sends to it
    std::unique_ptr<FrameBuffer> fb_;
    dfb::MeasuredCostBricks byCost_;
    dfb::RoundRobinBricks inTurn_;
    std::optional<dfb::DataParallelLoop<FrameBuffer>> dataLoop_;
    std::optional<dfb::DeepParallelLoop<FrameBuffer>> deepLoop_;
    std::optional<dfb::ImageParallelLoop<FrameBuffer>> imageLoop_;
    std::optional<dfb::MixedParallelLoop<FrameBuffer, dfb::MeasuredCostBricks>> loopByCost_;
    std::optional<dfb::MixedParallelLoop<FrameBuffer, dfb::RoundRobinBricks>> loopInTurn_;
    std::optional<dfb::OrderedLoop<FrameBuffer, dfb::RoundRobinBricks>> orderedLoop_;
    std::deque<typename FrameBuffer::Frame> open_;
};

// Frames with these operations.
template <LoopOver loopOver, class TileOp, class PixelOp = dfb::NoPixelOp>
std::unique_ptr<RunFrames> framesBy(std::shared_ptr<dfb::Connection> connection, const Options& options,
                                    const dfb::FrameBufferConfig& config, dfb::testing::Verification& verification)
{
    return std::make_unique<FramesBy<loopOver, TileOp, PixelOp>>(std::move(connection), options, config, verification);
}

// Also with the pixel operations that the options ask for.
template <LoopOver loopOver, class TileOp>
std::unique_ptr<RunFrames> framesWithPixelOp(std::shared_ptr<dfb::Connection> connection, const Options& options,
                                             const dfb::FrameBufferConfig& config,
                                             dfb::testing::Verification& verification)
{
    const bool hasWall = options.wallColumns > 0, hasToneMap = options.exposure > 0;
    const auto make = hasWall && hasToneMap ? framesBy<loopOver, TileOp, ToneMapToWall>
                      : hasWall             ? framesBy<loopOver, TileOp, dfb::ToWall>
                      : hasToneMap          ? framesBy<loopOver, TileOp, dfb::ToneMap>
                                            : framesBy<loopOver, TileOp, dfb::NoPixelOp>;
    return make(std::move(connection), options, config, verification);
}

} // namespace

std::unique_ptr<RunFrames> makeFrames(std::shared_ptr<dfb::Connection> connection, const Options& options,
                                      const dfb::FrameBufferConfig& config, dfb::testing::Verification& verification)
{
    constexpr LoopOver tiles = LoopOver::Tiles, bricks = LoopOver::Bricks;
    const auto make = [&](auto function) { return function(std::move(connection), options, config, verification); };
    switch (compositingOf(options)) { // adaptive: samples are saved tile by tile, so smaller tiles save more
    case Compositing::Single: return make(framesWithPixelOp<tiles, SingleOp>);
    case Compositing::SingleVerified: return make(framesBy<tiles, dfb::testing::Verified<SingleOp>>);
    case Compositing::SingleAdaptive:
        return make(framesBy<tiles, dfb::Progressive<dfb::BasicImageParallel<16, tileChannels>>>);
    case Compositing::SortVerified: return make(framesBy<bricks, dfb::testing::Verified<BlendOp>>);
    case Compositing::SortAdaptive:
        return make(framesBy<bricks, dfb::Progressive<dfb::BasicAlphaBlend<16, tileChannels>>>);
    case Compositing::Order: return make(framesBy<LoopOver::BricksInOrder, OrderedOp>);
    case Compositing::Nearest: return make(framesBy<bricks, dfb::BasicDepthComposite<64, tileChannels>>);
    case Compositing::Deep: return make(framesBy<LoopOver::DeepBricks, dfb::DeepBlend>);
    case Compositing::Sort: break;
    }
    return make(framesWithPixelOp<bricks, BlendOp>);
}

} // namespace example
