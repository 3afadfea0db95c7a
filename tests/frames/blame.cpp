// Errors name the rank, the setting and its values, or the input. Every rank gets the same error, and the next frame is
// right. In one process and over MPI (everywhere.hpp).

#include "everywhere.hpp"

#include <array>
#include <cstdint>
#include <functional>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace frame_cases {

using BlameFrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport>;

// "rank 2"
inline std::string rankText(int rank) { return "rank " + std::to_string(rank); }

inline void expectText(Result& result, const std::string& what, const std::string& text,
                       const std::vector<std::string>& parts)
{
    for (const std::string& part : parts)
        result.expect(scene::has(text, part), what + ": no \"" + part + "\" in: " + text);
}

// A good frame, compared with the reference.
template <class Fb>
void expectGoodFrame(Result& result, Fb& fb, const scene::Scene& s, const std::string& what)
{
    const std::string text = scene::outcomeOf([&] {
        const auto report = scene::renderLoop(fb, s, scene::Loop::Declared);
        if (fb.isDisplayRank())
            result.expect(wrongValues(scene::Picture(fb.image(), report), referenceOf(s)) == 0,
                          "a wrong image after " + what);
    });
    result.expect(text == "fine", "after " + what + ": " + text);
}

// The ranks that in turn behave differently from the others: the first and the last one.
inline std::vector<int> oddRanks(int size) { return size > 1 ? std::vector<int>{0, size - 1} : std::vector<int>{}; }

// The part of an error text that names two values, if `odd` has `its` and the other ranks have `usual`. Which of the
// others is named is open.
inline std::string valuesText(int odd, const std::string& usual, const std::string& its)
{
    return odd == 0 ? its + " on rank 0 and " + usual + " on rank " : " and " + its + " on rank " + std::to_string(odd);
}

// Frames that begin with different parameters.
struct BlamedParams {
    struct Case {
        const char* name;
        std::function<void(dfb::FrameConfig&)> change; // on the odd rank
        const char *usual, *its;
    };

    static Result run(const Transport::Communicator& communicator)
    {
        using Params = dfb::FrameConfig;
        const std::vector<Case> cases{
            {"background", [](Params& p) { p.background[2] = 0.75f; }, "(0.125, 0.25, 0.5, 1)",
             "(0.125, 0.25, 0.75, 1)"},
            {"passes", [](Params& p) { p.passes = 3; }, "2", "3"},
            {"samples",
             [](Params& p) {
                 p.samples = std::make_shared<std::vector<dfb::TileSamples>>(28, dfb::TileSamples{0, 2});
             },
             "null", "a plan of 56 samples"},
            {"maxLayers", [](Params& p) { p.maxLayers = 9; }, "4", "9"},
            {"accumulationId", [](Params& p) { p.accumulationId = 77; }, "5", "77"},
            {"timeout", [](Params& p) { p.timeout = std::chrono::milliseconds(31000); }, "30000 ms", "31000 ms"},
            {"allowPartial", [](Params& p) { p.allowPartial = true; }, "false", "true"}};
        const scene::Scene s = scene::makeScene(3);
        Result result;
        BlameFrameBuffer fb(communicator, configOf(s));
        for (const int odd : oddRanks(fb.size()))
            for (const Case& c : cases) {
                std::int64_t number = 0;
                const std::string text = scene::outcomeOf([&] {
                    Params params;
                    params.background = {0.125f, 0.25f, 0.5f, 1.0f};
                    params.passes = 2;
                    params.maxLayers = 4;
                    params.accumulationId = 5;
                    params.declared = true;
                    params.timeout = std::chrono::milliseconds(30000);
                    if (fb.rank() == odd)
                        c.change(params);
                    auto frame = fb.begin(params);
                    number = frame.number();
                    frame.declare({}); // no rank waits for anything: the verdict alone tells
                    frame.end();
                });
                const std::string what = std::string(c.name) + " of rank " + std::to_string(odd);
                expectText(result, what, text,
                           {"FrameError: dfb: ranks disagree: frame " + std::to_string(number),
                            std::string("FrameConfig::") + c.name + " is ", valuesText(odd, c.usual, c.its),
                            std::string(c.usual) + " on rank ", "it must be the same on all ranks"});
                expectGoodFrame(result, fb, s, what);
            }
        return result;
    }
};

