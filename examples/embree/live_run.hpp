// LiveRun: renders what the viewers of a live view want to see, until they end the job.
#pragma once

#include "camera.hpp"
#include "on_all_ranks.hpp"
#include "run_config.hpp"

#include <interrupt.hpp>
#include <live_view.hpp>

#include <algorithm>
#include <array>
#include <charconv>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace example {

// Frames accumulate while the camera rests.
using LiveBlend = dfb::Progressive<BlendOp>;
using LiveSingle = dfb::Progressive<SingleOp>;

template <class TileOp>
class LiveRun {
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, dfb::InprocTransport>;
    static constexpr bool isSingle = std::is_same_v<TileOp, LiveSingle>;

public:
    LiveRun(std::shared_ptr<dfb::Connection> connection, const Options& o)
        : o_(o), fb_(connection, configOf(o, o.threads > 0 ? o.threads : connection->threadShare()))
    {
    }

    // The exit code, the same on all ranks. Throws as FrameBuffer::Frame::end() does.
    int run()
    {
        const Interrupt interrupt;
        const auto listen = [&] {
            if (fb_.isDisplayRank())
                view_ = LiveView::listen(titleOf(o_.scene), *o_.live, false);
        };
        if (!onAllRanks(fb_, listen) || !onAllRanks(fb_, [&] { load(); }))
            return exitFailed;
        open();
        while (agree())
            renderNext();
        if (fb_.isDisplayRank())
            std::printf("ended after %lld frames\n", static_cast<long long>(frames_));
        return 0;
    }

private:
    // A renderer throws it when the viewers no longer want the frame. The ranks recognise the error by its text.
    struct Superseded : std::runtime_error {
        static constexpr const char* text = "the viewers want another picture";
        Superseded() : std::runtime_error(text) {}
    };

    // The scene's name, or those of its files without their folders.
    static std::string titleOf(const std::vector<std::string>& scene)
    {
        std::string title;
        for (const std::string& path : scene)
            title += (title.empty() ? "" : ", ") + path.substr(path.rfind('/') + 1);
        return title;
    }

    void load()
    {
        const Loaders loaders = loadersOf(fb_);
        Options fromAllSides = o_; // so bricks are cut for a camera that goes around
        fromAllSides.frames = 36;
        scene_ = std::make_unique<RankScene>(loadRankScene(fromAllSides, loaders));
        o_.view = withoutEye(scene_->info.focus, scene_->view);
        settings_ = o_;
        world_ = worldOf(*scene_);
        params_.maxLayers = static_cast<int>(scene_->bounds.size());
        const std::array<float, 3> behind = o_.background.value_or(std::array<float, 3>{0, 0, 0});
        params_.background = {behind[0], behind[1], behind[2], 1};
    }

    void open()
    {
        if (o_.mode != Mode::Image)
            shared_.emplace(fb_, world_);
        if (!fb_.isDisplayRank())
            return;
        for (const std::string& note : scene_->notes)
            std::fprintf(stderr, "dfb_render: %s\n", note.c_str());
        LiveScene scene;
        const auto outward = [&](float azimuth) {
            RenderSettings settings = settings_;
            settings.view.azimuth = azimuth;
            settings.view.elevation = 0;
            return frameCamera(scene_->info, settings, 0).pinhole().forward() * -1.0f;
        };
        const Vec3 front = outward(0), side = outward(90);
        const auto list = [](const Vec3& v) {
            return std::array<double, 3>{static_cast<double>(v.x), static_cast<double>(v.y), static_cast<double>(v.z)};
        };
        scene.axes = {list(side), list(cross(front, side)), list(front)};
        scene.unit = static_cast<double>(scene_->info.focus.box.largestExtent());
        scene.fieldOfView = static_cast<double>(shownAngle(o_.view));
        scene.mostSamples = std::max(256, o_.passes);
        scene.ranks = fb_.size();
        LiveWishes home;
        home.camera.azimuth = static_cast<double>(o_.view.azimuth);
        home.camera.elevation = static_cast<double>(o_.view.elevation);
        if (o_.view.distance) // limits of the viewers; 0 would show all of the scene
            home.camera.distance = std::clamp(static_cast<double>(*o_.view.distance), 1e-4, 1000.0);
        home.camera.target = list(o_.view.target.value_or(scene_->info.focus.box.center()));
        home.width = o_.width;
        home.height = o_.height;
        home.samples = o_.passes;
        view_->open(scene, home);
        std::fputs(view_->invitation().c_str(), stdout);
        std::fflush(stdout);
    }

