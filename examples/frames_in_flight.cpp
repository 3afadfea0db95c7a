// Several frames at once: while the last tiles of a frame are composited, the next one is rendered. The pictures show
// glass balls that turn around the middle.
//   mpirun -n 4 frames_in_flight    writes turn_00.ppm to turn_07.ppm
#include "ball.hpp"

#include <dfb/dfb.hpp>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <deque>
#include <exception>
#include <string>
#include <vector>

namespace {

constexpr int width = 320, height = 240, frames = 8;

} // namespace

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    dfb::FrameBufferConfig config(width, height, dfb::OutputFormat::SRGBA8);
    config.framesInFlight = 2;
    dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb(mpi.communicator(), config);
    std::vector<dfb::Brick> mine;
    for (int ball = fb.rank(); ball < 8; ball += fb.size())
        mine.push_back({static_cast<std::uint32_t>(ball), example::ballOf(ball).bounds()});
    const dfb::World world(mine);
    dfb::DataParallelLoop loop(fb, world);

    std::deque<decltype(fb)::Frame> open;
    const auto endOldest = [&] {
        const dfb::FrameReport report = open.front().end();
        open.pop_front();
        if (fb.isDisplayRank()) // the image is there until its memory is needed again
            dfb::writePpm("turn_0" + std::to_string(report.frame - 1) + ".ppm", fb.image());
    };
    for (int number = 0; number < frames; ++number) {
        if (open.size() == 2)
            endOldest();
        const float angle = 6.2831853f * static_cast<float>(number) / frames;
        const dfb::PerspectiveCamera camera({8 * std::sin(angle), 1, 8 * std::cos(angle)}, {0, 0, 0}, {0, 1, 0}, 35);
        open.push_back(loop.start(camera, [&](const dfb::Brick& brick, auto& tile) {
            const example::Ball ball = example::ballOf(static_cast<int>(brick.id));
            tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
                renderBall(ball, camera.eye(), camera.direction(x + 0.5, y + 0.5, width, height), rgba, depth);
            });
        }));
        open.back().isDone(); // this rank has set all tiles of the frame: others need not wait until it calls end()
    }
    while (!open.empty())
        endOldest();
} catch (const std::exception& e) {
    std::fprintf(stderr, "frames_in_flight: %s\n", e.what());
    return 1;
}