// Framebuffers that are configured differently, or wrongly on one rank.
struct BlamedConfig {
    static Result run(const Transport::Communicator& communicator)
    {
        using Config = dfb::FrameBufferConfig;
        struct Different {
            const char* name;
            std::function<void(Config&)> change; // on the odd rank
            const char *usual, *its;
        };
        const std::vector<Different> differences{
            {"width", [](Config& c) { c.image.width = 98; }, "97", "98"},
            {"height", [](Config& c) { c.image.height = 192; }, "61", "192"},
            {"format", [](Config& c) { c.image.format = dfb::OutputFormat::SRGBA8; }, "RGBA32F", "SRGBA8"},
            {"depth", [](Config& c) { c.image.depth = false; }, "true", "false"},
            {"dither", [](Config& c) { c.image.dither = true; }, "false", "true"},
            {"framesInFlight", [](Config& c) { c.framesInFlight = 2; }, "1", "2"},
            {"messages.compression", [](Config& c) { c.messages.compression = dfb::CompressionMode::Auto; }, "Always",
             "Auto"},
            {"messages.poolBytes", [](Config& c) { c.messages.poolBytes = 1 << 28; }, "67108864", "268435456"},
            {"minTransmittance", [](Config& c) { c.minTransmittance = 0.5f; }, "0", "0.5"},
            {"precision.color", [](Config& c) { c.precision = dfb::WireFormat::Float16; }, "float32", "float16"}};
        struct Wrong {
            std::function<void(Config&)> change;
            const char* text;
        };
        const std::vector<Wrong> wrongs{
            {[](Config& c) { c.image.width = 0; }, "the image size is 0x61"},
            {[](Config& c) { c.image.displayRank = 99; }, "the display rank is 99 of "},
            {[](Config& c) { c.framesInFlight = 0; }, "0 frames in flight"},
            {[](Config& c) { c.minTransmittance = 2; }, "a least transmittance of 2"},
            {[](Config& c) {
                 c.precision = dfb::HalfLevel();
                 c.precision.color = dfb::WireFormat::Float16;
             },
             "half a level, and another precision"},
            {[](Config& c) { c.precision = dfb::WireFormat::Bytes; }, "the format bytes is that of inputs of 8 bits"},
            {[](Config& c) { c.image.aux = dfb::normalChannel; }, "ImageConfig::aux has normal"},
            {[](Config& c) { c.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 99; }; },
             "the owner map gives tile 0 to rank 99 of "},
            {[](Config& c) {
                 c.image.ownerMap = [](int, const dfb::TileLayout&, int) -> int {
                     throw std::runtime_error("no such map");
                 };
             },
             "no such map"}};
        const scene::Scene s = scene::makeScene(3);
        Result result;
        int size = 0, rank = 0;
        const auto make = [&](int odd, const std::function<void(Config&)>& change) {
            Config config = configOf(s);
            if (rank == odd)
                change(config);
            return scene::outcomeOf([&] { BlameFrameBuffer fb(communicator, config); });
        };
        {
            BlameFrameBuffer fb(communicator, configOf(s));
            size = fb.size(), rank = fb.rank();
        }
        for (const int odd : oddRanks(size)) {
            for (const Different& d : differences)
                expectText(result, std::string(d.name) + " of rank " + std::to_string(odd), make(odd, d.change),
                           {"InvalidArgument: dfb: invalid argument: ", std::string(d.name) + " is ",
                            valuesText(odd, d.usual, d.its), std::string(d.usual) + " on rank ",
                            "it must be the same on all ranks"});
            for (const Wrong& w : wrongs)
                expectText(result, std::string(w.text) + " on rank " + std::to_string(odd), make(odd, w.change),
                           {"InvalidArgument: dfb: invalid argument: rank " + std::to_string(odd) + ": ", w.text});
        }
        for (const int odd : oddRanks(size)) {
            const auto makeWall = [&](bool checksums, int bezel, int displays) {
                dfb::NetworkConfig options;
                options.checksums = checksums;
                dfb::WallLayout layout;
                layout.columns = displays;
                layout.displayWidth = layout.displayHeight = 8;
                layout.bezelX = bezel;
                layout.ranks = {0, 1};
                const auto connection = dfb::connect<Transport>(communicator, options);
                return scene::outcomeOf([&] {
                    dfb::DisplayWall wall(connection, layout, dfb::OutputFormat::RGBA8,
                                          std::make_shared<dfb::ThreadExecutor>(1));
                });
            };
            // The exception destroys the framebuffer and, with it, the connection.
            const auto makeWide = [&](int width) {
                return scene::outcomeOf([&] {
                    const auto connection = dfb::connect<Transport>(communicator);
                    Config config = configOf(s);
                    config.image.width = width;
                    BlameFrameBuffer fb(connection, config);
                });
            };
            const std::string sums = scene::outcomeOf([&] {
                dfb::NetworkConfig options;
                options.checksums = rank == odd;
                BlameFrameBuffer fb(communicator, configOf(s), options);
            });
            expectText(result, "checksums of rank " + std::to_string(odd), sums,
                       {"InvalidArgument: dfb: invalid argument: checksums is ", valuesText(odd, "false", "true")});
            const std::string what = "a wall, rank " + std::to_string(odd),
                              refused = "InvalidArgument: dfb: invalid argument: ";
            expectText(result, what, makeWall(rank == odd, 0, 2),
                       {refused + "checksums is ", valuesText(odd, "false", "true")});
            expectText(result, what, makeWall(false, rank == odd ? 3 : 1, 2),
                       {refused + "the size of its bezels is ", valuesText(odd, "1x0", "3x0")});
            expectText(result, what, makeWall(false, 0, rank == odd ? 3 : 2),
                       {refused + rankText(odd) + ": a wall of 3 displays names 2 ranks"});
            expectText(result, "width of rank " + std::to_string(odd), makeWide(rank == odd ? 98 : 97),
                       {refused + "width is ", valuesText(odd, "97", "98")});
        }
        BlameFrameBuffer fb(communicator, configOf(s));
        for (const int odd : oddRanks(size)) {
            std::vector<std::int64_t> values(rank == odd ? 3 : 2);
            expectText(result, "allReduce() of rank " + std::to_string(odd),
                       scene::outcomeOf([&] { fb.allReduce(values, BlameFrameBuffer::Reduce::Sum); }),
                       {"InvalidArgument: dfb: invalid argument: rank ", " calls allReduce() of ",
                        "rank " + std::to_string(odd), "allReduce() of 3 values to their sum",
                        ": all ranks must make the same calls"});
        }
        expectGoodFrame(result, fb, s, "all of them");
        return result;
    }
};

