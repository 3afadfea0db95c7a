// Errors: every invalid call, every failure of a frame, and ranks that leave. Every rank gets the same error, none
// hangs, and the next frame is right. Ranks are threads.
#include "board.hpp"
#include "catch.hpp"
#include "random_scene.hpp"

#include <dfb/image_compositor.hpp>
#include <dfb/testing/fault_transport.hpp>
#include <dfb/wire/fragment_message.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <future>
#include <limits>
#include <map>
#include <memory>
#include <mutex>
#include <numeric>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#if defined(__GLIBC__)
#include <pthread.h>
#endif

namespace errors_cases {

namespace {

using board::allSame;
using board::Board;
using board::joined;
using scene::has;
using scene::Loop;
using scene::outcomeOf;
using scene::Picture;
using scene::Scene;

using Blend = dfb::BasicAlphaBlend<16>;
template <class TileOp, class PixelOp = dfb::NoPixelOp>
using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, PixelOp, dfb::InprocTransport>;
template <class TileOp>
using InspectedFrameBuffer = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, board::BoardTransport>;

// The errors of each rank in a bad frame, and the number of wrong values in the good frame after it.
struct BadFrame {
    std::vector<std::string> texts;
    std::size_t wrongAfter = 1;
};

// Calls `frame(fb)` on each rank, which renders the bad frame and may throw, then renders a good frame.
template <class Fb, class Frame>
BadFrame badFrame(int ranks, const Scene& s, const dfb::FrameBufferConfig& config, const Frame& frame, int threads = 1)
{
    BadFrame result;
    result.texts.resize(static_cast<std::size_t>(ranks));
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        auto mine = config;
        if (threads > 0)
            mine.executor = std::make_shared<dfb::ThreadExecutor>(threads);
        else // the rank's own thread reads messages, in their order
            mine.executor = std::make_shared<dfb::CallerExecutor>();
        Fb fb(communicator, mine);
        result.texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] { frame(fb); });
        const auto report = scene::renderLoop(fb, s, Loop::Listing3);
        if (fb.isDisplayRank())
            result.wrongAfter = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
    });
    return result;
}

// Sends one tile.
template <class Frame, class Tile>
void send(Frame& frame, Tile& tile, int index, int generation, std::uint32_t source, std::uint16_t part, int children)
{
    frame.start(tile, index);
    tile.generation = generation;
    tile.source = source;
    tile.part = part;
    tile.children = children;
    frame.setTile(tile);
}

// An AlphaBlend that throws in one function on one rank.
struct Faulty : dfb::BasicAlphaBlend<16> {
    enum class Where { Nowhere, NewFrame, Add, Finish };
    struct FrameData {
        Where where = Where::Nowhere;
        int rank = -1;
        bool standard = true; // throw a std::exception
    };
    void newFrame(const dfb::TileInfo& info, const FrameData& data)
    {
        data_ = data;
        rank_ = info.rank;
        failIn(Where::NewFrame);
        BasicAlphaBlend::newFrame(info);
    }
    void add(dfb::Fragment&& fragment)
    {
        failIn(Where::Add);
        BasicAlphaBlend::add(std::move(fragment));
    }
    void finish(dfb::FinishedTile& out)
    {
        failIn(Where::Finish);
        BasicAlphaBlend::finish(out);
    }

private:
    void failIn(Where where) const
    {
        if (data_.where != where || data_.rank != rank_)
            return;
        if (data_.standard)
            throw std::runtime_error("the op broke");
        throw 5;
    }
    FrameData data_;
    int rank_ = -1;
};
static_assert(dfb::is_tile_op_v<Faulty>);

template <bool Pointwise>
struct FaultyPixelOp {
    static constexpr bool pointwise = Pointwise;
    struct FrameData {
        int rank = -1;
    };
    int rank = -1;
    FrameData data{};

    void newFrame(const FrameData& d) { data = d; }
    void process(dfb::PixelTile&) const
    {
        if (rank == data.rank)
            throw std::runtime_error("the pixel op broke");
    }
};

// A codec that copies.
struct CopyCodec final : dfb::Codec {
    std::uint8_t id() const noexcept override { return 9; }
    std::size_t bound(std::size_t byteCount) const override { return byteCount; }
    std::size_t compress(const std::byte* in, std::size_t byteCount, std::byte* out) const override
    {
        std::copy(in, in + byteCount, out);
        return byteCount;
    }
    bool decompress(const std::byte* in, std::size_t byteCount, std::byte* out, std::size_t raw) const override
    {
        std::copy(in, in + std::min(byteCount, raw), out);
        return byteCount == raw;
    }
};

// The errors of all ranks when a framebuffer is made with a configuration that `change(rank, config)` has changed. Then
// a good framebuffer is made on the same communicator.
std::vector<std::string> constructed(int ranks, const std::function<void(int, dfb::FrameBufferConfig&)>& change)
{
    std::vector<std::string> texts(static_cast<std::size_t>(ranks));
    const Scene s = scene::makeScene(3);
    std::size_t wrongAfter = 1;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        auto config = configOf(s);
        change(communicator.rank(), config);
        texts[static_cast<std::size_t>(communicator.rank())] =
            outcomeOf([&] { FrameBuffer<Blend> fb(communicator, config); });
        FrameBuffer<Blend> fb(communicator, configOf(s));
        const auto report = scene::renderLoop(fb, s, Loop::Declared);
        if (fb.isDisplayRank())
            wrongAfter = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
    });
    if (wrongAfter > 0)
        throw std::logic_error("the framebuffer after the bad one gives a wrong image");
    return texts;
}

} // namespace

TEST_CASE("A tile that cannot be right is refused at once, and nothing is sent", "[errors]")
{
    const Scene s = scene::makeScene(4);
    std::vector<std::string> texts;
    std::int64_t sentMeanwhile = -1;
    std::size_t wrong = 1;
    std::promise<void> over;
    const auto board = std::make_shared<Board>();
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        auto config = configOf(s);
        config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
        using Fb = InspectedFrameBuffer<Blend>;
        Fb fb({{communicator, std::nullopt}, board}, config);
        // Rank 0 begins the frame only when the bad calls are over, so any message sent until then comes from them.
        fb.allReduce({0}, Fb::Reduce::Sum);
        if (fb.rank() == 0)
            over.get_future().wait();
        if (fb.rank() == 1) {
            auto frame = fb.begin(scene::paramsOf(s));
            auto tile = std::make_unique<Fb::Tile>();
            const std::int64_t before = board->sent;
            const auto tryTile = [&](const std::function<void(dfb::TileHeader&)>& change) {
                frame.start(*tile, 3);
                tile->pixel(0, 0)[3] = 1;
                change(*tile);
                texts.push_back(outcomeOf([&] { frame.setTile(*tile); }));
            };
            tryTile([](dfb::TileHeader& t) { t.frame += 1; });
            tryTile([](dfb::TileHeader& t) { t.frame = -1; });
            tryTile([](dfb::TileHeader& t) { t.region.x1 -= 1; });
            tryTile([](dfb::TileHeader& t) { t.tile = 4; }); // the region is another's
            tryTile([](dfb::TileHeader& t) { t.tile = -1; });
            tryTile([](dfb::TileHeader& t) { t.tile = 28; });
            tryTile([](dfb::TileHeader& t) { t.pass = 1; });
            tryTile([](dfb::TileHeader& t) { t.pass = -1; });
            tryTile([](dfb::TileHeader& t) { t.generation = -1; });
            tryTile([](dfb::TileHeader& t) { t.generation = 1 << 20; });
            tryTile([](dfb::TileHeader& t) { t.children = -1; });
            texts.push_back(outcomeOf([&] { frame.start(*tile, 28); }));
            texts.push_back(outcomeOf([&] { frame.start(*tile, -1); }));
            texts.push_back(outcomeOf([&] { frame.start(*tile, 0, 1); }));
            texts.push_back(outcomeOf([&] { frame.declare({}); }));
            texts.push_back(outcomeOf([&] { (void)fb.begin(); }));
            const std::vector<float> pixels(16 * 16 * 4, 0.5f);
            Fb::TileView view;
            frame.start(view, 3);
            view.stride = 16;
            view.color = pixels.data();
            texts.push_back(outcomeOf([&] { frame.setTile(view); })); // no depth
            view.depth = pixels.data();
            view.stride = static_cast<std::size_t>(view.region.width()) - 1;
            texts.push_back(outcomeOf([&] { frame.setTile(view); }));
            sentMeanwhile = board->sent - before;
            over.set_value();
            // None of these calls has harmed the frame.
            for (int index = 0; index < 28; ++index)
                for (const dfb::Brick& brick : s.bricks)
                    scene::sendInput(frame, *tile, s, brick, index);
            frame.end();
        } else {
            auto frame = fb.begin(scene::paramsOf(s));
            auto tile = std::make_unique<Fb::Tile>();
            for (int index = 0; index < 28; ++index)
                scene::sendParent(frame, *tile, index, 4);
            const auto report = frame.end();
            wrong = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
        }
    });
    REQUIRE(texts.size() == 18);
    for (const std::string& text : texts) {
        INFO(text);
        CHECK(has(text, "InvalidArgument"));
    }
    CHECK(has(texts[0], "frame 2"));
    CHECK(has(texts[10], "-1 children"));
    CHECK(has(texts[10], "tile 3"));
    CHECK(has(texts[16], "without its depth"));
    CHECK(has(texts[17], "its stride is"));
    CHECK(sentMeanwhile == 0);
    CHECK(wrong == 0);
}

