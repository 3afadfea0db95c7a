// RankRun: loads what a rank holds, renders the frames in the way that was asked for, and writes the files.
#pragma once

#include "options.hpp"
#include "output.hpp"
#include "progress_line.hpp"
#include "rank_scene.hpp"

#include <dfb/dfb.hpp>
#include <dfb/testing/verified.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <deque>
#include <exception>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace example {

// The tiles have all that the renderer can say; what no image has does not travel.
inline constexpr dfb::ChannelMask tileChannels = dfb::allChannels & ~dfb::farChannel;
using Blend = dfb::BasicAlphaBlend<64, tileChannels>;
using Single = dfb::BasicImageParallel<64, tileChannels>;
using Ordered = dfb::BasicOrderedBlend<64, tileChannels>;
using Nearest = dfb::BasicDepthComposite<64, tileChannels>;
// Samples are saved tile by tile: smaller tiles save more.
using AdaptiveBlend = dfb::Progressive<dfb::BasicAlphaBlend<16, tileChannels>>;
using AdaptiveSingle = dfb::Progressive<dfb::BasicImageParallel<16, tileChannels>>;

using VerifiedBlend = dfb::testing::Verified<Blend>;
using VerifiedSingle = dfb::testing::Verified<Single>;

template <class TileOp>
inline constexpr bool is_single_v =
    std::is_same_v<TileOp, Single> || std::is_same_v<TileOp, AdaptiveSingle> || std::is_same_v<TileOp, VerifiedSingle>;
template <class TileOp>
inline constexpr bool is_verified_v = std::is_same_v<TileOp, VerifiedBlend> || std::is_same_v<TileOp, VerifiedSingle>;
template <class TileOp>
inline constexpr bool is_adaptive_v = std::is_same_v<TileOp, AdaptiveBlend> || std::is_same_v<TileOp, AdaptiveSingle>;
template <class TileOp>
inline constexpr bool is_deep_v = (TileOp::channels & dfb::farChannel) != 0;

// Unless 8 bits per channel are all that is written. They lose too much to divide by alpha, as a PNG with alpha wants.
inline bool wantsFloat(const Options& o)
{
    return !o.stats.empty() || !o.alpha.empty() || (!o.output.empty() && !o.background)
           || detail::endingOf(o.output) == ".pfm";
}

inline dfb::FrameBufferConfig configOf(const Options& o, int threads)
{
    dfb::FrameBufferConfig config;
    config.width = o.width;
    config.height = o.height;
    config.format = wantsFloat(o)                                                         ? dfb::OutputFormat::RGBA32F
                    : !o.output.empty() || !o.depth.empty() || !o.aux.empty() || o.verify ? dfb::OutputFormat::SRGBA8
                                                                                          : dfb::OutputFormat::None;
    config.dither = o.dither;
    config.depth = !o.depth.empty();
    config.wire = o.errorBudget > 0 ? dfb::WirePrecision(dfb::ErrorBudget{o.errorBudget}) : dfb::WirePrecision(o.wire);
    config.wire.depth = o.wireDepth;
    config.minTransmittance = o.minTransmittance;
    config.framesInFlight = std::min(o.inFlight, o.frames);
    config.sharedMemory = o.sharedMemory;
    config.peerTimeoutMs = 1000 * o.peerTimeout;
    config.aux = o.aux.empty() ? 0 : dfb::imageAuxChannels;
    config.ownerMap = o.ownerMap == OwnerMap::Linear ? dfb::linearOwner
                      : o.ownerMap == OwnerMap::Hash ? dfb::hashOwner
                                                     : dfb::latticeOwner;
    if (o.compression == Compression::Auto)
        config.compression = dfb::CompressionMode::Auto;
    if (o.compression != Compression::None) {
#if defined(DFB_HAS_SNAPPY)
        config.codec = std::make_shared<dfb::SnappyCodec>();
#else
        throw std::runtime_error("this dfb_render was built without Snappy");
#endif
    }
#if defined(DFB_HAS_TBB)
    config.executor = std::make_shared<dfb::TbbExecutor>(threads);
#else
    config.executor = std::make_shared<dfb::ThreadExecutor>(threads);
#endif
    return config;
}