// Ranks that make different collective calls.
struct BlamedCalls {
    static Result run(const Transport::Communicator& communicator)
    {
        using Fb = BlameFrameBuffer;
        using Call = std::pair<std::string, std::function<void(Fb&)>>; // and its name in errors
        const auto reduce = [](Fb::Reduce how) { return [how](Fb& fb) { fb.allReduce({1}, how); }; };
        const Call sum{"allReduce() of 1 values to their sum", reduce(Fb::Reduce::Sum)},
            largest{"allReduce() of 1 values to their maximum", reduce(Fb::Reduce::Max)},
            share{"SharedWorld()", [](Fb&fb) { dfb::SharedWorld(fb, dfb::World()); }},
            gather{"allGather()", [](Fb&fb) { fb.allGather({}); }},
            image{"imageOnAllRanks()", [](Fb&fb) { fb.imageOnAllRanks(); }},
            resize{"resize()", [](Fb&fb) { fb.resize(40, 30); }};
        Result result;
        const scene::Scene s = scene::makeScene(3);
        dfb::FrameBufferConfig config = configOf(s);
        for (const int inFlight : {1, 2}) {
            config.framesInFlight = inFlight;
            Fb fb(communicator, config);
            for (int frame = 0; frame < inFlight; ++frame) // the next would be the first engine's again
                expectGoodFrame(result, fb, s, "no call");
            for (const int odd : oddRanks(fb.size()))
                for (const auto& [its, usual] :
                     {std::pair{sum, largest}, {share, gather}, {resize, sum}, {resize, image}}) {
                    const Call& mine = fb.rank() == odd ? its : usual;
                    const std::string text = scene::outcomeOf([&] { mine.second(fb); });
                    expectText(result, "rank " + std::to_string(odd) + " in " + its.first, text,
                               {"InvalidArgument: dfb: invalid argument: rank ",
                                rankText(odd) + (odd == 0 ? " calls " : " ") + its.first, usual.first,
                                ": all ranks must make the same calls"});
                    result.expect(fb.allReduce({1}, Fb::Reduce::Sum).front() == fb.size(), "a wrong sum after it");
                }
        }
        return result;
    }
};