TEST_CASE("A tile or a rank that there is not is refused, and nothing comes of it", "[errors]")
{
    std::vector<std::string> texts;
    std::vector<double> bounds(2, -1);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<dfb::BasicOrderedBlend<16>> fb(communicator, dfb::FrameBufferConfig(20, 20));
        auto frame = fb.begin();
        if (fb.rank() == 1) {
            for (const int tile : {-1, 4})
                texts.push_back(outcomeOf([&] { frame.noteMergeError(tile, 0.5); }));
            for (const int rank : {-1, 2})
                texts.push_back(outcomeOf([&] { frame.hide(0, 1, rank); }));
            texts.push_back(outcomeOf([&] { frame.nextJob(-1); }));
            FrameBuffer<dfb::BasicOrderedBlend<16>>::TileView view;
            texts.push_back(outcomeOf([&] { frame.start(view, 0, 1); }));
            frame.start(view, 0);
            view.pass = 1;
            texts.push_back(outcomeOf([&] { frame.setTile(view); }));
        }
        frame.forEachTile(-1, [](std::int64_t, auto&) { throw std::runtime_error("a job of less than none"); });
        frame.forEachTile(frame.ownedTiles(), [&](auto& tile) { frame.setTile(tile); });
        bounds[static_cast<std::size_t>(fb.rank())] = frame.end().mergeErrorBound;
    });
    CHECK(bounds == std::vector<double>(2, 0));
    INFO(joined(texts));
    REQUIRE(texts.size() == 7);
    for (const std::string& text : texts)
        CHECK(has(text, "InvalidArgument"));
    CHECK(has(texts[1], "tile 4 of an image of 4 tiles"));
    CHECK(has(texts[3], "rank 2 of 2"));
    CHECK(has(texts[5], "pass 1 of a tile of 1"));
    CHECK(has(texts[6], "the tile has 1 passes"));
}

TEST_CASE("Ranks that call nextJob() for different numbers of jobs are told so", "[errors]")
{
    std::vector<std::string> texts(2);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<dfb::ImageParallel> fb(communicator, dfb::FrameBufferConfig(20, 20));
        texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] {
            auto frame = fb.begin();
            while (frame.nextJob(10 * (fb.rank() + 1)) >= 0) {
            }
            frame.end();
        });
    });
    INFO(joined(texts));
    CHECK(texts[0] == texts[1]);
    CHECK(has(texts[0], "ranks disagree"));
    CHECK((has(texts[0], "nextJob() of 10 jobs on rank 0 and of 20 on rank 1")
           || has(texts[0], "nextJob() of 20 jobs on rank 1 and of 10 on rank 0")));
}

TEST_CASE("Frame parameters that cannot be are refused", "[errors]")
{
    std::vector<std::string> texts;
    const Scene s = scene::makeScene(1);
    dfb::runRanks(1, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<Blend> fb(communicator, configOf(s));
        dfb::FrameConfig params;
        params.passes = 0;
        texts.push_back(outcomeOf([&] { (void)fb.begin(params); }));
        params.passes = 1;
        params.maxLayers = -1;
        texts.push_back(outcomeOf([&] { (void)fb.begin(params); }));
    });
    for (const std::string& text : texts) {
        INFO(text);
        CHECK(has(text, "InvalidArgument"));
    }
}

namespace {

// A codec with the id 0, which means that there is no codec.
struct NamelessCodec : dfb::Codec {
    std::uint8_t id() const noexcept override { return 0; }
    std::size_t bound(std::size_t byteCount) const override { return byteCount; }
    std::size_t compress(const std::byte*, std::size_t byteCount, std::byte*) const override { return byteCount; }
    bool decompress(const std::byte*, std::size_t, std::byte*, std::size_t) const override { return false; }
};

} // namespace

TEST_CASE("A wrong or differing configuration is refused on every rank", "[errors]")
{
    const auto refused = [](const std::function<void(int, dfb::FrameBufferConfig&)>& change) {
        for (const int ranks : {2, 5}) {
            const auto texts = constructed(ranks, change);
            UNSCOPED_INFO(joined(texts));
            if (!allSame(texts) || !has(texts.front(), "InvalidArgument"))
                return false;
        }
        return true;
    };
    // Invalid on all ranks, or on one.
    CHECK(refused([](int, dfb::FrameBufferConfig& c) { c.image.width = 0; }));
    CHECK(refused([](int, dfb::FrameBufferConfig& c) { c.image.height = 65537; }));
    CHECK(refused([](int, dfb::FrameBufferConfig& c) { c.image.displayRank = -1; }));
    CHECK(refused([](int, dfb::FrameBufferConfig& c) { c.image.displayRank = 5; }));
    CHECK(refused([](int rank, dfb::FrameBufferConfig& c) { c.image.width = rank == 1 ? -7 : c.image.width; }));
    CHECK(refused([](int rank, dfb::FrameBufferConfig& c) {
        if (rank == 1)
            c.image.ownerMap = [](int, const dfb::TileLayout&, int ranks) { return ranks; };
    }));
    CHECK(refused([](int rank, dfb::FrameBufferConfig& c) {
        if (rank == 1)
            c.messages.codec = std::make_shared<NamelessCodec>();
    }));
    // Different on one rank.
    CHECK(refused([](int rank, dfb::FrameBufferConfig& c) { c.image.width += rank == 1; }));
    CHECK(refused([](int rank, dfb::FrameBufferConfig& c) { c.image.height += rank == 0; }));
    CHECK(refused([](int rank, dfb::FrameBufferConfig& c) {
        c.image.format = rank == 1 ? dfb::OutputFormat::RGBA8 : c.image.format;
    }));
    CHECK(refused([](int rank, dfb::FrameBufferConfig& c) { c.image.depth = rank != 1; }));
    CHECK(refused([](int rank, dfb::FrameBufferConfig& c) { c.image.displayRank = rank == 1; }));
    CHECK(refused(
        [](int rank, dfb::FrameBufferConfig& c) { c.image.ownerMap = rank == 1 ? dfb::hashOwner : dfb::linearOwner; }));
    CHECK(refused([](int rank, dfb::FrameBufferConfig& c) {
        c.messages.codec = rank == 1 ? std::make_shared<CopyCodec>() : nullptr;
    }));

    std::vector<std::string> texts(3);
    dfb::runRanks(3, [&](dfb::InprocCommunicator communicator) {
        const auto config = configOf(scene::makeScene(1));
        texts[static_cast<std::size_t>(communicator.rank())] = outcomeOf([&] {
            if (communicator.rank() == 2)
                FrameBuffer<dfb::BasicAlphaBlend<8>>(communicator, config);
            else
                FrameBuffer<Blend>(communicator, config);
        });
    });
    INFO(joined(texts));
    CHECK((allSame(texts) && has(texts[0], "InvalidArgument")));
}

TEST_CASE("Different message pools are refused on every rank", "[errors]")
{
    const auto texts = constructed(
        3, [](int rank, dfb::FrameBufferConfig& c) { c.messages.poolBytes = rank == 1 ? 1 << 28 : 1 << 27; });
    INFO(joined(texts));
    CHECK((allSame(texts) && has(texts[0], "InvalidArgument")));
}

TEST_CASE("A frame begun with different backgrounds fails on every rank", "[errors]")
{
    const Scene s = scene::makeScene(4);
    const BadFrame bad = badFrame<FrameBuffer<Blend>>(3, s, configOf(s), [&](auto& fb) {
        Scene other = s;
        other.background[2] = fb.rank() == 1 ? 0.75f : 0.5f;
        scene::renderLoop(fb, other, Loop::Listing3);
    });
    INFO(joined(bad.texts));
    CHECK(allSame(bad.texts));
    CHECK(has(bad.texts[0], "FrameError: dfb: ranks disagree"));
    CHECK(bad.wrongAfter == 0);
}

TEST_CASE("declare() at a wrong time or of what is not there is refused, and nothing comes of it", "[errors]")
{
    const Scene s = scene::makeScene(3);
    const std::vector<dfb::testing::Pixel> expected = scene::referenceOf(s);
    for (const int ranks : {1, 3}) {
        std::vector<std::string> texts;
        std::size_t wrong = 0;
        dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
            FrameBuffer<Blend> fb(communicator, configOf(s));
            const dfb::World world(bricksOf(s, fb.rank(), fb.size()));
            const auto pairs = dfb::visibleTiles(world, scene::FlatCamera(), fb.layout());
            const auto inputs = dfb::inputsOf(world, pairs);
            std::vector<std::string> mine;
            for (int round = 0; round < 3; ++round) { // an input that was refused must not count in the next frame
                dfb::FrameConfig params = paramsOf(s);
                params.declared = true;
                auto frame = fb.begin(params);
                mine.push_back(outcomeOf([&] { frame.declare({{0, 0, 0}, {28, 0, 0}}); }));
                mine.push_back(outcomeOf([&] { frame.declare({{0, 0, 0}, {-1, 0, 0}}); }));
                frame.declare(inputs);
                mine.push_back(outcomeOf([&] { frame.declare({}); }));
                const auto tile = std::make_unique<FrameBuffer<Blend>::Tile>();
                for (const dfb::BrickInTile& pair : pairs) {
                    const dfb::Brick& brick = world.bricks()[static_cast<std::size_t>(pair.brick)];
                    scene::sendInput(frame, *tile, s, brick, pair.tile);
                }
                mine.push_back(outcomeOf([&] { frame.declare(inputs); }));
                const auto report = frame.end();
                if (fb.isDisplayRank())
                    wrong += scene::wrongValues(Picture(fb.image(), report), expected);
                // A frame in which nothing is declared.
                params.declared = false;
                auto other = fb.begin(params);
                mine.push_back(outcomeOf([&] { other.declare(inputs); }));
                for (const int index : fb.ownedTiles()) {
                    other.start(*tile, index);
                    other.setTile(*tile);
                }
                other.end();
            }
            if (fb.isDisplayRank())
                texts = mine;
        });
        CHECK(wrong == 0);
        CHECK(texts.size() == 15);
        for (const std::string& text : texts) {
            INFO(text);
            CHECK(has(text, "InvalidArgument"));
        }
    }
}

