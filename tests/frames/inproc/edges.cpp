// Edges: images and tiles of every odd size, data on few ranks, framebuffers made and destroyed in any order, user code
// with threads of its own. Ranks are threads.
#include "catch.hpp"
#include "large_image.hpp"
#include "random_scene.hpp"

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#if defined(DFB_HAS_TBB)
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>
#endif

namespace edges_cases {

namespace {

using Inproc = dfb::InprocTransport;
template <class TileOp>
using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, Inproc>;

// Number of wrong values in an image of `ranks` ranks. With `deal` -1, the last rank has all bricks.
template <int TileSize>
std::size_t wrongIn(const scene::Scene& s, int ranks, int deal = 0)
{
    std::size_t wrong = 0;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<dfb::BasicAlphaBlend<TileSize>> fb(communicator, configOf(s));
        for (int frame = 0; frame < 2; ++frame) {
            const auto report = scene::renderLoop(fb, s, scene::Loop::Declared, deal);
            if (fb.isDisplayRank())
                wrong += wrongValues(scene::Picture(fb.image(), report), referenceOf(s));
        }
    });
    return wrong;
}

} // namespace

TEST_CASE("Images of one pixel, one row, one column and prime sizes, with more ranks than tiles", "[edges]")
{
    for (const auto& [width, height] : std::vector<std::pair<int, int>>{{1, 1}, {1, 97}, {101, 1}, {31, 37}})
        for (const int deal : {0, -1})
            for (const int ranks : {1, 5}) {
                scene::Scene s = scene::makeScene(4, 3, width, height);
                s.bricks[0].bounds = {{0, 0, 0}, {static_cast<float>(width), static_cast<float>(height), 1}};
                INFO(width << "x" << height << ", " << ranks << " ranks, deal " << deal);
                CHECK(wrongIn<8>(s, ranks, deal) == 0);
                CHECK(wrongIn<256>(s, ranks, deal) == 0);
            }
}

TEST_CASE("The smallest and the largest tiles, and what is between", "[edges]")
{
    const scene::Scene s = scene::makeScene(5, 4, 300, 270);
    CHECK(wrongIn<8>(s, 3) == 0);
    CHECK(wrongIn<24>(s, 3) == 0); // not a power of two
    CHECK(wrongIn<256>(s, 3) == 0);
}

TEST_CASE("An image of 16384 x 16384 pixels of which little is touched", "[edges]")
{
    scene::Scene s;
    s.width = s.height = 16384;
    s.background = {};
    s.bricks.push_back({7, {{16000, 16100, 0}, {16384, 16384, 1}}}); // the last corner
    dfb::FrameReport report;                                         // of the display rank
    std::size_t wrong = 0;
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        auto config = configOf(s);
        config.image.format = dfb::OutputFormat::RGBA8; // 1 GiB
        config.image.depth = false;
        FrameBuffer<dfb::BasicAlphaBlend<64>> fb(communicator, config);
        const auto mine = scene::renderLoop(fb, s, scene::Loop::Declared, -1);
        if (!fb.isDisplayRank())
            return;
        report = mine;
        for (int y = 16000; y < 16384; y += 3)
            for (int x = 15900; x < 16384; x += 3) {
                std::vector<dfb::testing::Sample> samples;
                if (const auto sample = sampleOf(s, s.bricks[0], 0, x, y))
                    samples.push_back(*sample);
                const auto expected = dfb::testing::composite(samples, s.background);
                const std::size_t pixel = 4 * (static_cast<std::size_t>(y) * 16384 + static_cast<std::size_t>(x));
                for (std::size_t c = 0; c < 4; ++c)
                    wrong += static_cast<std::size_t>(fb.image().rgba8()[pixel + c]
                                                      != dfb::testing::toUnorm8(expected.rgba[c]));
            }
    });
    CHECK(wrong == 0);
    CHECK(report.tilesTotal == 256 * 256);
    CHECK(report.tilesTouched == 6 * 5);
    CHECK(report.bytesSent < 4 << 20);
}

TEST_CASE("Sizes and counts of the largest images are right: none is a number of 32 bits", "[edges]")
{
    for (const auto& [width, height] : std::vector<std::pair<int, int>>{{65536, 32768}, {65536, 65536}}) {
        const std::uint64_t pixels = static_cast<std::uint64_t>(width) * static_cast<std::uint64_t>(height);
        INFO(width << "x" << height);
        CHECK(dfb::Image(*dfb::MemoryPool::create(), width, height, dfb::OutputFormat::None, 0).pixelCount() == pixels);
        CHECK(pixels * dfb::bytesPerPixel(dfb::OutputFormat::RGBA32F) == std::uint64_t{16} * pixels);
        for (const int size : {8, 64, 256}) {
            const dfb::TileLayout layout(width, height, size);
            const int count = layout.tileCount();
            CHECK(static_cast<std::uint64_t>(count) * static_cast<std::uint64_t>(size * size) == pixels);
            const dfb::Region last = layout.region(count - 1);
            CHECK((last.x0 == width - size && last.y0 == height - size && last.x1 == width && last.y1 == height));
            for (const auto& owner : {dfb::latticeOwner, dfb::linearOwner, dfb::hashOwner})
                for (const int tile : {0, count / 2, count - 1}) {
                    const int rank = owner(tile, layout, 100000);
                    CHECK((rank >= 0 && rank < 100000));
                }
            CHECK(dfb::linearOwner(count - 1, layout, 100000) == 100000 - (100000 + count - 1) / count);
        }
    }
}

