// Frames of a scene that changes: what a tile does not write again must still be in the image, and what ranks remember
// of the last frame must still be true. In one process and over MPI (everywhere.hpp).

#include "everywhere.hpp"
#include "send_all.hpp"

#include <deque>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

namespace frame_cases {

// Bricks come, go and move; the background changes and changes back; frames fail in between. Each frame is compared
// with the reference.
struct MovingBricks {
    static scene::Scene sceneOf(int frame)
    {
        // Bricks are wide and low, so that most rows of a tile have runs of both brick and background pixels.
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

    static void run(const Transport::Communicator& communicator, dfb::OutputFormat format, int threads, Result& result)
    {
        dfb::FrameBufferConfig config = configOf(sceneOf(0), threads);
        config.image.format = format;
        config.image.depth = format == dfb::OutputFormat::RGBA32F;
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
            result.hash = 3 * result.hash ^ checkedHash(result, fb, report, s, "frame " + std::to_string(frame));
        }
    }

    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        run(communicator, dfb::OutputFormat::RGBA32F, 2, result);
        result.hash = 0;
        run(communicator, dfb::OutputFormat::RGBA8, 2, result);
        const std::uint64_t before = result.hash;
        result.hash = 0;
        run(communicator, dfb::OutputFormat::RGBA8, 0, result);
        result.expect(result.hash == before, "images differ without workers");
        return result;
    }
};

// Bricks move within a rank and between ranks, come and go; cameras turn and stand still; frames fail before and after
// their declarations. What ranks remember of the last frame must still be true. Each image is that of a new
// framebuffer, bit for bit, in every loop that declares its inputs.
struct ChangingDeclarations {
    // When one rank fails: before it has declared its inputs, or when others have declared theirs.
    enum class Fails { Never, LookedUp, Rendered };

    // A camera that has turned by x and y pixels. On the rank that is to fail, it throws.
    struct Turned {
        int x = 0, y = 0;
        bool throws = false;

        dfb::Region project(const dfb::Box3& b, int width, int height) const
        {
            if (throws)
                throw std::runtime_error("no camera");
            const dfb::Region r = scene::FlatCamera().project(b, width, height);
            return {r.x0 + x, r.y0 + y, r.x1 + x, r.y1 + y};
        }
    };

    struct Step {
        const char* name;
        std::vector<dfb::Brick> bricks; // before the camera turns
        std::vector<int> holders;       // modulo the number of ranks
        Turned camera;
        Fails fails = Fails::Never;
    };

    static dfb::Brick brick(std::uint32_t id, float x, float y, float width, float height)
    {
        return {id, {{x, y, 0}, {x + width, y + height, 1}}};
    }

    static std::vector<Step> steps()
    {
        const std::vector<dfb::Brick> all{brick(5, 3, 2, 40, 30), brick(6, 30, 12, 29, 41), brick(9, 51, 33, 16, 9),
                                          brick(2, 70, 1, 20, 50)};
        std::vector<dfb::Brick> moved = all, fewer = all;
        moved[1] = brick(6, 1, 20, 29, 41);
        fewer.erase(fewer.begin());
        const std::vector<int> home{0, 1, 2, 3}, away{0, 2, 2, 3};
        return {{"the first", all, home, {}},
                {"the same", all, home, {}},
                {"the camera has turned", all, home, {14, -9}},
                {"and stands", all, home, {14, -9}},
                {"a brick is on another rank", all, away, {14, -9}},
                {"and back, elsewhere", moved, home, {14, -9}},
                {"one is gone", fewer, {1, 2, 3}, {14, -9}},
                {"a failure before the declaration", fewer, {1, 2, 3}, {-17, 5}, Fails::LookedUp},
                {"the same, without", fewer, {1, 2, 3}, {-17, 5}},
                {"a failure after the declaration", all, home, {-17, 5}, Fails::Rendered},
                {"the camera is back", all, home, {}},
                {"a failure of the same", all, home, {}, Fails::Rendered},
                {"the same again", all, home, {}},
                {"nothing is left", {}, {}, {}},
                {"all are back", all, home, {}},
                {"two have changed ranks", all, {0, 3, 2, 1}, {}}};
    }

    // The bricks as the camera sees them.
    static scene::Scene sceneOf(const Step& step)
    {
        scene::Scene s = scene::makeScene(0, 3);
        for (dfb::Brick b : step.bricks) {
            for (dfb::Vec3* corner : {&b.bounds.lower, &b.bounds.upper}) {
                corner->x += static_cast<float>(step.camera.x);
                corner->y += static_cast<float>(step.camera.y);
            }
            s.bricks.push_back(b);
        }
        return s;
    }

    enum Loop { Data, Mixed, Deep, Own, Loops };

