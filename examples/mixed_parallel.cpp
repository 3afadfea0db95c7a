// Bricks that several ranks hold: each ball is on two ranks, and for each tile one of the two renders it. After a first
// frame the loop knows what each ball costs in each tile, and shares the work. The picture shows eight glass balls.
//   mpirun -n 4 mixed_parallel    writes mixed_parallel.ppm
#include "ball.hpp"

#include <dfb/dfb.hpp>

#include <cstdint>
#include <cstdio>
#include <exception>
#include <vector>

namespace {

constexpr int width = 480, height = 360, balls = 8;

} // namespace

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb(mpi.communicator(), {width, height, dfb::OutputFormat::SRGBA8});

    std::vector<dfb::Brick> mine;
    for (int ball = 0; ball < balls; ++ball)
        if (ball % fb.size() == fb.rank() || (ball + 1) % fb.size() == fb.rank())
            mine.push_back({static_cast<std::uint32_t>(ball), example::ballOf(ball).bounds()});
    const dfb::SharedWorld world(fb, dfb::World(mine)); // collective: each rank learns who holds what

    const dfb::PerspectiveCamera camera({0, 1, 8}, {0, 0, 0}, {0, 1, 0}, 35);
    dfb::MeasuredCostBricks owner;
    dfb::MixedParallelLoop loop(fb, world, owner);
    for (int frame = 0; frame < 2; ++frame)
        owner.update(loop.render(camera, [&](const dfb::Brick& brick, auto& tile) {
            const example::Ball ball = example::ballOf(static_cast<int>(brick.id));
            tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
                renderBall(ball, camera.eye(), camera.direction(x + 0.5, y + 0.5, width, height), rgba, depth);
            });
        }));
    if (fb.isDisplayRank())
        dfb::writePpm("mixed_parallel.ppm", fb.image());
} catch (const std::exception& e) {
    std::fprintf(stderr, "mixed_parallel: %s\n", e.what());
    return 1;
}
