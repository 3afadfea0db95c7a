// Rays end at opaque surfaces: nothing behind them is shaded or sampled, and the image is that of the scene without
// what is hidden. Measured by the work that the renderer reports, not by time.
#include "support.hpp"

#include <generated.hpp>
#include <renderer.hpp>

#include <dfb/tile.hpp>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <vector>

namespace opaque_cases {

namespace {

using example::Box;
using example::component;
using example::Scene;
using example::Vec3;

constexpr int size = 64; // of the image, which is a single tile
using Tile = dfb::Tile<dfb::allChannels & ~dfb::farChannel, size>;

example::RenderSettings opaqueSettings()
{
    example::RenderSettings settings;
    settings.width = settings.height = size;
    settings.seed = 1;
    settings.opacity = 1;
    settings.view.azimuth = settings.view.elevation = 0; // from +z
    return settings;
}

struct Picture {
    std::unique_ptr<Tile> tile = std::make_unique<Tile>();
    std::int64_t work = 0;

    int covered() const
    {
        int count = 0;
        for (int i = 0; i < size * size; ++i)
            count += tile->color[4 * i + 3] > 0;
        return count;
    }
};

// Renders the brick of one cell. `all` is the scene that determines the sampling and the camera.
Picture render(const Scene& scene, const Box& cell, const Scene& all, const example::RenderSettings& settings)
{
    const example::SceneInfo info(all);
    const example::Renderer renderer(loadBrick(scene, cell, ghostReach(info, settings)), info, settings);
    Picture picture;
    picture.tile->region = {0, 0, size, size};
    picture.tile->clear();
    picture.work = renderer.renderTile(*picture.tile, 0);
    return picture;
}
Picture render(const Scene& scene, const example::RenderSettings& settings)
{
    return render(scene, scene.bounds, scene, settings);
}

// Number of shaded hits: each takes one more ray if there is one more ray for ambient occlusion.
std::int64_t shadedHits(const Scene& scene, const Box& cell, example::RenderSettings settings)
{
    settings.aoRays = 2;
    const std::int64_t with = render(scene, cell, scene, settings).work;
    settings.aoRays = 1;
    return with - render(scene, cell, scene, settings).work;
}

void checkSame(const Picture& a, const Picture& b)
{
    CHECK(std::equal(a.tile->color, a.tile->color + 4 * size * size, b.tile->color));
    CHECK(std::equal(a.tile->depth, a.tile->depth + size * size, b.tile->depth));
    CHECK(std::equal(a.tile->normal, a.tile->normal + 3 * size * size, b.tile->normal));
    CHECK(std::equal(a.tile->albedo, a.tile->albedo + 3 * size * size, b.tile->albedo));
    CHECK(std::equal(a.tile->primitiveId, a.tile->primitiveId + size * size, b.tile->primitiveId));
    CHECK(std::equal(a.tile->instanceId, a.tile->instanceId + size * size, b.tile->instanceId));
}

std::vector<example::Sphere> swarm(int count, float radius, const Vec3& lo, const Vec3& hi)
{
    std::vector<example::Sphere> spheres;
    std::uint64_t key = 7;
    const auto next = [&key] { return static_cast<float>(example::unitReal(key = example::hash64(key))); };
    for (int i = 0; i < count; ++i) {
        example::Sphere sphere;
        for (int axis = 0; axis < 3; ++axis)
            component(sphere.center, axis) = component(lo, axis) + (component(hi, axis) - component(lo, axis)) * next();
        sphere.radius = radius;
        sphere.color = {next(), next(), next()};
        spheres.push_back(sphere);
    }
    return spheres;
}

// A wall across the whole view at this z, and beyond its borders.
example::Mesh wall(float z) { return {{{-3, -3, z}, {4, -3, z}, {4, 4, z}, {-3, 4, z}}, {{0, 1, 2}, {0, 2, 3}}}; }

Scene thickScene()
{
    Scene scene;
    scene.add(swarm(4000, 0.05f, {0, 0, 0}, {1, 1, 1}), false);
    scene.add(example::detail::torusKnot(200, 12), false);
    return scene;
}

} // namespace

TEST_CASE("Of an opaque scene one hit of each pixel is shaded", "[opaque]")
{
    const Scene scene = thickScene();
    const example::RenderSettings settings = opaqueSettings();
    example::RenderSettings glassy = settings;
    glassy.opacity = 0.5f;
    const int covered = render(scene, settings).covered();
    CHECK(covered > 800);
    CHECK(shadedHits(scene, scene.bounds, glassy) > 10 * covered); // else there is nothing to save
    CHECK(shadedHits(scene, scene.bounds, settings) == covered);
    // Shadow rays end there as well: each shaded hit has one.
    example::RenderSettings shadows = settings;
    shadows.shadows = true;
    CHECK(render(scene, shadows).work - render(scene, settings).work == covered);
}

TEST_CASE("Rays end in each brick, and where its ghosts hide it", "[opaque]")
{
    const Scene scene = thickScene();
    example::RenderSettings settings = opaqueSettings();
    settings.view.azimuth = 30;
    settings.view.elevation = 20;
    std::int64_t alone = 0, shaded = 0;
    settings.aoRays = 1;
    const Picture whole = render(scene, settings);
    std::vector<Picture> parts;
    for (const Box& cell : cutScene(scene, 8)) {
        settings.aoRays = 0; // without ghosts
        alone += render(scene, cell, scene, settings).covered();
        settings.aoRays = 1;
        parts.push_back(render(scene, cell, scene, settings));
        CHECK(shadedHits(scene, cell, settings) == parts.back().covered());
        shaded += parts.back().covered();
    }
    CHECK(shaded < whole.covered() + (alone - whole.covered()) / 2);
    // Hidden parts that were left out do not show.
    int wrong = 0;
    for (int i = 0; i < size * size; ++i) {
        const Tile* nearest = parts.front().tile.get();
        for (const Picture& part : parts)
            if (part.tile->depth[i] < nearest->depth[i])
                nearest = part.tile.get();
        wrong += nearest->depth[i] != whole.tile->depth[i]
                 || !std::equal(nearest->color + 4 * i, nearest->color + 4 * (i + 1), whole.tile->color + 4 * i);
    }
    CHECK(wrong == 0);
}

TEST_CASE("What is behind an opaque surface changes nothing and costs nothing", "[opaque]")
{
    const auto cloud = [](int x, int y, int z) { return static_cast<float>((x * 7 + y * 5 + z * 3) % 32) / 31; };
    for (const float z : {1.2f, 0.5f}) { // in front of the volume, and in it
        INFO("wall at " << z);
        Scene front, all;
        for (Scene* scene : {&front, &all})
            scene->add(wall(z), false);
        if (z < 1)
            front.add(example::detail::generatedVolume({32, 32, 32}, cloud), true);
        all.add(example::detail::generatedVolume({32, 32, 32}, cloud), true);
        all.add(swarm(500, 0.1f, {0, 0, -0.6f}, {1, 1, 0.3f}), false);
        all.add(wall(0.1f), false);
        for (const int aoRays : {0, 2}) {
            example::RenderSettings settings = opaqueSettings();
            settings.aoRays = aoRays;
            settings.aoDistance = 0.02f;
            const Picture expected = render(front, all.bounds, all, settings), got = render(all, settings);
            CHECK(expected.covered() > 1000);
            checkSame(got, expected);
            CHECK(got.work == expected.work);
        }
    }
}

TEST_CASE("Early termination is for surfaces, too, and keeps its bound", "[opaque]")
{
    Scene scene = thickScene();
    example::RenderSettings settings = opaqueSettings();
    settings.opacity = 0.6f;
    for (const bool hasVolume : {false, true}) {
        if (hasVolume)
            scene.add(example::detail::generatedVolume({32, 32, 32}, [](int, int y, int) { return y > 15 ? 0.3f : 0; }),
                      true);
        settings.earlyTermination = 0;
        const Picture full = render(scene, settings);
        const std::int64_t shaded = shadedHits(scene, scene.bounds, settings);
        settings.earlyTermination = 0.05f; // 0.4^4 < 0.05 < 0.4^3
        const Picture ended = render(scene, settings);
        CHECK(shadedHits(scene, scene.bounds, settings) <= 4 * full.covered());
        CHECK(shadedHits(scene, scene.bounds, settings) < shaded / 3);
        float largest = 0, brightest = 1;
        for (int i = 0; i < 4 * size * size; ++i) {
            largest = std::max(largest, std::fabs(full.tile->color[i] - ended.tile->color[i]));
            brightest = std::max(brightest, full.tile->color[i]);
        }
        CHECK(largest > 0.0f);
        CHECK(largest <= 0.05f * brightest);

        // The same with bricks.
        settings.aoRays = 1;
        settings.earlyTermination = 0;
        const Picture whole = render(scene, settings);
        settings.earlyTermination = 0.05f;
        std::vector<Picture> parts;
        for (const Box& cell : cutScene(scene, 5))
            parts.push_back(render(scene, cell, scene, settings));
        largest = 0;
        for (int i = 0; i < size * size; ++i) {
            std::sort(parts.begin(), parts.end(),
                      [i](const Picture& a, const Picture& b) { return a.tile->depth[i] < b.tile->depth[i]; });
            for (int c = 0; c < 4; ++c) {
                double sum = 0, through = 1;
                for (const Picture& part : parts) {
                    sum += through * static_cast<double>(part.tile->color[4 * i + c]);
                    through *= 1 - static_cast<double>(part.tile->color[4 * i + 3]);
                }
                largest = std::max(largest, std::fabs(static_cast<float>(sum) - whole.tile->color[4 * i + c]));
            }
        }
        CHECK(largest > 0.0f);
        CHECK(largest <= 0.05f * brightest);
        settings.aoRays = 0;
    }
}

TEST_CASE("The first hits of a ray are those of all", "[opaque]")
{
    Scene spheres, meshes;
    spheres.add(swarm(3000, 0.04f, {0, 0, 0}, {1, 1, 1}), false);
    spheres.add(swarm(300, 0.1f, {0, 0, 0}, {1, 1, 1}), false);
    meshes.add(example::detail::torusKnot(100, 8), false);
    meshes.add(wall(0.5f), false);
    meshes.add(wall(0.5f), false); // twice at one place
    const Scene scenes[] = {spheres, meshes, thickScene()};
    for (const Scene& scene : scenes) {
        example::Brick brick = loadBrick(scene, scene.bounds);
        const example::Surfaces surfaces(scene.bounds, std::move(brick.meshes), std::move(brick.spheres));
        std::vector<example::Hit> all, first;
        std::size_t seen = 0, wrong = 0;
        std::uint64_t key = 3;
        const auto next = [&key] { return static_cast<float>(example::unitReal(key = example::hash64(key))); };
        for (int i = 0; i < 1000; ++i) {
            const Vec3 origin{4 * next() - 2, 4 * next() - 2, 4 * next() - 2}, target{next(), next(), next()};
            const Vec3 direction = example::unit(target - origin);
            surfaces.intersect(origin, direction, all);
            seen += all.size();
            wrong += !std::is_sorted(all.begin(), all.end(),
                                     [](const example::Hit& a, const example::Hit& b) { return a.t < b.t; });
            for (const std::size_t most : {0u, 1u, 2u, 5u, 1000u}) {
                surfaces.intersect(origin, direction, first, most);
                bool same = first.size() == std::min(most, all.size());
                for (std::size_t k = 0; same && k < first.size(); ++k)
                    same = first[k].t == all[k].t && first[k].geometry == all[k].geometry
                           && first[k].primitive == all[k].primitive;
                wrong += !same;
            }
        }
        CHECK(seen > 1000);
        CHECK(wrong == 0);
    }
}

TEST_CASE("A ray that begins in a sphere meets it where it leaves", "[opaque]")
{
    const example::Surfaces surfaces(
        {{-9, -9, -9}, {9, 9, 9}}, {},
        std::vector<example::BrickSpheres>(1, {0, {{{1, 0, 0}, 2, {1, 1, 1}}}, {0}, {}, {}}));
    std::vector<example::Hit> hits;
    surfaces.intersect({0, 0, 0}, {1, 0, 0}, hits);
    REQUIRE(hits.size() == 1);
    CHECK(hits[0].t == 3.0f);
    surfaces.intersect({-1, 0, 0}, {-1, 0, 0}, hits); // on it, and away
    CHECK(hits.empty());
}

TEST_CASE("A sheet with two sides, whose normals cancel out, has those of its triangles", "[opaque]")
{
    const float third = 1.0f / 3;
    example::Mesh sheet{{{0, 0, third}, {third, 0, 0}, {0, third, 0}, {third, third, 0.1f}}, {}};
    sheet.triangles = {{0, 1, 2}, {1, 3, 2}, {2, 1, 0}, {3, 1, 2}};
    for (const Vec3& normal : vertexNormals(sheet))
        CHECK(normal == Vec3());
    Scene scene;
    scene.add(sheet, false);
    example::Brick brick = loadBrick(scene, scene.bounds);
    const example::Surfaces surfaces(scene.bounds, std::move(brick.meshes), std::move(brick.spheres));
    std::vector<example::Hit> hits;
    surfaces.intersect({1, 1, 1}, Vec3{-1, -1, -1} + Vec3{0.1f, 0.1f, 0.1f}, hits);
    REQUIRE(!hits.empty());
    CHECK(example::length(hits[0].normal) == Approx(1));
}

} // namespace opaque_cases
