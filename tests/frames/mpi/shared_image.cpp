// The image of the display rank, into which owners on its node write finished tiles themselves. Over MPI, on any number
// of ranks; some cases need ranks that see each other's memory.
#include "catch.hpp"
#include "everywhere.hpp"
#include "large_image.hpp"
#include "random_scene.hpp"
#include "ranks.hpp"

#include <dfb/comm/mpi_transport.hpp>
#include <dfb/dfb.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <string>
#include <thread>

namespace shared_image_cases {

namespace {

using scene::Picture;
using scene::Scene;

// Like AlphaBlend, but finish() of one tile takes long on one rank, if it is told to.
std::atomic<int> slowTile{-1};
std::atomic<bool> isThere{false}, mayGoOn{false};
class SlowBlend : public dfb::BasicAlphaBlend<16> {
public:
    void newFrame(const dfb::TileInfo& info)
    {
        tile_ = info.tile;
        dfb::BasicAlphaBlend<16>::newFrame(info);
    }
    void finish(dfb::FinishedTile& out)
    {
        const bool isSlow = tile_ == slowTile;
        if (isSlow) {
            isThere = true;
            while (!mayGoOn)
                std::this_thread::sleep_for(std::chrono::milliseconds(1));
        }
        dfb::BasicAlphaBlend<16>::finish(out);
    }

private:
    int tile_ = -1;
};

} // namespace

namespace {

Scene sceneFor(int bricks, std::uint64_t seed)
{
    Scene s = scene::makeScene(bricks, seed);
    s.timeout = std::chrono::milliseconds(30000); // no frame takes so long
    return s;
}

// Whether this rank has heard where the image lies.
class PlaceSink final : public dfb::TraceSink {
public:
    void add(const dfb::TraceEvent& event) noexcept override
    {
        if (event.kind == dfb::TraceEvent::Kind::Receive
            && event.message == static_cast<std::uint8_t>(dfb::detail::MessageKind::ImagePlace))
            hasHeard = true;
    }
    std::atomic<bool> hasHeard{false};
};

// Call it before the first frame: an owner that hears where the image lies after that frame goes on sending its tiles.
// Collective. Returns whether all have heard in time.
template <class Fb>
bool waitForPlace(Fb& fb, const PlaceSink& sink)
{
    for (int round = 0; round < 3000; ++round) {
        if (fb.allReduce({fb.isDisplayRank() || sink.hasHeard}, dfb::Reduce::Min).front() == 1)
            return true;
        std::this_thread::sleep_for(std::chrono::milliseconds(10));
    }
    return false;
}

template <class Fb>
bool goodFrame(Fb& fb, const Scene& s, dfb::FrameReport& report)
{
    report = scene::renderLoop(fb, s, scene::Loop::Declared);
    return !fb.isDisplayRank() || scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s)) == 0;
}

} // namespace

TEST_CASE("Owners that see the image of the display rank send it no tiles", "[shared_image]")
{
    const Scene s = sceneFor(5, 1);
    const int others = seesNextRank(MPI_COMM_WORLD) ? sizeOf(MPI_COMM_WORLD) - 1 : 0;
    std::int64_t messages[2] = {}, bytes[2] = {};
    for (const bool shared : {true, false}) {
        auto config = scene::configOf(s);
        config.image.displayRank = sizeOf(MPI_COMM_WORLD) - 1;
        const auto sink = std::make_shared<PlaceSink>();
        config.trace = sink;
        dfb::NetworkConfig options;
        options.sharedMemory = shared;
        dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>> fb(MPI_COMM_WORLD, config, options);
        if (shared && others > 0)
            CHECK(waitForPlace(fb, *sink));
        dfb::FrameReport report;
        for (int i = 0; i < 4; ++i)
            CHECK(goodFrame(fb, s, report));
        messages[shared] = report.messagesSent;
        bytes[shared] = report.bytesSent;
    }
    CHECK(messages[true] == messages[false] - others);      // a batch each
    CHECK((others == 0 || bytes[true] > bytes[false] / 2)); // the bytes that they write there count
}

// Rank 0 and any other rank see each other's memory. No other two ranks do, as if one could map no more of it.
struct SeenByRank0 : dfb::MpiTransport {
    using MpiTransport::MpiTransport;
    bool lendsTo(int other) const noexcept { return (rank() == 0 || other == 0) && MpiTransport::lendsTo(other); }
    std::byte* blockAt(int other, std::int32_t place, std::size_t byteCount) const noexcept
    {
        return rank() == 0 || other == 0 ? MpiTransport::blockAt(other, place, byteCount) : nullptr;
    }
};

