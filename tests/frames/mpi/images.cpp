// The image over MPI, on any number of ranks: right by the serial reference, and bit for bit that of ranks in one
// process.
#include "catch.hpp"
#include "random_scene.hpp"
#include "ranks.hpp"

#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

namespace images_cases {

namespace {

using scene::Loop;
using scene::Picture;
using scene::Scene;

using Blend = dfb::BasicAlphaBlend<16>;
using Single = dfb::BasicImageParallel<16>;

// On the display rank the image of the last of `frames` frames, on the others an empty picture.
template <class TileOp, class Transport, class Communicator>
Picture pictureOn(const Communicator& communicator, const Scene& s, Loop loop, const dfb::FrameBufferConfig& config,
                  int deal = 0, const dfb::NetworkConfig& options = {}, int frames = 2)
{
    dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, Transport> fb(communicator, config, options);
    Picture result;
    for (int frame = 0; frame < frames; ++frame) {
        const auto report = scene::renderLoop(fb, s, loop, deal);
        result = fb.isDisplayRank() ? Picture(fb.image(), report) : Picture();
    }
    return result;
}

Picture overMpi(MPI_Comm communicator, const Scene& s, Loop loop, const dfb::FrameBufferConfig& config, int deal = 0,
                const dfb::NetworkConfig& options = {})
{
    return scene::isDataParallel(loop)
               ? pictureOn<Blend, dfb::MpiTransport>(communicator, s, loop, config, deal, options)
               : pictureOn<Single, dfb::MpiTransport>(communicator, s, loop, config, deal, options);
}

// The image of as many ranks in this process.
Picture inProcess(int ranks, const Scene& s, Loop loop, const dfb::FrameBufferConfig& config)
{
    Picture result;
    std::mutex mutex;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        auto mine = config;
        mine.executor = std::make_shared<dfb::ThreadExecutor>(1);
        Picture p = scene::isDataParallel(loop) ? pictureOn<Blend, dfb::InprocTransport>(communicator, s, loop, mine)
                                                : pictureOn<Single, dfb::InprocTransport>(communicator, s, loop, mine);
        const std::lock_guard<std::mutex> lock(mutex);
        if (communicator.rank() == config.image.displayRank)
            result = std::move(p);
    });
    return result;
}

Scene sceneFor(Loop loop, std::uint64_t seed = 1, int passes = 1)
{
    return scene::makeSceneFor(loop, 9, seed, 97, 61, passes);
}

} // namespace

TEST_CASE("Every loop gives the reference image, and that of ranks in one process", "[images]")
{
    const int size = sizeOf(MPI_COMM_WORLD);
    for (const Loop loop : {Loop::Listing3, Loop::Declared, Loop::ImageOwned, Loop::ImageDealt})
        for (const int passes : {1, 3}) {
            const Scene s = sceneFor(loop, 1, passes);
            const auto config = configOf(s, 2);
            const Picture p = overMpi(MPI_COMM_WORLD, s, loop, config);
            INFO("loop " << static_cast<int>(loop) << ", " << passes << " passes");
            if (rankIn(MPI_COMM_WORLD) != 0) {
                CHECK(p.bytes.empty());
                continue;
            }
            CHECK(scene::wrongValues(p, scene::referenceOf(s)) == 0);
            CHECK(p.hash() == inProcess(size, s, loop, config).hash());
            CHECK(p.hash() == inProcess(2, s, loop, config).hash());
        }
}

TEST_CASE("The image does not depend on configuration", "[images]")
{
    const int size = sizeOf(MPI_COMM_WORLD);
    const Scene s = sceneFor(Loop::Declared, 5);
    const std::uint64_t expected = inProcess(1, s, Loop::Declared, configOf(s, 2)).hash();
    const auto check = [&](const char* what, const std::function<void(dfb::FrameBufferConfig&)>& change, int deal = 0,
                           const dfb::NetworkConfig& options = {}) {
        auto config = configOf(s, 2);
        change(config);
        const Picture p = overMpi(MPI_COMM_WORLD, s, Loop::Declared, config, deal, options);
        INFO(what);
        CHECK((rankIn(MPI_COMM_WORLD) == config.image.displayRank ? p.hash() == expected : p.bytes.empty()));
    };
    check(
        "bricks dealt out otherwise", [](auto&) {}, 3);
    check(
        "all bricks on the last rank", [](auto&) {}, -1);
    check("another display rank", [&](auto& c) { c.image.displayRank = size - 1; });
    check("linear owners", [](auto& c) { c.image.ownerMap = dfb::linearOwner; });
    dfb::NetworkConfig byCaller;
    byCaller.progress = dfb::Progress::Caller;
    check(
        "progress by the caller", [](auto&) {}, 0, byCaller);
    check(
        "no threads of its own", [](auto& c) { c.executor = std::make_shared<dfb::CallerExecutor>(); }, 0, byCaller);
    check("one worker", [](auto& c) { c.executor = std::make_shared<dfb::ThreadExecutor>(1); });
#if defined(DFB_HAS_TBB)
    check("oneTBB", [](auto& c) { c.executor = std::make_shared<dfb::TbbExecutor>(2); });
#endif
#if defined(DFB_HAS_SNAPPY)
    check("compressed", [](auto& c) { c.messages.codec = std::make_shared<dfb::SnappyCodec>(); });
#endif
}

