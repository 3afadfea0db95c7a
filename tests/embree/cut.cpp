// Cutting a scene into bricks: the cells tile the scene, a brick holds its part and no more, and the image shows
// neither the cuts nor who rendered what. Up to 14 ranks, which are threads.
#include "support.hpp"

#include <content_cut.hpp>
#include <generated.hpp>
#include <output.hpp>
#include <renderer.hpp>

#include <dfb/dfb.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <utility>
#include <vector>

namespace cut_cases {

namespace {

using example::Box;
using example::component;
using example::Index3;
using example::Scene;
using example::Vec3;

// ---- cells -----------------------------------------------------------------------------------------------------

int cellsWith(const std::vector<Box>& cells, const Vec3& p)
{
    return static_cast<int>(std::count_if(cells.begin(), cells.end(), [&](const Box& c) { return c.contains(p); }));
}

// The faces of all cells cut the bounds into blocks, each of which lies either wholly in a cell or wholly outside it.
// So it is enough to test the lower corners of the blocks.
void checkTiling(const std::vector<Box>& cells, const Box& bounds)
{
    std::set<float> planes[3];
    for (int axis = 0; axis < 3; ++axis)
        for (const Box& c : cells) {
            const float lower = component(c.lo, axis), upper = component(c.hi, axis);
            REQUIRE(lower < upper);
            planes[axis].insert({lower, upper});
        }
    for (int axis = 0; axis < 3; ++axis) {
        CHECK(*planes[axis].begin() == component(bounds.lo, axis));
        CHECK(*planes[axis].rbegin() == component(bounds.hi, axis));
    }
    int wrong = 0;
    for (const float x : planes[0])
        for (const float y : planes[1])
            for (const float z : planes[2]) {
                const Vec3 p{x, y, z};
                const bool inside = x < bounds.hi.x && y < bounds.hi.y && z < bounds.hi.z;
                wrong += cellsWith(cells, p) != (inside ? 1 : 0);
                // The last representable point below all three planes.
                const float least = -std::numeric_limits<float>::infinity();
                const Vec3 q{std::nextafter(x, least), std::nextafter(y, least), std::nextafter(z, least)};
                wrong += cellsWith(cells, q) != (bounds.contains(q) ? 1 : 0);
            }
    CHECK(wrong == 0);
}

Scene boxScene(const Vec3& lo, const Vec3& hi)
{
    Scene scene;
    std::vector<example::Sphere> corners(2);
    corners[0].center = lo;
    corners[1].center = hi;
    scene.add(corners, false);
    return scene;
}

// ---- images ----------------------------------------------------------------------------------------------------

struct Picture {
    std::vector<float> rgba, depth;
    dfb::FrameReport report;