inline dfb::World worldOf(const RankScene& scene, const RenderSettings& settings)
{
    dfb::World world;
    const float ghosts = ghostReach(scene.info, settings);
    const auto box = [](const Box& b) { return dfb::Box3{{b.lo.x, b.lo.y, b.lo.z}, {b.hi.x, b.hi.y, b.hi.z}}; };
    for (const std::uint32_t id : scene.brickIds)
        world.add({id, box(scene.bounds[id]), box(scene.bounds[id].padded(ghosts))});
    return world;
}

// Layout of the wall that the options ask for; the image size is that of all displays and what the bezels hide.
inline dfb::WallLayout wallOf(const Options& o, int rankCount)
{
    dfb::WallLayout layout;
    layout.columns = o.wallColumns;
    layout.rows = o.wallRows;
    layout.bezelX = layout.bezelY = o.bezel;
    layout.displayWidth = (o.width - (o.wallColumns - 1) * o.bezel) / o.wallColumns;
    layout.displayHeight = (o.height - (o.wallRows - 1) * o.bezel) / o.wallRows;
    for (int d = 0; d < layout.displayCount(); ++d)
        layout.ranks.push_back(d % rankCount);
    return layout;
}

// image.png -> image.3.png
inline std::string numbered(const std::string& path, int number)
{
    const std::size_t dot = path.rfind('.');
    return path.substr(0, dot) + '.' + std::to_string(number) + path.substr(dot);
}

// A .pfm, or a .png that has alpha unless the image is opaque.
inline void writeImage(const std::string& path, const dfb::Image& image, bool isOpaque, bool dither)
{
    const int width = image.width(), height = image.height();
    if (image.format() != dfb::OutputFormat::RGBA32F) {
        writePng(path, width, height, image.rgba8(), false);
    } else if (detail::endingOf(path) == ".pfm") {
        writePfm(path, width, height, image.rgba32f());
    } else if (!isOpaque) {
        writePng(path, width, height, straightPixels(width, height, image.rgba32f(), dither).data(), true);
    } else {
        std::vector<std::byte> srgb(4 * image.pixelCount());
        for (int y = 0; y < height; ++y) {
            const std::size_t first = 4 * static_cast<std::size_t>(y) * static_cast<std::size_t>(width);
            if (dither)
                dfb::ditherPixels(image.rgba32f() + first, width, dfb::OutputFormat::SRGBA8, 0, y, srgb.data() + first);
            else
                dfb::convertPixels(image.rgba32f() + first, width, dfb::OutputFormat::SRGBA8, srgb.data() + first);
        }
        writePng(path, width, height, reinterpret_cast<const std::uint8_t*>(srgb.data()), false);
    }
}

inline void writeFiles(const Options& o, const dfb::Image& image, const RunStats& stats)
{
    if (!o.output.empty() && !image.empty())
        writeImage(o.output, image, o.background.has_value(), o.dither);
    if (!o.alpha.empty())
        writeGreyPfm(o.alpha, o.width, o.height, image.rgba32f() + 3, 4);
    if (!o.depth.empty())
        writeGreyPfm(o.depth, o.width, o.height, image.depth(), 1);
    if (!o.aux.empty()) {
        writeVectorPfm(o.aux + ".normal.pfm", o.width, o.height, image.normal());
        writeVectorPfm(o.aux + ".albedo.pfm", o.width, o.height, image.albedo());
        writeVectorPfm(o.aux + ".position.pfm", o.width, o.height, image.position());
        writeIdPng(o.aux + ".primitive.png", o.width, o.height, image.primitiveId());
        writeIdPng(o.aux + ".instance.png", o.width, o.height, image.instanceId());
    }
    if (!o.stats.empty())
        writeStats(o.stats, stats);
}

template <class TileOp, class PixelOp, class Transport>
class RankRun {
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, PixelOp, Transport>;
    using Reduce = typename FrameBuffer::Reduce;
    using Wall = dfb::DisplayWall<Transport>;
    using ToWall = dfb::ToWall<Transport>;
    using ToneMapToWall = dfb::PixelOpChain<dfb::ToneMap, ToWall>;
    static constexpr bool hasWall = std::is_same_v<PixelOp, ToWall> || std::is_same_v<PixelOp, ToneMapToWall>;

public:
    RankRun(const typename Transport::Communicator& communicator, const Options& o, int threads)
        : o_(o), messenger_(std::make_shared<dfb::Messenger<Transport>>(communicator))
    {
        dfb::FrameBufferConfig config = configOf(o, threads);
        PixelOp pixelOp{};
        if constexpr (hasWall) {
            // Of what a wall shows no rank has the whole.
            const auto format = wantsFloat(o) ? dfb::OutputFormat::RGBA32F : dfb::OutputFormat::SRGBA8;
            wall_ = std::make_unique<Wall>(messenger_, wallOf(o, messenger_->size()), format, config.executor);
            if constexpr (std::is_same_v<PixelOp, ToWall>)
                pixelOp.wall = wall_.get();
            else
                pixelOp.second.wall = wall_.get();
            config.format = dfb::OutputFormat::None;
        }
        try {
            fb_ = std::make_unique<FrameBuffer>(messenger_, config, pixelOp);
        } catch (const dfb::InvalidArgument&) {
            // All ranks throw it. A messenger that ends while an exception passes tells the others that it has failed.
            wall_.reset();
            messenger_.reset();
            throw;
        }
    }

