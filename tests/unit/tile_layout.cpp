// TileLayout and owner maps: every pixel is in one tile, and every tile has one owner.
#include "catch.hpp"

#include <dfb/tile_layout.hpp>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

namespace tile_layout_cases {

TEST_CASE("The tiles of a layout cover each pixel once", "[layout]")
{
    for (const auto& [width, height] : std::vector<std::pair<int, int>>{
             {1, 1}, {1, 37}, {37, 1}, {64, 64}, {65, 63}, {97, 61}, {509, 251}, {8, 8}, {256, 1}, {257, 255}})
        for (const auto& [tileWidth, tileHeight] :
             std::vector<std::pair<int, int>>{{8, 8}, {16, 16}, {64, 64}, {256, 256}, {97, 3}, {1, 40}}) {
            const dfb::TileLayout layout(width, height, tileWidth, tileHeight);
            std::vector<int> covered(static_cast<std::size_t>(width * height));
            bool sane = layout.tileCount() == layout.tilesX() * layout.tilesY();
            for (int tile = 0; tile < layout.tileCount(); ++tile) {
                const dfb::Region r = layout.region(tile);
                sane = sane && !r.empty() && r.width() <= tileWidth && r.height() <= tileHeight && r.x0 % tileWidth == 0
                       && r.y0 % tileHeight == 0 && layout.tileAt(layout.column(tile), layout.row(tile)) == tile;
                for (int y = r.y0; y < r.y1; ++y)
                    for (int x = r.x0; x < r.x1; ++x)
                        ++covered.at(static_cast<std::size_t>(y * width + x));
            }
            INFO(width << "x" << height << " in tiles of " << tileWidth << "x" << tileHeight);
            CHECK(sane);
            CHECK(std::all_of(covered.begin(), covered.end(), [](int count) { return count == 1; }));
        }
}

TEST_CASE("The largest images", "[layout]")
{
    const dfb::TileLayout wide(65536, 1, 64);
    CHECK(wide.tileCount() == 1024);
    CHECK(wide.region(1023) == dfb::Region{65472, 0, 65536, 1});
    const dfb::TileLayout all(65536, 65536, 8);
    CHECK(all.tileCount() == 8192 * 8192);
    CHECK(all.region(all.tileCount() - 1) == dfb::Region{65528, 65528, 65536, 65536});
    CHECK(dfb::TileLayout(65536, 65535, 2, 1).tileCount() == 32768 * 65535);
    CHECK_THROWS_AS(dfb::TileLayout(65536, 65536, 2, 1), dfb::InvalidArgument); // 2^31 tiles
    CHECK_THROWS_AS(dfb::TileLayout(65536, 65536, 1), dfb::InvalidArgument);
    for (const auto& [width, height] :
         std::vector<std::pair<int, int>>{{0, 5}, {5, 0}, {-1, 5}, {65537, 5}, {5, 65537}})
        CHECK_THROWS_AS(dfb::TileLayout(width, height, 64), dfb::InvalidArgument);
}

TEST_CASE("Tiles without pixels or larger than any image are refused", "[layout]")
{
    for (const auto& [width, height] :
         std::vector<std::pair<int, int>>{{0, 8}, {8, 0}, {-8, 8}, {65537, 8}, {8, 2147483647}})
        CHECK_THROWS_AS(dfb::TileLayout(5, 5, width, height), dfb::InvalidArgument);
}

TEST_CASE("tilesIn names exactly the tiles that meet a region", "[layout]")
{
    const dfb::TileLayout layout(45, 29, 8, 5);
    std::size_t wrong = 0;
    for (int x0 = -9; x0 < 50; x0 += 4)
        for (int y0 = -9; y0 < 36; y0 += 3)
            for (const int w : {0, 1, 7, 8, 9, 60})
                for (const int h : {0, 1, 8, 40}) {
                    const dfb::Region region{x0, y0, x0 + w, y0 + h};
                    const dfb::Region tiles = layout.tilesIn(region);
                    for (int tile = 0; tile < layout.tileCount(); ++tile) {
                        const bool meets = !dfb::intersection(layout.region(tile), region).empty();
                        wrong += meets != tiles.contains(layout.column(tile), layout.row(tile));
                    }
                }
    CHECK(wrong == 0);
}

TEST_CASE("Owner maps give every tile to a rank, evenly", "[layout]")
{
    for (const auto& [width, height] :
         std::vector<std::pair<int, int>>{{1, 1}, {7, 1}, {1, 9}, {97, 61}, {256, 256}, {1024, 768}})
        for (const int ranks : {1, 2, 3, 4, 5, 7, 8, 16, 61, 1000}) {
            const dfb::TileLayout layout(width, height, 8);
            INFO(width << "x" << height << ", " << ranks << " ranks");
            const auto spread = [&, wide = width](const dfb::OwnerMap& map) {
                (void)wide;
                std::vector<int> count(static_cast<std::size_t>(ranks));
                for (int tile = 0; tile < layout.tileCount(); ++tile)
                    ++count.at(static_cast<std::size_t>(map(tile, layout, ranks))); // throws if out of range
                const auto [least, most] = std::minmax_element(count.begin(), count.end());
                return std::make_pair(*least, *most);
            };
            const auto linear = spread(dfb::linearOwner);
            CHECK(linear.second - linear.first <= 1);
            // A row of the lattice goes round the ranks. So within a row one rank has at most one tile more than
            // another, and in all at most one for each row.
            const auto lattice = spread(dfb::latticeOwner);
            CHECK(lattice.second - lattice.first <= layout.tilesY());
            // A random scatter: counts are binomial, with mean m and deviation below sqrt(m). Allows 6 deviations, and
            // 6 more for small m.
            const auto hashed = spread(dfb::hashOwner);
            const double mean = static_cast<double>(layout.tileCount()) / ranks;
            CHECK(hashed.second <= mean + 6 * std::sqrt(mean) + 6);
            if (mean > 36)
                CHECK(hashed.first >= mean - 6 * std::sqrt(mean));
        }
}

TEST_CASE("The lattice gives neighbours to different ranks", "[layout]")
{
    const dfb::TileLayout layout(256, 256, 8);
    for (const int ranks : {2, 3, 4, 5, 7, 8, 16, 64}) {
        std::size_t same = 0;
        for (int row = 0; row + 1 < layout.tilesY(); ++row)
            for (int column = 0; column + 1 < layout.tilesX(); ++column) {
                const int here = dfb::latticeOwner(layout.tileAt(column, row), layout, ranks);
                same += here == dfb::latticeOwner(layout.tileAt(column + 1, row), layout, ranks);
                same += here == dfb::latticeOwner(layout.tileAt(column, row + 1), layout, ranks);
            }
        INFO(ranks << " ranks");
        CHECK(same == 0);
    }
}

} // namespace tile_layout_cases
