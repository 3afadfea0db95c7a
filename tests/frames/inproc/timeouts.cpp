// Frames with a time-out. If an input or message is missing, the frame fails with an error that names it and is the
// same on every rank. If ranks cannot even agree on the error, they get a TransportError. Ranks are threads; every test
// has a time limit.
#include "board.hpp"
#include "catch.hpp"
#include "random_scene.hpp"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <future>
#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace timeouts_cases {

namespace {

using board::allSame;
using board::Board;
using board::BoardTransport;
using board::eachAtOnce;
using board::joined;
using board::runOn;
using dfb::detail::MessageHeader;
using dfb::detail::MessageKind;
using scene::configOf;
using scene::has;
using scene::Loop;
using scene::outcomeOf;
using scene::Picture;
using scene::Scene;
using Clock = std::chrono::steady_clock;

using Blend = dfb::BasicAlphaBlend<16>;
using FrameBuffer = dfb::DistributedFrameBuffer<Blend, dfb::NoPixelOp, BoardTransport>;

// The outcome of a frame on a rank: its error, or none.
struct Ending {
    std::optional<dfb::ErrorInfo> error;
    bool isFrameError = false;
    std::string text;
    double ms = 0; // that end() took
};

template <class Frame>
Ending endingOf(Frame& frame)
{
    Ending ending;
    const auto start = Clock::now();
    try {
        frame.end();
        ending.text = "fine";
    } catch (const dfb::FrameError& e) {
        ending.error = e.info();
        ending.isFrameError = true;
        ending.text = std::string("FrameError: ") + e.what();
    } catch (const dfb::Error& e) {
        ending.error = e.info();
        ending.text = std::string("Error: ") + e.what();
    }
    ending.ms = std::chrono::duration<double, std::milli>(Clock::now() - start).count();
    return ending;
}

std::vector<std::string> textsOf(const std::vector<Ending>& endings)
{
    std::vector<std::string> texts;
    for (const Ending& e : endings)
        texts.push_back(e.text);
    return texts;
}

// A bad frame, then a good one without time-out. `frame(fb)` runs the bad frame up to end().
struct Run {
    std::vector<Ending> endings;
    std::size_t wrongAfter = 1;
};

Run run(const std::shared_ptr<Board>& board, int ranks, dfb::FrameBufferConfig config, const dfb::FrameConfig& params,
        const std::function<void(FrameBuffer&, FrameBuffer::Frame&)>& frame)
{
    Run result;
    result.endings.resize(static_cast<std::size_t>(ranks));
    const Scene s = scene::makeScene(5, 2, config.image.width, config.image.height);
    runOn(board, ranks, [&](const BoardTransport::Communicator& communicator) {
        auto mine = config;
        mine.executor = std::make_shared<dfb::ThreadExecutor>(1);
        FrameBuffer fb(communicator, mine);
        {
            auto open = fb.begin(params);
            frame(fb, open);
            result.endings[static_cast<std::size_t>(fb.rank())] = endingOf(open);
        }
        const auto report = scene::renderLoop(fb, s, Loop::Declared);
        if (fb.isDisplayRank())
            result.wrongAfter = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
    });
    return result;
}

// Like run(), for a case that is not run by eachAtOnce().
template <class... Args>
Run runAlone(const Args&... args)
{
    return undisturbed([&] { return run(args...); });
}

void send(FrameBuffer::Frame& frame, int index, int generation, std::uint32_t source, std::uint16_t part, int children,
          int pass = 0)
{
    const auto tile = std::make_unique<FrameBuffer::Tile>();
    frame.start(*tile, index, pass);
    tile->generation = generation;
    tile->source = source;
    tile->part = part;
    tile->children = children;
    tile->pixel(0, 0)[3] = 0.5f; // empty tiles do not travel to the display rank
    frame.setTile(*tile);
}

dfb::FrameBufferConfig smallConfig() // 28 tiles
{
    return configOf(scene::makeScene(0));
}

// Long enough, even on a busy machine, for everything that is not held back. A frame that has failed has as much time
// again to reach its verdict. Cases that wait for it run at the same time.
constexpr int limitMs = 1000;
// How many ms later than that an error may come on a busy machine.
constexpr double marginMs = 5000;

dfb::FrameConfig timed(bool declared, int timeoutMs = limitMs)
{
    dfb::FrameConfig params;
    params.declared = declared;
    params.timeout = std::chrono::milliseconds(timeoutMs);
    return params;
}

} // namespace