TEST_CASE("Output formats", "[images]")
{
    const Scene s = sceneFor(Loop::Declared, 6);
    for (const auto format : {dfb::OutputFormat::RGBA8, dfb::OutputFormat::SRGBA8, dfb::OutputFormat::None}) {
        auto config = configOf(s, 2);
        config.image.format = format;
        const Picture p = overMpi(MPI_COMM_WORLD, s, Loop::Declared, config);
        if (format == dfb::OutputFormat::None || rankIn(MPI_COMM_WORLD) != 0)
            CHECK(p.bytes.empty());
        else
            CHECK(scene::wrongValues(p, scene::referenceOf(s)) == 0);
    }
}

TEST_CASE("Ordinary: an empty view, one pixel, a declaration that is kept", "[images]")
{
    for (const Loop loop : {Loop::Listing3, Loop::Declared}) {
        Scene empty = scene::makeScene(0, 1, 600, 600);
        const Picture none = overMpi(MPI_COMM_WORLD, empty, loop, configOf(empty, 2));
        Scene one = scene::makeScene(2, 1, 1, 1);
        one.bricks[0].bounds = {{0, 0, 0}, {1, 1, 1}};
        const Picture pixel = overMpi(MPI_COMM_WORLD, one, loop, configOf(one, 2));
        if (rankIn(MPI_COMM_WORLD) == 0) {
            CHECK(scene::wrongValues(none, scene::referenceOf(empty)) == 0);
            CHECK(scene::wrongValues(pixel, scene::referenceOf(one)) == 0);
        }
    }
    const Scene s = sceneFor(Loop::Declared, 7);
    dfb::DistributedFrameBuffer<Blend> fb(MPI_COMM_WORLD, configOf(s, 2));
    std::vector<std::int64_t> messages;
    for (int frame = 0; frame < 3; ++frame) {
        const auto report = scene::renderLoop(fb, s, Loop::Declared);
        messages.push_back(report.messagesSent);
        if (fb.isDisplayRank())
            CHECK(scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s)) == 0);
    }
    if (fb.size() > 1) {
        CHECK(messages[1] < messages[0]);
        CHECK(messages[2] < messages[0]);
    } else {
        CHECK(messages[0] == 0);
    }
}

TEST_CASE("A part of the ranks, and two framebuffers on different communicators at once", "[images]")
{
    const int rank = rankIn(MPI_COMM_WORLD);
    MPI_Comm half = MPI_COMM_NULL;
    MPI_Comm_split(MPI_COMM_WORLD, rank % 2, -rank, &half); // in reverse order
    const Scene all = sceneFor(Loop::Declared, 8),
                part = sceneFor(Loop::ImageOwned, 9 + static_cast<std::uint64_t>(rank % 2));
    {
        dfb::DistributedFrameBuffer<Blend> fbAll(MPI_COMM_WORLD, configOf(all, 2));
        dfb::DistributedFrameBuffer<Single> fbPart(half, configOf(part, 2));
        for (int i = 0; i < 2; ++i) {
            auto frame = fbAll.begin(scene::paramsOf(all));
            const auto tile = std::make_unique<decltype(fbAll)::Tile>();
            for (int index : fbAll.ownedTiles())
                scene::sendParent(frame, *tile, index, static_cast<int>(all.bricks.size()));
            const auto reportPart = scene::renderLoop(fbPart, part, Loop::ImageOwned);
            for (const dfb::Brick& brick : scene::bricksOf(all, fbAll.rank(), fbAll.size()))
                for (int index = 0; index < fbAll.layout().tileCount(); ++index)
                    scene::sendInput(frame, *tile, all, brick, index);
            const auto reportAll = frame.end();
            if (fbAll.isDisplayRank())
                CHECK(scene::wrongValues(Picture(fbAll.image(), reportAll), scene::referenceOf(all)) == 0);
            if (fbPart.isDisplayRank())
                CHECK(scene::wrongValues(Picture(fbPart.image(), reportPart), scene::referenceOf(part)) == 0);
        }
    }
    CHECK(MPI_Comm_free(&half) == MPI_SUCCESS); // the communicator still belongs to the caller
}

} // namespace images_cases
