// MarchedBricks: each rank ray-marches a brick of 64^3 voxels, for real, and the images become one, as dfb or IceT make
// it. dfb sends tiles as they are finished, IceT composites when all is rendered.
#pragma once

#include "brick_grid.hpp"
#include "clip.hpp"
#include "frame_times.hpp"
#include "systems.hpp"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace bench {

class BrickMarcher {
public:
    static constexpr int voxels = 64; // along each side of a brick, which has length 1

    explicit BrickMarcher(const dfb::Box3& box) : box_(box), values_((voxels + 1) * (voxels + 1) * (voxels + 1))
    {
        std::size_t i = 0;
        for (int z = 0; z <= voxels; ++z)
            for (int y = 0; y <= voxels; ++y)
                for (int x = 0; x <= voxels; ++x)
                    values_[i++] = field(box.lower
                                         + dfb::Vec3{static_cast<float>(x) / voxels, static_cast<float>(y) / voxels,
                                                     static_cast<float>(z) / voxels});
    }

    // Pixel (x, y) of the image: premultiplied RGBA; returns the distance of the first sample. Not inlined, so that all
    // run the same code: where it was, it differed by a tenth in time.
#if defined(__GNUC__)
    __attribute__((noinline))
#endif
    float
    shade(const dfb::PerspectiveCamera& camera, int x, int y, int width, int height, float* rgba) const
    {
        const dfb::Vec3 eye = camera.eye(), d = camera.direction(x + 0.5, y + 0.5, width, height);
        float first = 0, last = 0;
        if (!clip(box_, 0, eye, d, first, last))
            return first;
        constexpr float step = 1.0f / voxels;
        float through = 1;
        for (float k = std::ceil(first / step); k * step < last; ++k) { // the same samples, however space is cut
            const float value = at(eye + k * step * d - box_.lower);
            const float alpha = std::min(std::max(value - 0.05f, 0.0f) * 0.35f, 0.9f);
            const float part = through * alpha;
            rgba[0] += part * (0.5f + value);
            rgba[1] += part * 0.6f;
            rgba[2] += part * (1.0f - value);
            rgba[3] += part;
            through *= 1 - alpha;
        }
        return first;
    }

private:
    // A turbulent field, which is the same whichever rank makes a part of it.
    static float field(const dfb::Vec3& p)
    {
        float sum = 0, weight = 0.5f, frequency = 3;
        for (int octave = 0; octave < 4; ++octave, weight *= 0.6f, frequency *= 2.1f)
            sum += weight * std::sin(frequency * p.x + 1.3f * std::sin(frequency * p.y))
                   * std::cos(frequency * p.z + 0.7f * std::sin(frequency * p.x));
        return sum;
    }

    float at(const dfb::Vec3& p) const
    {
        const auto place = [](float v) { return std::min(std::max(v * voxels, 0.0f), voxels - 0.001f); };
        const float x = place(p.x), y = place(p.y), z = place(p.z);
        const auto i = static_cast<int>(x), j = static_cast<int>(y), k = static_cast<int>(z);
        const float u = x - static_cast<float>(i), v = y - static_cast<float>(j), w = z - static_cast<float>(k);
        constexpr std::size_t row = voxels + 1, slice = row * row;
        const float* c = &values_[static_cast<std::size_t>(k) * slice + static_cast<std::size_t>(j) * row
                                  + static_cast<std::size_t>(i)];
        const auto mix = [](float a, float b, float t) { return a + t * (b - a); };
        return mix(mix(mix(c[0], c[1], u), mix(c[row], c[row + 1], u), v),
                   mix(mix(c[slice], c[slice + 1], u), mix(c[slice + row], c[slice + row + 1], u), v), w);
    }

    dfb::Box3 box_;
    std::vector<float> values_;
};

struct MarchedView {
    dfb::PerspectiveCamera camera;
    std::vector<int> order; // the ranks, front to back; their bricks have the same numbers
};