TEST_CASE("A negative time-out is refused, as are times that no clock has", "[timeouts]")
{
    std::string text, after, quiet;
    runOn(std::make_shared<Board>(), 1, [&](const auto& communicator) {
        FrameBuffer fb(communicator, smallConfig());
        text = outcomeOf([&] { (void)fb.begin(timed(true, -1)); });
        after = outcomeOf([&] {
            auto frame = fb.begin(timed(true, 0));
            frame.declare({});
            frame.end();
        });
    });
    runOn(std::make_shared<Board>(), 1, [&](const auto& communicator) {
        auto config = smallConfig();
        config.quiet = std::chrono::milliseconds::max();
        quiet = outcomeOf([&] { FrameBuffer(communicator, config); });
    });
    CHECK((has(text, "InvalidArgument") && has(text, "-1 ms")));
    CHECK(after == "fine");
    CHECK((has(quiet, "InvalidArgument") && has(quiet, "`quiet` is")));
}

TEST_CASE("Different time-outs are a disagreement", "[timeouts]")
{
    for (int odd = 0; odd < 3; ++odd) {
        std::vector<std::string> texts(3);
        runOn(std::make_shared<Board>(), 3, [&](const auto& communicator) {
            FrameBuffer fb(communicator, smallConfig());
            texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] {
                auto frame = fb.begin(timed(true, fb.rank() == odd ? 30000 : 20000));
                frame.declare({});
                frame.end();
            });
        });
        INFO(joined(texts));
        CHECK(allSame(texts));
        CHECK((has(texts[0], "FrameError: dfb: ranks disagree") && has(texts[0], "FrameConfig::timeout")));
    }
}

TEST_CASE("A time-out that is not reached changes nothing", "[timeouts]")
{
    for (const Loop loop : {Loop::Listing3, Loop::Declared}) {
        Scene s = scene::makeScene(6, 3);
        std::vector<std::uint64_t> hashes;
        std::vector<std::int64_t> messages;
        runOn(std::make_shared<Board>(), 3, [&](const auto& communicator) {
            FrameBuffer fb(communicator, configOf(s));
            for (const int timeoutMs : {0, 60000, 2147483647}) {
                Scene mine = s;
                mine.timeout = std::chrono::milliseconds(timeoutMs);
                const auto report = scene::renderLoop(fb, mine, loop);
                if (fb.isDisplayRank()) {
                    const Picture p(fb.image(), report);
                    CHECK(scene::wrongValues(p, scene::referenceOf(s)) == 0);
                    hashes.push_back(p.hash());
                    messages.push_back(report.lateMessages);
                }
            }
        });
        CHECK(hashes.size() == 3);
        CHECK(std::count(hashes.begin(), hashes.end(), hashes.front()) == 3);
        CHECK(messages == std::vector<std::int64_t>(3));
    }
}

TEST_CASE("An announced input that is never sent is named on every rank", "[timeouts]")
{
    // Tile 5, owned by rank 1, waits for 3 inputs of generation 1 and gets 2.
    struct Case {
        int ranks;
        bool shuffle;
    };
    const auto runCase = [](const Case& c) {
        auto config = smallConfig();
        config.image.ownerMap = [](int tile, const dfb::TileLayout&, int) { return tile == 5 ? 1 : 0; };
        std::vector<Ending> endings(static_cast<std::size_t>(c.ranks));
        runOn(
            std::make_shared<Board>(), c.ranks,
            [&](const auto& communicator) {
                auto mine = config;
                mine.executor = std::make_shared<dfb::ThreadExecutor>(1);
                FrameBuffer fb(communicator, mine);
                auto frame = fb.begin(timed(false));
                for (int tile : fb.ownedTiles())
                    send(frame, tile, 0, 0, 0, tile == 5 ? 3 : 0);
                if (fb.rank() == c.ranks - 1) {
                    send(frame, 5, 1, 70, 0, 0);
                    send(frame, 5, 1, 71, 0, 0);
                }
                endings[static_cast<std::size_t>(fb.rank())] = endingOf(frame);
            },
            c.shuffle ? std::optional<std::uint64_t>(1) : std::nullopt);
        return endings;
    };
    double soonest = 2 * limitMs + marginMs;
    const std::vector<Case> cases{{2, false}, {2, true}, {4, false}, {4, true}};
    for (int attempt = 0; attempt < 3 && soonest >= 2 * limitMs; ++attempt)
        eachAtOnce(cases, runCase, [&](const Case& c, const std::vector<Ending>& endings) {
            INFO(c.ranks << " ranks" << joined(textsOf(endings)));
            CHECK(allSame(textsOf(endings)));
            for (const Ending& e : endings) {
                REQUIRE(e.error);
                CHECK(e.isFrameError);
                CHECK(e.error->kind == dfb::ErrorKind::TimedOut);
                CHECK(e.error->rank == 1);
                CHECK(e.error->frame == 1);
                CHECK(e.error->tile == 5);
                CHECK(e.error->pass == 0);
                CHECK(e.error->generation == 1);
                CHECK(e.error->expected == 3);
                CHECK(e.error->got == 2);
                CHECK(has(e.text, "tile 5: generation 1 has 2 of 3 inputs"));
                CHECK(e.ms < 2 * limitMs + marginMs);
                soonest = std::min(soonest, e.ms);
            }
            // The rank that ends the frame first waits for the whole time-out.
            CHECK(std::any_of(endings.begin(), endings.end(), [](const Ending& e) { return e.ms >= limitMs; }));
        });
    CHECK(soonest < 2 * limitMs); // the machine is not always late
}

