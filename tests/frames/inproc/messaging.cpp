// What the messaging layer promises to frames: several framebuffers on one connection, repeated and damaged messages,
// gathering, and progress by the caller. Ranks are threads; every test has a time limit.
#include "board.hpp"
#include "catch.hpp"
#include "flood.hpp"
#include "forward.hpp"
#include "random_scene.hpp"

#include <dfb/comm/mailbox.hpp>
#include <dfb/comm/reduction.hpp>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <cstring>
#include <functional>
#include <future>
#include <map>
#include <memory>
#include <mutex>
#include <new>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace messaging_cases {

namespace {

using board::Board;
using board::BoardTransport;
using board::joined;
using board::runOn;
using dfb::detail::MessageHeader;
using dfb::detail::MessageKind;
using flood::fillTile;
using flood::floodConfig;
using flood::wrongSums;
using scene::configOf;
using scene::has;
using scene::Loop;
using scene::outcomeOf;
using scene::Picture;
using scene::Scene;

template <class TileOp>
using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, BoardTransport>;
using AddingFrameBuffer = dfb::DistributedFrameBuffer<flood::Adder, dfb::NoPixelOp, BoardTransport>;
using Blend = dfb::BasicAlphaBlend<16>;
using Single = dfb::BasicImageParallel<16>;

Scene sceneFor(Loop loop, std::uint64_t seed = 1) { return scene::makeSceneFor(loop, 6, seed); }

} // namespace

// ---- several objects on one connection, several connections

namespace {

// Two frames of different operations and images are open at once, with interleaved calls. Returns whether the images on
// both display ranks are right.
template <class A, class B>
bool interleaved(A& a, B& b, const Scene& sa, const Scene& sb, bool endFirst, bool abortB = false)
{
    bool right = true;
    {
        auto frameA = a.begin(scene::paramsOf(sa));
        auto frameB = b.begin(scene::paramsOf(sb));
        const auto tileA = std::make_unique<typename A::Tile>();
        const auto tileB = std::make_unique<typename B::Tile>();
        for (int index : a.ownedTiles())
            scene::sendParent(frameA, *tileA, index, static_cast<int>(sa.bricks.size()));
        const auto mine = scene::bricksOf(sa, a.rank(), a.size());
        for (int index = 0; index < std::max(a.layout().tileCount(), b.layout().tileCount()); ++index) {
            if (index < a.layout().tileCount())
                for (const dfb::Brick& brick : mine)
                    scene::sendInput(frameA, *tileA, sa, brick, index);
            if (index < b.layout().tileCount() && (index + 1) % b.size() == b.rank()) {
                frameB.start(*tileB, index);
                scene::renderBrick(sb, sb.bricks.front(), *tileB);
                frameB.setTile(*tileB);
            }
            if (abortB && index == 3 && b.rank() == b.size() - 1)
                frameB.abort(std::make_exception_ptr(std::runtime_error("B broke")));
        }
        const auto endA = [&] {
            const auto report = frameA.end();
            right =
                right
                && (!a.isDisplayRank() || scene::wrongValues(Picture(a.image(), report), scene::referenceOf(sa)) == 0);
        };
        const auto endB = [&] {
            const std::string text = outcomeOf([&] {
                const auto report = frameB.end();
                right = right
                        && (!b.isDisplayRank()
                            || scene::wrongValues(Picture(b.image(), report), scene::referenceOf(sb)) == 0);
            });
            right = right && (abortB ? has(text, "FrameError") && has(text, "B broke") : text == "fine");
        };
        if (endFirst)
            endA(), endB();
        else
            endB(), endA();
    }
    return right;
}

} // namespace

TEST_CASE("Frames of two framebuffers on one connection, open at the same time; one that fails", "[messaging]")
{
    const Scene sa = sceneFor(Loop::Declared, 3);
    Scene sb = scene::makeScene(1, 4, 70, 90);
    sb.bricks[0].bounds = {{0, 0, 0}, {70, 90, 1}};
    for (const int ranks : {1, 2, 5})
        for (const bool shared : {true, false}) // otherwise each has a connection, on one communicator
            for (const bool shuffle : {false, true}) {
                INFO(ranks << " ranks" << (shared ? ", shared" : "") << (shuffle ? ", shuffled" : ""));
                std::vector<std::string> texts(static_cast<std::size_t>(ranks));
                runOn(
                    std::make_shared<Board>(), ranks,
                    [&](const BoardTransport::Communicator& communicator) {
                        const int rank = communicator.inner.rank();
                        const auto connection =
                            shared ? dfb::connect<BoardTransport>(communicator) : std::shared_ptr<dfb::Connection>();
                        std::unique_ptr<FrameBuffer<Blend>> a;
                        std::unique_ptr<FrameBuffer<dfb::BasicImageParallel<32>>> b;
                        auto configB = configOf(sb);
                        configB.image.displayRank = ranks - 1;
                        if (shared) {
                            a = std::make_unique<FrameBuffer<Blend>>(connection, configOf(sa));
                            b = std::make_unique<FrameBuffer<dfb::BasicImageParallel<32>>>(connection, configB);
                        } else {
                            a = std::make_unique<FrameBuffer<Blend>>(communicator, configOf(sa));
                            b = std::make_unique<FrameBuffer<dfb::BasicImageParallel<32>>>(communicator, configB);
                        }
                        std::string text;
                        for (int i = 0; i < 4; ++i)
                            if (!interleaved(*a, *b, sa, sb, i / 2 == 0, i % 2 == 1))
                                text += "wrong in round " + std::to_string(i) + "; ";
                        // Ranks destroy the two in different orders.
                        if (rank % 2 == 0)
                            a.reset(), b.reset();
                        else
                            b.reset(), a.reset();
                        texts[static_cast<std::size_t>(rank)] = text;
                    },
                    shuffle ? std::optional<std::uint64_t>(7) : std::nullopt);
                INFO(joined(texts));
                CHECK(texts == std::vector<std::string>(static_cast<std::size_t>(ranks)));
            }
}

TEST_CASE("A framebuffer made later on one rank gets what came for it before", "[messaging]")
{
    const Scene s = sceneFor(Loop::Declared, 5);
    for (const int late : {0, 2}) { // messages of ranks 1 and 2, or of rank 3, come before
        const int expected = late == 0 ? 2 : 1;
        const auto board = std::make_shared<Board>();
        std::mutex mutex;
        std::condition_variable changed;
        int came = 0; // messages for the second framebuffer, on the late rank
        bool waiting = true, early = false;
        board->passed = [&](int, int to, const MessageHeader& header) {
            if (to != late || header.receiver != 1)
                return;
            const std::lock_guard<std::mutex> lock(mutex);
            came += waiting;
            changed.notify_all();
        };
        std::vector<std::size_t> wrong;
        runOn(board, 4, [&](const BoardTransport::Communicator& communicator) {
            const auto connection = dfb::connect<BoardTransport>(communicator);
            FrameBuffer<Blend> first(connection, configOf(s));
            if (first.rank() == late) {
                std::unique_lock<std::mutex> lock(mutex);
                early = changed.wait_for(lock, std::chrono::seconds(20), [&] { return came == expected; });
                waiting = false;
            }
            FrameBuffer<Blend> second(connection, configOf(s));
            for (auto* fb : {&second, &first}) {
                const auto report = scene::renderLoop(*fb, s, Loop::Declared);
                if (fb->isDisplayRank())
                    wrong.push_back(scene::wrongValues(Picture(fb->image(), report), scene::referenceOf(s)));
            }
        });
        INFO("rank " << late);
        CHECK(early);
        CHECK(wrong == std::vector<std::size_t>(2));
    }
}

