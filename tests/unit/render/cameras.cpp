// Cameras with lenses, two eyes, domes and motion: no ray meets a box in a tile that the box's projection leaves out.
#include "catch.hpp"
#include "random_rays.hpp"

#include <dfb/render/cameras.hpp>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <limits>
#include <random>
#include <set>
#include <string>
#include <vector>

namespace cameras_cases {

namespace {

using rays::meets;
using rays::point;
using rays::Random;
using rays::uniform;

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
    for (int round = 0; round < 10; ++round) {
        std::vector<dfb::Box3> boxes;
        std::vector<std::set<int>> found;
        for (int i = 0; i < 6; ++i) {
            const dfb::Vec3 center = point(random, 2.5);
            const auto extent = static_cast<float>(std::pow(10.0, uniform(random, -1.5, 0)));
            const dfb::Vec3 half{extent, 0.4f * extent, 0.7f * extent};
            boxes.push_back({center - half, center + half});
            found.emplace_back();
            for (const auto& pair : dfb::visibleTiles(dfb::World({{1, boxes.back()}}), camera, layout))
                found.back().insert(pair.tile);
            count.tiles += found.back().size();
            count.all += static_cast<std::size_t>(layout.tileCount());
        }
        for (int k = 0; k < 30000; ++k) { // most of the time goes into the rays, so each meets six boxes
            const double x = uniform(random, 0, width), y = uniform(random, 0, height);
            const dfb::LensSample sample{uniform(random, 0, 1), uniform(random, 0, 1), uniform(random, 0, 1)};
            const dfb::Ray ray = camera.ray(x, y, width, height, sample);
            if (ray.direction.x == 0 && ray.direction.y == 0 && ray.direction.z == 0)
                continue;
            const int tile = layout.tileAt(static_cast<int>(x) / 8, static_cast<int>(y) / 8);
            for (std::size_t i = 0; i < boxes.size(); ++i)
                if (meets(ray.origin, ray.direction, boxes[i])) {
                    ++count.hits;
                    count.missed += found[i].count(tile) == 0;
                }
        }
    }
    return count;
}

const dfb::Vec3 eye{1, 2, 8}, view{-0.1f, -0.2f, -1}, up{0, 1, 0};

// Matrices as in OpenGL, column by column.
struct Matrix {
    float at[16] = {};
};

Matrix lookAlong(const dfb::Vec3& from, const dfb::Vec3& along, const dfb::Vec3& upwards)
{
    const dfb::Vec3 back = -1.0f * normalize(along), right = normalize(cross(along, upwards)), top = cross(back, right);
    return {{right.x, top.x, back.x, 0, right.y, top.y, back.y, 0, right.z, top.z, back.z, 0, -dot(right, from),
             -dot(top, from), -dot(back, from), 1}};
}

// As glFrustum() and glOrtho() do.
Matrix frustum(float l, float r, float b, float t, float n, float f)
{
    return {{2 * n / (r - l), 0, 0, 0, 0, 2 * n / (t - b), 0, 0, (r + l) / (r - l), (t + b) / (t - b),
             -(f + n) / (f - n), -1, 0, 0, -2 * f * n / (f - n), 0}};
}
Matrix ortho(float l, float r, float b, float t, float n, float f)
{
    return {{2 / (r - l), 0, 0, 0, 0, 2 / (t - b), 0, 0, 0, 0, -2 / (f - n), 0, -(r + l) / (r - l), -(t + b) / (t - b),
             -(f + n) / (f - n), 1}};
}

// Where the matrices put a point, by the textbook; w in z.
dfb::Vec3 pixelOf(const Matrix& v, const Matrix& p, const dfb::Vec3& point, int width, int height)
{
    double in[4] = {point.x, point.y, point.z, 1}, out[4] = {};
    for (const Matrix* m : {&v, &p}) {
        for (int r = 0; r < 4; ++r) {
            out[r] = 0;
            for (int c = 0; c < 4; ++c)
                out[r] += static_cast<double>(m->at[4 * c + r]) * in[c];
        }
        std::copy_n(out, 4, in);
    }
    return {static_cast<float>(0.5 * width * (1 + out[0] / out[3])),
            static_cast<float>(0.5 * height * (1 - out[1] / out[3])), static_cast<float>(out[3])};
}

const Matrix projections[] = {frustum(-0.4f, 0.4f, -0.3f, 0.3f, 1, 100), frustum(-0.1f, 0.7f, -0.5f, 0.2f, 1, 30),
                              frustum(-0.004f, 0.004f, -0.003f, 0.003f, 0.01f, 1e6f), ortho(-4, 4, -3, 3, 0.1f, 100),
                              ortho(-1, 5, -4, 2, -50, 50)};

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
    const Matrix v = lookAlong(eye, view, up), inside = lookAlong({0, 0, 0.5f}, view, up);
    for (const Matrix& p : projections)
        checkAll(dfb::MatrixCamera(v.at, p.at), 8, 0.25);
    checkAll(dfb::MatrixCamera(inside.at, projections[1].at), 9, 0.6);
}