TEST_CASE("A tile that gets nothing at all, and a pass that does", "[timeouts]")
{
    const Run none =
        runAlone(std::make_shared<Board>(), 2, smallConfig(), timed(false), [](FrameBuffer& fb, auto& frame) {
            for (int tile : fb.ownedTiles())
                if (tile != 6)
                    send(frame, tile, 0, 0, 0, 0);
        });
    INFO(joined(textsOf(none.endings)));
    CHECK(allSame(textsOf(none.endings)));
    REQUIRE(none.endings[0].error);
    CHECK(none.endings[0].error->kind == dfb::ErrorKind::TimedOut);
    CHECK(none.endings[0].error->tile == 6);
    CHECK(none.endings[0].error->generation == 0);
    CHECK(none.endings[0].error->expected == 1);
    CHECK(none.endings[0].error->got == 0);
    CHECK(none.wrongAfter == 0);

    auto params = timed(false);
    params.passes = 3;
    const Run pass = runAlone(std::make_shared<Board>(), 2, smallConfig(), params, [](FrameBuffer& fb, auto& frame) {
        for (int tile : fb.ownedTiles())
            for (int p = 0; p < 3; ++p)
                if (tile != 7 || p != 2)
                    send(frame, tile, 0, 0, 0, 0, p);
    });
    INFO(joined(textsOf(pass.endings)));
    CHECK(allSame(textsOf(pass.endings)));
    REQUIRE(pass.endings[0].error);
    CHECK(pass.endings[0].error->tile == 7);
    CHECK(pass.endings[0].error->pass == 2);
    CHECK(has(pass.endings[0].text, "tile 7 pass 2"));
    CHECK(pass.wrongAfter == 0);
}

TEST_CASE("A declared input that is never sent is named with its source, part and rank", "[timeouts]")
{
    struct Case {
        int ranks, culprit;
    };
    const auto runCase = [](const Case& c) {
        auto config = smallConfig();
        config.image.displayRank = c.ranks / 2;
        return run(std::make_shared<Board>(), c.ranks, config, timed(true), [&](FrameBuffer& fb, auto& frame) {
            const auto rank = static_cast<std::uint32_t>(fb.rank());
            frame.declare({{9, 40 + rank, 0}, {9, 40 + rank, 2}});
            send(frame, 9, 1, 40 + rank, 0, 0);
            if (fb.rank() != c.culprit)
                send(frame, 9, 1, 40 + rank, 2, 0);
        });
    };
    eachAtOnce(std::vector<Case>{{1, 0}, {3, 0}, {7, 0}, {7, 3}, {7, 6}}, runCase, [](const Case& c, const Run& r) {
        INFO("rank " << c.culprit << " of " << c.ranks << joined(textsOf(r.endings)));
        CHECK(allSame(textsOf(r.endings)));
        REQUIRE(r.endings[0].error);
        const dfb::ErrorInfo& e = *r.endings[0].error;
        CHECK(r.endings[0].isFrameError);
        CHECK(e.kind == dfb::ErrorKind::TimedOut);
        CHECK(e.tile == 9);
        CHECK(e.generation == 1);
        CHECK(e.source == 40 + c.culprit);
        CHECK(e.expected == 2 * c.ranks);
        CHECK(e.got == 2 * c.ranks - 1);
        CHECK(has(e.message, "missing source " + std::to_string(40 + c.culprit) + " part 2 declared by rank "
                                 + std::to_string(c.culprit)));
        CHECK(r.wrongAfter == 0);
    });
}

