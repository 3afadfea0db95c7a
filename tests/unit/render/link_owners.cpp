// LinkOwners: owners of tiles that keep the traffic on the links between nodes low.
#include <dfb/render/link_owners.hpp>

#include "catch.hpp"

#include <algorithm>
#include <cstddef>
#include <limits>
#include <numeric>
#include <random>
#include <utility>
#include <vector>

namespace {

using dfb::detail::LinkOwners;

// The owners of an image of tiles of 16x16 pixels whose columns `pixelsOf(rank)` come from each rank.
template <class ColumnsOf>
std::vector<int> ownersOf(LinkOwners& links, int ranks, const dfb::TileLayout& layout, int displayRank,
                          const ColumnsOf& columnsOf)
{
    links.start(layout);
    for (int rank = 0; rank < ranks; ++rank) {
        const auto [x0, x1] = columnsOf(rank);
        for (int tile = 0; tile < layout.tileCount(); ++tile)
            if (const dfb::Region pixels = dfb::intersection(layout.region(tile), {x0, 0, x1, layout.height()});
                !pixels.empty())
                links.add(tile, pixels, rank);
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

TEST_CASE("The owner of a tile is on the node that makes the links' squares grow least", "[link_owners]")
{
    // The greedy rule, written down plainly. Depending on the seed, a node has up to 3 ranks, and ranks have up to all
    // of the image.
    for (unsigned seed = 0; seed < 40; ++seed) {
        CAPTURE(seed);
        std::mt19937 random(seed);
        const auto below = [&](int end) { return static_cast<int>(random() % static_cast<unsigned>(end)); };
        const int ranks = 2 + below(9), perNode = 1 + below(3);
        std::vector<int> nodeOf;
        for (int rank = 0; rank < ranks; ++rank)
            nodeOf.push_back(below(2) == 0 ? rank / perNode * perNode : rank % ((ranks + perNode - 1) / perNode));
        for (int rank = 0; rank < ranks; ++rank) // the number of a node is that of its lowest rank
            nodeOf[static_cast<std::size_t>(rank)] = static_cast<int>(
                std::find(nodeOf.begin(), nodeOf.end(), nodeOf[static_cast<std::size_t>(rank)]) - nodeOf.begin());
        const dfb::TileLayout layout(80, 64, 16);
        const auto tiles = static_cast<std::size_t>(layout.tileCount());
        std::vector<std::vector<double>> pixels(tiles, std::vector<double>(static_cast<std::size_t>(ranks)));
        LinkOwners links(nodeOf);
        links.start(layout);
        for (int rank = 0; rank < ranks; ++rank) {
            const int x0 = below(80), y0 = below(64);
            const dfb::Region part{x0, y0, x0 + 1 + below(80 - x0), y0 + 1 + below(64 - y0)};
            for (std::size_t t = 0; t < tiles; ++t) {
                const dfb::Region r = dfb::intersection(layout.region(static_cast<int>(t)), part);
                if (r.empty())
                    continue;
                links.add(static_cast<int>(t), r, rank);
                pixels[t][static_cast<std::size_t>(rank)] += double(r.width()) * r.height();
            }
        }
        dfb::FrameBufferConfig config(80, 64);
        config.image.displayRank = below(ranks);
        const int display = nodeOf[static_cast<std::size_t>(config.image.displayRank)];
        std::vector<double> in(nodeOf.size()), out(nodeOf.size());
        const auto carry = [&](std::size_t t, int node, double sign) {
            double sum = 0;
            for (std::size_t rank = 0; rank < nodeOf.size(); ++rank) {
                sum += pixels[t][rank];
                if (nodeOf[rank] != node) {
                    out[static_cast<std::size_t>(nodeOf[rank])] += sign * 16 * pixels[t][rank];
                    in[static_cast<std::size_t>(node)] += sign * 16 * pixels[t][rank];
                }
            }
            if (node != display) {
                const double finished = 4 * std::min(sum, 256.0);
                out[static_cast<std::size_t>(node)] += sign * finished;
                in[static_cast<std::size_t>(display)] += sign * finished;
            }
        };
        const auto squares = [&] {
            return std::inner_product(in.begin(), in.end(), in.begin(), 0.0)
                   + std::inner_product(out.begin(), out.end(), out.begin(), 0.0);
        };
        const std::vector<int> owners = *links.find(config, false, [](int) { return -1; });
        std::vector<int> placed(tiles, -1);
        for (const bool isSecond : {false, true})
            for (std::size_t t = 0; t < tiles; ++t) {
                const double sum = std::accumulate(pixels[t].begin(), pixels[t].end(), 0.0);
                if (sum == 0)
                    continue;
                if (isSecond)
                    carry(t, placed[t], -1);
                // Of nodes that are as good, the first is taken: that of the display rank, then by rank.
                std::vector<int> nodes{display};
                for (std::size_t rank = 0; rank < nodeOf.size(); ++rank)
                    if (pixels[t][rank] > 0)
                        nodes.push_back(nodeOf[rank]);
                double least = std::numeric_limits<double>::infinity();
                for (const int node : nodes) {
                    carry(t, node, 1);
                    if (const double cost = squares(); cost < least) {
                        placed[t] = node;
                        least = cost;
                    }
                    carry(t, node, -1);
                }
                carry(t, placed[t], 1);
            }
        for (std::size_t t = 0; t < tiles; ++t)
            CHECK((owners[t] < 0 ? -1 : nodeOf[static_cast<std::size_t>(owners[t])]) == placed[t]);
    }
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