TEST_CASE("A loop that fails before it has declared its inputs fails the frame at once", "[errors]")
{
    struct NoCamera {
        bool throws;
        dfb::Region project(const dfb::Box3& b, int width, int height) const
        {
            if (throws)
                throw std::runtime_error("no camera");
            return scene::FlatCamera().project(b, width, height);
        }
    };
    const Scene s = scene::makeScene(6, 3);
    for (const bool isPartial : {false, true})
        for (int odd = 0; odd < 3; ++odd) {
            const auto start = std::chrono::steady_clock::now();
            const BadFrame bad = badFrame<FrameBuffer<Blend>>(3, s, configOf(s), [&](auto& fb) {
                dfb::FrameConfig params = paramsOf(s);
                params.timeout = std::chrono::milliseconds(60000);
                params.allowPartial = isPartial;
                const auto report = dfb::DataParallelLoop(fb, dfb::World(bricksOf(s, fb.rank(), fb.size())))
                                        .render(
                                            NoCamera{fb.rank() == odd},
                                            [&](const dfb::Brick& b, auto& tile) { renderBrick(s, b, tile); }, params);
                if (report.failure)
                    throw dfb::FrameError(*report.failure);
            });
            INFO("rank " << odd << (isPartial ? ", partial" : "") << joined(bad.texts));
            CHECK(allSame(bad.texts));
            CHECK(has(bad.texts[0], "FrameError"));
            CHECK(has(bad.texts[0], "no camera"));
            CHECK(has(bad.texts[0], "rank " + std::to_string(odd)));
            CHECK(bad.wrongAfter == 0);
            CHECK(std::chrono::steady_clock::now() - start < std::chrono::seconds(30));
        }
}

TEST_CASE("Ranks that wait for different things find out, and none waits for ever", "[errors]")
{
    // The scene is empty, so no input travels that could reveal the difference.
    const Scene s = scene::makeScene(0);
    for (const bool oddDeclares : {true, false})
        for (const int ranks : {2, 3, 5})
            for (int odd = 0; odd < ranks; ++odd) {
                const BadFrame bad = badFrame<FrameBuffer<Blend>>(ranks, s, configOf(s), [&](auto& fb) {
                    const bool isOdd = fb.rank() == odd;
                    dfb::FrameConfig params;
                    params.declared = isOdd == oddDeclares;
                    auto frame = fb.begin(params);
                    if (params.declared)
                        frame.declare({});
                    auto tile = std::make_unique<typename std::decay_t<decltype(fb)>::Tile>();
                    for (int index : fb.ownedTiles())
                        if (!params.declared) {
                            frame.start(*tile, index);
                            frame.setTile(*tile);
                        }
                    frame.end();
                });
                INFO((oddDeclares ? "declares" : "does not declare") << ", rank " << odd << joined(bad.texts));
                CHECK(allSame(bad.texts));
                CHECK(has(bad.texts[0], "FrameError: dfb: ranks disagree: frame "));
                const std::string value = oddDeclares ? "true" : "false";
                CHECK(has(bad.texts[0], "FrameConfig::declared is "));
                CHECK(has(bad.texts[0], value + " on rank " + std::to_string(odd)));
                CHECK(bad.wrongAfter == 0);
            }
}

TEST_CASE("Ranks that were given other passes or samples find out, also where nobody waits for a time-out", "[errors]")
{
    // The odd rank has no data and owns tiles. It waits for inputs that no rank renders, and the others wait for its
    // tiles.
    struct Case {
        bool samples;
        int odd;
    };
    const Scene s = scene::makeScene(3);
    const auto run = [&](const Case& c) {
        return badFrame<FrameBuffer<Blend>>(3, s, configOf(s), [&](auto& fb) {
            const bool isOdd = fb.rank() == c.odd;
            dfb::FrameConfig params = scene::paramsOf(s);
            const dfb::TileSamples samples{0, isOdd ? 2 : 1};
            if (c.samples)
                params.samples = std::make_shared<std::vector<dfb::TileSamples>>(
                    static_cast<std::size_t>(fb.layout().tileCount()), samples);
            else
                params.passes = samples.count;
            const dfb::World world(isOdd ? std::vector<dfb::Brick>() : scene::bricksOf(s, fb.rank(), fb.size()));
            dfb::DataParallelLoop(fb, world).render(
                scene::FlatCamera(), [&](const dfb::Brick& brick, auto& tile) { scene::renderBrick(s, brick, tile); },
                params);
        });
    };
    board::eachAtOnce(std::vector<Case>{{false, 0}, {false, 1}, {false, 2}, {true, 0}, {true, 1}, {true, 2}}, run,
                      [](const Case& c, const BadFrame& bad) {
                          INFO((c.samples ? "samples" : "passes") << ", rank " << c.odd << joined(bad.texts));
                          CHECK(allSame(bad.texts));
                          CHECK(has(bad.texts[0], "FrameError: dfb: ranks disagree"));
                          CHECK(has(bad.texts[0], c.samples ? "FrameConfig::samples is " : "FrameConfig::passes is "));
                          CHECK(has(bad.texts[0], (c.samples ? "a plan of 56 samples on rank " : "2 on rank ")
                                                      + std::to_string(c.odd)));
                          CHECK(bad.wrongAfter == 0);
                      });
}

namespace {

struct Same {
    static constexpr bool pointwise = true;
    void process(dfb::PixelTile&) const {}
};

// The errors if rank 0 makes a framebuffer of one type and rank 1 one of another.
template <class One, class Other>
std::vector<std::string> madeOf(const Scene& s)
{
    std::vector<std::string> texts(2);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        texts[static_cast<std::size_t>(communicator.rank())] = outcomeOf([&] {
            if (communicator.rank() == 0)
                One(communicator, configOf(s));
            else
                Other(communicator, configOf(s));
        });
    });
    return texts;
}

} // namespace

TEST_CASE("Ranks with different operations are refused on every rank", "[errors]")
{
    using Blended = FrameBuffer<Blend>;
    const Scene s = scene::makeScene(3);
    const auto tileOps = madeOf<Blended, FrameBuffer<dfb::BasicDepthComposite<16>>>(s);
    const auto pixelOps = madeOf<FrameBuffer<Blend, Same>, Blended>(s);
    INFO(joined(tileOps) << joined(pixelOps));
    CHECK(allSame(tileOps));
    CHECK(has(tileOps[0], "InvalidArgument"));
    CHECK(has(tileOps[0], "the tile operation is dfb::BasicAlphaBlend<16"));
    CHECK(has(tileOps[0], " on rank 0 and dfb::BasicDepthComposite<16"));
    CHECK_FALSE(has(tileOps[0], "pixel operation"));
    CHECK(allSame(pixelOps));
    CHECK(has(pixelOps[0], "and dfb::NoPixelOp on rank 1"));
    CHECK(madeOf<Blended, Blended>(s) == std::vector<std::string>(2, "fine"));
}

namespace {

struct FaultyNewFrame {
    static constexpr bool pointwise = true;
    struct FrameData {
        bool broken = false;
    };
    void newFrame(const FrameData& data)
    {
        if (data.broken)
            throw std::runtime_error("no such look-up table");
    }
    void process(dfb::PixelTile&) const {}
};

} // namespace

TEST_CASE("An exception of a pixel operation's newFrame comes out of end() on every rank", "[errors]")
{
    const Scene s = scene::makeScene(0);
    for (int culprit = 0; culprit < 3; ++culprit) {
        const BadFrame bad = badFrame<FrameBuffer<Blend, FaultyNewFrame>>(3, s, configOf(s), [&](auto& fb) {
            dfb::FrameConfig params;
            params.declared = true;
            auto frame = fb.begin(params, {}, {fb.rank() == culprit});
            frame.declare({});
            frame.end();
        });
        INFO("rank " << culprit << joined(bad.texts));
        CHECK(allSame(bad.texts));
        CHECK(has(bad.texts[0], "FrameError: dfb: exception in user code: rank " + std::to_string(culprit)));
        CHECK(has(bad.texts[0], "no such look-up table"));
        CHECK(bad.wrongAfter == 0);
    }
}

TEST_CASE("An exception in a renderer fails the frame on every rank", "[errors]")
{
    const Scene s = scene::makeScene(6);
    for (const bool declared : {true, false})
        for (int culprit = 0; culprit < 3; ++culprit) {
            const BadFrame bad = badFrame<FrameBuffer<Blend>>(3, s, configOf(s), [&](auto& fb) {
                const auto render = [&](auto& tile) {
                    if (fb.rank() == culprit && tile.tile > 3)
                        throw std::runtime_error("the renderer broke");
                };
                if (declared)
                    dfb::DataParallelLoop(
                        fb, dfb::World({{static_cast<std::uint32_t>(fb.rank()), {{0, 0, 0}, {97, 61, 1}}}}))
                        .render(scene::FlatCamera(), [&](const dfb::Brick&, auto& tile) { render(tile); });
                else
                    dfb::ImageParallelLoop(fb).render(render);
            });
            INFO("rank " << culprit << joined(bad.texts));
            CHECK(allSame(bad.texts));
            CHECK(has(bad.texts[0], "FrameError: dfb: exception in user code"));
            CHECK(has(bad.texts[0], "rank " + std::to_string(culprit)));
            CHECK(has(bad.texts[0], "the renderer broke"));
            CHECK(bad.wrongAfter == 0);
        }
}

TEST_CASE("A frame that is given up without an exception fails on every rank", "[errors]")
{
    const Scene s = scene::makeScene(3);
    const BadFrame bad = badFrame<FrameBuffer<Blend>>(3, s, configOf(s), [](auto& fb) {
        auto frame = fb.begin();
        if (fb.rank() == 1)
            frame.abort(nullptr);
        frame.end();
    });
    INFO(joined(bad.texts));
    CHECK(allSame(bad.texts));
    CHECK(has(bad.texts[0], "FrameError: dfb: invalid argument: rank 1"));
    CHECK(has(bad.texts[0], "no exception"));
    CHECK(bad.wrongAfter == 0);
}

