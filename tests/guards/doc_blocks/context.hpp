// Declares what the blocks of code in docs/ assume; see docs/recipes.md. Only the operations are run.
#pragma once

#include <dfb/dfb.hpp>

#include <dfb/testing/tile_op_test.hpp>
#include <dfb/trace_file.hpp>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <memory>
#include <optional>
#include <string>
#include <tuple>
#include <vector>

namespace doc {

struct RenderPixel {
    void operator()(const dfb::Brick&, const dfb::Vec3&, float*, float&) const {}
    void operator()(const dfb::Brick&, const dfb::Ray&, float*, float&) const {}
    void operator()(int, int, float*, float&) const {}
};
struct RenderTile {
    template <class Tile>
    void operator()(Tile&) const
    {
    }
    template <class Tile>
    void operator()(const dfb::Brick&, Tile&) const
    {
    }
};

struct Gpu {
    void start(const dfb::PerspectiveCamera&);
    void waitForRow(std::uint32_t id, int y);
    int width() const;
    const float *color(std::uint32_t id, int x, int y) const, *depth(std::uint32_t id, int x, int y) const;
    dfb::Region copiedRegion(std::uint32_t id) const;
};

extern Gpu gpu;
extern MPI_Comm communicator;
extern dfb::World world;
extern dfb::PerspectiveCamera camera;
extern dfb::WallLayout layout;
extern dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb;
extern int width, height;
extern std::vector<dfb::Box3> allBounds;
extern std::vector<std::uint8_t> pixels;
extern std::vector<float> depths;
extern const RenderPixel renderPixel;
extern const RenderTile renderTile, renderBrick;
void show(const dfb::Image&);
void handleEvents();

} // namespace doc

#pragma GCC diagnostic ignored "-Wshadow" // a block may have an fb of its own
