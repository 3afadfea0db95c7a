// A program that a user builds from the documentation alone: finished images become one picture; a user's operation and
// loop; a viewer that polls; another size; an orthographic camera. Exits with 0 if all work, with any number of ranks.
#include <dfb/dfb.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

constexpr int width = 200, height = 120;

void expect(bool right, const char* what)
{
    if (!right)
        throw std::runtime_error(std::string("wrong: ") + what);
}

// As from OpenGL: 8 bits, the lowest row first, depth from 0 to 1. Rank r covers the lowest 10 (r + 1) rows at depth
// 1 / (r + 2), so a higher rank is in front.
void finishedImages(MPI_Comm communicator, int rank, int size)
{
    const std::size_t covered = static_cast<std::size_t>(width) * 10 * static_cast<std::size_t>(rank + 1);
    std::vector<std::uint8_t> pixels(4 * width * height, 0);
    std::vector<float> depths(width * height, 1.0f);
    std::fill_n(pixels.begin(), 4 * covered, static_cast<std::uint8_t>(255 - rank));
    std::fill_n(depths.begin(), covered, 1.0f / static_cast<float>(rank + 2));

    dfb::ImageCompositor compositor(communicator, dfb::ImageBlend::Nearest, {width, height});
    dfb::InputImage mine(pixels.data(), depths.data());
    mine.bottomUp = true;
    mine.farDepth = 1;
    compositor.composite(mine);
    if (compositor.isDisplayRank()) {
        const std::uint8_t* lowest = compositor.image().rgba8() + 4 * width * (height - 1);
        expect(lowest[0] == 256 - size, "the front image does not show in the lowest row");
        expect(compositor.image().rgba8()[0] == 0, "an image upside down");
    }
}

// The brightest red of all inputs.
class Brightest {
public:
    static constexpr dfb::ChannelMask channels = dfb::colorChannel;

    void newFrame(const dfb::TileInfo& info) { images_.newFrame(info); }
    void add(dfb::Fragment&& fragment)
    {
        fragment.forEachPixel([&](int x, int y, const float* rgba, float) {
            double* pixel = images_.pixel(images_.index(fragment.header().pass, x, y));
            if (static_cast<double>(rgba[0]) > pixel[0])
                std::copy_n(rgba, 4, pixel);
        });
    }
    void finish(dfb::FinishedTile& out) { images_.finish(out); }

private:
    dfb::PassImages images_;
};

// Each rank sends an input for each tile; `fails`: the last rank's renderer throws.
void ownLoop(dfb::DistributedFrameBuffer<Brightest>& fb, bool fails)
{
    auto frame = fb.begin();
    frame.forEachTile(fb.ownedTiles(), [&](auto& tile) {
        tile.children = fb.size();
        frame.setTile(tile);
    });
    frame.forEachTile(fb.layout().tileCount(), [&](std::int64_t index, auto& tile) {
        frame.start(tile, static_cast<int>(index));
        tile.generation = 1;
        tile.source = static_cast<std::uint32_t>(fb.rank());
        if (fails && fb.rank() == fb.size() - 1 && index == 2)
            throw std::runtime_error("no data on disk");
        tile.forEachPixel([&](int, int, float* rgba) {
            rgba[0] = static_cast<float>(fb.rank() + 1) / static_cast<float>(fb.size());
            rgba[3] = 1;
        });
        frame.setTile(tile);
    });
    frame.end();
}

void ownOperationAndLoop(MPI_Comm communicator)
{
    dfb::DistributedFrameBuffer<Brightest> fb(communicator, {width, height});
    for (const bool fails : {false, true, false}) {
        std::string text;
        try {
            ownLoop(fb, fails);
        } catch (const dfb::FrameError& e) {
            text = e.what();
        }
        expect(fails == (text.find("no data on disk") != std::string::npos), "the exception of a renderer");
        if (fb.isDisplayRank() && !fails)
            expect(fb.image().rgba8()[0] == 255, "the brightest input does not show");
    }
}

// Ranks have boxes beside each other from left to right; the camera looks along -z without perspective.
void viewer(MPI_Comm communicator)
{
    dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb(communicator, {width, height});
    const auto rank = static_cast<float>(fb.rank()), size = static_cast<float>(fb.size());
    const float left = -1 + 2 * rank / size, right = -1 + 2 * (rank + 1) / size;
    const dfb::World world({{static_cast<std::uint32_t>(fb.rank()), {{left, -1, -1}, {right, 1, 1}}}});
    const float view[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, -5, 1};
    const float projection[16] = {1, 0, 0, 0, 0, 0.5f, 0, 0, 0, 0, -0.1f, 0, 0, 0, 0, 1}; // x in [-1, 1], y in [-2, 2]
    const dfb::MatrixCamera camera(view, projection);
    dfb::DataParallelLoop loop(fb, world);
    const auto show = [&](int w, int h) {
        auto frame = loop.start(camera, [&](const dfb::Brick& brick, auto& tile) {
            tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
                const dfb::Ray ray = camera.ray(x + 0.5, y + 0.5, w, h);
                const bool meets = ray.origin.x >= brick.bounds.lower.x && ray.origin.x < brick.bounds.upper.x
                                   && ray.origin.y >= -1 && ray.origin.y < 1;
                if (meets)
                    rgba[1] = rgba[3] = 1, depth = ray.origin.z - 1;
            });
        });
        while (!frame.tryEnd()) { // a window would handle its events here
        }
        if (!fb.isDisplayRank())
            return;
        for (int y = 0; y < h; ++y)
            for (int x = 0; x < w; ++x)
                expect(fb.image().rgba8()[4 * (y * w + x) + 1] == (y >= h / 4 && y < h - h / 4 ? 255 : 0),
                       "a pixel of the boxes");
    };
    show(width, height);
    fb.resize(320, 64);
    show(320, 64);
}

} // namespace

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    finishedImages(mpi.communicator(), mpi.rank(), mpi.size());
    ownOperationAndLoop(mpi.communicator());
    viewer(mpi.communicator());
    if (mpi.rank() == 0)
        std::puts("ok");
} catch (const std::exception& e) {
    std::fprintf(stderr, "door: %s\n", e.what());
    return 1;
}
