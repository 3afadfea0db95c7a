// Frames of a scene that changes: what a tile does not write again must still be there, and be what it is taken for.
#pragma once

#include "everywhere.hpp"
#include "send_all.hpp"

#include <memory>
#include <stdexcept>
#include <string>

namespace algorithms {

// Bricks come, go and move; the background changes and changes back; frames fail in between, and all of it is compared
// with the reference frame by frame.
struct MovingBricks {
    static scene::Scene sceneOf(int frame)
    {
        // Wide and low bricks, so that most rows of a tile have runs of both.
        scene::Scene s;
        s.width = 211, s.height = 67, s.seed = 5;
        s.background = frame % 7 < 4 ? std::array<float, 4>{0.125f, 0.25f, 0.0f, 0.5f} : std::array<float, 4>{};
        const int bricks = frame % 5 == 4 ? 0 : 1 + frame % 3;
        for (int i = 0; i < bricks; ++i) {
            const int x = (37 * frame + 71 * i) % 180, y = (11 * frame + 23 * i) % 50;
            s.bricks.push_back({static_cast<std::uint32_t>(10 + i),
                                {{static_cast<float>(x), static_cast<float>(y), 0},
                                 {static_cast<float>(std::min(s.width, x + 3 + 29 * (i + 1))),
                                  static_cast<float>(std::min(s.height, y + 17)), 1}}});
        }
        return s;
    }

    template <class Transport>
    static void run(const typename Transport::Communicator& communicator, dfb::OutputFormat format, int threads,
                    Result& result)
    {
        dfb::FrameBufferConfig config = configOf(sceneOf(0), threads);
        config.format = format;
        config.depth = format == dfb::OutputFormat::RGBA32F;
        dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<64>, dfb::NoPixelOp, Transport> fb(communicator, config);
        for (int frame = 0; frame < 40; ++frame) {
            scene::Scene s = sceneOf(frame);
            const std::string what = "frame " + std::to_string(frame) + " ";
            if (frame % 6 == 3) { // some of its tiles may have been written
                const std::string outcome = scene::outcomeOf([&] {
                    auto open = fb.begin(paramsOf(s));
                    sendAll(fb, open, s, true);
                    if (fb.rank() == frame % fb.size())
                        open.abort(std::make_exception_ptr(std::runtime_error("on purpose")));
                    open.end();
                });
                result.expect(scene::has(outcome, "on purpose") || outcome == "fine", what + outcome);
                continue;
            }
            const scene::Loop loop = frame % 2 ? scene::Loop::Declared : scene::Loop::Listing3;
            const dfb::FrameReport report = renderLoop(fb, s, loop);
            if (fb.isDisplayRank()) {
                const scene::Picture picture(fb.image(), report);
                const std::size_t wrong = wrongValues(picture, referenceOf(s));
                result.expect(wrong == 0, what + std::to_string(wrong) + " values are wrong");
                result.hash = 3 * result.hash ^ picture.hash();
            }
        }
    }

    template <class Transport>
    static Result run(const typename Transport::Communicator& communicator)
    {
        Result result;
        run<Transport>(communicator, dfb::OutputFormat::RGBA32F, 2, result);
        run<Transport>(communicator, dfb::OutputFormat::RGBA8, 2, result);
        const std::uint64_t before = result.hash;
        result.hash = 0;
        run<Transport>(communicator, dfb::OutputFormat::RGBA32F, 0, result);
        run<Transport>(communicator, dfb::OutputFormat::RGBA8, 0, result);
        result.expect(result.hash == before, "images differ without workers");
        return result;
    }
};

// In moving.cpp, so that the tests over MPI need not compile them again.
extern template Result inProcess<MovingBricks>(int);

} // namespace algorithms

#if !defined(ALGORITHMS_WITHOUT_TESTS)
TEST_CASE("A scene may change from frame to frame as it likes", "[moving]") { everywhere<algorithms::MovingBricks>(); }
#endif