TEST_CASE("An exception in a tile operation fails the frame on every rank", "[errors]")
{
    const Scene s = scene::makeScene(6);
    for (const auto where : {Faulty::Where::NewFrame, Faulty::Where::Add, Faulty::Where::Finish})
        for (int culprit = 0; culprit < 3; ++culprit)
            for (const bool standard : {true, false}) {
                const BadFrame bad = badFrame<FrameBuffer<Faulty>>(3, s, configOf(s), [&](auto& fb) {
                    dfb::DataParallelLoop(fb, dfb::World(scene::bricksOf(s, fb.rank(), 3)))
                        .render(scene::FlatCamera(),
                                [&](const dfb::Brick& brick, auto& tile) { scene::renderBrick(s, brick, tile); }, {},
                                {where, culprit, standard});
                });
                INFO("in " << static_cast<int>(where) << " on rank " << culprit << joined(bad.texts));
                CHECK(allSame(bad.texts));
                CHECK(has(bad.texts[0], "FrameError: dfb: exception in user code"));
                CHECK(has(bad.texts[0], "rank " + std::to_string(culprit)));
                CHECK(has(bad.texts[0], "tile "));
                CHECK(has(bad.texts[0], standard ? "the op broke" : "not a std::exception"));
                CHECK(bad.wrongAfter == 0);
            }
}

namespace {

// An operation that writes as many rows in border tiles as in whole ones.
class TooManyRows : public Blend {
public:
    void finish(dfb::FinishedTile& out)
    {
        Blend::finish(out);
        const std::vector<double> row(4 * tileSize);
        for (int y = out.height(); y < tileSize; ++y)
            out.setRow(y, row.data(), nullptr);
    }
};

} // namespace

TEST_CASE("An operation that writes a row which its tile does not have fails the frame on every rank", "[errors]")
{
    Scene s = scene::makeScene(6);
    s.bricks.front().bounds = {{0, 0, 0}, {97, 61, 1}}; // all tiles, also those of 13 rows
    std::vector<std::string> texts(2);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<TooManyRows> fb(communicator, configOf(s));
        texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] { scene::renderLoop(fb, s, Loop::Declared); });
    });
    INFO(joined(texts));
    CHECK(allSame(texts));
    CHECK(has(texts[0], "FrameError: dfb: invalid argument"));
    CHECK(has(texts[0], "row 13 of a tile of "));
}

TEST_CASE("Pixels outside a finished tile are refused, and nothing is written", "[errors]")
{
    std::vector<float> colors(4 * 8 * 8, 1.0f), depths(8 * 8, 1.0f);
    dfb::detail::Planes planes;
    planes.at[dfb::detail::Color] = reinterpret_cast<std::byte*>(&colors[4 * 8]); // from the second row on, as Depth
    planes.at[dfb::detail::Depth] = reinterpret_cast<std::byte*>(&depths[8]);
    dfb::FinishedTile tile({0, 0, 7, 5}, dfb::OutputFormat::RGBA32F, planes, 8);
    const std::vector<double> doubles(4 * 8);
    const std::vector<float> floats(4 * 8);
    const auto* stored = reinterpret_cast<const std::byte*>(floats.data());
    struct Pixels {
        int x, y, count;
    };
    for (const Pixels p : {Pixels{0, -1, 7}, {0, 5, 7}, {-1, 0, 3}, {5, 0, 3}, {0, 0, -1}, {7, 0, 1}}) {
        INFO(p.x << ' ' << p.y << ' ' << p.count);
        if (p.y != 0)
            CHECK_THROWS_AS(tile.setRow(p.y, doubles.data(), floats.data()), dfb::InvalidArgument);
        CHECK_THROWS_AS(tile.setPixels(p.x, p.y, p.count, doubles.data(), floats.data()), dfb::InvalidArgument);
        CHECK_THROWS_AS(tile.setPixels(p.x, p.y, p.count, floats.data()), dfb::InvalidArgument);
        CHECK_THROWS_AS(tile.setStored(p.x, p.y, p.count, stored, floats.data()), dfb::InvalidArgument);
        CHECK_THROWS_AS(tile.fillPixels(p.x, p.y, p.count, stored), dfb::InvalidArgument);
    }
    CHECK(tile.writtenPixels() == 0);
    CHECK(std::count(colors.begin(), colors.end(), 1.0f) == 4 * 8 * 8);
    CHECK(std::count(depths.begin(), depths.end(), 1.0f) == 8 * 8);
    tile.setRow(4, doubles.data(), floats.data());
    tile.fillPixels(7, 4, 0, stored);
    CHECK(std::count(depths.begin(), depths.end(), 0.0f) == 7);
}

namespace {

// A bad frame, in which a FaultyPixelOp throws on one rank, and a good one.
template <bool Pointwise>
BadFrame brokenPixelOp(int culprit, const Scene& s)
{
    BadFrame bad;
    bad.texts.resize(3);
    dfb::runRanks(3, [&](dfb::InprocCommunicator communicator) {
        using Fb = FrameBuffer<Blend, FaultyPixelOp<Pointwise>>;
        Fb fb(communicator, configOf(s), {communicator.rank(), {}});
        const dfb::World world(scene::bricksOf(s, fb.rank(), 3));
        const auto render = [&](const dfb::Brick& brick, auto& tile) { scene::renderBrick(s, brick, tile); };
        dfb::DataParallelLoop loop(fb, world);
        bad.texts[static_cast<std::size_t>(fb.rank())] =
            outcomeOf([&] { loop.render(scene::FlatCamera(), render, scene::paramsOf(s), {}, {culprit}); });
        const auto report = loop.render(scene::FlatCamera(), render, scene::paramsOf(s));
        if (fb.isDisplayRank())
            bad.wrongAfter = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
    });
    return bad;
}

} // namespace

TEST_CASE("An exception in a pixel operation fails the frame on every rank", "[errors]")
{
    for (const int bricks : {9, 0}) {
        const Scene s = scene::makeScene(bricks);
        for (int culprit = 0; culprit < 3; ++culprit) {
            const BadFrame bad = brokenPixelOp<false>(culprit, s);
            INFO("not pointwise, " << bricks << " bricks, rank " << culprit << joined(bad.texts));
            CHECK(allSame(bad.texts));
            CHECK(has(bad.texts[0], "FrameError: dfb: exception in user code: rank " + std::to_string(culprit)));
            CHECK(has(bad.texts[0], "the pixel op broke"));
            CHECK(bad.wrongAfter == 0);
        }
    }
    const Scene s = scene::makeScene(9);
    for (int culprit = 0; culprit < 3; ++culprit) {
        const BadFrame bad = brokenPixelOp<true>(culprit, s);
        INFO("pointwise, rank " << culprit << joined(bad.texts));
        CHECK(allSame(bad.texts));
        CHECK(has(bad.texts[0], "FrameError: dfb: exception in user code: rank " + std::to_string(culprit)));
        CHECK(bad.wrongAfter == 0);
    }
}

TEST_CASE("An exception of a pointwise pixel operation on the background fails the frame on every rank", "[errors]")
{
    // Only the display rank computes the background colour.
    const BadFrame bad = brokenPixelOp<true>(0, scene::makeScene(0));
    INFO(joined(bad.texts));
    CHECK(allSame(bad.texts));
    CHECK(has(bad.texts[0], "FrameError: dfb: exception in user code: rank 0"));
    CHECK(bad.wrongAfter == 0);
}

TEST_CASE("A frame left without end() is cancelled on every rank", "[errors]")
{
    const Scene s = scene::makeScene(6);
    for (int culprit = 0; culprit < 3; ++culprit)
        for (const bool byException : {false, true}) {
            const BadFrame bad = badFrame<FrameBuffer<Blend>>(3, s, configOf(s), [&](auto& fb) {
                if (fb.rank() != culprit) {
                    scene::renderLoop(fb, s, Loop::Declared);
                    return;
                }
                dfb::FrameConfig params = scene::paramsOf(s);
                params.declared = true;
                auto frame = fb.begin(params);
                if (byException)
                    throw std::runtime_error("something else broke");
            });
            INFO("rank " << culprit << joined(bad.texts));
            for (int rank = 0; rank < 3; ++rank) {
                const std::string& text = bad.texts[static_cast<std::size_t>(rank)];
                if (rank == culprit)
                    CHECK(text == (byException ? "exception: something else broke" : "fine"));
                else
                    CHECK(has(text, "FrameError: dfb: frame cancelled: rank " + std::to_string(culprit)));
            }
            CHECK(bad.wrongAfter == 0);
        }
}

TEST_CASE("A frame that is left when all is done ends for the rank that leaves it, too", "[errors]")
{
    for (const bool partial : {false, true}) {
        std::vector<float> mean(2, 0.0f);
        dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
            using Framebuffer = FrameBuffer<dfb::Progressive<dfb::ImageParallel>>;
            dfb::FrameBufferConfig config(128, 64, dfb::OutputFormat::RGBA32F);
            Framebuffer fb(communicator, config);
            dfb::ImageParallelLoop loop(fb);
            dfb::FrameConfig params;
            params.allowPartial = partial;
            for (int i = 0; i < 3; ++i) { // the samples 1, 2, 3
                auto frame = loop.start(
                    [](auto& tile) {
                        const auto value = static_cast<float>(tile.sample + 1);
                        tile.fill({value, value, value, 1});
                    },
                    params);
                while (!frame.isDone())
                    std::this_thread::yield();
                if (i == fb.rank()) {
                    const auto left = std::move(frame);
                } else {
                    frame.end();
                }
            }
            if (fb.isDisplayRank())
                mean = {fb.image().rgba32f()[0], fb.image().rgba32f()[std::size_t{4} * 64]};
        });
        CHECK(mean == std::vector<float>{2, 2});
    }
}

