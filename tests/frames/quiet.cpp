// Frames that miss an input, without a time-out: they fail when all ranks are in end() and no message or work is under
// way any more, and say what is missing. Slow frames do not fail. In one process and over MPI (everywhere.hpp).

#include "everywhere.hpp"
#include "send_all.hpp"

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace frame_cases {

// With this configuration ranks check soon and often, once they are in end(), whether anything is still under way.
inline dfb::FrameBufferConfig quickConfig(const scene::Scene& s, int threads = 1)
{
    dfb::FrameBufferConfig config = configOf(s, threads);
    config.quiet = std::chrono::milliseconds(5);
    return config;
}

// Without worker threads, the ranks' own threads also move messages.
inline dfb::NetworkConfig optionsOf(int threads)
{
    dfb::NetworkConfig options;
    options.progress = threads > 0 ? dfb::Progress::Thread : dfb::Progress::Caller;
    return options;
}

// Sends an input of a tile with one pixel.
template <class FrameBuffer, class Frame>
void sendInput(const FrameBuffer&, Frame& frame, int tile, int generation, std::uint32_t source, int children)
{
    const auto input = std::make_unique<typename FrameBuffer::Tile>();
    frame.start(*input, tile);
    input->generation = generation;
    input->source = source;
    input->children = children;
    input->pixel(0, 0)[3] = 0.5f; // empty tiles do not travel to the display rank
    frame.setTile(*input);
}

// How end() of a frame ended on this rank: the error that it threw, the failure in the report of a partial frame, or
// none.
template <class Frame>
std::optional<dfb::ErrorInfo> failureOf(Frame& frame)
{
    try {
        return frame.end().failure;
    } catch (const dfb::FrameError& e) {
        return e.info();
    }
}

// Each kind of input that a tile can wait for in vain.
struct MissingInputs {
    struct Case {
        const char* name;
        const char* text; // of the error
        int generation;
        bool declared;
    };

    static Result run(const Transport::Communicator& communicator)
    {
        constexpr int lost = 5; // the tile
        Result result;
        const scene::Scene s = scene::makeScene(5, 3);
        for (const int threads : {1, 0}) { // 0: the ranks' own threads do all work
            using FrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport>;
            FrameBuffer fb(communicator, quickConfig(s, threads), optionsOf(threads));
            const int last = fb.size() - 1;
            const auto tileOf = [&](auto& frame, int tile, const Case& c) {
                const bool isMine = fb.tileOwner(tile) == fb.rank();
                const bool isLost = tile == lost;
                const bool hasParents = isLost && c.generation == 2;
                if (isMine && !c.declared && (!isLost || c.generation > 0))
                    sendInput(fb, frame, tile, 0, 0, isLost ? (hasParents ? 1 : 3) : 0);
                if (fb.rank() != last || !isLost || c.generation == 0)
                    return;
                sendInput(fb, frame, tile, 1, 70, hasParents ? 2 : 0);
                if (!hasParents)
                    sendInput(fb, frame, tile, 1, 71, 0);
            };
            for (const bool allowPartial : {false, true})
                for (const Case& c : {Case{"announced", "tile 5: generation 1 has 2 of 3 inputs", 1, false},
                                      Case{"a generation", "tile 5: generation 2 has 0 of 2 inputs", 2, false},
                                      Case{"the first", "tile 5: generation 0 has 0 of 1 inputs", 0, false},
                                      Case{"declared", "missing source 72 declared by rank ", 1, true}}) {
                    const std::string what = std::string(c.name) + (allowPartial ? ", partial" : "") + ", "
                                             + std::to_string(threads) + " threads";
                    dfb::FrameConfig params = paramsOf(s);
                    params.declared = c.declared;
                    params.allowPartial = allowPartial;
                    {
                        auto frame = fb.begin(params);
                        if (c.declared)
                            frame.declare(fb.rank() == last ? std::vector<dfb::TileInput>{{lost, 70, 0},
                                                                                          {lost, 71, 0},
                                                                                          {lost, 72, 0},
                                                                                          {lost + 1, 70, 0}}
                                                            : std::vector<dfb::TileInput>{});
                        if (c.declared && fb.rank() == last)
                            sendInput(fb, frame, lost + 1, 1, 70, 0);
                        for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
                            tileOf(frame, tile, c);
                        const auto failure = failureOf(frame);
                        if (!failure) {
                            result.expect(false, what + ": no failure");
                            continue;
                        }
                        result.expect(failure->kind == dfb::ErrorKind::MissingInput && failure->tile == lost
                                          && failure->generation == c.generation && failure->rank == fb.tileOwner(lost)
                                          && scene::has(failure->message, c.text)
                                          && scene::has(failure->describe(), "nothing is under way"),
                                      what + ": " + failure->describe());
                        if (fb.isDisplayRank() && allowPartial)
                            for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
                                result.expect(fb.isComplete(tile) == (tile != lost),
                                              what + ": tile " + std::to_string(tile) + " is complete or not");
                    }
                    const dfb::FrameReport report = renderLoop(fb, s, scene::Loop::Declared);
                    result.hash = checkedHash(result, fb, report, s, what + ": the frame after");
                }
        }
        return result;
    }
};

// Frames that must not be taken for quiet: good frames open beside one that misses inputs, and ranks that render long.
struct QuietOthers {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const scene::Scene s = scene::makeScene(5, 3);
        using FrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport>;
        const auto isMissing = [&](const std::optional<dfb::ErrorInfo>& failure, const std::string& what) {
            result.expect(failure && failure->kind == dfb::ErrorKind::MissingInput,
                          what + ": " + (failure ? failure->describe() : "no failure"));
        };
        const auto isRight = [&](const FrameBuffer& fb, const dfb::FrameReport& report, const std::string& what) {
            result.hash = checkedHash(result, fb, report, s, what);
        };
        auto config = quickConfig(s);
        {
            config.framesInFlight = 2;
            FrameBuffer fb(communicator, config);
            for (int round = 0; round < 2; ++round) { // the first frame misses half its inputs, then the second
                auto first = fb.begin(paramsOf(s));
                auto second = fb.begin(paramsOf(s));
                sendAll(fb, first, s, false);
                if (round == 1)
                    sendAll(fb, first, s, true);
                sendAll(fb, second, s, false);
                if (round == 0)
                    isMissing(failureOf(first), "the first in flight");
                else
                    isRight(fb, first.end(), "the first in flight");
                if (round == 0)
                    sendAll(fb, second, s, true);
                if (round == 0)
                    isRight(fb, second.end(), "the second in flight");
                else
                    isMissing(failureOf(second), "the second in flight");
            }
            config.framesInFlight = 1;
        }
        {
            const auto connection = dfb::connect<Transport>(communicator);
            FrameBuffer a(connection, config), b(connection, config);
            auto inA = a.begin(paramsOf(s));
            auto inB = b.begin(paramsOf(s));
            sendAll(a, inA, s, false);
            sendAll(b, inB, s, false);
            isMissing(failureOf(inA), "one of two framebuffers");
            sendAll(b, inB, s, true);
            isRight(b, inB.end(), "the other");
        }
        for (const int threads : {0, 1}) { // the last rank still renders while the others check about a hundred times
            config = quickConfig(s, threads);
            config.quiet = std::chrono::milliseconds(1);
            FrameBuffer fb(communicator, config, optionsOf(threads));
            const bool isSlow = fb.rank() == fb.size() - 1;
            auto frame = fb.begin(paramsOf(s));
            sendAll(fb, frame, s, false);
            for (const auto start = std::chrono::steady_clock::now();
                 isSlow && std::chrono::steady_clock::now() - start < std::chrono::milliseconds(100);)
                fb.poll();
            sendAll(fb, frame, s, true);
            isRight(fb, frame.end(), "a slow renderer");
        }
        return result;
    }
};