    // The exit code, the same on all ranks.
    int run()
    {
        if (!onAllRanks([&] {
                if (fb_->isDisplayRank())
                    requireFilesWritable();
            }))
            return exitFailed;
        if (!onAllRanks([&] { load(); })) // collective: all ranks or none
            return exitFailed;
        settings_ = renderSettings(o_);
        params_.passes = o_.spp;
        params_.maxLayers = static_cast<int>(scene_->bounds.size()) * std::max(1, o_.deep);
        if (o_.background)
            params_.background = {(*o_.background)[0], (*o_.background)[1], (*o_.background)[2], 1.0f};
        const dfb::World world = worldOf(*scene_, settings_);
        if (o_.mode == Mode::Mixed || std::is_same_v<TileOp, Ordered>)
            shared_.emplace(*fb_, world);
        ProgressLine progress(fb_->isDisplayRank(), o_.frames);
        const auto begin = std::chrono::steady_clock::now();
        std::deque<typename FrameBuffer::Frame> open;
        for (int frame = 0; frame < o_.frames; ++frame) {
            progress.beginFrame(frame);
            tiles_ = work_ = 0;
            if constexpr (is_adaptive_v<TileOp>) {
                reports_.push_back(renderAdaptively(frame, world, progress));
            } else {
                if (static_cast<int>(open.size()) == fb_->config().framesInFlight)
                    endFirst(open);
                open.push_back(startFrame(frame, world, params_, progress));
            }
            rendered_.insert(rendered_.end(), {tiles_, work_});
        }
        while (!open.empty())
            endFirst(open);
        runMs_ = std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - begin).count();
        progress.end();
        return finish() ? 0 : exitFailed;
    }