TEST_CASE("One framebuffer goes while the other has a frame open; another is made after it", "[messaging]")
{
    const Scene s = sceneFor(Loop::Listing3, 6);
    std::size_t wrong = 1;
    runOn(std::make_shared<Board>(), 3, [&](const BoardTransport::Communicator& communicator) {
        const auto connection = dfb::connect<BoardTransport>(communicator);
        FrameBuffer<Blend> a(connection, configOf(s));
        auto b = std::make_unique<FrameBuffer<Single>>(connection, configOf(s));
        for (int i = 0; i < 3; ++i) {
            auto frame = a.begin(scene::paramsOf(s));
            b.reset();
            b = std::make_unique<FrameBuffer<Single>>(connection, configOf(s));
            const auto tile = std::make_unique<FrameBuffer<Blend>::Tile>();
            for (int index : a.ownedTiles())
                scene::sendParent(frame, *tile, index, static_cast<int>(s.bricks.size()));
            scene::renderLoop(*b, sceneFor(Loop::ImageOwned), Loop::ImageOwned);
            for (const dfb::Brick& brick : scene::bricksOf(s, a.rank(), a.size()))
                for (int index = 0; index < a.layout().tileCount(); ++index)
                    scene::sendInput(frame, *tile, s, brick, index);
            const auto report = frame.end();
            if (a.isDisplayRank())
                wrong = scene::wrongValues(Picture(a.image(), report), scene::referenceOf(s));
        }
    });
    CHECK(wrong == 0);
}

// ---- messages twice, and damaged

TEST_CASE("A transport that delivers each message twice: the image is right, and the frame says so", "[messaging]")
{
    for (const Loop loop : {Loop::Listing3, Loop::Declared, Loop::ImageDealt})
        for (const bool shuffle : {false, true}) {
            const Scene s = sceneFor(loop);
            const auto expected = scene::referenceOf(s);
            const auto board = std::make_shared<Board>();
            board->inspect = [](int, int, const MessageHeader&, dfb::Buffer&) { return Board::What::Twice; };
            std::vector<std::size_t> wrong;
            std::vector<dfb::FrameReport> reports;
            const auto body = [&](auto& fb) {
                for (int i = 0; i < 3; ++i) {
                    const auto report = scene::renderLoop(fb, s, loop);
                    if (fb.isDisplayRank()) {
                        wrong.push_back(scene::wrongValues(Picture(fb.image(), report), expected));
                        reports.push_back(report);
                    }
                }
            };
            runOn(
                board, 3,
                [&](const auto& communicator) {
                    if (scene::isDataParallel(loop)) {
                        FrameBuffer<Blend> fb(communicator, configOf(s));
                        body(fb);
                    } else {
                        FrameBuffer<Single> fb(communicator, configOf(s));
                        body(fb);
                    }
                },
                shuffle ? std::optional<std::uint64_t>(3) : std::nullopt);
            INFO("loop " << static_cast<int>(loop) << (shuffle ? ", shuffled" : ""));
            CHECK(wrong == std::vector<std::size_t>(3));
            for (const dfb::FrameReport& r : reports) {
                CHECK(r.repeatedMessages > 0);
                CHECK(r.lateMessages == 0);
            }
        }
}

TEST_CASE("Repeated messages are counted exactly, and a frame without any has none", "[messaging]")
{
    const auto board = std::make_shared<Board>();
    board->inspect = [](int, int, const MessageHeader& header, dfb::Buffer&) {
        return header.kind == MessageKind::Fragment && header.number == 1 ? Board::What::Twice : Board::What::Pass;
    };
    std::vector<std::int64_t> repeated;
    std::promise<void> setAll;
    std::atomic<int> left{2};
    runOn(board, 3, [&](const auto& communicator) {
        const Scene s = sceneFor(Loop::Listing3);
        auto config = configOf(s);
        config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
        FrameBuffer<Blend> fb(communicator, config);
        for (int round = 0; round < 2; ++round) {
            auto frame = fb.begin();
            const auto tile = std::make_unique<FrameBuffer<Blend>::Tile>();
            if (fb.rank() > 0)
                for (int index = 0; index < 28; ++index) {
                    frame.start(*tile, index);
                    tile->generation = 1;
                    frame.setTile(*tile);
                }
            if (fb.rank() > 0 && round == 0 && --left == 0)
                setAll.set_value(); // all repeated messages have come
            if (fb.rank() == 0 && round == 0)
                setAll.get_future().wait_for(std::chrono::seconds(20));
            for (int index : fb.ownedTiles())
                scene::sendParent(frame, *tile, index, 2);
            const auto report = frame.end();
            if (fb.rank() == 0)
                repeated.push_back(report.repeatedMessages);
        }
    });
    CHECK(repeated == std::vector<std::int64_t>{56, 0});
}

TEST_CASE("Copies that come when their frame is long over do no harm", "[messaging]")
{
    for (const Loop loop : {Loop::Listing3, Loop::Declared}) {
        const Scene s = sceneFor(loop);
        const auto expected = scene::referenceOf(s);
        const auto board = std::make_shared<Board>();
        board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer&) {
            return header.number == 1 || header.number == 2 ? Board::What::CopyHeld : Board::What::Pass;
        };
        std::vector<std::size_t> wrong;
        std::vector<std::int64_t> late;
        std::size_t copies = 0;
        runOn(board, 3, [&](const BoardTransport::Communicator& communicator) {
            FrameBuffer<Blend> fb(communicator, configOf(s));
            for (int i = 0; i < 4; ++i) {
                fb.allReduce({1}, FrameBuffer<Blend>::Reduce::Sum); // all have left the frame before
                if (i == 3 && fb.rank() == 1) {
                    copies = board->held.size();
                    board->release();
                }
                const auto report = scene::renderLoop(fb, s, loop);
                if (fb.isDisplayRank()) {
                    wrong.push_back(scene::wrongValues(Picture(fb.image(), report), expected));
                    late.push_back(report.lateMessages);
                }
            }
        });
        CHECK(wrong == std::vector<std::size_t>(4));
        CHECK(late == std::vector<std::int64_t>(4));
        CHECK(copies > 20);
    }
}

TEST_CASE("With checksums the image is the same", "[messaging]")
{
    for (const Loop loop : {Loop::Listing3, Loop::Declared, Loop::ImageDealt}) {
        const Scene s = sceneFor(loop);
        std::vector<std::size_t> wrong;
        std::atomic<int> without{0};
        const auto board = std::make_shared<Board>();
        board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer&) {
            without += header.checksum == 0;
            return Board::What::Pass;
        };
        const auto body = [&](auto& fb) {
            for (int i = 0; i < 2; ++i) {
                const auto report = scene::renderLoop(fb, s, loop);
                if (fb.isDisplayRank())
                    wrong.push_back(scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s)));
            }
        };
        runOn(board, 3, [&](const auto& communicator) {
            dfb::NetworkConfig options;
            options.checksums = true;
            if (scene::isDataParallel(loop)) {
                FrameBuffer<Blend> fb(communicator, configOf(s), options);
                body(fb);
            } else {
                FrameBuffer<Single> fb(communicator, configOf(s), options);
                body(fb);
            }
        });
        CHECK(wrong == std::vector<std::size_t>(2));
        CHECK(without == 0);
    }
}

