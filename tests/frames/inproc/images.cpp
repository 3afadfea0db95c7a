// The image of a frame: right by the serial reference, and the same bit for bit whatever the order of arrival, number
// of ranks, threads, executor, owners and compression. Ranks are threads.
#include "catch.hpp"
#include "random_scene.hpp"
#include "shuffled.hpp"

#include <dfb/image_compositor.hpp>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <future>
#include <limits>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <vector>

namespace images_cases {

namespace {

using scene::Loop;
using scene::Picture;
using scene::Scene;

using Blend = dfb::BasicAlphaBlend<16>;
using Single = dfb::BasicImageParallel<16>;
template <class TileOp, class PixelOp = dfb::NoPixelOp>
using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, PixelOp, ShuffledTransport>;

struct Options {
    int ranks = 3;
    Loop loop = Loop::Declared;
    int threads = 2;
    bool tbb = false;
    std::optional<std::uint64_t> shuffleSeed;
    dfb::OwnerMap ownerMap = dfb::latticeOwner;
    std::shared_ptr<const dfb::Codec> codec;
    dfb::OutputFormat format = dfb::OutputFormat::RGBA32F;
    bool depth = true;
    int displayRank = 0;
    int deal = 0;
    int frames = 2; // the second frame reuses everything
};

std::shared_ptr<dfb::Executor> makeExecutor(const Options& o)
{
#if defined(DFB_HAS_TBB)
    if (o.tbb)
        return std::make_shared<dfb::TbbExecutor>(o.threads);
#endif
    return std::make_shared<dfb::ThreadExecutor>(o.threads);
}

dfb::FrameBufferConfig configOf(const Scene& s, const Options& o)
{
    dfb::FrameBufferConfig config;
    config.image.width = s.width;
    config.image.height = s.height;
    config.image.format = o.format;
    config.image.depth = o.depth;
    config.image.displayRank = o.displayRank;
    config.image.ownerMap = o.ownerMap;
    config.messages.codec = o.codec;
    config.executor = makeExecutor(o);
    return config;
}

// The image of the last frame.
template <class TileOp>
Picture picture(const Scene& s, const Options& o)
{
    Picture result;
    int imagesElsewhere = 0;
    std::mutex mutex;
    dfb::runRanks(o.ranks, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<TileOp> fb({communicator, o.shuffleSeed}, configOf(s, o));
        dfb::FrameReport report;
        for (int frame = 0; frame < o.frames; ++frame)
            report = scene::renderLoop(fb, s, o.loop, o.deal);
        const std::lock_guard<std::mutex> lock(mutex);
        if (fb.isDisplayRank())
            result = Picture(fb.image(), report);
        else
            imagesElsewhere += !fb.image().empty();
    });
    if (imagesElsewhere > 0)
        throw std::logic_error("a rank that does not display has an image");
    return result;
}

Picture pictureOf(const Scene& s, const Options& o)
{
    return scene::isDataParallel(o.loop) ? picture<Blend>(s, o) : picture<Single>(s, o);
}

Scene sceneFor(Loop loop, std::uint64_t seed = 1, int passes = 1)
{
    return scene::makeSceneFor(loop, 9, seed, 97, 61, passes);
}

constexpr Loop allLoops[] = {Loop::Listing3, Loop::Declared, Loop::ImageOwned, Loop::ImageDealt};

} // namespace

TEST_CASE("Every loop gives the reference image at every number of ranks", "[images]")
{
    for (const Loop loop : allLoops) {
        const Scene s = sceneFor(loop);
        const auto expected = scene::referenceOf(s);
        std::set<std::uint64_t> hashes;
        for (const int ranks : {1, 2, 3, 4, 7}) {
            Options o;
            o.loop = loop;
            o.ranks = ranks;
            const Picture p = pictureOf(s, o);
            INFO("loop " << static_cast<int>(loop) << ", " << ranks << " ranks");
            CHECK(scene::wrongValues(p, expected) == 0);
            CHECK(p.depth.size() == expected.size());
            CHECK(p.report.frame == 2);
            CHECK(p.report.tilesTotal == 7 * 4);
            CHECK(p.report.lateMessages == 0);
            CHECK(p.report.nonFinitePixels == 0);
            if (ranks == 1)
                CHECK(p.report.messagesSent == 0);
            hashes.insert(p.hash());
        }
        CHECK(hashes.size() == 1);
    }
}

