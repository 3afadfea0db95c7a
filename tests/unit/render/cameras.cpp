// Cameras with lenses, two eyes, domes and motion: no ray meets a box in a tile that the projection leaves out.
#include "catch.hpp"

#include <dfb/render/cameras.hpp>

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <set>
#include <string>
#include <vector>

namespace cameras_cases {

namespace {

using Random = std::mt19937_64;

double uniform(Random& random, double low, double high)
{
    return low + (high - low) * static_cast<double>(random() >> 11) * 0x1p-53;
}
dfb::Vec3 point(Random& random, double extent)
{
    return {static_cast<float>(uniform(random, -extent, extent)), static_cast<float>(uniform(random, -extent, extent)),
            static_cast<float>(uniform(random, -extent, extent))};
}

bool meets(const dfb::Ray& ray, const dfb::Box3& box)
{
    const double o[3] = {ray.origin.x, ray.origin.y, ray.origin.z},
                 d[3] = {ray.direction.x, ray.direction.y, ray.direction.z};
    const double lower[3] = {box.lower.x, box.lower.y, box.lower.z}, upper[3] = {box.upper.x, box.upper.y, box.upper.z};
    double from = 0, to = std::numeric_limits<double>::infinity();
    for (int a = 0; a < 3; ++a) {
        const double t0 = (lower[a] - o[a]) / d[a], t1 = (upper[a] - o[a]) / d[a];
        from = std::max(from, std::min(t0, t1));
        to = std::min(to, std::max(t0, t1));
    }
    return from <= to;
}

struct Count {
    std::size_t hits = 0, missed = 0, tiles = 0, all = 0;
};

// Many rays through each tile, against what the projection of many boxes says.
template <class Camera>
Count check(const Camera& camera, std::uint64_t seed)
{
    Random random(seed);
    const int width = 120, height = 90;
    const dfb::TileLayout layout(width, height, 8);
    Count count;
    for (int i = 0; i < 60; ++i) {
        const dfb::Vec3 center = point(random, 2.5);
        const auto extent = static_cast<float>(std::pow(10.0, uniform(random, -1.5, 0)));
        const dfb::Vec3 half{extent, 0.4f * extent, 0.7f * extent};
        const dfb::Box3 box{center - half, center + half};
        std::set<int> found;
        for (const auto& pair : dfb::visibleTiles(dfb::World({{1, box}}), camera, layout))
            found.insert(pair.tile);
        count.tiles += found.size();
        count.all += static_cast<std::size_t>(layout.tileCount());
        for (int k = 0; k < 30000; ++k) {
            const double x = uniform(random, 0, width), y = uniform(random, 0, height);
            const dfb::LensSample sample{uniform(random, 0, 1), uniform(random, 0, 1), uniform(random, 0, 1)};
            const dfb::Ray ray = camera.ray(x, y, width, height, sample);
            if (ray.direction.x == 0 && ray.direction.y == 0 && ray.direction.z == 0)
                continue;
            if (!meets(ray, box))
                continue;
            ++count.hits;
            count.missed += found.count(layout.tileAt(static_cast<int>(x) / 8, static_cast<int>(y) / 8)) == 0;
        }
    }
    return count;
}

const dfb::Vec3 eye{1, 2, 8}, view{-0.1f, -0.2f, -1}, up{0, 1, 0};

} // namespace

TEST_CASE("No ray of any camera meets a box in a tile that its projection leaves out", "[cameras]")
{
    const auto checkAll = [](const auto& camera, std::uint64_t seed, double mostTiles) {
        const Count c = check(camera, seed);
        CHECK(c.missed == 0);
        CHECK(c.hits > 500);
        CHECK(static_cast<double>(c.tiles) < mostTiles * static_cast<double>(c.all)); // not just everything
    };
    checkAll(dfb::ThinLensCamera(eye, view, up, 45, 0.3f, 6), 1, 0.25);
    checkAll(dfb::ThinLensCamera(eye, view, up, 45, 0.05f, 2), 2, 0.25);
    checkAll(dfb::StereoCamera(eye, view, up, 45, 0.5f, 7), 3, 0.25);
    checkAll(dfb::DomeCamera(eye, view, up), 4, 0.15);
    checkAll(dfb::DomeCamera({0, 0, 0}, {0, 1, 0}, {0, 0, 1}, 300), 5, 0.9);
    checkAll(dfb::OrbitBlurCamera(eye, view, up, 45, {0, 0, 0}, {0, 1, 0}, 10), 6, 0.25);
    checkAll(dfb::OrbitBlurCamera(eye, view, up, 45, {0, 0, 0}, {0.3f, 1, 0}, -90), 7, 0.6);
}

TEST_CASE("Without a lens, between the eyes and at rest cameras are the pinhole", "[cameras]")
{
    const auto pinhole = dfb::PerspectiveCamera::along(eye, view, up, 45);
    const dfb::ThinLensCamera lens(eye, view, up, 45, 0, 3);
    const dfb::OrbitBlurCamera orbit(eye, view, up, 45, {0, 0, 0}, {0, 1, 0}, 30);
    const dfb::StereoCamera stereo(eye, view, up, 45, 0, 5);
    double largest = 0;
    const auto compare = [&](const dfb::Vec3& a, const dfb::Vec3& b) {
        const dfb::Vec3 d = a - b;
        largest = std::max(largest, static_cast<double>(dot(d, d)));
    };
    for (int i = 0; i < 100; ++i) {
        const double x = 1.2 * i, y = 90 - 0.7 * i;
        compare(lens.ray(x, y, 120, 90, {0.7, 0.3, 0}).direction, pinhole.direction(x, y, 120, 90));
        compare(orbit.ray(x, y, 120, 90, {}).direction, pinhole.direction(x, y, 120, 90));
        const double half = 0.5 * x; // the left half has the view of an image of half the width
        compare(stereo.ray(half, y, 120, 90).direction, pinhole.direction(half, y, 60, 90));
    }
    CHECK(largest < 1e-12);
    // What converges is at the same place of both halves.
    const dfb::StereoCamera eyes({0, 0, 0}, {0, 0, -1}, {0, 1, 0}, 60, 0.4f, 5);
    const dfb::Ray l = eyes.ray(30, 45, 120, 90), r = eyes.ray(90, 45, 120, 90);
    compare(l.origin + (-5 / l.direction.z) * l.direction, r.origin + (-5 / r.direction.z) * r.direction);
    CHECK(largest < 1e-12);
    // The dome's border is at a right angle, and nothing is seen outside.
    const dfb::DomeCamera dome({0, 0, 0}, {0, 0, -1}, {0, 1, 0});
    CHECK(std::fabs(dome.ray(15, 45, 120, 90).direction.z) < 1e-6f);
    CHECK(dome.ray(14.9, 45, 120, 90).direction.x == 0.0f);
}

TEST_CASE("Cameras that are none are refused", "[cameras]")
{
    using dfb::InvalidArgument;
    CHECK_THROWS_AS(dfb::ThinLensCamera(eye, {0, 0, 0}, up, 45, 0.1f, 1), InvalidArgument);
    CHECK_THROWS_AS(dfb::ThinLensCamera(eye, view, up, 180, 0.1f, 1), InvalidArgument);
    CHECK_THROWS_AS(dfb::ThinLensCamera(eye, view, up, 45, -0.1f, 1), InvalidArgument);
    CHECK_THROWS_AS(dfb::ThinLensCamera(eye, view, up, 45, 0.1f, 0), InvalidArgument);
    CHECK_THROWS_AS(dfb::StereoCamera(eye, view, view, 45, 0.1f, 1), InvalidArgument);
    CHECK_THROWS_AS(dfb::StereoCamera(eye, view, up, 45, 0.1f, -1), InvalidArgument);
    CHECK_THROWS_AS(dfb::DomeCamera(eye, view, up, 0), InvalidArgument);
    CHECK_THROWS_AS(dfb::OrbitBlurCamera(eye, view, up, 45, {0, 0, 0}, {0, 0, 0}, 5), InvalidArgument);
    CHECK_THROWS_AS(dfb::OrbitBlurCamera(eye, view, up, 45, {0, 0, 0}, {0, 1, 0}, 361), InvalidArgument);
}

} // namespace cameras_cases
