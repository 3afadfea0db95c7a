// The work that a frame skips: its cost as less of the image is active, and the work that is left out altogether. Each
// claim is a line: what was measured, its limit, and whether it holds. 4 ranks are threads of this process; no MPI.
//   bench_skip [--size 1024x1024] [--frames 12] [--quick] [--counts-only] [--json FILE] [--svg FILE] [--table FILE]
//   [--commit ID] bench_skip --frames-of full|empty [--frames N] [--size ...] [--trace FILE]
//                                                       N frames of that and nothing else, for profilers
// The exit status is 1 if a claim of counts does not hold. Times are shown, as a machine may have other work.
#include "clip.hpp"
#include "counted_transport.hpp"
#include "options.hpp"
#include "pixel_bricks.hpp"
#include "plot.hpp"
#include "results.hpp"
#include "trace.hpp"

#include <dfb/distributed_framebuffer.hpp>
#include <dfb/ops/progressive.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/render/loops.hpp>
#include <dfb/render/mixed_parallel.hpp>
#include <dfb/render/sampling.hpp>
#include <dfb/wire/fragment_message.hpp>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <numeric>
#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace {

using bench::Figure;
using bench::Kind;
using bench::MessageCount;
using bench::text;

constexpr int ranks = 4;

// ---- the images: all ranks have the same pixels, a square in the middle, at depths of their own

class Picture {
public:
    // `share`: of the image's pixels that are active.
    Picture(int width, int height, double share, float alpha = 0.25f) : width_(width)
    {
        const double side = std::sqrt(share);
        const auto columns = static_cast<int>(std::lround(width * side)),
                   rows = static_cast<int>(std::lround(height * side));
        region_.x0 = (width - columns) / 2, region_.x1 = region_.x0 + columns;
        region_.y0 = (height - rows) / 2, region_.y1 = region_.y0 + rows;
        const std::size_t pixels = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
        rgba_.assign(4 * pixels, 0.0f);
        for (int y = region_.y0; y < region_.y1; ++y)
            for (int x = region_.x0; x < region_.x1; ++x) {
                float* const rgba = &rgba_[4 * indexOf(x, y)];
                rgba[0] = 0.03f * static_cast<float>((x + 3 * y) % 7); // not constant
                rgba[1] = rgba[2] = rgba[3] = alpha;
            }
        for (int rank = 0; rank < ranks; ++rank)
            depths_.emplace_back(pixels, static_cast<float>(rank));
    }

    const dfb::Region& region() const { return region_; }
    double activePixels() const { return static_cast<double>(region_.width()) * region_.height(); }

    // `zeros`: for channels beside colour and depth, as many as the image has pixels, times 3.
    template <class View>
    void show(int rank, View& view, const std::vector<float>& zeros) const
    {
        const std::size_t first = indexOf(view.region.x0, view.region.y0);
        view.stride = static_cast<std::size_t>(width_);
        view.color = &rgba_[4 * first];
        view.depth = &depths_[static_cast<std::size_t>(rank)][first];
        if (!zeros.empty())
            view.normal = view.albedo = zeros.data();
    }

private:
    std::size_t indexOf(int x, int y) const
    {
        return static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(x);
    }

    int width_;
    dfb::Region region_;
    std::vector<float> rgba_;
    std::vector<std::vector<float>> depths_; // of each rank
};

// ---- frames

// Of all ranks.
struct FrameCost {
    MessageCount all, inputs, manifests;
    Figure ms;
    std::int64_t rendered = 0; // tiles, in the last frame
};

struct Settings {
    int width = 0, height = 0, frames = 0;
    bool knowsBounds = true; // a renderer knows where it has pixels; else it has a look at every tile
    dfb::ChannelMask aux = 0;
    double renderUs = 0; // CPU time of rendering a tile
    std::string trace{}; // the file for one; empty: none
};

void useCpu(double us)
{
    const double end = bench::threadCpuSeconds() + 1e-6 * us;
    while (bench::threadCpuSeconds() < end) {
    }
}

MessageCount countOf(const bench::Counters& counters, std::initializer_list<Kind> kinds)
{
    MessageCount sum;
    for (const bench::Traffic& traffic : counters.sent)
        sum += traffic.of(kinds);
    return sum;
}

