// The paper's ways to render a generated scene: image-parallel, data-parallel, and mixed, where ranks hold several
// bricks of which each is held by several ranks. And the same without any ranks, to compare with.
#pragma once

#include "brick_grid.hpp"
#include "paper_brick.hpp"
#include "paper_measure.hpp"
#include "trace.hpp"

#include <dfb/dfb.hpp>

#include <array>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

namespace bench {

// A scene, seen by the ranks of a communicator. It must outlive the ways that it makes. Its members are collective.
class PaperStage {
public:
    // The communicator remains the caller's; `config` has all but the format.
    PaperStage(MPI_Comm comm, PaperScene scene, dfb::FrameBufferConfig config, int views)
        : scene_(std::move(scene)), connection_(dfb::connect<dfb::MpiTransport>(comm)), config_(std::move(config)),
          cameras_(orbitOf(views, unit, 1.5f)), width_(config_.image.width), height_(config_.image.height),
          rank_(rankIn(comm)), grid_(sizeOf(comm)), ranks_(sizeOf(comm))
    {
    }

    // Every rank has the whole scene.
    PaperWay imageParallel(const std::string& name, dfb::WorkDistribution distribution, dfb::OutputFormat format)
    {
        using FrameBuffer = dfb::DistributedFrameBuffer<dfb::ImageParallel>;
        hold(whole, {{0, 0, 0}, unit});
        return wayOf<FrameBuffer>(name, format, [this, distribution](FrameBuffer& fb) {
            const auto loop = std::make_shared<dfb::ImageParallelLoop<FrameBuffer>>(fb, distribution);
            return [this, loop](int view) { return loop->start([&](auto& tile) { render(whole, view, tile); }); };
        });
    }

    // Each rank has one brick.
    PaperWay dataParallel(const std::string& name, dfb::OutputFormat format)
    {
        using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend>;
        return wayOf<FrameBuffer>(name, format, [this](FrameBuffer& fb) {
            const auto world = std::make_shared<dfb::World>(worldOf(1));
            const auto loop = std::make_shared<dfb::DataParallelLoop<FrameBuffer>>(fb, *world);
            return [this, world, loop](int view) {
                return loop->start(camera(view),
                                   [&](const dfb::Brick& brick, auto& tile) { render(brick.id, view, tile); });
            };
        });
    }

    // As many bricks as ranks, of which each rank has `bricksPerRank`: its own and those of the next. `Owner`: who
    // renders which of its tiles.
    template <class Owner>
    PaperWay mixedParallel(const std::string& name, int bricksPerRank, dfb::OutputFormat format)
    {
        using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend>;
        const auto owner = std::make_shared<Owner>();
        PaperWay way = wayOf<FrameBuffer>(name, format, [this, owner, bricksPerRank](FrameBuffer& fb) {
            const auto world = std::make_shared<dfb::SharedWorld>(fb, worldOf(bricksPerRank));
            const auto loop = std::make_shared<dfb::MixedParallelLoop<FrameBuffer, Owner>>(fb, *world, *owner);
            return [this, owner, world, loop](int view) {
                // Its cost is CPU time, which says the same where ranks share cores.
                const auto renderBrick = [&](const dfb::Brick& brick, auto& tile) {
                    const double before = threadCpuSeconds();
                    render(brick.id, view, tile);
                    return 1e9 * (threadCpuSeconds() - before);
                };
                return loop->start(camera(view), renderBrick);
            };
        });
        if constexpr (std::is_same_v<Owner, dfb::MeasuredCostBricks>)
            way.frame = [frame = way.frame, report = way.report, owner](int view) {
                const double rendered = frame(view);
                owner->update(report());
                return rendered;
            };
        return way;
    }

    // Not collective: the whole scene by this rank alone, and without a framebuffer. Keeps it until forgetUncut(),
    // which only those may call that render in parts.
    std::vector<float> uncut(int view)
    {
        hold(whole, {{0, 0, 0}, unit});
        std::vector<float> rgba(4 * static_cast<std::size_t>(width_) * static_cast<std::size_t>(height_), 0.0f);
        config_.executor->parallelFor(static_cast<std::size_t>(height_), [&](std::size_t row) {
            Pixels to;
            to.region = {0, static_cast<int>(row), width_, static_cast<int>(row) + 1};
            to.width = width_, to.height = height_, to.stride = width_;
            to.color = rgba.data() + 4 * row * static_cast<std::size_t>(width_);
            bricks_.at(whole)->render(camera(view), to);
        });
        return rgba;
    }

    void forgetUncut() { bricks_.erase(whole); }

    // Of what all ways did, if its sink is in `config`. Collective.
    void write(const Trace& trace) const { write_(trace); }

private:
    static constexpr dfb::Vec3 unit{1, 1, 1};
    static constexpr std::uint32_t whole = std::numeric_limits<std::uint32_t>::max(); // the id of an uncut scene

    const dfb::PerspectiveCamera& camera(int view) const { return cameras_[static_cast<std::size_t>(view)]; }

    void hold(std::uint32_t id, const dfb::Box3& bounds)
    {
        if (bricks_.find(id) == bricks_.end())
            bricks_[id] = scene_.make(bounds, *config_.executor);
    }

    dfb::World worldOf(int bricksPerRank)
    {
        dfb::World world;
        for (int i = 0; i < bricksPerRank; ++i) {
            const int id = (rank_ + i) % ranks_;
            const dfb::Box3 bounds = grid_.box(id, unit);
            hold(static_cast<std::uint32_t>(id), bounds);
            world.add({static_cast<std::uint32_t>(id), bounds});
        }
        return world;
    }

    template <class Tile>
    void render(std::uint32_t id, int view, Tile& tile) const
    {
        Pixels to;
        to.region = tile.region;
        to.width = width_, to.height = height_, to.stride = Tile::size;
        to.color = tile.color;
        if constexpr (Tile::hasDepth)
            to.depth = tile.depth;
        bricks_.at(id)->render(camera(view), to);
    }

    // `loopOf(framebuffer)` returns what begins a frame of a view and renders this rank's part of it.
    template <class FrameBuffer, class LoopOf>
    PaperWay wayOf(const std::string& name, dfb::OutputFormat format, const LoopOf& loopOf)
    {
        dfb::FrameBufferConfig config = config_;
        config.image.format = format;
        const auto fb = std::make_shared<FrameBuffer>(connection_, config);
        const auto report = std::make_shared<dfb::FrameReport>();
        write_ = [fb](const Trace& trace) { trace.write(*fb); };
        PaperWay way;
        way.system = "dfb";
        way.config = name;
        way.frame = [fb, report, start = loopOf(*fb)](int view) {
            auto frame = start(view);
            const double rendered = now();
            *report = frame.end();
            return rendered;
        };
        way.image = [fb] {
            const float* rgba = fb->image().rgba32f();
            return std::vector<float>(rgba, rgba + 4 * fb->image().pixelCount());
        };
        way.traffic = [report] {
            return std::array<double, 2>{static_cast<double>(report->bytesSent),
                                         static_cast<double>(report->messagesSent)};
        };
        way.report = [report] { return *report; };
        return way;
    }

    PaperScene scene_;
    std::shared_ptr<dfb::Connection> connection_;
    dfb::FrameBufferConfig config_;
    std::vector<dfb::PerspectiveCamera> cameras_;
    int width_, height_, rank_;
    BrickGrid grid_;
    int ranks_;
    std::map<std::uint32_t, std::unique_ptr<PaperBrick>> bricks_; // that this rank holds, by id
    std::function<void(const Trace&)> write_;                     // through the last framebuffer that was made
};

} // namespace bench
