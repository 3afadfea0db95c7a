// What a frame costs in bytes, messages and allocations, which are exact, unlike times. And the errors of allocations
// that fail. Ranks are threads.
#include "catch.hpp"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <exception>
#include <functional>
#include <limits>
#include <memory>
#include <mutex>
#include <new>
#include <numeric>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

// Sanitizers have an operator new of their own.
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define COUNTERS_WITHOUT_ALLOCATIONS
#elif defined(__has_feature)
#if __has_feature(address_sanitizer) || __has_feature(thread_sanitizer)
#define COUNTERS_WITHOUT_ALLOCATIONS
#endif
#endif

#if !defined(COUNTERS_WITHOUT_ALLOCATIONS)
namespace {

std::atomic<std::int64_t> allocations{0};
std::atomic<std::size_t> largestAllocation{std::numeric_limits<std::size_t>::max()}; // larger allocations fail
thread_local int allocationsUntilFailure = -1; // of this thread: the next but so many fails, once; below 0: none

void* allocate(std::size_t bytes, std::size_t alignment)
{
    ++allocations;
    if (bytes > largestAllocation || (allocationsUntilFailure >= 0 && allocationsUntilFailure-- == 0))
        throw std::bad_alloc();
    void* block = alignment > alignof(std::max_align_t)
                      ? std::aligned_alloc(alignment, (bytes + alignment - 1) / alignment * alignment)
                      : std::malloc(bytes > 0 ? bytes : 1);
    if (!block)
        throw std::bad_alloc();
    return block;
}

#if defined(__GNUC__)
__attribute__((noinline)) // else the compiler warns of a mismatched free
#endif
void release(void* block)
{
    std::free(block);
}

} // namespace

// Replaces operator new of the whole program.
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

// A camera in which every box covers the image.
struct WholeImage {
    dfb::Region project(const dfb::Box3&, int, int) const { return {0, 0, side, side}; }
};

// The report of the last of some frames of the same picture. Each rank has an image of which only the first `rows` rows
// are active.
template <class TileOp>
dfb::FrameReport cost(int rows)
{
    constexpr int frames = 4;
    dfb::FrameReport result;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config;
        config.image.width = config.image.height = side;
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
        dfb::DataParallelLoop loop(fb, world);
        for (int frame = 0; frame < frames; ++frame) {
            const dfb::FrameReport report = loop.render(WholeImage(), find);
            if (fb.isDisplayRank())
                result = report;
        }
    });
    return result;
}

// The bytes that must travel if all ranks have `rows` active rows: inputs whose owner is another rank, and finished
// tiles.
double expectedBytes(double rows, double bytesPerPixel)
{
    return (ranks - 1) * rows * side * bytesPerPixel  // each rank has all tiles and owns one in four
           + (ranks - 1.0) / ranks * side * rows * 4; // finished tiles, 8 bits a channel
}

} // namespace

TEST_CASE("A frame sends its active pixels, and little else", "[counters]")
{
    // The number of rows is a multiple of a tile, so that whole tiles are sent.
    for (const int rows : {64, 256, 512}) {
        const dfb::FrameReport sorted = cost<dfb::AlphaBlend>(rows), nearest = cost<dfb::DepthComposite>(rows);
        INFO(rows << " rows: " << sorted.bytesSent << " bytes, expected at least " << expectedBytes(rows, 20));
        for (const dfb::FrameReport& c : {sorted, nearest}) {
            CHECK(static_cast<double>(c.bytesSent) >= expectedBytes(rows, 20));
            CHECK(static_cast<double>(c.bytesSent) <= expectedBytes(rows, 20) * 1.01 + 64 * 3 * tileCount + 4096);
        }
    }
    // Half a tile costs half as much, and empty rows cost nothing.
    const double half = static_cast<double>(cost<dfb::AlphaBlend>(32).bytesSent),
                 whole = static_cast<double>(cost<dfb::AlphaBlend>(64).bytesSent);
    const double inputs = (ranks - 1) * 64.0 * side * 20;
    CHECK(whole - half >= inputs * 0.49);
}

TEST_CASE("Bytes grow with the active pixels, along a line", "[counters]")
{
    std::vector<std::int64_t> bytes;
    for (const int rows : {64, 192, 320, 448})
        bytes.push_back(cost<dfb::AlphaBlend>(rows).bytesSent);
    for (std::size_t i = 2; i < bytes.size(); ++i) {
        const std::int64_t bend = (bytes[i] - bytes[i - 1]) - (bytes[i - 1] - bytes[i - 2]);
        INFO(bend << " bytes more than the step before");
        CHECK(std::abs(bend) <= ranks * 64); // headers of batches of finished tiles
    }
}