// Errors in trees that a program builds itself, and in the ids of bricks.
struct BlamedTree {
    static Result run(const Transport::Communicator& communicator)
    {
        using Fb = BlameFrameBuffer;
        Result result;
        const scene::Scene s = scene::makeScene(3);
        Fb fb(communicator, configOf(s));
        const int size = fb.size(), owner = fb.tileOwner(5);
        const auto tile = std::make_unique<Fb::Tile>();
        {
            // The owner announces inputs that never come.
            dfb::FrameConfig params;
            // So much later than the others may a rank begin the frame: they give it up after twice this time.
            params.timeout = std::chrono::milliseconds(1000);
            std::string text;
            dfb::ErrorInfo error;
            fb.allReduce({0}, Fb::Reduce::Sum); // all are there
            try {
                auto frame = fb.begin(params);
                for (const int index : fb.ownedTiles()) {
                    frame.start(*tile, index);
                    tile->children = index == 5 ? 2 : 0;
                    tile->source = static_cast<std::uint32_t>(40 + fb.rank());
                    frame.setTile(*tile);
                }
                frame.end();
            } catch (const dfb::FrameError& e) {
                text = e.what();
                error = e.info();
            }
            expectText(result, "a missing input", text,
                       {"dfb: timed out: noticed by " + rankText(owner) + ", announced by " + rankText(owner),
                        "tile 5: generation 1 has 0 of 2 inputs; announced by source " + std::to_string(40 + owner)
                            + " of " + rankText(owner)});
            result.expect(error.rank == owner && error.from == owner, "ranks of a time-out: " + text);
            expectGoodFrame(result, fb, s, "a missing input");
        }
        if (size == 1)
            return result;
        for (const int first : {0, size - 2}) {
            // Two ranks have the brick.
            const int second = size - 1;
            std::vector<dfb::Brick> bricks;
            if (fb.rank() == first || fb.rank() == second)
                bricks.push_back({7, {{3, 5, 0}, {90, 60, 1}}});
            dfb::ErrorInfo error;
            std::string text;
            try {
                dfb::DataParallelLoop(fb, dfb::World(bricks))
                    .render(scene::FlatCamera(), [](const dfb::Brick&, auto& t) { t.pixel(0, 0)[3] = 1; });
            } catch (const dfb::FrameError& e) {
                text = e.what();
                error = e.info();
            }
            expectText(result, "a brick of two ranks", text,
                       {"dfb: duplicate input: noticed by rank ", "generation 1, source 7",
                        "source 7 (the id of a brick, or the place of an image in an order) comes from "
                            + rankText(first) + " and from " + rankText(second)});
            result.expect(error.source == 7 && error.from == second
                              && error.rank == fb.tileOwner(static_cast<int>(error.tile)),
                          "ranks of a duplicate: " + text);
            expectGoodFrame(result, fb, s, "a brick of two ranks");
        }
        // One rank sends twice.
        const std::string text = scene::outcomeOf([&] {
            auto frame = fb.begin();
            for (int i = 0; i < 2 && fb.rank() == size - 1; ++i) {
                frame.start(*tile, 5);
                tile->generation = 1;
                tile->source = 50;
                frame.setTile(*tile);
            }
            frame.end();
        });
        expectText(result, "an input that comes twice", text,
                   {"dfb: duplicate input: noticed by " + rankText(owner) + ", from " + rankText(size - 1), "tile 5",
                    "source 50 (the id of a brick, or the place of an image in an order) comes twice from "
                        + rankText(size - 1)});
        expectGoodFrame(result, fb, s, "an input that comes twice");
        return result;
    }
};