TEST_CASE("What several owners miss is all listed, whoever's time was up first", "[timeouts]")
{
    // Rank t owns tile t. The tiles in `missing` do not get their inputs. Rank `first` calls end() first; the others
    // call it when they know that the frame has failed.
    struct Case {
        int ranks;
        std::vector<int> missing;
        int first;
    };
    std::vector<Case> cases;
    for (const Case& c : {Case{2, {0, 1}, 0}, Case{4, {0, 3}, 0}, Case{4, {1, 2, 3}, 0}, Case{4, {0, 1}, 0},
                          Case{7, {0, 3, 5, 6}, 0}, Case{7, {2, 4}, 0}})
        for (const int first : c.missing)
            cases.push_back({c.ranks, c.missing, first});
    const auto runCase = [](const Case& c) {
        auto config = smallConfig();
        config.image.ownerMap = [](int tile, const dfb::TileLayout&, int ranks) { return tile < ranks ? tile : 0; };
        return run(std::make_shared<Board>(), c.ranks, config, timed(true), [&](FrameBuffer& fb, auto& frame) {
            std::vector<dfb::TileInput> inputs;
            if (fb.rank() == 0)
                for (int tile = 0; tile < c.ranks; ++tile)
                    inputs.push_back({tile, 50, 0});
            frame.declare(inputs);
            for (const dfb::TileInput& input : inputs)
                if (std::count(c.missing.begin(), c.missing.end(), input.tile) == 0)
                    send(frame, input.tile, 1, 50, 0, 0);
            const auto limit = Clock::now() + std::chrono::seconds(20);
            while (fb.rank() != c.first && !frame.failed() && Clock::now() < limit)
                std::this_thread::sleep_for(std::chrono::milliseconds(1));
        });
    };
    eachAtOnce(cases, runCase, [](const Case& c, const Run& r) {
        INFO(c.ranks << " ranks, first " << c.first << joined(textsOf(r.endings)));
        CHECK(allSame(textsOf(r.endings)));
        REQUIRE(r.endings[0].error);
        CHECK(r.endings[0].error->kind == dfb::ErrorKind::TimedOut);
        CHECK(r.endings[0].error->rank == c.missing.front());
        CHECK(r.endings[0].error->tile == c.missing.front());
        for (const int owner : c.missing)
            CHECK(has(r.endings[0].text, "tile " + std::to_string(owner) + ": generation 1 has 0 of 1 inputs"));
        CHECK(r.wrongAfter == 0);
    });
}

TEST_CASE("More than one tile of an owner: the first are listed, the rest are counted", "[timeouts]")
{
    const Run r = runAlone(std::make_shared<Board>(), 2, smallConfig(), timed(false), [](FrameBuffer&, auto&) {});
    INFO(joined(textsOf(r.endings)));
    CHECK(allSame(textsOf(r.endings)));
    CHECK(has(r.endings[0].text, "and 6 more tiles")); // each has 14
    CHECK(has(r.endings[0].text, "on rank 1: tile"));
    CHECK(r.wrongAfter == 0);
}

TEST_CASE("What fails a frame is said even if something is missing as well", "[timeouts]")
{
    const auto runCase = [](int culprit) {
        return run(std::make_shared<Board>(), 3, smallConfig(), timed(false), [&](FrameBuffer& fb, auto& frame) {
            const auto limit = Clock::now() + std::chrono::seconds(20);
            if (fb.rank() != culprit)
                return;
            while (!frame.failed() && Clock::now() < limit) // until the time-out of the others
                std::this_thread::sleep_for(std::chrono::milliseconds(1));
            frame.abort(std::make_exception_ptr(std::runtime_error("out of paint")));
        });
    };
    eachAtOnce(std::vector<int>{0, 1, 2}, runCase, [](int culprit, const Run& r) {
        INFO("rank " << culprit << joined(textsOf(r.endings)));
        CHECK(allSame(textsOf(r.endings)));
        CHECK(has(r.endings[0].text, "FrameError"));
        CHECK(r.wrongAfter == 0);
    });
}

