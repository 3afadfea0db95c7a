// Bricks that several ranks hold, and bricks in order.
#include "catch.hpp"

#include <dfb/comm/inproc_transport.hpp>
#include <dfb/distributed_framebuffer.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/render/mixed_parallel.hpp>

#include <atomic>
#include <chrono>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace mixed_parallel_cases {

namespace {

template <class Op>
using FrameBuffer = dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, dfb::InprocTransport>;

const dfb::PerspectiveCamera pinhole({0, 1, 8}, {0, 0, 0}, {0, 1, 0}, 35);

// Waits for something that other ranks do, but not for ever.
template <class IsDone>
void waitUntil(const IsDone& isDone)
{
    const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(10);
    while (!isDone() && std::chrono::steady_clock::now() < limit)
        std::this_thread::yield();
}

// Throws on rank 1 when it is asked where its rays begin.
struct BrokenCamera {
    int rank = 0;

    std::optional<dfb::Vec3> commonEye() const
    {
        if (rank == 1)
            throw std::runtime_error("no eye");
        return pinhole.commonEye();
    }
    dfb::Footprint project(const dfb::Box3& bounds, int width, int height) const
    {
        return pinhole.project(bounds, width, height);
    }
};

} // namespace

TEST_CASE("Fronts come first, and all else in the order that it had", "[mixed]")
{
    // In tiles 0 to 3 bricks 0 to 2 are behind each other, in tile 4 is brick 2 alone.
    dfb::detail::OrderedWork work;
    for (int tile = 0; tile < 5; ++tile) {
        work.firstPair.push_back(static_cast<int>(work.pairs.size()));
        for (int brick = tile == 4 ? 2 : 0; brick < 3; ++brick)
            work.pairs.push_back({brick, tile});
    }
    // A rank has bricks 1 and 2, and what is in front in tile 1 as well; two passes of tile 3.
    for (std::size_t p = 0; p < work.pairs.size(); ++p)
        if (work.pairs[p].brick > 0 || work.pairs[p].tile == 1)
            for (int pass = 0; pass < (work.pairs[p].tile == 3 ? 2 : 1); ++pass)
                work.jobs.push_back({p, pass});

    work.renderFrontsFirst();

    using Order = std::vector<std::vector<int>>; // tile, brick, pass
    Order order;
    for (const auto& job : work.jobs)
        order.push_back({work.pairs[job.item].tile, work.pairs[job.item].brick, job.pass});
    CHECK(order
          == Order{{1, 0, 0},
                   {4, 2, 0}, // these two are fronts
                   {0, 1, 0},
                   {0, 2, 0},
                   {1, 1, 0},
                   {1, 2, 0},
                   {2, 1, 0},
                   {2, 2, 0},
                   {3, 1, 0},
                   {3, 1, 1},
                   {3, 2, 0},
                   {3, 2, 1}});
    CHECK(work.generationOf(work.jobs[1]) == 0);
    CHECK(work.generationOf(work.jobs[5]) == 2);
}

TEST_CASE("What costs more than twice the mean comes first, and all else in the order that it had", "[mixed]")
{
    struct Owner {
        int operator()(const dfb::SharedBrick&, int, int) const { return 0; }
        double costOf(const dfb::SharedBrick&, int tile) const { return tile == 2 || tile == 4 ? 20 : 1; }
    } owner;
    dfb::runRanks(1, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<dfb::AlphaBlend> fb(communicator, dfb::FrameBufferConfig(10, 10));
        const dfb::SharedWorld world(fb, dfb::World({{7, {{0, 0, 0}, {1, 1, 1}}}}));
        dfb::detail::MixedWork work;
        for (int tile = 0; tile < 6; ++tile)
            work.pairs.push_back({0, tile});
        // A pass of tile 2 costs 5: more than the mean, 44 / 9, but less than twice the mean.
        work.passes = {1, 1, 4, 1, 1, 1};
        for (const std::size_t item : {0, 1, 2, 2, 2, 2, 3, 4, 5})
            work.jobs.push_back({item, 0});
        work.renderCostlyFirst(world, owner);
        std::vector<std::size_t> items;
        for (const dfb::detail::Job& job : work.jobs)
            items.push_back(job.item);
        CHECK(items == std::vector<std::size_t>{4, 0, 1, 2, 2, 2, 2, 3, 5});
        work.renderCostlyFirst(world, dfb::RoundRobinBricks()); // knows no costs
        CHECK(work.jobs.front().item == 4);
    });
}