// A camera that breaks on one rank.
struct BrokenCamera : scene::FlatCamera {
    bool isBroken = false;
    dfb::Region project(const dfb::Box3& b, int w, int h) const
    {
        if (isBroken)
            throw std::runtime_error("the lens is gone");
        return FlatCamera::project(b, w, h);
    }
};

// Exceptions between begin() and end().
struct BlamedLoop {
    static Result run(const Transport::Communicator& communicator)
    {
        using Fb = BlameFrameBuffer;
        Result result;
        const scene::Scene s = scene::makeScene(3);
        Fb fb(communicator, configOf(s));
        const auto tile = std::make_unique<Fb::Tile>();
        for (const int culprit : {0, fb.size() / 2, fb.size() - 1})
            for (const bool named : {false, true}) {
                std::int64_t number = 0;
                bool through = false;
                const std::string text = scene::outcomeOf([&] {
                    auto frame = fb.begin();
                    number = frame.number();
                    const auto renderAll = [&] {
                        for (const int index : fb.ownedTiles()) {
                            frame.start(*tile, index);
                            if (fb.rank() == culprit)
                                throw std::runtime_error("out of paint");
                            frame.setTile(*tile);
                        }
                    };
                    through = named ? frame.guard(renderAll, *tile) : frame.guard(renderAll);
                    frame.end();
                });
                const std::string where = named ? ", tile " : ": out of paint";
                expectText(result, "an own loop", text,
                           {"FrameError: dfb: exception in user code: " + rankText(culprit) + ", frame "
                                + std::to_string(number) + where,
                            ": out of paint"});
                result.expect(through == (fb.rank() != culprit), "guard() returned the wrong thing");
                expectGoodFrame(result, fb, s, "an exception in an own loop");
            }
        for (const int culprit : oddRanks(fb.size())) {
            BrokenCamera camera;
            camera.isBroken = fb.rank() == culprit;
            const dfb::World world(scene::bricksOf(scene::makeScene(fb.size()), fb.rank(), fb.size()));
            const std::string text = scene::outcomeOf(
                [&] { dfb::DataParallelLoop(fb, world).render(camera, [](const dfb::Brick&, auto&) {}); });
            expectText(result, "a camera", text,
                       {"FrameError: dfb: exception in user code: " + rankText(culprit), ": the lens is gone"});
            expectGoodFrame(result, fb, s, "a broken camera");
        }
        return result;
    }
};