TEST_CASE("A channel that nobody asks for adds no byte", "[counters]")
{
    using WithMore = dfb::BasicAlphaBlend<64, dfb::colorChannel | dfb::depthChannel | dfb::imageAuxChannels>;
    CHECK(cost<WithMore>(256).bytesSent == cost<dfb::AlphaBlend>(256).bytesSent);
}

TEST_CASE("A tile that has converged is not rendered, and nothing of it travels", "[counters]")
{
    std::vector<dfb::FrameReport> reports;
    std::atomic<std::int64_t> calls{0}, wrongCalls{0};
    std::vector<std::int64_t> callsOf;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config;
        config.image.width = config.image.height = side;
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        using Fb = dfb::DistributedFrameBuffer<dfb::Progressive<dfb::AlphaBlend>, dfb::NoPixelOp, dfb::InprocTransport>;
        Fb fb(communicator, config);
        dfb::World world;
        world.add({static_cast<std::uint32_t>(fb.rank()), {{0, 0, 0}, {1, 1, 1}}});
        dfb::DataParallelLoop loop(fb, world);
        int taken = 0;
        for (const int step : {1, 2, 0}) { // all tiles, every second one, none
            dfb::FrameConfig params;
            params.accumulationId = 1;
            std::vector<dfb::TileSamples> plan(tileCount);
            for (std::size_t t = 0; t < plan.size(); ++t)
                plan[t] = {step == 1 || t % 2 == 0 ? taken : 2,
                           step > 0 && t % static_cast<std::size_t>(step) == 0 ? 2 : 0};
            taken += 2;
            params.samples = std::make_shared<const std::vector<dfb::TileSamples>>(plan);
            const dfb::FrameReport report = loop.render(
                WholeImage(),
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
    // The messages say that all ranks have declared and what the verdict is, both up and down, and that there are no
    // tiles.
    CHECK(reports[2].messagesSent <= 5 * (ranks - 1));
    CHECK(reports[2].bytesSent <= 5 * (ranks - 1) * 1024); // the verdict has an error of each tile that was finished
}

TEST_CASE("A frame of nothing costs next to nothing", "[counters]")
{
    const dfb::FrameReport full = cost<dfb::AlphaBlend>(side), empty = cost<dfb::AlphaBlend>(0);
    INFO("bytes " << empty.bytesSent << " of " << full.bytesSent << ", messages " << empty.messagesSent << " of "
                  << full.messagesSent);
    CHECK(static_cast<double>(empty.bytesSent) <= 0.001 * static_cast<double>(full.bytesSent));
    // The messages say that all ranks have declared and what the verdict is, both up and down, and that there are no
    // tiles.
    CHECK(empty.messagesSent <= 5 * (ranks - 1));
}

TEST_CASE("A rank tells owners of its inputs if they have changed, and only those whom it concerns", "[counters]")
{
    std::vector<std::int64_t> messages;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config;
        config.image.width = config.image.height = side;
        config.image.format = dfb::OutputFormat::None; // the number of messages with finished tiles depends on time
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        using Fb = dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, dfb::InprocTransport>;
        Fb fb(communicator, config);
        dfb::World world;
        dfb::DataParallelLoop loop(fb, world);
        const auto frame = [&](std::uint32_t id, bool isThere, const auto& camera) {
            world = {};
            if (isThere)
                world.add({id, {{0, 0, 0}, {1, 1, 1}}});
            const auto report = loop.render(camera, [](const dfb::Brick&, auto&) {});
            if (fb.isDisplayRank())
                messages.push_back(report.messagesSent);
        };
        struct FirstTile {
            dfb::Region project(const dfb::Box3&, int, int) const { return {0, 0, 1, 1}; }
        };
        const auto rank = static_cast<std::uint32_t>(fb.rank());
        frame(rank, true, WholeImage());                       // 0
        frame(rank, true, WholeImage());                       // 1
        frame(rank == 2 ? 77 : rank, true, WholeImage());      // 2: other inputs of one rank
        frame(rank == 2 ? 77 : rank, true, WholeImage());      // 3
        frame(rank == 2 ? 77 : rank, rank != 1, WholeImage()); // 4: no inputs of another
        frame(rank == 2 ? 77 : rank, rank != 1, WholeImage()); // 5
        frame(rank, rank == 3, FirstTile());                   // 6: inputs of one rank for one owner
        frame(rank, rank == 3, FirstTile());                   // 7
        frame(rank + 50, rank == 3, FirstTile());              // 8: another one for that owner
    });
    // `inputs`: those of a rank to others. `rest`: that all have declared, up and down; the verdict itself is not
    // counted.
    const std::int64_t inputs = tileCount - tileCount / ranks, rest = 2 * (ranks - 1);
    const std::int64_t manifests = 2 * (ranks - 1); // of one rank, with their answers
    REQUIRE(messages.size() == 9);
    CHECK(messages[0] == ranks * inputs + rest + ranks * manifests);
    CHECK(messages[1] == ranks * inputs + rest);
    CHECK(messages[2] == ranks * inputs + rest + manifests);
    CHECK(messages[3] == ranks * inputs + rest);
    CHECK(messages[4] == (ranks - 1) * inputs + rest + manifests);
    CHECK(messages[5] == (ranks - 1) * inputs + rest);
    CHECK(messages[6] == 1 + rest + (ranks - 1) * manifests);
    CHECK(messages[7] == 1 + rest);
    CHECK(messages[8] == 1 + rest + 2);
}

