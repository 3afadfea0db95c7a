// Progressive rendering: a floor, a round lamp above it, and a ball between them. Each sample picks a point of the
// lamp, so the edge of the shadow is noisy. Frames accumulate until the error of each tile is small enough; tiles
// without noise are done at once. The picture shows a soft shadow.
//   mpirun -n 4 progressive    writes progressive.ppm and says how many samples were taken
#include "ball.hpp"

#include <dfb/dfb.hpp>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <exception>

namespace {

constexpr int width = 360, height = 270;

// A random number in [0, 1) that depends on its arguments only, so it is the same on every rank.
float randomOf(std::uint64_t pixel, std::uint64_t sample, std::uint64_t dimension)
{
    std::uint64_t h = (pixel * 4096 + sample) * 2 + dimension;
    for (int i = 0; i < 3; ++i)
        h = (h ^ h >> 31) * 0x9e3779b97f4a7c15u;
    return static_cast<float>(h >> 40) * 0x1p-24f;
}

} // namespace

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    dfb::DistributedFrameBuffer<dfb::Progressive<dfb::ImageParallel>> fb(mpi.communicator(),
                                                                         {width, height, dfb::OutputFormat::SRGBA8});
    const dfb::PerspectiveCamera camera({0, 4, 7}, {0, 0, 0}, {0, 1, 0}, 40);
    const example::Ball ball{{0, 1.2f, 0}, {1, 1, 1}, 0.8f};
    dfb::ImageParallelLoop loop(fb, dfb::WorkDistribution::RoundRobin);
    dfb::AdaptiveSampler sampler(fb.layout(), {0.01});
    int frames = 0;
    for (; !sampler.done(); ++frames)
        sampler.update(loop.render(
            [&](auto& tile) {
                const auto sample = static_cast<std::uint64_t>(tile.sample);
                tile.forEachPixel([&](int x, int y, float* rgba, float&) {
                    const dfb::Vec3 eye = camera.eye(), way = camera.direction(x + 0.5, y + 0.5, width, height);
                    const auto pixel = static_cast<std::uint64_t>(y * width + x);
                    float enter = 0, leave = 0;
                    rgba[3] = 1;
                    if (hits(ball, eye, way, enter, leave)) {
                        rgba[0] = 0.4f + 0.2f * (eye + enter * way - ball.center).y;
                        return;
                    }
                    if (way.y >= 0)
                        return; // above the horizon
                    const dfb::Vec3 floor = eye + (-eye.y / way.y) * way;
                    const float r = std::sqrt(randomOf(pixel, sample, 0)), a = 6.2831853f * randomOf(pixel, sample, 1);
                    const dfb::Vec3 toLamp = dfb::Vec3{-2 + r * std::cos(a), 5, 1 + r * std::sin(a)} - floor;
                    if (hits(ball, floor, normalize(toLamp), enter, leave) && enter > 0)
                        return;
                    rgba[0] = rgba[1] = rgba[2] = 20 / dot(toLamp, toLamp);
                });
            },
            sampler.next()));
    if (fb.isDisplayRank()) {
        std::printf("%d frames\n", frames);
        dfb::writePpm("progressive.ppm", fb.image());
    }
} catch (const std::exception& e) {
    std::fprintf(stderr, "progressive: %s\n", e.what());
    return 1;
}
