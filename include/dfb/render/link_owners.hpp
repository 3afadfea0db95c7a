// LinkOwners: gives the tiles of a frame to ranks so that few bytes go from node to node, and no link carries many more
// than the others.
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
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// All ranks call the same members with the same values, and get the same owners: no message is needed. Keeps its memory
// from frame to frame; only owners that have changed are a new list. For each frame, call start(), then add() for all
// pixels that some rank has, then find().
class LinkOwners {
public:
    // `nodeOf`: for each rank, the lowest rank of its node.
    explicit LinkOwners(const std::vector<int>& nodeOf)
        : nodeOf_(nodeOf), ranksOf_(nodeOf.size()), links_(nodeOf.size()), work_(nodeOf.size())
    {
        for (std::size_t rank = 0; rank < nodeOf.size(); ++rank)
            ranksOf_[static_cast<std::size_t>(nodeOf[rank])].push_back(static_cast<int>(rank));
    }

    // On one node, any owner is as near to the pixels as another.
    bool isOneNode() const { return ranksOf_.front().size() == nodeOf_.size(); }

    void start(const TileLayout& layout)
    {
        layout_ = layout;
        found_.clear();
        first_.assign(static_cast<std::size_t>(layout.tileCount()) + 1, 0);
    }

    // Some pixels of a tile come from one of `rankCount` ranks; nobody knows from which. `ranks` must stay until
    // find().
    void add(int tile, const Region& pixels, const int* ranks, std::size_t rankCount)
    {
        found_.push_back({tile, ranks, rankCount, areaOf(pixels)});
        ++first_[static_cast<std::size_t>(tile) + 1];
    }

    // Returns the owner of each tile. `hasDepth`: whether inputs have depth. `elsewhere(tile)` gives the owners of
    // tiles without pixels.
    TileOwners find(const FrameBufferConfig& config, bool hasDepth, FunctionRef<int(int)> elsewhere);

private:
    struct Part {
        int tile = 0;
        const int* ranks = nullptr;
        std::size_t rankCount = 0;
        double pixels = 0;
    };
    struct Link { // the bytes into and out of a node
        double in = 0, out = 0;
    };

    static double areaOf(const Region& r) { return static_cast<double>(r.width()) * static_cast<double>(r.height()); }
    int nodeOf(int rank) const { return nodeOf_[static_cast<std::size_t>(rank)]; }
    Link& linkOf(int node) { return links_[static_cast<std::size_t>(node)]; }
    // The parts of a tile.
    const Part* begin(int tile) const { return parts_.data() + first_[static_cast<std::size_t>(tile)]; }
    const Part* end(int tile) const { return begin(tile + 1); }
    bool isAnywhere(int tile) const { return begin(tile) != end(tile); }

    void sortByTile();

    void place(int tile);

    void addFrom(int node, double bytes)
    {
        for (auto& [its, sum] : from_)
            if (its == node) {
                sum += bytes;
                return;
            }
        from_.emplace_back(node, bytes);
    }

    // Calls f(load, bytes) for each load of a link to which the inputs in from_ or the finished tile add bytes, if the
    // owner is on `node`.
    template <class F>
    void forEachLoad(int node, double finished, const F& f)
    {
        double in = 0;
        for (const auto& [source, bytes] : from_)
            if (source != node) {
                f(linkOf(source).out, bytes);
                in += bytes;
            }
        f(linkOf(node).in, in);
        if (node != displayNode_) {
            f(linkOf(node).out, finished);
            f(linkOf(displayNode_).in, finished);
        }
    }
    void carry(int node, double finished, int sign)
    {
        forEachLoad(node, finished, [sign](double& load, double bytes) { load += sign * bytes; });
    }
    // How much the sum of the squares of all loads grows with an owner on `node`.
    double costOf(int node, double finished)
    {
        double cost = 0;
        forEachLoad(node, finished, [&](double load, double bytes) { cost += bytes * (2 * load + bytes); });
        return cost;
    }

    int leastBusy(int tile);

