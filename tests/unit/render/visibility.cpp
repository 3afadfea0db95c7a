// World, camera and visibility: the projection of a box covers all pixels whose rays can meet the box.
#include "brief.hpp"
#include "catch.hpp"
#include "random_rays.hpp"

#include <dfb/dfb.hpp>
#include <dfb/render/visibility.hpp>

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <random>
#include <set>
#include <string>
#include <utility>
#include <vector>

namespace visibility_cases {

namespace {

using rays::meets;
using rays::point;
using rays::Random;
using rays::uniform;

} // namespace

TEST_CASE("The projection of a box covers every pixel whose rays meet it", "[visibility]")
{
    Random random(21);
    int missed = 0, hits = 0, behind = 0, around = 0;
    std::string example;
    const std::vector<std::pair<int, int>> sizes{{40, 30}, {1, 1}, {64, 1}, {3, 57}};
    for (int i = 0; i < repeats(600); ++i) {
        const auto [width, height] = sizes[static_cast<std::size_t>(i) % sizes.size()];
        const dfb::Vec3 eye = point(random, 3), target = point(random, 1);
        const dfb::PerspectiveCamera camera(eye, target, {0.1f, 1.0f, -0.05f},
                                            static_cast<float>(uniform(random, 2, 160)));
        // From a thousandth of a unit to several, some of them around the eye or behind it.
        const float extent = static_cast<float>(std::pow(10.0, uniform(random, -3, 0.7)));
        const dfb::Vec3 center = i % 5 == 0 ? eye : point(random, 3);
        const dfb::Vec3 a = center + extent * point(random, 1), b = center + extent * point(random, 1);
        const dfb::Box3 box{{std::min(a.x, b.x), std::min(a.y, b.y), std::min(a.z, b.z)},
                            {std::max(a.x, b.x), std::max(a.y, b.y), std::max(a.z, b.z)}};
        const dfb::Region region = camera.project(box, width, height).region();
        CHECK(dfb::intersection(region, {0, 0, width, height}) == region);
        behind += region.empty();
        around += meets(eye, {1, 0, 0}, box) && meets(eye, {-1, 0, 0}, box);
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x)
                for (int s = 0; s < 5; ++s) {
                    // The corners and a random point of the pixel.
                    const double dx = s < 4 ? s % 2 : uniform(random, 0, 1), dy = s < 4 ? s / 2 : uniform(random, 0, 1);
                    if (!meets(eye,
                               camera.direction(static_cast<float>(x + dx), static_cast<float>(y + dy), width, height),
                               box))
                        continue;
                    ++hits;
                    if (!region.contains(x, y)) {
                        ++missed;
                        example =
                            "scene " + std::to_string(i) + ", pixel " + std::to_string(x) + ' ' + std::to_string(y);
                    }
                }
    }
    INFO(example);
    CHECK(missed == 0);
    // The scenes are not all of one kind.
    CHECK(hits > repeats(10000));
    CHECK(behind > repeats(50));
    CHECK(around > repeats(5));
}