void reset(bench::Counters& counters)
{
    for (bench::Traffic& traffic : counters.sent)
        traffic.reset();
}

// The same picture in each frame, which is said to the framebuffer.
template <class TileOp>
FrameCost framesOf(const Picture& picture, const Settings& s)
{
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, bench::CountedTransport>;
    const auto counters = std::make_shared<bench::Counters>(ranks);
    std::atomic<std::int64_t> rendered{0};
    std::vector<double> ms;
    const std::vector<float> zeros(
        s.aux != 0 ? 3 * static_cast<std::size_t>(s.width) * static_cast<std::size_t>(s.height) : 0, 0.0f);
    FrameCost cost;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        const int rank = communicator.rank();
        dfb::FrameBufferConfig config(s.width, s.height);
        config.image.aux = s.aux;
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        const bench::Trace trace(s.trace);
        config.trace = trace.sink;
        FrameBuffer fb(bench::CountedTransport::Communicator{communicator, counters}, config);
        const dfb::World world =
            bench::worldOf(rank, s.knowsBounds ? picture.region() : dfb::Region{0, 0, s.width, s.height});
        dfb::DataParallelLoop loop(fb, world);
        std::optional<dfb::SharedWorld> shared; // all bricks, front to back
        dfb::RoundRobinBricks owner;
        std::optional<dfb::OrderedLoop<FrameBuffer, dfb::RoundRobinBricks>> orderedLoop;
        std::vector<int> order;
        if constexpr (TileOp::rule == dfb::BlendRule::InOrder) {
            shared.emplace(fb, world);
            orderedLoop.emplace(fb, *shared, owner);
            order.resize(shared->bricks().size());
            std::iota(order.begin(), order.end(), 0);
        }
        const auto find = dfb::inPlace([&](const dfb::Brick&, auto& view) {
            ++rendered;
            useCpu(s.renderUs);
            picture.show(rank, view, zeros);
        });
        for (int frame = 0; frame < s.frames; ++frame) {
            counters->meet();
            if (rank == 0) {
                reset(*counters);
                rendered = 0;
            }
            counters->meet();
            const double start = bench::now();
            dfb::FrameConfig params;
            params.maxLayers = ranks;
            if constexpr (TileOp::rule == dfb::BlendRule::InOrder)
                orderedLoop->render(bench::PixelCamera(), order, find, params);
            else
                loop.render(bench::PixelCamera(), find, params);
            const double end = bench::now();
            counters->meet();
            if (rank != 0)
                continue;
            if (frame > 0)
                ms.push_back(1e3 * (end - start));
            for (const bench::Traffic& traffic : counters->sent)
                cost.all += frame + 1 == s.frames ? traffic.all() : MessageCount();
        }
        counters->meet();
        trace.write(fb);
    });
    cost.inputs = countOf(*counters, {Kind::Fragment});
    cost.manifests = countOf(*counters, {Kind::Manifest, Kind::ManifestAck});
    cost.ms = bench::figureOf(ms);
    cost.rendered = rendered;
    return cost;
}

// ---- what is behind something opaque

// Tiles of four bricks, a rank each, in views around them: all that they project to, those that had to be rendered as
// nothing opaque hides them, and those that were.
struct OrbitTiles {
    std::int64_t all = 0, needed = 0, rendered = 0;
};

constexpr int orbitViews = 36;

dfb::PerspectiveCamera orbitCamera(int view)
{
    const double angle = 2 * 3.14159265358979 * (view + 0.5) / orbitViews;
    return dfb::PerspectiveCamera({5 * static_cast<float>(std::sin(angle)), 1, 5 * static_cast<float>(std::cos(angle))},
                                  {0, 0, 0}, {0, 1, 0}, 35);
}

// Solid and opaque boxes, two by two.
dfb::Box3 orbitBox(int rank)
{
    const auto x = static_cast<float>(rank % 2), z = static_cast<float>(rank / 2);
    return {{x - 1, -1, z - 1}, {x, 1, z}};
}