TEST_CASE("Frames that all ranks leave, many times over", "[errors]")
{
    const Scene s = scene::makeScene(6);
    std::size_t wrong = 1;
    std::int64_t frame = 0;
    dfb::runRanks(3, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<Blend> fb(communicator, configOf(s, 2));
        for (int i = 0; i < 50; ++i) {
            auto open = fb.begin();
            auto tile = std::make_unique<FrameBuffer<Blend>::Tile>();
            for (int index = 0; index < 28 && i % 2 == 0; ++index)
                send(open, *tile, index, 1, static_cast<std::uint32_t>(fb.rank()), 0, 0);
        }
        const auto report = scene::renderLoop(fb, s, Loop::Declared);
        if (fb.isDisplayRank()) {
            wrong = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
            frame = report.frame;
        }
    });
    CHECK(wrong == 0);
    CHECK(frame == 51);
}

TEST_CASE("Inputs that contradict the tree fail the frame on every rank, and are named", "[errors]")
{
    const Scene s = scene::makeScene(6);
    // `empty` gets no input, so that the owner does not vote before it has seen the mistake.
    const int index = 5, empty = 6;
    struct Mistake {
        const char* name;
        std::function<void(const std::function<void(int, std::uint32_t, std::uint16_t, int)>&)>
            inputs; // generation, source, part, children
        std::vector<std::string> parts;
    };
    const std::vector<Mistake> mistakes{
        {"too many",
         [](const auto& in) { in(1, 50, 0, 0), in(1, 51, 0, 0), in(1, 52, 0, 0), in(0, 9, 0, 2); },
         {"too many inputs", "generation 1", "expected 2, got 3", "source 5"}},
        {"too many roots",
         [](const auto& in) { in(0, 80, 0, 1), in(0, 81, 0, 1); }, // in any order
         {"too many inputs", "generation 0", "source 8", "expected 1, got 2"}},
        {"duplicate",
         [](const auto& in) { in(1, 50, 3, 0), in(1, 50, 3, 0), in(0, 9, 0, 2); },
         {"duplicate input", "generation 1", "source 50", "expected 1, got 2"}},
        {"unannounced",
         [](const auto& in) { in(2, 50, 0, 0), in(1, 51, 0, 0), in(0, 9, 0, 1); },
         {"unannounced input", "generation 2", "source 50", "expected 0, got 1"}},
    };
    for (const Mistake& mistake : mistakes)
        for (int culprit = 0; culprit < 3; ++culprit) {
            auto config = configOf(s);
            config.image.ownerMap = [](int tile, const dfb::TileLayout&, int) {
                return tile == index || tile == empty ? 1 : 0;
            };
            const BadFrame bad = badFrame<FrameBuffer<Blend>>(3, s, config, [&](auto& fb) {
                auto frame = fb.begin();
                auto tile = std::make_unique<FrameBuffer<Blend>::Tile>();
                if (fb.rank() == 0)
                    for (int other = 0; other < 28; ++other)
                        if (other != index && other != empty)
                            send(frame, *tile, other, 0, 0, 0, 0);
                if (fb.rank() == culprit)
                    mistake.inputs([&](int generation, std::uint32_t source, std::uint16_t part, int children) {
                        send(frame, *tile, index, generation, source, part, children);
                    });
                frame.end();
            });
            INFO(mistake.name << " from rank " << culprit << joined(bad.texts));
            CHECK(allSame(bad.texts));
            CHECK(has(bad.texts[0], "noticed by rank 1, from rank " + std::to_string(culprit) + ", frame 1, tile "
                                        + std::to_string(index) + ", pass 0"));
            for (const std::string& part : mistake.parts)
                CHECK(has(bad.texts[0], part));
            CHECK(bad.wrongAfter == 0);
        }
}

TEST_CASE("An input that comes when its owner has already voted does not vanish", "[errors]")
{
    // The input is one too many and is held back until its owner has voted. It is an error on all ranks, and counted as
    // late.
    const auto board = std::make_shared<Board>();
    std::promise<void> ownerVoted, mayBegin;
    const auto mayBeginFuture = mayBegin.get_future().share();
    std::atomic<bool> inFrame{false};
    board->inspect = [&](int from, int, const dfb::detail::MessageHeader& header, dfb::Buffer& message) {
        // The first reduction message of rank 2 in the frame is its vote.
        if (from == 2 && header.kind == dfb::detail::MessageKind::ReduceUp && inFrame.exchange(false))
            ownerVoted.set_value();
        const bool extra =
            header.kind == dfb::detail::MessageKind::Fragment && header.number == 1
            && dfb::detail::loadAs<dfb::detail::FragmentHeader>(message.data() + sizeof header).source == 99;
        return from == 1 && extra ? Board::What::Hold : Board::What::Pass;
    };
    const Scene s = scene::makeScene(0, 1, 16, 16);
    std::vector<std::string> texts(3);
    std::vector<std::int64_t> late(3);
    dfb::runRanks(3, [&](dfb::InprocCommunicator communicator) {
        using Fb = InspectedFrameBuffer<Blend>;
        auto config = configOf(s);
        config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 2; };
        config.image.format = dfb::OutputFormat::None;
        Fb fb({{communicator, std::nullopt}, board}, config);
        const auto rank = static_cast<std::size_t>(fb.rank());
        fb.allReduce({0}, Fb::Reduce::Sum);
        if (fb.rank() == 1) {
            inFrame = true;
            mayBegin.set_value();
        }
        mayBeginFuture.wait();
        texts[rank] = outcomeOf([&] {
            auto frame = fb.begin();
            auto tile = std::make_unique<Fb::Tile>();
            if (fb.rank() == 2)
                send(frame, *tile, 0, 0, 2, 0, 0);
            if (fb.rank() == 1) {
                send(frame, *tile, 0, 1, 99, 0, 0);
                ownerVoted.get_future().wait();
                board->release();
            }
            late[rank] += frame.end().lateMessages;
        });
        // Late messages are counted in the next verdict, or in a later one if a busy machine reads them so late.
        for (int i = 0; i < 50 && late[rank] == 0; ++i) {
            auto frame = fb.begin();
            auto tile = std::make_unique<Fb::Tile>();
            if (fb.rank() == 2)
                send(frame, *tile, 0, 0, 2, 0, 0);
            late[rank] += frame.end().lateMessages;
        }
    });
    INFO(joined(texts) << "\n  late: " << late[0]);
    CHECK(allSame(texts));
    CHECK((has(texts[0], "FrameError: dfb: ranks disagree") || has(texts[0], "FrameError: dfb: unannounced input")));
    CHECK(late[0] >= 1);
}

namespace {

// Only one of two inputs was announced. The other one comes first, and the announced one after all ranks have voted.
template <class TileOp>
std::vector<std::string> withInputTooMany(bool allowPartial)
{
    const auto board = std::make_shared<Board>();
    board->inspect = [&](int from, int, const dfb::detail::MessageHeader& header, dfb::Buffer& message) {
        if (from == 0 && header.kind == dfb::detail::MessageKind::ReduceDown && header.number == 1
            && dfb::detail::loadAs<std::uint32_t>(message.data() + sizeof header) != 0) // the verdict
            board->release();
        const bool announced =
            header.kind == dfb::detail::MessageKind::Fragment
            && dfb::detail::loadAs<dfb::detail::FragmentHeader>(message.data() + sizeof header).source == 7;
        return announced ? Board::What::Hold : Board::What::Pass;
    };
    const Scene s = scene::makeScene(0, 1, 16, 16);
    std::vector<std::string> texts(2);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        using Fb = InspectedFrameBuffer<TileOp>;
        auto config = configOf(s);
        config.image.depth = false;
        config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 1; };
        Fb fb({{communicator, std::nullopt}, board}, config);
        texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] {
            dfb::FrameConfig params;
            params.timeout = std::chrono::milliseconds(20000);
            params.allowPartial = allowPartial;
            auto frame = fb.begin(params);
            auto tile = std::make_unique<typename Fb::Tile>();
            if (fb.rank() == 1) {
                send(frame, *tile, 0, 0, 1, 0, 1);
            } else {
                send(frame, *tile, 0, 1, 7, 0, 0);
                send(frame, *tile, 0, 1, 99, 0, 0);
            }
            frame.end();
        });
    });
    return texts;
}

} // namespace

TEST_CASE("An input that takes the place of an announced one is an error, whatever the operation", "[errors]")
{
    for (const bool allowPartial : {false, true})
        for (const auto& texts :
             {withInputTooMany<Blend>(allowPartial), withInputTooMany<dfb::BasicDepthComposite<16>>(allowPartial),
              withInputTooMany<dfb::BasicOrderedBlend<16>>(allowPartial)}) {
            INFO(joined(texts));
            CHECK(allSame(texts));
            CHECK(has(texts[0], "FrameError: dfb: ranks disagree: frame "));
            CHECK(has(texts[0], ", expected 0, got 1: more inputs were sent"));
        }
}

TEST_CASE("Cancelling or aborting a frame that is over changes nothing", "[errors]")
{
    const Scene s = scene::makeScene(3);
    std::vector<std::string> texts(2);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<Blend> fb(communicator, configOf(s));
        texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] {
            dfb::FrameConfig params;
            params.declared = true;
            auto first = fb.begin(params);
            first.declare({});
            first.end();
            const auto stop = [&] {
                first.cancel();
                first.abort(std::make_exception_ptr(std::runtime_error("too late")));
            };
            stop();
            auto second = fb.begin(params);
            second.declare({});
            stop();
            second.end();
        });
    });
    INFO(joined(texts));
    CHECK(texts == std::vector<std::string>(2, "fine"));
}

TEST_CASE("Tiles of a frame that is over are dropped before they are sent", "[errors]")
{
    auto config = configOf(scene::makeScene(3));
    config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
    std::vector<std::int64_t> late(2);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<Blend> fb(communicator, config);
        dfb::FrameConfig params;
        params.declared = true;
        params.timeout = std::chrono::seconds(5); // otherwise setTile() might wait for room for ever
        auto first = fb.begin(params);
        first.declare({});
        auto tile = std::make_unique<typename FrameBuffer<Blend>::Tile>();
        first.start(*tile, 0);
        tile->generation = 1;
        first.end();
        for (int i = 0; i < 3; ++i)
            first.setTile(*tile);
        auto second = fb.begin(params);
        second.declare({});
        late[static_cast<std::size_t>(fb.rank())] = second.end().lateMessages;
    });
    CHECK(late == std::vector<std::int64_t>(2, 0));
}

