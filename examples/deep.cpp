// Bricks within each other: five concentric glass shells, dealt out to the ranks. A ray meets the outer shell, then the
// inner ones, then the outer shell again, so a brick sends up to two segments of the ray for each pixel. The picture
// shows the shells one within the other, as if one rank had rendered all.
//   mpirun -n 4 deep    writes deep.ppm
#include "ball.hpp"

#include <dfb/dfb.hpp>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <vector>

namespace {

constexpr int width = 480, height = 360, shells = 5;
constexpr float thickness = 0.12f;

example::Ball shellOf(int number)
{
    example::Ball ball = example::ballOf(number);
    ball.center = {0, 0, 0};
    ball.radius = 2 - 0.35f * static_cast<float>(number);
    return ball;
}

// Returns the colour of glass between `enter` and `leave`.
dfb::Segment segmentOf(const dfb::Vec3& color, float enter, float leave)
{
    const float alpha = 1 - std::exp(-1.5f * (leave - enter));
    return {{alpha * color.x, alpha * color.y, alpha * color.z, alpha}, enter, leave};
}

} // namespace

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    dfb::DistributedFrameBuffer<dfb::DeepBlend> fb(mpi.communicator(), {width, height, dfb::OutputFormat::SRGBA8});
    std::vector<dfb::Brick> mine;
    for (int shell = fb.rank(); shell < shells; shell += fb.size())
        mine.push_back({static_cast<std::uint32_t>(shell), shellOf(shell).bounds()});
    const dfb::World world(mine);
    const dfb::PerspectiveCamera camera({0, 1, 8}, {0, 0, 0}, {0, 1, 0}, 35);

    dfb::DeepParallelLoop loop(fb, world, 2); // a pixel of a shell has two segments at most
    loop.render(camera, [&](const dfb::Brick& brick, dfb::DeepTile& tile) {
        const example::Ball outside = shellOf(static_cast<int>(brick.id));
        example::Ball inside = outside;
        inside.radius -= thickness;
        const dfb::Region& region = tile.header().region;
        for (int y = region.y0; y < region.y1; ++y)
            for (int x = region.x0; x < region.x1; ++x) {
                const dfb::Vec3 direction = camera.direction(x + 0.5, y + 0.5, width, height);
                float enter = 0, leave = 0, hollowEnter = 0, hollowLeave = 0;
                if (!hits(outside, camera.eye(), direction, enter, leave))
                    continue;
                if (!hits(inside, camera.eye(), direction, hollowEnter, hollowLeave)) {
                    tile.add(x, y, segmentOf(outside.color, enter, leave));
                    continue;
                }
                tile.add(x, y, segmentOf(outside.color, enter, hollowEnter));
                tile.add(x, y, segmentOf(outside.color, hollowLeave, leave));
            }
    });
    if (fb.isDisplayRank())
        dfb::writePpm("deep.ppm", fb.image());
} catch (const std::exception& e) {
    std::fprintf(stderr, "deep: %s\n", e.what());
    return 1;
}
