// What a frame costs, in bytes, messages and allocations: counted, as a clock would have to be believed.
#include "catch.hpp"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <limits>
#include <memory>
#include <new>
#include <vector>

// Sanitizers have an operator new of their own.
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define COUNTERS_WITHOUT_ALLOCATIONS
#elif defined(__has_feature)
#if __has_feature(address_sanitizer) || __has_feature(thread_sanitizer)
#define COUNTERS_WITHOUT_ALLOCATIONS
#endif
#endif

namespace {

std::atomic<std::int64_t> allocations{0};

} // namespace

#if !defined(COUNTERS_WITHOUT_ALLOCATIONS)
namespace {

void* allocate(std::size_t bytes, std::size_t alignment)
{
    ++allocations;
    void* block = alignment > alignof(std::max_align_t)
                      ? std::aligned_alloc(alignment, (bytes + alignment - 1) / alignment * alignment)
                      : std::malloc(bytes > 0 ? bytes : 1);
    if (!block)
        throw std::bad_alloc();
    return block;
}

#if defined(__GNUC__)
__attribute__((noinline)) // or the compiler takes it for a mistake
#endif
void release(void* block)
{
    std::free(block);
}

} // namespace

// Those of the whole program.
void* operator new(std::size_t bytes) { return allocate(bytes, 1); }
void* operator new[](std::size_t bytes) { return allocate(bytes, 1); }
void* operator new(std::size_t bytes, std::align_val_t a) { return allocate(bytes, static_cast<std::size_t>(a)); }
void* operator new[](std::size_t bytes, std::align_val_t a) { return allocate(bytes, static_cast<std::size_t>(a)); }
void operator delete(void* block) noexcept { release(block); }
void operator delete[](void* block) noexcept { release(block); }
void operator delete(void* block, std::size_t) noexcept { release(block); }
void operator delete[](void* block, std::size_t) noexcept { release(block); }
void operator delete(void* block, std::align_val_t) noexcept { release(block); }
void operator delete[](void* block, std::align_val_t) noexcept { release(block); }
void operator delete(void* block, std::size_t, std::align_val_t) noexcept { release(block); }
void operator delete[](void* block, std::size_t, std::align_val_t) noexcept { release(block); }
#endif

namespace {

constexpr int ranks = 4, side = 512, tileSide = 64, tileCount = (side / tileSide) * (side / tileSide);

// Every box covers the image.
std::atomic<int> projections{0};
struct WholeImage {
    dfb::Region project(const dfb::Box3&, int, int) const
    {
        ++projections;
        return {0, 0, side, side};
    }
};

struct Cost {
    dfb::FrameReport report; // of the last frame
    std::int64_t allocations = 0;
    int projections = 0; // of boxes, on all ranks
};

// Frames of the same picture: each rank has an image of which the first `rows` rows have something.
template <class TileOp>
Cost cost(int rows, bool declaresAgain = false, int frames = 4)
{
    Cost result;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config;
        config.width = config.height = side;
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        using Fb = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, dfb::InprocTransport>;
        Fb fb(communicator, config);
        dfb::World world;
        const auto depth = static_cast<float>(fb.rank());
        if (rows > 0)
            world.add({static_cast<std::uint32_t>(fb.rank()), {{0, 0, depth}, {1, 1, depth + 1}}});
        const std::size_t pixels = static_cast<std::size_t>(side) * side;
        std::vector<float> rgba(4 * pixels, 0.0f), depths(pixels, std::numeric_limits<float>::infinity());
        std::fill_n(rgba.begin(), 4 * side * rows, 0.25f);
        for (std::size_t i = 0; i < static_cast<std::size_t>(side * rows); ++i) {
            rgba[4 * i] = 0.25f * static_cast<float>(i % 7) / 7; // not constant
            depths[i] = depth;
        }
        const auto find = dfb::inPlace([&](const dfb::Brick&, auto& view) {
            const std::size_t first =
                static_cast<std::size_t>(view.region.y0) * side + static_cast<std::size_t>(view.region.x0);
            view.stride = side;
            view.color = &rgba[4 * first];
            view.depth = &depths[first];
        });
        const auto meet = [&] { fb.allReduce({0}, Fb::Reduce::Sum); };
        for (int frame = 0; frame < frames; ++frame) {
            meet();
            const std::int64_t before = allocations;
            const int projectionsBefore = projections;
            meet();
            dfb::FrameParams params;
            params.declarationKey = declaresAgain ? 0 : 1;
            const dfb::FrameReport report = dfb::renderDataParallel(fb, world, WholeImage(), find, params);
            meet();
            if (fb.isDisplayRank())
                result = {report, allocations - before, projections - projectionsBefore};
            meet();
        }
    });
    return result;
}

