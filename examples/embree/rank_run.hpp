// RankRun: loads a rank's part of the scene, renders the frames as the options say, and writes the files.
#pragma once

#include "on_all_ranks.hpp"
#include "options.hpp"
#include "output.hpp"
#include "phase_clock.hpp"
#include "progress_line.hpp"
#include "rank_scene.hpp"
#include "run_config.hpp"
#include "run_files.hpp"
#include "run_frames.hpp"

#include <dfb/dfb.hpp>
#include <dfb/testing/verified.hpp>
#include <dfb/trace_file.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace example {

class RankRun {
public:
    RankRun(std::shared_ptr<dfb::Connection> connection, const char* transport, const Options& o)
        : o_(o), transport_(transport), threads_(o.threads > 0 ? o.threads : connection->threadShare())
    {
        dfb::FrameBufferConfig config = configOf(o, threads_);
        if (!o.trace.empty())
            config.trace = trace_ = std::make_shared<dfb::TraceFile>();
        try {
            run_ = makeFrames(connection, o_, config, verification_);
        } catch (const dfb::InvalidArgument&) {
            // All ranks throw it, so the connection ends here. One that ends during an exception tells the others that
            // it failed.
            connection.reset();
            throw;
        }
    }

    // The exit code, the same on all ranks.
    int run()
    {
        if (!onAllRanks([&] {
                if (fb().isDisplayRank())
                    files_.requireWritable();
            }))
            return exitFailed;
        clock_.enter(Phase::Load);
        if (!onAllRanks([&] { load(); }))
            return exitFailed;
        for (const std::string& note : work_.scene->notes)
            if (fb().isDisplayRank())
                std::fprintf(stderr, "dfb_render: %s\n", note.c_str());
        ProgressLine progress(fb().isDisplayRank(), o_.frames);
        prepare(progress);
        const auto begin = std::chrono::steady_clock::now();
        try {
            renderFrames(progress);
        } catch (const CannotWrite&) { // on all ranks; finish() says why
            run_->leaveAll();
        }
        runMs_ = std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - begin).count();
        progress.end();
        return finish() ? 0 : exitFailed;
    }

