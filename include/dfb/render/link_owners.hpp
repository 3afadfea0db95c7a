// LinkOwners: picks owners for the tiles of a frame, so that few bytes go from node to node, and no link carries many
// more than the others.
#pragma once

#include <dfb/base/function_ref.hpp>
#include <dfb/compiled.hpp>
#include <dfb/frame.hpp>
#include <dfb/image.hpp>
#include <dfb/tile_layout.hpp>
#include <dfb/wire/wire_format.hpp>

#include <algorithm>
#include <cstddef>
#include <memory>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// All ranks call the same members with the same values, and get the same owners: no message is needed. Keeps its memory
// from frame to frame. find() returns the same list as long as no owner changes. For each frame, call start(), then
// add() for all pixels that some rank has, then find().
class LinkOwners {
public:
    // `nodeOf`: for each rank, the lowest rank of its node.
    explicit LinkOwners(const std::vector<int>& nodeOf)
        : nodeOf_(nodeOf), ranksOf_(nodeOf.size()), links_(nodeOf.size()), fromNode_(nodeOf.size()),
          work_(nodeOf.size())
    {
        for (std::size_t rank = 0; rank < nodeOf.size(); ++rank)
            ranksOf_[static_cast<std::size_t>(nodeOf[rank])].push_back(static_cast<int>(rank));
    }

    // On one node all ranks are equally near to the pixels.
    bool isOneNode() const { return ranksOf_.front().size() == nodeOf_.size(); }

    void start(const TileLayout& layout)
    {
        layout_ = layout;
        parts_.clear();
        tiles_.assign(static_cast<std::size_t>(layout.tileCount()), {});
    }

    // Some pixels of a tile come from this rank. Takes the least memory if the ranks of a node come one after the
    // other, as in byNode().
    void add(int tile, const Region& pixels, int rank)
    {
        Tile& to = tiles_[static_cast<std::size_t>(tile)];
        if (to.last != none && part(to.last).node == nodeOf(rank)) {
            part(to.last).pixels += areaOf(pixels);
            return;
        }
        const int added = static_cast<int>(parts_.size());
        parts_.push_back({nodeOf(rank), none, areaOf(pixels)});
        (to.last == none ? to.first : part(to.last).next) = added;
        to.last = added;
    }

    // All ranks, node by node.
    const std::vector<std::vector<int>>& byNode() const { return ranksOf_; }

    // Returns the owner of each tile. `hasDepth`: whether inputs have depth. `elsewhere(tile)` gives the owners of
    // tiles without pixels.
    TileOwners find(const FrameBufferConfig& config, bool hasDepth, FunctionRef<int(int)> elsewhere);

private:
    static constexpr int none = -1;
    struct Part { // the pixels of a tile that come from a node; a node may have several parts
        int node = 0, next = none;
        double pixels = 0;
    };
    struct Tile {
        int first = none, last = none; // of its parts
        int node = none;               // of its owner
    };
    struct Link { // the bytes into and out of a node
        double in = 0, out = 0;
    };

    static double areaOf(const Region& r) { return static_cast<double>(r.width()) * static_cast<double>(r.height()); }
    int nodeOf(int rank) const { return nodeOf_[static_cast<std::size_t>(rank)]; }
    Link& linkOf(int node) { return links_[static_cast<std::size_t>(node)]; }
    double& fromNode(int node) { return fromNode_[static_cast<std::size_t>(node)]; }

    Part& part(int i) { return parts_[static_cast<std::size_t>(i)]; }

    void place(Tile& tile, double area);

    // Adds the bytes of the tile in from_ to the links' loads, if its owner is on `node`; with sign -1, takes them
    // away.
    void carry(int node, double input, double finished, int sign)
    {
        for (const int source : from_)
            if (source != node)
                linkOf(source).out += sign * fromNode(source);
        linkOf(node).in += sign * (input - fromNode(node));
        if (node != displayNode_) {
            linkOf(node).out += sign * finished;
            linkOf(displayNode_).in += sign * finished;
        }
    }
    // How much the square of a load grows with these bytes.
    static double growth(double load, double bytes) { return bytes * (2 * load + bytes); }

    int leastBusy(const Tile& tile);

