// A program's own loop, as Listing 3 of the paper: Frame::forEachTile() and exceptions in it. In one process and over
// MPI (everywhere.hpp).

#include "everywhere.hpp"

#include <chrono>
#include <stdexcept>
#include <string>
#include <vector>

namespace frame_cases {

namespace {

using OwnFrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport>;

struct OwnLoop {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        scene::Scene s = scene::makeScene(5);
        s.passes = 2;
        auto config = scene::configOf(s);
        config.quiet = std::chrono::milliseconds(5);
        OwnFrameBuffer fb(communicator, config);
        const auto mine = scene::bricksOf(s, fb.rank(), fb.size());
        // Calls `check(tile)` for each input before it is sent. The loop has two kinds of jobs: the backgrounds of this
        // rank's tiles, and its bricks in all tiles.
        const auto render = [&](dfb::FrameConfig params, const auto& check) {
            auto frame = fb.begin(params);
            frame.forEachTile(fb.ownedTiles(), [&](auto& tile) {
                tile.children = scene::bricksIn(fb, s, tile.tile);
                frame.setTile(tile);
            });
            std::vector<dfb::BrickInTile> jobs;
            for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
                for (std::size_t b = 0; b < mine.size(); ++b)
                    if (scene::meets(fb, mine[b], tile))
                        jobs.push_back({static_cast<int>(b), tile});
            frame.forEachTile(static_cast<std::int64_t>(jobs.size()), [&](std::int64_t i, auto& tile) {
                const dfb::BrickInTile& job = jobs[static_cast<std::size_t>(i)];
                for (int pass = 0; pass < s.passes; ++pass) {
                    frame.start(tile, job.tile, pass);
                    tile.generation = 1;
                    tile.source = mine[static_cast<std::size_t>(job.brick)].id;
                    scene::renderBrick(s, mine[static_cast<std::size_t>(job.brick)], tile);
                    check(tile);
                    frame.setTile(tile);
                }
            });
            return frame.end();
        };
        const auto nothing = [](const dfb::TileHeader&) {};
        const auto expectRight = [&](const std::string& when) {
            const auto report = render(scene::paramsOf(s), nothing);
            if (fb.isDisplayRank())
                result.expect(scene::wrongValues(scene::Picture(fb.image(), report), scene::referenceOf(s)) == 0, when);
        };
        expectRight("a wrong picture");

        int bad = 0; // a tile with an input
        while (!scene::meets(fb, s.bricks.front(), bad))
            ++bad;
        const auto throws = [&](const dfb::TileHeader& tile) {
            if (tile.tile == bad)
                throw std::runtime_error("a renderer that throws");
        };
        const std::string text = scene::outcomeOf([&] { render(scene::paramsOf(s), throws); });
        result.expect(text.find("FrameError") != std::string::npos
                          && text.find("a renderer that throws") != std::string::npos
                          && text.find("tile " + std::to_string(bad)) != std::string::npos,
                      "thrown: " + text);
        expectRight("a wrong picture after the exception");

        auto partial = scene::paramsOf(s);
        partial.allowPartial = true;
        const auto report = render(partial, throws);
        result.expect(report.failure.has_value() && report.failure->tile == bad, "partial: no failure");
        result.expect(report.tilesIncomplete == 1, std::to_string(report.tilesIncomplete) + " tiles are missing");
        result.expect(report.tilesTouched > 0, "partial: no tile counts as touched");
        if (fb.isDisplayRank())
            for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
                result.expect(fb.isComplete(tile) == (tile != bad), "tile " + std::to_string(tile));
        return result;
    }
};

} // namespace

TEST_CASE("A loop of one's own renders with forEachTile(), and its exceptions name the tile on all ranks", "[own_loop]")
{
    everywhere<OwnLoop>();
}

} // namespace frame_cases
