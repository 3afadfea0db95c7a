// An existing ray tracer, Tachyon (package libtachyon-mt-0-dev), on the ranks of a job. Every rank has the whole scene.
// Each worker thread has a Tachyon scene of its own and renders the tiles that it gets, on demand. Each tile is
// rendered with its own camera frustum, and each sample moves the frustum by a part of a pixel. Tiles with edges get
// more samples.
//   mpirun -n 4 tachyon            writes tachyon.ppm
//   mpirun -n 4 tachyon --check    also compares a frame with the whole image as Tachyon alone renders it, bit for bit
#include "scene.hpp"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <exception>
#include <stdexcept>

namespace {

// The scene of this thread.
Scene& myScene()
{
    thread_local Scene scene;
    return scene;
}

// Renders a tile with Tachyon. `right` and `up` are as in Scene::render().
template <class Tile>
void renderTile(Tile& tile, double right = 0, double up = 0)
{
    const dfb::Region& part = tile.region;
    const float* pixels = myScene().render(part, right, up).data();
    tile.forEachPixel([&](int x, int y, float* rgba, float&) {
        std::copy_n(pixels + 3 * ((part.y1 - 1 - y) * part.width() + x - part.x0), 3, rgba);
        rgba[3] = 1;
    });
}

// Whether an image of one sample a pixel, made of the tiles of all ranks, equals the image of Tachyon alone, bit for
// bit.
bool isTachyonsImage(MPI_Comm communicator)
{
    dfb::DistributedFrameBuffer<dfb::ImageParallel> fb(communicator,
                                                       {imageWidth, imageHeight, dfb::OutputFormat::RGBA32F});
    dfb::ImageParallelLoop loop(fb, dfb::WorkDistribution::Dynamic);
    loop.render([](auto& tile) { renderTile(tile); });
    if (!fb.isDisplayRank())
        return true;
    const float* whole = myScene().render({0, 0, imageWidth, imageHeight}).data();
    const float* mine = fb.image().rgba32f();
    for (int y = 0; y < imageHeight; ++y)
        for (int x = 0; x < imageWidth; ++x, mine += 4)
            if (std::memcmp(mine, whole + 3 * ((imageHeight - 1 - y) * imageWidth + x), 3 * sizeof(float)) != 0)
                return false;
    return true;
}

} // namespace

int main(int argc, char** argv)
try {
    rt_initialize(nullptr, nullptr);
    dfb::MpiSession mpi(argc, argv);
    if (argc > 1 && std::strcmp(argv[1], "--check") == 0 && !isTachyonsImage(mpi.communicator()))
        throw std::runtime_error("the image is not Tachyon's");

    dfb::DistributedFrameBuffer<dfb::Progressive<dfb::ImageParallel>> fb(
        mpi.communicator(), {imageWidth, imageHeight, dfb::OutputFormat::SRGBA8});
    dfb::ImageParallelLoop loop(fb, dfb::WorkDistribution::Dynamic);
    dfb::SamplingConfig sampling;
    sampling.maxError = 0.01;
    sampling.firstSamples = 4;
    sampling.maxSamples = 32;
    dfb::AdaptiveSampler sampler(fb.layout(), sampling);
    while (!sampler.done())
        sampler.update(loop.render(
            [](auto& tile) {
                const double sample = tile.sample + 0.5; // spread by the golden ratio in two dimensions
                renderTile(tile, std::fmod(0.7548776662466927 * sample, 1) - 0.5,
                           std::fmod(0.5698402909980532 * sample, 1) - 0.5);
            },
            sampler.next()));
    if (fb.isDisplayRank()) {
        std::printf("%lld samples, %lld fewer than if all tiles had as many as the one that has most\n",
                    static_cast<long long>(sampler.samplesTaken()), static_cast<long long>(sampler.samplesSaved()));
        dfb::writePpm("tachyon.ppm", fb.image());
    }
} catch (const std::exception& e) {
    std::fprintf(stderr, "tachyon: %s\n", e.what());
    return 1;
}