TEST_CASE("A cost that is not a number leaves the work shared out evenly", "[mixed]")
{
    int onRank[2] = {};
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        FrameBuffer<dfb::AlphaBlend> fb(communicator, {64, 64});
        dfb::World world;
        std::vector<dfb::BrickInTile> pairs;
        for (int brick = 0; brick < 8; ++brick) {
            world.add({static_cast<std::uint32_t>(brick), {}});
            pairs.push_back({brick, 0});
        }
        const dfb::SharedWorld shared(fb, world);
        dfb::MeasuredCostBricks owner;
        dfb::FrameReport report;
        for (int brick = 0; brick < 8; ++brick)
            report.figures.push_back({dfb::MeasuredCostBricks::keyOf(static_cast<std::uint32_t>(brick), 0), 1});
        report.figures[3].value = std::numeric_limits<double>::quiet_NaN();
        owner.update(report);
        owner.plan(shared, pairs, std::vector<int>(pairs.size(), 1));
        if (fb.rank() == 0)
            for (const auto& brick : shared.bricks())
                ++onRank[owner(brick, 0, 0)];
    });
    CHECK(onRank[0] == 4);
    CHECK(onRank[1] == 4);
}

TEST_CASE("What a camera throws on one rank is what all ranks report", "[mixed]")
{
    // A late rank 1 gets the inputs of the others before it begins the frame. They have no depth, as these ranks have
    // an order.
    for (const bool isLate : {false, true}) {
        INFO((isLate ? "late" : "in time"));
        std::atomic<int> told{0}, sent{0};
        dfb::runRanks(3, [&](dfb::InprocCommunicator communicator) {
            dfb::FrameBufferConfig config{64, 64};
            config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 1; };
            FrameBuffer<dfb::AlphaBlend> fb(communicator, config);
            const auto id = static_cast<std::uint32_t>(fb.rank());
            const dfb::SharedWorld world(fb, dfb::World({{id, {{-1, -1, -1.0f - id}, {1, 1, -0.0f - id}}}}));
            dfb::RoundRobinBricks owner;
            dfb::MixedParallelLoop loop(fb, world, owner);
            if (isLate && fb.rank() == 1)
                waitUntil([&] { return sent == 2; });
            auto frame = loop.start(BrokenCamera{fb.rank()}, [](const dfb::Brick&, auto& tile) {
                tile.forEachPixel([](int, int, float* rgba, float&) { rgba[3] = 1; });
            });
            ++sent;
            try {
                frame.end();
            } catch (const dfb::FrameError& e) {
                told += e.info().kind == dfb::ErrorKind::UserCode && e.info().rank == 1
                        && std::string(e.what()).find("no eye") != std::string::npos;
            }
        });
        CHECK(told == 3);
    }
}

// The first brick hides the other in one frame, and throws in the next. Rank 1 is late, so it has been told to wait.
TEST_CASE("Nobody waits for word of an input whose renderer has thrown", "[mixed]")
{
    std::atomic<bool> hasThrown{false}, isSeen{false};
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        dfb::FrameBufferConfig config{64, 64};
        config.quiet = std::chrono::seconds(30);
        FrameBuffer<dfb::OrderedBlend> fb(communicator, config);
        const auto id = static_cast<std::uint32_t>(fb.rank());
        const dfb::SharedWorld world(fb, dfb::World({{id, {{-1, -1, -1.0f - id}, {1, 1, -0.0f - id}}}}));
        dfb::RoundRobinBricks owner;
        dfb::OrderedLoop loop(fb, world, owner);
        const std::vector<int> order = dfb::visibilityOrder(world, pinhole);
        const auto opaque = [](auto& tile) { tile.forEachPixel([](int, int, float* rgba, float&) { rgba[3] = 1; }); };
        loop.render(pinhole, order, [&](const dfb::Brick&, auto& tile) { opaque(tile); });
        dfb::FrameConfig params;
        params.allowPartial = true;
        if (fb.rank() == 1)
            waitUntil([&] { return hasThrown.load(); });
        auto frame = loop.start(
            pinhole, order,
            [&](const dfb::Brick& brick, auto& tile) {
                (brick.id == 0 ? hasThrown : isSeen) = true;
                if (brick.id == 0)
                    throw std::runtime_error("the front is gone");
                opaque(tile);
            },
            params);
        if (fb.rank() == 0) {
            waitUntil([&] { return isSeen.load(); });
            frame.cancel();
        }
        frame.end();
    });
    CHECK(isSeen);
}

} // namespace mixed_parallel_cases