TEST_CASE("With half a level, ranks agree on how inputs come, whoever sees whom", "[shared_image]")
{
    dfb::FrameBufferConfig config(64, 64);
    config.precision = dfb::HalfLevel{};
    dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, SeenByRank0> fb(MPI_COMM_WORLD, config);
    dfb::Buffer memory = fb.sharedMemory(16 * 16 * 5 * sizeof(float)); // all tiles get the same pixels
    float* const pixels = reinterpret_cast<float*>(memory.data());
    std::fill_n(pixels, 16 * 16 * 5, 0.0f);
    pixels[0] = pixels[3] = 1;
    dfb::FrameConfig params;
    params.maxLayers = fb.size();
    auto frame = fb.begin(params);
    for (int tile = 0; tile < fb.layout().tileCount(); ++tile) {
        decltype(fb)::TileView view;
        frame.start(view, tile, 0);
        view.generation = 1;
        view.color = pixels;
        view.depth = pixels + 16 * 16 * 4;
        view.stride = 16;
        view.staysUntilEnd = true;
        frame.setTile(view);
        if (fb.tileOwner(tile) == fb.rank()) {
            decltype(fb)::TileView parent;
            frame.start(parent, tile, 0);
            parent.children = fb.size();
            frame.setTile(parent);
        }
    }
    const auto report = frame.end();
    CHECK(report.wireErrorBound <= 0.5 / 255);
    if (fb.isDisplayRank()) {
        CHECK(fb.image().rgba8()[4 * 16] == 255);
        CHECK(fb.image().rgba8()[4 * 17] == 0);
    }
}

TEST_CASE("After a frame with two owners of a tile the next frame is right", "[shared_image]")
{
    using Fb = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>>;
    dfb::FrameBufferConfig config(64, 64);
    config.quiet = std::chrono::milliseconds(50);
    const auto sink = std::make_shared<PlaceSink>();
    config.trace = sink;
    Fb fb(MPI_COMM_WORLD, config);
    if (seesNextRank(MPI_COMM_WORLD))
        CHECK(waitForPlace(fb, *sink));
    const int owner = 0, other = 1;
    const auto tile = std::make_unique<Fb::Tile>();
    bool isWrong = false;
    const auto frame = [&](bool disagrees) {
        dfb::FrameConfig params;
        const int mine = disagrees && fb.rank() == other ? other : owner;
        params.owners = std::make_shared<const std::vector<int>>(fb.layout().tileCount(), mine);
        auto open = fb.begin(params);
        // The owner leaves most pixels to the background; the other rank covers them.
        for (const int index : open.ownedTiles()) {
            const float green[4] = {0, 1, 0, 1};
            open.start(*tile, index);
            if (mine == owner)
                std::copy_n(green, 4, tile->color);
            else
                tile->fill(green, 1);
            if (!disagrees || fb.rank() == other)
                open.setTile(*tile);
        }
        open.end();
        for (std::size_t i = 0; i < fb.image().pixelCount(); ++i) {
            const bool isSet = i % 16 == 0 && i / 64 % 16 == 0;
            isWrong = isWrong || fb.image().rgba8()[4 * i + 1] != (isSet ? 255 : 0);
        }
    };
    frame(false);
    CHECK_THROWS_AS(frame(true), dfb::FrameError);
    frame(false);
    CHECK(!isWrong);
}

TEST_CASE("A change of size leaves no memory behind", "[shared_image]")
{
    const Scene s = sceneFor(2, 3);
    dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>> fb(MPI_COMM_WORLD, scene::configOf(s));
    dfb::FrameReport report;
    std::int64_t before = 0;
    for (int round = 0; round < 110; ++round) {
        fb.resize(s.width, s.height);
        if (round % 2 == 0) // also without a frame in between
            CHECK(goodFrame(fb, s, report));
        if (round == 10)
            before = report.peakMemoryBytes;
    }
    CHECK(report.peakMemoryBytes < before + 50 * 2048); // had each left a block of the smallest size: 100
}