// An error of all ranks that also destroys their framebuffers. One rank gets it first; that this rank then leaves must
// not hide the error from the others.
struct BlamedOutside {
    static Result run(const Transport::Communicator& communicator)
    {
        using Fb = BlameFrameBuffer;
        Result result;
        dfb::FrameBufferConfig config(64, 48);
        config.quiet = std::chrono::milliseconds(1);
        const auto endWithMissingInput = [](Fb& fb) {
            auto frame = fb.begin();
            frame.forEachTile(fb.ownedTiles(), [&](auto& tile) {
                tile.children = 1; // which nobody sends
                frame.setTile(tile);
            });
            frame.end();
        };
        const auto reduceUnequal = [](Fb& fb) {
            const bool isLast = fb.rank() == fb.size() - 1;
            fb.allReduce(std::vector<std::int64_t>(isLast ? 2 : 1), Fb::Reduce::Sum);
        };
        const auto resizeUnequal = [](Fb& fb) { fb.resize(fb.rank() == fb.size() - 1 ? 80 : 64, 48); };
        struct Case {
            std::string name, text;
            std::function<void(Fb&)> call;
            int leastRanks;
        };
        for (const Case& c : {Case{"end()", "FrameError: dfb: missing input", endWithMissingInput, 1},
                              Case{"allReduce()", "all ranks must make the same calls", reduceUnequal, 2},
                              Case{"resize()", "width is ", resizeUnequal, 2}})
            for (int round = 0; round < 10; ++round) {
                int size = 0;
                const std::string text = scene::outcomeOf([&] {
                    Fb fb(communicator, config);
                    size = fb.size();
                    c.call(fb);
                });
                if (size >= c.leastRanks)
                    expectText(result, c.name + " that leaves the framebuffer's scope", text, {c.text});
            }
        for (int round = 0; round < 10; ++round)
            expectText(result, "finish() that leaves the wall's scope", scene::outcomeOf([&] {
                           dfb::WallLayout layout;
                           layout.displayWidth = layout.displayHeight = 32;
                           layout.ranks = {0};
                           dfb::DisplayWall wall(dfb::connect<Transport>(communicator), layout,
                                                 dfb::OutputFormat::SRGBA8);
                           wall.finish(1); // which nobody has begun
                       }),
                       {"dfb: missing input"});
        return result;
    }
};

// A rank that destroys its framebuffer while the others go on.
struct BlamedLeaving {
    static Result run(const Transport::Communicator& communicator)
    {
        using Fb = BlameFrameBuffer;
        Result result;
        const scene::Scene s = scene::makeScene(3);
        const int size = Fb(communicator, configOf(s)).size();
        const std::vector<std::pair<std::string, std::function<void(Fb&)>>> calls{
            {"frame 2", [&](Fb& fb) { scene::renderLoop(fb, s, scene::Loop::Declared); }},
            {"collective call", [](Fb& fb) { fb.imageOnAllRanks(); }}};
        for (const int leaver : oddRanks(size))
            for (const auto& [name, call] : calls) {
                int rank = -1;
                const std::string text = scene::outcomeOf([&, &call = call] {
                    Fb fb(communicator, configOf(s));
                    rank = fb.rank();
                    scene::renderLoop(fb, s, scene::Loop::Declared);
                    if (rank != leaver)
                        call(fb);
                });
                if (rank == leaver)
                    result.expect(text == "fine", "a rank that leaves in order: " + text);
                else
                    expectText(
                        result, "a rank that leaves", text,
                        {"TransportError: ",
                         rankText(leaver) + ": it has destroyed its framebuffer, compositor or wall after frame 1",
                         "is in " + name});
            }
        return result;
    }
};

} // namespace frame_cases

TEST_CASE("Parameters of frames that differ are named, with ranks and values", "[blame]")
{
    everywhere<frame_cases::BlamedParams>();
}
TEST_CASE("A configuration that is wrong or differs is named, with ranks and values", "[blame]")
{
    everywhere<frame_cases::BlamedConfig>();
}
TEST_CASE("Different collective calls are named, with their ranks", "[blame]")
{
    everywhere<frame_cases::BlamedCalls>();
}
TEST_CASE("Inputs that are missing or come twice are named, with their ranks", "[blame]")
{
    everywhere<frame_cases::BlamedTree>();
}
TEST_CASE("An exception between begin() and end() is told to all ranks", "[blame]")
{
    everywhere<frame_cases::BlamedLoop>();
}
TEST_CASE("An error of all ranks is the same on all when it ends their framebuffers", "[blame]")
{
    everywhere<frame_cases::BlamedOutside>();
}
TEST_CASE("A rank that destroys its framebuffer is named on ranks that go on", "[blame]")
{
    everywhere<frame_cases::BlamedLeaving>();
}