bool hits(const dfb::Box3& box, const dfb::PerspectiveCamera& camera, const dfb::TileLayout& layout, int x, int y)
{
    const dfb::Vec3 direction = camera.direction(x + 0.5, y + 0.5, layout.width(), layout.height());
    float enter = 0, leave = 0;
    return bench::clip(box, 0, camera.eye(), direction, enter, leave) && enter < leave;
}

// Adds those of a tile in a view. `order`: the bricks, front to back.
void addTile(OrbitTiles& tiles, const dfb::Region& region, const dfb::TileLayout& layout, const dfb::SharedWorld& world,
             const std::vector<int>& order, const dfb::PerspectiveCamera& camera)
{
    bool isHidden = false;
    for (const int b : order) {
        const dfb::Box3& box = world.bricks()[static_cast<std::size_t>(b)].bounds;
        if (!camera.project(box, layout.width(), layout.height()).meets(region))
            continue;
        ++tiles.all;
        tiles.needed += !isHidden;
        int count = 0;
        for (int y = region.y0; y < region.y1; ++y)
            for (int x = region.x0; x < region.x1; ++x)
                count += hits(box, camera, layout, x, y);
        isHidden = isHidden || count == region.width() * region.height();
    }
}

OrbitTiles orbitAround(int width, int height, double renderUs)
{
    using FrameBuffer = dfb::DistributedFrameBuffer<dfb::OrderedBlend, dfb::NoPixelOp, dfb::InprocTransport>;
    OrbitTiles tiles;
    std::atomic<std::int64_t> rendered{0};
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config(width, height);
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        FrameBuffer fb(communicator, config);
        const dfb::SharedWorld world(fb, dfb::World({{static_cast<std::uint32_t>(fb.rank()), orbitBox(fb.rank())}}));
        dfb::RoundRobinBricks owner;
        dfb::OrderedLoop loop(fb, world, owner);
        for (int view = -1; view < orbitViews; ++view) { // the first one is to be hidden by nobody
            const dfb::PerspectiveCamera camera = orbitCamera(view);
            const std::vector<int> order = dfb::visibilityOrder(world, camera.eye());
            loop.render(camera, order, [&](const dfb::Brick& brick, auto& tile) {
                rendered += view >= 0;
                useCpu(renderUs);
                tile.forEachPixel([&](int x, int y, float* rgba, float&) {
                    if (hits(brick.bounds, camera, fb.layout(), x, y))
                        std::fill_n(rgba, 4, 1.0f);
                });
            });
            for (int t = 0; view >= 0 && fb.isDisplayRank() && t < fb.layout().tileCount(); ++t)
                addTile(tiles, fb.layout().region(t), fb.layout(), world, order, camera);
        }
    });
    tiles.rendered = rendered;
    return tiles;
}

// The CPU time in us of blending 16 inputs of a tile.
double blendUs(float frontAlpha, float minTransmittance)
{
    constexpr int side = dfb::AlphaBlend::tileSize, layers = 16;
    using Tile = dfb::Tile<dfb::colorChannel | dfb::depthChannel, side>;
    const auto pool = dfb::MemoryPool::create();
    const dfb::TileLayout layout(side, side, side);
    const dfb::detail::WireCoder coder;
    const auto tile = std::make_unique<Tile>();
    tile->frame = tile->tile = 0;
    tile->region = {0, 0, side, side};
    std::vector<float> out(4 * side * side);
    dfb::detail::Planes planes;
    planes.at[dfb::detail::Color] = reinterpret_cast<std::byte*>(out.data());
    dfb::TileInfo info;
    info.region = tile->region;
    info.minTransmittance = minTransmittance;
    dfb::AlphaBlend op;
    std::vector<double> us;
    for (int repetition = 0; repetition < 201; ++repetition) {
        op.newFrame(info);
        for (int layer = 0; layer < layers; ++layer) {
            const float alpha = layer == 0 ? frontAlpha : 0.2f;
            for (int i = 0; i < side * side; ++i) {
                const float red = alpha * 0.1f * static_cast<float>(i % 7);
                const float rgba[4] = {red, 0, alpha, alpha};
                std::copy_n(rgba, 4, tile->color + 4 * i);
                tile->depth[i] = static_cast<float>(layer);
            }
            tile->source = static_cast<std::uint32_t>(layer);
            dfb::detail::InputFaults faults;
            op.add(dfb::detail::decodeFragment(
                *pool,
                dfb::detail::encodeFragment(*pool, *tile, Tile::channels, 0, nullptr, coder, dfb::WireFormat::Float32,
                                            faults),
                layout, [](int) { return 1; }, nullptr, coder));
        }
        dfb::FinishedTile finished(info.region, dfb::OutputFormat::RGBA32F, planes, side);
        const double start = bench::threadCpuSeconds();
        op.finish(finished);
        us.push_back(1e6 * (bench::threadCpuSeconds() - start));
    }
    return bench::figureOf(us).median;
}