// A framebuffer whose tiles go to a wall.
struct QuietWall {
    static Result run(const Transport::Communicator& communicator)
    {
        Result result;
        const auto connection = dfb::connect<Transport>(communicator);
        const dfb::WallLayout layout{2, 1, 40, 48, 0, 0, {0, connection->size() - 1}};
        const auto executor = std::make_shared<dfb::ThreadExecutor>(1);
        dfb::DisplayWall wall(connection, layout, dfb::OutputFormat::RGBA8, executor);
        auto config = wall.frameBufferConfig();
        config.executor = executor;
        config.quiet = std::chrono::milliseconds(5);
        dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::ToWall, Transport> fb(connection, config, {&wall});
        const auto frame = [&](int tiles, bool allowPartial) {
            dfb::FrameConfig params;
            params.allowPartial = allowPartial;
            auto open = fb.begin(params);
            for (const int tile : fb.ownedTiles())
                if (tile < tiles)
                    sendInput(fb, open, tile, 0, 0, 0);
            std::int64_t number = open.number();
            const auto failure = failureOf(open);
            result.expect(tiles < fb.layout().tileCount()
                              ? failure && failure->kind == dfb::ErrorKind::MissingInput && failure->tile == tiles
                              : !failure,
                          "a frame of a wall: " + (failure ? failure->describe() : "no failure"));
            return number;
        };
        const int all = fb.layout().tileCount();
        const std::int64_t first = frame(all, false);
        wall.finish(first);
        frame(all - 1, false);
        result.expect(wall.imageFrame() == first, "the wall does not show the first frame any more");
        const std::string outcome = scene::outcomeOf([&] { wall.finish(frame(all - 1, true)); });
        result.expect(scene::has(outcome, "display 1 of rank " + std::to_string(fb.size() - 1)
                                              + " misses 256 pixels that no rank has sent"),
                      "a frame with a hole: " + outcome);
        result.expect(wall.imageFrame() == first, "the wall shows a frame with a hole");
        const std::int64_t last = frame(all, false);
        wall.finish(last);
        result.expect(wall.imageFrame() == last, "the wall does not show the last frame");
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("A frame fails without a time-out for an input that nobody sends, and says which", "[quiet]")
{
    everywhere<frame_cases::MissingInputs>();
}

TEST_CASE("Other frames, other framebuffers and slow renderers are not taken for it", "[quiet]")
{
    everywhere<frame_cases::QuietOthers>();
}

TEST_CASE("A wall whose frame misses an input does not wait for it", "[quiet]")
{
    everywhere<frame_cases::QuietWall>();
}
