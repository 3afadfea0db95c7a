// RankScene: what one rank holds of the scene that the command line asks for.
#pragma once

#include "generated.hpp"
#include "options.hpp"
#include "renderer.hpp"

namespace example {

inline RenderSettings renderSettings(const Options& options)
{
    RenderSettings settings;
    settings.width = options.width;
    settings.height = options.height;
    settings.frames = options.frames;
    settings.passes = options.spp;
    settings.seed = options.seed;
    settings.opacity = options.opacity;
    settings.earlyTermination = options.earlyTermination;
    settings.view = options.view;
    return settings;
}

// Throws std::runtime_error that names the file.
inline Scene makeScene(const Options& options, int brickCount)
{
    if (options.scene.front() == "synthetic")
        return syntheticScene(brickCount, options.seed);
    if (options.scene.front() == "demo")
        return demoScene(options.seed);
    Scene scene;
    for (const std::string& path : options.scene)
        addFile(scene, path, options.fit);
    return scene;
}

struct RankScene {
    SceneInfo info;
    std::vector<Box> cells;              // of all bricks, by brick id; in image mode one, the whole scene
    std::vector<std::uint32_t> brickIds; // of the bricks that this rank holds, ascending
    std::vector<Renderer> renderers;     // one for each of brickIds
};

// Not collective: each rank reads what it needs, and all come to the same cells. Throws std::runtime_error.
inline RankScene loadRankScene(const Options& options, int rank, int rankCount)
{
    const int brickCount = options.bricks > 0 ? options.bricks : rankCount;
    const Scene scene = makeScene(options, brickCount);
    RankScene result{SceneInfo(scene), {}, {}, {}};
    if (options.mode == Mode::Image)
        result.cells = {scene.bounds};
    else
        result.cells = cutScene(scene, brickCount);
    const int count = static_cast<int>(result.cells.size());
    for (int brick = 0; brick < count; ++brick)
        if (options.mode == Mode::Image || rankOfBrick(brick, count, rankCount) == rank) {
            const std::uint32_t id = static_cast<std::uint32_t>(brick);
            result.brickIds.push_back(id);
            result.renderers.emplace_back(loadBrick(scene, id, result.cells[id]), result.info, renderSettings(options));
        }
    return result;
}

} // namespace example