// ---- tiles that have converged

struct Sampling {
    int frames = 0;                         // until all tiles had converged
    std::int64_t tiles = 0, stillNoisy = 0; // in all; those that got samples in the frame that was looked at
    std::int64_t convergedRenders = 0;      // renderer's calls for others in that frame
    std::int64_t renders = 0;
    MessageCount inputs;             // in that frame
    MessageCount last, lastOfPixels; // in a frame after all had converged: all, and inputs and finished tiles
    std::int64_t lastRenders = 0;
};

// Only the left half of the image has noise. The second frame is looked at, and one when there is nothing to do.
Sampling sample(int width, int height)
{
    using TileOp = dfb::Progressive<dfb::AlphaBlend>;
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, bench::CountedTransport>;
    const auto counters = std::make_shared<bench::Counters>(ranks);
    std::atomic<std::int64_t> renders{0}, convergedRenders{0};
    Sampling result;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config(width, height);
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        FrameBuffer fb(bench::CountedTransport::Communicator{communicator, counters}, config);
        const dfb::World world = bench::worldOf(fb.rank(), {0, 0, width, height});
        dfb::DataParallelLoop loop(fb, world);
        dfb::AdaptiveSampler sampler(fb.layout(), {0.02, 4, 256, 64});
        dfb::SamplePlan plan;
        const auto render = [&](const dfb::Brick& brick, auto& tile) {
            ++renders;
            convergedRenders += (*plan)[static_cast<std::size_t>(tile.tile)].count == 0;
            tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
                const unsigned mixed =
                    (static_cast<unsigned>(x * 7919 + y * 104729 + tile.sample * 31) * 2654435761u) >> 16;
                const float noise = x < width / 2 ? static_cast<float>(mixed % 256) / 255 : 0.5f;
                rgba[0] = 0.2f * noise;
                rgba[3] = 0.2f;
                depth = static_cast<float>(brick.id);
            });
        };
        const auto frame = [&] {
            counters->meet();
            if (fb.rank() == 0) {
                reset(*counters);
                renders = convergedRenders = 0;
            }
            counters->meet();
            dfb::FrameConfig params = sampler.next();
            plan = params.samples;
            sampler.update(loop.render(bench::PixelCamera(), render, params));
            counters->meet();
        };
        int frames = 0;
        for (; !sampler.done(); ++frames) {
            frame();
            if (frames != 1 || fb.rank() != 0)
                continue;
            result.tiles = fb.layout().tileCount();
            result.stillNoisy = std::count_if(plan->begin(), plan->end(), [](const auto& t) { return t.count > 0; });
            result.renders = renders;
            result.convergedRenders = convergedRenders;
            result.inputs = countOf(*counters, {Kind::Fragment});
        }
        frame();
        if (fb.rank() == 0) {
            result.frames = frames;
            for (const bench::Traffic& traffic : counters->sent)
                result.last += traffic.all();
            result.lastOfPixels = countOf(*counters, {Kind::Fragment, Kind::FinishedTiles});
            result.lastRenders = renders;
        }
        counters->meet();
    });
    return result;
}

// ---- the program

struct Options {
    int width = 1024, height = 1024, frames = 0;
    bool quick = false, countsOnly = false;
    std::string framesOf, json, svg, table, trace, commit;
};

class Bench {
public:
    explicit Bench(Options options) : o_(std::move(options)) {}