private:
    // Runs `step` on every rank. If it throws on any, the lowest of those says why, and all return false.
    template <class Step>
    bool onAllRanks(const Step& step)
    {
        std::string error;
        bool failed = false;
        try {
            step();
        } catch (const std::exception& e) {
            error = e.what();
            failed = true;
        }
        const auto lowest = fb_->allReduce({failed ? fb_->rank() : fb_->size()}, Reduce::Min).front();
        if (lowest == fb_->rank())
            std::fprintf(stderr, "dfb_render: %s\n", error.c_str());
        return lowest == fb_->size();
    }

    void load()
    {
        const Loaders loaders(
            fb_->rank(), fb_->size(),
            [this](const Loaders::Numbers& numbers) { return fb_->allReduce(numbers, Reduce::Min); },
            [this](const Loaders::Bytes& bytes) { return fb_->allGather(bytes); });
        scene_ = std::make_unique<RankScene>(loadRankScene(o_, loaders));
    }

    std::vector<std::string> files() const
    {
        std::vector<std::string> all;
        if (!o_.output.empty() && !hasWall)
            all.push_back(o_.output);
        for (int d = 0; !o_.output.empty() && d < o_.wallColumns * o_.wallRows; ++d)
            all.push_back(numbered(o_.output, d));
        for (const std::string* path : {&o_.alpha, &o_.depth, &o_.stats})
            if (!path->empty())
                all.push_back(*path);
        if (!o_.aux.empty())
            for (const char* ending :
                 {".normal.pfm", ".albedo.pfm", ".position.pfm", ".primitive.png", ".instance.png"})
                all.push_back(o_.aux + ending);
        return all;
    }
    void requireFilesWritable() const
    {
        for (const std::string& path : files())
            requireWritable(path);
    }

    // Renders what this rank has to.
    typename FrameBuffer::Frame startFrame(int frame, const dfb::World& world, const dfb::FrameParams& params,
                                           ProgressLine& progress)
    {
        const FrameCamera camera = frameCamera(scene_->info, settings_, frame);
        typename FrameBuffer::PixelFrameData pixelData{};
        if constexpr (std::is_same_v<PixelOp, dfb::ToneMap>)
            pixelData.exposure = o_.exposure;
        if constexpr (std::is_same_v<PixelOp, ToneMapToWall>)
            pixelData.first.exposure = o_.exposure;
        typename FrameBuffer::TileFrameData tileData{};
        if constexpr (is_verified_v<TileOp>)
            tileData = &verification_;
        const auto count = [&](std::int64_t cost) {
            ++tiles_;
            work_ += cost;
            progress.tileDone();
            return static_cast<double>(cost);
        };
        const auto renderBrick = [&](const dfb::Brick& brick, auto& tile) {
            return count(scene_->of(brick.id).front().renderTile(tile, frame));
        };
        if constexpr (is_deep_v<TileOp>) {
            return dfb::startDeepParallel(
                *fb_, world, camera, std::max(1, o_.deep),
                [&](const dfb::Brick& brick, dfb::DeepTile& deep) {
                    std::int64_t cost = 0;
                    for (const Renderer& cell : scene_->of(brick.id))
                        cost += cell.renderDeep(deep, frame);
                    count(cost);
                },
                params, tileData, pixelData);
        } else if constexpr (is_single_v<TileOp>) {
            const auto distribution = o_.distribution == Distribution::Linear       ? dfb::WorkDistribution::Linear
                                      : o_.distribution == Distribution::RoundRobin ? dfb::WorkDistribution::RoundRobin
                                      : o_.distribution == Distribution::Dynamic    ? dfb::WorkDistribution::Dynamic
                                                                                    : dfb::WorkDistribution::Owned;
            return dfb::startImageParallel(
                *fb_, distribution,
                [&](auto& tile) { count(scene_->renderers.front().front().renderTile(tile, frame)); }, params, tileData,
                pixelData);
        } else if constexpr (std::is_same_v<TileOp, Ordered>) {
            const Vec3& eye = camera.pose().origin;
            const std::vector<int> order = dfb::visibilityOrder(*shared_, {eye.x, eye.y, eye.z});
            return dfb::startOrdered(*fb_, *shared_, camera, order, inTurn_, renderBrick, params, tileData, pixelData);
        } else if (!shared_) {
            return dfb::startDataParallel(*fb_, world, camera, renderBrick, params, tileData, pixelData);
        } else if (o_.balance == Balance::Cost) {
            return dfb::startMixedParallel(*fb_, *shared_, camera, byCost_, renderBrick, params, tileData, pixelData);
        } else {
            return dfb::startMixedParallel(*fb_, *shared_, camera, inTurn_, renderBrick, params, tileData, pixelData);
        }
    }

    void endFirst(std::deque<typename FrameBuffer::Frame>& open)
    {
        reports_.push_back(open.front().end());
        open.pop_front();
        if (o_.mode == Mode::Mixed && o_.balance == Balance::Cost)
            byCost_.update(reports_.back());
        if constexpr (hasWall)
            wall_->finish(reports_.back().frame);
    }

    dfb::FrameReport renderAdaptively(int frame, const dfb::World& world, ProgressLine& progress)
    {
        if (!sampler_)
            sampler_.emplace(fb_->layout(), dfb::SamplingSettings{o_.adaptive, std::min(8, o_.spp), o_.spp, 64});
        else
            sampler_->reset();
        std::optional<dfb::FrameReport> sum;
        while (!sampler_->done()) {
            const dfb::FrameReport report = startFrame(frame, world, sampler_->next(params_), progress).end();
            sampler_->update(report);
            if (!sum) {
                sum = report;
                continue;
            }
            sum->totalMs += report.totalMs;
            sum->renderMsMax += report.renderMsMax;
            sum->compositingOverheadMs += report.compositingOverheadMs;
            sum->bytesSent += report.bytesSent;
            sum->messagesSent += report.messagesSent;
            sum->peakMemoryBytes = std::max(sum->peakMemoryBytes, report.peakMemoryBytes);
        }
        return *sum;
    }

    // What `rendered_` is on each rank.
    std::vector<std::vector<std::int64_t>> renderedByAll()
    {
        const auto* first = reinterpret_cast<const std::byte*>(rendered_.data());
        std::vector<std::vector<std::int64_t>> all;
        for (const auto& bytes : fb_->allGather({first, first + rendered_.size() * sizeof(std::int64_t)})) {
            if (bytes.size() != rendered_.size() * sizeof(std::int64_t))
                throw std::runtime_error("ranks have counted different numbers of frames");
            all.emplace_back(rendered_.size());
            std::memcpy(all.back().data(), bytes.data(), bytes.size());
        }
        return all;
    }

    bool finish()
    {
        // Own frame end minus own rendering end, the smallest over ranks: no clocks are compared.
        std::vector<std::int64_t> overheadNs, totalNs;
        for (const dfb::FrameReport& r : reports_) {
            overheadNs.push_back(static_cast<std::int64_t>(1e6 * r.compositingOverheadMs));
            totalNs.push_back(static_cast<std::int64_t>(1e6 * r.totalMs));
        }
        overheadNs = fb_->allReduce(overheadNs, Reduce::Min);
        totalNs = fb_->allReduce(totalNs, Reduce::Max);
        const auto rendered = renderedByAll();
        const dfb::testing::ErrorReport checked = verification_.report();
        const auto verified = fb_->allReduce(
            {checked.values + checked.bytes, checked.ulps[0] + checked.bytes - checked.wrongBytes}, Reduce::Sum);
        if (hasWall && !o_.output.empty() && !onAllRanks([&] { writeDisplays(); }))
            return false;
        return onAllRanks([&] {
            if (!fb_->isDisplayRank())
                return;
            const RunStats stats = statsOf(overheadNs, totalNs, rendered);
            writeFiles(o_, fb_->image(), stats);
            say(stats);
            if (o_.verify)
                std::printf("%lld of %lld values are not the exact result rounded\n",
                            static_cast<long long>(verified[0] - verified[1]), static_cast<long long>(verified[0]));
        });
    }

    void writeDisplays() const
    {
        if constexpr (hasWall)
            for (int d = 0; d < wall_->layout().displayCount(); ++d)
                if (wall_->layout().ranks[static_cast<std::size_t>(d)] == fb_->rank())
                    writeImage(numbered(o_.output, d), wall_->image(d), o_.background.has_value(), false);
    }

    RunStats statsOf(const std::vector<std::int64_t>& overheadNs, const std::vector<std::int64_t>& totalNs,
                     const std::vector<std::vector<std::int64_t>>& rendered) const
    {
        RunStats stats;
        stats.ranks = fb_->size();
        stats.transport = Transport::name;
        stats.mode = o_.mode == Mode::Data ? "data" : o_.mode == Mode::Image ? "image" : "mixed";
        stats.width = o_.width;
        stats.height = o_.height;
        stats.runMs = runMs_;
        for (std::size_t i = 0; i < reports_.size(); ++i) {
            const dfb::FrameReport& r = reports_[i];
            FrameStats s;
            s.totalMs = static_cast<double>(totalNs[i]) / 1e6;
            s.renderMsMax = r.renderMsMax;
            s.compositingOverheadMs = static_cast<double>(overheadNs[i]) / 1e6;
            s.bytesSent = static_cast<std::uint64_t>(r.bytesSent);
            s.messagesSent = static_cast<std::uint64_t>(r.messagesSent);
            s.tilesTotal = static_cast<std::uint64_t>(r.tilesTotal);
            s.tilesTouched = static_cast<std::uint64_t>(r.tilesTouched);
            s.peakMemoryBytes = static_cast<std::uint64_t>(r.peakMemoryBytes);
            s.orderUndefinedPixels = static_cast<std::uint64_t>(r.orderUndefinedPixels);
            s.mergeErrorBound = r.mergeErrorBound;
            s.wireColor = dfb::nameOf(r.wireColor);
            s.wireErrorBound = r.wireErrorBound;
            s.compressed = r.compressed;
            s.compressedLinks = r.compressedLinks;
            for (const auto& ofRank : rendered) {
                s.tilesRendered.push_back(static_cast<std::uint64_t>(ofRank[2 * i]));
                s.workOfRanks.push_back(static_cast<std::uint64_t>(ofRank[2 * i + 1]));
            }
            stats.frames.push_back(s);
        }
        const std::int64_t pixels = static_cast<std::int64_t>(o_.width) * o_.height;
        stats.samplesTaken = static_cast<std::uint64_t>(sampler_ ? sampler_->samplesTaken() : pixels * o_.spp);
        stats.samplesSaved = static_cast<std::uint64_t>(pixels * o_.spp) - stats.samplesTaken;
        if (fb_->image().format() == dfb::OutputFormat::RGBA32F) {
            stats.imageHash = hashPixels(fb_->image().rgba32f(), fb_->image().pixelCount());
            stats.meanAlpha = meanAlpha(fb_->image().rgba32f(), fb_->image().pixelCount());
        }
        return stats;
    }

    void say(const RunStats& stats) const
    {
        std::printf("%d %s of %dx%d on %d %s: %.1f ms a frame, %.1f ms of it after the slowest rank had rendered\n",
                    o_.frames, o_.frames == 1 ? "frame" : "frames", o_.width, o_.height, stats.ranks,
                    stats.ranks == 1 ? "rank" : "ranks", stats.runMs / o_.frames,
                    stats.frames.back().compositingOverheadMs);
        if (sampler_)
            std::printf("%.1f %% of the samples of --spp %d were taken\n",
                        100.0 * static_cast<double>(stats.samplesTaken)
                            / (static_cast<double>(stats.samplesTaken) + static_cast<double>(stats.samplesSaved)),
                        o_.spp);
        if (is_deep_v<TileOp>)
            std::printf("order undefined at %llu pixels; merging changed none by more than %.3g\n",
                        static_cast<unsigned long long>(stats.frames.back().orderUndefinedPixels),
                        stats.frames.back().mergeErrorBound);
        const FrameStats& last = stats.frames.back();
        if (last.wireErrorBound > 0)
            std::printf("tiles travelled as %s: no pixel is off by more than %.3g\n", last.wireColor.c_str(),
                        last.wireErrorBound);
        for (const std::string& path : files())
            std::printf("wrote %s\n", path.c_str());
    }

    Options o_;
    std::shared_ptr<dfb::Messenger<Transport>> messenger_;
    std::unique_ptr<Wall> wall_; // outlives the framebuffer that sends to it
    std::unique_ptr<FrameBuffer> fb_;
    std::unique_ptr<RankScene> scene_;
    RenderSettings settings_;
    dfb::FrameParams params_;
    std::optional<dfb::SharedWorld> shared_;
    dfb::MeasuredCostBricks byCost_;
    dfb::RoundRobinBricks inTurn_;
    std::optional<dfb::AdaptiveSampler> sampler_;
    std::atomic<std::int64_t> tiles_{0}, work_{0}; // of this rank in this frame
    std::vector<std::int64_t> rendered_;           // both, of each frame
    double runMs_ = 0;
    dfb::testing::Verification verification_;
    std::vector<dfb::FrameReport> reports_;
};