TEST_CASE("A rank that does not call end(): the others get their error while it renders on", "[timeouts]")
{
    struct Outcome {
        std::vector<Ending> endings{3};
        std::size_t wrong = 1;
        bool sawFailure = false;
    };
    const auto runCase = [](int absent) {
        std::promise<void> othersDone;
        const auto othersAreDone = othersDone.get_future().share();
        std::atomic<int> left{2};
        Outcome o;
        runOn(std::make_shared<Board>(), 3, [&](const auto& communicator) {
            const Scene s = scene::makeScene(4);
            FrameBuffer fb(communicator, configOf(s));
            {
                auto frame = fb.begin(timed(true));
                frame.declare({});
                if (fb.rank() == absent) {
                    othersAreDone.wait_for(std::chrono::seconds(20));
                    o.sawFailure = frame.failed();
                }
                o.endings[static_cast<std::size_t>(fb.rank())] = endingOf(frame);
                if (fb.rank() != absent && --left == 0)
                    othersDone.set_value();
            }
            const auto report = scene::renderLoop(fb, s, Loop::Declared);
            if (fb.isDisplayRank())
                o.wrong = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
        });
        return o;
    };
    eachAtOnce(std::vector<int>{0, 1, 2}, runCase, [](int absent, const Outcome& o) {
        INFO("rank " << absent << joined(textsOf(o.endings)));
        CHECK(allSame(textsOf(o.endings)));
        for (const Ending& e : o.endings) {
            REQUIRE(e.error);
            CHECK(e.isFrameError);
            CHECK(e.error->kind == dfb::ErrorKind::TimedOut);
            CHECK(e.ms < 2 * limitMs + marginMs);
        }
        CHECK(has(o.endings[0].text, "waiting for rank"));
        CHECK(o.sawFailure);
        CHECK(o.wrong == 0);
    });
}

TEST_CASE("A rank that does not begin the frame: a TransportError on the others, and then on it", "[timeouts]")
{
    struct Outcome {
        std::vector<std::string> texts{3};
        std::vector<double> ms = std::vector<double>(3);
    };
    // `declares`: the others have inputs to declare, so they wait for the absent rank's answers.
    const bool declares = GENERATE(false, true);
    const auto runCase = [declares](int absent) {
        std::promise<void> othersDone;
        const auto othersAreDone = othersDone.get_future().share();
        std::atomic<int> left{2};
        Outcome o;
        runOn(std::make_shared<Board>(), 3, [&](const auto& communicator) {
            FrameBuffer fb(communicator, smallConfig());
            const auto rank = static_cast<std::size_t>(fb.rank());
            if (fb.rank() == absent)
                othersAreDone.wait_for(std::chrono::seconds(20));
            std::vector<dfb::TileInput> inputs;
            for (int tile = 0; declares && tile < fb.layout().tileCount(); ++tile)
                inputs.push_back({tile, static_cast<std::uint32_t>(rank), 0});
            o.texts[rank] = outcomeOf([&] {
                auto frame = fb.begin(timed(true));
                frame.declare(inputs);
                const auto start = Clock::now();
                try {
                    frame.end();
                } catch (...) {
                    o.ms[rank] = std::chrono::duration<double, std::milli>(Clock::now() - start).count();
                    throw;
                }
            });
            if (fb.rank() != absent && --left == 0)
                othersDone.set_value();
        });
        return o;
    };
    eachAtOnce(std::vector<int>{0, 1, 2}, runCase, [declares](int absent, const Outcome& o) {
        INFO("rank " << absent << joined(o.texts));
        for (std::size_t rank = 0; rank < 3; ++rank) {
            CHECK(has(o.texts[rank], "TransportError"));
            CHECK(o.ms[rank] < 2 * limitMs + marginMs);
            if (declares)
                CHECK(has(o.texts[rank], "declared their inputs, waiting for rank " + std::to_string(absent)));
        }
    });
}