TEST_CASE("Messages: one for each input, a few for each rank", "[counters]")
{
    const dfb::FrameReport full = cost<dfb::AlphaBlend>(side);
    const int inputs = tileCount * (ranks - 1);
    INFO(full.messagesSent);
    CHECK(full.messagesSent >= inputs);
    CHECK(full.messagesSent <= inputs + 8 * ranks); // with credits, which depend on time
}

#if !defined(COUNTERS_WITHOUT_ALLOCATIONS)
namespace {

// A barrier for all ranks that allocates nothing.
class Meeting {
public:
    explicit Meeting(int count) : count_(count) {}

    void operator()()
    {
        std::unique_lock<std::mutex> lock(mutex_);
        const int mine = round_;
        if (++here_ == count_) {
            here_ = 0;
            ++round_;
            all_.notify_all();
        }
        all_.wait(lock, [&] { return round_ != mine; });
    }

private:
    std::mutex mutex_;
    std::condition_variable all_;
    int count_, here_ = 0, round_ = 0;
};

thread_local bool isWorker = false;
std::array<std::atomic<int>, ranks> tilesOfWorker{}, tilesOfCaller{}; // composited, of each rank

// An operation that counts which thread composites.
template <class TileOp>
struct Watched : TileOp {
    void newFrame(const dfb::TileInfo& info)
    {
        rank = info.rank;
        TileOp::newFrame(info);
    }
    void finish(dfb::FinishedTile& out)
    {
        TileOp::finish(out);
        ++(isWorker ? tilesOfWorker : tilesOfCaller)[static_cast<std::size_t>(rank)];
    }
    int rank = 0;
};

void waitUntil(const std::atomic<int>& value, int least)
{
    while (value < least)
        std::this_thread::yield();
}

// The number of blocks in a pool is the number of messages that were under way at once, which depends on time. This
// gives the pool as many blocks as can ever be needed.
void fill(dfb::MemoryPool& pool)
{
    std::vector<dfb::Buffer> blocks;
    for (const std::size_t bytes : {200, 300, 500, 700, 1000, 1500, 2000, 3000, 4000})
        for (int i = 0; i < 64; ++i)
            blocks.push_back(pool.acquire(bytes));
    for (int i = 0; i < tileCount; ++i)
        blocks.push_back(pool.acquire(std::size_t{96} << 10)); // one input
    for (const int kilobytes : {16, 256})                      // a finished tile, and several
        for (int i = 0; i < 8; ++i)
            blocks.push_back(pool.acquire(static_cast<std::size_t>(kilobytes) << 10));
}

// The number of allocations in each frame from the third on. Every rank has an image of all pixels. In the first two
// frames, on each rank, first the worker composites and then the thread that waits for the frame. Otherwise one of them
// might composite for the first time, and so allocate, in a later frame.
template <class Base>
std::vector<std::int64_t> allocationsOf(int rankCount, bool declaresAnew)
{
    using TileOp = Watched<Base>;
    using Fb = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, dfb::InprocTransport>;
    constexpr bool isOrdered = Base::rule == dfb::BlendRule::InOrder;
    constexpr int counted = 8;
    std::vector<std::int64_t> result(counted);
    Meeting meet(rankCount);
    for (auto* tiles : {&tilesOfWorker, &tilesOfCaller})
        for (auto& count : *tiles)
            count = 0;
    dfb::runRanks(rankCount, [&](dfb::InprocCommunicator communicator) {
        const auto connection = dfb::connect<dfb::InprocTransport>(communicator);
        fill(*connection->pool());
        dfb::FrameBufferConfig config;
        config.image.width = config.image.height = side;
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        Fb fb(connection, config);
        const auto rank = static_cast<std::size_t>(fb.rank());
        const auto depth = static_cast<float>(fb.rank());
        const auto worldOf = [&](std::uint32_t id) { return dfb::World({{id, {{0, 0, depth}, {1, 1, depth + 1}}}}); };
        const auto id = static_cast<std::uint32_t>(rank);
        dfb::World worlds[2] = {worldOf(id), worldOf(declaresAnew ? id + 100 : id)};
        const dfb::SharedWorld shared(fb, worlds[0]);
        dfb::RoundRobinBricks owner;
        std::vector<int> order(static_cast<std::size_t>(rankCount));
        std::iota(order.begin(), order.end(), 0);
        std::vector<float> rgba(4 * side * side, 0.5f), depths(side * side, depth); // halves are rounded exactly
        const auto find = [&](const dfb::Brick&, auto& view) {
            const std::size_t first =
                static_cast<std::size_t>(view.region.y0) * side + static_cast<std::size_t>(view.region.x0);
            view.stride = side;
            view.color = &rgba[4 * first];
            view.depth = &depths[first];
        };
        dfb::FrameConfig params;
        dfb::OrderedLoop orderedLoop(fb, shared, owner);
        dfb::DataParallelLoop loop(fb, worlds[0]);
        const auto start = [&] {
            if constexpr (isOrdered)
                return orderedLoop.start(WholeImage(), order, dfb::inPlace(find), params);
            else
                return loop.start(WholeImage(), dfb::inPlace(find), params);
        };

        // A frame composited by the worker.
        std::atomic<int> step{0};
        fb.executor().submit([&step] {
            isWorker = true;
            step = 1;
        });
        waitUntil(step, 1);
        {
            std::optional<typename Fb::Frame> frame;
            dfb::CallerExecutor caller;
            caller.submit([&] { frame.emplace(start()); }); // in a task this thread runs no others
            caller.help();
            waitUntil(tilesOfWorker[rank], 1);
            frame->end();
        }
        meet();
        // A frame composited by this thread.
        fb.executor().submit([&step] {
            step = 2;
            waitUntil(step, 3);
            step = 4;
        });
        waitUntil(step, 2);
        {
            params.declared = !isOrdered;
            auto frame = fb.begin(params);
            if (params.declared)
                frame.declare(dfb::inputsOf(worlds[1], dfb::visibleTiles(worlds[1], WholeImage(), fb.layout())));
            typename Fb::TileView view;
            for (int tile = 0; tile < tileCount; ++tile) {
                frame.start(view, tile);
                view.generation = isOrdered ? fb.rank() : 1;
                view.source = worlds[1].bricks().front().id;
                view.children = isOrdered && fb.rank() + 1 < rankCount;
                find(worlds[1].bricks().front(), view);
                frame.setTile(view);
            }
            frame.end();
        }
        step = 3;
        waitUntil(step, 4);

        for (int frame = 0; frame < counted; ++frame) {
            meet();
            const std::int64_t before = allocations;
            meet();
            std::swap(worlds[0], worlds[1]);
            start().end();
            meet();
            if (fb.isDisplayRank())
                result[static_cast<std::size_t>(frame)] = allocations - before;
        }
        meet();
    });
    for (std::size_t rank = 0; rank < static_cast<std::size_t>(rankCount); ++rank) {
        CHECK(tilesOfWorker[rank] > 0);
        CHECK(tilesOfCaller[rank] > 0);
    }
    return result;
}

} // namespace

