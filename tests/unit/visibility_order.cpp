// The order of bricks from an eye: right for every ray, or an error.
#include "catch.hpp"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <limits>
#include <random>
#include <string>
#include <vector>

namespace visibility_order_cases {

namespace {

using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, dfb::InprocTransport>;

// Of one rank that holds all.
template <class Check>
void withWorld(const std::vector<dfb::Brick>& bricks, const Check& check)
{
    dfb::FrameBufferConfig config;
    config.width = config.height = 8;
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
    const auto uniform = [&](double a, double b) { return a + (b - a) * (random() % 100000) / 1e5; };
    for (int round = 0; round < 40; ++round) {
        std::vector<dfb::Brick> bricks;
        bisect(random, {{-1, -1, -1}, {1, 1, 1}}, 1 + static_cast<int>(random() % 40), bricks);
        const dfb::Vec3 eye{static_cast<float>(uniform(-2, 2)), static_cast<float>(uniform(-2, 2)),
                            static_cast<float>(uniform(-2, 2))};
        withWorld(bricks, [&](const dfb::SharedWorld& world) {
            const std::vector<int> order = dfb::visibilityOrder(world, eye);
            REQUIRE(order.size() == bricks.size());
            int wrong = 0;
            for (int ray = 0; ray < 300; ++ray) {
                const double d[3] = {uniform(-1, 1), uniform(-1, 1), uniform(-1, 1)};
                double before = -1;
                for (const int i : order) {
                    const double t = enter(world.bricks()[static_cast<std::size_t>(i)].brick.bounds, eye, d);
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

} // namespace visibility_order_cases