// A way to make the image.
struct MarchedSystem {
    std::string name;
    std::function<double(const MarchedView&)> frame{}; // collective; returns when this rank had rendered
    std::function<const float*()> image{};             // of the last frame, on rank 0; none without compositing
    // Of the last frame, by all ranks: bytes and messages sent. Collective; none without compositing.
    std::function<std::array<double, 2>()> traffic{};
    std::vector<Times> times{};
};

// Systems that it has made must not outlive it.
class MarchedBricks {
    // First, as it has to be known what it returns.
    auto renderer(const MarchedView& view) const
    {
        const dfb::Region whole = view.camera.project(boxOf(rank_), width_, height_).region();
        return [this, &view, whole](const dfb::Brick&, auto& tile) {
            const dfb::Region r = dfb::intersection(tile.region, whole);
            for (int y = r.y0; y < r.y1; ++y)
                for (int x = r.x0; x < r.x1; ++x) {
                    const int column = x - tile.region.x0, row = y - tile.region.y0;
                    const float depth = marcher_.shade(view.camera, x, y, width_, height_, tile.pixel(column, row));
                    if constexpr (std::decay_t<decltype(tile)>::hasDepth)
                        if (tile.pixel(column, row)[3] > 0)
                            tile.depth[row * std::decay_t<decltype(tile)>::size + column] = depth;
                    (void)depth;
                }
        };
    }

public:
    // Collective. The communicator remains the caller's; `config` has size and executor, and what else dfb should do.
    // `hasThreads`: see connectBy().
    MarchedBricks(MPI_Comm comm, dfb::FrameBufferConfig config, int viewCount, bool hasThreads = true)
        : comm_(comm), connection_(connectBy(comm, hasThreads)()), config_(std::move(config)),
          width_(config_.image.width), height_(config_.image.height), rank_(rankIn(comm)), grid_(sizeOf(comm)),
          marcher_(boxOf(rank_)), world_({{static_cast<std::uint32_t>(rank_), boxOf(rank_)}}),
          image_(4 * static_cast<std::size_t>(width_) * static_cast<std::size_t>(height_), 0.0f)
    {
        config_.image.format = dfb::OutputFormat::RGBA32F;
        ordered_ = std::make_unique<Ordered>(connection_, config_);
        shared_ = std::make_unique<dfb::SharedWorld>(*ordered_, world_);
        orderedLoop_.emplace(*ordered_, *shared_, owner_);
        for (const dfb::PerspectiveCamera& camera : orbitOf(viewCount, grid_.size(), 1.9f)) {
            MarchedView view{camera, {}};
            for (const int brick : dfb::visibilityOrder(*shared_, camera.eye()))
                view.order.push_back(static_cast<int>(shared_->bricks()[static_cast<std::size_t>(brick)].id));
            views_.push_back(std::move(view));
        }
    }

    const std::vector<MarchedView>& views() const { return views_; }
    // Of what dfb did, if its sink is in `config`. Collective.
    void write(const Trace& trace) { trace.write(*ordered_); }
    dfb::Box3 boxOf(int rank) const { return grid_.box(rank, grid_.size()); }

    MarchedSystem alone()
    {
        return {"rendering alone", [this](const MarchedView& view) { return (renderAll(view), now()); }};
    }

    // dfb that gets the order, as IceT does. Ids of bricks are the ranks, so that places in the shared world are, too.
    MarchedSystem inOrder(const std::string& name)
    {
        const auto report = std::make_shared<dfb::FrameReport>();
        return {name,
                [this, report](const MarchedView& view) {
                    auto frame = orderedLoop_->start(view.camera, view.order, renderer(view));
                    const double rendered = now();
                    *report = frame.end();
                    return rendered;
                },
                [this] { return ordered_->isDisplayRank() ? ordered_->image().rgba32f() : nullptr; },
                trafficOf(report)};
    }

    // All views one after the other, as one frame: up to config.framesInFlight are open at once, so that a rank that
    // has rendered its part of one begins the next. The view that it gets is not used.
    MarchedSystem inFlight(const std::string& name)
    {
        return {name,
                [this](const MarchedView&) {
                    std::deque<Ordered::Frame> open;
                    for (const MarchedView& view : views_) {
                        if (static_cast<int>(open.size()) == config_.framesInFlight) {
                            open.front().end();
                            open.pop_front();
                        }
                        open.push_back(orderedLoop_->start(view.camera, view.order, renderer(view)));
                    }
                    const double rendered = now();
                    for (auto& frame : open)
                        frame.end();
                    return rendered;
                },
                [this] { return ordered_->isDisplayRank() ? ordered_->image().rgba32f() : nullptr; }};
    }