TEST_CASE("From the third frame on the library allocates nothing", "[counters]")
{
    for (const int rankCount : {1, 2, 4})
        for (const bool declaresAnew : {false, true}) {
            INFO(rankCount << " ranks, " << (declaresAnew ? "other inputs in each frame" : "the same inputs"));
            const std::vector<std::int64_t> nothing(8);
            CHECK(allocationsOf<dfb::AlphaBlend>(rankCount, declaresAnew) == nothing);
            CHECK(allocationsOf<dfb::DepthComposite>(rankCount, declaresAnew) == nothing);
            CHECK(allocationsOf<dfb::OrderedBlend>(rankCount, declaresAnew) == nothing);
        }
}

namespace {

// The number of allocations in each of some frames. On one rank, with a CallerExecutor, nothing depends on time, so the
// first two frames may be any.
template <class Frame>
std::vector<std::int64_t> allocationsOf(const Frame& frame)
{
    std::vector<std::int64_t> counts(10);
    for (std::int64_t& count : counts) {
        const std::int64_t before = allocations;
        frame();
        count = allocations - before;
    }
    CHECK(counts[0] > 0);
    return {counts.begin() + 2, counts.end()};
}

} // namespace

TEST_CASE("On one rank it allocates nothing after two frames, into whatever is rendered", "[counters]")
{
    using Fb = dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, dfb::InprocTransport>;
    dfb::runRanks(1, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config;
        config.image.width = config.image.height = side;
        config.executor = std::make_shared<dfb::CallerExecutor>();
        Fb fb(communicator, config);
        const dfb::World world({{7, {{0, 0, 0}, {1, 1, 1}}}, {8, {{1, 0, 0}, {2, 1, 1}}}});
        const dfb::SharedWorld all(fb, world);
        const auto render = [](const dfb::Brick& brick, auto& tile) {
            tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
                if ((x + y) % 3 > 0)
                    rgba[0] = rgba[3] = 0.5f + 0.01f * static_cast<float>(x % 7);
                depth = static_cast<float>(brick.id);
            });
        };
        dfb::DataParallelLoop loop(fb, world), told(fb, world, all);
        CHECK(allocationsOf([&] { loop.render(WholeImage(), render); }) == std::vector<std::int64_t>(8));
        // The camera moves, and the order of the bricks stays the same, which takes no memory. Projecting a brick does.
        float x = 0;
        const auto next = [&x] {
            return dfb::PerspectiveCamera({-4 + (x += 0.01f), 0.5f, 6}, {1, 0.5f, 0.5f}, {0, 1, 0}, 40);
        };
        const auto sorted = allocationsOf([&] { loop.render(next(), render); });
        CHECK(allocationsOf([&] { told.render(next(), render); }) == sorted);
    });
}