TEST_CASE("One lost message of each kind: an error in time, on every rank", "[timeouts]")
{
    enum : std::uint32_t { AllDeclared = 1, FrameVerdict = 2 };
    struct Loss {
        const char* name;
        MessageKind kind;
        std::uint32_t scope;
        const char* says;     // part of the error
        bool verdictSurvives; // all ranks get the same FrameError, and the next frame is right
    };
    const std::vector<Loss> losses{
        {"input", MessageKind::Fragment, 0, "declared by rank", true},
        {"manifest", MessageKind::Manifest, 0, "declared", true},
        {"answer to a manifest", MessageKind::ManifestAck, 0, "declared", true},
        {"finished tiles", MessageKind::FinishedTiles, 0, "finished tiles have not come from rank", true},
        {"count of finished tiles", MessageKind::TilesDone, 0, "finished tiles have not come from rank", true},
        {"all have declared, up", MessageKind::ReduceUp, AllDeclared, "waiting for rank", true},
        {"all have declared, down", MessageKind::ReduceDown, AllDeclared, "waiting for rank", true},
        {"vote", MessageKind::ReduceUp, FrameVerdict, "not all ranks have ended", false},
        {"verdict", MessageKind::ReduceDown, FrameVerdict, "not all ranks have ended", false}};
    struct Case {
        Loss loss;
        int ranks, nth; // not always the first of its kind
    };
    std::vector<Case> cases;
    for (const Loss& loss : losses)
        for (const int ranks : {2, 5})
            for (int nth = 0; nth < (ranks == 2 ? 1 : 3); ++nth)
                cases.push_back({loss, ranks, nth});
    struct Outcome {
        std::vector<Ending> endings;
        std::vector<std::string> after;
        bool lost = false;
        std::size_t wrong = 0;
    };
    const auto runCase = [](const Case& c) {
        const auto board = std::make_shared<Board>();
        std::atomic<int> seen{0}, ready{0};
        std::atomic<bool> armed{false}, lost{false};
        board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer& message) {
            const bool isReduction = header.kind == MessageKind::ReduceUp || header.kind == MessageKind::ReduceDown;
            if (!armed || header.kind != c.loss.kind || header.number != 1
                || (isReduction && dfb::detail::loadAs<std::uint32_t>(message.data() + sizeof header) != c.loss.scope)
                || seen++ != c.nth)
                return Board::What::Pass;
            lost = true;
            return Board::What::Lose;
        };
        Outcome o;
        o.endings.resize(static_cast<std::size_t>(c.ranks));
        o.after.resize(o.endings.size());
        runOn(board, c.ranks, [&](const auto& communicator) {
            const Scene s = scene::makeScene(6, 9);
            FrameBuffer fb(communicator, configOf(s));
            const auto rank = static_cast<std::size_t>(fb.rank());
            fb.allReduce({1}, FrameBuffer::Reduce::Sum);
            armed = true;
            {
                auto frame = fb.begin(timed(true));
                std::vector<dfb::TileInput> inputs; // one of each rank for each tile
                for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
                    inputs.push_back({tile, static_cast<std::uint32_t>(rank), 0});
                frame.declare(inputs);
                for (const dfb::TileInput& input : inputs)
                    send(frame, input.tile, 1, input.source, 0, 0);
                // The time-out is for the lost message, not for the steps before it: all messages but votes are sent
                // before end().
                ++ready;
                const auto limit = Clock::now() + std::chrono::seconds(20);
                while ((ready < c.ranks || (!lost && c.loss.scope != FrameVerdict)) && Clock::now() < limit)
                    std::this_thread::sleep_for(std::chrono::milliseconds(1));
                o.endings[rank] = endingOf(frame);
            }
            o.after[rank] = outcomeOf([&] {
                const auto report = scene::renderLoop(fb, s, Loop::Declared);
                if (fb.isDisplayRank())
                    o.wrong = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
            });
        });
        o.lost = lost;
        return o;
    };
    eachAtOnce(cases, runCase, [](const Case& c, const Outcome& o) {
        const auto texts = textsOf(o.endings);
        INFO(c.loss.name << " " << c.nth << ", " << c.ranks << " ranks" << joined(texts) << "\n after it"
                         << joined(o.after));
        CHECK(o.lost);
        CHECK(o.wrong == 0);
        bool said = false;
        for (std::size_t rank = 0; rank < o.endings.size(); ++rank) {
            const Ending& e = o.endings[rank];
            CHECK(e.ms < 2 * limitMs + marginMs);
            said = said || has(e.text, c.loss.says);
            if (c.loss.verdictSurvives) {
                CHECK(e.isFrameError);
                CHECK((e.error && e.error->kind == dfb::ErrorKind::TimedOut));
                CHECK(o.after[rank] == "fine");
            } else {
                // A rank that has the verdict is fine; a rank without it can only give up. Then no rank can go on.
                CHECK((e.text == "fine" || (e.error && e.error->kind == dfb::ErrorKind::Transport)));
                CHECK(has(o.after[rank], "TransportError"));
            }
        }
        CHECK(said);
        if (c.loss.verdictSurvives)
            CHECK(allSame(texts));
    });
}