    // dfb as in the paper: inputs are sorted by depth. Collective.
    MarchedSystem sorted(const std::string& name)
    {
        using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend>;
        const auto fb = std::make_shared<FrameBuffer>(connection_, config_);
        const auto loop = std::make_shared<dfb::DataParallelLoop<FrameBuffer>>(*fb, world_);
        const auto report = std::make_shared<dfb::FrameReport>();
        return {name,
                [this, loop, report](const MarchedView& view) {
                    auto frame = loop->start(view.camera, renderer(view));
                    const double rendered = now();
                    *report = frame.end();
                    return rendered;
                },
                [fb] { return fb->isDisplayRank() ? fb->image().rgba32f() : nullptr; }, trafficOf(report)};
    }

#ifdef DFB_BENCH_HAS_ICET
    // Collective.
    MarchedSystem icet(const IceTStrategy& strategy)
    {
        const auto icet = std::make_shared<IceT>(comm_, strategy, false, width_, height_);
        const auto result = std::make_shared<const float*>(nullptr);
        return {std::string("icet: ") + strategy.name,
                [this, icet, result](const MarchedView& view) {
                    const dfb::Region r = renderAll(view);
                    const double rendered = now();
                    icet->resetTraffic();
                    const int viewport[4] = {r.x0, r.y0, r.width(), r.height()};
                    *result = static_cast<const float*>(icet->composite(image_.data(), viewport, view.order));
                    return rendered;
                },
                [result] { return *result; },
                [this, icet] {
                    return std::array<double, 2>{reduce(comm_, static_cast<double>(icet->bytesSent()), MPI_SUM),
                                                 reduce(comm_, static_cast<double>(icet->messagesSent()), MPI_SUM)};
                }};
    }
#endif

private:
    using Ordered = dfb::DistributedFrameBuffer<dfb::BasicOrderedBlend<64>>;

    static std::function<std::array<double, 2>()> trafficOf(const std::shared_ptr<dfb::FrameReport>& report)
    {
        return [report] {
            return std::array<double, 2>{static_cast<double>(report->bytesSent),
                                         static_cast<double>(report->messagesSent)};
        };
    }

    // This rank's brick into image_; returns where that may be.
    dfb::Region renderAll(const MarchedView& view)
    {
        const dfb::Region r = view.camera.project(boxOf(rank_), width_, height_).region();
        constexpr int band = 16; // rows
        config_.executor->parallelFor(static_cast<std::size_t>((r.height() + band - 1) / band), [&](std::size_t i) {
            const int first = r.y0 + band * static_cast<int>(i);
            for (int y = first; y < std::min(first + band, r.y1); ++y)
                for (int x = r.x0; x < r.x1; ++x) {
                    float* pixel = &image_[4
                                           * (static_cast<std::size_t>(y) * static_cast<std::size_t>(width_)
                                              + static_cast<std::size_t>(x))];
                    std::fill_n(pixel, 4, 0.0f);
                    marcher_.shade(view.camera, x, y, width_, height_, pixel);
                }
        });
        return r;
    }

    MPI_Comm comm_;
    std::shared_ptr<Connection> connection_;
    dfb::FrameBufferConfig config_;
    int width_, height_, rank_;
    BrickGrid grid_;
    BrickMarcher marcher_;
    dfb::World world_;
    std::unique_ptr<Ordered> ordered_;
    std::unique_ptr<dfb::SharedWorld> shared_;
    dfb::RoundRobinBricks owner_;
    std::optional<dfb::OrderedLoop<Ordered, dfb::RoundRobinBricks>> orderedLoop_;
    std::vector<MarchedView> views_;
    std::vector<float> image_; // what IceT is given
};

} // namespace bench