    int run()
    {
        measureShares();
        measureDeclarations();
        measureChannels();
        if (!o_.countsOnly)
            measureOpaque();
        measureConverged();
        const std::string title = "Claims, " + sizeText();
        claims_.print(title);
        claims_.appendTo(o_.table, title);
        bench::appendJson(o_.json, results_);
        std::printf("\n%s\n", failures_ == 0 ? "All claims hold that are counted." : "SOME CLAIMS DO NOT HOLD.");
        return failures_ == 0 ? 0 : 1;
    }

private:
    std::string sizeText() const { return std::to_string(o_.width) + 'x' + std::to_string(o_.height); }
    Settings settings() const
    {
        Settings s;
        s.width = o_.width, s.height = o_.height, s.frames = o_.frames;
        return s;
    }

    enum class Sort { Counted, Shown };
    void claim(const std::string& what, double measured, const char* form, double limit, Sort sort = Sort::Counted)
    {
        const bool holds = measured <= limit;
        failures_ += !holds && sort == Sort::Counted;
        claims_.add({what, text(form, measured), text(form, limit),
                     std::string(holds ? "yes" : "NO") + (sort == Sort::Shown ? " (shown)" : "")});
    }

    void keep(const std::string& config, const FrameCost& cost, const std::string& more)
    {
        bench::Result r{"skip", "dfb", config, "square", ranks, o_.width, o_.height, o_.commit};
        r.ms = cost.ms;
        r.bytes = static_cast<double>(cost.all.bytes);
        r.messages = static_cast<double>(cost.all.messages);
        r.more = more;
        results_.push_back(std::move(r));
    }

    void measureShares()
    {
        bench::Table table({"active [%]", "ms", "bytes", "messages", "bytes, of full [%]", "messages", "time"});
        std::vector<double> pixels, bytes;
        bench::PlotLine bytesLine{"bytes", {}, 0}, timeLine{"time", {}, 1};
        FrameCost full;
        for (const double percent : {100.0, 50.0, 25.0, 10.0, 1.0, 0.0}) {
            const Picture picture(o_.width, o_.height, percent / 100);
            const FrameCost cost = framesOf<dfb::AlphaBlend>(picture, settings());
            if (percent == 100)
                full = cost;
            pixels.push_back(picture.activePixels());
            bytes.push_back(static_cast<double>(cost.all.bytes));
            bytesLine.points.emplace_back(percent, ofFull(cost.all.bytes, full.all.bytes));
            timeLine.points.emplace_back(percent, 100 * cost.ms.median / full.ms.median);
            addRow(table, text("%g", percent), cost, full);
            keep(text("%g %% active", percent), cost, text(R"(, "active_share": %g)", percent / 100));
            if (percent > 0)
                continue;
            Settings blind = settings();
            blind.knowsBounds = false;
            const FrameCost found = framesOf<dfb::AlphaBlend>(picture, blind);
            addRow(table, "0, found out tile by tile", found, full);
            keep("0 % active, found out", found, R"(, "active_share": 0)");
            claim("an empty frame: bytes, % of a full one", ofFull(cost.all.bytes, full.all.bytes), "%.3f", 3);
            claim("its messages, %", ofFull(cost.all.messages, full.all.messages), "%.2f", 3);
            claim("its time, %", 100 * cost.ms.median / full.ms.median, "%.1f", 3, Sort::Shown);
            claim("an empty frame that is found out tile by tile: bytes, %", ofFull(found.all.bytes, full.all.bytes),
                  "%.2f", 3);
        }
        const std::string title =
            "A frame as less of it is active, " + sizeText() + ", 4 ranks of which each has it all";
        table.print(title);
        table.appendTo(o_.table, title);
        if (!o_.svg.empty())
            bench::writePlot(o_.svg, "A frame as less of it is active, " + sizeText() + ", 4 ranks",
                             "active pixels [% of the image]", "% of a full frame", {bytesLine, timeLine}, false);
        claim("bytes off a line through the active pixels, % of a full frame", offLine(pixels, bytes), "%.2f", 1);
    }

    static double ofFull(std::int64_t part, std::int64_t full)
    {
        return 100.0 * static_cast<double>(part) / static_cast<double>(full);
    }

