// Every rank has the whole scene. Tiles are handed out to the ranks on demand, because some take much longer than
// others. A pixel operation runs on the owners of finished tiles, and darkens the corners of the image. The picture
// shows the Mandelbrot set.
//   mpirun -n 4 image_parallel    writes image_parallel.ppm

#include <dfb/dfb.hpp>

#include <cmath>
#include <complex>
#include <cstdio>
#include <exception>

namespace {

constexpr int width = 600, height = 400;

// The pixel operation. It runs once for each finished tile, on several tiles at once, and may change all their pixels.
struct Vignette {
    void process(dfb::PixelTile& tile) const
    {
        float* rgba = tile.color;
        for (int y = tile.region.y0; y < tile.region.y1; ++y)
            for (int x = tile.region.x0; x < tile.region.x1; ++x, rgba += 4) {
                const float u = static_cast<float>(2 * x - width) / width,
                            v = static_cast<float>(2 * y - height) / height;
                for (int c = 0; c < 3; ++c)
                    rgba[c] *= 1 - 0.35f * (u * u + v * v);
            }
    }
};

void renderPixel(int x, int y, float* rgba)
{
    const std::complex<double> c(-0.745 + 0.012 * (x - width / 2) / width, 0.113 + 0.008 * (y - height / 2) / height);
    std::complex<double> z = 0;
    int steps = 0;
    for (; steps < 1000 && std::norm(z) < 256; ++steps)
        z = z * z + c;
    rgba[3] = 1;
    if (steps == 1000)
        return;
    const double smooth = 0.03 * (steps - std::log2(std::log(std::norm(z))));
    for (int channel = 0; channel < 3; ++channel)
        rgba[channel] = static_cast<float>(0.5 - 0.5 * std::cos(smooth + 0.7 * channel));
}

} // namespace

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    dfb::DistributedFrameBuffer<dfb::ImageParallel, Vignette> fb(mpi.communicator(),
                                                                 {width, height, dfb::OutputFormat::SRGBA8});
    dfb::ImageParallelLoop loop(fb, dfb::WorkDistribution::Dynamic);
    loop.render(
        [](auto& tile) { tile.forEachPixel([](int x, int y, float* rgba, float&) { renderPixel(x, y, rgba); }); });
    if (fb.isDisplayRank())
        dfb::writePpm("image_parallel.ppm", fb.image());
} catch (const std::exception& e) {
    std::fprintf(stderr, "image_parallel: %s\n", e.what());
    return 1;
}