TEST_CASE("The data-parallel loops agree with each other", "[images]")
{
    const Scene s = sceneFor(Loop::Declared, 8);
    Options o;
    const std::uint64_t declared = pictureOf(s, o).hash();
    o.loop = Loop::Listing3;
    CHECK(pictureOf(s, o).hash() == declared);
}

TEST_CASE("The image does not depend on the order of arrival", "[images]")
{
    for (const Loop loop : {Loop::Listing3, Loop::Declared}) {
        const Scene s = sceneFor(loop, 2, 2);
        Options o;
        o.loop = loop;
        o.frames = 1;
        const Picture direct = pictureOf(s, o);
        CHECK(scene::wrongValues(direct, scene::referenceOf(s)) == 0);
        for (std::uint64_t seed = 0; seed < 20; ++seed) {
            o.shuffleSeed = seed;
            INFO("loop " << static_cast<int>(loop) << ", seed " << seed);
            CHECK(pictureOf(s, o).hash() == direct.hash());
        }
    }
}

TEST_CASE("The image does not depend on threads, executor, owners, compression, display rank or dealing", "[images]")
{
    for (const Loop loop : {Loop::Declared, Loop::ImageDealt}) {
        const Scene s = sceneFor(loop, 3);
        Options plain;
        plain.loop = loop;
        const std::uint64_t hash = pictureOf(s, plain).hash();
        const auto same = [&](const std::function<void(Options&)>& change) {
            Options o = plain;
            change(o);
            return pictureOf(s, o).hash() == hash;
        };
        INFO("loop " << static_cast<int>(loop));
        for (const int threads : {1, 2, 3}) {
            INFO(threads << " threads");
            CHECK(same([&](Options& o) { o.threads = threads; }));
#if defined(DFB_HAS_TBB)
            CHECK(same([&](Options& o) { o.threads = threads, o.tbb = true; }));
#endif
        }
        CHECK(same([](Options& o) { o.ownerMap = dfb::linearOwner; }));
        CHECK(same([](Options& o) { o.ownerMap = dfb::hashOwner; }));
        CHECK(same([](Options& o) { o.ownerMap = nullptr; }));
        CHECK(same([](Options& o) { o.ownerMap = [](int, const dfb::TileLayout&, int ranks) { return ranks - 1; }; }));
        CHECK(same([](Options& o) { o.displayRank = 2; }));
        for (const int deal : {-1, 1, 2, 3}) {
            CHECK(same([&](Options& o) { o.deal = std::max(0, deal); }));
            CHECK(same([&](Options& o) { o.ranks = 5, o.deal = loop == Loop::Declared ? deal : 0; }));
        }
#if defined(DFB_HAS_SNAPPY)
        CHECK(same([](Options& o) { o.codec = std::make_shared<dfb::SnappyCodec>(); }));
        CHECK(same([](Options& o) { o.codec = std::make_shared<dfb::SnappyCodec>(), o.ranks = 7, o.displayRank = 6; }));
#endif
    }
}

TEST_CASE("Passes 1 to 4", "[images]")
{
    for (const Loop loop : {Loop::Listing3, Loop::Declared, Loop::ImageDealt})
        for (const int passes : {1, 2, 3, 4}) {
            const Scene s = sceneFor(loop, 4, passes);
            Options o;
            o.loop = loop;
            INFO("loop " << static_cast<int>(loop) << ", " << passes << " passes");
            CHECK(scene::wrongValues(pictureOf(s, o), scene::referenceOf(s)) == 0);
        }
}

TEST_CASE("Output formats, with and without depth", "[images]")
{
    for (const Loop loop : {Loop::Declared, Loop::ImageDealt}) {
        const Scene s = sceneFor(loop, 5);
        const auto expected = scene::referenceOf(s);
        for (const auto format : {dfb::OutputFormat::RGBA8, dfb::OutputFormat::SRGBA8, dfb::OutputFormat::RGBA32F})
            for (const bool depth : {false, true}) {
                Options o;
                o.loop = loop;
                o.format = format;
                o.depth = depth;
                o.displayRank = 1;
                const Picture p = pictureOf(s, o);
                INFO("loop " << static_cast<int>(loop) << ", format " << static_cast<int>(format) << ", depth "
                             << depth);
                CHECK(p.format == format);
                CHECK(p.depth.empty() == !depth);
                CHECK(scene::wrongValues(p, expected) == 0);
            }
    }
}