TEST_CASE("A frame of 65536 x 32768 pixels, 32 GiB in float, that no rank displays", "[edges]")
{
    const int width = 65536, height = 32768;
    scene::Scene s;
    s.width = width, s.height = height;
    s.bricks.push_back({7, {{65000, 32500, 0}, {65536, 32768, 1}}}); // the last corner
    std::vector<dfb::FrameReport> reports(2);
    std::atomic<std::int64_t> pixels{0};
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        auto config = configOf(s);
        config.image.format = dfb::OutputFormat::None;
        config.image.depth = false;
        FrameBuffer<dfb::BasicAlphaBlend<256>> fb(communicator, config);
        reports[static_cast<std::size_t>(fb.rank())] =
            dfb::DataParallelLoop(fb, dfb::World(bricksOf(s, fb.rank(), fb.size())))
                .render(scene::FlatCamera(), [&](const dfb::Brick& b, auto& tile) {
                    const dfb::Region r = dfb::intersection(tile.region, scene::FlatCamera().project(b.bounds, 0, 0));
                    pixels += static_cast<std::int64_t>(r.width()) * r.height();
                    renderBrick(s, b, tile);
                });
    });
    for (const dfb::FrameReport& report : reports) {
        CHECK(report.tilesTotal == 256 * 128);
        CHECK(report.tilesTouched == 3 * 2);
    }
    CHECK(pixels == 536 * 268);
}

TEST_CASE("A float image of 2.25 GiB travels to the display rank", "[edges][.stress]")
{
    std::string wrong = "no image";
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        const std::string mine = largeImage<Inproc>(communicator, true);
        if (communicator.rank() == 0)
            wrong = mine;
    });
    CHECK(wrong == "");
}

TEST_CASE("Framebuffers on one connection are made and gone in any order", "[edges]")
{
    const scene::Scene s = scene::makeScene(5, 3);
    std::size_t wrong = 0; // written by the display rank
    int images = 0;
    dfb::runRanks(3, [&](dfb::InprocCommunicator communicator) {
        using Fb = FrameBuffer<dfb::BasicAlphaBlend<16>>;
        const auto connection = dfb::connect<Inproc>(communicator);
        std::vector<std::unique_ptr<Fb>> alive(4);
        for (std::uint64_t step = 0; step < 40; ++step) { // the same on all ranks
            auto& one = alive[scene::mix(step) % alive.size()];
            if (one && scene::mix(step + 99) % 2)
                one.reset();
            else if (!one)
                one = std::make_unique<Fb>(connection, configOf(s));
            if (!one)
                continue;
            const auto report = scene::renderLoop(*one, s, scene::Loop::Declared);
            if (one->isDisplayRank())
                wrong += wrongValues(scene::Picture(one->image(), report), referenceOf(s)), ++images;
        }
    });
    CHECK(wrong == 0);
    CHECK(images > 15);
}

TEST_CASE("A sum over all ranks that is too large wraps around", "[edges]")
{
    const std::int64_t most = std::numeric_limits<std::int64_t>::max(), least = -most - 1;
    std::atomic<int> wrong{0};
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<dfb::BasicAlphaBlend<16>> fb(communicator, configOf(scene::makeScene(1)));
        const bool isFirst = fb.rank() == 0;
        const auto sums = fb.allReduce({isFirst ? most : 1, isFirst ? -1 : least}, decltype(fb)::Reduce::Sum);
        wrong += sums != std::vector<std::int64_t>{least, most};
    });
    CHECK(wrong == 0);
}

#if defined(DFB_HAS_TBB)
TEST_CASE("A framebuffer is used inside the user's own TBB arena, by several of its threads", "[edges]")
{
    const scene::Scene s = scene::makeScene(6, 8);
    std::size_t wrong = 0; // written by the display rank
    int images = 0;
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        tbb::task_arena arena(2);
        auto config = configOf(s);
        config.executor = std::make_shared<dfb::TbbExecutor>(2);
        using Fb = FrameBuffer<dfb::BasicAlphaBlend<16>>;
        Fb fb(communicator, config);
        for (int frame = 0; frame < 5; ++frame) {
            auto params = paramsOf(s);
            params.declared = true;
            auto open = fb.begin(params);
            const auto mine = bricksOf(s, fb.rank(), fb.size());
            const auto pairs = visibleTiles(dfb::World(mine), scene::FlatCamera(), fb.layout());
            open.declare(inputsOf(dfb::World(mine), pairs));
            arena.execute([&] {
                tbb::parallel_for(std::size_t{0}, pairs.size(), [&](std::size_t i) {
                    const auto tile = std::make_unique<Fb::Tile>();
                    const dfb::Brick& brick = mine[static_cast<std::size_t>(pairs[i].brick)];
                    open.start(*tile, pairs[i].tile);
                    tile->generation = 1;
                    tile->source = brick.id;
                    renderBrick(s, brick, *tile);
                    open.setTile(*tile);
                });
            });
            dfb::FrameReport report;
            arena.execute([&] { report = open.end(); }); // waits in there, too
            if (fb.isDisplayRank())
                wrong += wrongValues(scene::Picture(fb.image(), report), referenceOf(s)), ++images;
        }
        for (const int slots : {1, 2}) { // a whole loop in there, also with no slot but the caller's
            tbb::task_arena small(slots);
            dfb::FrameReport report;
            small.execute([&] { report = scene::renderLoop(fb, s, scene::Loop::Declared); });
            if (fb.isDisplayRank())
                wrong += wrongValues(scene::Picture(fb.image(), report), referenceOf(s)), ++images;
        }
    });
    CHECK(wrong == 0);
    CHECK(images == 7);
}
#endif

} // namespace edges_cases