    // A frame of one step, begun by one rank.
    template <class FrameBuffer>
    static typename FrameBuffer::Frame start(FrameBuffer& fb, Loop loop, const Step& step, int number)
    {
        const scene::Scene s = sceneOf(step);
        const bool isCulprit = number % fb.size() == fb.rank();
        dfb::World world;
        for (std::size_t b = 0; b < step.bricks.size(); ++b)
            if (step.holders[b] % fb.size() == fb.rank())
                world.add(step.bricks[b]);
        Turned camera = step.camera;
        camera.throws = isCulprit && step.fails == Fails::LookedUp;
        const auto find = [&](const dfb::Brick& b) -> const dfb::Brick& {
            if (isCulprit && step.fails == Fails::Rendered)
                throw std::runtime_error("nothing to see");
            for (const dfb::Brick& seen : s.bricks)
                if (seen.id == b.id)
                    return seen;
            throw std::runtime_error("a brick that is not there");
        };
        const auto render = [&](const dfb::Brick& b, auto& tile) {
            renderBrick(s, find(b), tile);
            for (int i = 0; i < tile.size * tile.size; ++i)
                tile.farDepth[i] = tile.depth[i];
        };
        dfb::FrameConfig params = paramsOf(s);
        params.timeout = std::chrono::milliseconds(20000); // nothing waits for it
        if (loop == Deep)
            return dfb::DeepParallelLoop(fb, world, 1)
                .start(
                    camera,
                    [&](const dfb::Brick& b, dfb::DeepTile& deep) {
                        const dfb::Region& r = deep.header().region;
                        for (int y = r.y0; y < r.y1; ++y)
                            for (int x = r.x0; x < r.x1; ++x)
                                if (const auto sample = sampleOf(s, find(b), 0, x, y))
                                    deep.add(x, y, {sample->rgba, sample->depth, sample->depth});
                    },
                    params);
        if (loop == Mixed) {
            const dfb::SharedWorld shared(fb, world);
            dfb::RoundRobinBricks inTurn;
            return dfb::MixedParallelLoop(fb, shared, inTurn).start(camera, render, params);
        }
        if (loop == Data)
            return dfb::DataParallelLoop(fb, world).start(camera, render, params);
        params.declared = true;
        auto frame = fb.begin(params);
        try {
            const std::vector<dfb::BrickInTile> pairs = dfb::visibleTiles(world, camera, fb.layout());
            frame.declare(dfb::inputsOf(world, pairs));
            const auto tile = std::make_unique<typename FrameBuffer::Tile>();
            for (const dfb::BrickInTile& pair : pairs) {
                const dfb::Brick& b = world.bricks()[static_cast<std::size_t>(pair.brick)];
                frame.start(*tile, pair.tile);
                tile->generation = 1;
                tile->source = b.id;
                render(b, *tile);
                frame.setTile(*tile);
            }
        } catch (...) {
            frame.abort(std::current_exception());
        }
        return frame;
    }

    static Result run(const Transport::Communicator& communicator)
    {
        using FrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicDeepBlend<16>, dfb::NoPixelOp, Transport>;
        Result result;
        const auto connection = dfb::connect<Transport>(communicator);
        const std::vector<Step> all = steps();
        auto config = configOf(sceneOf(all[0]));
        std::deque<FrameBuffer> kept; // one of each loop
        for (int loop = 0; loop < Loops; ++loop)
            kept.emplace_back(connection, config);
        std::vector<std::uint64_t> hashes;
        for (std::size_t i = 0; i < all.size(); ++i) {
            const Step& step = all[i];
            const int number = static_cast<int>(i);
            std::optional<FrameBuffer> fresh;
            scene::Picture expected;
            if (step.fails == Fails::Never) {
                fresh.emplace(connection, config);
                const dfb::FrameReport report = start(*fresh, Data, step, number).end();
                expected = scene::Picture(fresh->image(), report);
                if (fresh->isDisplayRank())
                    result.expect(wrongValues(expected, referenceOf(sceneOf(step))) == 0,
                                  std::string(step.name) + ": values");
            }
            hashes.push_back(expected.hash());
            result.hash = result.hash * 31 + expected.hash();
            for (int loop = 0; loop < Loops; ++loop) {
                const std::string what = std::string(step.name) + ", loop " + std::to_string(loop) + ": ";
                FrameBuffer& fb = kept[static_cast<std::size_t>(loop)];
                scene::Picture picture;
                const std::string outcome = scene::outcomeOf([&] {
                    const dfb::FrameReport report = start(fb, static_cast<Loop>(loop), step, number).end();
                    picture = scene::Picture(fb.image(), report);
                });
                if (step.fails != Fails::Never)
                    result.expect(outcome != "fine" || step.bricks.size() < static_cast<std::size_t>(fb.size()),
                                  what + "no failure");
                else
                    result.expect(outcome == "fine" && picture.hash() == expected.hash(),
                                  what + (outcome == "fine" ? "another image" : outcome));
            }
        }
        // The same with two frames open at a time.
        config.framesInFlight = 2;
        FrameBuffer fb(connection, config);
        std::deque<typename FrameBuffer::Frame> open;
        std::size_t ended = 0;
        const auto endFirst = [&] {
            const std::size_t i = ended++;
            const std::string what = std::string(all[i].name) + ", in flight: ";
            scene::Picture picture;
            const std::string outcome = scene::outcomeOf([&] {
                const dfb::FrameReport report = open.front().end();
                picture = scene::Picture(fb.image(), report);
            });
            if (all[i].fails == Fails::Never)
                result.expect(outcome == "fine" && picture.hash() == hashes[i],
                              what + (outcome == "fine" ? "another image" : outcome));
            open.pop_front();
        };
        for (std::size_t i = 0; i < all.size(); ++i) {
            if (open.size() == 2)
                endFirst();
            open.push_back(start(fb, Data, all[i], static_cast<int>(i)));
        }
        while (!open.empty())
            endFirst();
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("A scene may change from frame to frame as it likes", "[moving]") { everywhere<frame_cases::MovingBricks>(); }

TEST_CASE("What is known of the last frame's inputs is so, whatever changes and whatever fails", "[moving]")
{
    everywhere<frame_cases::ChangingDeclarations>();
}
