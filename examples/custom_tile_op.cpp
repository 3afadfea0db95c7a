// A tile operation of your own, without a renderer. It shows a field on three levels of refinement, as in simulations
// with adaptive meshes. Patches are spread over all ranks. Each patch announces how many finer patches refine it,
// whichever ranks have those: the patches of level l are generation l in the tree of a tile's inputs. The operation
// keeps the finest value of each pixel, and drops the rest.
//   mpirun -n 4 custom_tile_op        writes custom_tile_op.ppm, and compares it with the field as one process sees it

#include <dfb/dfb.hpp>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <iostream>
#include <memory>
#include <vector>

constexpr int width = 640, height = 448, levels = 3;
constexpr int patchSize[levels] = {64, 32, 16}, cellSize[levels] = {16, 4, 1}; // pixels

class FinestLevel {
public:
    static constexpr int tileSize = patchSize[0];
    static constexpr dfb::ChannelMask channels = dfb::colorChannel;

    void newFrame(const dfb::TileInfo& info)
    {
        images_.newFrame(info);
        level_.assign(images_.count(), -1);
    }

    void add(dfb::Fragment&& fragment) // the fragments come in any order
    {
        const int pass = fragment.header().pass, level = fragment.header().generation;
        fragment.forEachPixel([&](int x, int y, const float* rgba, float) {
            const std::size_t pixel = images_.index(pass, x, y);
            if (level <= level_[pixel])
                return;
            level_[pixel] = level;
            std::copy_n(rgba, 4, images_.pixel(pixel));
        });
    }

    void finish(dfb::FinishedTile& out) { images_.finish(out); }

private:
    dfb::PassImages images_;
    std::vector<int> level_; // level of the value that each pixel has
};
static_assert(dfb::is_tile_op_v<FinestLevel>);

// The field: a spiral wave that gets finer towards the middle.
double field(double x, double y)
{
    const double u = x - width / 2.0, v = y - height / 2.0, r = std::hypot(u, v);
    return std::exp(-r / 120) * std::sin(600 / (r + 12) + 2 * std::atan2(v, u));
}

// Patch (i, j) of a level exists if the field varies too much in it for the next coarser level.
bool exists(int level, int i, int j)
{
    if (level == 0)
        return true;
    if (!exists(level - 1, i / 2, j / 2))
        return false;
    double lowest = 1, highest = -1;
    for (int y = 0; y <= 4; ++y)
        for (int x = 0; x <= 4; ++x) {
            const double value = field((i + x / 4.0) * patchSize[level], (j + y / 4.0) * patchSize[level]);
            lowest = std::min(lowest, value), highest = std::max(highest, value);
        }
    return highest - lowest > 0.2;
}

// The colour of a pixel on a level is that of the middle of its cell.
void colorOf(int level, int x, int y, float* rgba)
{
    const int cell = cellSize[level];
    const auto value = static_cast<float>(field((x / cell + 0.5) * cell, (y / cell + 0.5) * cell));
    rgba[0] = std::max(value, 0.0f);
    rgba[1] = 0.1f + 0.2f * static_cast<float>(level);
    rgba[2] = std::max(-value, 0.0f);
    rgba[3] = 1;
}

int main(int argc, char** argv)
{
    dfb::MpiSession mpi(argc, argv);
    using FrameBuffer = dfb::DistributedFrameBuffer<FinestLevel>;
    FrameBuffer fb(mpi.communicator(), {width, height, dfb::OutputFormat::SRGBA8});
    dfb::FrameConfig params;
    params.timeout = std::chrono::milliseconds(10000); // if an announced patch does not come by then, it is an error
    auto frame = fb.begin(params);
    const auto tile = std::make_unique<FrameBuffer::Tile>();
    frame.guard([&] { // an exception comes out of end(), on all ranks
        for (int level = 0; level < levels; ++level)
            for (int j = 0; j < height / patchSize[level]; ++j)
                for (int i = 0; i < width / patchSize[level]; ++i) {
                    if ((3 * i + 5 * j + level) % fb.size() != fb.rank() || !exists(level, i, j))
                        continue; // another rank has it
                    const int perTile = patchSize[0] / patchSize[level];
                    frame.start(*tile, j / perTile * (width / patchSize[0]) + i / perTile);
                    tile->generation = level;
                    tile->part = static_cast<std::uint16_t>(j % perTile * perTile + i % perTile);
                    for (int child = 0; child < 4 && level + 1 < levels; ++child)
                        tile->children += exists(level + 1, 2 * i + child % 2, 2 * j + child / 2);
                    tile->forEachPixel([&](int x, int y, float* rgba) {
                        if (x / patchSize[level] == i && y / patchSize[level] == j)
                            colorOf(level, x, y, rgba);
                    });
                    frame.setTile(*tile);
                }
    });
    frame.end();
    if (!fb.isDisplayRank())
        return 0;

    dfb::writePpm("custom_tile_op.ppm", fb.image());
    constexpr int finest = patchSize[levels - 1];
    std::vector<int> shown; // the level that each patch of the finest size shows
    for (int j = 0; j < height / finest; ++j)
        for (int i = 0; i < width / finest; ++i) {
            int level = levels - 1;
            while (!exists(level, i * finest / patchSize[level], j * finest / patchSize[level]))
                --level;
            shown.push_back(level);
        }
    int wrong = 0;
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            const std::uint8_t* pixel = fb.image().rgba8() + 4 * (y * width + x);
            float rgba[4];
            std::byte expected[4];
            colorOf(shown[static_cast<std::size_t>(y / finest * (width / finest) + x / finest)], x, y, rgba);
            dfb::convertPixels(rgba, 1, dfb::OutputFormat::SRGBA8, expected);
            wrong += std::memcmp(pixel, expected, 4) != 0;
        }
    std::cout << "wrote custom_tile_op.ppm; " << wrong << " pixels differ from the field as one process sees it\n";
    return wrong != 0;
}