TEST_CASE("From an owner that does not leave the image is taken away", "[shared_image]")
{
    if (sizeOf(MPI_COMM_WORLD) == 1 || !seesNextRank(MPI_COMM_WORLD))
        return;
    const int rank = rankIn(MPI_COMM_WORLD);
    const Scene s = sceneFor(5, 2);
    const auto runCase = [&](bool allowPartial) {
        frame_cases::Result result;
        constexpr int threads = 2; // the slow tile keeps one of them
        auto config = scene::configOf(s, threads);
        const auto sink = std::make_shared<PlaceSink>();
        config.trace = sink;
        dfb::DistributedFrameBuffer<SlowBlend> fb(MPI_COMM_WORLD, config);
        result.expect(waitForPlace(fb, *sink), "not all hear where the image lies");
        dfb::FrameReport report;
        for (int i = 0; i < 2; ++i)
            result.expect(goodFrame(fb, s, report), "a frame before");
        const std::int64_t messagesBefore = report.messagesSent;
        const std::byte* imageBefore = fb.image().bytes();
        const Picture before(fb.image(), report);

        for (int tile = 0; tile < fb.layout().tileCount() && rank == 1; ++tile)
            if (fb.tileOwner(tile) == 1 && tile % 2 == 1)
                slowTile = tile;
        isThere = mayGoOn = false;
        MPI_Request go = MPI_REQUEST_NULL;
        int word = 0;
        if (rank == 1)
            MPI_Irecv(&word, 1, MPI_INT, 0, 0, MPI_COMM_WORLD, &go);
        std::thread waiter([&] {
            for (int done = 0; rank == 1 && !done; std::this_thread::sleep_for(std::chrono::milliseconds(1)))
                MPI_Test(&go, &done, MPI_STATUS_IGNORE);
            mayGoOn = true;
        });
        Scene impatient = s;
        impatient.timeout = std::chrono::milliseconds(2000); // rank 1 has been at that tile for long by then
        impatient.allowPartial = allowPartial;
        const std::string text =
            scene::outcomeOf([&] { report = scene::renderLoop(fb, impatient, scene::Loop::Declared); });
        if (allowPartial)
            result.expect(report.failure && report.failure->kind == dfb::ErrorKind::TimedOut
                              && report.tilesIncomplete > 0,
                          "not partial: " + text);
        else
            result.expect(scene::has(text, "timed out"), text);
        if (rank == 0) {
            result.expect(fb.image().empty() == !allowPartial, "an image, or none");
            // An owner that still writes costs the image its own tiles and no others.
            const Picture after(fb.image(), report);
            const std::size_t width = static_cast<std::size_t>(s.width), pixelBytes = dfb::bytesPerPixel(before.format);
            int lost = 0, wrong = 0;
            for (int tile = 0; tile < fb.layout().tileCount() && allowPartial; ++tile) {
                const dfb::Region region = fb.layout().region(tile);
                lost += !fb.isComplete(tile) && fb.tileOwner(tile) != 1;
                for (int y = region.y0; y < region.y1 && fb.isComplete(tile); ++y) {
                    const std::size_t at =
                        (static_cast<std::size_t>(y) * width + static_cast<std::size_t>(region.x0)) * pixelBytes;
                    wrong += std::memcmp(after.bytes.data() + at, before.bytes.data() + at,
                                         static_cast<std::size_t>(region.width()) * pixelBytes)
                             != 0;
                }
            }
            result.expect(lost == 0 && wrong == 0,
                          std::to_string(lost) + " tiles lost, " + std::to_string(wrong) + " rows wrong");
            MPI_Send(&word, 1, MPI_INT, 1, 0, MPI_COMM_WORLD);
        }
        waiter.join();
        result.expect(rank != 1 || isThere, "rank 1 was not at that tile");
        slowTile = -1;
        const std::string after = scene::outcomeOf([&] {
            for (int i = 0; i < 3; ++i)
                result.expect(goodFrame(fb, s, report), "a frame after");
        });
        result.expect(after == "fine", after);
        result.expect(rank != 0 || fb.image().bytes() != imageBefore, "the same image");
        result.expect(report.messagesSent > messagesBefore, "tiles are not sent again");
        return result;
    };
    for (const bool allowPartial : {false, true})
        CHECK(undisturbedRanks([&] { return runCase(allowPartial); }).wrong == "");
}

// The image is larger than what ranks of a node share (NodeMemory::capacity). Finished tiles are lent or go through
// MPI.
TEST_CASE("A float image of 2.25 GiB gets to the display rank, lent and through MPI", "[.stress]")
{
    for (const bool shared : {false, true}) {
        INFO((shared ? "lent" : "through MPI"));
        CHECK(largeImage<dfb::MpiTransport>(MPI_COMM_WORLD, shared) == "");
    }
}

} // namespace shared_image_cases