// What travels of `pixels` active pixels of all ranks to be composited: those whose owner is another rank.
double expectedBytes(double rows, double bytesPerPixel)
{
    return (ranks - 1) * rows * side * bytesPerPixel  // each rank has all tiles, and owns one in four
           + (ranks - 1.0) / ranks * side * rows * 4; // the finished ones, 8 bits a channel
}

} // namespace

TEST_CASE("A frame sends its active pixels, and little else", "[counters]")
{
    // Rows by the tile, so that whole tiles are sent.
    for (const int rows : {64, 256, 512}) {
        const Cost sorted = cost<dfb::AlphaBlend>(rows), nearest = cost<dfb::DepthComposite>(rows);
        INFO(rows << " rows: " << sorted.report.bytesSent << " bytes, expected at least " << expectedBytes(rows, 20));
        for (const Cost& c : {sorted, nearest}) {
            CHECK(static_cast<double>(c.report.bytesSent) >= expectedBytes(rows, 20));
            CHECK(static_cast<double>(c.report.bytesSent)
                  <= expectedBytes(rows, 20) * 1.01 + 64 * 3 * tileCount + 4096);
        }
    }
    // Half a tile is a half, and rows that are not there cost nothing.
    const double half = static_cast<double>(cost<dfb::AlphaBlend>(32).report.bytesSent),
                 whole = static_cast<double>(cost<dfb::AlphaBlend>(64).report.bytesSent);
    const double inputs = (ranks - 1) * 64.0 * side * 20;
    CHECK(whole - half >= inputs * 0.49);
}

TEST_CASE("Bytes grow with the active pixels, along a line", "[counters]")
{
    std::vector<std::int64_t> bytes;
    for (const int rows : {64, 192, 320, 448})
        bytes.push_back(cost<dfb::AlphaBlend>(rows).report.bytesSent);
    for (std::size_t i = 2; i < bytes.size(); ++i) {
        const std::int64_t bend = (bytes[i] - bytes[i - 1]) - (bytes[i - 1] - bytes[i - 2]);
        INFO(bend << " bytes more than the step before");
        CHECK(std::abs(bend) <= ranks * 64); // headers of batches of finished tiles
    }
}

TEST_CASE("A channel that nobody asks for adds no byte", "[counters]")
{
    using WithMore = dfb::BasicAlphaBlend<64, dfb::colorChannel | dfb::depthChannel | dfb::imageAuxChannels>;
    CHECK(cost<WithMore>(256).report.bytesSent == cost<dfb::AlphaBlend>(256).report.bytesSent);
}