    std::string hash() const { return example::hashPixels(rgba.data(), depth.size()); }
    double meanAlpha() const { return example::meanAlpha(rgba.data(), depth.size()); }
};

struct Run {
    int ranks = 1;
    int bricks = 1; // 0: image-parallel
    int threads = 1;
    dfb::OwnerMap ownerMap = dfb::latticeOwner;
    std::function<int(int brick, int bricks, int ranks)> rankOf = example::rankOfBrick;
    bool ghosts = true;
    bool byContent = false;
};

// A scene whose voxels are generated once, and not for each brick of each picture.
Scene kept(Scene scene)
{
    for (example::VolumeObject& volume : scene.volumes) {
        const example::Index3 dims = volume.source.info.dims;
        const auto width = static_cast<std::size_t>(dims[0]), height = static_cast<std::size_t>(dims[1]);
        const auto voxels =
            std::make_shared<std::vector<std::byte>>(width * height * static_cast<std::size_t>(dims[2]));
        volume.source.open()({0, 0, 0}, dims, voxels->data());
        volume.source.open = [=] {
            return [=](const example::Index3& lo, const example::Index3& hi, std::byte* out) {
                for (int z = lo[2]; z < hi[2]; ++z)
                    for (int y = lo[1]; y < hi[1]; ++y) {
                        const std::size_t row =
                            (static_cast<std::size_t>(z) * height + static_cast<std::size_t>(y)) * width;
                        out = std::copy(voxels->data() + row + lo[0], voxels->data() + row + hi[0], out);
                    }
            };
        };
    }
    return scene;
}

const Scene& keptDemo(std::uint64_t seed)
{
    static std::map<std::uint64_t, Scene> scenes;
    const auto found = scenes.find(seed);
    return found != scenes.end() ? found->second : scenes.emplace(seed, kept(example::demoScene(seed))).first->second;
}

Scene keptSynthetic(int brickCount) { return kept(example::syntheticScene(brickCount, 1)); }

std::vector<Box> cellsOf(const Scene& scene, const example::RenderSettings& settings, int count)
{
    return example::ContentCut(scene, example::SceneInfo(scene), settings).cells(count);
}

dfb::FrameBufferConfig configOf(const example::RenderSettings& settings, const Run& run)
{
    dfb::FrameBufferConfig config;
    config.image.width = settings.width;
    config.image.height = settings.height;
    config.image.format = dfb::OutputFormat::RGBA32F;
    config.image.depth = true;
    config.image.ownerMap = run.ownerMap;
    config.executor = std::make_shared<dfb::ThreadExecutor>(run.threads);
    return config;
}

// Renders with ranks that are threads, each with only its own bricks, as dfb_render does.
Picture render(const Scene& scene, const example::RenderSettings& settings, const Run& run)
{
    Picture picture;
    const auto keep = [&](const auto& fb, const dfb::FrameReport& report) {
        if (!fb.isDisplayRank())
            return;
        const dfb::Image& image = fb.image();
        picture.rgba.assign(image.rgba32f(), image.rgba32f() + 4 * image.pixelCount());
        picture.depth.assign(image.depth(), image.depth() + image.pixelCount());
        picture.report = report;
    };
    dfb::FrameConfig params;
    params.passes = settings.passes;
    const example::SceneInfo info(scene);
    dfb::runRanks(run.ranks, [&](dfb::InprocCommunicator communicator) {
        const dfb::FrameBufferConfig config = configOf(settings, run);
        if (run.bricks == 0) {
            dfb::DistributedFrameBuffer<dfb::ImageParallel, dfb::NoPixelOp, dfb::InprocTransport> fb(communicator,
                                                                                                     config);
            const example::Renderer renderer(loadBrick(scene, scene.bounds), info, settings);
            keep(fb, dfb::ImageParallelLoop(fb).render([&](auto& tile) { renderer.renderTile(tile, 0); }, params));
            return;
        }
        dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, dfb::InprocTransport> fb(communicator, config);
        const std::vector<Box> cells =
            run.byContent ? cellsOf(scene, settings, run.bricks) : cutScene(scene, run.bricks);
        dfb::World world;
        std::vector<std::unique_ptr<example::Renderer>> renderers(cells.size());
        for (std::uint32_t id = 0; id < cells.size(); ++id) {
            if (run.rankOf(static_cast<int>(id), run.bricks, run.ranks) != fb.rank())
                continue;
            const Box& c = cells[id];
            world.add({id, {{c.lo.x, c.lo.y, c.lo.z}, {c.hi.x, c.hi.y, c.hi.z}}});
            const float ghosts = run.ghosts ? ghostReach(info, settings) : 0;
            renderers[id] = std::make_unique<example::Renderer>(loadBrick(scene, c, ghosts), info, settings);
        }
        const example::FrameCamera camera = frameCamera(info, settings, 0);
        keep(fb, dfb::DataParallelLoop(fb, world).render(
                     camera, [&](const dfb::Brick& brick, auto& tile) { renderers[brick.id]->renderTile(tile, 0); },
                     params));
    });
    return picture;
}

float largestDifference(const std::vector<float>& a, const std::vector<float>& b)
{
    REQUIRE(a.size() == b.size());
    float largest = 0;
    for (std::size_t i = 0; i < a.size(); ++i)
        if (a[i] != b[i]) // infinite depths are equal; a NaN counts as infinitely far off
            largest = std::max(largest, std::isfinite(a[i] - b[i]) ? std::fabs(a[i] - b[i])
                                                                   : std::numeric_limits<float>::infinity());
    return largest;
}

void checkSame(const Picture& a, const Picture& b)
{
    CHECK(a.hash() == b.hash());
    CHECK(a.depth == b.depth);
}

// The tolerance is for cutting a ray's sum: some roundings of floats near 1.
void checkNoSeams(const Picture& a, const Picture& b)
{
    CHECK(largestDifference(a.rgba, b.rgba) <= 1e-6f);
    CHECK(a.depth == b.depth);
}

example::RenderSettings settingsOf(int width, int height)
{
    example::RenderSettings settings;
    settings.width = width;
    settings.height = height;
    settings.seed = 1;
    return settings;
}

// The scene looks the same, cut into these numbers of bricks and rendered by fewer ranks or by more.
void checkCuts(const Scene& scene, const example::RenderSettings& settings)
{
    const Picture whole = render(scene, settings, {1, 1});
    checkSame(render(scene, settings, {3, 0}), whole); // not cut in either case
    for (const auto& [bricks, ranks] : {std::pair(2, 3), {3, 2}, {5, 4}, {8, 3}}) {
        INFO(bricks << " bricks");
        const Picture one = render(scene, settings, {1, bricks});
        checkNoSeams(one, whole);
        checkSame(render(scene, settings, {ranks, bricks}), one);
    }
}

// Three squares, exactly on the planes at which a scene of [-2, 2]^3 is cut in 8.
example::Mesh walls()
{
    example::Mesh mesh;
    const auto square = [&](const Vec3& p, const Vec3& u, const Vec3& v) {
        const std::uint32_t n = static_cast<std::uint32_t>(mesh.positions.size());
        for (const Vec3& q : {p, p + u, p + u + v, p + v})
            mesh.positions.push_back(q);
        mesh.triangles.push_back({n, n + 1, n + 2});
        mesh.triangles.push_back({n, n + 2, n + 3});
    };
    square({0, -2, -2}, {0, 4, 0}, {0, 0, 4});
    square({-2, 0, -2}, {4, 0, 0}, {0, 0, 4});
    square({-2, -2, 0}, {4, 0, 0}, {0, 4, 0});
    return mesh;
}

Scene wallScene()
{
    Scene scene;
    scene.add(walls(), false);
    const float pad = scene.bounds.hi.x - 2;
    CHECK(pad > 0.0f);
    CHECK(scene.bounds.lo.x == -scene.bounds.hi.x);
    return scene;
}

} // namespace

TEST_CASE("Every camera sees the same scene, cut or whole", "[cut]")
{
    const Scene scene = keptDemo(3);
    example::RenderSettings settings = settingsOf(96, 64);
    settings.passes = 3;
    const Picture plain = render(scene, settings, {1, 0});
    for (const auto kind : {example::CameraKind::DepthOfField, example::CameraKind::MotionBlur,
                            example::CameraKind::Stereo, example::CameraKind::Dome}) {
        INFO("camera " << static_cast<int>(kind));
        settings.view.kind = kind;
        const Picture whole = render(scene, settings, {1, 0});
        CHECK(whole.meanAlpha() > 0.003); // the dome sees it from afar
        CHECK(largestDifference(plain.rgba, whole.rgba) > 0.1f);
        for (const auto& [bricks, ranks] : {std::pair(2, 3), {5, 7}}) {
            INFO(bricks << " bricks");
            const Picture one = render(scene, settings, {1, bricks});
            checkNoSeams(one, whole);
            checkSame(render(scene, settings, {ranks, bricks}), one);
        }
    }
}

TEST_CASE("Ambient occlusion and shadows are the same, cut or whole, and need their ghosts", "[cut]")
{
    const Scene scene = keptDemo(3);
    example::RenderSettings settings = settingsOf(96, 64);
    const Picture plain = render(scene, settings, {1, 0});
    settings.aoRays = 6;
    settings.aoDistance = 0.15f;
    settings.shadows = true;
    const Picture whole = render(scene, settings, {1, 0});
    CHECK(largestDifference(plain.rgba, whole.rgba) > 0.1f);
    for (const int bricks : {1, 2, 5, 8}) {
        INFO(bricks << " bricks");
        const Picture one = render(scene, settings, {1, bricks});
        checkNoSeams(one, whole);
        for (const int ranks : {3, 7})
            checkSame(render(scene, settings, {ranks, bricks}), one);
    }
    Run without{1, 8};
    without.ghosts = false;
    CHECK(largestDifference(render(scene, settings, without).rgba, whole.rgba) > 0.01f);
}

TEST_CASE("Path tracing converges, and depends on its seed", "[cut]")
{
    const Scene scene = wallScene();
    example::RenderSettings settings = settingsOf(48, 32);
    settings.pathBounces = 3;
    settings.passes = 4;
    const Picture a = render(scene, settings, {1, 0});
    checkSame(render(scene, settings, {3, 0}), a);
    settings.seed = 2;
    const Picture b = render(scene, settings, {1, 0});
    settings.passes = 256;
    const Picture converged = render(scene, settings, {1, 0});
    const auto error = [&](const Picture& p) {
        double sum = 0;
        for (std::size_t i = 0; i < p.rgba.size(); ++i)
            sum += std::pow(static_cast<double>(p.rgba[i]) - static_cast<double>(converged.rgba[i]), 2);
        return std::sqrt(sum / static_cast<double>(p.rgba.size()));
    };
    settings.passes = 64;
    const Picture better = render(scene, settings, {1, 0});
    CHECK(a.hash() != b.hash());
    CHECK(error(b) > 0.01);
    CHECK(error(better) < 0.5 * error(b)); // it would be a quarter if both were independent of the converged image
}

TEST_CASE("Cells tile the bounds and are disjoint", "[cut]")
{
    const std::vector<Scene> scenes{boxScene({0, 0, 0}, {1, 1, 1}), boxScene({-5, 2, 1000}, {1, 2.5f, 1000.25f}),
                                    boxScene({0.1f, -1e6f, 0}, {0.7f, 1e6f, 1e-3f})};
    for (const Scene& scene : scenes)
        for (int count = 1; count <= 17; ++count) {
            INFO(count << " cells");
            const std::vector<Box> cells = cutScene(scene, count);
            REQUIRE(cells.size() == static_cast<std::size_t>(count));
            checkTiling(cells, scene.bounds);
        }
    CHECK_THROWS_AS(cutScene(scenes[0], 0), std::invalid_argument);
    CHECK_THROWS_AS(cutScene(scenes[0], -1), std::invalid_argument);
}

TEST_CASE("Cells of a scene are of one size, also where their number is odd", "[cut]")
{
    const Scene scene = boxScene({0, 0, 0}, {1, 2, 3});
    const auto volume = [](const Box& box) {
        return static_cast<double>(box.extent().x) * static_cast<double>(box.extent().y)
               * static_cast<double>(box.extent().z);
    };
    for (const int count : {3, 5, 7, 11, 100})
        for (const Box& cell : cutScene(scene, count))
            CHECK(std::fabs(volume(cell) * count / volume(scene.bounds) - 1) < 1e-3);
}

TEST_CASE("Cells that are cut by content tile the bounds, too", "[cut]")
{
    Scene nothing;
    nothing.add(example::detail::generatedVolume({8, 8, 8}, [](int, int, int) { return 0.0f; }), true);
    const Scene scenes[] = {keptDemo(1),
                            keptSynthetic(3),
                            wallScene(),
                            nothing,
                            boxScene({0, 0, 0}, {0, 0, 0}),
                            boxScene({-5, 2, 1000}, {1, 2.5f, 1000.25f}),
                            boxScene({0.1f, -1e6f, 0}, {0.7f, 1e6f, 1e-3f})};
    for (const Scene& scene : scenes)
        for (const int count : {1, 2, 3, 7, 8, 17, 64}) {
            INFO(count << " cells");
            example::RenderSettings settings = settingsOf(96, 64);
            settings.frames = count == 17 ? count : std::min(count, 2); // not all of 17 are looked at
            settings.view.distance = count == 7 ? 0.0f : 2.0f;
            const std::vector<Box> cells = cellsOf(scene, settings, count);
            REQUIRE(cells.size() == static_cast<std::size_t>(count));
            checkTiling(cells, scene.bounds);
        }
}

TEST_CASE("Bricks that are cut by content take equally long", "[cut]")
{
    // Most of the scene is empty, as in a scan: a ball in a corner, and a thin plate.
    Scene scan;
    scan.add(example::detail::generatedVolume({128, 96, 80},
                                              [](int x, int y, int z) {
                                                  const int dx = x - 35, dy = y - 30, dz = z - 40;
                                                  return dx * dx + dy * dy + dz * dz < 25 * 25 || y / 4 == 19 ? 0.5f
                                                                                                              : 0;
                                              }),
             true);
    const auto busiest = [](const Scene& scene, const example::RenderSettings& settings,
                            const std::vector<Box>& cells) {
        const example::SceneInfo info(scene);
        std::vector<double> most(static_cast<std::size_t>(settings.frames)), all = most;
        for (const Box& cell : cells) {
            const example::Renderer renderer(loadBrick(scene, cell, ghostReach(info, settings)), info, settings);
            auto tile = std::make_unique<dfb::Tile<dfb::colorChannel | dfb::depthChannel, 128>>();
            tile->region = {0, 0, settings.width, settings.height};
            for (std::size_t frame = 0; frame < all.size(); ++frame) {
                const double cost = static_cast<double>(renderer.renderTile(*tile, static_cast<int>(frame)));
                most[frame] = std::max(most[frame], cost);
                all[frame] += cost / static_cast<double>(cells.size());
            }
        }
        double worst = 0; // times the mean
        for (std::size_t frame = 0; frame < all.size(); ++frame)
            worst = std::max(worst, most[frame] / all[frame]);
        return worst;
    };
    const Scene demo = keptDemo(1);
    for (const Scene* scene : {&std::as_const(scan), &demo})
        for (const auto& [elevation, frames] : {std::pair(20.0f, 1), {-60.0f, 3}}) {
            INFO((scene == &demo ? "demo" : "scan") << ", elevation " << elevation << ", " << frames << " frames");
            example::RenderSettings settings = settingsOf(128, 128);
            settings.frames = frames;
            settings.view.elevation = elevation;
            CHECK(busiest(*scene, settings, cellsOf(*scene, settings, 8)) < 1.25);
            CHECK(busiest(*scene, settings, cutScene(*scene, 8)) > 1.3);
        }
    // Surfaces whose hits cast ambient occlusion rays.
    Scene knot;
    knot.add(example::detail::torusKnot(400, 12), true);
    example::RenderSettings settings = settingsOf(128, 128);
    settings.aoRays = 16;
    settings.opacity = 1;
    CHECK(busiest(knot, settings, cellsOf(knot, settings, 8)) < 0.8 * busiest(knot, settings, cutScene(knot, 8)));
}

TEST_CASE("Cutting by content leaves no seam", "[cut]")
{
    for (const Scene& scene : {keptDemo(1), keptSynthetic(4)}) {
        const Picture whole = render(scene, settingsOf(96, 64), {1, 1});
        for (const int bricks : {2, 5, 8}) {
            INFO(bricks << " bricks");
            Run run{1, bricks};
            run.byContent = true;
            const Picture one = render(scene, settingsOf(96, 64), run);
            checkNoSeams(one, whole);
            CHECK(one.depth == whole.depth);
            run.ranks = 3;
            checkSame(render(scene, settingsOf(96, 64), run), one);
        }
    }
}

TEST_CASE("A generated volume has a brick of 64 voxels a side for each cell", "[cut]")
{
    for (const int count : {1, 2, 3, 4, 7, 8, 12}) {
        INFO(count << " cells");
        const Index3 grid = example::nearCubicGrid(count);
        CHECK(grid[0] * grid[1] * grid[2] == count);
        const Scene scene = example::syntheticScene(count, 1);
        for (std::size_t axis = 0; axis < 3; ++axis)
            CHECK(scene.volumes[0].source.info.dims[axis] == 64 * grid[axis]);
        const std::vector<Box> cells = cutScene(scene, count);
        REQUIRE(cells.size() == static_cast<std::size_t>(count));
        checkTiling(cells, scene.bounds);
        // The scene is cut anew for another number of cells.
        checkTiling(cutScene(scene, count + 1), scene.bounds);
    }
    CHECK(example::nearCubicGrid(8) == Index3{2, 2, 2});
    CHECK(example::nearCubicGrid(12) == Index3{3, 2, 2});
    CHECK(example::nearCubicGrid(64) == Index3{4, 4, 4});
    CHECK(example::nearCubicGrid(7) == Index3{7, 1, 1});
}

TEST_CASE("Bricks are dealt out evenly", "[cut]")
{
    for (int ranks = 1; ranks <= 9; ++ranks)
        for (int bricks = 1; bricks <= 20; ++bricks) {
            std::vector<int> load(static_cast<std::size_t>(ranks));
            int last = 0;
            for (int brick = 0; brick < bricks; ++brick) {
                const int rank = example::rankOfBrick(brick, bricks, ranks);
                REQUIRE(rank >= last); // neighbours stay together
                REQUIRE(rank < ranks);
                last = rank;
                ++load[static_cast<std::size_t>(rank)];
            }
            const auto [least, most] = std::minmax_element(load.begin(), load.end());
            CHECK(*most - *least <= 1);
        }
    CHECK(example::rankOfBrick((1 << 20) - 1, 1 << 20, 4096) == 4095);
}

TEST_CASE("A brick holds its part of the volume, with ghosts, and no more", "[cut]")
{
    const Scene scene = keptSynthetic(8);
    const auto& object = scene.volumes[0];
    const auto count = [](const example::VoxelBlock& b) {
        std::size_t n = 1;
        for (std::size_t axis = 0; axis < 3; ++axis)
            n *= static_cast<std::size_t>(b.hi()[axis] - b.lo()[axis]);
        return n;
    };
    const std::vector<Box> cells = cutScene(scene, 8);
    for (std::uint32_t id = 0; id < 8; ++id) {
        const example::Brick brick = loadBrick(scene, cells[id]);
        REQUIRE(brick.volumes.size() == 1);
        const example::VoxelBlock& block = brick.volumes[0].block;
        CHECK(count(block) >= 66u * 66u * 66u);
        CHECK(count(block) <= 72u * 72u * 72u); // of 128^3
        // Interpolation of values and gradients reads from one voxel before a point in the cell to two behind it.
        for (int axis = 0; axis < 3; ++axis) {
            const std::size_t a = static_cast<std::size_t>(axis);
            const float scale = component(object.placement.scale, axis),
                        offset = component(object.placement.offset, axis);
            const float ends[2] = {(component(cells[id].lo, axis) - offset) / scale,
                                   (component(cells[id].hi, axis) - offset) / scale};
            const float first = std::max(0.0f, std::min(ends[0], ends[1])),
                        behind = std::min(127.0f, std::max(ends[0], ends[1]));
            CHECK(block.lo()[a] <= static_cast<int>(first) - 1);
            CHECK(block.hi()[a] >= static_cast<int>(behind) + 3);
        }
        // The voxels of the brick are those of the whole volume.
        const example::VoxelBlock all(object.source, block.lo(), {block.hi()[0], block.hi()[1], block.lo()[2] + 1});
        CHECK(std::equal(all.data<std::uint8_t>(), all.data<std::uint8_t>() + count(all), block.data<std::uint8_t>()));
    }
    // A cell outside the volume holds no part of it.
    Box aside;
    aside.lo = {5, 5, 5};
    aside.hi = {6, 6, 6};
    CHECK(loadBrick(scene, aside).volumes.empty());
}

TEST_CASE("A brick holds the triangles and spheres that touch it, under their numbers in the whole scene", "[cut]")
{
    const Scene scene = keptDemo(1);
    const auto& triangles = scene.meshes[0].mesh.triangles;
    const auto& spheres = scene.spheres[0].spheres;
    std::vector<int> seenTriangles(triangles.size()), seenSpheres(spheres.size());
    const std::vector<Box> cells = cutScene(scene, 8);
    for (std::uint32_t id = 0; id < 8; ++id) {
        const example::Brick brick = loadBrick(scene, cells[id]);
        std::set<std::uint32_t> here, spheresHere;
        for (const auto& part : brick.meshes) {
            CHECK(part.geometry == scene.meshes[0].geometry);
            REQUIRE(part.primitives.size() == part.mesh.triangles.size());
            CHECK(part.mesh.positions.size() < scene.meshes[0].mesh.positions.size());
            for (std::size_t i = 0; i < part.primitives.size(); ++i)
                for (std::size_t k = 0; k < 3; ++k) {
                    const Vec3 &a = part.mesh.positions[part.mesh.triangles[i][k]],
                               &b = scene.meshes[0].mesh.positions[triangles[part.primitives[i]][k]];
                    REQUIRE((a.x == b.x && a.y == b.y && a.z == b.z));
                }
            here.insert(part.primitives.begin(), part.primitives.end());
        }
        for (const auto& part : brick.spheres) {
            REQUIRE(part.primitives.size() == part.spheres.size());
            for (std::size_t i = 0; i < part.primitives.size(); ++i)
                REQUIRE(part.spheres[i].radius == spheres[part.primitives[i]].radius);
            spheresHere.insert(part.primitives.begin(), part.primitives.end());
        }
        CHECK(here.size() < triangles.size() / 2);
        CHECK(spheresHere.size() < spheres.size() / 2);
        int missing = 0;
        for (std::uint32_t i = 0; i < triangles.size(); ++i) {
            Box box;
            for (const std::uint32_t vertex : triangles[i])
                box.grow(scene.meshes[0].mesh.positions[vertex]);
            missing += box.overlaps(cells[id]) && here.count(i) == 0;
        }
        for (std::uint32_t i = 0; i < spheres.size(); ++i) {
            Box box;
            box.grow(spheres[i].center, spheres[i].radius);
            missing += box.overlaps(cells[id]) && spheresHere.count(i) == 0;
        }
        CHECK(missing == 0);
    }
}

TEST_CASE("Each hit of a ray belongs to one brick", "[cut]")
{
    const Scene scenes[] = {keptDemo(1), wallScene()};
    for (const Scene& scene : scenes)
        for (const int count : {2, 3, 8}) {
            INFO(count << " bricks");
            const auto surfacesOf = [&](const Box& cell) {
                example::Brick brick = loadBrick(scene, cell);
                return std::make_unique<example::Surfaces>(cell, std::move(brick.meshes), std::move(brick.spheres));
            };
            const auto whole = surfacesOf(scene.bounds);
            std::vector<std::unique_ptr<example::Surfaces>> parts;
            for (const Box& cell : cutScene(scene, count))
                parts.push_back(surfacesOf(cell));
            std::size_t seen = 0, wrong = 0;
            for (int i = 0; i < 2000; ++i) {
                const auto real = [i, key = std::uint64_t{0}]() mutable {
                    return static_cast<float>(example::unitReal(example::hash64(static_cast<std::uint64_t>(i), ++key)));
                };
                auto next = real;
                Vec3 origin, target;
                for (int axis = 0; axis < 3; ++axis) {
                    component(origin, axis) =
                        component(scene.bounds.center(), axis) + 4 * scene.bounds.largestExtent() * (next() - 0.5f);
                    component(target, axis) =
                        component(scene.bounds.lo, axis) + component(scene.bounds.extent(), axis) * next();
                }
                const Vec3 direction = example::unit(target - origin);
                std::vector<example::Hit> expected, got, all;
                whole->intersect(origin, direction, expected);
                for (const auto& part : parts) {
                    part->intersect(origin, direction, got);
                    all.insert(all.end(), got.begin(), got.end());
                }
                std::sort(all.begin(), all.end(),
                          [](const example::Hit& a, const example::Hit& b) { return a.t < b.t; });
                bool same = all.size() == expected.size();
                for (std::size_t k = 0; same && k < all.size(); ++k)
                    same = all[k].t == expected[k].t && all[k].geometry == expected[k].geometry
                           && all[k].primitive == expected[k].primitive;
                seen += expected.size();
                wrong += !same;
            }
            CHECK(seen > 1000);
            CHECK(wrong == 0);
        }
}

TEST_CASE("Cutting a volume leaves no seam", "[cut]")
{
    const Scene scene = keptSynthetic(8);
    const Picture whole = render(scene, settingsOf(96, 64), {1, 1});
    CHECK(whole.meanAlpha() > 0.1);
    CHECK(whole.meanAlpha() < 0.9);
    checkCuts(scene, settingsOf(96, 64));
}

TEST_CASE("Cutting a turned volume leaves no seam", "[cut]")
{
    Scene scene;
    example::FileLook turned;
    for (const auto& [key, value] : {std::pair("rotate", "20,35,50"), {"scale", "0.8"}, {"translate", "0.1,0,-0.2"}})
        CHECK(setLook(turned, key, value));
    scene.add(example::detail::generatedVolume({48, 40, 33}, example::detail::WaveField({48, 40, 33}, 7)), true,
              turned);
    const Picture whole = render(scene, settingsOf(96, 64), {1, 1});
    CHECK(whole.meanAlpha() > 0.1);
    checkCuts(scene, settingsOf(96, 64));
    Run byContent{2, 5};
    byContent.byContent = true;
    checkNoSeams(render(scene, settingsOf(96, 64), byContent), whole);
}

TEST_CASE("Cutting a volume, a mesh and spheres leaves no seam", "[cut]")
{
    const Scene scene = keptDemo(1);
    CHECK(render(scene, settingsOf(96, 64), {1, 1}).meanAlpha() > 0.1);
    checkCuts(scene, settingsOf(96, 64));
}

TEST_CASE("A wall on the face between two bricks is seen once", "[cut]")
{
    const Scene scene = wallScene();
    CHECK(render(scene, settingsOf(96, 64), {1, 1}).meanAlpha() > 0.1);
    checkCuts(scene, settingsOf(96, 64));
}

TEST_CASE("Several samples a pixel, each a pass", "[cut]")
{
    const Scene scene = keptDemo(1);
    example::RenderSettings settings = settingsOf(70, 50);
    const Picture one = render(scene, settings, {1, 1});
    settings.passes = 3;
    const Picture whole = render(scene, settings, {1, 1});
    CHECK(largestDifference(one.rgba, whole.rgba) > 1e-2f);
    checkSame(render(scene, settings, {2, 0}), whole);
    const Picture cut = render(scene, settings, {1, 5});
    checkNoSeams(cut, whole);
    checkSame(render(scene, settings, {3, 5}), cut);
}

TEST_CASE("From inside the scene", "[cut]")
{
    for (const Scene& scene : {keptDemo(1), keptSynthetic(8)})
        for (const float distance : {0.0f, 0.3f}) {
            INFO("distance " << distance);
            example::RenderSettings settings = settingsOf(70, 50);
            settings.view.distance = distance;
            settings.view.fieldOfView = 100;
            const Picture whole = render(scene, settings, {1, 1});
            CHECK(whole.meanAlpha() > 0.1);
            checkSame(render(scene, settings, {2, 0}), whole);
            for (const int bricks : {2, 8}) {
                const Picture cut = render(scene, settings, {1, bricks});
                checkNoSeams(cut, whole);
                checkSame(render(scene, settings, {3, bricks}), cut);
            }
        }
}

TEST_CASE("The image does not depend on who renders a brick, who owns a tile, and how many threads there are", "[cut]")
{
    const Scene scene = keptDemo(1);
    const example::RenderSettings settings = settingsOf(200, 150); // 12 tiles
    const Picture one = render(scene, settings, {1, 5});
    CHECK(one.report.tilesTotal == 12);
    Run run{4, 5};
    run.rankOf = [](int, int, int) { return 3; }; // the other ranks, and with them the display rank, have no data
    checkSame(render(scene, settings, run), one);
    run.rankOf = [](int brick, int, int ranks) { return 1 + (4 * brick + 2) % (ranks - 1); };
    checkSame(render(scene, settings, run), one);
    run.rankOf = example::rankOfBrick;
    run.threads = 0;
    for (const dfb::OwnerMap& map :
         {dfb::OwnerMap(dfb::linearOwner), dfb::OwnerMap(dfb::hashOwner), dfb::OwnerMap([](auto&&...) { return 2; })}) {
        run.ownerMap = map;
        ++run.threads;
        checkSame(render(scene, settings, run), one);
    }
    Run many{14, 2}; // more ranks than tiles and than bricks
    checkSame(render(scene, settings, many), render(scene, settings, {1, 2}));
}

TEST_CASE("Images of one pixel, and views of nothing", "[cut]")
{
    const Scene scene = keptDemo(1);
    const Picture pixel = render(scene, settingsOf(1, 1), {1, 5});
    CHECK(pixel.depth.size() == 1);
    checkSame(render(scene, settingsOf(1, 1), {4, 5}), pixel);
    checkNoSeams(render(scene, settingsOf(1, 1), {1, 1}), pixel);

    Scene nothing;
    nothing.add(example::detail::generatedVolume({8, 8, 8}, [](int, int, int) { return 0.0f; }), true);
    Scene thin = nothing;
    thin.add(std::vector<example::Sphere>(1, {{0.5f, 0.5f, 0.5f}, 0.0f, {1, 1, 1}}), false); // of radius 0
    for (const Scene& empty : {nothing, thin})
        for (const Run& run : {Run{1, 1}, Run{3, 5}, Run{3, 0}, Run{4, 1}}) {
            const Picture picture = render(empty, settingsOf(96, 64), run);
            CHECK(std::all_of(picture.rgba.begin(), picture.rgba.end(), [](float v) { return v == 0.0f; }));
            CHECK(std::all_of(picture.depth.begin(), picture.depth.end(),
                              [](float v) { return v == std::numeric_limits<float>::infinity(); }));
        }
}

TEST_CASE("Figures of a frame are plausible", "[cut]")
{
    const Scene scene = keptDemo(1);
    const Picture one = render(scene, settingsOf(200, 150), {1, 5}), four = render(scene, settingsOf(200, 150), {4, 5});
    for (const Picture* picture : {&one, &four}) {
        const dfb::FrameReport& r = picture->report;
        CHECK(r.totalMs > 0);
        CHECK(r.renderMsMax > 0);
        CHECK(r.compositingOverheadMs >= 0);
        CHECK(r.renderMsMax + r.compositingOverheadMs > 0.5 * r.totalMs);
        CHECK(r.tilesTotal == 12);
        CHECK(r.tilesTouched > 0);
        CHECK(r.tilesTouched <= 12);
        CHECK(r.nonFinitePixels == 0);
        CHECK(r.peakMemoryBytes > 200 * 150 * 20); // colour and depth on the display rank
        CHECK(r.peakMemoryBytes < 100 * 1000 * 1000);
    }
    CHECK(one.report.bytesSent == 0);
    CHECK(four.report.bytesSent > 10000);
    CHECK(four.report.bytesSent < 20 * 200 * 150 * 20);
    CHECK(four.report.messagesSent > 10);
}

} // namespace cut_cases