namespace {

// A peerTimeout within which a rank answers even on a busy machine.
constexpr int peerMs = 1500;

// The outcomes of three frames with checksums. One byte of one message was changed in the second frame: in the first
// message of its kind. `place` counts from the message's start or, if negative, from its end.
struct Damaged {
    bool done = false;
    std::vector<std::string> before, texts, after;
    std::size_t wrong = 0;
};

Damaged damagedFrame(MessageKind kind, std::uint32_t scope, int place, int timeoutMs, int peerTimeoutMs = 0)
{
    Damaged result;
    result.before.resize(2);
    result.texts.resize(2);
    result.after.resize(2);
    const auto board = std::make_shared<Board>();
    std::atomic<bool> done{false}, armed{false};
    std::promise<void> mayGoOn;
    const auto mayGoOnFuture = mayGoOn.get_future().share();
    std::atomic<int> notReady{2};
    board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer& message) {
        const bool isReduction = header.kind == MessageKind::ReduceUp || header.kind == MessageKind::ReduceDown;
        const auto size = static_cast<int>(message.size());
        if (armed && header.kind == kind && place < size && place >= -size
            && (!isReduction || dfb::detail::loadAs<std::uint32_t>(message.data() + sizeof header) == scope)
            && !done.exchange(true))
            message.data()[place < 0 ? size + place : place] ^= std::byte{0x24};
        return Board::What::Pass;
    };
    Scene s = sceneFor(Loop::Declared);
    runOn(board, 2, [&](const auto& communicator) {
        dfb::NetworkConfig options;
        options.checksums = true;
        options.peerTimeout = std::chrono::milliseconds(peerTimeoutMs);
        FrameBuffer<Blend> fb(communicator, configOf(s), options);
        const auto rank = static_cast<std::size_t>(fb.rank());
        const auto frame = [&](const Scene& shown, int limit) {
            return outcomeOf([&] {
                Scene timed = shown;
                timed.timeout = std::chrono::milliseconds(limit);
                const auto report = scene::renderLoop(fb, timed, Loop::Declared);
                if (fb.isDisplayRank())
                    result.wrong += scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(shown));
            });
        };
        Scene nothing = s; // so that the next frame's inputs have to be declared
        nothing.bricks.clear();
        result.before[rank] = frame(nothing, 20000);
        // No rank is still in that frame, so a message that comes early belongs to the next frame.
        armed = true;
        if (--notReady == 0)
            mayGoOn.set_value();
        mayGoOnFuture.wait();
        result.texts[rank] = frame(s, timeoutMs);
        // After a TransportError no rank can render another frame.
        result.after[rank] = has(result.texts[rank], "TransportError") ? "" : frame(s, 20000);
    });
    result.done = done;
    return result;
}

} // namespace

TEST_CASE("With checksums a changed byte anywhere is an error, never a wrong image", "[messaging]")
{
    enum : std::uint32_t { AllDeclared = 1, FrameVerdict = 2 };
    struct Target {
        const char* name;
        MessageKind kind;
        std::uint32_t scope;
    };
    const std::vector<Target> targets{{"input", MessageKind::Fragment, 0},
                                      {"manifest", MessageKind::Manifest, 0},
                                      {"answer to a manifest", MessageKind::ManifestAck, 0},
                                      {"finished tiles", MessageKind::FinishedTiles, 0},
                                      {"count of finished tiles", MessageKind::TilesDone, 0},
                                      {"all have declared, up", MessageKind::ReduceUp, AllDeclared},
                                      {"all have declared, down", MessageKind::ReduceDown, AllDeclared},
                                      {"vote", MessageKind::ReduceUp, FrameVerdict},
                                      {"verdict", MessageKind::ReduceDown, FrameVerdict}};
    struct Case {
        Target target;
        int place;
    };
    std::vector<Case> cases;
    for (const Target& target : targets)
        // Magic number, version, kind, receiver, frame, running number, checksum, the first and the last of the body.
        for (const int place : {0, 2, 3, 4, 8, 16, 20, 24, -1})
            if (target.kind != MessageKind::ManifestAck || place != 24) // it has no body
                cases.push_back({target, place});
    const auto runCase = [](const Case& c) {
        const int limitMs = c.target.scope == FrameVerdict ? 2000 : 20000; // only a lost verdict is waited for
        return damagedFrame(c.target.kind, c.target.scope, c.place, limitMs);
    };
    board::eachAtOnce(cases, runCase, [](const Case& c, const Damaged& d) {
        INFO(c.target.name << ", byte " << c.place << joined(d.texts) << "\n after it" << joined(d.after));
        CHECK(d.before == std::vector<std::string>(2, "fine"));
        CHECK(d.done);
        CHECK(d.wrong == 0);
        int errors = 0;
        bool dead = false;
        for (std::size_t rank = 0; rank < 2; ++rank) {
            const std::string& text = d.texts[rank];
            errors += text != "fine";
            dead = dead || has(text, "TransportError");
            CHECK((text == "fine" || has(text, "FrameError: dfb: malformed message")
                   || has(text, "FrameError: dfb: timed out") || has(text, "TransportError")));
        }
        // A rank that misses the verdict cannot fail a frame that the other rank has seen end well.
        CHECK(errors >= 1);
        if (c.target.scope != FrameVerdict) {
            CHECK(d.texts[0] == d.texts[1]);
            CHECK_FALSE(dead);
        }
        for (const std::string& text : d.after)
            CHECK((dead ? text.empty() || has(text, "TransportError") : text == "fine"));
    });
}

TEST_CASE("A damaged vote or verdict does not hang a frame that has no time-out", "[messaging]")
{
    enum : std::uint32_t { FrameVerdict = 2 };
    board::eachAtOnce(
        std::vector<MessageKind>{MessageKind::ReduceUp, MessageKind::ReduceDown},
        [](MessageKind kind) { return damagedFrame(kind, FrameVerdict, -1, 0, peerMs); },
        [](MessageKind kind, const Damaged& d) {
            INFO((kind == MessageKind::ReduceUp ? "vote" : "verdict") << joined(d.texts));
            CHECK(d.done);
            CHECK(d.wrong == 0);
            // For the rank that has the verdict the frame ended well. It gets the error in the next frame.
            CHECK(has(d.texts[1], "TransportError"));
            CHECK((kind == MessageKind::ReduceDown
                   || has(d.texts[0], "not all ranks have ended this frame after " + std::to_string(peerMs) + " ms")
                   || has(d.texts[1], "not all ranks have ended this frame after " + std::to_string(peerMs) + " ms")));
            CHECK((d.texts[0] == "fine" ? has(d.after[0], "TransportError") : has(d.texts[0], "TransportError")));
        });
}