    static void addRow(bench::Table& table, const std::string& name, const FrameCost& cost, const FrameCost& full)
    {
        table.add({name, bench::text(cost.ms), std::to_string(cost.all.bytes), std::to_string(cost.all.messages),
                   text("%.3f", ofFull(cost.all.bytes, full.all.bytes)),
                   text("%.2f", ofFull(cost.all.messages, full.all.messages)),
                   text("%.1f", 100 * cost.ms.median / full.ms.median)});
    }

    // The most that a value is off the line of least squares, in % of the largest value.
    static double offLine(const std::vector<double>& x, const std::vector<double>& y)
    {
        const auto n = static_cast<double>(x.size());
        double sx = 0, sy = 0, sxx = 0, sxy = 0, most = 0;
        for (std::size_t i = 0; i < x.size(); ++i)
            sx += x[i], sy += y[i], sxx += x[i] * x[i], sxy += x[i] * y[i];
        const double slope = (n * sxy - sx * sy) / (n * sxx - sx * sx), base = (sy - slope * sx) / n;
        for (std::size_t i = 0; i < x.size(); ++i)
            most = std::max(most, std::abs(y[i] - base - slope * x[i]));
        return 100 * most / *std::max_element(y.begin(), y.end());
    }

    void measureDeclarations()
    {
        Settings s = settings();
        s.frames = 2;
        const FrameCost cost = framesOf<dfb::AlphaBlend>(Picture(o_.width, o_.height, 0.25), s);
        claim("manifests and answers in a second frame with the same bricks and camera",
              static_cast<double>(cost.manifests.messages), "%.0f", 0);
    }

    void measureChannels()
    {
        const double share = 0.25;
        const Picture picture(o_.width, o_.height, share);
        Settings s = settings();
        s.frames = 2;
        constexpr dfb::ChannelMask more = dfb::normalChannel | dfb::albedoChannel;
        const FrameCost sorted = framesOf<dfb::AlphaBlend>(picture, s);
        const FrameCost ordered = framesOf<dfb::OrderedBlend>(picture, s);
        using WithAux = dfb::BasicAlphaBlend<64, dfb::colorChannel | dfb::depthChannel | more>;
        const FrameCost unasked = framesOf<WithAux>(picture, s);
        s.aux = more;
        const FrameCost asked = framesOf<WithAux>(picture, s);
        // Where all ranks have the same tiles, each sends those of the three others.
        const double travelling = (sorted.inputs.bytes - ordered.inputs.bytes) / 4.0;
        const auto perPixel = [&](const FrameCost& cost) {
            return static_cast<double>(cost.inputs.bytes - sorted.inputs.bytes) / travelling;
        };
        claim("bytes of a pixel that an image without auxiliary channels adds, whose operation has them",
              perPixel(unasked), "%.3f", 0);
        claim("with normals and albedo asked for", perPixel(asked), "%.3f", 24);
        const double pixels = (ranks - 1) * picture.activePixels();
        claim("depth where the order is known: bytes of inputs beyond 16 a pixel, %",
              100 * (static_cast<double>(ordered.inputs.bytes) / (16 * pixels) - 1), "%.2f", 1);
        claim("all other operations: bytes of inputs beyond 20 a pixel, %",
              100 * (static_cast<double>(sorted.inputs.bytes) / (20 * pixels) - 1), "%.2f", 1);
        keep("25 % active, in order", ordered, "");
        keep("25 % active, normals and albedo", asked, "");
    }

    void measureOpaque()
    {
        const double all = blendUs(0.2f, 0), hidden = blendUs(1.0f, 0), nearly = blendUs(0.9999f, 1e-3f);
        claim("16 inputs of a tile, the front one opaque: time of blending, % of that of translucent ones",
              100 * hidden / all, "%.1f", 50, Sort::Shown);
        claim("the front one opaque but for 1e-4, minTransmittance 1e-3", 100 * nearly / all, "%.1f", 50, Sort::Shown);
        // Ranks behind may learn too late that they are hidden. In the first frame no rank knows that it will be
        // hidden.
        Settings s = settings();
        s.frames = 3;
        s.renderUs = 200;
        const FrameCost translucent = framesOf<dfb::OrderedBlend>(Picture(o_.width, o_.height, 0.25), s);
        const FrameCost opaque = framesOf<dfb::OrderedBlend>(Picture(o_.width, o_.height, 0.25, 1), s);
        claim("4 ranks with the same pixels in order, the front one's opaque: bytes of inputs, % of translucent ones'",
              ofFull(opaque.inputs.bytes, translucent.inputs.bytes), "%.1f", 25, Sort::Shown);
        claim("tiles rendered, %", ofFull(opaque.rendered, translucent.rendered), "%.1f", 35, Sort::Shown);
        const OrbitTiles orbit = orbitAround(o_.width, o_.height, 200);
        const auto percent = [&](std::int64_t of) {
            return 100 * static_cast<double>(of) / static_cast<double>(orbit.all);
        };
        char text[160];
        std::snprintf(text, sizeof text, "36 views around 2x2 opaque boxes: tiles rendered, %%; %.1f had to be",
                      percent(orbit.needed));
        claim(text, percent(orbit.rendered), "%.1f", 1.2 * percent(orbit.needed), Sort::Shown);
    }