TEST_CASE("The angle of view may be nearly 180 degrees", "[cameras]")
{
    const int width = 65536, height = 1000; // 179.85 to 179.999 degrees across the image
    std::mt19937_64 random(1);
    const auto any = [&] {
        return dfb::Vec3{static_cast<float>(uniform(random, -1, 1)), static_cast<float>(uniform(random, -1, 1)),
                         static_cast<float>(uniform(random, -1, 1))};
    };
    // The smallest box of floats that has a point.
    const auto boxOf = [](const dfb::Vec3d& p) {
        const auto below = [](double x) {
            const auto rounded = static_cast<float>(x);
            return static_cast<double>(rounded) <= x ? rounded : std::nextafter(rounded, -HUGE_VALF);
        };
        const auto above = [&](double x) { return -below(-x); };
        return dfb::Box3{{below(p.x), below(p.y), below(p.z)}, {above(p.x), above(p.y), above(p.z)}};
    };
    std::size_t missed = 0;
    for (const float fovY : {170.0f, 179.0f, 179.9f})
        for (int i = 0; i < 4000; ++i) {
            const auto camera = dfb::PerspectiveCamera::along(any(), any(), any(), fovY);
            const double x = uniform(random, 0, 8), y = uniform(random, 0, height); // at the border
            const dfb::Ray ray = camera.ray(x, y, width, height);
            const double way = std::pow(10, uniform(random, -1, 2));
            const dfb::Vec3d at = dfb::toDouble(ray.origin) + way * dfb::toDouble(ray.direction);
            const int px = static_cast<int>(x), py = static_cast<int>(y);
            missed += !camera.project(boxOf(at), width, height).meets({px, py, px + 1, py + 1});
        }
    CHECK(missed == 0);
}

TEST_CASE("No ray meets a box as small as roundings of the eye in a tile that its projection leaves out", "[cameras]")
{
    Random random(12);
    std::size_t hits = 0, missed = 0;
    const auto check = [&](const auto& camera, const dfb::Vec3& at) {
        const auto moved = [&](float value, int ulps) {
            for (int i = 0; i < std::abs(ulps); ++i)
                value = std::nextafter(value, ulps < 0 ? -1e9f : 1e9f);
            return value;
        };
        int from[3], to[3];
        for (int k = 0; k < 3; ++k) {
            from[k] = static_cast<int>(random() % 8) - 4;
            to[k] = from[k] + 1 + static_cast<int>(random() % static_cast<std::uint64_t>(4 - from[k]));
        }
        const dfb::Box3 box{{moved(at.x, from[0]), moved(at.y, from[1]), moved(at.z, from[2])},
                            {moved(at.x, to[0]), moved(at.y, to[1]), moved(at.z, to[2])}};
        std::set<int> found;
        const dfb::TileLayout layout(64, 48, 8);
        for (const auto& pair : dfb::visibleTiles(dfb::World({{1, box}}), camera, layout))
            found.insert(pair.tile);
        for (int i = 0; i < 40; ++i) {
            const double x = uniform(random, 0, 64), y = uniform(random, 0, 48);
            const dfb::Ray ray = camera.ray(x, y, 64, 48, {uniform(random, 0, 1), uniform(random, 0, 1), 0});
            if (!meets(ray.origin, ray.direction, box))
                continue;
            ++hits;
            missed += found.count(layout.tileAt(static_cast<int>(x) / 8, static_cast<int>(y) / 8)) == 0;
        }
    };
    for (int i = 0; i < 3000; ++i) {
        const dfb::Vec3 at = point(random, std::pow(10.0, uniform(random, -1, 5))), along = point(random, 1);
        const float wide = 3e-7f * std::sqrt(dot(at, at)); // some roundings
        check(dfb::ThinLensCamera(at, along, up, 60, wide, 1), at);
        check(dfb::StereoCamera(at, along, up, 60, wide, 1), at);
        const dfb::MatrixCamera matrix(lookAlong(at, along, up).at, projections[1].at);
        check(matrix, matrix.eye());
    }
    CHECK(missed == 0);
    CHECK(hits > 500);
}

