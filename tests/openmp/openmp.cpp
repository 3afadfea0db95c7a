// A framebuffer in a user's OpenMP code: OpenMP threads render and set tiles, while frames are begun and ended outside
// of parallel regions. Also framebuffers that each belong to one thread.
#include "catch.hpp"
#include "random_scene.hpp"

#include <omp.h>

#include <array>
#include <atomic>
#include <cstddef>
#include <memory>
#include <vector>

namespace {

using Fb = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, dfb::InprocTransport>;

// A frame whose tiles are set in a parallel loop. The most threads that were in it.
int frameInParallel(Fb& fb, const scene::Scene& s, dfb::FrameReport& report)
{
    auto params = paramsOf(s);
    params.declared = true;
    auto frame = fb.begin(params);
    const auto mine = bricksOf(s, fb.rank(), fb.size());
    const auto pairs = visibleTiles(dfb::World(mine), scene::FlatCamera(), fb.layout());
    frame.declare(inputsOf(dfb::World(mine), pairs));
    std::atomic<int> threads{1};
#pragma omp parallel for schedule(dynamic) num_threads(3)
    for (int i = 0; i < static_cast<int>(pairs.size()); ++i) {
        if (omp_get_num_threads() > threads)
            threads = omp_get_num_threads();
        const dfb::BrickInTile& pair = pairs[static_cast<std::size_t>(i)];
        const dfb::Brick& brick = mine[static_cast<std::size_t>(pair.brick)];
        const auto tile = std::make_unique<Fb::Tile>();
        frame.start(*tile, pair.tile);
        tile->generation = 1;
        tile->source = brick.id;
        renderBrick(s, brick, *tile);
        frame.setTile(*tile);
    }
    report = frame.end();
    return threads;
}

} // namespace

TEST_CASE("Tiles are set in the user's parallel loops")
{
    const scene::Scene s = scene::makeScene(7, 8);
    std::size_t wrong = 0; // written by the display rank
    int images = 0;
    std::atomic<int> threads{0};
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        Fb fb(communicator, configOf(s, 2));
        for (int i = 0; i < 20; ++i) {
            dfb::FrameReport report;
            threads = frameInParallel(fb, s, report);
            if (fb.isDisplayRank())
                wrong += wrongValues(scene::Picture(fb.image(), report), referenceOf(s)), ++images;
        }
    });
    CHECK(wrong == 0);
    CHECK(images == 20);
    CHECK(threads == 3);
}

TEST_CASE("Each of the user's threads has a framebuffer of its own")
{
    // All ranks make them in the same order; then each goes its own way.
    const std::array<scene::Scene, 2> scenes{scene::makeScene(5, 3), scene::makeScene(6, 4, 61, 83)};
    std::array<std::size_t, 2> wrong{}; // written by the display rank
    std::array<int, 2> images{};
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        std::vector<std::unique_ptr<Fb>> fbs;
        for (const scene::Scene& s : scenes)
            fbs.push_back(std::make_unique<Fb>(communicator, configOf(s, 1)));
        const auto frames = [&](std::size_t which) {
            Fb& fb = *fbs[which];
            for (int i = 0; i < 20; ++i) {
                const auto report = renderLoop(fb, scenes[which], scene::Loop::Declared);
                if (fb.isDisplayRank()) {
                    wrong[which] += wrongValues(scene::Picture(fb.image(), report), referenceOf(scenes[which]));
                    ++images[which];
                }
            }
        };
#pragma omp parallel sections num_threads(2)
        {
#pragma omp section
            frames(0);
#pragma omp section
            frames(1);
        }
    });
    for (std::size_t which = 0; which < 2; ++which) {
        CHECK(wrong[which] == 0);
        CHECK(images[which] == 20);
    }
}
