// A volume renderer on GPUs, with OpenCL. Each rank has some bricks of the volume, the orbital of an electron. Its GPU
// renders them in bands, one row of tiles after the other, and copies each band to main memory as soon as it is done.
// The tiles of a band are composited while the GPU renders the next one. With CUDA or HIP the program would look alike.
//   mpirun -n 4 gpu_volume       writes gpu_volume.ppm
// OpenCL also runs on processors: on Debian install pocl-opencl-icd.
#define CL_HPP_ENABLE_EXCEPTIONS
#define CL_HPP_MINIMUM_OPENCL_VERSION 120
#define CL_HPP_TARGET_OPENCL_VERSION 120
#include <CL/opencl.hpp>
#include <dfb/dfb.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace {

constexpr int width = 480, height = 360;
constexpr float angle = 36; // of view

using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend>;

// One work item marches along the ray of a pixel, through a brick. All bricks take samples at the same distances from
// the eye, so the seams between them cannot be seen. `corner` is the way to the upper left corner of the image; `right`
// and `down` lead from pixel to pixel.
const char* const source = R"(
float orbital(float3 p)
{
    return p.z * (p.x * p.x - p.y * p.y) * exp(-length(p)) * (1 - 0.08f * length(p));
}

kernel void render(float4 lower, float4 upper, float4 eye, float4 corner, float4 right, float4 down,
                   int x0, int y0, int pitch, global float4* colors, global float* depths)
{
    const int x = get_global_id(0), y = get_global_id(1), at = y * pitch + x;
    const float3 way = normalize((corner + (x0 + x + 0.5f) * right + (y0 + y + 0.5f) * down).xyz);
    const float3 a = (lower.xyz - eye.xyz) / way, b = (upper.xyz - eye.xyz) / way;
    const float3 first = fmin(a, b), last = fmax(a, b);
    const float enter = fmax(fmax(first.x, first.y), fmax(first.z, 0.0f)), leave = fmin(fmin(last.x, last.y), last.z);
    float4 color = 0;
    float depth = INFINITY;
    const float step = 0.06f;
    const bool hits = enter < leave;
    for (int i = hits ? (int)(enter / step) : 0; hits && i * step < leave && color.w < 0.999f; ++i) {
        if (i * step < enter) // a sample on the common face of two bricks belongs to the one behind
            continue;
        const float psi = orbital(eye.xyz + i * step * way);
        const float alpha = 1 - exp(-step * 8 * psi * psi);
        const float3 hue = psi > 0 ? (float3)(1, 0.55f, 0.15f) : (float3)(0.2f, 0.55f, 1);
        if (alpha > 0 && depth == INFINITY)
            depth = i * step;
        color += (1 - color.w) * alpha * (float4)(hue, 1);
    }
    colors[at] = color;
    depths[at] = depth;
}
)";

cl_float4 toFloat4(const dfb::Vec3& v) { return {{v.x, v.y, v.z, 0}}; }

// A GPU of this node. Its ranks take turns to choose one.
cl::Device deviceFor(const FrameBuffer& fb)
{
    const auto nodes = fb.nodeOf().begin();
    const auto before = std::count(nodes, nodes + fb.rank(), nodes[fb.rank()]); // ranks of this node
    std::vector<cl::Platform> platforms;
    try {
        cl::Platform::get(&platforms);
    } catch (const cl::Error&) { // there is none
    }
    for (const cl_device_type type : {cl_device_type{CL_DEVICE_TYPE_GPU}, cl_device_type{CL_DEVICE_TYPE_ALL}})
        for (const cl::Platform& platform : platforms) {
            std::vector<cl::Device> devices;
            try {
                platform.getDevices(type, &devices);
            } catch (const cl::Error&) { // of this driver; others may work
            }
            if (!devices.empty())
                return devices[static_cast<std::size_t>(before) % devices.size()];
        }
    throw std::runtime_error("OpenCL finds no device; on Debian install pocl-opencl-icd");
}

// The pixels of a brick.
struct Picture {
    dfb::Region region;             // whole tiles
    cl::Buffer colors, depths;      // on the GPU
    dfb::Buffer memory;             // for the copy: all colours, then all depths
    std::map<int, cl::Event> bands; // by their first row: when the copy is done

    std::size_t pixelCount() const { return static_cast<std::size_t>(region.width()) * std::size_t(region.height()); }
    std::size_t indexOf(int x, int y) const
    {
        return static_cast<std::size_t>(y - region.y0) * std::size_t(region.width()) + std::size_t(x - region.x0);
    }
    float* colorAt(std::size_t index) { return reinterpret_cast<float*>(memory.data()) + 4 * index; }
    float* depthAt(std::size_t index) { return colorAt(pixelCount()) + index; }
};

class Renderer {
public:
    Renderer(FrameBuffer& fb, const dfb::World& world)
        : fb_(fb), world_(world), loop_(fb, world), device_(deviceFor(fb)), context_(device_), work_(context_, device_),
          copies_(context_, device_), program_(context_, source)
    {
        program_.build(device_, "-cl-std=CL1.2");
        kernel_ = cl::Kernel(program_, "render");
    }
    ~Renderer() { clFinish(copies_()); } // as in start(), without an exception