TEST_CASE("A tile that has converged is not rendered, and nothing of it travels", "[counters]")
{
    std::vector<dfb::FrameReport> reports;
    std::atomic<std::int64_t> calls{0}, wrongCalls{0};
    std::vector<std::int64_t> callsOf;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config;
        config.width = config.height = side;
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        using Fb = dfb::DistributedFrameBuffer<dfb::Progressive<dfb::AlphaBlend>, dfb::NoPixelOp, dfb::InprocTransport>;
        Fb fb(communicator, config);
        dfb::World world;
        world.add({static_cast<std::uint32_t>(fb.rank()), {{0, 0, 0}, {1, 1, 1}}});
        int taken = 0;
        for (const int step : {1, 2, 0}) { // all tiles, every second one, none
            dfb::FrameParams params;
            params.declarationKey = params.accumulationId = 1;
            std::vector<dfb::TileSamples> plan(tileCount);
            for (std::size_t t = 0; t < plan.size(); ++t)
                plan[t] = {step == 1 || t % 2 == 0 ? taken : 2,
                           step > 0 && t % static_cast<std::size_t>(step) == 0 ? 2 : 0};
            taken += 2;
            params.samples = std::make_shared<const std::vector<dfb::TileSamples>>(plan);
            const dfb::FrameReport report = dfb::renderDataParallel(
                fb, world, WholeImage(),
                [&](const dfb::Brick& brick, auto& tile) {
                    ++calls;
                    wrongCalls += plan[static_cast<std::size_t>(tile.tile)].count == 0;
                    tile.forEachPixel([&](int x, int, float* rgba, float& depth) {
                        rgba[0] = rgba[3] = 0.25f + 0.01f * static_cast<float>(x % 7);
                        depth = static_cast<float>(brick.id);
                    });
                },
                params);
            fb.allReduce({0}, Fb::Reduce::Sum);
            if (fb.isDisplayRank()) {
                reports.push_back(report);
                callsOf.push_back(calls);
                calls = 0;
            }
            fb.allReduce({0}, Fb::Reduce::Sum);
        }
    });
    constexpr std::int64_t inputs = 2 * tileCount * (ranks - 1); // of a frame, to other ranks
    CHECK(wrongCalls == 0);
    CHECK(callsOf == std::vector<std::int64_t>{2 * tileCount * ranks, tileCount * ranks, 0});
    INFO(reports[1].messagesSent << ", " << reports[2].messagesSent << " messages");
    CHECK(reports[1].messagesSent >= inputs / 2);
    CHECK(reports[1].messagesSent <= inputs / 2 + 8 * ranks);
    CHECK(reports[2].messagesSent <= 3 * (ranks - 1));
    CHECK(reports[2].bytesSent <= 3 * (ranks - 1) * 1024); // the verdict has an error of each tile that was finished
}

TEST_CASE("A frame of nothing costs next to nothing", "[counters]")
{
    const Cost full = cost<dfb::AlphaBlend>(side), empty = cost<dfb::AlphaBlend>(0);
    INFO("bytes " << empty.report.bytesSent << " of " << full.report.bytesSent << ", messages "
                  << empty.report.messagesSent << " of " << full.report.messagesSent);
    CHECK(static_cast<double>(empty.report.bytesSent) <= 0.001 * static_cast<double>(full.report.bytesSent));
    CHECK(empty.report.messagesSent <= 3 * (ranks - 1)); // of the verdict up and down, and that there are no tiles
}

TEST_CASE("The second frame with the same declaration sends no manifests and looks for no bricks", "[counters]")
{
    const Cost again = cost<dfb::AlphaBlend>(side, true), kept = cost<dfb::AlphaBlend>(side, false);
    // Each rank to each other one, their answers, and that all have declared, up and down.
    CHECK(again.report.messagesSent - kept.report.messagesSent >= 2 * ranks * (ranks - 1));
    CHECK(again.projections == ranks);
    CHECK(kept.projections == 0);
}

TEST_CASE("Messages: one for each input, a few for each rank", "[counters]")
{
    const Cost full = cost<dfb::AlphaBlend>(side);
    const int inputs = tileCount * (ranks - 1);
    INFO(full.report.messagesSent);
    CHECK(full.report.messagesSent >= inputs);
    CHECK(full.report.messagesSent <= inputs + 8 * ranks); // with credits, which depend on time
}

#if !defined(COUNTERS_WITHOUT_ALLOCATIONS)
TEST_CASE("Allocations do not grow from frame to frame, and are fewer than two for each input", "[counters]")
{
    const Cost c = cost<dfb::AlphaBlend>(side, false, 8);
    INFO(c.allocations);
    CHECK(c.allocations < 2 * tileCount * ranks);
}
#endif