TEST_CASE("Lost credit, or requests for it: setTile() does not wait for ever, and the next frame is right",
          "[timeouts]")
{
    using Large = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<64>, dfb::NoPixelOp, BoardTransport>;
    for (const auto kind : {MessageKind::Credit, MessageKind::CreditRequest}) {
        // All messages of this kind that rank 1 gets or sends are lost, as the next credit would replace a lost one.
        // With 9 ranks a sender's own part of the pool is less than a message.
        const int ranks = kind == MessageKind::Credit ? 2 : 9;
        struct Outcome {
            std::vector<Ending> endings;
            std::size_t wrong = 1;
            bool lost = false;
        };
        const Scene s = scene::makeScene(4, 2, 320, 320);
        const auto runCase = [&] {
            Outcome o;
            o.endings.resize(static_cast<std::size_t>(ranks));
            const auto board = std::make_shared<Board>();
            std::atomic<bool> lost{false};
            board->inspect = [&](int from, int to, const MessageHeader& header, dfb::Buffer&) {
                const bool loses =
                    header.kind == kind && header.number == 1 && (kind == MessageKind::Credit ? to == 1 : from == 1);
                lost = lost || loses;
                return loses ? Board::What::Lose : Board::What::Pass;
            };
            runOn(board, ranks, [&](const auto& communicator) {
                auto config = configOf(s);
                config.messages.poolBytes = 0; // 1 MiB
                config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
                Large fb(communicator, config);
                {
                    auto frame = fb.begin(timed(true));
                    std::vector<dfb::TileInput> inputs;
                    for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
                        for (std::uint16_t part = 0; part < 2; ++part)
                            if (fb.rank() == 1)
                                inputs.push_back({tile, 1, part});
                    frame.declare(inputs);
                    const auto tile = std::make_unique<Large::Tile>();
                    for (const dfb::TileInput& input : inputs) { // 4 MB
                        frame.start(*tile, input.tile);
                        for (int i = 0; i < 4 * 64 * 64; ++i)
                            tile->color[i] = static_cast<float>(i % 7 + 1);
                        tile->generation = 1;
                        tile->part = input.part;
                        frame.setTile(*tile);
                    }
                    o.endings[static_cast<std::size_t>(fb.rank())] = endingOf(frame);
                }
                const auto report = scene::renderLoop(fb, s, Loop::Declared);
                if (fb.isDisplayRank())
                    o.wrong = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
            });
            o.lost = lost;
            return o;
        };
        const Outcome o = undisturbed(runCase);
        INFO((kind == MessageKind::Credit ? "credit" : "requests") << joined(textsOf(o.endings)));
        CHECK(o.lost);
        CHECK(allSame(textsOf(o.endings)));
        CHECK((o.endings[0].error && o.endings[0].error->kind == dfb::ErrorKind::TimedOut));
        CHECK(has(o.endings[0].text, "declared by rank 1"));
        CHECK(o.wrong == 0);
    }
}

TEST_CASE("A partial frame does without finished tiles whose credit was lost", "[timeouts]")
{
    using Large = dfb::DistributedFrameBuffer<dfb::BasicImageParallel<64>, dfb::NoPixelOp, BoardTransport>;
    for (const auto progress : {dfb::Progress::Auto, dfb::Progress::Caller}) {
        struct Outcome {
            std::vector<std::string> texts{2}, after{2};
            int complete = 0, completeAfter = 0, tiles = 0;
        };
        const auto runCase = [&] {
            Outcome o;
            const auto board = std::make_shared<Board>();
            board->inspect = [](int, int to, const MessageHeader& header, dfb::Buffer&) {
                return header.kind == MessageKind::Credit && header.number == 1 && to == 1 ? Board::What::Lose
                                                                                           : Board::What::Pass;
            };
            runOn(
                board, 2,
                [&](const auto& communicator) {
                    auto config = configOf(scene::makeScene(0, 1, 640, 640));
                    config.messages.poolBytes = 0; // 1 MiB; the tiles have 6 MiB
                    config.image.format = dfb::OutputFormat::RGBA32F;
                    config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 1; };
                    dfb::NetworkConfig options;
                    options.progress = progress;
                    Large fb(communicator, config, options);
                    const auto rank = static_cast<std::size_t>(fb.rank());
                    const auto frame = [&](int timeoutMs, int& count) {
                        dfb::FrameConfig params = timed(false, timeoutMs);
                        params.allowPartial = true;
                        const auto report = dfb::ImageParallelLoop(fb, dfb::WorkDistribution::Owned)
                                                .render(
                                                    [](auto& tile) {
                                                        tile.forEachPixel([](int x, int y, float* rgba, float&) {
                                                            rgba[0] =
                                                                static_cast<float>((x + y) % 2); // so it all travels
                                                            rgba[3] = 1;
                                                        });
                                                    },
                                                    params);
                        if (fb.isDisplayRank())
                            o.tiles = fb.layout().tileCount();
                        for (int tile = 0; fb.isDisplayRank() && tile < o.tiles; ++tile)
                            count += fb.isComplete(tile);
                        if (report.failure)
                            throw dfb::FrameError(*report.failure);
                    };
                    o.texts[rank] = outcomeOf([&] { frame(limitMs, o.complete); });
                    o.after[rank] = outcomeOf([&] { frame(60000, o.completeAfter); });
                },
                progress == dfb::Progress::Caller ? std::optional<std::uint64_t>(1) : std::nullopt);
            return o;
        };
        const Outcome o = undisturbed(runCase);
        INFO((progress == dfb::Progress::Caller ? "caller" : "auto") << joined(o.texts) << joined(o.after));
        CHECK(allSame(o.texts));
        CHECK(has(o.texts[0], "timed out"));
        CHECK((o.complete > 0 && o.complete < o.tiles));
        CHECK(o.after == std::vector<std::string>(2, "fine"));
        CHECK(o.completeAfter == o.tiles);
    }
}

