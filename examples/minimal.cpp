// The shortest complete program: every rank has one brick with a glass ball in it; rank 0 writes the picture.
//   mpirun -n 4 minimal        writes minimal.ppm
#include <dfb/dfb.hpp>
#include <cmath>

int main(int argc, char** argv)
{
    dfb::MpiSession mpi(argc, argv);
    dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb(mpi.communicator(), {640, 320, dfb::OutputFormat::SRGBA8});
    const auto rank = static_cast<float>(fb.rank());
    const dfb::Vec3 center{rank - 1.5f, 0.3f * rank - 0.6f, -2 * rank}, half{1, 1, 1};
    const dfb::World world({{static_cast<std::uint32_t>(fb.rank()), {center - half, center + half}}});
    const dfb::PerspectiveCamera camera({0, 1, 8}, {0, 0, 0}, {0, 1, 0}, 30);
    dfb::DataParallelLoop loop(fb, world);
    loop.render(camera, [&](const dfb::Brick&, auto& tile) {
        tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
            const dfb::Vec3 way = center - camera.eye();
            const float middle = dot(camera.direction(x + 0.5, y + 0.5, 640, 320), way);
            const float inside = 1 - dot(way, way) + middle * middle; // half the chord through the ball, squared
            if (inside <= 0)
                return;
            rgba[0] = rgba[3] = 1 - std::exp(-std::sqrt(inside)); // premultiplied
            rgba[1] = rgba[3] / (rank + 1);
            depth = middle - std::sqrt(inside);
        });
    });
    if (fb.isDisplayRank())
        dfb::writePpm("minimal.ppm", fb.image());
}