    std::vector<int> nodeOf_;
    std::vector<std::vector<int>> ranksOf_; // of each node
    TileLayout layout_;
    double inputBytes_ = 0, imageBytes_ = 0; // bytes of a pixel: to the owner, and to the display rank
    int displayNode_ = 0;
    std::vector<Part> found_, parts_;          // parts_: tile by tile
    std::vector<std::size_t> first_, next_;    // for each tile, an index into parts_
    std::vector<std::pair<int, double>> from_; // nodes, and how many bytes of a tile come from each
    std::vector<Link> links_;                  // of each node
    std::vector<double> work_;                 // pixels that each rank has to blend
    std::vector<int> nodes_, owners_;          // of each tile
    TileOwners last_;
};

#if DFB_HAS_BODIES
DFB_COMPILED_ONCE TileOwners LinkOwners::find(const FrameBufferConfig& config, bool hasDepth,
                                              FunctionRef<int(int)> elsewhere)
{
    sortByTile();
    const ImageConfig& image = config.image;
    inputBytes_ = 4.0 * static_cast<double>(bytesOf(config.precision.color)) + 4 * (hasDepth || image.depth);
    imageBytes_ = static_cast<double>(bytesPerPixel(image.format)) + 4 * image.depth;
    displayNode_ = nodeOf(image.displayRank);
    std::fill(links_.begin(), links_.end(), Link());
    std::fill(work_.begin(), work_.end(), 0.0);
    nodes_.assign(static_cast<std::size_t>(layout_.tileCount()), -1);
    for (int sweep = 0; sweep < 2; ++sweep) // the second time, each tile is placed knowing all others
        for (int tile = 0; tile < layout_.tileCount(); ++tile)
            if (isAnywhere(tile))
                place(tile);
    owners_.clear();
    for (int tile = 0; tile < layout_.tileCount(); ++tile)
        owners_.push_back(isAnywhere(tile) ? leastBusy(tile) : elsewhere(tile));
    if (!last_ || *last_ != owners_)
        last_ = std::make_shared<const std::vector<int>>(owners_);
    return last_;
}

DFB_COMPILED_ONCE void LinkOwners::sortByTile()
{
    for (std::size_t tile = 1; tile < first_.size(); ++tile)
        first_[tile] += first_[tile - 1];
    parts_.resize(found_.size());
    next_ = first_;
    for (const Part& part : found_)
        parts_[next_[static_cast<std::size_t>(part.tile)]++] = part;
}

// Gives a tile to the node with which the sum of the squares of all links' loads is least. The node has pixels of the
// tile, or is that of the display rank.
DFB_COMPILED_ONCE void LinkOwners::place(int tile)
{
    double pixels = 0;
    from_.clear();
    addFrom(displayNode_, 0);
    for (const Part* part = begin(tile); part != end(tile); ++part) {
        pixels += part->pixels;
        for (std::size_t i = 0; i < part->rankCount; ++i)
            addFrom(nodeOf(part->ranks[i]), inputBytes_ * part->pixels / static_cast<double>(part->rankCount));
    }
    const double finished = imageBytes_ * std::min(pixels, areaOf(layout_.region(tile)));
    int& node = nodes_[static_cast<std::size_t>(tile)];
    if (node >= 0)
        carry(node, finished, -1);
    node = -1;
    double least = 0;
    for (const auto& from : from_)
        if (const double cost = costOf(from.first, finished); node < 0 || cost < least) {
            node = from.first;
            least = cost;
        }
    carry(node, finished, 1);
}

// Returns the rank on the tile's node that has the fewest pixels to blend.
DFB_COMPILED_ONCE int LinkOwners::leastBusy(int tile)
{
    const auto& ranks = ranksOf_[static_cast<std::size_t>(nodes_[static_cast<std::size_t>(tile)])];
    const auto workOf = [this](int rank) -> double& { return work_[static_cast<std::size_t>(rank)]; };
    const int best = *std::min_element(ranks.begin(), ranks.end(), [&](int a, int b) { return workOf(a) < workOf(b); });
    for (const Part* part = begin(tile); part != end(tile); ++part)
        workOf(best) += part->pixels;
    return best;
}
#endif

} // namespace detail
DFB_NAMESPACE_END