TEST_CASE("Format None: no image, and no pixels to the display rank", "[images]")
{
    // All inputs stay on their rank, so only finished tiles could travel.
    const Scene s = sceneFor(Loop::ImageOwned);
    Options o;
    o.loop = Loop::ImageOwned;
    o.ranks = 4;
    o.format = dfb::OutputFormat::RGBA8;
    const Picture shown = pictureOf(s, o);
    o.format = dfb::OutputFormat::None;
    const Picture none = pictureOf(s, o);
    CHECK(none.bytes.empty());
    CHECK(none.depth.empty());
    CHECK(none.report.tilesTouched == 28);
    CHECK(shown.report.bytesSent > 97 * 61 * 4 / 2);
    // Only the verdict travels: one message of less than 256 bytes up the tree from each rank but rank 0.
    CHECK(none.report.messagesSent <= 3);
    CHECK(none.report.bytesSent < 3 * 256);
}

TEST_CASE("Background does not travel", "[images]")
{
    SECTION("an empty view costs a bounded number of bytes, whatever the size of the image")
    {
        Scene s = scene::makeScene(0, 1, 1024, 1024);
        Options o;
        o.ranks = 4;
        const Picture p = picture<dfb::AlphaBlend>(s, o);
        CHECK(scene::wrongValues(p, scene::referenceOf(s)) == 0);
        CHECK(p.report.tilesTouched == 0);
        // For each of 4 ranks but one: its count of tiles, its part of the reduction that says that all ranks have
        // declared (up and down), and its part of the verdict (up). These are at most 4 messages, together less than
        // 512 bytes.
        CHECK(p.report.messagesSent <= 3 * 4);
        CHECK(p.report.bytesSent <= 3 * 512);
    }
    SECTION("tiles that nobody touched do not travel to the display rank")
    {
        Scene s = scene::makeScene(1, 1, 1024, 1024);
        s.bricks[0].bounds = {{70, 70, 0}, {100, 100, 1}}; // in one of 256 tiles
        Options o;
        o.ranks = 4;
        const Picture p = picture<dfb::AlphaBlend>(s, o);
        CHECK(scene::wrongValues(p, scene::referenceOf(s)) == 0);
        CHECK(p.report.tilesTouched == 1);
        // That tile as an input (20 bytes a pixel) and as a finished tile (colour and depth), and control messages.
        CHECK(p.report.bytesSent <= 64 * 64 * 20 + 64 * 64 * 20 + 4 * 1024);
    }
    SECTION("what was background stays it, in the next frame and with another colour")
    {
        std::vector<std::size_t> wrong(4);
        const std::vector<Scene> frames = [] {
            std::vector<Scene> result(4, scene::makeScene(2, 6));
            result[1].bricks[0].bounds = {{5, 5, 0}, {20, 20, 1}}; // elsewhere
            result[2].background = {0.5f, 0.5f, 0.25f, 1.0f};
            result[3].bricks.clear();
            return result;
        }();
        dfb::runRanks(3, [&](dfb::InprocCommunicator communicator) {
            FrameBuffer<Blend> fb(communicator, configOf(frames[0], Options()));
            for (std::size_t i = 0; i < frames.size(); ++i) {
                const auto report = scene::renderLoop(fb, frames[i], Loop::Declared);
                if (fb.isDisplayRank())
                    wrong[i] = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(frames[i]));
            }
        });
        CHECK(wrong == std::vector<std::size_t>(4));
    }
    SECTION("-0 is 0, where something is blended and elsewhere")
    {
        Scene s = scene::makeScene(2, 6);
        s.background = {};
        const Picture zero = pictureOf(s, Options());
        s.background = {-0.0f, -0.0f, -0.0f, -0.0f};
        CHECK((pictureOf(s, Options()).bytes == zero.bytes));
    }
}

