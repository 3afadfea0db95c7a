// A rendering loop of your own, as in Listing 3 of the paper: each rank renders its balls into all tiles that they
// cover. The picture shows eight glass balls on a spiral.
//   mpirun -n 4 own_loop          writes own_loop.ppm
//   mpirun -n 4 own_loop fail     the last rank's renderer throws; each rank says so
#include "ball.hpp"

#include <dfb/dfb.hpp>

#include <cstdint>
#include <cstdio>
#include <exception>
#include <stdexcept>
#include <string>

namespace {

constexpr int width = 480, height = 360, balls = 8;

void render(dfb::DistributedFrameBuffer<dfb::AlphaBlend>& fb, bool fails)
{
    const dfb::PerspectiveCamera camera({0, 1, 8}, {0, 0, 0}, {0, 1, 0}, 35);
    const auto covers = [&](int ball, const dfb::TileHeader& tile) {
        return camera.project(example::ballOf(ball).bounds(), width, height).meets(tile.region);
    };
    auto frame = fb.begin();
    // Generation 0: the owner of a tile announces how many inputs it will get.
    frame.forEachTile(fb.ownedTiles(), [&](auto& tile) {
        for (int ball = 0; ball < balls; ++ball)
            tile.children += covers(ball, tile);
        frame.setTile(tile);
    });
    // Generation 1: an input for each ball of this rank.
    frame.forEachTile(fb.layout().tileCount(), [&](std::int64_t index, auto& tile) {
        for (int number = fb.rank(); number < balls; number += fb.size()) {
            frame.start(tile, static_cast<int>(index));
            if (!covers(number, tile))
                continue;
            if (fails && fb.rank() == fb.size() - 1)
                throw std::runtime_error("ball " + std::to_string(number) + " cannot be read");
            tile.generation = 1;
            tile.source = static_cast<std::uint32_t>(number);
            tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
                renderBall(example::ballOf(number), camera.eye(), camera.direction(x + 0.5, y + 0.5, width, height),
                           rgba, depth);
            });
            frame.setTile(tile);
        }
    });
    frame.end(); // throws FrameError on all ranks if a renderer threw on any
}

} // namespace

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb(mpi.communicator(), {width, height, dfb::OutputFormat::SRGBA8});
    try {
        render(fb, argc > 1 && std::string(argv[1]) == "fail");
    } catch (const dfb::FrameError& e) {
        std::fprintf(stderr, "rank %d: %s\n", fb.rank(), e.what());
        return 1;
    }
    if (fb.isDisplayRank())
        dfb::writePpm("own_loop.ppm", fb.image());
} catch (const std::exception& e) {
    std::fprintf(stderr, "own_loop: %s\n", e.what());
    return 1;
}