    std::vector<int> nodeOf_;
    std::vector<std::vector<int>> ranksOf_; // of each node
    TileLayout layout_;
    double inputBytes_ = 0, imageBytes_ = 0; // bytes of a pixel: to the owner, and to the display rank
    int displayNode_ = 0;
    std::vector<Part> parts_;
    std::vector<Tile> tiles_;
    std::vector<Link> links_;      // of each node
    std::vector<int> from_;        // the nodes from which a tile's inputs come, and that of the display rank
    std::vector<double> fromNode_; // the bytes of these inputs from each node
    std::vector<double> work_;     // pixels that each rank has to blend
    std::vector<int> owners_;      // of each tile
    TileOwners last_;
};

#if DFB_HAS_BODIES
DFB_COMPILED_ONCE TileOwners LinkOwners::find(const FrameBufferConfig& config, bool hasDepth,
                                              FunctionRef<int(int)> elsewhere)
{
    const ImageConfig& image = config.image;
    inputBytes_ = 4.0 * static_cast<double>(bytesOf(config.precision.color)) + 4 * (hasDepth || image.depth);
    imageBytes_ = static_cast<double>(bytesPerPixel(image.format)) + 4 * image.depth;
    displayNode_ = nodeOf(image.displayRank);
    std::fill(links_.begin(), links_.end(), Link());
    std::fill(work_.begin(), work_.end(), 0.0);
    for (int sweep = 0; sweep < 2; ++sweep) // the second time, each tile is placed knowing all others
        for (int t = 0; t < layout_.tileCount(); ++t)
            if (Tile& tile = tiles_[static_cast<std::size_t>(t)]; tile.first != none)
                place(tile, areaOf(layout_.region(t)));
    owners_.clear();
    for (int t = 0; t < layout_.tileCount(); ++t) {
        const Tile& tile = tiles_[static_cast<std::size_t>(t)];
        owners_.push_back(tile.first != none ? leastBusy(tile) : elsewhere(t));
    }
    if (!last_ || *last_ != owners_)
        last_ = std::make_shared<const std::vector<int>>(owners_);
    return last_;
}

// Gives a tile of so many pixels to the node with which the sum of the squares of all links' loads is least. The node
// has pixels of the tile, or is that of the display rank.
DFB_COMPILED_ONCE void LinkOwners::place(Tile& tile, double area)
{
    double pixels = 0;
    from_.assign(1, displayNode_);
    for (int i = tile.first; i != none; i = part(i).next) {
        const auto [node, next, share] = part(i);
        if (node != displayNode_ && fromNode(node) == 0)
            from_.push_back(node);
        fromNode(node) += inputBytes_ * share;
        pixels += share;
    }
    const double input = inputBytes_ * pixels, finished = imageBytes_ * std::min(pixels, area);
    if (tile.node != none)
        carry(tile.node, input, finished, -1);
    double sent = 0; // how much the squares of what nodes send grow if each sends its inputs
    for (const int source : from_)
        sent += growth(linkOf(source).out, fromNode(source));
    tile.node = none;
    double least = 0;
    for (const int node : from_) {
        const Link& link = linkOf(node);
        double cost = sent - growth(link.out, fromNode(node)) + growth(link.in, input - fromNode(node));
        if (node != displayNode_)
            cost += growth(link.out, finished) + growth(linkOf(displayNode_).in, finished);
        if (tile.node == none || cost < least) {
            tile.node = node;
            least = cost;
        }
    }
    carry(tile.node, input, finished, 1);
    for (const int node : from_)
        fromNode(node) = 0;
}

// Returns the rank on the tile's node that has the fewest pixels to blend.
DFB_COMPILED_ONCE int LinkOwners::leastBusy(const Tile& tile)
{
    const auto& ranks = ranksOf_[static_cast<std::size_t>(tile.node)];
    const auto workOf = [this](int rank) -> double& { return work_[static_cast<std::size_t>(rank)]; };
    const int best = *std::min_element(ranks.begin(), ranks.end(), [&](int a, int b) { return workOf(a) < workOf(b); });
    for (int i = tile.first; i != none; i = part(i).next)
        workOf(best) += part(i).pixels;
    return best;
}
#endif

} // namespace detail
DFB_NAMESPACE_END