TEST_CASE("The projection covers the points of boxes in large images, and not much more", "[visibility]")
{
    Random random(5);
    int missed = 0, inside = 0;
    double largest = 0;
    for (int i = 0; i < 300; ++i) {
        const int width = 2000, height = 1500;
        const dfb::PerspectiveCamera camera({0, 0, 10}, {0, 0, 0}, {0, 1, 0}, 40);
        const dfb::Vec3 center = point(random, 2);
        const auto extent = static_cast<float>(std::pow(10.0, uniform(random, -4, 0)));
        const dfb::Vec3 half{extent, 0.3f * extent, 0.7f * extent};
        const dfb::Box3 box{center - half, center + half};
        const dfb::Region region = camera.project(box, width, height).region();
        const double pixelsPerUnit = 0.5 * height / std::tan(20 * 3.14159265358979 / 180);
        double x0 = 1e9, x1 = -1e9, y0 = 1e9, y1 = -1e9;
        for (int k = 0; k < 9 * 9 * 9; ++k) {
            // Also the faces, edges and corners.
            const double fx = k % 9 / 8.0, fy = k / 9 % 9 / 8.0, fz = k / 81 / 8.0;
            const double px = box.lower.x + fx * (static_cast<double>(box.upper.x) - box.lower.x);
            const double py = box.lower.y + fy * (static_cast<double>(box.upper.y) - box.lower.y);
            const double pz = box.lower.z + fz * (static_cast<double>(box.upper.z) - box.lower.z);
            const double x = 0.5 * width + pixelsPerUnit * px / (10 - pz),
                         y = 0.5 * height - pixelsPerUnit * py / (10 - pz);
            x0 = std::min(x0, x), x1 = std::max(x1, x);
            y0 = std::min(y0, y), y1 = std::max(y1, y);
            const int column = static_cast<int>(std::floor(x)), row = static_cast<int>(std::floor(y));
            if (column < 0 || column >= width || row < 0 || row >= height)
                continue;
            ++inside;
            missed += !region.contains(column, row);
        }
        if (!region.empty())
            largest = std::max({largest, region.width() - (x1 - x0), region.height() - (y1 - y0)});
    }
    CHECK(missed == 0);
    CHECK(inside > repeats(100000));
    // The margin on each side, and the pixels that the ends lie in: the corners of a box are its extremes.
    CHECK(largest <= 2.3);
}

TEST_CASE("Boxes behind, around and beside the camera", "[visibility]")
{
    const dfb::PerspectiveCamera camera({0, 0, 5}, {0, 0, 0}, {0, 1, 0}, 60);
    CHECK(camera.project({{-1, -1, 6}, {1, 1, 8}}, 100, 80).region().empty());
    CHECK(camera.project({{-1, -1, 4}, {1, 1, 8}}, 100, 80).region() == dfb::Region{0, 0, 100, 80});
    CHECK(camera.project({{50, -1, -1}, {52, 1, 1}}, 100, 80).region().empty());
    // So wide that its corners are at a right angle to the view: it still fills the image.
    for (const float wide : {1e4f, 1e8f, 1e30f}) {
        INFO("half width " << wide);
        CHECK(camera.project({{-wide, -wide, -1}, {wide, wide, 1}}, 100, 80).region() == dfb::Region{0, 0, 100, 80});
    }
    const dfb::Region speck = camera.project({{0, 0, 0}, {0, 0, 0}}, 100, 80).region();
    CHECK(speck.contains(50, 40));
    CHECK(speck.width() <= 2);
    CHECK(speck.height() <= 2);
}