TEST_CASE("On one rank an image compositor allocates nothing after two frames", "[counters]")
{
    dfb::runRanks(1, [&](dfb::InprocCommunicator communicator) {
        for (const auto blend : {dfb::ImageBlend::ByDepth, dfb::ImageBlend::InOrder, dfb::ImageBlend::Nearest})
            for (const bool hasBytes : {false, true}) {
                INFO("blend " << static_cast<int>(blend) << (hasBytes ? ", bytes" : ", floats"));
                dfb::FrameBufferConfig config(side, side);
                config.executor = std::make_shared<dfb::CallerExecutor>();
                dfb::ImageCompositor compositor(dfb::connect<dfb::InprocTransport>(communicator), blend, config);
                constexpr std::size_t pixels = std::size_t{side} * side;
                std::vector<float> rgba(4 * pixels, 0.5f), depths(pixels, 1);
                std::vector<std::uint8_t> bytes(4 * pixels, 100);
                dfb::InputImage image;
                image.rgba8 = hasBytes ? bytes.data() : nullptr;
                image.rgba32f = hasBytes ? nullptr : rgba.data();
                image.depth = blend == dfb::ImageBlend::InOrder ? nullptr : depths.data();
                CHECK(allocationsOf([&] { compositor.composite(image, 0); }) == std::vector<std::int64_t>(8));
            }
    });
}

namespace {

// The error of each of 2 ranks if allocations larger than `largest` fail.
template <class Make>
std::vector<std::string> outcomes(std::size_t largest, const Make& make)
{
    std::vector<std::string> texts(2);
    largestAllocation = largest;
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        std::string& text = texts[static_cast<std::size_t>(communicator.rank())];
        try {
            make(communicator);
        } catch (const dfb::InvalidArgument& e) {
            text = e.what();
        } catch (const std::exception& e) {
            text = std::string("another exception: ") + e.what();
        }
    });
    largestAllocation = std::numeric_limits<std::size_t>::max();
    return texts;
}

} // namespace

namespace {

using OneTile = dfb::DistributedFrameBuffer<dfb::ImageParallel, dfb::NoPixelOp, dfb::InprocTransport>;

// Calls body(framebuffer, tile) on one rank with one worker. The image is a single tile.
template <class Body>
void withOneTile(const Body& body)
{
    dfb::runRanks(1, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config(64, 64, dfb::OutputFormat::RGBA32F);
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        OneTile fb(communicator, config);
        body(fb, *std::make_unique<OneTile::Tile>());
    });
}

} // namespace