TEST_CASE("The footprints of two eyes stay in their halves of the image", "[cameras]")
{
    Random random(13);
    const dfb::StereoCamera camera(eye, view, up, 45, 0.5f, 7);
    int across = 0, beyond = 0;
    for (int i = 0; i < 400; ++i) {
        const int width = 120 + i % 2, height = 90;
        const dfb::Vec3 center = point(random, 2.5), half = {0.5f, 0.4f, 0.3f};
        const auto both = camera.project({center - half, center + half}, width, height);
        const dfb::Region halves[] = {{0, 0, (width + 1) / 2, height}, {width / 2, 0, width, height}};
        for (std::size_t k = 0; k < 2; ++k) {
            const dfb::Region seen = both.at(k).region();
            beyond += !seen.empty() && !(intersection(seen, halves[k]) == seen);
            across += both[k].meets({width / 2 - 1, 0, width / 2, height});
        }
    }
    CHECK(beyond == 0);
    CHECK(across > 20);
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

TEST_CASE("A lens may be focused at infinity, and two eyes may look in parallel", "[cameras]")
{
    const float infinity = std::numeric_limits<float>::infinity();
    const auto pinhole = dfb::PerspectiveCamera::along(eye, view, up, 45);
    const dfb::ThinLensCamera lens(eye, view, up, 45, 0.2f, infinity);
    const dfb::StereoCamera eyes(eye, view, up, 45, 0.5f, infinity);
    const auto apart = [](const dfb::Vec3& a, const dfb::Vec3& b) { return dot(a - b, a - b); };
    for (int i = 0; i < 50; ++i) {
        const double x = 1.2 * i, y = 90 - 1.7 * i;
        CHECK(apart(lens.ray(x, y, 120, 90, {0.9, 0.02 * i, 0}).direction, pinhole.direction(x, y, 120, 90)) < 1e-12f);
        CHECK(apart(eyes.ray(x, y, 120, 90).direction, eyes.ray(x + 60, y, 120, 90).direction) < 1e-12f);
    }
    const Count ofLens = check(lens, 14), ofEyes = check(eyes, 15);
    CHECK(ofLens.missed + ofEyes.missed == 0);
    CHECK(std::min(ofLens.hits, ofEyes.hits) > 500);
}

TEST_CASE("The rays of a dome have one eye", "[cameras]")
{
    const dfb::DomeCamera dome(eye, view, up, 300);
    const auto common = dome.commonEye();
    REQUIRE(common);
    for (const double x : {3.0, 60.0, 110.0}) {
        const dfb::Vec3 off = dome.ray(x, 40, 120, 90).origin - *common;
        CHECK(dot(off, off) == 0.0f);
    }
}

TEST_CASE("A matrix camera's rays meet the points that its matrices project there", "[cameras]")
{
    const int width = 120, height = 90;
    const Matrix v = lookAlong(eye, view, up);
    Random random(11);
    for (const Matrix& p : projections) {
        const dfb::MatrixCamera camera(v.at, p.at);
        CHECK(camera.isOrthographic() == (p.at[15] == 1));
        int seen = 0, wrong = 0;
        for (int i = 0; i < 2000; ++i) {
            const dfb::Vec3 at = point(random, 6);
            const dfb::Vec3 pixel = pixelOf(v, p, at, width, height);
            if (pixel.z <= 0)
                continue;
            const dfb::Ray ray = camera.ray(pixel.x, pixel.y, width, height);
            const dfb::Vec3 way = at - ray.origin, aside = cross(way, ray.direction);
            ++seen;
            wrong += !(std::sqrt(dot(aside, aside)) < 1e-4f) || !(dot(way, ray.direction) > 0)
                     || !(std::fabs(dot(ray.direction, ray.direction) - 1) < 1e-6f);
            // A small box is where its corners are, and two pixels more at most.
            const dfb::Vec3 half{0.2f, 0.1f, 0.3f};
            const dfb::Box3 box{at - half, at + half};
            float x0 = 1e9f, x1 = -1e9f, y0 = 1e9f, y1 = -1e9f, w = 1;
            for (int corner = 0; corner < 8; ++corner) {
                const auto c = dfb::toFloat(dfb::detail::cornerOf(box, corner));
                const dfb::Vec3 q = pixelOf(v, p, c, width, height);
                x0 = std::min(x0, q.x), x1 = std::max(x1, q.x), y0 = std::min(y0, q.y), y1 = std::max(y1, q.y);
                w = std::min(w, q.z);
            }
            const dfb::Region found = camera.project(box, width, height).region();
            if (w > 0.01f && !found.empty())
                wrong += (found.x0 > 0 && static_cast<float>(found.x0) < x0 - 2)
                         || (found.y0 > 0 && static_cast<float>(found.y0) < y0 - 2)
                         || (found.x1<width&& static_cast<float>(found.x1)> x1 + 2)
                         || (found.y1<height&& static_cast<float>(found.y1)> y1 + 2);
        }
        CHECK(wrong == 0);
        CHECK(seen > 900);
    }
    // The symmetric frustum is the pinhole.
    const dfb::MatrixCamera camera(v.at, projections[0].at);
    const auto pinhole = dfb::PerspectiveCamera::along(eye, view, up, 2 * 16.6992442f); // its tangent is 0.3
    const dfb::Vec3 apart = camera.eye() - eye;
    CHECK(dot(apart, apart) < 1e-10f);
    float largest = 0;
    for (int i = 0; i < 100; ++i) {
        const double x = 1.2 * i, y = 90 - 0.7 * i;
        const dfb::Vec3 d = camera.ray(x, y, width, height).direction - pinhole.direction(x, y, width, height);
        largest = std::max(largest, dot(d, d));
    }
    CHECK(largest < 1e-12f);
}

TEST_CASE("An orthographic camera's projection may have the other sign throughout", "[cameras]")
{
    const Matrix v = lookAlong(eye, view, up), &p = projections[3];
    Matrix negative = p;
    for (float& value : negative.at)
        value = -value;
    const dfb::MatrixCamera camera(v.at, p.at), other(v.at, negative.at);
    REQUIRE(camera.isOrthographic());
    CHECK(other.isOrthographic());
    for (const double x : {0.5, 60.0, 119.5}) {
        const dfb::Ray ray = camera.ray(x, 20, 120, 90), same = other.ray(x, 20, 120, 90);
        CHECK((ray.origin == same.origin && ray.direction == same.direction));
    }
}

TEST_CASE("Cameras that are none are refused", "[cameras]")
{
    using dfb::InvalidArgument;
    const Matrix v = lookAlong(eye, view, up), none;
    Matrix notFinite = projections[0];
    notFinite.at[5] = std::numeric_limits<float>::quiet_NaN();
    CHECK_THROWS_AS(dfb::MatrixCamera(v.at, none.at), InvalidArgument);
    CHECK_THROWS_AS(dfb::MatrixCamera(none.at, projections[0].at), InvalidArgument);
    CHECK_THROWS_AS(dfb::MatrixCamera(v.at, notFinite.at), InvalidArgument);
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

TEST_CASE("Cameras of numbers that are not finite are refused", "[cameras]")
{
    using dfb::InvalidArgument;
    using Limits = std::numeric_limits<float>;
    for (const float bad : {Limits::quiet_NaN(), Limits::infinity()}) {
        const dfb::Vec3 off{0, bad, 0};
        CHECK_THROWS_AS(dfb::PerspectiveCamera(off, {0, 0, 0}, up, 45), InvalidArgument);
        CHECK_THROWS_AS(dfb::PerspectiveCamera::along(off, view, up, 45), InvalidArgument);
        CHECK_THROWS_AS(dfb::PerspectiveCamera::along(eye, {0, 0, bad}, {1, 1, 1}, 45), InvalidArgument);
        CHECK_THROWS_AS(dfb::PerspectiveCamera::along(eye, view, off, 45), InvalidArgument);
        CHECK_THROWS_AS(dfb::ThinLensCamera(off, view, up, 45, 0.1f, 1), InvalidArgument);
        CHECK_THROWS_AS(dfb::ThinLensCamera(eye, view, up, 45, bad, 1), InvalidArgument);
        CHECK_THROWS_AS(dfb::StereoCamera(eye, view, up, 45, bad, 1), InvalidArgument);
        CHECK_THROWS_AS(dfb::DomeCamera(off, view, up), InvalidArgument);
        CHECK_THROWS_AS(dfb::OrbitBlurCamera(eye, view, up, 45, off, {0, 1, 0}, 5), InvalidArgument);
        CHECK_THROWS_AS(dfb::OrbitBlurCamera(eye, view, up, 45, {0, 0, 0}, off, 5), InvalidArgument);
    }
    CHECK_THROWS_AS(dfb::ThinLensCamera(eye, view, up, 45, 0.1f, Limits::quiet_NaN()), InvalidArgument);
    CHECK_THROWS_AS(dfb::StereoCamera(eye, view, up, 45, 0.1f, Limits::quiet_NaN()), InvalidArgument);
}

} // namespace cameras_cases
