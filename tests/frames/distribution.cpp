// Bricks that several ranks hold, and bricks in a known order. In one process and over MPI (everywhere.hpp).

#include "everywhere.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

namespace frame_cases {

using Blend = dfb::BasicAlphaBlend<16>;
using BlendFrameBuffer = dfb::DistributedFrameBuffer<Blend, dfb::NoPixelOp, Transport>;

// Brick i is held by `copies` ranks: i, i + 1, ..., modulo the number of ranks.
inline dfb::World replicated(const std::vector<dfb::Brick>& bricks, int rank, int size, int copies)
{
    dfb::World world;
    for (int i = 0; i < static_cast<int>(bricks.size()); ++i)
        for (int k = 0; k < std::min(copies, size); ++k)
            if ((i + k) % size == rank)
                world.add(bricks[static_cast<std::size_t>(i)]);
    return world;
}

// ---- the image does not show who rendered what ------------------------------------------------------------------

struct Mixed {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(7, 3, 97, 61, 3);
        BlendFrameBuffer fb(communicator, configOf(s, 2));
        const auto check = [&](const dfb::FrameReport& report, const std::string& name) {
            const std::uint64_t hash = checkedHash(result, fb, report, s, name);
            result.expect(result.hash == 0 || result.hash == hash, name + ": another image");
            result.hash = hash;
        };
        check(dfb::DataParallelLoop(fb, dfb::World(bricksOf(s, fb.rank(), fb.size())))
                  .render(
                      scene::FlatCamera(), [&](const dfb::Brick& b, auto& tile) { renderBrick(s, b, tile); },
                      paramsOf(s)),
              "data-parallel");
        for (const int copies : {1, 2, fb.size()}) {
            const dfb::SharedWorld world(fb, replicated(s.bricks, fb.rank(), fb.size(), copies));
            result.expect(world.bricks().size() == s.bricks.size(), "bricks of all ranks");
            const std::string name = std::to_string(copies) + " copies";
            std::mutex mutex;
            std::map<std::tuple<std::uint32_t, int, int>, int> rendered;
            const auto render = [&](const dfb::Brick& b, auto& tile) {
                renderBrick(s, b, tile);
                const std::lock_guard<std::mutex> lock(mutex);
                ++rendered[{b.id, tile.tile, tile.pass}];
                return 1.0;
            };
            const auto renderedOnce = [&](const std::string& what) {
                const std::int64_t pairs =
                    static_cast<std::int64_t>(visibleTiles(world, scene::FlatCamera(), fb.layout()).size());
                const std::int64_t all =
                    fb.allReduce({static_cast<std::int64_t>(rendered.size())}, decltype(fb)::Reduce::Sum).front();
                result.expect(all == 3 * pairs, what + ": " + std::to_string(all) + " tiles of bricks rendered of "
                                                    + std::to_string(3 * pairs));
                rendered.clear();
            };
            const auto inTurn = [&](auto dealer) {
                const auto report =
                    dfb::MixedParallelLoop(fb, world, dealer).render(scene::FlatCamera(), render, paramsOf(s));
                result.expect(report.figures.empty(), "costs that nobody wants");
                check(report, name + ", round robin");
                renderedOnce(name + ", round robin");
            };
            inTurn(dfb::RoundRobinBricks());
            inTurn(scene::PassesInTurn());
            dfb::MeasuredCostBricks owner;
            dfb::MixedParallelLoop loop(fb, world, owner);
            for (int frame = 0; frame < 3; ++frame) {
                const auto report = loop.render(scene::FlatCamera(), render, paramsOf(s));
                owner.update(report);
                check(report, name + ", by cost");
                renderedOnce(name + ", by cost");
            }
        }
        return result;
    }
};