TEST_CASE("A footprint meets the tiles that the box projects to, and no others", "[visibility]")
{
    Random random(8);
    const int width = 1500, height = 1100;
    const dfb::TileLayout layout(width, height, 64);
    const double scale = 0.5 * height / std::tan(20 * 3.14159265358979 / 180);
    int missed = 0, superfluous = 0, saved = 0, pairs = 0;
    for (int i = 0; i < repeats(60); ++i) {
        const dfb::PerspectiveCamera camera({0, 0, 10}, {0, 0, 0}, {0, 1, 0}, 40);
        const dfb::Vec3 center = point(random, 3);
        const auto extent = static_cast<float>(std::pow(10.0, uniform(random, -4, 0.3)));
        const dfb::Vec3 half{extent, 0.2f * extent, 2 * extent};
        const dfb::Box3 box{center - half, center + half};
        if (box.upper.z > 9)
            continue;
        // Points of its faces, densely.
        std::vector<std::pair<double, double>> points;
        const int n = 40;
        for (int face = 0; face < 6; ++face)
            for (int a = 0; a <= n; ++a)
                for (int b = 0; b <= n; ++b) {
                    double f[3];
                    f[face % 3] = face / 3;
                    f[(face + 1) % 3] = static_cast<double>(a) / n;
                    f[(face + 2) % 3] = static_cast<double>(b) / n;
                    const double px = box.lower.x + f[0] * (static_cast<double>(box.upper.x) - box.lower.x);
                    const double py = box.lower.y + f[1] * (static_cast<double>(box.upper.y) - box.lower.y);
                    const double pz = box.lower.z + f[2] * (static_cast<double>(box.upper.z) - box.lower.z);
                    points.emplace_back(0.5 * width + scale * px / (10 - pz), 0.5 * height - scale * py / (10 - pz));
                }
        double x0 = 1e9, x1 = -1e9, y0 = 1e9, y1 = -1e9;
        for (const auto& [x, y] : points) {
            x0 = std::min(x0, x), x1 = std::max(x1, x);
            y0 = std::min(y0, y), y1 = std::max(y1, y);
        }
        const double between = 3 * std::max(x1 - x0, y1 - y0) / n; // more than from one point to the next
        std::set<int> found;
        for (const auto& pair : dfb::visibleTiles(dfb::World({{1, box}}), camera, layout))
            found.insert(pair.tile);
        pairs += static_cast<int>(found.size());
        for (int tile = 0; tile < layout.tileCount(); ++tile) {
            const dfb::Region r = layout.region(tile);
            const bool isFound = found.count(tile) != 0;
            double nearest = 1e9; // of a tile that was not found it matters only whether it is 0
            for (const auto& [x, y] : points) {
                const double dx = std::max({0.0, r.x0 - x, x - r.x1}), dy = std::max({0.0, r.y0 - y, y - r.y1});
                if (isFound || (dx == 0 && dy == 0))
                    nearest = std::min(nearest, std::hypot(dx, dy));
            }
            missed += nearest == 0 && !isFound;
            superfluous += nearest > between + 0.2 && isFound;
            saved += found.count(tile) == 0 && x0 < r.x1 && x1 > r.x0 && y0 < r.y1 && y1 > r.y0;
        }
    }
    CHECK(missed == 0);
    CHECK(superfluous == 0);
    CHECK(pairs > repeats(300));
    CHECK(saved > repeats(10)); // within the rectangle around the projection
}

TEST_CASE("Degenerate cameras and bricks that are none are refused", "[visibility]")
{
    using Camera = dfb::PerspectiveCamera;
    CHECK_THROWS_AS(Camera({1, 2, 3}, {1, 2, 3}, {0, 1, 0}, 40), dfb::InvalidArgument);
    CHECK_THROWS_AS(Camera({0, 5, 0}, {0, 0, 0}, {0, 1, 0}, 40), dfb::InvalidArgument);
    CHECK_THROWS_AS(Camera({0, 0, 5}, {0, 0, 0}, {0, 1, 0}, 0), dfb::InvalidArgument);
    CHECK_THROWS_AS(Camera({0, 0, 5}, {0, 0, 0}, {0, 1, 0}, 180), dfb::InvalidArgument);

    const float notANumber = std::numeric_limits<float>::quiet_NaN(), infinity = std::numeric_limits<float>::infinity();
    dfb::World world;
    world.add({7, {{0, 0, 0}, {1, 1, 1}}});
    CHECK_THROWS_AS(world.add({7, {{2, 0, 0}, {3, 1, 1}}}), dfb::InvalidArgument);
    CHECK_THROWS_AS(world.add({8, {{2, 0, 0}, {1, 1, 1}}}), dfb::InvalidArgument);
    CHECK_THROWS_AS(world.add({8, {{0, notANumber, 0}, {1, 1, 1}}}), dfb::InvalidArgument);
    CHECK_THROWS_AS(world.add({8, {{0, 0, 0}, {1, 1, infinity}}}), dfb::InvalidArgument);
    CHECK(world.bricks().size() == 1);
    CHECK_NOTHROW(world.add({8, {{1, 1, 1}, {1, 1, 1}}}));
}

TEST_CASE("Two ids with equal bounds are two bricks", "[visibility]")
{
    const dfb::PerspectiveCamera camera({0, 0, 5}, {0, 0, 0}, {0, 1, 0}, 60);
    const dfb::TileLayout layout(100, 80, 16);
    const dfb::Box3 left{{-1, -1, -1}, {0, 1, 1}};
    const dfb::World one({{1, left}}), twins({{1, left}, {2, left}});
    CHECK(dfb::visibleTiles(twins, camera, layout).size() == 2 * dfb::visibleTiles(one, camera, layout).size());
}