TEST_CASE("Ordinary: odd sizes, few tiles, empty ranks", "[images]")
{
    struct Size {
        int width, height;
    };
    for (const Loop loop : allLoops)
        for (const Size size : {Size{1, 1}, Size{1, 31}, Size{113, 1}, Size{16, 16}, Size{17, 15}}) {
            Scene s = scene::makeScene(scene::isDataParallel(loop) ? 3 : 1, 7, size.width, size.height);
            s.bricks[0].bounds = {{0, 0, 0}, {static_cast<float>(size.width), static_cast<float>(size.height), 1}};
            Options o;
            o.loop = loop;
            o.ranks = 7; // more than tiles, and more than bricks
            o.displayRank = 3;
            INFO("loop " << static_cast<int>(loop) << ", " << size.width << "x" << size.height);
            CHECK(scene::wrongValues(pictureOf(s, o), scene::referenceOf(s)) == 0);
        }
    for (const Loop loop : {Loop::Listing3, Loop::Declared}) {
        // Scenes in which rank 0 has no data, no rank has data, or the bricks are outside the image.
        Options o;
        o.loop = loop;
        o.deal = -1;
        CHECK(scene::wrongValues(pictureOf(sceneFor(loop), o), scene::referenceOf(sceneFor(loop))) == 0);
        Scene none = scene::makeScene(0);
        CHECK(scene::wrongValues(pictureOf(none, o), scene::referenceOf(none)) == 0);
        Scene outside = scene::makeScene(2);
        outside.bricks[0].bounds = {{-50, 0, 0}, {0, 61, 1}};
        outside.bricks[1].bounds = {{97, -5, 0}, {200, 80, 1}};
        CHECK(scene::wrongValues(pictureOf(outside, o), scene::referenceOf(outside)) == 0);
    }
}

TEST_CASE("The default tile size, and tiles larger than the image", "[images]")
{
    Scene s = scene::makeScene(6, 9, 149, 131);
    const auto expected = scene::referenceOf(s);
    CHECK(scene::wrongValues(picture<dfb::AlphaBlend>(s, Options()), expected) == 0);
    CHECK(scene::wrongValues(picture<dfb::BasicAlphaBlend<256>>(s, Options()), expected) == 0);
}

TEST_CASE("A declaration that still holds is not sent again", "[images]")
{
    std::vector<std::int64_t> messages(6);
    std::vector<std::uint64_t> hashes(6);
    const Scene s = sceneFor(Loop::Declared, 10);
    Scene moved = sceneFor(Loop::Declared, 11);
    dfb::runRanks(4, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<Blend> fb(communicator, configOf(s, Options()));
        for (std::size_t i = 0; i < 6; ++i) {
            const auto report = scene::renderLoop(fb, i < 3 ? s : moved, Loop::Declared);
            if (fb.isDisplayRank()) {
                messages[i] = report.messagesSent;
                hashes[i] = Picture(fb.image(), report).hash();
            }
        }
    });
    const std::uint64_t first = pictureOf(s, Options()).hash(), second = pictureOf(moved, Options()).hash();
    CHECK(hashes == std::vector<std::uint64_t>{first, first, first, second, second, second});
    CHECK(messages[1] < messages[0]);
    CHECK(messages[2] < messages[0]);
    CHECK(messages[3] > messages[4]);
    CHECK(messages[5] < messages[3]);
}

TEST_CASE("Two framebuffers at once on one communicator", "[images]")
{
    const Scene a = sceneFor(Loop::Declared, 12), b = sceneFor(Loop::ImageOwned, 13);
    std::vector<std::size_t> wrong(4, 1);
    dfb::runRanks(3, [&](dfb::InprocCommunicator communicator) {
        Options o;
        const auto configA = configOf(a, o);
        auto configB = configA; // also the same executor
        configB.image.displayRank = 1;
        FrameBuffer<Blend> fbA(communicator, configA);
        FrameBuffer<Single> fbB(communicator, configB);
        for (std::size_t i = 0; i < 2; ++i) {
            // Both frames are open at the same time, and the ranks end them in different orders.
            auto frame = fbA.begin(scene::paramsOf(a));
            const auto reportB = scene::renderLoop(fbB, b, Loop::ImageOwned);
            auto tile = std::make_unique<FrameBuffer<Blend>::Tile>();
            for (int index : fbA.ownedTiles())
                scene::sendParent(frame, *tile, index, static_cast<int>(a.bricks.size()));
            for (int index = 0; index < fbA.layout().tileCount(); ++index)
                for (const dfb::Brick& brick : scene::bricksOf(a, communicator.rank(), 3)) {
                    frame.start(*tile, index);
                    tile->generation = 1;
                    tile->source = brick.id;
                    scene::renderBrick(a, brick, *tile); // mostly "nothing here"
                    frame.setTile(*tile);
                }
            const auto reportA = frame.end();
            if (fbA.isDisplayRank())
                wrong[2 * i] = scene::wrongValues(Picture(fbA.image(), reportA), scene::referenceOf(a));
            if (fbB.isDisplayRank())
                wrong[2 * i + 1] = scene::wrongValues(Picture(fbB.image(), reportB), scene::referenceOf(b));
        }
    });
    CHECK(wrong == std::vector<std::size_t>(4));
}