TEST_CASE("A frame that has ended or was moved from cannot be ended", "[errors]")
{
    dfb::runRanks(1, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<Blend> fb(communicator, configOf(scene::makeScene(3)));
        dfb::FrameConfig params;
        params.declared = true;
        params.timeout = std::chrono::seconds(5);
        auto from = fb.begin(params);
        auto frame = std::move(from);
        frame.declare({});
        CHECK_THROWS_AS(from.end(), dfb::InvalidArgument);
        CHECK(frame.end().frame == 1);
        CHECK_THROWS_AS(frame.isDone(), dfb::InvalidArgument);
        CHECK_THROWS_AS(frame.tryEnd(), dfb::InvalidArgument);
        CHECK_THROWS_AS(frame.end(), dfb::InvalidArgument);
        frame = fb.begin(params); // as a member of a window would be
        frame.declare({});
        CHECK(frame.end().frame == 2);
    });
}

TEST_CASE("A frame that another one is assigned to is left", "[errors]")
{
    std::string text;
    std::int64_t number = 0;
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        auto config = configOf(scene::makeScene(3));
        config.framesInFlight = 2;
        FrameBuffer<Blend> fb(communicator, config);
        auto frame = fb.begin();
        auto next = fb.begin();
        if (fb.rank() == 0) {
            frame = std::move(next);
            number = frame.number();
        } else {
            try {
                frame.end();
            } catch (const dfb::FrameError& e) {
                text = e.what();
            }
        }
    });
    CHECK(number == 2);
    CHECK(text.find("the frame was left without end()") != std::string::npos);
}

TEST_CASE("What was not declared, or not sent as declared, is named", "[errors]")
{
    const Scene s = scene::makeScene(6);
    struct Mistake {
        const char* name;
        std::vector<dfb::TileInput> declared;
        std::vector<dfb::TileInput> sent;
        std::vector<std::string> parts;
    };
    const std::vector<Mistake> mistakes{
        {"another source",
         {{5, 50, 0}},
         {{5, 51, 0}, {5, 50, 0}},
         {"unannounced input", "tile 5", "generation 1", "source 51", "expected 0, got 1"}},
        {"another part",
         {{5, 50, 0}},
         {{5, 50, 1}, {5, 50, 0}},
         {"unannounced input", "tile 5", "generation 1", "source 50", "expected 0, got 1"}},
        {"a tile that nobody declared",
         {{4, 50, 0}},
         {{5, 51, 0}, {4, 50, 0}},
         {"unannounced input", "tile 5", "generation 1", "source 51", "expected 0, got 1"}},
        {"declared twice",
         {{5, 50, 0}, {5, 50, 0}},
         {{5, 50, 0}},
         {"duplicate input", "tile 5", "generation 1", "source 50", "expected 1, got 2"}},
        {"sent twice",
         {{5, 50, 0}, {5, 51, 0}},
         {{5, 50, 0}, {5, 50, 0}, {5, 51, 0}},
         {"duplicate input", "tile 5", "generation 1", "source 50", "expected 1, got 2"}},
    };
    for (const Mistake& mistake : mistakes)
        for (int culprit = 0; culprit < 3; ++culprit)
            for (const bool sendFirst : {false, true}) {
                auto config = configOf(s);
                config.image.ownerMap = [](int tile, const dfb::TileLayout&, int) {
                    return tile == 4 || tile == 5 ? 1 : 0;
                };
                const BadFrame bad = badFrame<FrameBuffer<Blend>>(
                    3, s, config,
                    [&](auto& fb) {
                        dfb::FrameConfig params;
                        params.declared = true;
                        auto frame = fb.begin(params);
                        auto tile = std::make_unique<FrameBuffer<Blend>::Tile>();
                        const auto sendAll = [&] {
                            for (const dfb::TileInput& input : mistake.sent)
                                if (fb.rank() == culprit)
                                    send(frame, *tile, input.tile, 1, input.source, input.part, 0);
                        };
                        if (sendFirst)
                            sendAll();
                        frame.declare(fb.rank() == culprit ? mistake.declared : std::vector<dfb::TileInput>());
                        if (!sendFirst)
                            sendAll();
                        frame.end();
                    },
                    0);
                INFO(mistake.name << " on rank " << culprit << (sendFirst ? ", sent before" : ", sent after")
                                  << joined(bad.texts));
                CHECK(allSame(bad.texts));
                CHECK(has(bad.texts[0], "FrameError"));
                CHECK(has(bad.texts[0], "rank 1"));
                for (const std::string& part : mistake.parts)
                    CHECK(has(bad.texts[0], part));
                CHECK(bad.wrongAfter == 0);
            }
}

TEST_CASE("end() without declare() fails the frame on every rank", "[errors]")
{
    const Scene s = scene::makeScene(6);
    for (int culprit = 0; culprit < 3; ++culprit) {
        const BadFrame bad = badFrame<FrameBuffer<Blend>>(3, s, configOf(s), [&](auto& fb) {
            dfb::FrameConfig params;
            params.declared = true;
            auto frame = fb.begin(params);
            if (fb.rank() != culprit)
                frame.declare({});
            frame.end();
        });
        INFO(joined(bad.texts));
        CHECK(allSame(bad.texts));
        CHECK(has(bad.texts[0], "FrameError"));
        CHECK(has(bad.texts[0], "rank " + std::to_string(culprit)));
        CHECK(has(bad.texts[0], "declare()"));
        CHECK(bad.wrongAfter == 0);
    }
}

TEST_CASE("A broken message fails the frame on every rank and names its sender", "[errors]")
{
    const Scene s = scene::makeScene(6);
    const auto board = std::make_shared<Board>();
    std::atomic<bool> done{false};
    board->inspect = [&](int from, int, const dfb::detail::MessageHeader& header, dfb::Buffer& message) {
        // The first input from rank 2 loses its last byte.
        if (from == 2 && header.kind == dfb::detail::MessageKind::Fragment && !done.exchange(true))
            message.shrink(message.size() - 1);
        return Board::What::Pass;
    };
    std::vector<std::string> texts(3);
    std::size_t wrong = 1;
    dfb::runRanks(3, [&](dfb::InprocCommunicator communicator) {
        InspectedFrameBuffer<Blend> fb({{communicator, std::nullopt}, board}, configOf(s));
        texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] { scene::renderLoop(fb, s, Loop::Declared); });
        const auto report = scene::renderLoop(fb, s, Loop::Declared);
        if (fb.isDisplayRank())
            wrong = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
    });
    INFO(joined(texts));
    CHECK(done);
    CHECK(allSame(texts));
    CHECK(has(texts[0], "FrameError: dfb: malformed message"));
    CHECK(has(texts[0], "from rank 2"));
    CHECK(wrong == 0);
}

TEST_CASE("Messages of a frame that is over are counted and do no harm", "[errors]")
{
    for (const bool cancels : {false, true}) {
        const Scene s = scene::makeScene(0, 1, 97, 61);
        const auto board = std::make_shared<Board>();
        board->inspect = [](int from, int, const dfb::detail::MessageHeader& header, dfb::Buffer&) {
            return from == 1 && header.kind == dfb::detail::MessageKind::Fragment && header.number == 1
                       ? Board::What::Hold
                       : Board::What::Pass;
        };
        std::string first;
        std::vector<std::int64_t> late;
        std::vector<std::size_t> wrong;
        dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
            using Fb = InspectedFrameBuffer<Blend>;
            auto config = configOf(s);
            config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
            Fb fb({{communicator, std::nullopt}, board}, config);
            auto tile = std::make_unique<Fb::Tile>();
            const auto setAll = [&](Fb::Frame& frame) {
                for (int index = 0; index < 28; ++index)
                    send(frame, *tile, index, 0, 1, 0, 0);
            };
            {
                // The messages of rank 1 are held back; rank 1 gives the frame up while rank 0 waits for its tiles.
                auto frame = fb.begin();
                if (fb.rank() == 1) {
                    for (int index = 0; index < 5; ++index)
                        send(frame, *tile, index, 0, 1, 0, 0);
                    if (cancels)
                        frame.cancel();
                } else {
                    first = outcomeOf([&] { frame.end(); });
                }
            }
            fb.allReduce({0}, Fb::Reduce::Sum); // the frame is over on both
            // On a busy machine the last of them may be read only when the next frame's verdict is already under way.
            std::int64_t lateOfAll = 0;
            for (int i = 0; i < 2 || (lateOfAll < 5 && i < 50); ++i) {
                auto frame = fb.begin(scene::paramsOf(s));
                if (fb.rank() == 1) {
                    board->release();
                    setAll(frame);
                }
                const auto report = frame.end();
                lateOfAll += report.lateMessages;
                if (fb.isDisplayRank()) {
                    late.push_back(report.lateMessages);
                    wrong.push_back(scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s)));
                }
            }
        });
        CHECK(has(first, "frame cancelled: rank 1"));
        CHECK(std::accumulate(late.begin(), late.end(), std::int64_t{0}) == 5);
        CHECK(wrong == std::vector<std::size_t>(wrong.size()));
    }
}

