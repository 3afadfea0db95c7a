// Several frames in flight do not disturb each other. In one process and over MPI (everywhere.hpp).

#include "everywhere.hpp"
#include "send_all.hpp"

#include <deque>
#include <memory>
#include <utility>

namespace frame_cases {

struct TwoFrames {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        auto config = configOf(scene::makeScene(1), 2);
        config.framesInFlight = 2;
        dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport> fb(communicator, config);
        const auto check = [&](const dfb::FrameReport& report, const scene::Scene& s, const std::string& which) {
            result.hash = result.hash * 31 + checkedHash(result, fb, report, s, which);
        };
        for (std::uint64_t round = 0; round < 4; ++round) {
            const scene::Scene a = scene::makeScene(5, 2 * round + 1), b = scene::makeScene(7, 2 * round + 2);
            auto first = fb.begin(paramsOf(a));
            sendAll(fb, first, a, false);
            auto second = fb.begin(paramsOf(b));
            result.expect(second.number() == first.number() + 1, "numbers");
            sendAll(fb, second, b, false);
            sendAll(fb, first, a, true);
            const std::string third = scene::outcomeOf([&] { (void)fb.begin(paramsOf(a)); });
            result.expect(scene::has(third, "end() it first"), "a third frame: " + third);
            sendAll(fb, second, b, true);
            if (round == 2) { // one fails, the other does not
                if (fb.rank() == fb.size() - 1)
                    first.abort(std::make_exception_ptr(std::runtime_error("on purpose")));
                const std::string outcome = scene::outcomeOf([&] { first.end(); });
                result.expect(scene::has(outcome, "on purpose"), outcome);
            } else {
                check(first.end(), a, "first");
            }
            check(second.end(), b, "second");
        }
        return result;
    }
};

// Frames of different loops, each begun before the frame before it has ended.
struct LoopsInFlight {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(5, 3);
        auto config = configOf(s, 2);
        config.framesInFlight = 3;
        dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport> fb(communicator, config);
        dfb::World world;
        for (const dfb::Brick& b : bricksOf(s, fb.rank(), fb.size()))
            world.add(b);
        const dfb::SharedWorld shared(fb, world);
        dfb::RoundRobinBricks inTurn;
        const auto render = [&](const dfb::Brick& b, auto& tile) { renderBrick(s, b, tile); };
        dfb::DataParallelLoop dataLoop(fb, world);
        dfb::MixedParallelLoop mixedLoop(fb, shared, inTurn);
        std::deque<decltype(fb.begin())> open;
        for (int round = 0; round < 9; ++round) {
            if (open.size() == 3) {
                const dfb::FrameReport report = open.front().end();
                open.pop_front();
                result.expect(report.frame == round - 2, "not the oldest");
                result.hash = checkedHash(result, fb, report, s, "round " + std::to_string(round));
            }
            open.push_back(round % 2 == 0 ? dataLoop.start(scene::FlatCamera(), render, paramsOf(s))
                                          : mixedLoop.start(scene::FlatCamera(), render, paramsOf(s)));
        }
        while (open.size() > 1) {
            open.front().end();
            open.pop_front();
        }
        return result; // the last frame is not ended, so it is cancelled
    }
};

// Two framebuffers of different sizes and operations, over one connection.
struct TwoFrameBuffers {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const auto connection = dfb::connect<Transport>(communicator);
        const scene::Scene a = scene::makeScene(5, 3), b = scene::makeScene(1, 4, 128, 33);
        dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport> blend(connection,
                                                                                               configOf(a, 1));
        dfb::DistributedFrameBuffer<dfb::BasicImageParallel<32>, dfb::NoPixelOp, Transport> single(connection,
                                                                                                   configOf(b, 1));
        dfb::ImageParallelLoop loop(single, dfb::WorkDistribution::Dynamic);
        for (int round = 0; round < 3; ++round) {
            auto frame = blend.begin(paramsOf(a));
            sendAll(blend, frame, a, false);
            const auto other = loop.render([&](auto& tile) { renderBrick(b, b.bricks[0], tile); }, paramsOf(b));
            sendAll(blend, frame, a, true);
            const auto report = frame.end();
            if (!blend.isDisplayRank())
                continue;
            const scene::Picture pictureA(blend.image(), report), pictureB(single.image(), other);
            result.expect(wrongValues(pictureA, referenceOf(a)) == 0 && wrongValues(pictureB, referenceOf(b)) == 0,
                          "values");
            result.hash = pictureA.hash() ^ 3 * pictureB.hash();
        }
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("Two frames of one framebuffer at once do not disturb each other", "[in_flight]")
{
    everywhere<frame_cases::TwoFrames>();
}

TEST_CASE("Rendering loops begin a frame before others have ended", "[in_flight]")
{
    everywhere<frame_cases::LoopsInFlight>();
}

TEST_CASE("Two framebuffers with open frames do not disturb each other", "[in_flight]")
{
    everywhere<frame_cases::TwoFrameBuffers>();
}
