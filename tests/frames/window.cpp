// What an interactive window needs: frames that do not block, tiles as they are finished, other sizes, frames of a
// region. In one process and over MPI (everywhere.hpp).

#include "everywhere.hpp"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

namespace frame_cases {

namespace {

using WindowFrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport>;

// Polls until the frame is done. Throws after 20 seconds.
template <class Frame>
dfb::FrameReport pollToEnd(Frame& frame, int& polls)
{
    const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(20);
    for (;; ++polls) {
        if (const auto report = frame.tryEnd())
            return *report;
        if (std::chrono::steady_clock::now() > limit)
            throw std::runtime_error("isDone() is never true");
        std::this_thread::yield();
    }
}

struct NotBlocking {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(5);
        for (const auto progress : {dfb::Progress::Auto, dfb::Progress::Caller}) {
            dfb::NetworkConfig network;
            network.progress = progress;
            auto config = scene::configOf(s);
            config.quiet = std::chrono::minutes(1); // no good frame waits for this
            WindowFrameBuffer patient(communicator, config, network);
            config.quiet = std::chrono::milliseconds(5);
            WindowFrameBuffer fb(communicator, config, network);
            int polls = 0;
            for (int i = 0; i < 3; ++i) { // a good frame
                const dfb::World world(scene::bricksOf(s, fb.rank(), fb.size()));
                dfb::DataParallelLoop loop(patient, world);
                auto frame = loop.start(
                    scene::FlatCamera(),
                    [&](const dfb::Brick& brick, auto& tile) { scene::renderBrick(s, brick, tile); },
                    scene::paramsOf(s));
                const auto report = pollToEnd(frame, polls);
                if (!fb.isDisplayRank())
                    continue;
                const scene::Picture picture(patient.image(), report);
                result.expect(scene::wrongValues(picture, scene::referenceOf(s)) == 0, "a wrong picture");
                result.hash = picture.hash();
            }
            const auto failureOf = [&](const auto& body, dfb::FrameConfig params) {
                return scene::outcomeOf([&] {
                    auto frame = fb.begin(params);
                    body(frame);
                    pollToEnd(frame, polls);
                });
            };
            dfb::FrameConfig declared;
            declared.declared = true;
            const std::string thrown = failureOf(
                [&](auto& frame) {
                    frame.guard([&] {
                        frame.declare({});
                        if (fb.rank() == fb.size() - 1)
                            throw std::runtime_error("a renderer that throws");
                    });
                },
                declared);
            result.expect(thrown.find("a renderer that throws") != std::string::npos, "thrown: " + thrown);
            const std::string missing = failureOf(
                [&](auto& frame) {
                    frame.declare(fb.rank() == 0 ? std::vector<dfb::TileInput>{{0, 7, 0}}
                                                 : std::vector<dfb::TileInput>());
                },
                declared);
            result.expect(missing.find("MissingInput") != std::string::npos
                              || missing.find("missing") != std::string::npos,
                          "missing: " + missing);
            const std::string undeclared = failureOf([](auto&) {}, declared);
            result.expect(undeclared.find("without declare()") != std::string::npos, "undeclared: " + undeclared);
        }
        return result;
    }
};

// onTile is called once for each tile with an input, when its pixels are in the image.
struct TilesAsTheyCome {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(5);
        auto config = scene::configOf(s);
        const dfb::TileLayout layout(s.width, s.height, 16);
        std::vector<std::atomic<int>> told(static_cast<std::size_t>(layout.tileCount()));
        std::vector<std::vector<float>> rows(told.size()); // the first row of each tile, as it was during the call
        std::atomic<bool> throws{false};
        config.onTile = [&](int tile, const dfb::Region& pixels, const dfb::Image& image) {
            if (throws)
                throw std::runtime_error("a window that throws");
            ++told[static_cast<std::size_t>(tile)];
            const float* row = image.rgba32f() + 4 * (pixels.y0 * image.width() + pixels.x0);
            rows[static_cast<std::size_t>(tile)].assign(row, row + 4 * pixels.width());
        };
        WindowFrameBuffer fb(communicator, config);
        for (int i = 0; i < 2; ++i) {
            for (auto& count : told)
                count = 0;
            const auto report = scene::renderLoop(fb, s, scene::Loop::Declared);
            std::int64_t tiles = 0;
            int wrong = 0;
            for (int tile = 0; tile < layout.tileCount(); ++tile) {
                const int count = told[static_cast<std::size_t>(tile)];
                tiles += count;
                wrong += count > (fb.isDisplayRank() ? 1 : 0);
                if (count == 0 || !fb.isDisplayRank())
                    continue;
                const dfb::Region r = layout.region(tile);
                const auto& row = rows[static_cast<std::size_t>(tile)];
                wrong += std::memcmp(row.data(), fb.image().rgba32f() + 4 * (r.y0 * fb.image().width() + r.x0),
                                     row.size() * sizeof(float))
                         != 0;
            }
            result.expect(wrong == 0, std::to_string(wrong) + " tiles told twice, elsewhere, or too soon");
            if (fb.isDisplayRank())
                result.expect(tiles > 0 && tiles <= report.tilesTouched,
                              std::to_string(tiles) + " tiles of " + std::to_string(report.tilesTouched));
        }
        throws = fb.isDisplayRank();
        const std::string text = scene::outcomeOf([&] { scene::renderLoop(fb, s, scene::Loop::Declared); });
        result.expect(text.find("FrameError") != std::string::npos
                          && text.find("a window that throws") != std::string::npos,
                      "a window that throws: " + text);
        scene::Scene partial = s;
        partial.allowPartial = true;
        const auto report = scene::renderLoop(fb, partial, scene::Loop::Declared);
        result.expect(report.failure && report.failure->message == "a window that throws" && report.failure->tile >= 0
                          && report.tilesIncomplete == 0,
                      "a partial frame of a window that throws: "
                          + (report.failure ? report.failure->describe() : std::string("no failure")));
        throws = false;
        scene::renderLoop(fb, s, scene::Loop::Declared);
        return result;
    }
};