TEST_CASE("A rank that leaves by an exception outside frames: the others get a TransportError", "[errors]")
{
    const Scene s = scene::makeScene(6);
    enum class When { BetweenFrames, BeforeAllReduce, BeforeTheFirstFrame };
    for (const When when : {When::BetweenFrames, When::BeforeAllReduce, When::BeforeTheFirstFrame})
        for (const auto loop : {Loop::Listing3, Loop::Declared})
            for (int culprit = 0; culprit < 4; ++culprit) {
                std::vector<std::string> texts(4);
                const std::string thrown = outcomeOf([&] {
                    dfb::runRanks(4, [&](dfb::InprocCommunicator communicator) {
                        using Fb = FrameBuffer<Blend>;
                        const auto rank = static_cast<std::size_t>(communicator.rank());
                        std::unique_ptr<Fb> fb;
                        texts[rank] = outcomeOf([&] {
                            fb = std::make_unique<Fb>(communicator, configOf(s));
                            if (when != When::BeforeTheFirstFrame)
                                scene::renderLoop(*fb, s, loop);
                        });
                        if (communicator.rank() == culprit)
                            throw std::runtime_error("out of disk");
                        if (!fb)
                            return; // the other left before this rank got that far
                        texts[rank] = outcomeOf([&] {
                            if (when == When::BeforeAllReduce)
                                fb->allReduce({1}, Fb::Reduce::Sum);
                            else
                                scene::renderLoop(*fb, s, loop);
                        });
                        const std::string again = outcomeOf([&] { (void)fb->begin(); });
                        if (again.compare(0, 14, "TransportError") != 0)
                            texts[rank] = "begin() afterwards: " + again;
                    });
                });
                INFO("when " << static_cast<int>(when) << ", rank " << culprit << joined(texts) << "\n  " << thrown);
                CHECK(thrown == "exception: out of disk");
                for (int rank = 0; rank < 4; ++rank)
                    if (rank != culprit) {
                        const std::string& text = texts[static_cast<std::size_t>(rank)];
                        CHECK(has(text, "TransportError: dfb: transport failure: rank " + std::to_string(culprit)));
                        // The exception reaches the others from runRanks(), or from the framebuffer or the connection
                        // that it destroys first.
                        CHECK((has(text, "out of disk") || has(text, "an exception has ended its")));
                    }
            }
}

TEST_CASE("A rank that leaves before the framebuffer is made", "[errors]")
{
    for (const int leaver : {0, 1, 2}) {
        std::vector<std::string> texts(3);
        std::promise<void> left, firstGone;
        const auto leftFuture = left.get_future().share();
        const auto firstGoneFuture = firstGone.get_future().share();
        const std::string thrown = outcomeOf([&] {
            dfb::runRanks(3, [&](dfb::InprocCommunicator communicator) {
                const int rank = communicator.rank();
                if (rank == leaver) {
                    left.set_value();
                    throw std::runtime_error("no input file");
                }
                leftFuture.wait();
                // One after the other, so that the second rank sends to one that is gone.
                const bool first = rank == (leaver == 0 ? 1 : 0);
                if (!first)
                    firstGoneFuture.wait();
                texts[static_cast<std::size_t>(rank)] =
                    outcomeOf([&] { FrameBuffer<Blend> fb(communicator, configOf(scene::makeScene(1))); });
                if (first)
                    firstGone.set_value();
            });
        });
        INFO("rank " << leaver << joined(texts) << "\n  " << thrown);
        CHECK(thrown == "exception: no input file");
        for (int rank = 0; rank < 3; ++rank)
            if (rank != leaver)
                CHECK(has(texts[static_cast<std::size_t>(rank)], "TransportError"));
    }
}

#if defined(__GLIBC__)
TEST_CASE("A rank that gets no threads: the others learn of it, even if it keeps its connection", "[errors]")
{
    std::vector<std::string> texts(3);
    std::promise<void> told[3];
    std::atomic<int> here{0};
    dfb::runRanks(3, [&](const dfb::InprocCommunicator& communicator) {
        const int rank = communicator.rank();
        const auto connection = dfb::connect<dfb::InprocTransport>(communicator);
        dfb::FrameBufferConfig config = configOf(scene::makeScene(1));
        config.executor = std::make_shared<dfb::CallerExecutor>();
        for (++here; here < 3;) // else another may still connect, or make a thread, when rank 1 has failed
            std::this_thread::yield();
        const auto make = [&] { FrameBuffer<Blend> fb(connection, config); };
        const auto at = static_cast<std::size_t>(rank);
        if (rank != 1) {
            texts[at] = outcomeOf(make);
            told[at].set_value();
            return;
        }
        config.executor = nullptr; // makes threads, with a stack for which there is no room
        pthread_attr_t usual, tooMuch;
        pthread_getattr_default_np(&usual);
        pthread_getattr_default_np(&tooMuch);
        pthread_attr_setstacksize(&tooMuch, std::size_t{1} << 50);
        pthread_setattr_default_np(&tooMuch);
        texts[at] = outcomeOf(make);
        pthread_setattr_default_np(&usual);
        pthread_attr_destroy(&usual);
        pthread_attr_destroy(&tooMuch);
        for (const std::size_t other : {0, 2})
            if (told[other].get_future().wait_for(std::chrono::seconds(60)) != std::future_status::ready)
                texts[at] += "; rank " + std::to_string(other) + " still waits";
    });
    INFO(joined(texts));
    CHECK(has(texts[1], "exception: "));
    CHECK(!has(texts[1], "still waits"));
    for (const std::size_t other : {0, 2})
        CHECK(has(texts[other], "TransportError: dfb: transport failure: rank 1"));
}
#endif

TEST_CASE("runRanks refuses a number of ranks that is none", "[errors]")
{
    CHECK_THROWS_AS(dfb::runRanks(0, [](dfb::InprocCommunicator) {}), dfb::InvalidArgument);
    int calls = 0;
    dfb::runRanks(1, [&](dfb::InprocCommunicator c) { calls += c.rank() == 0 && c.size() == 1; });
    CHECK(calls == 1);
}

namespace {

// Sends the inputs that this rank's tiles wait for.
template <class Fb, class Frame>
void sendOwned(Fb& fb, Frame& frame)
{
    auto tile = std::make_unique<typename Fb::Tile>();
    for (const int index : fb.ownedTiles())
        send(frame, *tile, index, 0, 0, 0, 0);
}

// The outcomes of a partial frame of two ranks, and of the frame after it. In the partial frame rank 0 gives up a tile,
// then all call `more(frame, rank)`. `params(rank)` returns the configuration of the frame on a rank.
template <class Params, class More>
std::vector<std::string> partialFrame(const Params& params, const More& more)
{
    std::vector<std::string> texts(2);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<Blend> fb(communicator, configOf(scene::makeScene(0)));
        std::string failure;
        const std::string text = outcomeOf([&] {
            auto frame = fb.begin(params(fb.rank()));
            sendOwned(fb, frame);
            if (fb.rank() == 0)
                frame.abort(std::make_exception_ptr(std::runtime_error("no such brick")), 0);
            more(frame, fb.rank());
            const auto report = frame.end();
            failure = report.failure ? ", " + report.failure->describe() : "";
        });
        const std::string after = outcomeOf([&] {
            auto frame = fb.begin();
            sendOwned(fb, frame);
            frame.end();
        });
        texts[static_cast<std::size_t>(fb.rank())] = text + failure + ", then " + after;
    });
    return texts;
}

} // namespace

TEST_CASE("What ends a partial frame is told to all ranks, also after an error that it could bear", "[errors]")
{
    const auto params = [](int) {
        dfb::FrameConfig p;
        p.allowPartial = true;
        p.timeout = std::chrono::milliseconds(20000);
        return p;
    };
    const auto texts = partialFrame(params, [](auto& frame, int rank) {
        if (rank == 0)
            frame.cancel();
        while (!frame.failed())
            std::this_thread::yield();
    });
    INFO(joined(texts));
    CHECK(allSame(texts));
    CHECK(has(texts[0], "no such brick"));
    CHECK(has(texts[0], "then fine"));
}

TEST_CASE("Ranks that began a partial frame differently disagree, whatever else went wrong", "[errors]")
{
    const auto params = [](int rank) {
        dfb::FrameConfig p;
        p.allowPartial = true;
        p.timeout = std::chrono::milliseconds(20000);
        p.background[2] = static_cast<float>(rank);
        return p;
    };
    const auto texts = partialFrame(params, [](auto&, int) {});
    INFO(joined(texts));
    CHECK(allSame(texts));
    CHECK(has(texts[0], "FrameError: dfb: ranks disagree"));
    CHECK(has(texts[0], "then fine"));
}

TEST_CASE("Ranks of which only some begin a partial frame get the same error, and the next is fine", "[errors]")
{
    for (const int partialOn : {0, 1}) { // rank 0 has the image
        const auto params = [=](int rank) {
            dfb::FrameConfig p;
            p.allowPartial = rank == partialOn;
            p.timeout = std::chrono::milliseconds(20000);
            return p;
        };
        const auto texts = partialFrame(params, [](auto&, int) {});
        INFO(joined(texts));
        CHECK(allSame(texts));
        CHECK(has(texts[0], "FrameError: "));
        CHECK(has(texts[0], "then fine"));
    }
}

TEST_CASE("Ranks that disagree about who owns the tiles of a partial frame go on after it", "[errors]")
{
    std::vector<std::string> texts(2), after(2);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<Blend> fb(communicator, configOf(scene::makeScene(0)));
        const auto rank = static_cast<std::size_t>(fb.rank());
        texts[rank] = outcomeOf([&] {
            dfb::FrameConfig params;
            params.allowPartial = true;
            params.owners =
                std::make_shared<const std::vector<int>>(static_cast<std::size_t>(fb.layout().tileCount()), fb.rank());
            auto frame = fb.begin(params);
            // All tiles are missing on both ranks: twice as many as the image has.
            for (const int tile : frame.ownedTiles())
                frame.abort(std::make_exception_ptr(std::runtime_error("no such tile")), tile);
            frame.end();
        });
        after[rank] = outcomeOf([&] {
            auto frame = fb.begin();
            sendOwned(fb, frame);
            frame.end();
        });
    });
    INFO(joined(texts));
    CHECK(allSame(texts));
    CHECK(has(texts[0], "FrameError: dfb: ranks disagree"));
    CHECK(after == std::vector<std::string>(2, "fine"));
}