    // Tells all ranks what the viewers want. Waits for a change if there is nothing to render. Returns false if the job
    // is to end. Collective.
    bool agree()
    {
        LiveWishes mine;
        mine.ends = Interrupt::happened();
        if (fb_.isDisplayRank())
            mine = view_->waitForChange(wishes_.number, patience());
        const LiveWishes now = shareWishes(fb_, mine);
        if (!isBegun_ || now.look != wishes_.look)
            look(now);
        wishes_ = now;
        isBegun_ = true;
        return !now.ends;
    }

    // How long to wait for a change before the picture is refined.
    std::chrono::milliseconds patience() const
    {
        if (!isBegun_ || !isDrawn_ || (samples_ > 0 && samples_ < wishes_.samples))
            return std::chrono::milliseconds(0);
        if (isRefined())
            return std::chrono::milliseconds::max();
        return std::chrono::milliseconds(150); // the camera may be moving
    }
    bool isRefined() const { return isDrawn_ && (wishes_.samples == 1 || samples_ >= wishes_.samples); }

    void look(const LiveWishes& wishes)
    {
        if (wishes.width != fb_.config().image.width || wishes.height != fb_.config().image.height)
            fb_.resize(wishes.width, wishes.height);
        settings_.width = wishes.width;
        settings_.height = wishes.height;
        View& view = settings_.view;
        view.azimuth = static_cast<float>(wishes.camera.azimuth);
        view.elevation = static_cast<float>(wishes.camera.elevation);
        view.distance.reset();
        if (wishes.camera.distance > 0)
            view.distance = static_cast<float>(wishes.camera.distance);
        const std::array<double, 3>& t = wishes.camera.target;
        const Vec3 target{static_cast<float>(t[0]), static_cast<float>(t[1]), static_cast<float>(t[2])};
        const Vec3 center = scene_->info.focus.box.center();
        view.target.reset();
        if (!(target == center))
            view.target = target;
        isDrawn_ = false;
        samples_ = 0;
    }

    void renderNext()
    {
        if (isRefined())
            return;
        const bool isFirst = !isDrawn_;
        if (isFirst || samples_ == 0) {
            // A single sample is in the middle of its pixel; several are spread over it.
            settings_.passes = isFirst ? 1 : 2;
            for (auto& cells : scene_->renderers)
                for (Renderer& renderer : cells)
                    renderer.look(settings_);
            ++params_.accumulationId;
        }
        std::optional<dfb::FrameReport> report;
        try {
            report = render();
        } catch (const dfb::FrameError& e) {
            const bool isSuperseded = e.info().kind == dfb::ErrorKind::Cancelled
                                      || (e.info().kind == dfb::ErrorKind::UserCode
                                          && e.info().message.find(Superseded::text) != std::string::npos);
            if (!isSuperseded)
                throw;
            samples_ = 0; // accumulation begins anew
            return;
        }
        ++frames_;
        isDrawn_ = true;
        samples_ += !isFirst;
        // The first of several samples is not shown: it looks worse than the sample in the middle, which is shown
        // already.
        if (fb_.isDisplayRank() && samples_ != 1)
            show(*report);
    }