struct Sizes {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        scene::Scene s = scene::makeScene(5);
        for (const int inFlight : {1, 2}) {
            auto config = scene::configOf(s);
            config.framesInFlight = inFlight;
            WindowFrameBuffer fb(communicator, config);
            const auto expectRight = [&](const scene::Scene& its, const std::string& when) {
                const auto report = scene::renderLoop(fb, its, scene::Loop::Declared);
                if (fb.isDisplayRank())
                    result.expect(scene::wrongValues(scene::Picture(fb.image(), report), scene::referenceOf(its)) == 0,
                                  when);
            };
            expectRight(s, "before resize()");
            const scene::Scene other = scene::makeScene(5, 3, 33, 130);
            fb.resize(33, 130);
            result.expect(fb.image().empty() && fb.imageFrame() == -1, "an image of another size");
            result.expect(fb.layout().width() == 33 && fb.config().image.height == 130, "resize() has no effect");
            expectRight(other, "after resize()");
            const std::string wrong = scene::outcomeOf([&] { fb.resize(33, fb.rank() == 0 ? 0 : 130); });
            result.expect(wrong.find("InvalidArgument") != std::string::npos, "a size that cannot be: " + wrong);
            expectRight(other, "after resize() that failed");
            auto frame = fb.begin();
            const std::string open = scene::outcomeOf([&] { fb.resize(64, 64); });
            result.expect(open.find("while a frame is open") != std::string::npos, "resize() in a frame: " + open);
            frame.cancel();
            scene::outcomeOf([&] { frame.end(); });
            expectRight(other, "after all");
        }
        return result;
    }
};