TEST_CASE("A rank that works on between start() and end() holds up nobody", "[images]")
{
    constexpr int ranks = 3;
    std::promise<void> othersAreDone;
    std::atomic<int> done{0};
    bool inTime = false;
    std::vector<std::uint64_t> hashes(2);
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config(150, 90);
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        dfb::ImageCompositor compositor(dfb::connect<dfb::InprocTransport>(communicator), dfb::ImageBlend::InOrder,
                                        config);
        std::vector<float> pixels(4 * 150 * 90, 0.1f * static_cast<float>(compositor.rank() + 1));
        for (int picture = 0; picture < 2; ++picture) {
            compositor.start(dfb::InputImage(pixels.data()), compositor.rank());
            if (compositor.rank() == 0 && picture == 1)
                inTime = othersAreDone.get_future().wait_for(std::chrono::seconds(20)) == std::future_status::ready;
            compositor.end();
            if (compositor.rank() != 0 && picture == 1 && ++done == ranks - 1)
                othersAreDone.set_value();
            if (compositor.isDisplayRank())
                hashes[static_cast<std::size_t>(picture)] =
                    dfb::testing::hashOf(compositor.image().rgba8(), 4 * compositor.image().pixelCount());
        }
    });
    CHECK(inTime);
    CHECK(hashes[0] == hashes[1]);
}

TEST_CASE("allReduce outside frames", "[images]")
{
    std::vector<std::vector<std::int64_t>> sums(5), minima(5), maxima(5);
    int refused = 0;
    std::mutex mutex;
    dfb::runRanks(5, [&](dfb::InprocCommunicator communicator) {
        using Fb = FrameBuffer<Blend>;
        Fb fb(communicator, configOf(scene::makeScene(1), Options()));
        const auto rank = static_cast<std::size_t>(fb.rank());
        sums[rank] = fb.allReduce({fb.rank(), 1, -3}, Fb::Reduce::Sum);
        minima[rank] = fb.allReduce({fb.rank(), -fb.rank()}, Fb::Reduce::Min);
        maxima[rank] = fb.allReduce({fb.rank(), std::numeric_limits<std::int64_t>::min()}, Fb::Reduce::Max);
        try {
            fb.allReduce(std::vector<std::int64_t>(rank == 3 ? 2 : 1), Fb::Reduce::Sum);
        } catch (const dfb::InvalidArgument&) {
            const std::lock_guard<std::mutex> lock(mutex);
            ++refused;
        }
        scene::renderLoop(fb, scene::makeScene(1), Loop::Declared);
    });
    CHECK(sums == std::vector<std::vector<std::int64_t>>(5, {10, 5, -15}));
    CHECK(minima == std::vector<std::vector<std::int64_t>>(5, {0, -4}));
    CHECK(maxima == std::vector<std::vector<std::int64_t>>(5, {4, std::numeric_limits<std::int64_t>::min()}));
    CHECK(refused == 5);
}

TEST_CASE("With minTransmittance the levels of a pixel do not depend on other pixels", "[images]")
{
    constexpr int width = 64;
    std::array<std::uint8_t, 2> red{};
    for (const bool hasTie : {false, true}) // which is rounded again in twice the precision
        dfb::runRanks(4, [&](dfb::InprocCommunicator communicator) {
            dfb::FrameBufferConfig config(width, 1);
            config.minTransmittance = 0.25f;
            dfb::ImageCompositor images(dfb::connect<dfb::InprocTransport>(communicator), dfb::ImageBlend::InOrder,
                                        config);
            std::vector<float> pixels(4 * width);
            float *tie = pixels.data(), *atLimit = tie + 4 * 40;
            if (images.rank() == 0) {
                tie[3] = hasTie ? 0.5f : 0;
                atLimit[0] = 0.1f, atLimit[3] = 0.75f; // lets through what is the limit
            } else {
                atLimit[3] = images.rank() < 3 ? 5e-17f : 1; // so thin that only twice the precision sees it
                atLimit[0] = images.rank() < 3 ? 0 : 0.9f;
            }
            images.composite(dfb::InputImage(pixels.data()), images.rank());
            if (images.isDisplayRank())
                red[hasTie] = images.image().rgba8()[4 * 40];
        });
    CHECK(red[0] == red[1]);
    CHECK(red[0] == 83);
}

} // namespace images_cases