    void measureConverged()
    {
        const Sampling s = sample(512, 512);
        claim("adaptive, second frame: calls of the renderer for tiles that have converged ("
                  + std::to_string(s.tiles - s.stillNoisy) + " of " + std::to_string(s.tiles) + ", calls for others "
                  + std::to_string(s.renders) + ")",
              static_cast<double>(s.convergedRenders), "%.0f", 0);
        claim("inputs beyond those of the other tiles",
              std::max(0.0,
                       static_cast<double>(s.inputs.messages) - static_cast<double>(s.renders) * (ranks - 1) / ranks),
              "%.0f", 0);
        claim("all converged after " + std::to_string(s.frames) + " frames: calls of the renderer",
              static_cast<double>(s.lastRenders), "%.0f", 0);
        claim("inputs and finished tiles, messages", static_cast<double>(s.lastOfPixels.messages), "%.0f", 0);
        // The verdict up and down, and that there are no finished tiles.
        claim("all messages: that all have declared, and those that end the frame",
              static_cast<double>(s.last.messages), "%.0f", 5 * (ranks - 1));
    }

    Options o_;
    int failures_ = 0;
    bench::Table claims_{{"claim", "measured", "at most", "holds"}};
    std::vector<bench::Result> results_;
};

Options optionsOf(int argc, char** argv)
{
    Options o;
    const auto readContent = [&](const std::string& value) {
        o.framesOf = value;
        return value == "full" || value == "empty";
    };
    bench::readOptions(
        argc, argv,
        "usage: bench_skip [--size WxH] [--frames N] [--quick] [--counts-only] [--json FILE] [--svg FILE] [--table "
        "FILE] [--commit "
        "ID]\n"
        "       bench_skip --frames-of full|empty [--size WxH] [--frames N] [--trace FILE]\n"
        "  --counts-only  without the claims that the exit status does not depend on: those of opaque inputs\n"
        "  --frames-of  renders so many frames of a full or an empty image and measures nothing: for a profiler",
        {{"--size", [&o](const std::string& value) { return bench::readSize(value, o.width, o.height); }},
         {"--frames", bench::readNumber(o.frames, 1)},
         {"--frames-of", readContent},
         {"--json", bench::readText(o.json)},
         {"--svg", bench::readText(o.svg)},
         {"--table", bench::readText(o.table)},
         {"--trace", bench::readText(o.trace)},
         {"--commit", bench::readText(o.commit)}},
        {{"--quick", &o.quick}, {"--counts-only", &o.countsOnly}});
    if (o.frames == 0)
        o.frames = o.quick ? 4 : 12;
    return o;
}

} // namespace

int main(int argc, char** argv)
{
    const Options o = optionsOf(argc, argv);
    if (o.framesOf.empty())
        return Bench(o).run();
    Settings s;
    s.width = o.width, s.height = o.height, s.frames = o.frames;
    s.trace = o.trace;
    const FrameCost cost = framesOf<dfb::AlphaBlend>(Picture(s.width, s.height, o.framesOf == "full" ? 1 : 0), s);
    std::printf("%d frames, %s: the last sent %lld bytes in %lld messages\n", o.frames, o.framesOf.c_str(),
                static_cast<long long>(cost.all.bytes), static_cast<long long>(cost.all.messages));
    return 0;
}
