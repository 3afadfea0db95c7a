// LinkOwners: owners of tiles that keep the traffic on the links between nodes low.
#include <dfb/render/link_owners.hpp>

#include "catch.hpp"

#include <algorithm>
#include <cstddef>
#include <numeric>
#include <vector>

namespace {

using dfb::detail::LinkOwners;

// The owners of an image of tiles of 16x16 pixels whose columns `pixelsOf(rank)` come from each rank.
template <class ColumnsOf>
std::vector<int> ownersOf(LinkOwners& links, int ranks, const dfb::TileLayout& layout, int displayRank,
                          const ColumnsOf& columnsOf)
{
    std::vector<int> all(static_cast<std::size_t>(ranks));
    std::iota(all.begin(), all.end(), 0);
    links.start(layout);
    for (int rank = 0; rank < ranks; ++rank) {
        const auto [x0, x1] = columnsOf(rank);
        for (int tile = 0; tile < layout.tileCount(); ++tile)
            if (const dfb::Region pixels = dfb::intersection(layout.region(tile), {x0, 0, x1, layout.height()});
                !pixels.empty())
                links.add(tile, pixels, &all[static_cast<std::size_t>(rank)], 1);
    }
    dfb::FrameBufferConfig config(layout.width(), layout.height());
    config.image.displayRank = displayRank;
    return *links.find(config, false, [](int) { return 1000; });
}

} // namespace

TEST_CASE("A tile with pixels of one rank belongs to it, on whatever node", "[link_owners]")
{
    LinkOwners links({0, 1, 2, 3});
    CHECK(!links.isOneNode());
    const dfb::TileLayout layout(64, 48, 16);
    for (const int displayRank : {0, 3}) {
        const auto owners = ownersOf(links, 4, layout, displayRank, [](int rank) {
            return std::pair(16 * rank, 16 * rank + (rank == 2 ? 0 : 16)); // nobody has the third column
        });
        for (int tile = 0; tile < layout.tileCount(); ++tile)
            CHECK(owners[static_cast<std::size_t>(tile)] == (layout.column(tile) == 2 ? 1000 : layout.column(tile)));
    }
}

TEST_CASE("A tile belongs to the node with most of its pixels, if all links are equally loaded", "[link_owners]")
{
    LinkOwners links({0, 1});
    const dfb::TileLayout layout(16, 16, 16);
    for (int split = 0; split <= 16; ++split) {
        const auto owners = ownersOf(links, 2, layout, 0,
                                     [&](int rank) { return rank == 0 ? std::pair(0, split) : std::pair(split, 16); });
        // 16 bytes a pixel of an input. 4 of a finished one, which goes to rank 0 anyway if rank 0 is the owner: the
        // squares of what goes over the two links are (16 (16 - split))^2 twice, or (16 split)^2 twice and 64^2 twice.
        const int toRank0 = 2 * (16 * (16 - split)) * (16 * (16 - split)),
                  toRank1 = 2 * (16 * split) * (16 * split) + 2 * 64 * 64;
        CAPTURE(split);
        CHECK(owners.front() == (toRank0 <= toRank1 ? 0 : 1));
    }
}

TEST_CASE("Ranks of one node share its tiles, and one node needs no owners", "[link_owners]")
{
    LinkOwners two({0, 0, 0, 3, 3});
    const dfb::TileLayout layout(160, 160, 16);
    const auto owners = ownersOf(two, 5, layout, 0, [](int rank) {
        return rank == 0 ? std::pair(0, 80) : rank == 3 ? std::pair(80, 160) : std::pair(0, 0);
    });
    std::vector<int> counts(5);
    for (const int owner : owners)
        ++counts[static_cast<std::size_t>(owner)];
    CHECK(counts == std::vector<int>{17, 17, 16, 25, 25});
    CHECK(LinkOwners({0, 0, 0}).isOneNode());
    CHECK(LinkOwners({0}).isOneNode());
}

TEST_CASE("No link has much more to carry than the others", "[link_owners]")
{
    // Every rank has pixels of the whole image: whoever owns a tile gets three inputs.
    LinkOwners links({0, 1, 2, 3});
    const dfb::TileLayout layout(320, 320, 16);
    const auto owners = ownersOf(links, 4, layout, 0, [](int) { return std::pair(0, 320); });
    std::vector<int> counts(4);
    for (const int owner : owners)
        ++counts[static_cast<std::size_t>(owner)];
    // Rank 0 gets 3 inputs (48 bytes a pixel) of its tiles, and what is finished (4 bytes) of the rest; it sends 16
    // bytes a pixel of the rest. So it owns somewhat less than the others, whose counts are alike.
    CHECK(counts[0] < counts[1]);
    CHECK(counts[0] > 80);
    CHECK(*std::max_element(counts.begin() + 1, counts.end()) - *std::min_element(counts.begin() + 1, counts.end())
          <= 1);
}