// imageOnAllRanks() gives every rank the image with its depth, or an empty image if there is none.
struct EverywhereTheImage {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(5);
        for (const int display : {0, 1}) {
            auto config = scene::configOf(s);
            config.image.depth = true;
            WindowFrameBuffer probe(communicator, config);
            config.image.displayRank = std::min(display, probe.size() - 1);
            WindowFrameBuffer fb(communicator, config);
            result.expect(fb.imageOnAllRanks().empty(), "an image before the first frame");
            const auto report = scene::renderLoop(fb, s, scene::Loop::Declared);
            const dfb::Image image = fb.imageOnAllRanks();
            if (image.empty() || !image.hasDepth()) {
                result.expect(false, "no image");
                return result;
            }
            const scene::Picture picture(image, report);
            result.expect(scene::wrongValues(picture, scene::referenceOf(s)) == 0, "a wrong picture");
            if (fb.isDisplayRank())
                result.expect(picture.hash() == scene::Picture(fb.image(), report).hash(), "not the same picture");
        }
        return result;
    }
};

// A frame of a region renders the tiles that meet the region. The others keep their pixels, even if the scene has
// changed.
struct RegionOfInterest {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        scene::Scene first = scene::makeScene(5), second = scene::makeScene(6);
        second.width = first.width, second.height = first.height;
        second.background = {0.5f, 0.25f, 0.125f, 1}; // shows in the region only
        WindowFrameBuffer fb(communicator, scene::configOf(first));
        const dfb::Region region{20, 17, 41, 33};
        const auto render = [&](const scene::Scene& s, bool all) {
            const dfb::World world(scene::bricksOf(s, fb.rank(), fb.size()));
            dfb::DataParallelLoop loop(fb, world);
            dfb::FrameConfig frame = scene::paramsOf(s);
            if (!all)
                frame.samples = dfb::samplesIn(fb.layout(), region, frame.passes);
            std::atomic<int> outside{0};
            loop.render(
                scene::FlatCamera(),
                [&](const dfb::Brick& brick, auto& tile) {
                    outside += !all && intersection(region, tile.region).empty();
                    scene::renderBrick(s, brick, tile);
                },
                frame);
            result.expect(outside == 0, "a tile outside the region is rendered");
        };
        const auto pixels = [&] {
            const float* rgba = fb.isDisplayRank() ? fb.image().rgba32f() : nullptr;
            return rgba ? std::vector<float>(rgba, rgba + 4 * fb.image().pixelCount()) : std::vector<float>();
        };
        render(second, true);
        const std::vector<float> all = pixels();
        render(first, true);
        const std::vector<float> before = pixels();
        for (int i = 0; i < 2; ++i) {
            render(second, false);
            const std::vector<float> after = pixels();
            int wrong = 0;
            for (int tile = 0; fb.isDisplayRank() && tile < fb.layout().tileCount(); ++tile) {
                const dfb::Region r = fb.layout().region(tile);
                const std::vector<float>& expected = intersection(region, r).empty() ? before : all;
                for (int y = r.y0; y < r.y1; ++y) {
                    const auto at = static_cast<std::size_t>(4 * (y * first.width + r.x0));
                    wrong += std::memcmp(&after[at], &expected[at], 16 * static_cast<std::size_t>(r.width())) != 0;
                }
            }
            result.expect(wrong == 0, std::to_string(wrong) + " wrong rows");
            result.expect(!fb.isDisplayRank() || all != before, "two scenes that are one");
        }
        auto frame = fb.begin();
        frame.cancel();
        scene::outcomeOf([&] { frame.end(); });
        const std::string text = scene::outcomeOf([&] { render(second, false); });
        result.expect(text.find("the last frame failed") != std::string::npos, "after a failed frame: " + text);
        render(first, true);
        result.expect(pixels() == before, "the next whole frame");
        return result;
    }
};

} // namespace

TEST_CASE("imageOnAllRanks() gives each rank the display rank's image", "[window]")
{
    everywhere<EverywhereTheImage>();
}

TEST_CASE("A frame of a region leaves the rest of the image alone", "[window]") { everywhere<RegionOfInterest>(); }

TEST_CASE("isDone() waits for nobody, and end() after it waits no more, also in frames that fail", "[window]")
{
    everywhere<NotBlocking>();
}

TEST_CASE("onTile is called once for each tile with an input, when its pixels are in the image", "[window]")
{
    everywhere<TilesAsTheyCome>();
}

TEST_CASE("resize() gives images of another size, or changes nothing", "[window]") { everywhere<Sizes>(); }

} // namespace frame_cases
