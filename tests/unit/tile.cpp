// Tile: what a renderer writes is there, also where a compiler would drop it. Compiled at -O2.
#include "catch.hpp"

#include <dfb/tile.hpp>

#include <memory>

namespace tile_cases {

namespace {

using Tile = dfb::Tile<dfb::colorChannel | dfb::depthChannel, 64>;

// GCC 12.2 at -O2 takes this for a function without effects if it knows how the two arrays lie to each other.
[[gnu::noinline]] void paint(Tile& tile, float depth)
{
    tile.forEachPixel([&](int, int, float* rgba, float& z) {
        rgba[3] = 0.5f;
        z = depth;
    });
}

bool isPainted(float depth)
{
    const auto tile = std::make_unique<Tile>();
    tile->region = {0, 0, 64, 64};
    tile->clear();
    paint(*tile, depth);
    return tile->color[4 * 63 + 3] > 0.0f && tile->depth[63] == depth;
}

} // namespace

TEST_CASE("What a function paints that is not inlined stays", "[tile]") { CHECK(isPainted(2)); }

} // namespace tile_cases