namespace {

// Cannot be copied on one rank.
struct CopiesOn0 {
    int rank = 0;

    explicit CopiesOn0(int own = 0) : rank(own) {}
    CopiesOn0(const CopiesOn0& other) : rank(other.rank)
    {
        if (rank != 0)
            throw std::runtime_error("no copy here");
    }
    CopiesOn0(CopiesOn0&&) = default;
    CopiesOn0& operator=(const CopiesOn0&) = default;
    void process(dfb::PixelTile&) const {}
};

} // namespace

TEST_CASE("A pixel operation that cannot be copied on one rank: the others learn of it", "[errors]")
{
    std::vector<std::string> texts(2);
    dfb::runRanks(2, [&](const dfb::InprocCommunicator& communicator) {
        const auto connection = dfb::connect<dfb::InprocTransport>(communicator); // lives on after the exception
        texts[static_cast<std::size_t>(communicator.rank())] = outcomeOf([&] {
            FrameBuffer<Blend, CopiesOn0>(connection, configOf(scene::makeScene(1)), CopiesOn0(communicator.rank()));
        });
    });
    INFO(joined(texts));
    CHECK(has(texts[0], "TransportError: dfb: transport failure: rank 1: no copy here"));
    CHECK(has(texts[1], "exception: no copy here"));
}

namespace {

struct ThrowingEye : dfb::PerspectiveCamera {
    bool throws = false, isInvalid = false;

    explicit ThrowingEye(bool isCulprit, bool throwsInvalid = false)
        : PerspectiveCamera({0, 0, 5}, {0, 0, 0}, {0, 1, 0}, 40), throws(isCulprit), isInvalid(throwsInvalid)
    {
    }
    std::optional<dfb::Vec3> commonEye() const
    {
        if (throws && isInvalid)
            throw dfb::InvalidArgument("no such eye");
        if (throws)
            throw std::runtime_error("no such eye");
        return eye();
    }
};

// Its first object cannot be made.
struct MadeLate : dfb::AlphaBlend {
    static inline std::atomic<bool> fails{false};

    MadeLate()
    {
        if (fails.exchange(false))
            throw std::runtime_error("not yet");
    }
};

} // namespace

TEST_CASE("A camera that throws on one rank is why a frame fails, also if it may be partial", "[errors]")
{
    const bool isInvalid = GENERATE(false, true);
    const bool isPartial = GENERATE(false, true);
    std::vector<std::string> texts(9);
    dfb::runRanks(9, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config(128, 64);
        config.executor = std::make_shared<dfb::CallerExecutor>(); // messages are taken in their order
        config.quiet = std::chrono::milliseconds(50);
        FrameBuffer<dfb::AlphaBlend> fb(communicator, config);
        const auto z = static_cast<float>(fb.rank());
        const dfb::World world({{static_cast<std::uint32_t>(fb.rank()), {{0, 0, z}, {1, 1, z}}}});
        const dfb::SharedWorld all(fb, world);
        dfb::DataParallelLoop loop(fb, world, all);
        dfb::FrameConfig params;
        params.allowPartial = isPartial;
        texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] {
            loop.render(
                ThrowingEye(fb.rank() == 1, isInvalid), [](const dfb::Brick&, auto&) {}, params);
        });
    });
    INFO(joined(texts));
    CHECK(allSame(texts));
    CHECK(has(texts[0], "rank 1"));
    CHECK(has(texts[0], "no such eye"));
    CHECK(texts[0].find("no such eye") == texts[0].rfind("no such eye"));
}

TEST_CASE("A camera that throws on one rank is why a frame fails, also if its vote overtakes the news", "[errors]")
{
    using Transport = dfb::testing::FaultTransport<dfb::InprocTransport>;
    dfb::FrameConfig params;
    params.allowPartial = GENERATE(false, true);
    dfb::testing::FaultOptions faults;
    faults.delay = 1;
    faults.maxDelay = std::chrono::milliseconds(4);
    faults.only = [](int, const dfb::Buffer& message) {
        return dfb::detail::loadAs<dfb::detail::MessageHeader>(message.data()).kind == dfb::detail::MessageKind::Abort;
    };
    std::vector<std::string> texts;
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config(128, 64);
        config.quiet = std::chrono::milliseconds(20);
        dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, Transport> fb({communicator, faults}, config);
        const auto z = static_cast<float>(fb.rank());
        const dfb::World world({{static_cast<std::uint32_t>(fb.rank()), {{0, 0, z}, {1, 1, z}}}});
        const dfb::SharedWorld all(fb, world);
        dfb::DataParallelLoop loop(fb, world, all);
        for (int frame = 0; frame < 20; ++frame) {
            std::string text = outcomeOf([&] {
                loop.render(
                    ThrowingEye(fb.rank() == 1), [](const dfb::Brick&, auto&) {}, params);
            });
            if (fb.rank() == 0)
                texts.push_back(std::move(text));
        }
    });
    REQUIRE(texts.size() == 20);
    for (const std::string& text : texts) {
        INFO(text);
        CHECK(has(text, "no such eye"));
    }
}

TEST_CASE("A frame fails if a brick has moved since the SharedWorld was made, and the next is fine", "[errors]")
{
    std::vector<std::string> texts(2), after(2);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<dfb::AlphaBlend> fb(communicator, {128, 64});
        const auto rank = static_cast<std::size_t>(fb.rank());
        const auto worldAt = [&](float z) {
            return dfb::World({{static_cast<std::uint32_t>(fb.rank()), {{0, 0, z}, {1, 1, z}}}});
        };
        const dfb::World world = worldAt(static_cast<float>(fb.rank()));
        const dfb::World moved = fb.rank() == 1 ? worldAt(3) : world;
        const dfb::SharedWorld all(fb, world);
        const auto frameOf = [&](const dfb::World& its) {
            return outcomeOf([&] {
                dfb::DataParallelLoop(fb, its, all).render(ThrowingEye(false), [](const dfb::Brick&, auto&) {});
            });
        };
        texts[rank] = frameOf(moved);
        after[rank] = frameOf(world);
    });
    INFO(joined(texts));
    CHECK(allSame(texts));
    CHECK(has(texts[0], "rank 1"));
    CHECK(has(texts[0], "brick 1 is not in the SharedWorld with these bounds"));
    CHECK(after == std::vector<std::string>{"fine", "fine"});
}

TEST_CASE("Of a partial frame only the tile is lost whose operation cannot be made", "[errors]")
{
    std::vector<std::int64_t> incomplete;
    dfb::runRanks(1, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<MadeLate> fb(communicator, {512, 64});
        const dfb::World world({{0, {{-9, -1, -1}, {9, 1, 1}}}});
        const dfb::PerspectiveCamera camera({0, 0, 5}, {0, 0, 0}, {0, 1, 0}, 10);
        dfb::DataParallelLoop loop(fb, world);
        dfb::FrameConfig params;
        params.allowPartial = true;
        for (const bool fails : {true, false}) {
            MadeLate::fails = fails;
            const auto report = loop.render(
                camera,
                [](const dfb::Brick&, auto& tile) {
                    tile.fill({1, 1, 1, 1}, 1);
                },
                params);
            incomplete.push_back(report.tilesIncomplete);
        }
    });
    CHECK(incomplete == std::vector<std::int64_t>{1, 0});
}

TEST_CASE("An operation that takes longer than a frame may fails the frame, not the framebuffer", "[errors]")
{
    static std::atomic<int> slowMs{0};
    struct Slow {
        void process(dfb::PixelTile&) const { std::this_thread::sleep_for(std::chrono::milliseconds(slowMs)); }
    };
    constexpr int limitMs = 1000;
    struct Outcome {
        std::vector<std::string> texts{2}, after{2};
    };
    const auto runCase = [&] {
        Outcome o;
        dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
            using Fb = FrameBuffer<Blend, Slow>;
            auto config = configOf(scene::makeScene(0, 1, 32, 16)); // a tile each
            Fb fb(communicator, config);
            const auto rank = static_cast<std::size_t>(fb.rank());
            slowMs = 5 * limitMs / 2;
            dfb::FrameConfig params;
            params.timeout = std::chrono::milliseconds(limitMs);
            o.texts[rank] = outcomeOf([&] {
                auto frame = fb.begin(params);
                sendOwned(fb, frame);
                frame.end();
            });
            slowMs = 0;
            o.after[rank] = outcomeOf([&] {
                auto frame = fb.begin();
                sendOwned(fb, frame);
                frame.end();
            });
        });
        return o;
    };
    const Outcome o = undisturbed(runCase);
    INFO(joined(o.texts) << joined(o.after));
    CHECK(allSame(o.texts));
    CHECK(has(o.texts[0], "FrameError: dfb: timed out"));
    CHECK(has(o.texts[0], "are still being finished"));
    CHECK(o.after == std::vector<std::string>(2, "fine"));
}

TEST_CASE("A compositor that goes while a picture is open fails it on the other ranks", "[errors]")
{
    std::promise<void> started;
    std::string text;
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        dfb::NetworkConfig network;
        network.progress = dfb::Progress::Caller; // rank 1 learns of the other image in its destructor, not before
        dfb::FrameBufferConfig config(64, 64);
        config.executor = std::make_shared<dfb::CallerExecutor>();
        dfb::ImageCompositor compositor(dfb::connect<dfb::InprocTransport>(communicator, network),
                                        dfb::ImageBlend::Nearest, config);
        const std::vector<std::uint8_t> pixels(4 * 64 * 64, 255);
        const std::vector<float> depths(64 * 64, 0.5f);
        const dfb::InputImage image(pixels.data(), depths.data());
        if (compositor.rank() == 1) {
            compositor.start(image);
            started.set_value();
            return;
        }
        started.get_future().wait_for(std::chrono::seconds(20));
        text = outcomeOf([&] { compositor.composite(image); });
    });
    INFO(text);
    CHECK(has(text, "the frame was left without end()"));
}

} // namespace errors_cases