// If two ranks have a brick with the same id and different bounds, all ranks get an error that says so.
struct OtherBounds {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(2);
        BlendFrameBuffer fb(communicator, configOf(s, 1));
        const auto wide = static_cast<float>(1 + (fb.rank() == fb.size() - 1 ? 1 : 0));
        const std::string outcome = scene::outcomeOf([&] {
            const dfb::SharedWorld world(fb, dfb::World({{7, {{0, 0, 0}, {wide, 1, 1}}}}));
        });
        result.expect(fb.size() == 1 ? outcome == "fine" : scene::has(outcome, "brick 7 has other bounds"), outcome);
        // 0 and -0 are the same place.
        const float zero = fb.rank() == 0 ? -0.0f : 0.0f;
        const dfb::SharedWorld one(fb, dfb::World({{1, {{zero, 0, 0}, {1, 1, 1}}}}));
        result.expect(one.bricks().size() == 1, "a brick that begins at 0 and at -0");
        // Two ids with the same bounds are two bricks.
        const dfb::SharedWorld world(fb, dfb::World({{1, {{0, 0, 0}, {1, 1, 1}}}, {2, {{0, 0, 0}, {1, 1, 1}}}}));
        result.expect(world.bricks().size() == 2, "two bricks with equal bounds");
        return result;
    }
};

// All data are in one corner of the view, most of them in one brick. If two ranks hold each brick, the slowest rank has
// much less work, and less still if measured costs decide who renders.
struct Unbalanced {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        scene::Scene s = scene::makeScene(0, 1, 256, 256, 1);
        const int size = std::max(2, communicatorSize(communicator));
        for (int i = 0; i < size; ++i) { // side by side, the first one is the largest
            const float x0 = i == 0 ? 0 : 64.0f + 8.0f * static_cast<float>(i - 1),
                        x1 = 64.0f + 8.0f * static_cast<float>(i);
            s.bricks.push_back({static_cast<std::uint32_t>(i), {{x0, 0, 0}, {x1, 96, 1}}});
        }
        BlendFrameBuffer fb(communicator, configOf(s, 1));
        std::atomic<std::int64_t> samples{0};
        const auto render = [&](const dfb::Brick& b, auto& tile) {
            renderBrick(s, b, tile);
            const dfb::Region r = dfb::intersection(tile.region, scene::FlatCamera().project(b.bounds, 0, 0));
            const std::int64_t here = static_cast<std::int64_t>(r.width()) * r.height();
            samples += here;
            return static_cast<double>(here);
        };
        const auto slowest = [&] {
            return static_cast<double>(fb.allReduce({samples.exchange(0)}, decltype(fb)::Reduce::Max).front());
        };
        dfb::DataParallelLoop(fb, replicated(s.bricks, fb.rank(), fb.size(), 1))
            .render(scene::FlatCamera(), render, paramsOf(s));
        const double dataParallel = slowest();
        const dfb::SharedWorld world(fb, replicated(s.bricks, fb.rank(), fb.size(), 2));
        dfb::RoundRobinBricks inTurn;
        dfb::MixedParallelLoop(fb, world, inTurn).render(scene::FlatCamera(), render, paramsOf(s));
        const double roundRobin = slowest();
        dfb::MeasuredCostBricks byCost;
        dfb::MixedParallelLoop loop(fb, world, byCost);
        byCost.update(loop.render(scene::FlatCamera(), render, paramsOf(s)));
        slowest();
        const auto report = loop.render(scene::FlatCamera(), render, paramsOf(s));
        const double measured = slowest();
        if (fb.size() > 1) {
            const std::string text = std::to_string(dataParallel) + " samples on the slowest rank data-parallel, "
                                     + std::to_string(roundRobin) + " dealt out, " + std::to_string(measured)
                                     + " by cost";
            result.expect(measured <= 0.65 * dataParallel, text);
            result.expect(measured < roundRobin, text);
        }
        if (fb.isDisplayRank())
            result.expect(wrongValues(scene::Picture(fb.image(), report), referenceOf(s)) == 0, "values");
        return result;
    }

    // The scene has a brick per rank, so the image depends on the number of ranks. Hence run() returns no hash to
    // compare.
    static int communicatorSize(const Transport::Communicator& communicator)
    {
        dfb::FrameBufferConfig config;
        config.image.width = config.image.height = 1;
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        return BlendFrameBuffer(communicator, config).size();
    }
};

// ---- in a known order ------------------------------------------------------------------------------------------