TEST_CASE("Credit lost in both directions: no rank waits for ever in setTile()", "[timeouts]")
{
    using Large = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<64>, dfb::NoPixelOp, BoardTransport>;
    const auto runCase = [&] {
        const auto board = std::make_shared<Board>();
        board->inspect = [](int, int, const MessageHeader& header, dfb::Buffer&) {
            return header.kind == MessageKind::Credit && header.number == 1 ? Board::What::Lose : Board::What::Pass;
        };
        std::vector<std::string> texts(2);
        runOn(board, 2, [&](const auto& communicator) {
            auto config = configOf(scene::makeScene(0, 1, 640, 640));
            config.messages.poolBytes = 0; // 1 MiB
            Large fb(communicator, config);
            texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] {
                auto frame = fb.begin(timed(false));
                const auto tile = std::make_unique<Large::Tile>();
                for (int index = 0; index < fb.layout().tileCount(); ++index) {
                    frame.start(*tile, index);
                    for (int i = 0; i < 4 * 64 * 64; ++i)
                        tile->color[i] = static_cast<float>(i % 7 + 1);
                    tile->generation = 1;
                    frame.setTile(*tile);
                }
                frame.end();
            });
        });
        return texts;
    };
    const auto texts = undisturbed(runCase);
    INFO(joined(texts));
    for (const std::string& text : texts)
        CHECK((has(text, "timed out") || (has(text, "TransportError") && !has(text, "time limit"))));
}

TEST_CASE("Time-outs in frames of one framebuffer leave the other on the same connection alone", "[timeouts]")
{
    const Scene s = scene::makeScene(5, 4);
    struct Outcome {
        std::vector<std::string> texts{3};
        std::size_t wrong = 2;
    };
    const auto runCase = [&] {
        Outcome o;
        runOn(std::make_shared<Board>(), 3, [&](const BoardTransport::Communicator& communicator) {
            const auto connection = dfb::connect<BoardTransport>(communicator);
            FrameBuffer a(connection, configOf(s)), b(connection, configOf(s));
            {
                auto frameB = b.begin(scene::paramsOf(s));
                {
                    auto frameA = a.begin(timed(false));
                    o.texts[static_cast<std::size_t>(a.rank())] = endingOf(frameA).text;
                }
                for (int index : b.ownedTiles())
                    send(frameB, index, 0, 0, 0, 0);
                frameB.end();
            }
            for (FrameBuffer* fb : {&a, &b}) {
                const auto report = scene::renderLoop(*fb, s, Loop::Listing3);
                if (fb->isDisplayRank())
                    o.wrong -= scene::wrongValues(Picture(fb->image(), report), scene::referenceOf(s)) == 0;
            }
        });
        return o;
    };
    const Outcome o = undisturbed(runCase);
    INFO(joined(o.texts));
    CHECK((allSame(o.texts) && has(o.texts[0], "FrameError: dfb: timed out")));
    CHECK(o.wrong == 0);
}

TEST_CASE("Progress by the caller: an absent rank that does not poll is a TransportError after twice the time",
          "[timeouts]")
{
    const auto runCase = [&] {
        std::promise<void> otherDone;
        std::vector<Ending> endings(2);
        runOn(
            std::make_shared<Board>(), 2,
            [&](const auto& communicator) {
                dfb::NetworkConfig options;
                options.progress = dfb::Progress::Caller;
                FrameBuffer fb(communicator, smallConfig(), options);
                auto frame = fb.begin(timed(true));
                frame.declare({});
                if (fb.rank() == 1)
                    otherDone.get_future().wait_for(std::chrono::seconds(20));
                endings[static_cast<std::size_t>(fb.rank())] = endingOf(frame);
                if (fb.rank() == 0)
                    otherDone.set_value();
            },
            1);
        return endings;
    };
    const auto endings = undisturbed(runCase);
    INFO(joined(textsOf(endings)));
    for (const Ending& e : endings) {
        REQUIRE(e.error);
        CHECK(e.error->kind == dfb::ErrorKind::Transport);
    }
    CHECK(endings[0].ms >= 2 * limitMs);
    CHECK(endings[0].ms < 2 * limitMs + marginMs);
}

} // namespace timeouts_cases
