// Loading what a rank holds of the scene.
#include "rank_scene.hpp"

#include "auto_look.hpp"
#include "brick_exchange.hpp"
#include "content_cut.hpp"
#include "generated.hpp"
#include "scene_files.hpp"

#include <algorithm>
#include <iterator>
#include <stdexcept>
#include <string>
#include <utility>

namespace example {

namespace {

// Collective. Throws std::runtime_error that names the file, the same on all ranks.
Scene makeScene(const Options& options, int brickCount, const Loaders& loaders)
{
    LookOf look;
    const std::string& transfer = options.look.transfer;
    if ((!transfer.empty() && transfer != "auto") || options.look.range || !options.look.isovalues.empty())
        look = [&](const VolumeSource& source) { return lookOf(source, options.look, loaders); };
    if (options.scene.front() == "synthetic")
        return syntheticScene(brickCount, options.seed, look);
    if (options.scene.front() == "demo")
        return demoScene(options.seed, look);
    Scene scene;
    const auto vec = [](const std::array<float, 3>& v) { return Vec3{v[0], v[1], v[2]}; };
    VoxelGrid grid;
    if (options.spacing)
        grid.spacing = vec(*options.spacing);
    if (options.origin)
        grid.origin = vec(*options.origin);
    for (const SceneFile& file : options.files)
        addFile(scene, file, options.fit, options.xyzFrame, loaders, grid,
                [&](const VolumeSource& source) { return lookOf(source, file.look, loaders); });
    return scene;
}

// Whether the scene is a body in computed tomography, which stands along z: by the usual convention its slices go from
// the feet to the head.
bool stands(const Scene& scene)
{
    return !scene.volumes.empty()
           && std::all_of(scene.volumes.begin(), scene.volumes.end(),
                          [](const VolumeObject& volume) { return volume.source.look.isTomography; });
}

// Whether to cut by content. For surfaces without secondary rays, a brick's work is the area that its box covers in the
// image, so equal boxes are best.
bool cutsByContent(const Options& options, const Scene& scene)
{
    if (options.cut != CutBy::Auto)
        return options.cut == CutBy::Content;
    return scene.grid[0] == 0 && (!scene.volumes.empty() || options.aoRays > 0 || options.shadows);
}

} // namespace

RankScene loadRankScene(const Options& options, const Loaders& loaders)
{
    const int rank = loaders.rank(), rankCount = loaders.size();
    const bool isImage = options.mode == Mode::Image;
    const int sceneBricks = options.bricks > 0 ? options.bricks : rankCount, brickCount = isImage ? 1 : sceneBricks;
    if (brickCount > mostCells / options.interleave)
        throw std::runtime_error("--interleave " + std::to_string(options.interleave) + " makes more than "
                                 + std::to_string(mostCells) + " cells of " + std::to_string(brickCount) + " bricks");
    Scene scene = makeScene(options, sceneBricks, loaders);
    RenderSettings settings = options;
    RankScene result{SceneInfo(scene), {}, {}, {}, scene.notes, {}};
    if (!settings.view.isUpGiven && stands(scene)) {
        settings.view.up = {0, 0, options.fit ? -1.0f : 1.0f};
        result.notes.push_back("this looks like computed tomography, with the last slice at the top: --up "
                               + std::string(options.fit ? "z" : "-z") + " turns it over");
    }
    result.view = settings.view;
    if (scene.volumes.empty())
        for (const auto& [option, isGiven] : {std::pair{"--transfer", !options.look.transfer.empty()},
                                              std::pair{"--range", options.look.range.has_value()},
                                              std::pair{"--isovalue", !options.look.isovalues.empty()}})
            if (isGiven)
                result.notes.push_back(std::string(option) + " is for volumes, and there are none");
    if (options.pathBounces > 0 && !scene.volumes.empty())
        result.notes.push_back(scene.meshes.empty() && scene.spheres.empty()
                                   ? "there is nothing to see: --path leaves volumes out, and there are no surfaces"
                                   : "--path leaves volumes out");
    frameCamera(result.info, settings, 0); // throws if there is none
    const float ghosts = ghostReach(result.info, settings);
    std::vector<Box> cells{scene.bounds};
    if (!isImage && cutsByContent(options, scene)) {
        const ContentCut cut(scene, result.info, settings, loaders);
        cells = loaders.gatherOf<Box>([&] { // the cells of rank 0 hold, in case other machines compute others
            return rank > 0 ? std::vector<Box>() : cut.cells(brickCount * options.interleave);
        });
    } else if (!isImage) {
        cells = cutScene(scene, brickCount * options.interleave);
    }
    const int copies = options.mode == Mode::Mixed ? std::min(options.replicate, rankCount) : 1;
    std::vector<Holders> holders;
    std::vector<Box> reaches;
    for (std::size_t c = 0; c < cells.size(); ++c) {
        const int brick = static_cast<int>(c) % brickCount;
        holders.push_back(isImage ? Holders{0, rankCount} : Holders{rankOfBrick(brick, brickCount, rankCount), copies});
        reaches.push_back(reachOf(scene, cells[c], ghosts));
    }
    std::vector<CellSurfaces> surfaces = exchangeBricks(scene, holders, reaches, loaders);
    for (int brick = 0; brick < brickCount; ++brick) {
        Box bounds;
        for (std::size_t c = static_cast<std::size_t>(brick); c < cells.size();
             c += static_cast<std::size_t>(brickCount))
            bounds.grow(cells[c]);
        result.bounds.push_back(bounds);
        const Holders& held = holders[static_cast<std::size_t>(brick)]; // those of all its cells
        if ((rank - held.first + rankCount) % rankCount >= held.count)
            continue;
        result.brickIds.push_back(static_cast<std::uint32_t>(brick));
        result.renderers.emplace_back();
        for (std::size_t c = static_cast<std::size_t>(brick); c < cells.size();
             c += static_cast<std::size_t>(brickCount)) {
            Brick loaded = loadBrick(scene, cells[c], ghosts);
            std::move(surfaces[c].meshes.begin(), surfaces[c].meshes.end(), std::back_inserter(loaded.meshes));
            std::move(surfaces[c].spheres.begin(), surfaces[c].spheres.end(), std::back_inserter(loaded.spheres));
            surfaces[c] = CellSurfaces();
            result.renderers.back().emplace_back(std::move(loaded), result.info, settings);
        }
    }
    return result;
}

} // namespace example
