// Makes the pictures of the programs in C and Fortran with the C++ interface, to compare them:
//   mpirun -n 3 test_c_twin pictures FILE                as `test_c_pictures write FILE`
//   mpirun -n 3 test_c_twin minimal FILE                 as minimal_c
//   mpirun -n 3 test_c_twin heat FILES STEPS EVERY       as `heat STEPS EVERY`; FILES0000.ppm and so on
#include "scene.h"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

namespace {

using dfb::OutputFormat;

// ---- pictures.c

class Pictures {
public:
    Pictures(MPI_Comm communicator, const std::string& path) : communicator_(communicator)
    {
        MPI_Comm_rank(communicator, &rank_);
        MPI_Comm_size(communicator, &ranks_);
        if (rank_ == ranks_ - 1)
            file_.open(path, std::ios::binary);
        frame_.background = {0.125f, 0, 0.5f, 0.75f};
    }

    void writeAll()
    {
        for (int twice = 0; twice < 2; ++twice) {
            {
                dfb::ImageCompositor images(communicator_, dfb::ImageBlend::Nearest,
                                            configOf(OutputFormat::RGBA8, true));
                dfb::DistributedFrameBuffer<dfb::DepthComposite> bricks(communicator_,
                                                                        configOf(OutputFormat::RGBA8, true));
                compositeBytes(images);
                render(bricks);
                images.resize(other_width, other_height);
                bricks.resize(other_width, other_height);
                compositeBytes(images);
                render(bricks);
            }
            {
                dfb::ImageCompositor images(communicator_, dfb::ImageBlend::InOrder,
                                            configOf(OutputFormat::RGBA32F, false));
                scene_floats(rank_, scene_width, scene_height, floats_.data());
                images.composite(dfb::InputImage(floats_.data()), ranks_ - 1 - rank_, frame_);
                write(images.image());
            }
            {
                dfb::ImageCompositor images(communicator_, dfb::ImageBlend::ByDepth,
                                            configOf(OutputFormat::SRGBA8, false));
                scene_bytes(rank_, 100, 80, bytes_.data(), depths_.data());
                dfb::InputImage part(bytes_.data(), depths_.data());
                part.rowPixels = 100;
                part.isBgra = part.hasStraightAlpha = true;
                part.region = {10, 5, 100, 85};
                part.valid = {20, 15, 90, 200};
                images.composite(part, frame_);
                write(images.image());
                dfb::DistributedFrameBuffer<dfb::AlphaBlend> bricks(communicator_,
                                                                    configOf(OutputFormat::SRGBA8, false));
                render(bricks);
            }
            dfb::DistributedFrameBuffer<dfb::AlphaBlend> bricks(communicator_, configOf(OutputFormat::RGBA32F, true));
            render(bricks);
        }
    }

private:
    dfb::FrameBufferConfig configOf(OutputFormat format, bool depth) const
    {
        dfb::FrameBufferConfig config(scene_width, scene_height, format, depth);
        config.image.displayRank = ranks_ - 1;
        return config;
    }

    void compositeBytes(dfb::ImageCompositor& images)
    {
        scene_bytes(rank_, images.config().image.width, images.config().image.height, bytes_.data(), depths_.data());
        dfb::InputImage mine(bytes_.data(), depths_.data());
        mine.bottomUp = true;
        mine.farDepth = 1;
        images.composite(mine, frame_);
        write(images.image());
    }

    template <class FrameBuffer>
    void render(FrameBuffer& fb)
    {
        dfb::World world;
        for (int i = 0; i < 2; ++i) {
            float lower[3], upper[3];
            scene_bounds(rank_, i, lower, upper);
            world.add({static_cast<std::uint32_t>(2 * rank_ + i),
                       {{lower[0], lower[1], lower[2]}, {upper[0], upper[1], upper[2]}}});
        }
        float view[16], projection[16];
        std::transform(scene_view, scene_view + 16, view, [](double v) { return static_cast<float>(v); });
        std::transform(scene_projection, scene_projection + 16, projection,
                       [](double v) { return static_cast<float>(v); });
        dfb::DataParallelLoop loop(fb, world);
        loop.render(
            dfb::MatrixCamera(view, projection),
            [&](const dfb::Brick& brick, auto& tile) {
                scene_draw(brick.id, tile.region.x0, tile.region.y0, tile.region.x1, tile.region.y1,
                           fb.layout().width(), fb.layout().height(), tile.size, tile.color, tile.depth);
            },
            frame_);
        write(fb.image());
    }

