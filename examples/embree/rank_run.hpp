// RankRun: loads what a rank holds, renders the frames in the way that was asked for, and writes the files.
#pragma once

#include "cinema.hpp"
#include "exr.hpp"
#include "frame_pattern.hpp"
#include "options.hpp"
#include "output.hpp"
#include "phase_clock.hpp"
#include "progress_line.hpp"
#include "rank_scene.hpp"

#include <dfb/dfb.hpp>
#include <dfb/testing/verified.hpp>
#include <dfb/trace_file.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <deque>
#include <exception>
#include <filesystem>
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
using ToneMapToWall = dfb::PixelOpChain<dfb::ToneMap, dfb::ToWall>;

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
    return !o.stats.empty() || !o.alpha.empty() || (!o.output.empty() && !o.background) || endingOf(o.output) == ".pfm"
           || o.isExr() || o.pngBits == 16;
}

inline dfb::FrameBufferConfig configOf(const Options& o, int threads)
{
    dfb::FrameBufferConfig config;
    config.image.width = o.width;
    config.image.height = o.height;
    config.image.format = wantsFloat(o) ? dfb::OutputFormat::RGBA32F
                          : !o.output.empty() || !o.depth.empty() || !o.aux.empty() || o.verify || o.live
                              ? dfb::OutputFormat::SRGBA8
                              : dfb::OutputFormat::None;
    config.image.dither = o.dither;
    const dfb::ChannelMask layers = o.isExr() ? o.layers : dfb::ChannelMask{0};
    config.image.depth = !o.depth.empty() || (layers & dfb::depthChannel) != 0;
    config.precision = o.errorBudget > 0 ? dfb::Precision(dfb::ErrorBudget{o.errorBudget}) : dfb::Precision(o.wire);
    config.minTransmittance = o.minTransmittance;
    config.framesInFlight = std::min(o.inFlight, o.frames);
    config.image.aux =
        o.aux.empty() ? static_cast<dfb::ChannelMask>(layers & dfb::imageAuxChannels) : dfb::imageAuxChannels;
    config.image.ownerMap = o.ownerMap == OwnerMap::Linear ? dfb::linearOwner
                            : o.ownerMap == OwnerMap::Hash ? dfb::hashOwner
                                                           : dfb::latticeOwner;
    if (o.compression == Compression::Auto)
        config.messages.compression = dfb::CompressionMode::Auto;
    if (o.compression != Compression::None) {
#if defined(DFB_HAS_SNAPPY)
        config.messages.codec = std::make_shared<dfb::SnappyCodec>();
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

inline dfb::NetworkConfig networkOf(const Options& o)
{
    dfb::NetworkConfig options;
    options.sharedMemory = o.sharedMemory;
    options.peerTimeout = std::chrono::seconds(o.peerTimeout);
    return options;
}

inline dfb::World worldOf(const RankScene& scene, const RenderSettings& settings)
{
    dfb::World world;
    const float ghosts = ghostReach(scene.info, settings);
    const auto box = [](const Box& b) { return dfb::Box3{b.lo, b.hi}; };
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

// The pictures of a Cinema database, relative to its folder.
inline std::vector<std::string> framesOf(const Options& o)
{
    std::vector<std::string> files;
    for (int frame = 0; frame < o.frames; ++frame)
        files.push_back(FramePattern("frame_%04d.png").path(frame));
    return files;
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
    } else if (endingOf(path) == ".pfm") {
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

// Runs `step` on every rank. If it throws on any, the lowest of those says why, and all return false.
template <class FrameBuffer, class Step>
bool onAllRanks(FrameBuffer& fb, const Step& step)
{
    std::string error;
    bool failed = false;
    try {
        step();
    } catch (const std::exception& e) {
        error = e.what();
        failed = true;
    }
    const auto lowest = fb.allReduce({failed ? fb.rank() : fb.size()}, FrameBuffer::Reduce::Min).front();
    if (lowest == fb.rank())
        std::fprintf(stderr, "dfb_render: %s\n", error.c_str());
    return lowest == fb.size();
}

template <class TileOp, class PixelOp>
class RankRun {
    // It is made over a connection, whatever the transport of that is.
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, PixelOp, dfb::InprocTransport>;
    using Reduce = typename FrameBuffer::Reduce;
    static constexpr bool hasWall = std::is_same_v<PixelOp, dfb::ToWall> || std::is_same_v<PixelOp, ToneMapToWall>;

public:
    RankRun(std::shared_ptr<dfb::Connection> connection, const char* transport, const Options& o, int threads)
        : o_(o), transport_(transport), connection_(std::move(connection)),
          threads_(threads > 0 ? threads : connection_->threadShare())
    {
        dfb::FrameBufferConfig config = configOf(o, threads_);
        if (!o.trace.empty())
            config.trace = trace_ = std::make_shared<dfb::TraceFile>();
        PixelOp pixelOp{};
        if constexpr (hasWall) {
            // Of what a wall shows no rank has the whole.
            const auto format = wantsFloat(o) ? dfb::OutputFormat::RGBA32F : dfb::OutputFormat::SRGBA8;
            wall_ = std::make_unique<dfb::DisplayWall>(connection_, wallOf(o, connection_->size()), format,
                                                       config.executor);
            if constexpr (std::is_same_v<PixelOp, dfb::ToWall>)
                pixelOp.wall = wall_.get();
            else
                pixelOp.second.wall = wall_.get();
            config.image.format = dfb::OutputFormat::None;
        }
        try {
            fb_ = std::make_unique<FrameBuffer>(connection_, config, pixelOp);
        } catch (const dfb::InvalidArgument&) {
            // All ranks throw it. A connection that ends while an exception passes tells the others that it has failed.
            wall_.reset();
            connection_.reset();
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
        clock_.enter(Phase::Load);
        if (!onAllRanks([&] { load(); }))
            return exitFailed;
        for (const std::string& note : scene_->notes)
            if (fb_->isDisplayRank())
                std::fprintf(stderr, "dfb_render: %s\n", note.c_str());
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
        try {
            renderFrames(world, progress);
        } catch (const CannotWrite&) { // on all ranks; finish() says why
        }
        runMs_ = std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - begin).count();
        progress.end();
        return finish() ? 0 : exitFailed;
    }

private:
    // This rank's part of a frame.
    struct FrameCounts {
        std::int64_t renderNs = 0, compositingNs = 0, writeNs = 0, tiles = 0, work = 0;
    };
    // A rank could not write a file of an earlier frame. Thrown on all ranks at the end of the same frame.
    struct CannotWrite {};
    // Of Frame::addFigure(), for that. No brick and tile have it.
    static constexpr std::uint64_t cannotWriteKey = ~std::uint64_t{0};

    // As the function of that name; its end counts as compositing: waiting for others.
    template <class Step>
    bool onAllRanks(const Step& step)
    {
        return example::onAllRanks(*fb_, [&] {
            struct AtEnd {
                PhaseClock& clock;
                ~AtEnd() { clock.enter(Phase::Compositing); }
            } const atEnd{clock_};
            step();
        });
    }

    void load()
    {
        const Loaders loaders = loadersOf(*fb_);
        scene_ = std::make_unique<RankScene>(loadRankScene(o_, loaders));
        o_.view = scene_->view;
        bytesRead_ = static_cast<std::int64_t>(loaders.bytesRead());
    }

    // The files of a frame whose names have its number; or those that are written of the last frame alone.
    std::vector<std::string> files(int frame, bool areNumbered) const
    {
        std::vector<std::string> all;
        const auto isOne = [&](const FramePattern& name) {
            return name.isPattern() == areNumbered && !name.path(frame).empty();
        };
        const FramePattern output(o_.output), aux(o_.aux);
        if (isOne(output) && !hasWall)
            all.push_back(output.path(frame));
        for (int d = 0; isOne(output) && d < o_.wallColumns * o_.wallRows; ++d)
            all.push_back(numbered(output.path(frame), d));
        for (const std::string* text : {&o_.alpha, &o_.depth})
            if (const FramePattern name(*text); isOne(name))
                all.push_back(name.path(frame));
        if (isOne(aux))
            for (const char* ending :
                 {".normal.pfm", ".albedo.pfm", ".position.pfm", ".primitive.png", ".instance.png"})
                all.push_back(aux.path(frame) + ending);
        for (const std::string& path : {o_.stats, o_.trace, o_.saveOptions, cinemaTable()})
            if (!areNumbered && !path.empty())
                all.push_back(path);
        return all;
    }
    // Empty: none.
    std::string cinemaTable() const { return o_.cinema.empty() ? "" : o_.cinema + "/data.csv"; }
    void requireFilesWritable() const
    {
        if (o_.isExr() && !hasOpenExr)
            throw std::runtime_error("this dfb_render was built without OpenEXR: install libopenexr-dev, or write "
                                     "another kind of file");
        std::error_code ignored; // an error shows when the files are opened
        if (!o_.cinema.empty())
            std::filesystem::create_directories(o_.cinema, ignored);

        for (const bool areNumbered : {false, true})
            for (const std::string& path : files(0, areNumbered))
                requireWritable(path);
    }

    // Writes what this rank has of the files of the frame that ended last. If that fails, what is wrong is kept and no
    // other file written.
    void writeFrame(int frame)
    {
        clock_.enter(Phase::Write);
        try {
            if (writeError_.empty())
                writeFiles(frame);
        } catch (const std::exception& e) {
            writeError_ = e.what();
        }
        frames_[static_cast<std::size_t>(frame)].writeNs = clock_.enter(Phase::Compositing);
    }
    void writeFiles(int frame) const
    {
        // The path that a file of this frame has; empty if there is none.
        const auto pathOf = [&](const std::string& text) {
            const FramePattern name(text);
            return name.isPattern() || frame == o_.frames - 1 ? name.path(frame) : std::string();
        };
        const std::string output = pathOf(o_.output), alpha = pathOf(o_.alpha), depth = pathOf(o_.depth),
                          aux = pathOf(o_.aux);
        const bool isOpaque = o_.background.has_value();
        if constexpr (hasWall) {
            for (int d = 0; !output.empty() && d < wall_->layout().displayCount(); ++d)
                if (wall_->layout().ranks[static_cast<std::size_t>(d)] == fb_->rank())
                    writeImage(numbered(output, d), wall_->image(d), isOpaque, false);
            return;
        }
        if (!fb_->isDisplayRank())
            return;
        const dfb::Image& image = fb_->image();
        if (!output.empty() && o_.isExr())
            writeExr(output, image, o_.layers, optionsText(o_.scene, o_.given));
        else if (!output.empty() && o_.pngBits == 16)
            writePng16(output, o_.width, o_.height, image.rgba32f(), !isOpaque);
        else if (!output.empty())
            writeImage(output, image, isOpaque, o_.dither);
        if (!alpha.empty())
            writeGreyPfm(alpha, o_.width, o_.height, image.rgba32f() + 3, 4);
        if (!depth.empty())
            writeGreyPfm(depth, o_.width, o_.height, image.depth(), 1);
        if (!aux.empty()) {
            writeVectorPfm(aux + ".normal.pfm", o_.width, o_.height, image.normal());
            writeVectorPfm(aux + ".albedo.pfm", o_.width, o_.height, image.albedo());
            writeVectorPfm(aux + ".position.pfm", o_.width, o_.height, image.position());
            writeIdPng(aux + ".primitive.png", o_.width, o_.height, image.primitiveId());
            writeIdPng(aux + ".instance.png", o_.width, o_.height, image.instanceId());
        }
    }

    void renderFrames(const dfb::World& world, ProgressLine& progress)
    {
        frames_.resize(static_cast<std::size_t>(o_.frames));
        std::deque<typename FrameBuffer::Frame> open;
        for (int frame = 0; frame < o_.frames; ++frame) {
            progress.beginFrame(frame, progress.isEnabled() ? tilesAhead(frame, world) : 0);
            tiles_ = work_ = 0;
            if constexpr (is_adaptive_v<TileOp>) {
                reports_.push_back(renderAdaptively(frame, world, progress));
                writeFrame(frame);
            } else {
                if (static_cast<int>(open.size()) == fb_->config().framesInFlight)
                    endFirst(open);
                open.push_back(start(frame, world, params_, progress));
            }
            frames_[static_cast<std::size_t>(frame)].tiles = tiles_;
            frames_[static_cast<std::size_t>(frame)].work = work_;
        }
        while (!open.empty())
            endFirst(open);
    }

    // About how many tiles this rank renders in a frame, those of each sample and brick by themselves.
    std::int64_t tilesAhead(int frame, const dfb::World& world) const
    {
        if constexpr (is_single_v<TileOp>)
            return static_cast<std::int64_t>(fb_->layout().tileCount()) * o_.spp / fb_->size();
        const FrameCamera camera = frameCamera(scene_->info, settings_, frame);
        const std::size_t visible = dfb::visibleTiles(world, camera, fb_->layout()).size();
        const int copies = o_.mode == Mode::Mixed ? std::min(o_.replicate, fb_->size()) : 1;
        return static_cast<std::int64_t>(visible) * o_.spp / copies;
    }

    typename FrameBuffer::Frame start(int frame, const dfb::World& world, const dfb::FrameConfig& params,
                                      ProgressLine& progress)
    {
        clock_.enter(Phase::Render);
        typename FrameBuffer::Frame started = startFrame(frame, world, params, progress);
        frames_[static_cast<std::size_t>(frame)].renderNs += clock_.enter(Phase::Compositing);
        return started;
    }

    dfb::FrameReport end(typename FrameBuffer::Frame& open, int frame)
    {
        if (!writeError_.empty())
            open.addFigure(cannotWriteKey, 1);
        clock_.enter(Phase::Compositing);
        dfb::FrameReport report = open.end();
        if constexpr (hasWall)
            wall_->finish(report.frame);
        frames_[static_cast<std::size_t>(frame)].compositingNs += clock_.enter(Phase::Compositing);
        if (std::any_of(report.figures.begin(), report.figures.end(),
                        [](const dfb::Figure& figure) { return figure.key == cannotWriteKey; }))
            throw CannotWrite();
        return report;
    }

    // The loop, made for the first frame.
    template <class Loop, class... Arguments>
    static Loop& once(std::optional<Loop>& loop, Arguments&&... arguments)
    {
        return loop ? *loop : loop.emplace(std::forward<Arguments>(arguments)...);
    }

    // Renders what this rank has to.
    typename FrameBuffer::Frame startFrame(int frame, const dfb::World& world, const dfb::FrameConfig& params,
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
            return once(deepLoop_, *fb_, world, std::max(1, o_.deep))
                .start(
                    camera,
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
            return once(imageLoop_, *fb_, distribution)
                .start([&](auto& tile) { count(scene_->renderers.front().front().renderTile(tile, frame)); }, params,
                       tileData, pixelData);
        } else if constexpr (std::is_same_v<TileOp, Ordered>) {
            const std::vector<int> order = dfb::visibilityOrder(*shared_, camera.pinhole().eye());
            return once(orderedLoop_, *fb_, *shared_, inTurn_)
                .start(camera, order, renderBrick, params, tileData, pixelData);
        } else if (!shared_) {
            return once(dataLoop_, *fb_, world).start(camera, renderBrick, params, tileData, pixelData);
        } else if (o_.balance == Balance::Cost) {
            return once(loopByCost_, *fb_, *shared_, byCost_).start(camera, renderBrick, params, tileData, pixelData);
        } else {
            return once(loopInTurn_, *fb_, *shared_, inTurn_).start(camera, renderBrick, params, tileData, pixelData);
        }
    }

    void endFirst(std::deque<typename FrameBuffer::Frame>& open)
    {
        const int frame = static_cast<int>(reports_.size());
        reports_.push_back(end(open.front(), frame));
        open.pop_front();
        if (o_.mode == Mode::Mixed && o_.balance == Balance::Cost)
            byCost_.update(reports_.back());
        writeFrame(frame);
    }

    dfb::FrameReport renderAdaptively(int frame, const dfb::World& world, ProgressLine& progress)
    {
        if (!sampler_)
            sampler_.emplace(fb_->layout(), dfb::SamplingConfig{o_.adaptive, std::min(8, o_.spp), o_.spp, 64});
        else
            sampler_->reset();
        std::optional<dfb::FrameReport> sum;
        while (!sampler_->done()) {
            auto open = start(frame, world, sampler_->next(params_), progress);
            const dfb::FrameReport report = end(open, frame);
            sampler_->update(report);
            if (!sum) {
                sum = report;
                continue;
            }
            sum->bytesSent += report.bytesSent;
            sum->messagesSent += report.messagesSent;
            sum->peakMemoryBytes = std::max(sum->peakMemoryBytes, report.peakMemoryBytes);
        }
        return *sum;
    }

    // The numbers of each rank, which has as many of them as this one.
    std::vector<std::vector<std::int64_t>> gathered(const std::vector<std::int64_t>& numbers)
    {
        const auto* first = reinterpret_cast<const std::byte*>(numbers.data());
        std::vector<std::vector<std::int64_t>> all;
        for (const auto& bytes : fb_->allGather({first, first + numbers.size() * sizeof(std::int64_t)})) {
            if (bytes.size() != numbers.size() * sizeof(std::int64_t))
                throw std::runtime_error("ranks have counted different numbers of frames");
            all.emplace_back(numbers.size());
            std::memcpy(all.back().data(), bytes.data(), bytes.size());
        }
        return all;
    }

    bool finish()
    {
        if (!onAllRanks([&] {
                if (!writeError_.empty())
                    throw std::runtime_error(writeError_);
            }))
            return false;
        if (trace_ && !onAllRanks([&] { trace_->write(*fb_, o_.trace); }))
            return false;
        clock_.enter(Phase::Compositing);
        std::vector<std::int64_t> numbers{clock_.totalNs(),
                                          clock_.ns(Phase::Load),
                                          clock_.ns(Phase::Render),
                                          clock_.ns(Phase::Compositing),
                                          clock_.ns(Phase::Write),
                                          threads_,
                                          bytesRead_};
        for (const FrameCounts& f : frames_)
            numbers.insert(numbers.end(), {f.renderNs, f.compositingNs, f.writeNs, f.tiles, f.work});
        const auto ofRanks = gathered(numbers);
        const dfb::testing::ErrorReport checked = verification_.report();
        const auto verified =
            fb_->allReduce({checked.values + checked.bytes, checked.ulps[0] + checked.bytes - checked.wrongBytes,
                            checked.others, checked.wrongOthers},
                           Reduce::Sum);
        return onAllRanks([&] {
            if (!fb_->isDisplayRank())
                return;
            const RunStats stats = statsOf(ofRanks);
            if (!o_.stats.empty())
                writeStats(o_.stats, stats);
            if (!o_.saveOptions.empty())
                writeText(o_.saveOptions, optionsText(o_.scene, o_.given));
            if (!o_.cinema.empty())
                writeCinema(cinemaTable(), o_.view, framesOf(o_));
            say(stats);
            if (o_.verify)
                std::printf("%lld of %lld values are not the exact result rounded\n",
                            static_cast<long long>(verified[0] - verified[1]), static_cast<long long>(verified[0]));
            if (o_.verify && verified[2] > 0)
                std::printf("%lld of %lld values of depth and auxiliary channels are wrong\n",
                            static_cast<long long>(verified[3]), static_cast<long long>(verified[2]));
        });
    }

    // `ofRanks`: what finish() gathers.
    RunStats statsOf(const std::vector<std::vector<std::int64_t>>& ofRanks) const
    {
        const auto ms = [](std::int64_t ns) { return static_cast<double>(ns) / 1e6; };
        RunStats stats;
        for (const auto& n : ofRanks)
            stats.ranks.push_back({{ms(n[1]), ms(n[2]), ms(n[3]), ms(n[4])},
                                   ms(n[0]),
                                   static_cast<int>(n[5]),
                                   static_cast<std::uint64_t>(n[6])});
        stats.scene = o_.scene;
        stats.options = o_.values;
        stats.version = std::to_string(DFB_VERSION_MAJOR) + '.' + std::to_string(DFB_VERSION_MINOR) + '.'
                        + std::to_string(DFB_VERSION_PATCH);
        stats.transport = transport_;
        stats.mode = o_.mode == Mode::Data ? "data" : o_.mode == Mode::Image ? "image" : "mixed";
        stats.width = o_.width;
        stats.height = o_.height;
        stats.runMs = runMs_;
        for (std::size_t i = 0; i < reports_.size(); ++i) {
            const dfb::FrameReport& r = reports_[i];
            FrameStats s;
            for (const auto& n : ofRanks) {
                const std::int64_t* f = n.data() + 7 + 5 * i;
                s.ranks.push_back({{0, ms(f[0]), ms(f[1]), ms(f[2])},
                                   static_cast<std::uint64_t>(f[3]),
                                   static_cast<std::uint64_t>(f[4])});
            }
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
        const FrameStats& last = stats.frames.back();
        const std::size_t ranks = stats.ranks.size();
        std::printf("%d %s of %dx%d on %zu %s: %.1f ms a frame, %.1f ms of it after the slowest rank had rendered\n",
                    o_.frames, o_.frames == 1 ? "frame" : "frames", o_.width, o_.height, ranks,
                    ranks == 1 ? "rank" : "ranks",
                    (stats.runMs - stats.ranks[static_cast<std::size_t>(fb_->rank())].times.writeMs) / o_.frames,
                    last.ranks[slowestOf(last.ranks)].times.compositingMs);
        if (sampler_)
            std::printf("%.1f %% of the samples of --spp %d were taken\n",
                        100.0 * static_cast<double>(stats.samplesTaken)
                            / (static_cast<double>(stats.samplesTaken) + static_cast<double>(stats.samplesSaved)),
                        o_.spp);
        if (is_deep_v<TileOp>)
            std::printf("order undefined at %llu pixels; merging changed none by more than %.3g\n",
                        static_cast<unsigned long long>(last.orderUndefinedPixels), last.mergeErrorBound);
        if (last.wireErrorBound > 0)
            std::printf("tiles travelled as %s: no colour or alpha is off by more than %.3g\n", last.wireColor.c_str(),
                        last.wireErrorBound);
        sayWritten();
    }

    void sayWritten() const
    {
        const std::vector<std::string> first = files(0, true), last = files(o_.frames - 1, true);
        for (std::size_t i = 0; i < first.size(); ++i) {
            if (o_.frames > 1)
                std::printf("wrote %s to %s\n", first[i].c_str(), last[i].c_str());
            else
                std::printf("wrote %s\n", first[i].c_str());
        }
        for (const std::string& path : files(0, false)) {
            const bool isOfRun =
                path == o_.stats || path == o_.trace || path == o_.saveOptions || path == cinemaTable();
            if (o_.frames > 1 && !isOfRun)
                std::printf("wrote %s, the last of %d frames; %%04d in the name gives a file for each\n", path.c_str(),
                            o_.frames);
            else
                std::printf("wrote %s\n", path.c_str());
        }
        if (o_.writesNothing())
            std::fprintf(stderr, "dfb_render: nothing was written: there is no --output, --alpha, --depth, --aux, "
                                 "--stats, --trace, --cinema or --save-options\n");
    }

    PhaseClock clock_;
    Options o_;
    const char* transport_; // its name
    std::shared_ptr<dfb::Connection> connection_;
    int threads_;
    std::shared_ptr<dfb::TraceFile> trace_;  // null: none is written
    std::unique_ptr<dfb::DisplayWall> wall_; // outlives the framebuffer that sends to it
    std::unique_ptr<FrameBuffer> fb_;
    std::unique_ptr<RankScene> scene_;
    RenderSettings settings_;
    dfb::FrameConfig params_;
    std::optional<dfb::SharedWorld> shared_;
    dfb::MeasuredCostBricks byCost_;
    dfb::RoundRobinBricks inTurn_;
    std::optional<dfb::DataParallelLoop<FrameBuffer>> dataLoop_;
    std::optional<dfb::DeepParallelLoop<FrameBuffer>> deepLoop_;
    std::optional<dfb::ImageParallelLoop<FrameBuffer>> imageLoop_;
    std::optional<dfb::MixedParallelLoop<FrameBuffer, dfb::MeasuredCostBricks>> loopByCost_;
    std::optional<dfb::MixedParallelLoop<FrameBuffer, dfb::RoundRobinBricks>> loopInTurn_;
    std::optional<dfb::OrderedLoop<FrameBuffer, dfb::RoundRobinBricks>> orderedLoop_;
    std::optional<dfb::AdaptiveSampler> sampler_;
    std::atomic<std::int64_t> tiles_{0}, work_{0}; // of this rank in this frame
    std::vector<FrameCounts> frames_;
    std::int64_t bytesRead_ = 0;
    std::string writeError_; // empty if there is none
    double runMs_ = 0;
    dfb::testing::Verification verification_;
    std::vector<dfb::FrameReport> reports_;
};

// Runs with these operations.
template <class TileOp, class PixelOp>
int runWith(std::shared_ptr<dfb::Connection> connection, const char* transport, const Options& o, int threads)
{
    return RankRun<TileOp, PixelOp>(std::move(connection), transport, o, threads).run();
}

} // namespace example