TEST_CASE("A lack of memory for a tile of this rank's own fails the frame, and the next is right", "[counters]")
{
    withOneTile([](OneTile& fb, OneTile::Tile& tile) {
        for (const bool hasMemory : {false, true}) {
            auto frame = fb.begin();
            frame.start(tile, 0, 0);
            std::fill_n(tile.color, 4 * 64 * 64, 0.5f);
            largestAllocation = hasMemory ? std::numeric_limits<std::size_t>::max() : 20000;
            frame.guard([&] { frame.setTile(tile); });
            largestAllocation = std::numeric_limits<std::size_t>::max();
            std::string outcome = "fine";
            try {
                frame.end();
            } catch (const dfb::FrameError& e) {
                outcome = e.what();
            }
            INFO(outcome);
            CHECK(outcome.find(hasMemory ? "fine" : "no memory for ") != std::string::npos);
        }
    });
}

TEST_CASE("A tile that there was no memory for can be set again", "[counters]")
{
    withOneTile([](OneTile& fb, OneTile::Tile& tile) {
        auto frame = fb.begin();
        frame.start(tile, 0, 0);
        std::fill_n(tile.color, 4 * 64 * 64, 0.5f);
        largestAllocation = 20000;
        CHECK_THROWS_AS(frame.setTile(tile), dfb::OutOfMemory);
        largestAllocation = std::numeric_limits<std::size_t>::max();
        frame.setTile(tile);
        CHECK(frame.end().tilesTouched == 1);
    });
}

namespace {

// From the third tile on, there is no memory for another batch of finished tiles, which takes 256 KiB.
struct TakesMemory {
    std::shared_ptr<std::atomic<int>> tiles = std::make_shared<std::atomic<int>>(0);
    void process(dfb::PixelTile&) const
    {
        if (++*tiles == 3)
            largestAllocation = 200000;
    }
};

} // namespace

TEST_CASE("A lack of memory for finished tiles costs a partial frame no other tile", "[counters]")
{
    const bool compresses = GENERATE(false, true); // true: no memory for a batch's compressed bytes either
    std::vector<std::int64_t> incomplete(2);
    int shown = 0;
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        using Fb = dfb::DistributedFrameBuffer<dfb::ImageParallel, TakesMemory, dfb::InprocTransport>;
        dfb::FrameBufferConfig config(64 * 8, 64, dfb::OutputFormat::RGBA32F); // a batch has room for 3 tiles
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 1; };
#if defined(DFB_HAS_SNAPPY)
        config.messages.codec = compresses ? std::make_shared<dfb::SnappyCodec>() : nullptr;
        config.messages.compression = dfb::CompressionMode::Always;
#endif
        dfb::NetworkConfig network;
        network.sharedMemory = false;
        Fb fb(communicator, config, network);
        dfb::FrameConfig params;
        params.allowPartial = true;
        auto frame = fb.begin(params);
        frame.forEachTile(fb.ownedTiles(), [&](auto& tile) {
            for (int i = 0; i < 4 * 64 * 64; ++i)
                tile.color[i] = static_cast<float>(i % 1009) / 1009;
            frame.setTile(tile);
        });
        incomplete[static_cast<std::size_t>(fb.rank())] = frame.end().tilesIncomplete;
        for (int tile = 0; tile < 8 && fb.isDisplayRank(); ++tile)
            shown += fb.isComplete(tile);
    });
    largestAllocation = std::numeric_limits<std::size_t>::max();
    INFO((compresses ? "compressed" : "not compressed"));
    CHECK(incomplete == std::vector<std::int64_t>(2, 5));
    CHECK(shown == 3);
}

TEST_CASE("A rank that lacks memory to combine parts of a reduction ends it on every rank", "[counters]")
{
    // Where rank 0 lacks memory: in a task that combines, in the call, which combines; in the call, for its own part.
    const std::string where = GENERATE(as<std::string>(), "task", "call", "own part");
    std::vector<std::string> texts(2);
    std::atomic<int> here{0};
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        const auto executor = std::make_shared<dfb::CallerExecutor>();
        dfb::FrameBufferConfig config(64, 64, dfb::OutputFormat::RGBA32F);
        config.executor = executor;
        OneTile fb(communicator, config);
        std::string& text = texts[static_cast<std::size_t>(fb.rank())];
        // Together too many, or else those of rank 0 alone.
        const std::vector<std::byte> mine(fb.rank() != 0 ? 1000 : where == "own part" ? 2000000 : 1000000);
        fb.allReduce({0}, OneTile::Reduce::Sum);
        for (++here; here < 2;) // else rank 1 may still be in that call when rank 0 has failed
            std::this_thread::yield();
        largestAllocation = 1500000;
        while (where == "call" && fb.rank() == 0 && !executor->help()) // until the part of rank 1 is here
            std::this_thread::yield();
        try {
            fb.allGather(mine);
        } catch (const dfb::TransportError& e) {
            text = e.what();
        } catch (const std::bad_alloc&) {
            text = "no memory";
        }
    });
    largestAllocation = std::numeric_limits<std::size_t>::max();
    INFO(texts[0] << "; " << texts[1]);
    CHECK((where != "task" ? texts[0] == "no memory" : texts[0] == texts[1]));
    CHECK(texts[1].find("rank 0") != std::string::npos);
    CHECK(texts[1].find(std::bad_alloc().what()) != std::string::npos);
}