    // Renders a frame. It fails on all ranks if the viewers have changed the camera or the size. The first frame of a
    // view fails only if they want a smaller one, which comes soon; otherwise nothing would be seen while the camera
    // moves.
    dfb::FrameReport render()
    {
        const FrameCamera camera = frameCamera(scene_->info, settings_, 0);
        const auto renderBrick = [&](const dfb::Brick& brick, auto& tile) {
            checkWanted();
            return static_cast<double>(scene_->of(brick.id).front().renderTile(tile, 0));
        };
        auto frame = [&] {
            if constexpr (isSingle) {
                return imageLoop_.start(
                    [&](auto& tile) {
                        checkWanted();
                        scene_->renderers.front().front().renderTile(tile, 0);
                    },
                    params_);
            } else if (o_.mode == Mode::Mixed) {
                return (mixedLoop_ ? *mixedLoop_ : mixedLoop_.emplace(fb_, *shared_, inTurn_))
                    .start(camera, renderBrick, params_);
            } else {
                return (dataLoop_ ? *dataLoop_ : dataLoop_.emplace(fb_, world_, *shared_))
                    .start(camera, renderBrick, params_);
            }
        }();
        if (!view_)
            return frame.end();
        owners_.clear();
        for (int tile = 0; tile < fb_.layout().tileCount(); ++tile)
            owners_.push_back(frame.tileOwner(tile));
        std::optional<dfb::FrameReport> report;
        view_->whileWatching(
            wishes_.look, !isDrawn_, [&] { frame.cancel(); }, [&] { report = frame.end(); });
        return *report;
    }

    void checkWanted() const
    {
        if (Interrupt::happened() || (view_ && view_->hasMoved(wishes_.look, !isDrawn_)))
            throw Superseded();
    }

    void show(const dfb::FrameReport& report)
    {
        LivePicture picture;
        picture.wishes = wishes_;
        const Focus& focus = scene_->info.focus;
        picture.distance = cameraDistance(focus, settings_.view, settings_.width, settings_.height);
        if (focus.box.largestExtent() > 0)
            picture.distance /= static_cast<double>(focus.box.largestExtent());
        picture.samples = std::max(1, samples_);
        picture.camera = words(picture.samples);
        picture.tileSize = fb_.layout().tileSize();
        picture.owners = owners_;
        view_->show(fb_.image().rgba8(), fb_.image().width(), fb_.image().height(), report, std::move(picture));
    }

    // Returns the options with which dfb_render makes the shown picture.
    std::string words(int samples) const
    {
        const View& view = settings_.view;
        const auto number = [](float value) { // the shortest text that is read as this number again
            char text[32];
            return std::string(text, std::to_chars(text, text + sizeof text, value).ptr);
        };
        std::string text = "--azimuth " + number(view.azimuth) + " --elevation " + number(view.elevation);
        if (view.distance)
            text += " --camera-distance " + number(*view.distance);
        if (view.target)
            text += " --target " + number(view.target->x) + ',' + number(view.target->y) + ',' + number(view.target->z);
        text += " --size " + std::to_string(settings_.width) + 'x' + std::to_string(settings_.height);
        if (samples > 1)
            text += " --spp " + std::to_string(samples);
        if (o_.pathBounces == 0)
            text += " --ao " + std::to_string(settings_.aoRays); // also 0, which is not the default for files
        return text + " --background " + number(params_.background[0]) + ',' + number(params_.background[1]) + ','
               + number(params_.background[2]);
    }

    Options o_;
    FrameBuffer fb_;
    std::unique_ptr<LiveView> view_; // on the display rank
    std::unique_ptr<RankScene> scene_;
    RenderSettings settings_;
    dfb::FrameConfig params_;
    dfb::World world_;
    std::optional<dfb::SharedWorld> shared_;
    dfb::RoundRobinBricks inTurn_;
    std::optional<dfb::DataParallelLoop<FrameBuffer>> dataLoop_;
    std::optional<dfb::MixedParallelLoop<FrameBuffer, dfb::RoundRobinBricks>> mixedLoop_;
    dfb::ImageParallelLoop<FrameBuffer> imageLoop_{fb_, dfb::WorkDistribution::Owned};

    LiveWishes wishes_; // those that all ranks know
    bool isBegun_ = false;
    bool isDrawn_ = false;    // there is a picture of this view
    std::vector<int> owners_; // of the tiles of the last frame
    int samples_ = 0;         // samples accumulated since then
    std::int64_t frames_ = 0;
};

} // namespace example
