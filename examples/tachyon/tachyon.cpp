// A ray tracer that others wrote, on the ranks of a job: Tachyon (package libtachyon-mt-0-dev). Every rank has the
// whole scene. Each worker has a scene of Tachyon's to itself and renders the tiles that it is given, on demand. A tile
// is a camera frustum of its own, and a sample moves the frustum by a part of a pixel. Tiles with edges get more
// samples.
//   mpirun -n 4 tachyon            writes tachyon.ppm
//   mpirun -n 4 tachyon --check    also compares a frame with the whole image as Tachyon alone renders it: all bits
#include <dfb/dfb.hpp>

#include <tachyon.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <exception>
#include <memory>
#include <stdexcept>
#include <vector>

namespace {

constexpr int width = 480, height = 320;

// Tachyon's scene: a spiral of balls over a floor that mirrors them. Not for two threads at once.
class Scene {
public:
    Scene()
    {
        SceneHandle s = scene_.get();
        rt_set_numthreads(s, 1);
        rt_verbose(s, 0);
        rt_camera_projection(s, RT_PROJECTION_PERSPECTIVE);
        rt_camera_position(s, rt_vector(0, 5.2, -9), rt_vector(0, -0.5, 0.86), rt_vector(0, 1, 0));
        rt_camera_raydepth(s, 6);
        rt_background(s, rt_color(0.55, 0.7, 0.9));
        rt_light(s, material(1, 1, 1, 0), rt_vector(-6, 12, -8), 0.1);
        rt_plane(s, material(0.5, 0.5, 0.55, 0.25), rt_vector(0, 0, 0), rt_vector(0, 1, 0));
        for (int i = 0; i < 120; ++i) {
            const double turn = 0.26 * i, away = 0.3 + 0.035 * i, size = 0.12 + 0.0028 * i;
            void* skin = material(0.5 + 0.5 * std::cos(turn), 0.35, 0.5 + 0.5 * std::sin(0.7 * turn), 0.2);
            rt_sphere(s, skin, rt_vector(away * std::cos(turn), size, away * std::sin(turn)), size);
        }
    }

    // Renders pixels [x0, x1) x [y0, y1) of the image, sampled at so much of a pixel from its middle. Returns red,
    // green and blue of each; the first row is the lowest.
    const std::vector<float>& render(const dfb::Region& part, double right = 0, double up = 0)
    {
        // Exact in binary, so that the frustum of a tile has the very rays of the image's.
        const double pixel = 5.0 / 2048, middleX = width / 2.0 - right, middleY = height / 2.0 + up;
        pixels_.resize(3 * static_cast<std::size_t>(part.width()) * static_cast<std::size_t>(part.height()));
        rt_resolution(scene_.get(), part.width(), part.height());
        rt_camera_frustum(scene_.get(), (part.x0 - middleX) * pixel, (part.x1 - middleX) * pixel,
                          (middleY - part.y1) * pixel, (middleY - part.y0) * pixel);
        rt_rawimage_rgb96f(scene_.get(), pixels_.data());
        rt_renderscene(scene_.get());
        return pixels_;
    }

private:
    struct Delete {
        void operator()(void* scene) const { rt_deletescene(scene); }
    };

    void* material(double r, double g, double b, double mirror)
    {
        apitexture look{};
        look.texturefunc = RT_TEXTURE_CONSTANT;
        look.col = rt_color(r, g, b);
        look.shadowcast = 1;
        look.ambient = 0.15;
        look.diffuse = 0.75;
        look.specular = mirror;
        look.opacity = 1;
        return rt_texture(scene_.get(), &look);
    }

    std::unique_ptr<void, Delete> scene_{rt_newscene()};
    std::vector<float> pixels_;
};

// The scene of this thread.
Scene& myScene()
{
    thread_local Scene scene;
    return scene;
}

// Puts a part of the image as Tachyon renders it into a tile of that part.
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

// Whether one sample a pixel, put together from the tiles of all ranks, is Tachyon's own image, bit for bit.
bool isTachyonsImage(MPI_Comm communicator)
{
    dfb::DistributedFrameBuffer<dfb::ImageParallel> fb(communicator, {width, height, dfb::OutputFormat::RGBA32F});
    dfb::ImageParallelLoop loop(fb, dfb::WorkDistribution::Dynamic);
    loop.render([](auto& tile) { renderTile(tile); });
    if (!fb.isDisplayRank())
        return true;
    const float* whole = myScene().render({0, 0, width, height}).data();
    const float* mine = fb.image().rgba32f();
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x, mine += 4)
            if (std::memcmp(mine, whole + 3 * ((height - 1 - y) * width + x), 3 * sizeof(float)) != 0)
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

    dfb::DistributedFrameBuffer<dfb::Progressive<dfb::ImageParallel>> fb(mpi.communicator(),
                                                                         {width, height, dfb::OutputFormat::SRGBA8});
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