    void render(const dfb::PerspectiveCamera& camera)
    {
        start(camera);
        const auto find = [&](const dfb::Brick& brick, auto& view) {
            Picture& picture = pictures_.at(brick.id);
            picture.bands.at(view.region.y0).wait();
            const std::size_t first = picture.indexOf(view.region.x0, view.region.y0);
            view.color = picture.colorAt(first);
            view.depth = picture.depthAt(first);
            view.stride = picture.region.width();
            view.staysUntilEnd = true; // the pixels do not change until loop_.render() returns
        };
        loop_.render(camera, dfb::inPlace(find));
    }

private:
    // Tells the GPU to render all bricks and to copy their pixels. Does not wait for it.
    void start(const dfb::PerspectiveCamera& camera)
    {
        copies_.finish(); // after a frame that failed it may still copy
        pictures_.clear();
        for (const dfb::Brick& brick : world_.bricks())
            pictures_[brick.id] = pictureOf(camera.project(brick.bounds, width, height).region());
        for (int y = 0; y < height; y += fb_.layout().tileHeight())
            for (const dfb::Brick& brick : world_.bricks())
                startBand(brick, camera, y);
    }

    // An application with many frames keeps the memory from frame to frame.
    Picture pictureOf(const dfb::Region& pixels) const
    {
        const dfb::TileLayout& layout = fb_.layout();
        const dfb::Region tiles = layout.tilesIn(pixels);
        Picture picture;
        picture.region = {tiles.x0 * layout.tileWidth(), tiles.y0 * layout.tileHeight(),
                          std::min(tiles.x1 * layout.tileWidth(), width),
                          std::min(tiles.y1 * layout.tileHeight(), height)};
        if (pixels.empty())
            return picture;
        const std::size_t count = picture.pixelCount();
        picture.colors = cl::Buffer(context_, CL_MEM_WRITE_ONLY, 16 * count);
        picture.depths = cl::Buffer(context_, CL_MEM_WRITE_ONLY, 4 * count);
        picture.memory = fb_.sharedMemory(20 * count); // other ranks of the node read it there
        return picture;
    }

    void startBand(const dfb::Brick& brick, const dfb::PerspectiveCamera& camera, int y)
    {
        Picture& picture = pictures_.at(brick.id);
        const dfb::Region band =
            intersection(picture.region, {0, y, width, std::min(y + fb_.layout().tileHeight(), height)});
        if (band.empty())
            return;
        const float scale = 2 * std::tan(angle * 3.14159265f / 360) / height;
        const dfb::Vec3 right = scale * camera.right(), down = -scale * camera.up(),
                        corner = camera.forward() - 0.5f * width * right - 0.5f * height * down;
        int argument = 0;
        for (const dfb::Vec3& v : {brick.bounds.lower, brick.bounds.upper, camera.eye(), corner, right, down})
            kernel_.setArg(argument++, toFloat4(v));
        for (const int number : {picture.region.x0, picture.region.y0, picture.region.width()})
            kernel_.setArg(argument++, number);
        kernel_.setArg(argument++, picture.colors);
        kernel_.setArg(argument++, picture.depths);
        std::vector<cl::Event> rendered(1);
        work_.enqueueNDRangeKernel(kernel_, cl::NDRange(0, std::size_t(y - picture.region.y0)),
                                   cl::NDRange(std::size_t(band.width()), std::size_t(band.height())), cl::NullRange,
                                   nullptr, &rendered[0]);
        work_.flush();
        const std::size_t first = picture.indexOf(band.x0, y), count = std::size_t(band.width() * band.height());
        // Some drivers wait here, as OpenCL cannot register memory that it has not allocated. CUDA can.
        copies_.enqueueReadBuffer(picture.colors, CL_FALSE, 16 * first, 16 * count, picture.colorAt(first), &rendered);
        copies_.enqueueReadBuffer(picture.depths, CL_FALSE, 4 * first, 4 * count, picture.depthAt(first), nullptr,
                                  &picture.bands[y]);
        copies_.flush();
    }

    FrameBuffer& fb_;
    const dfb::World& world_;
    dfb::DataParallelLoop<FrameBuffer> loop_;
    std::map<std::uint32_t, Picture> pictures_; // by the id of the brick
    cl::Device device_;
    cl::Context context_;
    cl::CommandQueue work_, copies_; // a GPU can do both at once
    cl::Program program_;
    cl::Kernel kernel_;
};

// Eight bricks, dealt out to the ranks.
dfb::World bricksOf(int rank, int rankCount)
{
    constexpr float size = 9;
    std::vector<dfb::Brick> bricks;
    for (int id = rank; id < 8; id += rankCount) {
        const dfb::Vec3 lower{id & 1 ? 0 : -size, id & 2 ? 0 : -size, id & 4 ? 0 : -size};
        bricks.push_back({static_cast<std::uint32_t>(id), {lower, lower + dfb::Vec3{size, size, size}}});
    }
    return dfb::World(std::move(bricks));
}

} // namespace

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    FrameBuffer fb(mpi.communicator(), {width, height, dfb::OutputFormat::SRGBA8});
    const dfb::World world = bricksOf(fb.rank(), fb.size());
    Renderer renderer(fb, world);
    renderer.render(dfb::PerspectiveCamera({16, 9, 22}, {0, 0, 0}, {0, 1, 0}, angle));
    if (fb.isDisplayRank())
        dfb::writePpm("gpu_volume.ppm", fb.image());
} catch (const cl::Error& e) {
    std::fprintf(stderr, "gpu_volume: OpenCL: %s fails with error %d\n", e.what(), e.err());
    return 1;
} catch (const std::exception& e) {
    std::fprintf(stderr, "gpu_volume: %s\n", e.what());
    return 1;
}