TEST_CASE("visibleTiles pairs each brick with the tiles that its projection meets", "[visibility]")
{
    const dfb::PerspectiveCamera camera({0, 0, 5}, {0, 0, 0}, {0, 1, 0}, 60);
    const dfb::TileLayout layout(100, 80, 16);
    const dfb::World world(
        {{5, {{-1, -1, -1}, {0, 0, 0}}}, {3, {{0, 0, 0}, {1, 1, 1}}}, {9, {{-1, -1, 6}, {1, 1, 8}}}});
    const auto pairs = dfb::visibleTiles(world, camera, layout);
    std::set<std::pair<int, int>> found;
    for (const auto& p : pairs)
        found.emplace(p.tile, p.brick);
    CHECK(found.size() == pairs.size());
    std::set<std::pair<int, int>> expected;
    for (int brick = 0; brick < 3; ++brick)
        for (int tile = 0; tile < layout.tileCount(); ++tile)
            if (camera.project(world.bricks()[static_cast<std::size_t>(brick)].bounds, 100, 80)
                    .meets(layout.region(tile)))
                expected.emplace(tile, brick);
    CHECK(found == expected);
    CHECK(std::is_sorted(pairs.begin(), pairs.end(), [](const auto& a, const auto& b) { return a.tile < b.tile; }));

    const auto inputs = dfb::inputsOf(world, pairs);
    REQUIRE(inputs.size() == pairs.size());
    for (std::size_t i = 0; i < inputs.size(); ++i) {
        CHECK(inputs[i].tile == pairs[i].tile);
        CHECK(inputs[i].source == world.bricks()[static_cast<std::size_t>(pairs[i].brick)].id);
        CHECK(inputs[i].part == 0);
    }
    CHECK(dfb::visibleTiles(dfb::World(), camera, layout).empty());
}

} // namespace visibility_cases

// The order of bricks from an eye: right for every ray, or an error.
namespace visibility_order_cases {

namespace {

using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, dfb::InprocTransport>;

// Of one rank that holds all.
template <class Check>
void withWorld(const std::vector<dfb::Brick>& bricks, const Check& check)
{
    dfb::FrameBufferConfig config;
    config.image.width = config.image.height = 8;
    dfb::runRanks(1, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer fb(communicator, config);
        check(dfb::SharedWorld(fb, dfb::World(bricks)));
    });
}

// Where a ray enters a box; infinity if it misses.
double enter(const dfb::Box3& b, const dfb::Vec3& e, const double (&d)[3])
{
    const double lo[3] = {b.lower.x, b.lower.y, b.lower.z}, hi[3] = {b.upper.x, b.upper.y, b.upper.z},
                 eye[3] = {e.x, e.y, e.z};
    double first = 0, last = 1e300;
    for (int i = 0; i < 3; ++i) {
        const double t0 = (lo[i] - eye[i]) / d[i], t1 = (hi[i] - eye[i]) / d[i];
        first = std::max(first, std::min(t0, t1));
        last = std::min(last, std::max(t0, t1));
    }
    return first < last ? first : std::numeric_limits<double>::infinity();
}

void bisect(std::mt19937& random, const dfb::Box3& box, int count, std::vector<dfb::Brick>& bricks)
{
    if (count == 1) {
        bricks.push_back({static_cast<std::uint32_t>(random()), box});
        return;
    }
    dfb::Box3 a = box, b = box;
    const float f = 0.3f + 0.4f * static_cast<float>(random() % 1000) / 1000;
    switch (random() % 3) {
    case 0: a.upper.x = b.lower.x = box.lower.x + f * (box.upper.x - box.lower.x); break;
    case 1: a.upper.y = b.lower.y = box.lower.y + f * (box.upper.y - box.lower.y); break;
    default: a.upper.z = b.lower.z = box.lower.z + f * (box.upper.z - box.lower.z); break;
    }
    bisect(random, a, count / 2, bricks);
    bisect(random, b, count - count / 2, bricks);
}

} // namespace