TEST_CASE("Wherever in a frame a rank's memory fails, no rank waits for it in vain", "[counters]")
{
    const int failing = GENERATE(0, 1);
    bool hasFailed = true;
    for (int place = 0; hasFailed; ++place) {
        std::vector<std::string> texts(2);
        dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
            using Fb = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, dfb::InprocTransport>;
            dfb::FrameBufferConfig config(48, 48);
            config.executor = std::make_shared<dfb::CallerExecutor>(); // all is done in this thread
            config.quiet = std::chrono::milliseconds(20);
            dfb::FrameConfig params;
            params.timeout = std::chrono::seconds(20);
            std::string& text = texts[static_cast<std::size_t>(communicator.rank())];
            dfb::World world;
            world.add({static_cast<std::uint32_t>(communicator.rank()), {{0, 0, 0}, {1, 1, 1}}});
            try {
                Fb fb(communicator, config);
                if (fb.rank() == failing)
                    allocationsUntilFailure = place;
                dfb::DataParallelLoop(fb, world).render(
                    WholeImage(), [](const dfb::Brick&, auto& tile) { tile.color[3] = 1; }, params);
                text = "fine";
            } catch (const std::exception& e) {
                text = e.what();
            }
            if (communicator.rank() == failing)
                hasFailed = std::exchange(allocationsUntilFailure, -1) < 0;
        });
        INFO("rank " << failing << ", allocation " << place << ": " << texts[0] << "; " << texts[1]);
        for (const std::string& text : texts) {
            CHECK(text.find("timed out") == std::string::npos);
            CHECK(text.find("not all ranks have ended") == std::string::npos);
        }
        CHECK(place < 1000);
    }
}

TEST_CASE("Wherever a rank's memory fails while objects are made, no rank waits for it in vain", "[counters]")
{
    struct Case {
        const char* name;
        std::function<void(const std::shared_ptr<dfb::Connection>&, const std::function<void()>& arm)> run;
    };
    using Fb = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, dfb::InprocTransport>;
    const auto makeConfig = [] {
        dfb::FrameBufferConfig config(48, 48);
        config.executor = std::make_shared<dfb::CallerExecutor>(); // all is done in this thread
        return config;
    };
    const std::vector<Case> cases{{"a framebuffer",
                                   [&](const auto& connection, const auto& arm) {
                                       dfb::FrameBufferConfig config = makeConfig();
                                       config.framesInFlight = 2;
                                       arm();
                                       const Fb fb(connection, std::move(config));
                                   }},
                                  {"its resize()",
                                   [&](const auto& connection, const auto& arm) {
                                       Fb fb(connection, makeConfig());
                                       arm();
                                       try {
                                           fb.resize(64, 32);
                                       } catch (...) {
                                           if (fb.imageFrame() != -1) // asks an engine that is still there
                                               std::abort();
                                           throw;
                                       }
                                   }},
                                  {"an image compositor",
                                   [&](const auto& connection, const auto& arm) {
                                       dfb::FrameBufferConfig config = makeConfig();
                                       arm();
                                       dfb::ImageCompositor(connection, dfb::ImageBlend::ByDepth, std::move(config));
                                   }},
                                  {"its resize()",
                                   [&](const auto& connection, const auto& arm) {
                                       dfb::ImageCompositor images(connection, dfb::ImageBlend::ByDepth, makeConfig());
                                       arm();
                                       images.resize(64, 32);
                                   }},
                                  {"a wall", [&](const auto& connection, const auto& arm) {
                                       const dfb::WallLayout layout{2, 1, 48, 48, 0, 0, {0, 1}};
                                       const auto executor = std::make_shared<dfb::CallerExecutor>();
                                       arm();
                                       const dfb::DisplayWall wall(connection, layout, dfb::OutputFormat::RGBA8,
                                                                   executor);
                                   }}};
    for (const Case& c : cases)
        for (const int failing : {0, 1}) {
            bool hasFailed = true;
            for (int place = 0; hasFailed && place < 1000; ++place) {
                std::vector<std::string> texts(2);
                dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
                    std::string& text = texts[static_cast<std::size_t>(communicator.rank())];
                    const auto connection = dfb::connect<dfb::InprocTransport>(communicator);
                    try {
                        c.run(connection, [&] {
                            if (communicator.rank() == failing)
                                allocationsUntilFailure = place;
                        });
                        text = "fine";
                    } catch (const std::exception& e) {
                        text = e.what();
                    }
                    if (communicator.rank() == failing)
                        hasFailed = std::exchange(allocationsUntilFailure, -1) < 0;
                });
                INFO(c.name << ", rank " << failing << ", allocation " << place << ": " << texts[0] << "; "
                            << texts[1]);
                CHECK(texts[0].find("peerTimeout") == std::string::npos);
                CHECK(texts[1].find("peerTimeout") == std::string::npos);
            }
            CHECK_FALSE(hasFailed);
        }
}

