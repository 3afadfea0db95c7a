// Composites finished images into one picture. Each rank has rendered some of four balls into an image of its own, as
// OpenGL gives it: 8 bits per channel, the lowest row first, depth from 0 to 1 with 1 where there is nothing. In the
// picture the balls intersect: every pixel shows the nearest one.
//
//   mpirun -n 4 finished_images [picture.ppm]
#include <dfb/dfb.hpp>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <vector>

namespace {

constexpr int width = 640, height = 480;

// Draws ball `number` into the image, in the form in which glReadPixels() would return it.
void renderBall(int number, std::vector<std::uint8_t>& pixels, std::vector<float>& depths)
{
    const float centerX = 190 + 85.0f * static_cast<float>(number % 4),
                centerY = 200 + 60.0f * static_cast<float>(number % 2);
    const float radius = 110, distance = 300 + 40.0f * static_cast<float>(number % 3);
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            const float dx = (static_cast<float>(x) - centerX) / radius,
                        dy = (static_cast<float>(y) - centerY) / radius;
            const float square = dx * dx + dy * dy;
            if (square >= 1)
                continue;
            const float towards = std::sqrt(1 - square); // component of the normal towards the viewer
            const auto i = static_cast<std::size_t>(y * width + x);
            const float depth = (distance - radius * towards) / 600;
            if (depth >= depths[i])
                continue;
            depths[i] = depth;
            const float light = 0.25f + 0.75f * std::fmax(0.0f, 0.5f * dy - 0.4f * dx + 0.75f * towards);
            for (int c = 0; c < 3; ++c)
                pixels[4 * i + static_cast<std::size_t>(c)] =
                    static_cast<std::uint8_t>((number + c) % 3 == 0 ? 255 * light : 110 * light);
            pixels[4 * i + 3] = 255;
        }
}

} // namespace

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    std::vector<std::uint8_t> pixels(4 * width * height, 0);
    std::vector<float> depths(width * height, 1.0f);
    for (int ball = mpi.rank(); ball < 4; ball += mpi.size())
        renderBall(ball, pixels, depths);

    dfb::ImageCompositor compositor(mpi.communicator(), dfb::ImageBlend::Nearest, {width, height});
    dfb::InputImage mine(pixels.data(), depths.data());
    mine.bottomUp = true;
    mine.farDepth = 1;
    dfb::FrameConfig frame;
    frame.background = {0.1f, 0.1f, 0.12f, 1};
    compositor.composite(mine, frame);
    if (compositor.isDisplayRank())
        dfb::writePpm(argc > 1 ? argv[1] : "finished_images.ppm", compositor.image());
} catch (const std::exception& e) {
    std::fprintf(stderr, "finished_images: %s\n", e.what());
    return 1;
}