private:
    dfb::FrameBufferBase& fb() const { return run_->framebuffer(); }

    // A rank could not write a file of an earlier frame. Thrown on all ranks at the end of the same frame.
    struct CannotWrite {};
    // The key of Frame::addFigure() that tells the others. No brick or tile has it.
    static constexpr std::uint64_t cannotWriteKey = ~std::uint64_t{0};

    // Like the function of that name. Waiting for the other ranks counts as compositing.
    template <class Step>
    bool onAllRanks(const Step& step)
    {
        return example::onAllRanks(fb(), [&] {
            struct AtEnd {
                PhaseClock& clock;
                ~AtEnd() { clock.enter(Phase::Compositing); }
            } const atEnd{clock_};
            step();
        });
    }

    void load()
    {
        const Loaders loaders = loadersOf(fb());
        work_.scene = std::make_unique<RankScene>(loadRankScene(o_, loaders));
        o_.view = work_.scene->view;
        bytesRead_ = loaders.bytesRead();
    }

    void prepare(ProgressLine& progress)
    {
        work_.settings = o_;
        work_.world = worldOf(*work_.scene);
        if (o_.mode != Mode::Image)
            work_.shared.emplace(fb(), work_.world);
        work_.tileDone = [this, &progress](std::int64_t work) {
            ++tiles_;
            workDone_ += work;
            progress.tileDone();
        };
        params_.passes = o_.passes;
        const std::int64_t layers = static_cast<std::int64_t>(work_.scene->bounds.size()) * std::max(1, o_.deep);
        params_.maxLayers = static_cast<int>(std::min<std::int64_t>(layers, std::numeric_limits<int>::max()));
        if (o_.background)
            params_.background = {(*o_.background)[0], (*o_.background)[1], (*o_.background)[2], 1.0f};
    }

    // Writes this rank's files of the frame that ended last. If that fails, it keeps the error and writes no other
    // file.
    void writeFrame(int frame)
    {
        clock_.enter(Phase::Write);
        try {
            if (writeError_.empty() && run_->wall())
                files_.write(frame, *run_->wall(), fb().rank());
            else if (writeError_.empty() && fb().isDisplayRank())
                files_.write(frame, fb().image());
        } catch (const std::exception& e) {
            writeError_ = e.what();
        }
        frames_[static_cast<std::size_t>(frame)].times.writeMs = clock_.enter(Phase::Compositing);
    }

    void renderFrames(ProgressLine& progress)
    {
        frames_.resize(static_cast<std::size_t>(o_.frames));
        for (int frame = 0; frame < o_.frames; ++frame) {
            progress.beginFrame(frame, progress.isEnabled() ? tilesAhead(frame) : 0);
            tiles_ = workDone_ = 0;
            if (isAdaptive(compositing_)) {
                reports_.push_back(renderAdaptively(frame));
                writeFrame(frame);
            } else {
                if (run_->openCount() == fb().config().framesInFlight)
                    endFirst();
                start(frame, params_);
            }
            frames_[static_cast<std::size_t>(frame)].tilesRendered = static_cast<std::uint64_t>(tiles_);
            frames_[static_cast<std::size_t>(frame)].work = static_cast<std::uint64_t>(workDone_);
        }
        while (run_->openCount() > 0)
            endFirst();
    }

    // About how many tiles this rank renders in a frame. A tile counts once for each sample and brick.
    std::int64_t tilesAhead(int frame) const
    {
        if (isSingle(compositing_))
            return static_cast<std::int64_t>(fb().layout().tileCount()) * o_.passes / fb().size();
        const FrameCamera camera = frameCamera(work_.scene->info, work_.settings, frame);
        const std::size_t visible = dfb::visibleTiles(work_.world, camera, fb().layout()).size();
        const int copies = o_.mode == Mode::Mixed ? std::min(o_.replicate, fb().size()) : 1;
        return static_cast<std::int64_t>(visible) * o_.passes / copies;
    }

    void start(int frame, const dfb::FrameConfig& params)
    {
        clock_.enter(Phase::Render);
        run_->start(frame, work_, params);
        frames_[static_cast<std::size_t>(frame)].times.renderMs += clock_.enter(Phase::Compositing);
    }

    // Ends the oldest open frame, which is number `frame`.
    dfb::FrameReport end(int frame)
    {
        if (!writeError_.empty())
            run_->oldest().addFigure(cannotWriteKey, 1);
        clock_.enter(Phase::Compositing);
        dfb::FrameReport report = run_->end();
        frames_[static_cast<std::size_t>(frame)].times.compositingMs += clock_.enter(Phase::Compositing);
        if (std::any_of(report.figures.begin(), report.figures.end(),
                        [](const dfb::Figure& figure) { return figure.key == cannotWriteKey; }))
            throw CannotWrite();
        return report;
    }

    void endFirst()
    {
        const int frame = static_cast<int>(reports_.size());
        reports_.push_back(end(frame));
        writeFrame(frame);
    }

    dfb::FrameReport renderAdaptively(int frame)
    {
        if (!sampler_)
            sampler_.emplace(fb().layout(), dfb::SamplingConfig{o_.adaptive, std::min(8, o_.passes), o_.passes, 64});
        else
            sampler_->reset();
        std::optional<dfb::FrameReport> sum;
        while (!sampler_->done()) {
            start(frame, sampler_->next(params_));
            const dfb::FrameReport report = end(frame);
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

    bool finish()
    {
        if (!onAllRanks([&] {
                if (!writeError_.empty())
                    throw std::runtime_error(writeError_);
            }))
            return false;
        if (trace_ && !onAllRanks([&] { trace_->write(fb(), o_.trace); }))
            return false;
        clock_.enter(Phase::Compositing);
        const RankStats mine{
            {clock_.ms(Phase::Load), clock_.ms(Phase::Render), clock_.ms(Phase::Compositing), clock_.ms(Phase::Write)},
            clock_.totalMs(),
            threads_,
            bytesRead_};
        const Loaders ranks = loadersOf(fb());
        const auto ofRanks = ranks.gatherOf<RankStats>([&] { return std::vector<RankStats>{mine}; });
        const auto framesOfRanks = ranks.gatherOf<RankFrameStats>([&] { return frames_; });
        const dfb::testing::ErrorReport checked = verification_.report();
        const auto verified =
            fb().allReduce({checked.values + checked.bytes, checked.ulps[0] + checked.bytes - checked.wrongBytes,
                            checked.others, checked.wrongOthers},
                           dfb::Reduce::Sum);
        return onAllRanks([&] {
            if (!fb().isDisplayRank())
                return;
            const RunStats stats = statsOf(ofRanks, framesOfRanks);
            files_.write(stats);
            say(stats);
            if (o_.verify)
                std::printf("%lld of %lld values are not the exact result rounded\n",
                            static_cast<long long>(verified[0] - verified[1]), static_cast<long long>(verified[0]));
            if (o_.verify && verified[2] > 0)
                std::printf("%lld of %lld values of depth and auxiliary channels are wrong\n",
                            static_cast<long long>(verified[3]), static_cast<long long>(verified[2]));
        });
    }

    // `frames`: all frames of rank 0, then those of rank 1, and so on.
    RunStats statsOf(const std::vector<RankStats>& ranks, const std::vector<RankFrameStats>& frames) const
    {
        RunStats stats;
        stats.ranks = ranks;
        stats.scene = o_.scene;
        stats.options = o_.values;
        stats.version = DFB_VERSION;
        stats.transport = transport_;
        stats.mode = o_.mode == Mode::Data ? "data" : o_.mode == Mode::Image ? "image" : "mixed";
        stats.width = o_.width;
        stats.height = o_.height;
        stats.runMs = runMs_;
        for (std::size_t i = 0; i < reports_.size(); ++i) {
            FrameStats s;
            for (std::size_t rank = 0; rank < ranks.size(); ++rank)
                s.ranks.push_back(frames[rank * frames_.size() + i]);
            s.report = reports_[i];
            stats.frames.push_back(std::move(s));
        }
        const std::int64_t pixels = static_cast<std::int64_t>(o_.width) * o_.height;
        stats.samplesTaken = static_cast<std::uint64_t>(sampler_ ? sampler_->samplesTaken() : pixels * o_.passes);
        stats.samplesSaved = static_cast<std::uint64_t>(pixels * o_.passes) - stats.samplesTaken;
        if (fb().image().format() == dfb::OutputFormat::RGBA32F) {
            stats.imageHash = hashPixels(fb().image().rgba32f(), fb().image().pixelCount());
            stats.meanAlpha = meanAlpha(fb().image().rgba32f(), fb().image().pixelCount());
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
                    (stats.runMs - stats.ranks[static_cast<std::size_t>(fb().rank())].times.writeMs) / o_.frames,
                    last.ranks[slowestOf(last.ranks)].times.compositingMs);
        if (sampler_)
            std::printf("%.1f %% of the samples of --spp %d were taken\n",
                        100.0 * static_cast<double>(stats.samplesTaken)
                            / (static_cast<double>(stats.samplesTaken) + static_cast<double>(stats.samplesSaved)),
                        o_.passes);
        if (compositing_ == Compositing::Deep)
            std::printf("order undefined at %lld pixels; merging changed none by more than %.3g\n",
                        static_cast<long long>(last.report.orderUndefinedPixels), last.report.mergeErrorBound);
        if (last.report.wireErrorBound > 0)
            std::printf("%s: no colour or alpha is off by more than %.3g\n",
                        last.report.wireColor == dfb::WireFormat::Float32
                            ? "pixels end at --min-transmittance"
                            : ("tiles travelled as " + std::string(dfb::nameOf(last.report.wireColor))).c_str(),
                        last.report.wireErrorBound);
        files_.say();
    }

    PhaseClock clock_;
    Options o_;
    const Compositing compositing_ = compositingOf(o_);
    const RunFiles files_{o_};
    const char* transport_; // its name
    int threads_;
    std::shared_ptr<dfb::TraceFile> trace_; // null: none is written
    dfb::testing::Verification verification_;
    std::unique_ptr<RunFrames> run_;
    RankWork work_;
    dfb::FrameConfig params_;
    std::optional<dfb::AdaptiveSampler> sampler_;
    std::atomic<std::int64_t> tiles_{0}, workDone_{0}; // of this rank in this frame
    std::vector<RankFrameStats> frames_;
    std::uint64_t bytesRead_ = 0;
    std::string writeError_; // empty if there is none
    double runMs_ = 0;
    std::vector<dfb::FrameReport> reports_;
};

} // namespace example