// Picks the operations that the options ask for.
template <class Transport>
int runWith(const typename Transport::Communicator& communicator, const Options& o, int threads)
{
    const auto run = [&](auto tileOp, auto pixelOp) {
        return RankRun<decltype(tileOp), decltype(pixelOp), Transport>(communicator, o, threads).run();
    };
    using ToWall = dfb::ToWall<Transport>;
    using ToneMapToWall = dfb::PixelOpChain<dfb::ToneMap, ToWall>;
    if (o.deep > 0 || o.interleave > 1)
        return run(dfb::DeepBlend(), dfb::NoPixelOp());
    if (o.verify)
        return o.mode == Mode::Image ? run(VerifiedSingle(), dfb::NoPixelOp()) : run(VerifiedBlend(), dfb::NoPixelOp());
    if (o.blend == Blending::Order)
        return run(Ordered(), dfb::NoPixelOp());
    if (o.blend == Blending::Nearest)
        return run(Nearest(), dfb::NoPixelOp());
    const bool isImage = o.mode == Mode::Image;
    if (o.adaptive > 0)
        return isImage ? run(AdaptiveSingle(), dfb::NoPixelOp()) : run(AdaptiveBlend(), dfb::NoPixelOp());
    if (o.wallColumns > 0 && o.exposure > 0)
        return isImage ? run(Single(), ToneMapToWall()) : run(Blend(), ToneMapToWall());
    if (o.wallColumns > 0)
        return isImage ? run(Single(), ToWall()) : run(Blend(), ToWall());
    if (o.exposure > 0)
        return isImage ? run(Single(), dfb::ToneMap()) : run(Blend(), dfb::ToneMap());
    return isImage ? run(Single(), dfb::NoPixelOp()) : run(Blend(), dfb::NoPixelOp());
}

} // namespace example