    void write(const dfb::Image& image)
    {
        image.forEachPlane([this](const std::byte* bytes, std::size_t count) {
            file_.write(reinterpret_cast<const char*>(bytes), static_cast<std::streamsize>(count));
        });
    }

    MPI_Comm communicator_;
    int rank_ = 0, ranks_ = 1;
    std::ofstream file_; // of the display rank
    dfb::FrameConfig frame_;
    std::vector<std::uint8_t> bytes_ = std::vector<std::uint8_t>(4 * most_pixels);
    std::vector<float> floats_ = std::vector<float>(4 * most_pixels), depths_ = std::vector<float>(most_pixels);
};

// ---- minimal.c

void drawMinimal(MPI_Comm communicator, const std::string& path)
{
    dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb(communicator, {640, 320, OutputFormat::SRGBA8});
    const auto rank = static_cast<float>(fb.rank());
    const dfb::Vec3 center{rank - 1.5f, 0.3f * rank - 0.6f, -2 * rank}, half{1, 1, 1};
    const dfb::World world({{static_cast<std::uint32_t>(fb.rank()), {center - half, center + half}}});
    const float view[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, -8, 1};
    const float projection[16] = {0.25f, 0, 0, 0, 0, 0.5f, 0, 0, 0, 0, -0.1f, 0, 0, 0, -1, 1};
    dfb::DataParallelLoop loop(fb, world);
    loop.render(dfb::MatrixCamera(view, projection), [&](const dfb::Brick&, auto& tile) {
        tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
            const float dx = (static_cast<float>(x) + 0.5f) / 80 - 4 - center.x;
            const float dy = 2 - (static_cast<float>(y) + 0.5f) / 80 - center.y;
            const float inside = 1 - dx * dx - dy * dy;
            if (inside <= 0)
                return;
            const float way = std::sqrt(inside);
            rgba[0] = rgba[3] = 0.75f * way;
            rgba[1] = rgba[3] / (rank + 1);
            depth = 8 - (center.z + way);
        });
    });
    if (fb.isDisplayRank())
        dfb::writePpm(path, fb.image());
}

// ---- heat.f90

constexpr int n = 128; // cells along each side of the plate

// Rows first to last of the plate, counted from 1, with the row before and the one behind.
class Plate {
public:
    Plate(MPI_Comm communicator, int rank, int ranks)
        : communicator_(communicator), first(rank * n / ranks + 1), last((rank + 1) * n / ranks),
          below_(rank > 0 ? rank - 1 : MPI_PROC_NULL), above_(rank < ranks - 1 ? rank + 1 : MPI_PROC_NULL),
          heat_(static_cast<std::size_t>((n + 2) * (last - first + 3)))
    {
        heatPlaces();
    }

    float& at(int i, int j) { return heat_[index(i, j)]; }

    void exchangeRows()
    {
        MPI_Sendrecv(&at(0, last), n + 2, MPI_FLOAT, above_, 0, &at(0, first - 1), n + 2, MPI_FLOAT, below_, 0,
                     communicator_, MPI_STATUS_IGNORE);
        MPI_Sendrecv(&at(0, first), n + 2, MPI_FLOAT, below_, 1, &at(0, last + 1), n + 2, MPI_FLOAT, above_, 1,
                     communicator_, MPI_STATUS_IGNORE);
    }

    void advance()
    {
        exchangeRows();
        std::vector<float> next = heat_;
        for (int j = first; j <= last; ++j)
            for (int i = 1; i <= n; ++i)
                next[index(i, j)] =
                    at(i, j)
                    + 0.234375f * (((at(i - 1, j) + at(i + 1, j)) + (at(i, j - 1) + at(i, j + 1))) - 4 * at(i, j));
        heat_.swap(next);
        heatPlaces();
    }

private:
    std::size_t index(int i, int j) const { return static_cast<std::size_t>((j - first + 1) * (n + 2) + i); }