TEST_CASE("A damaged vote does not keep a frame open that is ended by tryEnd()", "[messaging]")
{
    enum : std::uint32_t { FrameVerdict = 2 };
    struct Outcome {
        bool done = false;
        std::vector<std::string> texts = std::vector<std::string>(2);
    };
    const Outcome o = undisturbed([] {
        const auto board = std::make_shared<Board>();
        std::atomic<bool> done{false};
        board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer& message) {
            if (header.kind == MessageKind::ReduceUp
                && dfb::detail::loadAs<std::uint32_t>(message.data() + sizeof header) == FrameVerdict
                && !done.exchange(true))
                message.data()[message.size() - 1] ^= std::byte{0x24};
            return Board::What::Pass;
        };
        Outcome outcome;
        runOn(board, 2, [&](const auto& communicator) {
            dfb::NetworkConfig options;
            options.checksums = true;
            options.peerTimeout = std::chrono::milliseconds(peerMs);
            FrameBuffer<Blend> fb(communicator, configOf(sceneFor(Loop::Declared)), options);
            outcome.texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] {
                dfb::FrameConfig params;
                params.declared = true;
                auto frame = fb.begin(params);
                frame.declare({});
                const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(20);
                while (!frame.tryEnd()) {
                    if (std::chrono::steady_clock::now() > limit)
                        throw std::runtime_error("the frame is still open");
                    std::this_thread::sleep_for(std::chrono::milliseconds(1));
                }
            });
        });
        outcome.done = done;
        return outcome;
    });
    INFO(joined(o.texts));
    CHECK(o.done);
    CHECK(std::any_of(o.texts.begin(), o.texts.end(), [](const std::string& text) {
        return has(text, "not all ranks have ended this frame after " + std::to_string(peerMs) + " ms");
    }));
    for (const std::string& text : o.texts)
        CHECK(has(text, "TransportError"));
}

TEST_CASE("With frames in flight a damaged message costs frames, not the framebuffer", "[messaging]")
{
    const Scene s = sceneFor(Loop::Declared);
    const auto board = std::make_shared<Board>();
    std::atomic<bool> done{false};
    board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer& message) {
        if (header.kind == MessageKind::Fragment && !done.exchange(true))
            message.data()[message.size() - 1] ^= std::byte{1};
        return Board::What::Pass;
    };
    std::vector<std::string> texts(2);
    std::vector<std::vector<std::string>> after(2);
    std::size_t wrong = 1;
    runOn(board, 2, [&](const auto& communicator) {
        auto config = configOf(s);
        config.framesInFlight = 2; // the second has never begun one when the first fails
        dfb::NetworkConfig options;
        options.checksums = true;
        FrameBuffer<Blend> fb(communicator, config, options);
        const auto rank = static_cast<std::size_t>(fb.rank());
        texts[rank] = outcomeOf([&] { scene::renderLoop(fb, s, Loop::Declared); });
        after[rank].push_back(outcomeOf([&] { scene::renderLoop(fb, s, Loop::Declared); }));
        after[rank].push_back(outcomeOf([&] {
            const auto report = scene::renderLoop(fb, s, Loop::Declared);
            if (fb.isDisplayRank())
                wrong = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
        }));
    });
    for (std::size_t rank = 0; rank < 2; ++rank) {
        INFO(texts[rank] << joined(after[rank]));
        CHECK(has(texts[rank], "FrameError: dfb: malformed message"));
        // No rank can tell that the message did not belong to this frame.
        CHECK(has(after[rank][0], "FrameError: dfb: malformed message"));
        CHECK(after[rank][1] == "fine");
    }
    CHECK(wrong == 0);
}

TEST_CASE("A damaged part of a reduction that its receiver is not at yet ends in an error on every rank", "[messaging]")
{
    const Scene s = sceneFor(Loop::Declared);
    const auto all = undisturbed([&] {
        const auto board = std::make_shared<Board>();
        std::atomic<bool> armed{false}, done{false};
        std::promise<void> came;
        board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer& message) {
            if (armed && header.kind == MessageKind::ReduceUp && !done.exchange(true))
                message.data()[message.size() - 1] ^= std::byte{1};
            return Board::What::Pass;
        };
        board->passed = [&](int, int, const MessageHeader& header) {
            if (header.kind == MessageKind::ReduceUp && armed.exchange(false))
                came.set_value();
        };
        std::vector<std::string> texts(2);
        runOn(board, 2, [&](const auto& communicator) {
            auto config = configOf(s);
            config.executor = std::make_shared<dfb::CallerExecutor>(); // its tasks run in poll()
            dfb::NetworkConfig options;
            options.checksums = true;
            options.peerTimeout = std::chrono::milliseconds(peerMs);
            FrameBuffer<Blend> fb(communicator, config, options);
            scene::renderLoop(fb, s, Loop::Declared);
            if (fb.rank() == 1) {
                armed = true;
            } else {
                came.get_future().wait_for(std::chrono::seconds(20));
                while (fb.poll()) {
                }
            }
            texts[static_cast<std::size_t>(fb.rank())] =
                outcomeOf([&] { fb.allReduce({7}, FrameBuffer<Blend>::Reduce::Sum); });
        });
        return texts;
    });
    INFO(joined(all));
    for (const std::string& text : all) {
        CHECK(has(text, "TransportError: dfb: malformed message"));
        CHECK(has(text, "in a message from rank 1"));
    }
}

TEST_CASE("Without a peerTimeout a damaged message of before does not end a reduction", "[messaging]")
{
    const auto board = std::make_shared<Board>();
    std::vector<std::string> texts(2);
    std::vector<std::int64_t> sums(2);
    runOn(board, 2, [&](const auto& communicator) {
        auto config = configOf(sceneFor(Loop::Declared));
        config.executor = std::make_shared<dfb::CallerExecutor>(); // its tasks run in poll()
        dfb::NetworkConfig options;
        options.peerTimeout = std::chrono::milliseconds(0);
        FrameBuffer<Blend> fb(communicator, config, options);
        const int rank = fb.rank();
        board->handlers.at(rank)->receive(1 - rank, board->pool->acquire(sizeof(MessageHeader) - 1));
        while (fb.poll()) {
        }
        texts[static_cast<std::size_t>(rank)] = outcomeOf(
            [&] { sums[static_cast<std::size_t>(rank)] = fb.allReduce({7}, FrameBuffer<Blend>::Reduce::Sum).at(0); });
    });
    INFO(joined(texts));
    CHECK(texts == std::vector<std::string>(2, "fine"));
    CHECK(sums == std::vector<std::int64_t>(2, 14));
}

TEST_CASE("Without a peerTimeout what is damaged during a reduction ends it, also after damage of before",
          "[messaging]")
{
    const auto board = std::make_shared<Board>();
    std::promise<void> noticed;
    std::atomic<bool> damages{false};
    const auto damage = [&board] {
        board->handlers.at(0)->receive(1, board->pool->acquire(sizeof(MessageHeader) - 1));
    };
    board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer&) {
        if (header.kind != MessageKind::ReduceUp || !damages)
            return Board::What::Pass;
        damage(); // the result of the damage
        return Board::What::Lose;
    };
    std::vector<std::string> texts(2);
    runOn(board, 2, [&](const auto& communicator) {
        auto config = configOf(sceneFor(Loop::Declared));
        config.executor = std::make_shared<dfb::CallerExecutor>(); // its tasks run in calls that wait
        dfb::NetworkConfig options;
        options.peerTimeout = std::chrono::milliseconds(0);
        FrameBuffer<Blend> fb(communicator, config, options);
        if (fb.rank() == 0) {
            damage();
            while (fb.poll()) {
            }
            damages = true;
            noticed.set_value();
        } else {
            noticed.get_future().wait_for(std::chrono::seconds(20));
        }
        texts[static_cast<std::size_t>(fb.rank())] =
            outcomeOf([&] { fb.allReduce({7}, FrameBuffer<Blend>::Reduce::Sum); });
    });
    INFO(joined(texts));
    for (const std::string& text : texts)
        CHECK(has(text, "TransportError: dfb: malformed message: noticed by rank 0, in a message from rank 1"));
}