TEST_CASE("The bricks of a bisection have an order from anywhere", "[visibility_order]")
{
    std::mt19937 random(3);
    const auto uniform = [&](double a, double b) { return a + (b - a) * static_cast<double>(random() % 100000) / 1e5; };
    for (int round = 0; round < repeats(40); ++round) {
        std::vector<dfb::Brick> bricks;
        bisect(random, {{-1, -1, -1}, {1, 1, 1}}, 1 + static_cast<int>(random() % 40), bricks);
        const dfb::Vec3 eye{static_cast<float>(uniform(-2, 2)), static_cast<float>(uniform(-2, 2)),
                            static_cast<float>(uniform(-2, 2))};
        withWorld(bricks, [&](const dfb::SharedWorld& world) {
            const std::vector<int> order = dfb::visibilityOrder(world, eye);
            REQUIRE(order.size() == bricks.size());
            const dfb::PerspectiveCamera camera(eye, {eye.x, eye.y, eye.z - 1}, {0, 1, 0}, 45);
            CHECK(dfb::visibilityOrder(world, camera) == order);
            int wrong = 0;
            for (int ray = 0; ray < 300; ++ray) {
                const double d[3] = {uniform(-1, 1), uniform(-1, 1), uniform(-1, 1)};
                double before = -1;
                for (const int i : order) {
                    const double t = enter(world.bricks()[static_cast<std::size_t>(i)].bounds, eye, d);
                    if (t == std::numeric_limits<double>::infinity())
                        continue;
                    wrong += t < before;
                    before = t;
                }
            }
            CHECK(wrong == 0);
        });
    }
}

TEST_CASE("The bricks of a bisection have an order along any direction", "[visibility_order]")
{
    std::mt19937 random(5);
    const auto uniform = [&](double a, double b) { return a + (b - a) * static_cast<double>(random() % 100000) / 1e5; };
    for (int round = 0; round < repeats(40); ++round) {
        std::vector<dfb::Brick> bricks;
        bisect(random, {{-1, -1, -1}, {1, 1, 1}}, 1 + static_cast<int>(random() % 40), bricks);
        // Looks along -z of its view, whose axes are two turns of those of the world; or along an axis.
        const double a = round < 4 ? 1.5707963267948966 * round : uniform(0, 6.28),
                     b = round < 4 ? 0 : uniform(-1.5, 1.5);
        const dfb::Vec3 right{static_cast<float>(std::cos(a)), 0, static_cast<float>(-std::sin(a))},
            back{static_cast<float>(std::sin(a) * std::cos(b)), static_cast<float>(std::sin(b)),
                 static_cast<float>(std::cos(a) * std::cos(b))},
            top = cross(back, right);
        const float view[16] = {right.x, top.x, back.x, 0, right.y, top.y, back.y, 0,
                                right.z, top.z, back.z, 0, 0,       0,     0,      1};
        const float projection[16] = {0.5f, 0, 0, 0, 0, 0.5f, 0, 0, 0, 0, -0.1f, 0, 0, 0, 0, 1};
        const dfb::MatrixCamera camera(view, projection);
        withWorld(bricks, [&](const dfb::SharedWorld& world) {
            const std::vector<int> order = dfb::visibilityOrder(world, camera);
            REQUIRE(order.size() == bricks.size());
            int wrong = 0, hits = 0;
            for (int i = 0; i < 300; ++i) {
                const dfb::Ray ray = camera.ray(uniform(0, 100), uniform(0, 100), 100, 100);
                const double d[3] = {ray.direction.x, ray.direction.y, ray.direction.z};
                double before = -1;
                for (const int place : order) {
                    const double t = enter(world.bricks()[static_cast<std::size_t>(place)].bounds, ray.origin, d);
                    if (t == std::numeric_limits<double>::infinity())
                        continue;
                    wrong += t < before;
                    ++hits;
                    before = t;
                }
            }
            CHECK(wrong == 0);
            CHECK(hits > 50);
        });
    }
}

