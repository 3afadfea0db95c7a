// ImageParallel: each tile is rendered once per pass, by some rank (Listing 2 of the paper).
#pragma once

#include <dfb/ops/sort_last.hpp>

#include <utility>

DFB_NAMESPACE_BEGIN

// Expects one input per pass, of generation 0 and without children; others make the frame fail. Lays it over the
// background, and averages the passes. Channels beside colour travel only if the image has them.
template <int TileSize = 64, ChannelMask Channels = colorChannel | depthChannel>
class BasicImageParallel : public detail::SortLast<BlendRule::InOrder, TileSize, Channels> {
public:
    void add(Fragment&& fragment)
    {
        if (fragment.header().generation != 0 || fragment.header().children != 0)
            detail::failArgument("an image-parallel tile is of generation 0 and has no children, this one is of "
                                 "generation %d and has %d",
                                 fragment.header().generation, fragment.header().children);
        detail::SortLast<BlendRule::InOrder, TileSize, Channels>::add(std::move(fragment));
    }
};

// BasicImageParallel, with tiles of 64 x 64 pixels.
using ImageParallel = BasicImageParallel<>;
static_assert(is_tile_op_v<ImageParallel>);

DFB_NAMESPACE_END