    void heatPlaces()
    {
        struct Disc {
            int x, y, radius;
            float temperature;
        };
        for (const Disc& d : {Disc{36, 44, 14, 1}, Disc{92, 36, 8, 0.875f}, Disc{60, 94, 11, 0.75f}})
            for (int j = first; j <= last; ++j)
                for (int i = 1; i <= n; ++i)
                    if ((i - d.x) * (i - d.x) + (j - d.y) * (j - d.y) <= d.radius * d.radius)
                        at(i, j) = d.temperature;
    }

    MPI_Comm communicator_;

public:
    const int first, last;

private:
    int below_, above_;
    std::vector<float> heat_;
};

template <class Tile>
void drawSlab(Plate& plate, Tile& tile)
{
    tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
        const float right = ((static_cast<float>(x) + 0.5f) / 240 - 1) / 1.75f;
        const float up = (1 - (static_cast<float>(y) + 0.5f) / 160) / 2.625f;
        const float way = 2.4f / (0.8f - 0.6f * up);
        const float u = (way * right + 1) * (n / 2), v = ((1.8f - way * (0.6f + 0.8f * up)) + 1) * (n / 2);
        if (u < 0 || u >= n || v < static_cast<float>(plate.first - 1) || v >= static_cast<float>(plate.last))
            return;
        const int i = static_cast<int>(u + 0.5f), j = static_cast<int>(v + 0.5f);
        const float fu = (u + 0.5f) - static_cast<float>(i), fv = (v + 0.5f) - static_cast<float>(j);
        const float t = (1 - fv) * ((1 - fu) * plate.at(i, j) + fu * plate.at(i + 1, j))
                        + fv * ((1 - fu) * plate.at(i, j + 1) + fu * plate.at(i + 1, j + 1));
        rgba[0] = std::min(1.0f, 0.02f + 2.5f * t);
        rgba[1] = 0.01f + t * t;
        rgba[2] = 0.02f + (t * t) * (t * t) * 0.75f;
        rgba[3] = 1;
        depth = way;
    });
}

void drawHeat(MPI_Comm communicator, const std::string& files, int steps, int every)
{
    dfb::DistributedFrameBuffer<dfb::DepthComposite> fb(communicator, {480, 320, OutputFormat::SRGBA8});
    Plate plate(communicator, fb.rank(), fb.size());
    const auto edge = [](int j) { return 2 * static_cast<float>(j - 1) / n - 1; };
    const dfb::World world(
        {{static_cast<std::uint32_t>(fb.rank()), {{-1, 0, edge(plate.first)}, {1, 0, edge(plate.last + 1)}}}});
    const float view[16] = {1, 0, 0, 0, 0, 0.6f, 0.8f, 0, 0, -0.8f, 0.6f, 0, 0, 0, -3, 1};
    const float projection[16] = {1.75f, 0, 0, 0, 0, 2.625f, 0, 0, 0, 0, -1, -1, 0, 0, -0.1f, 0};
    dfb::FrameConfig frame;
    frame.background = {0.01f, 0.012f, 0.02f, 1};
    dfb::DataParallelLoop loop(fb, world);
    for (int step = 1; step <= steps; ++step) {
        plate.advance();
        if (step % every != 0)
            continue;
        plate.exchangeRows();
        loop.render(
            dfb::MatrixCamera(view, projection), [&](const dfb::Brick&, auto& tile) { drawSlab(plate, tile); }, frame);
        char name[20];
        std::snprintf(name, sizeof name, "%04d.ppm", step / every - 1);
        if (fb.isDisplayRank())
            dfb::writePpm(files + name, fb.image());
    }
}

} // namespace

int main(int argc, char** argv)
{
    dfb::MpiSession mpi(argc, argv);
    const std::string what = argc > 2 ? argv[1] : "";
    if (what == "pictures")
        Pictures(mpi.communicator(), argv[2]).writeAll();
    else if (what == "minimal")
        drawMinimal(mpi.communicator(), argv[2]);
    else if (what == "heat" && argc > 4)
        drawHeat(mpi.communicator(), argv[2], std::atoi(argv[3]), std::atoi(argv[4]));
    else {
        std::cerr << "test_c_twin: see the top of its source\n";
        return 1;
    }
}