TEST_CASE("For a camera without a common eye there is no order", "[visibility_order]")
{
    struct Lens {
        std::optional<dfb::Vec3> commonEye() const { return std::nullopt; }
    };
    withWorld({}, [](const dfb::SharedWorld& world) {
        CHECK_THROWS_AS(dfb::visibilityOrder(world, Lens()), dfb::InvalidArgument);
    });
}

TEST_CASE("Flat bricks beside each other have an order from both sides", "[visibility_order]")
{
    const std::vector<dfb::Brick> flat{{1, {{0, 0, 0}, {1, 1, 0}}}, {2, {{1, 0, 0}, {2, 1, 0}}}};
    withWorld(flat, [](const dfb::SharedWorld& world) {
        for (const float x : {0.5f, 1.5f})
            for (const float z : {-9.0f, 0.0f, 9.0f})
                CHECK(dfb::visibilityOrder(world, dfb::Vec3{x, 0.5f, z}).size() == 2);
    });
}

TEST_CASE("Bricks that overlap or stand in a circle have no order", "[visibility_order]")
{
    const auto outcome = [](const std::vector<dfb::Brick>& bricks) {
        std::string text = "fine";
        withWorld(bricks, [&](const dfb::SharedWorld& world) {
            try {
                dfb::visibilityOrder(world, {10, 10, 10});
            } catch (const dfb::InvalidArgument& e) {
                text = e.what();
            }
        });
        return text;
    };
    CHECK(outcome({{1, {{0, 0, 0}, {2, 2, 2}}}, {2, {{1, 1, 1}, {3, 3, 3}}}}).find("overlap") != std::string::npos);
    // Three beams, each over the end of the next.
    const std::vector<dfb::Brick> beams{
        {1, {{0, 0, 1}, {9, 1, 2}}}, {2, {{8, 0, 2}, {9, 9, 3}}}, {3, {{0, 0.5f, 0}, {1, 9, 1}}}};
    CHECK(outcome(beams) == "fine");
    const std::vector<dfb::Brick> circle{
        {1, {{0, 1, 2}, {9, 2, 3}}}, {2, {{2, 0, 1}, {3, 9, 2}}}, {3, {{1, 2, 0}, {2, 3, 9}}}};
    CHECK(outcome(circle).find("circle") != std::string::npos);
}

TEST_CASE("An order that is kept is that of the last eye and boxes", "[visibility_order]")
{
    dfb::detail::FrontToBack kept;
    const auto check = [&](const std::vector<dfb::Brick>& bricks, const dfb::Vec3& eye, const std::vector<int>& order) {
        withWorld(bricks, [&](const dfb::SharedWorld& world) {
            CHECK((kept.find(world, eye) == nullptr) == !order.empty());
            CHECK(kept.order() == order);
        });
    };
    const dfb::Box3 a{{0, 0, 0}, {1, 1, 1}}, b{{1, 0, 0}, {2, 1, 1}}, c{{-2, 0, 0}, {-1, 1, 1}};
    check({{1, a}, {2, b}}, {-5, 0, 0}, {0, 1});
    check({{1, a}, {2, b}}, {5, 0, 0}, {1, 0}); // the eye has moved
    check({{1, a}, {2, b}}, {5, 0, 0}, {1, 0});
    check({{1, a}}, {5, 0, 0}, {0});
    check({{1, a}, {2, c}}, {5, 0, 0}, {0, 1}); // a box has
    check({{3, c}, {4, a}}, {5, 0, 0}, {1, 0}); // another world with as many
    check({{3, a}, {4, a}}, {5, 0, 0}, {});
    check({{3, a}, {4, a}}, {5, 0, 0}, {}); // that there is no order is kept as well
    check({{3, a}, {4, c}}, {5, 0, 0}, {0, 1});
}

} // namespace visibility_order_cases
