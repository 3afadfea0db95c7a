// A display wall: two rows of two displays with bezels between them, driven by up to four ranks. Tiles go from their
// owners straight to the displays. Each display writes what it shows. The bezels hide pixels, so the outline of a ball
// that crosses one is not bent.
//   mpirun -n 4 wall    writes wall_0.ppm to wall_3.ppm
#include "ball.hpp"

#include <dfb/dfb.hpp>

#include <cstdint>
#include <cstdio>
#include <exception>
#include <string>
#include <vector>

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    dfb::WallLayout layout;
    layout.columns = layout.rows = 2;
    layout.displayWidth = 240;
    layout.displayHeight = 180;
    layout.bezelX = layout.bezelY = 12;
    for (int display = 0; display < layout.displayCount(); ++display)
        layout.ranks.push_back(display % mpi.size());

    // The framebuffer and the wall share a connection. The wall must outlive the framebuffer.
    const auto connection = dfb::connect<dfb::MpiTransport>(mpi.communicator());
    dfb::DisplayWall wall(connection, layout, dfb::OutputFormat::SRGBA8);
    dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::ToWall> fb(connection, wall.frameBufferConfig(), {&wall});

    std::vector<dfb::Brick> mine;
    for (int ball = fb.rank(); ball < 8; ball += fb.size())
        mine.push_back({static_cast<std::uint32_t>(ball), example::ballOf(ball).bounds()});
    const dfb::World world(mine);
    const dfb::PerspectiveCamera camera({0, 1, 8}, {0, 0, 0}, {0, 1, 0}, 35);
    dfb::DataParallelLoop loop(fb, world);
    const dfb::FrameReport report = loop.render(camera, [&](const dfb::Brick& brick, auto& tile) {
        const example::Ball ball = example::ballOf(static_cast<int>(brick.id));
        tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
            renderBall(ball, camera.eye(), camera.direction(x + 0.5, y + 0.5, layout.width(), layout.height()), rgba,
                       depth);
        });
    });
    wall.finish(report.frame); // now all displays can show it

    for (int display = 0; display < layout.displayCount(); ++display)
        if (layout.ranks[static_cast<std::size_t>(display)] == fb.rank())
            dfb::writePpm("wall_" + std::to_string(display) + ".ppm", wall.image(display));
} catch (const std::exception& e) {
    std::fprintf(stderr, "wall: %s\n", e.what());
    return 1;
}