// Boxes of glass with bubbles, seen by a camera among them.
struct Ordered {
    static std::vector<dfb::Brick> boxes()
    {
        std::vector<dfb::Brick> all;
        for (int z = 0; z < 3; ++z)
            for (int y = 0; y < 2; ++y)
                for (int x = 0; x < 2; ++x) {
                    const auto i = static_cast<std::uint32_t>(all.size());
                    const auto at = [](int v, float shift) { return 1.5f * static_cast<float>(v) + shift; };
                    const dfb::Vec3 lower{at(x, 0), at(y, 0.1f * static_cast<float>(x)), at(z, 0)};
                    const float side = i % 3 == 0 ? 0.9f : 1.4f; // those with 1.4 nearly touch
                    all.push_back({11 - i, {lower, lower + dfb::Vec3{side, side, side}}});
                }
        return all;
    }

    static float enter(const dfb::Box3& b, const dfb::Vec3& eye, const dfb::Vec3& d)
    {
        float first = 0, last = 1e30f;
        const auto axis = [&](float lo, float hi, float e, float v) {
            const float t0 = (lo - e) / v, t1 = (hi - e) / v;
            first = std::max(first, std::min(t0, t1));
            last = std::min(last, std::max(t0, t1));
        };
        axis(b.lower.x, b.upper.x, eye.x, d.x);
        axis(b.lower.y, b.upper.y, eye.y, d.y);
        axis(b.lower.z, b.upper.z, eye.z, d.z);
        return first < last ? first : -1;
    }

    // A camera of which loops cannot tell where its rays begin.
    struct AnyCamera {
        dfb::PerspectiveCamera camera;
        auto project(const dfb::Box3& box, int width, int height) const { return camera.project(box, width, height); }
    };

    enum class Way { Sorted, Told, ToldByData, InOrder };