TEST_CASE("What is damaged when a rank has given its part of a reduction counts for what comes after it", "[messaging]")
{
    const Scene s = sceneFor(Loop::Declared);
    const auto [texts, after] = undisturbed([&] {
        const auto board = std::make_shared<Board>();
        std::atomic<bool> done{false};
        const auto executor = std::make_shared<dfb::ThreadExecutor>(1); // of rank 1
        board->passed = [&](int from, int, const MessageHeader& header) {
            if (header.kind != MessageKind::ReduceUp || done.exchange(true))
                return; // else it is the part of rank 1, which is not waiting yet
            board->handlers.at(from)->receive(1 - from, board->pool->acquire(sizeof(MessageHeader) - 1));
            std::promise<void> noticed;
            executor->submit([&] { noticed.set_value(); }); // runs after the tasks submitted before
            noticed.get_future().wait();
        };
        std::vector<std::string> first(2), second(2);
        runOn(board, 2, [&](const auto& communicator) {
            auto config = configOf(s);
            if (communicator.inner.rank() == 1)
                config.executor = executor;
            FrameBuffer<Blend> fb(communicator, config);
            const auto rank = static_cast<std::size_t>(fb.rank());
            first[rank] = outcomeOf([&] { scene::renderLoop(fb, s, Loop::Declared); });
            second[rank] = outcomeOf([&] { scene::renderLoop(fb, s, Loop::Declared); });
        });
        return std::make_pair(first, second);
    });
    INFO(joined(texts) << joined(after));
    for (std::size_t rank = 0; rank < 2; ++rank) {
        CHECK(has(texts[rank], "FrameError: dfb: malformed message: noticed by rank 1"));
        CHECK(after[rank] == "fine");
    }
}

TEST_CASE("A rank that leaves is named also where another waits for it already", "[messaging]")
{
    const auto board = std::make_shared<Board>();
    std::promise<void> waits;
    board->inspect = [over = waits.get_future().share()](int, int, const MessageHeader& header, dfb::Buffer&) {
        if (header.kind == MessageKind::Leaving)
            over.wait_for(std::chrono::seconds(20));
        return Board::What::Pass;
    };
    board->passed = [&](int from, int, const MessageHeader& header) {
        if (from == 1 && header.kind == MessageKind::ReduceUp && header.number == 1) // rank 1 is in allReduce()
            waits.set_value();
    };
    std::string text;
    runOn(board, 2, [&](const auto& communicator) { // call 1 is the constructor
        std::optional<FrameBuffer<Blend>> fb(std::in_place, communicator, configOf(sceneFor(Loop::Declared)));
        if (fb->rank() == 1)
            text = outcomeOf([&] { fb->allReduce({1}, dfb::Reduce::Sum); });
    });
    INFO(text);
    CHECK(has(text, "rank 0: it has destroyed its framebuffer, compositor or wall after frame 0"));
    CHECK(has(text, "rank 1 is in collective call 2"));
}

TEST_CASE("A reduction that no rank can be at is malformed, and nobody waits for it", "[messaging]")
{
    // A message of the constructor's reduction, which is number 0, gets the number of another reduction.
    for (const std::int64_t number : {-1, 1, 1000000}) {
        const auto board = std::make_shared<Board>();
        std::atomic<bool> done{false};
        board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer& message) {
            if (header.kind == MessageKind::ReduceUp && !done.exchange(true))
                std::memcpy(message.data() + offsetof(MessageHeader, number), &number, sizeof number);
            return Board::What::Pass;
        };
        std::vector<std::string> texts(2);
        runOn(board, 2, [&](const auto& communicator) {
            texts[static_cast<std::size_t>(communicator.inner.rank())] =
                outcomeOf([&] { FrameBuffer<Blend> fb(communicator, configOf(sceneFor(Loop::Declared))); });
        });
        INFO(number << joined(texts));
        for (const std::string& text : texts)
            CHECK(has(text, "TransportError: dfb: malformed message"));
    }
}

namespace {

// An owner that has no memory for any message.
class NoMemory final : private dfb::detail::MailboxOwner {
public:
    explicit NoMemory(const std::shared_ptr<dfb::Connection>& connection)
        : mailbox_(connection, std::make_shared<dfb::ThreadExecutor>(1), std::size_t{1} << 20, *this)
    {
        mailbox_.start();
    }
    ~NoMemory() { mailbox_.stop(); }

    dfb::detail::Mailbox& mailbox() { return mailbox_; }

private:
    void incoming(int, const MessageHeader&, dfb::Buffer&&) override { throw std::bad_alloc(); }
    void undecodable(const dfb::ErrorInfo&) override {}

    dfb::detail::Mailbox mailbox_;
};

} // namespace

TEST_CASE("Where there is no memory for a message, the connection fails on all ranks", "[messaging]")
{
    std::vector<std::string> texts(2);
    runOn(std::make_shared<Board>(), 2, [&](const auto& communicator) {
        const auto connection = dfb::connect<BoardTransport>(communicator);
        NoMemory object(connection);
        if (connection->rank() == 0)
            object.mailbox().send(1, MessageKind::TilesDone, 0);
        texts[static_cast<std::size_t>(connection->rank())] =
            outcomeOf([&] { object.mailbox().wait([] { return false; }); });
    });
    INFO(joined(texts));
    for (const std::string& text : texts)
        CHECK(has(text, std::bad_alloc().what()));
}

TEST_CASE("A thread that waits returns also if another thread takes what has come", "[messaging]")
{
    for (const auto progress : {dfb::Progress::Thread, dfb::Progress::Caller}) {
        bool hasCome = false;
        runOn(std::make_shared<Board>(), 1, [&](const auto& communicator) {
            dfb::NetworkConfig options;
            options.progress = progress;
            NoMemory object(dfb::connect<BoardTransport>(communicator, options));
            bool isThere = true; // when it looks for the first time
            const auto limit = dfb::detail::Mailbox::Clock::now() + std::chrono::seconds(1);
            hasCome = object.mailbox().wait([&] { return std::exchange(isThere, false); }, limit);
        });
        CHECK(hasCome);
    }
}

TEST_CASE("A reduction's result is malformed where nothing was given to it", "[messaging]")
{
    dfb::ReductionTable leaf(1, 2, [](int, const dfb::ReductionKey&, bool, const dfb::detail::SmallBytes&) {});
    CHECK_THROWS_AS(leaf.receive(0, {2, 1}, false, {}), dfb::Error);
}

namespace {

// A transport in which rank 1 sends an input right after its part of the constructor's reduction.
class Hasty : public Forward<dfb::InprocTransport> {
public:
    using Communicator = dfb::InprocCommunicator;
    using Forward::Forward;