TEST_CASE("What is too large for memory is named with its bytes and its rank, on every rank", "[counters]")
{
    using dfb::OutputFormat;
    struct Case {
        OutputFormat format;
        dfb::ChannelMask aux;
        bool depth;
        const char* text;
    };
    for (const Case& c : {Case{OutputFormat::RGBA32F, 0, false,
                               "no memory for 68719476736 bytes: an image of 65536x65536 pixels of 16 bytes (RGBA32F)"},
                          Case{OutputFormat::RGBA8, 0, false,
                               "no memory for 17179869184 bytes: an image of 65536x65536 pixels of 4 bytes (RGBA8)"},
                          Case{OutputFormat::SRGBA8, dfb::normalChannel, true,
                               "no memory for 85899345920 bytes: an image of 65536x65536 pixels of 20 bytes (SRGBA8 "
                               "and more channels)"}})
        for (const int inFlight : {1, 3}) {
            const auto texts = outcomes(std::size_t{1} << 30, [&](dfb::InprocCommunicator communicator) {
                dfb::FrameBufferConfig config;
                config.image.width = config.image.height = 65536;
                config.image.format = c.format;
                config.image.aux = c.aux;
                config.image.depth = c.depth;
                config.image.displayRank = 1;
                config.framesInFlight = inFlight;
                config.executor = std::make_shared<dfb::ThreadExecutor>(1);
                dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<64, dfb::allChannels & ~dfb::farChannel>,
                                            dfb::NoPixelOp, dfb::InprocTransport>
                    fb(communicator, config);
            });
            CHECK(texts[0] == texts[1]);
            CHECK(texts[0]
                  == std::string("dfb: invalid argument: rank 1: ") + c.text
                         + (inFlight > 1 ? "; there is one for each of 3 frames in flight" : ""));
        }
    const auto tables = outcomes(std::size_t{1} << 20, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config;
        config.image.width = config.image.height = 65536;
        config.image.format = OutputFormat::None;
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, dfb::InprocTransport> fb(communicator, config);
    });
    CHECK(tables[0] == tables[1]);
    CHECK(tables[0].find("dfb: invalid argument: rank 0: no memory for ") == 0);
    CHECK(tables[0].find(" bytes: tables of 1048576 tiles") != std::string::npos);
    const auto pool = dfb::MemoryPool::create(false);
    const std::uint64_t before = pool->peakBytes();
    largestAllocation = 1 << 20;
    CHECK_THROWS_WITH(pool->acquire(3 << 20), "no memory for 3145728 bytes: a block");
    largestAllocation = std::numeric_limits<std::size_t>::max();
    CHECK(pool->peakBytes() == before);
    const auto wall = outcomes(std::size_t{1} << 30, [&](dfb::InprocCommunicator communicator) {
        dfb::WallLayout layout;
        layout.columns = 2;
        layout.displayWidth = layout.displayHeight = 32000;
        layout.ranks = {1, 1};
        const auto connection = dfb::connect<dfb::InprocTransport>(communicator);
        const dfb::DisplayWall made(connection, layout, OutputFormat::RGBA8, std::make_shared<dfb::ThreadExecutor>(1));
    });
    CHECK(wall[0] == wall[1]);
    CHECK(wall[0]
          == "dfb: invalid argument: rank 1: no memory for 4096000000 bytes: an image of 32000x32000 pixels of 4 bytes "
             "(RGBA8)");
}
#endif