    template <Way way>
    static void render(const Transport::Communicator& communicator, Result& result, int copies, bool inPlace,
                       std::int64_t& bytes, std::uint64_t* depthHash = nullptr)
    {
        using Op = std::conditional_t<way == Way::InOrder, dfb::BasicOrderedBlend<16>, Blend>;
        const dfb::Vec3 eye{0.7f, 0.8f, 6.5f}, target{1.1f, 1.0f, 0};
        const dfb::PerspectiveCamera camera(eye, target, {0, 1, 0}, 50);
        dfb::FrameBufferConfig config;
        config.image.width = 97;
        config.image.height = 61;
        config.image.format = dfb::OutputFormat::RGBA32F;
        config.image.depth = depthHash != nullptr;
        config.executor = std::make_shared<dfb::ThreadExecutor>(2);
        dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, Transport> fb(communicator, config);
        const dfb::World mine = replicated(boxes(), fb.rank(), fb.size(), copies);
        const dfb::SharedWorld world(fb, mine);
        const auto shade = [&](const dfb::Brick& b, int x, int y, float* rgba, float& depth) {
            const float t = enter(b.bounds, eye, camera.direction(x + 0.5, y + 0.5, 97, 61));
            const bool isNearest = t < depth; // as renderers of several surfaces ask; a started tile has no surface
            if (t < 0 || !isNearest || (x + y) % 11 == static_cast<int>(b.id) % 11)
                return;
            rgba[3] = 0.3f + 0.05f * static_cast<float>(b.id % 5);
            rgba[b.id % 3] = rgba[3] * 0.9f;
            depth = t;
        };
        const auto renderBrick = [&](const dfb::Brick& b, auto& tile) {
            tile.forEachPixel([&](int x, int y, float* rgba, float& depth) { shade(b, x, y, rgba, depth); });
        };
        // The same pixels as rendered images of all bricks, for rendering in place.
        constexpr std::size_t stride = 97 + 5;
        struct BrickImage {
            std::vector<float> rgba = std::vector<float>(4 * stride * 61, 0.0f);
            std::vector<float> depth = std::vector<float>(stride * 61, std::numeric_limits<float>::infinity());
        };
        std::map<std::uint32_t, BrickImage> images;
        for (const dfb::SharedBrick& b : world.bricks())
            for (std::size_t i = 0; i < stride * 61; ++i)
                if (BrickImage& image = images[b.id]; i % stride < 97)
                    shade(b, static_cast<int>(i % stride), static_cast<int>(i / stride), &image.rgba[4 * i],
                          image.depth[i]);
        const auto findBrick = dfb::inPlace([&](const dfb::Brick& b, auto& view) {
            const std::size_t first =
                static_cast<std::size_t>(view.region.y0) * stride + static_cast<std::size_t>(view.region.x0);
            view.stride = stride;
            view.color = &images.at(b.id).rgba[4 * first];
            view.depth = &images.at(b.id).depth[first];
        });
        dfb::FrameConfig params;
        params.passes = 2;
        params.background = {0.1f, 0.2f, 0.3f, 1};
        scene::PassesInTurn owner;
        const auto frame = [&](const auto& brickSource) {
            if constexpr (way == Way::InOrder)
                return dfb::OrderedLoop(fb, world, owner)
                    .render(camera, dfb::visibilityOrder(world, eye), brickSource, params);
            else if constexpr (way == Way::ToldByData)
                return dfb::DataParallelLoop(fb, mine, world).render(camera, brickSource, params);
            else if constexpr (way == Way::Told)
                return dfb::MixedParallelLoop(fb, world, owner).render(camera, brickSource, params);
            else
                return dfb::MixedParallelLoop(fb, world, owner).render(AnyCamera{camera}, brickSource, params);
        };
        const dfb::FrameReport report = inPlace ? frame(findBrick) : frame(renderBrick);
        bytes = report.bytesSent;
        if (!fb.isDisplayRank())
            return;
        const std::uint64_t hash = dfb::testing::hashOf(fb.image().rgba32f(), 16 * fb.image().pixelCount());
        result.expect(result.hash == 0 || result.hash == hash, "another image, " + std::to_string(copies) + " copies");
        result.hash = hash;
        if (!depthHash)
            return;
        const std::uint64_t depths = dfb::testing::hashOf(fb.image().depth(), 4 * fb.image().pixelCount());
        result.expect(*depthHash == 0 || *depthHash == depths, "another depth");
        *depthHash = depths;
    }

    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        std::int64_t bytes = 0;
        std::uint64_t depthHash = 0;
        render<Way::Sorted>(communicator, result, 1, true, bytes, &depthHash);
        render<Way::Told>(communicator, result, 1, true, bytes, &depthHash);
        for (const int copies : {1, 2}) {
            std::int64_t sorted = 0, told = 0, toldByData = 0, ordered = 0;
            for (const bool inPlace : {true, false}) {
                render<Way::Sorted>(communicator, result, copies, inPlace, sorted);
                render<Way::Told>(communicator, result, copies, inPlace, told);
                if (copies == 1)
                    render<Way::ToldByData>(communicator, result, copies, inPlace, toldByData);
                render<Way::InOrder>(communicator, result, copies, inPlace, ordered);
            }
            for (const std::int64_t without : {told, toldByData, ordered})
                result.expect(sorted == 0 || without < sorted, "no depth to send, and yet " + std::to_string(without)
                                                                   + " bytes beside " + std::to_string(sorted));
        }
        return result;
    }
};

// No case waits for this time-out.
scene::Scene threeBricks()
{
    scene::Scene s = scene::makeScene(3, 6);
    s.timeout = std::chrono::milliseconds(5000);
    return s;
}

// An order that lacks a source, or that differs between ranks, fails the frame on all ranks; the next frame is right.
struct WrongOrder {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = threeBricks();
        BlendFrameBuffer fb(communicator, configOf(s, 1));
        const dfb::World world(bricksOf(s, fb.rank(), fb.size()));
        dfb::DataParallelLoop loop(fb, world);
        const auto frame = [&](const std::vector<std::uint32_t>& sources) {
            dfb::FrameConfig params = paramsOf(s);
            params.order = std::make_shared<const dfb::SourceOrder>(sources);
            return scene::outcomeOf([&] {
                loop.render(
                    scene::FlatCamera(), [&](const dfb::Brick& b, auto& tile) { renderBrick(s, b, tile); }, params);
            });
        };
        std::vector<std::uint32_t> all;
        for (const dfb::Brick& brick : s.bricks)
            all.push_back(brick.id);
        std::vector<std::uint32_t> few(all.begin() + 1, all.end()), other(all.rbegin(), all.rend());
        const auto expect = [&](const std::string& outcome, const std::string& text) {
            result.expect(scene::has(outcome, text), outcome);
        };
        expect(frame(few), "which is not in the order of the frame");
        expect(frame(all), "fine");
        expect(frame(fb.rank() == 0 ? all : other), fb.size() == 1 ? "fine" : "FrameConfig::order is one with hash");
        expect(frame(all), "fine");
        expect(scene::outcomeOf([] { dfb::SourceOrder({1, 2, 1}); }), "source 1 comes twice");
        return result;
    }
};