    void send(int to, dfb::Buffer&& message)
    {
        auto header = dfb::detail::loadAs<MessageHeader>(message.data());
        if (hasSentBoth_) { // that input had a sequence number of its own
            ++header.sequence;
            std::memcpy(message.data(), &header, sizeof header);
        }
        inner_.send(to, std::move(message));
        if (rank() != 1 || header.kind != MessageKind::ReduceUp || std::exchange(hasSentBoth_, true))
            return;
        header.kind = MessageKind::Fragment;
        header.number = 1;
        ++header.sequence;
        inner_.send(to, dfb::detail::makeMessage(*pool_, header));
        sentBoth().set_value();
    }
    static std::promise<void>& sentBoth()
    {
        static std::promise<void> promise;
        return promise;
    }

private:
    std::shared_ptr<dfb::MemoryPool> pool_ = dfb::MemoryPool::create(false);
    bool hasSentBoth_ = false;
};

} // namespace

TEST_CASE("What has come for a framebuffer that is refused is still in order when it ends", "[messaging]")
{
    std::vector<std::string> texts(2);
    dfb::runRanks(2, [&](dfb::InprocCommunicator communicator) {
        auto config = configOf(sceneFor(Loop::Declared));
        config.image.width += communicator.rank();
        config.executor = std::make_shared<dfb::CallerExecutor>(); // what it has not run waits for the end
        if (communicator.rank() == 0)
            Hasty::sentBoth().get_future().wait_for(std::chrono::seconds(20));
        texts[static_cast<std::size_t>(communicator.rank())] =
            outcomeOf([&] { dfb::DistributedFrameBuffer<Blend, dfb::NoPixelOp, Hasty> fb(communicator, config); });
    });
    INFO(joined(texts));
    for (const std::string& text : texts)
        CHECK(has(text, "InvalidArgument: dfb: invalid argument: width is "));
}

TEST_CASE("A damaged message that comes before its frame has begun fails that frame on every rank", "[messaging]")
{
    // The message comes when its receiver has left the frame before, or when it has voted there and waits for the
    // verdict.
    for (const bool left : {true, false}) {
        const auto board = std::make_shared<Board>();
        std::promise<void> came, isOut;
        std::atomic<bool> done{false}, said{false};
        board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer& message) {
            if (header.kind == MessageKind::Fragment && header.number == 2 && !done.exchange(true))
                message.data()[0] ^= std::byte{1}; // this is no longer a message of dfb
            const bool isVerdict = header.kind == MessageKind::ReduceDown && header.number == 1
                                   && dfb::detail::loadAs<std::uint32_t>(message.data() + sizeof header) == 2;
            return isVerdict && !left ? Board::What::Hold : Board::What::Pass;
        };
        board->passed = [&](int, int, const MessageHeader& header) {
            if (header.kind != MessageKind::Fragment || header.number != 2 || said.exchange(true))
                return;
            came.set_value();
            board->release();
        };
        std::vector<std::string> texts(2);
        std::size_t wrong = 1;
        runOn(board, 2, [&](const auto& communicator) {
            const Scene s = sceneFor(Loop::Listing3);
            auto config = configOf(s);
            config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 1; };
            FrameBuffer<Blend> fb(communicator, config);
            scene::renderLoop(fb, s, Loop::Listing3);
            if (fb.rank() == 1)
                isOut.set_value();
            else if (left)
                isOut.get_future().wait_for(std::chrono::seconds(20));
            if (fb.rank() == 1)
                came.get_future().wait_for(std::chrono::seconds(20));
            texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] { scene::renderLoop(fb, s, Loop::Listing3); });
            const auto report = scene::renderLoop(fb, s, Loop::Listing3);
            if (fb.isDisplayRank())
                wrong = scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
        });
        INFO((left ? "after the frame before" : "within the frame before") << joined(texts));
        CHECK(has(texts[0], "FrameError: dfb: malformed message: noticed by rank 1, in a message from rank 0"));
        CHECK(has(texts[0], "from rank 0"));
        CHECK(texts[0] == texts[1]);
        CHECK(wrong == 0);
    }
}

TEST_CASE("Ranks that disagree about checksums learn which rank has them, and none waits", "[messaging]")
{
    for (const int ranks : {2, 4})
        for (int odd = 0; odd < ranks; ++odd)
            for (const bool uses : {false, true}) {
                std::vector<std::string> texts(static_cast<std::size_t>(ranks));
                runOn(
                    std::make_shared<Board>(), ranks,
                    [&](const BoardTransport::Communicator& communicator) {
                        dfb::NetworkConfig options;
                        options.checksums = (communicator.inner.rank() == odd) == uses;
                        texts[static_cast<std::size_t>(communicator.inner.rank())] = outcomeOf(
                            [&] { FrameBuffer<Blend> fb(communicator, configOf(sceneFor(Loop::Declared)), options); });
                    },
                    std::nullopt, std::chrono::seconds(20));
                INFO("rank " << odd << " of " << ranks << (uses ? " uses them" : " uses none") << joined(texts));
                for (const std::string& text : texts) {
                    CHECK(has(text, "InvalidArgument: dfb: invalid argument: checksums is "));
                    CHECK(has(text, std::string(uses ? "true" : "false") + " on rank " + std::to_string(odd)));
                }
                if (has(texts[0], "time limit"))
                    return; // once is enough
            }
}

// ---- gathering

TEST_CASE("The image is right after frames that failed when most of their tiles had been finished", "[messaging]")
{
    for (const Loop loop : {Loop::Listing3, Loop::Declared}) {
        std::vector<std::size_t> wrong;
        std::vector<std::string> failures;
        runOn(std::make_shared<Board>(), 4, [&](const auto& communicator) {
            const Scene s = sceneFor(loop, 8);
            auto config = configOf(s, 2);
            config.image.displayRank = 1;
            FrameBuffer<Blend> fb(communicator, config);
            for (int i = 0; i < 6; ++i) {
                if (i % 2 == 1) {
                    // When the frame fails, most tiles are finished and in a message.
                    const std::string text = outcomeOf([&] {
                        auto frame = fb.begin();
                        const auto tile = std::make_unique<FrameBuffer<Blend>::Tile>();
                        for (std::size_t k = 0; k < fb.ownedTiles().size(); ++k) {
                            if (fb.rank() == i / 2 && k + 1 == fb.ownedTiles().size()) {
                                frame.abort(std::make_exception_ptr(std::runtime_error("enough")));
                                break;
                            }
                            frame.start(*tile, fb.ownedTiles()[k]);
                            const float colour[4] = {9, 9, 9, 1};
                            tile->fill(colour, 0.0f);
                            frame.setTile(*tile);
                        }
                        frame.end();
                    });
                    if (fb.isDisplayRank())
                        failures.push_back(text);
                    continue;
                }
                Scene round = s;
                round.background[1] = static_cast<float>(i);
                const auto report = scene::renderLoop(fb, round, loop);
                if (fb.isDisplayRank())
                    wrong.push_back(scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(round)));
            }
        });
        CHECK(wrong == std::vector<std::size_t>(3));
        CHECK(failures.size() == 3);
        for (const std::string& text : failures)
            CHECK(has(text, "enough"));
    }
}

