// RankScene: what one rank holds of the scene that the command line asks for.
#pragma once

#include "loaders.hpp"
#include "options.hpp"
#include "renderer.hpp"

#include <algorithm>
#include <cstdint>
#include <vector>

namespace example {

struct RankScene {
    SceneInfo info;
    std::vector<std::uint32_t> brickIds; // of the bricks that this rank holds, ascending
    std::vector<Box> bounds;             // of all bricks, by brick id; in image mode one, the whole scene
    // For each of brickIds, one renderer per cell. A brick has one cell, or with --interleave several that are apart.
    std::vector<std::vector<Renderer>> renderers;
    Notes notes; // for the user, the same on all ranks
    View view;   // the user's; what it leaves open suits the scene

    const std::vector<Renderer>& of(std::uint32_t brickId) const
    {
        const auto found = std::lower_bound(brickIds.begin(), brickIds.end(), brickId);
        return renderers[static_cast<std::size_t>(found - brickIds.begin())];
    }
};

// Collective: each rank reads what it needs, and all come to the same cells. Throws std::runtime_error, on some ranks
// or all.
RankScene loadRankScene(const Options& options, const Loaders& loaders);

} // namespace example