// An owner that names a rank without the brick, or an order that does not have each brick once, is an error on all
// ranks; the next frame is right.
struct WrongOwner {
    struct Owner {
        int size = 1, shift = 0; // shift: from the first rank that has it; -1: no rank

        int operator()(const dfb::SharedBrick& brick, int, int) const
        {
            return shift < 0 ? size : (brick.ranks.front() + shift) % size;
        }
    };

    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        runOn(communicator, true, result);
        runOn(communicator, false, result); // each rank counts as a node, so loops ask for owners before begin()
        return result;
    }

    static void runOn(const Transport::Communicator& communicator, bool sharedMemory, Result& result)
    {
        const scene::Scene s = threeBricks();
        dfb::NetworkConfig network;
        network.sharedMemory = sharedMemory;
        BlendFrameBuffer fb(communicator, configOf(s, 1), network);
        dfb::DistributedFrameBuffer<dfb::BasicOrderedBlend<16>, dfb::NoPixelOp, Transport> inOrder(
            communicator, configOf(s, 1), network);
        const dfb::World mine(bricksOf(s, fb.rank(), fb.size()));
        const dfb::SharedWorld world(fb, mine);
        const auto render = [&](const dfb::Brick& b, auto& tile) {
            if (std::none_of(mine.bricks().begin(), mine.bricks().end(), [&](auto& m) { return m.id == b.id; }))
                result.expect(false, "a brick that this rank does not have is rendered");
            renderBrick(s, b, tile);
        };
        const auto frame = [&](Owner owner, const std::vector<int>& order, bool isOrdered) {
            return scene::outcomeOf([&] {
                if (isOrdered)
                    dfb::OrderedLoop(inOrder, world, owner).render(scene::FlatCamera(), order, render, paramsOf(s));
                else
                    dfb::MixedParallelLoop(fb, world, owner).render(scene::FlatCamera(), render, paramsOf(s));
            });
        };
        for (const bool isOrdered : {false, true}) {
            for (const int shift : {1, -1}) {
                const std::string outcome = frame({fb.size(), shift}, {0, 1, 2}, isOrdered);
                result.expect(shift == 1 && fb.size() == 1 ? outcome == "fine"
                                                           : scene::has(outcome, "which does not hold it"),
                              outcome);
                const std::string after = frame({fb.size(), 0}, {0, 1, 2}, isOrdered);
                result.expect(after == "fine", "the frame after: " + after);
            }
        }
        for (const std::vector<int>& order :
             std::vector<std::vector<int>>{{0, 1}, {0, 1, 1}, {0, 1, 3}, {-1, 1, 2}, {0, 1, 2, 0}, {}}) {
            const std::string outcome = frame({fb.size(), 0}, order, true);
            result.expect(scene::has(outcome, "the order does not have each brick once"), outcome);
        }
    }
};

} // namespace frame_cases

TEST_CASE("Mixed-parallel rendering gives the data-parallel image, whoever renders what", "[distribution]")
{
    everywhere<frame_cases::Mixed>();
}

TEST_CASE("A brick has the same bounds everywhere, and an id of its own", "[distribution]")
{
    everywhere<frame_cases::OtherBounds>();
}

TEST_CASE("Two ranks per brick take a third and more of the slowest rank's work, by cost most", "[distribution]")
{
    everywhere<frame_cases::Unbalanced>();
}

TEST_CASE("Bricks in a known order blend to the image of sorted ones, without depth", "[distribution]")
{
    everywhere<frame_cases::Ordered>();
}

TEST_CASE("An order without a source, or another on each rank, fails the frame on all of them", "[distribution]")
{
    everywhere<frame_cases::WrongOrder>();
}

TEST_CASE("An owner that has not got the brick, or a wrong order, is an error on all ranks", "[distribution]")
{
    everywhere<frame_cases::WrongOwner>();
}