TEST_CASE("Finished tiles leave for the display rank while their owner still renders", "[messaging]")
{
    const auto board = std::make_shared<Board>();
    std::atomic<int> batches{0}, batchesThen{-1};
    std::promise<void> first;
    std::atomic<bool> seen{false};
    board->passed = [&](int, int, const MessageHeader& header) {
        if (header.kind != MessageKind::FinishedTiles)
            return;
        ++batches;
        if (!seen.exchange(true))
            first.set_value();
    };
    std::size_t wrong = 1;
    runOn(board, 2, [&](const auto& communicator) {
        auto config = floodConfig(512, std::make_shared<dfb::ThreadExecutor>(1)); // 16 tiles a batch
        config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 1; };
        AddingFrameBuffer fb(communicator, config);
        auto frame = fb.begin();
        const auto tile = std::make_unique<AddingFrameBuffer::Tile>();
        for (std::size_t k = 0; k < fb.ownedTiles().size(); ++k) {
            if (k + 1 == fb.ownedTiles().size()) {
                first.get_future().wait_for(std::chrono::seconds(20));
                batchesThen = batches.load();
            }
            frame.start(*tile, fb.ownedTiles()[k]);
            fillTile(*tile, 0, 0);
            frame.setTile(*tile);
        }
        frame.end();
        if (fb.isDisplayRank())
            wrong = wrongSums(fb.image(), 1, 1);
    });
    CHECK(wrong == 0);
    CHECK(batchesThen > 0);
    CHECK(batches >= 16);
}

// ---- progress by the caller

namespace {

// An operation that counts its inputs, on all ranks together.
std::atomic<int> inputsAdded{0};
struct Counter : dfb::BasicAlphaBlend<16> {
    void add(dfb::Fragment&& fragment)
    {
        BasicAlphaBlend::add(std::move(fragment));
        ++inputsAdded;
    }
};

} // namespace

TEST_CASE("With progress by the caller messages move in poll() and setTile(), and not without", "[messaging]")
{
    for (const std::uint64_t seed : {1u, 2u, 3u}) {
        const bool polls = seed != 3;
        std::promise<void> begun, sent;
        int before = -1, after = -1;
        bool moved = false;
        std::vector<std::size_t> wrong;
        inputsAdded = 0;
        const Scene s = sceneFor(Loop::Listing3);
        runOn(
            std::make_shared<Board>(), 2,
            [&](const BoardTransport::Communicator& communicator) {
                auto config = configOf(s);
                config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
                dfb::NetworkConfig options;
                options.progress = dfb::Progress::Caller;
                FrameBuffer<Counter> fb(communicator, config, options);
                {
                    auto frame = fb.begin(scene::paramsOf(s));
                    const auto tile = std::make_unique<FrameBuffer<Counter>::Tile>();
                    if (fb.rank() == 1) { // after rank 0's begin(), which moves messages
                        begun.get_future().wait_for(std::chrono::seconds(20));
                        for (const dfb::Brick& brick : s.bricks)
                            for (int index = 0; index < 28; ++index)
                                scene::sendInput(frame, *tile, s, brick, index);
                        sent.set_value();
                    } else {
                        begun.set_value();
                        sent.get_future().wait_for(std::chrono::seconds(20));
                        std::promise<void> tasksDone; // the one worker does them in order
                        fb.executor().submit([&] { tasksDone.set_value(); });
                        tasksDone.get_future().wait();
                        before = inputsAdded;
                        using Clock = std::chrono::steady_clock;
                        const auto limit = Clock::now() + std::chrono::seconds(20);
                        while (polls && inputsAdded < 28 * 6 && Clock::now() < limit)
                            moved = fb.poll() || moved;
                        if (polls)
                            after = inputsAdded;
                        for (int index : fb.ownedTiles()) {
                            const auto last = Clock::now();
                            scene::sendParent(frame, *tile, index, 6);
                            while (!polls && Clock::now() < last + std::chrono::milliseconds(2)) // it renders
                                std::this_thread::yield();
                        }
                        if (!polls) {
                            std::promise<void> allDone;
                            fb.executor().submit([&] { allDone.set_value(); });
                            allDone.get_future().wait();
                            after = inputsAdded;
                            moved = after > 28; // more than the inputs of this rank
                        }
                    }
                    const auto report = frame.end();
                    if (fb.isDisplayRank())
                        wrong.push_back(scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s)));
                }
                const auto report = scene::renderLoop(fb, s, Loop::Declared);
                if (fb.isDisplayRank())
                    wrong.push_back(scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s)));
            },
            seed);
        CHECK(before == 0);
        CHECK((after == 28 * 6 || !polls));
        CHECK(moved);
        CHECK(wrong == std::vector<std::size_t>(2));
    }
}

TEST_CASE("A thread that waits for room gives up only if nothing moves", "[messaging]")
{
    // Each credit of the receiver comes late, and some of the 16 threads are always faster than others.
    struct Outcome {
        std::vector<std::string> texts{2};
        int credits = 0;
        bool slow = true;
    };
    const auto runCase = [&] {
        Outcome o;
        const auto board = std::make_shared<Board>();
        std::atomic<bool> slow{true}, sent{false};
        std::atomic<int> credits{0};
        board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer&) {
            if (slow && header.kind == MessageKind::Credit) {
                std::this_thread::sleep_for(std::chrono::milliseconds(20)); // as a receiver that is busy
                slow = ++credits < 60;
            }
            return Board::What::Pass;
        };
        runOn(board, 2, [&](const auto& communicator) {
            auto config = configOf(scene::makeScene(0, 1, 2048, 1024));
            config.messages.poolBytes = 0;
            config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
            config.executor = std::make_shared<dfb::ThreadExecutor>(communicator.inner.rank() == 0 ? 1 : 16);
            dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<64>, dfb::NoPixelOp, BoardTransport> fb(communicator,
                                                                                                     config);
            dfb::FrameConfig params;
            params.timeout = std::chrono::milliseconds(1000);
            o.texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] {
                auto frame = fb.begin(params);
                frame.forEachTile(fb.rank() == 1 ? fb.layout().tileCount() : 0, [&](std::int64_t i, auto& tile) {
                    frame.start(tile, static_cast<int>(i));
                    tile.forEachPixel([](int x, int y, float* rgba, float& depth) { // not what a few bytes could say
                        rgba[0] = static_cast<float>((x + 64 * y) % 777) / 1000;
                        rgba[3] = 1;
                        depth = 1;
                    });
                    frame.setTile(tile);
                });
                sent = sent || fb.rank() == 1;
                while (!sent && !frame.failed()) // in end() the time-out runs even if messages move
                    std::this_thread::sleep_for(std::chrono::milliseconds(1));
                frame.end();
            });
        });
        o.credits = credits;
        o.slow = slow;
        return o;
    };
    const Outcome o = undisturbed(runCase);
    INFO(joined(o.texts) << ", " << o.credits << " credits");
    CHECK(o.texts == std::vector<std::string>(2, "fine"));
    CHECK_FALSE(o.slow);
}

namespace {

// A codec that gains nothing, and whose third call takes long: until `mayEnd`.
class SlowCodec final : public dfb::Codec {
public:
    std::uint8_t id() const noexcept override { return 200; }
    std::size_t bound(std::size_t byteCount) const override { return byteCount; }
    std::size_t compress(const std::byte*, std::size_t byteCount, std::byte*) const override
    {
        if (++calls_ == 3) {
            hasBegun.set_value();
            mayEnd.get_future().wait();
            // For the thread that is in end() to leave it, if it could.
            std::this_thread::sleep_for(std::chrono::milliseconds(50));
        }
        return byteCount;
    }
    bool decompress(const std::byte*, std::size_t, std::byte*, std::size_t) const override { return false; }

    mutable std::promise<void> hasBegun, mayEnd;

private:
    mutable std::atomic<int> calls_{0};
};

} // namespace

TEST_CASE("A rank that is about to send its last tiles of a partial frame stays in the frame", "[messaging]")
{
    // Rank 0 has finished nine tiles of 64 KiB; the last may not be in a message yet. Two messages with three tiles
    // each have left. There is no credit for the third, which is compressed when the frame has failed and all ranks
    // have voted.
    constexpr int tiles = 9;
    static std::atomic<int> finished{0};
    finished = 0;
    struct Count {
        void process(dfb::PixelTile&) const { ++finished; }
    };
    using Fb = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<64>, Count, BoardTransport>;
    const auto codec = std::make_shared<SlowCodec>();
    std::promise<void> hasVerdict, hasSent;
    std::atomic<bool> isDecided{false};
    const auto board = std::make_shared<Board>();
    board->passed = [&](int from, int, const MessageHeader& header) {
        if (from == 0 && header.kind == MessageKind::ReduceDown && header.number == 1 && !isDecided.exchange(true))
            hasVerdict.set_value(); // the frame's first reduction
        if (from == 0 && header.kind == MessageKind::TilesDone)
            hasSent.set_value();
    };
    std::vector<dfb::FrameReport> reports(2);
    runOn(board, 2, [&](const auto& communicator) {
        auto config = configOf(scene::makeScene(0, 1, 64 * (tiles + 1), 64));
        config.image.format = dfb::OutputFormat::RGBA32F;
        config.image.displayRank = 1;
        config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
        config.messages.poolBytes = 0;
        config.messages.codec = codec;
        config.messages.compression = dfb::CompressionMode::Always;
        config.executor = std::make_shared<dfb::ThreadExecutor>(2);
        Fb fb(communicator, config);
        dfb::FrameConfig params;
        params.allowPartial = true;
        params.timeout = std::chrono::milliseconds(3000);
        std::promise<void> mayReceive;
        const auto mayReceiveNow = mayReceive.get_future().share();
        for (int worker = 0; fb.rank() == 1 && worker < 2; ++worker)
            fb.executor().submit([=] { mayReceiveNow.wait(); });
        auto frame = fb.begin(params);
        if (fb.rank() == 0) {
            auto tile = std::make_unique<Fb::Tile>();
            for (int i = 0; i < tiles; ++i) {
                frame.start(*tile, i);
                for (std::size_t k = 0; k < 64 * 64; ++k) { // not constant, so that all of it is sent
                    tile->color[4 * k] = static_cast<float>(k % 777) / 1000;
                    tile->color[4 * k + 1] = tile->color[4 * k + 3] = 1;
                }
                frame.setTile(*tile);
            }
            codec->hasBegun.get_future().wait();
        } else {
            while (finished < tiles)
                std::this_thread::yield();
            frame.cancel();
            hasVerdict.get_future().wait();
            codec->mayEnd.set_value();
            hasSent.get_future().wait();
            mayReceive.set_value();
        }
        reports[static_cast<std::size_t>(fb.rank())] = frame.end();
    });
    for (const dfb::FrameReport& report : reports)
        CHECK(report.tilesIncomplete <= 2); // the one that was never set, and perhaps the last
}

TEST_CASE("Finished tiles of a partial frame that wait for room still come", "[messaging]")
{
    // 64 tiles of 64 KiB, and a pool of four. The frame is cancelled when the tiles are finished. `senders`: number of
    // ranks whose inputs have asked for room before that, and are then dropped.
    constexpr int tiles = 64;
    const int senders = GENERATE(0, 22), inputs = 4;
    static std::atomic<int> finished{0};
    finished = 0;
    struct Count {
        void process(dfb::PixelTile&) const { ++finished; }
    };
    using Fb = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<64>, Count, BoardTransport>;
    dfb::FrameConfig params;
    params.allowPartial = true;
    params.timeout = std::chrono::milliseconds(20000);
    std::vector<dfb::FrameReport> reports(static_cast<std::size_t>(2 + senders));
    std::atomic<int> set{0}, haveHeard{0};
    runOn(std::make_shared<Board>(), 2 + senders, [&](const auto& communicator) {
        const auto waitFor = [](const auto& condition) {
            const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(20);
            while (!condition() && std::chrono::steady_clock::now() < limit)
                std::this_thread::sleep_for(std::chrono::milliseconds(1));
        };
        auto config = configOf(scene::makeScene(0, 1, 64 * (tiles + 1 + senders * inputs), 64));
        config.image.format = dfb::OutputFormat::RGBA32F;
        config.messages.poolBytes = 0;
        config.image.ownerMap = [=](int tile, const dfb::TileLayout&, int) {
            return tile < tiles || senders == 0 ? 1 : 0;
        };
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        Fb fb(communicator, config);
        const int rank = fb.rank();
        std::promise<void> mayReceive;
        if (rank == 0 && senders > 0) // its worker hands out credit
            fb.executor().submit([&] { mayReceive.get_future().wait(); });
        auto frame = fb.begin(params);
        auto tile = std::make_unique<Fb::Tile>();
        const int first = rank == 1 ? 0 : tiles + 1 + (rank - 2) * inputs;
        waitFor([&] { return rank != 1 || set == senders; });
        for (int i = 0; i < (rank == 0 ? 0 : rank == 1 ? tiles : inputs); ++i) {
            frame.start(*tile, first + i);
            for (std::size_t k = 0; k < 64 * 64; ++k) { // not constant, so that all of it is sent
                tile->color[4 * k] = static_cast<float>(k % 777) / 1000;
                tile->color[4 * k + 1] = tile->color[4 * k + 3] = 0.5f;
                tile->depth[k] = static_cast<float>(k);
            }
            frame.setTile(*tile);
        }
        if (rank > 1) {
            ++set;
            waitFor([&] { return frame.failed(); });
            ++haveHeard;
        }
        if (rank == 0) {
            waitFor([&] { return finished == tiles; });
            frame.cancel();
            waitFor([&] { return haveHeard == senders; });
            mayReceive.set_value();
        }
        reports[static_cast<std::size_t>(rank)] = frame.end();
        if (fb.isDisplayRank())
            for (int index = 0; index < tiles; ++index)
                if (fb.isComplete(index)
                    && fb.image().rgba32f()[4 * 64 * static_cast<std::size_t>(index) + 1]
                           < 0.5f) // the background shines through
                    finished = -1;
    });
    CHECK(finished == tiles);
    REQUIRE(reports[0].failure);
    CHECK(reports[0].failure->kind == dfb::ErrorKind::Cancelled);
    // One input, and those of `senders`, were never sent. One more may not have been passed on when the frame was
    // cancelled.
    const int never = 1 + senders * inputs;
    CHECK(reports[0].tilesIncomplete >= never);
    CHECK(reports[0].tilesIncomplete <= never + 1);
    CHECK(reports[1].tilesIncomplete == reports[0].tilesIncomplete);
    CHECK(reports[0].compositingOverheadMs < 20000.0 / 2);
}

} // namespace messaging_cases
