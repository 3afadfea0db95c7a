// Display walls, and messages that are lost, repeated or invalid: every rank gets an error that says so, none waits for
// ever, and no display is wrong without an error. Ranks are threads.
#include "board.hpp"
#include "catch.hpp"
#include "random_scene.hpp"

#include <dfb/comm/mailbox.hpp>

#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstring>
#include <functional>
#include <future>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <vector>

namespace wall_safety_cases {

namespace {

using board::Board;
using board::BoardTransport;
using board::joined;
using dfb::detail::MessageHeader;
using dfb::detail::MessageKind;
using scene::has;
using scene::outcomeOf;

using FrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::ToWall, BoardTransport>;
using What = Board::What;
constexpr std::size_t body = sizeof(MessageHeader), region = body + 4; // of a part of a display
constexpr std::uint32_t wallAddress = 0;                               // it is made first

template <class T>
void put(dfb::Buffer& message, std::size_t at, const T& value)
{
    REQUIRE(message.size() >= at + sizeof value);
    std::memcpy(message.data() + at, &value, sizeof value);
}

struct Outcome {
    bool done = false;
    std::vector<std::string> texts, after;                  // of both ranks, of the first frame and of the next
    std::vector<dfb::ErrorKind> kinds{2, dfb::ErrorKind{}}; // of the first
    std::size_t wrong = 0;                                  // pixels on the displays after frames that were fine
};

// Renders two frames on a wall of two displays, one on each of 2 ranks. `change` gets the first message of this kind
// from rank 1 to the wall of rank 0, and decides what happens to it. `timeoutMs` is for finish().
Outcome frames(MessageKind kind, int timeoutMs, const std::function<What(dfb::Buffer&)>& change)
{
    Outcome result;
    result.texts.resize(2);
    result.after.resize(2);
    const auto watched = std::make_shared<Board>();
    std::atomic<bool> armed{false}, done{false};
    watched->inspect = [&](int from, int, const MessageHeader& header, dfb::Buffer& message) {
        if (from != 1 || header.receiver != wallAddress || header.kind != kind || !armed)
            return What::Pass;
        const bool isReduction = kind == MessageKind::ReduceUp; // the one that finish() waits for
        if ((isReduction && dfb::detail::loadAs<std::uint32_t>(message.data() + body) != 0) || done.exchange(true))
            return What::Pass;
        return change(message);
    };
    std::atomic<std::size_t> wrong{0};
    board::runOn(
        watched, 2,
        [&](const BoardTransport::Communicator& communicator) {
            const auto connection = dfb::connect<BoardTransport>(communicator);
            dfb::WallLayout layout;
            layout.columns = 2;
            layout.displayWidth = 72, layout.displayHeight = 64;
            layout.ranks = {0, 1};
            const auto executor = std::make_shared<dfb::ThreadExecutor>(1);
            dfb::DisplayWall wall(connection, layout, dfb::OutputFormat::RGBA32F, executor);
            auto config = wall.frameBufferConfig();
            config.executor = executor;
            FrameBuffer fb(connection, config, {&wall});
            const auto rank = static_cast<std::size_t>(fb.rank());
            armed = true; // rank 1's constructors have sent their messages
            const auto frame = [&](float shade) {
                dfb::FrameConfig params;
                params.background = {shade, shade, shade, 1};
                const auto report = dfb::DataParallelLoop(fb, dfb::World())
                                        .render(
                                            scene::FlatCamera(), [](const dfb::Brick&, auto&) {}, params);
                try {
                    wall.finish(report.frame, std::chrono::milliseconds(shade == 0.5f ? timeoutMs : 0));
                } catch (const dfb::Error& e) {
                    if (shade == 0.5f)
                        result.kinds[rank] = e.info().kind;
                    throw;
                }
                const dfb::Image& image = wall.image(fb.rank());
                for (std::size_t i = 0; i < image.pixelCount(); ++i)
                    wrong += image.rgba32f()[4 * i] != shade;
            };
            result.texts[rank] = outcomeOf([&] { frame(0.5f); });
            const bool isShown = result.texts[rank] == "fine";
            wrong += wall.image(fb.rank()).empty() == isShown || wall.imageFrame() != (isShown ? 1 : -1);
            result.after[rank] = outcomeOf([&] { frame(0.25f); });
        },
        std::nullopt, std::chrono::seconds(20));
    result.done = done;
    result.wrong = wrong;
    return result;
}

const std::vector<std::string> fine{"fine", "fine"};

} // namespace

TEST_CASE("A part of a display that cannot be fails its frame on every rank, and the next is right", "[wall]")
{
    struct Lie {
        const char* name;
        std::function<void(dfb::Buffer&)> change;
        std::string part; // of the error
    };
    const auto moved = [](int x, int y) {
        return [=](dfb::Buffer& m) {
            auto r = dfb::detail::loadAs<dfb::Region>(m.data() + region);
            // Moves it to the place of another part of the same size.
            r.x0 += r.x0 < 32 ? x : -x, r.x1 = r.x0 + 16;
            r.y0 += r.y0 < 32 ? y : -y, r.y1 = r.y0 + 16;
            put(m, region, r);
        };
    };
    const std::vector<Lie> lies{
        {"over its neighbour", moved(16, 0), "overlaps another"},
        {"over the one below", moved(0, 16), "overlaps another"},
        {"over a corner", moved(1, 1), "overlaps another"},
        {"of a frame far ahead", [](dfb::Buffer& m) { put(m, offsetof(MessageHeader, number), std::int64_t{1000}); },
         "no rank can have begun"},
        {"of a display of another rank", [](dfb::Buffer& m) { put(m, body, 1); }, "does not drive"},
        {"too short", [](dfb::Buffer& m) { m.shrink(m.size() - 1); }, "wrong size"},
    };
    for (const Lie& lie : lies) {
        const Outcome o = frames(MessageKind::FinishedTiles, 0, [&](dfb::Buffer& m) {
            lie.change(m);
            return What::Pass;
        });
        INFO(lie.name << joined(o.texts) << "\n after it" << joined(o.after));
        CHECK(o.done);
        CHECK(o.texts[0] == o.texts[1]);
        CHECK(has(o.texts[0], lie.part));
        CHECK(has(o.texts[0], "in a message from rank "));
        CHECK(o.kinds == std::vector<dfb::ErrorKind>(2, dfb::ErrorKind::MalformedMessage));
        CHECK(o.after == fine);
        CHECK(o.wrong == 0);
    }
}

TEST_CASE("A wall does not wait for what cannot come: a message of a kind that it does not get", "[wall]")
{
    struct Lie {
        const char* name;
        MessageKind kind;
        std::function<void(dfb::Buffer&)> change;
    };
    const std::vector<Lie> lies{
        {"a part that claims to be an input", MessageKind::FinishedTiles,
         [](dfb::Buffer& m) { put(m, offsetof(MessageHeader, kind), MessageKind::Fragment); }},
        {"a reduction of another scope", MessageKind::ReduceUp, [](dfb::Buffer& m) { put(m, body, std::uint32_t{7}); }},
        {"a reduction that claims to be a request", MessageKind::ReduceUp,
         [](dfb::Buffer& m) { put(m, offsetof(MessageHeader, kind), MessageKind::CreditRequest); }},
    };
    for (const Lie& lie : lies) {
        const Outcome o = frames(lie.kind, 0, [&](dfb::Buffer& m) {
            lie.change(m);
            return What::Pass;
        });
        INFO(lie.name << joined(o.texts) << "\n after it" << joined(o.after));
        CHECK(o.done);
        for (const auto* texts : {&o.texts, &o.after})
            for (const std::string& text : *texts) {
                CHECK(has(text, "TransportError"));
                CHECK_FALSE(has(text, "time limit"));
            }
        CHECK(has(o.texts[0], "in a message from rank 1"));
    }
}

TEST_CASE("A part of a display that is lost is named with its display, one that comes twice is dropped", "[wall]")
{
    const Outcome lost = frames(MessageKind::FinishedTiles, 1000, [](dfb::Buffer&) { return What::Lose; });
    INFO(joined(lost.texts) << "\n after it" << joined(lost.after));
    CHECK(lost.done);
    CHECK(lost.texts[0] == lost.texts[1]);
    CHECK(has(lost.texts[0], "display 0 of rank 0 misses "));
    CHECK(lost.kinds == std::vector<dfb::ErrorKind>(2, dfb::ErrorKind::TimedOut));
    CHECK(lost.after == fine);
    CHECK(lost.wrong == 0);

    const Outcome twice = frames(MessageKind::FinishedTiles, 0, [](dfb::Buffer&) { return What::Twice; });
    INFO(joined(twice.texts) << "\n after it" << joined(twice.after));
    CHECK(twice.done);
    CHECK(twice.texts == fine);
    CHECK(twice.after == fine);
    CHECK(twice.wrong == 0);
}

TEST_CASE("The longest of all times is none that a wall's end of frame exceeds", "[wall]")
{
    std::vector<std::string> texts(2);
    board::runOn(std::make_shared<Board>(), 2, [&](const BoardTransport::Communicator& communicator) {
        const auto connection = dfb::connect<BoardTransport>(communicator);
        // With a CallerExecutor the wall's work is done in finish(), which therefore has to wait.
        dfb::DisplayWall wall(connection, {2, 1, 64, 64, 0, 0, {0, 1}}, dfb::OutputFormat::RGBA8,
                              std::make_shared<dfb::CallerExecutor>());
        FrameBuffer fb(connection, wall.frameBufferConfig(), {&wall});
        const auto report =
            dfb::DataParallelLoop(fb, dfb::World()).render(scene::FlatCamera(), [](const dfb::Brick&, auto&) {});
        texts[static_cast<std::size_t>(fb.rank())] =
            outcomeOf([&] { wall.finish(report.frame, std::chrono::milliseconds::max()); });
    });
    INFO(joined(texts));
    CHECK(texts == fine);
}

TEST_CASE("A frame that no rank can have begun is refused, and the wall goes on", "[wall]")
{
    std::vector<std::string> texts(2), after(2);
    board::runOn(std::make_shared<Board>(), 2, [&](const BoardTransport::Communicator& communicator) {
        const auto connection = dfb::connect<BoardTransport>(communicator);
        dfb::DisplayWall wall(connection, {2, 1, 64, 64, 0, 0, {0, 1}}, dfb::OutputFormat::RGBA8);
        FrameBuffer fb(connection, wall.frameBufferConfig(), {&wall});
        const auto rank = static_cast<std::size_t>(fb.rank());
        texts[rank] = outcomeOf([&] { wall.finish(1000); });
        after[rank] = outcomeOf([&] {
            const auto report =
                dfb::DataParallelLoop(fb, dfb::World()).render(scene::FlatCamera(), [](const dfb::Brick&, auto&) {});
            wall.finish(report.frame);
        });
    });
    INFO(joined(texts) << joined(after));
    CHECK(has(texts[0], "frame 1000, which no rank can have begun"));
    CHECK(has(texts[1], "frame 1000, which no rank can have begun"));
    CHECK(after == fine);
}

TEST_CASE("A frame that finish() has found complete is shown, even if parts of 16 later ones come meanwhile", "[wall]")
{
    const auto board = std::make_shared<Board>();
    std::promise<void> isComplete; // on rank 1, which then waits for rank 0
    board->inspect = [&](int from, int, const MessageHeader& header, dfb::Buffer& message) {
        if (from == 1 && header.receiver == wallAddress && header.kind == MessageKind::ReduceUp && header.number == 2
            && dfb::detail::loadAs<std::uint32_t>(message.data() + body) == dfb::detail::Mailbox::ownScope)
            isComplete.set_value();
        return What::Pass;
    };
    std::vector<std::string> texts(2);
    int red = -1;
    board::runOn(board, 2, [&](const BoardTransport::Communicator& communicator) {
        const auto connection = dfb::connect<BoardTransport>(communicator);
        dfb::DisplayWall wall(connection, {1, 1, 16, 16, 0, 0, {1}}, dfb::OutputFormat::RGBA8);
        FrameBuffer fb(connection, wall.frameBufferConfig(), {&wall});
        const dfb::World noBricks;
        auto renderUpTo = [&, number = 0](int last) mutable {
            while (number < last) {
                dfb::FrameConfig params;
                params.background = {static_cast<float>(++number) / 255, 0, 0, 1};
                dfb::DataParallelLoop(fb, noBricks)
                    .render(
                        scene::FlatCamera(), [](const dfb::Brick&, auto&) {}, params);
            }
        };
        const auto rank = static_cast<std::size_t>(fb.rank());
        texts[rank] = outcomeOf([&] {
            renderUpTo(1);
            wall.finish(1);
            renderUpTo(2);
            std::thread other; // for finish(): it waits for rank 0, which comes there later
            if (rank == 1) {
                other = std::thread([&] { texts[1] = outcomeOf([&] { wall.finish(2); }); });
                isComplete.get_future().wait();
            }
            renderUpTo(20);
            if (rank == 0)
                wall.finish(2);
            else
                other.join();
        });
        if (rank == 1)
            red = wall.image(0).rgba8()[0];
    });
    INFO(joined(texts));
    CHECK(texts == fine);
    CHECK(red == 2);
}

TEST_CASE("Ranks with different pools make no wall", "[wall]")
{
    std::vector<std::string> texts(2);
    board::runOn(std::make_shared<Board>(), 2, [&](const BoardTransport::Communicator& communicator) {
        const auto connection = dfb::connect<BoardTransport>(communicator);
        const auto rank = static_cast<std::size_t>(connection->rank());
        texts[rank] = outcomeOf([&] {
            dfb::DisplayWall(connection, {2, 1, 64, 64, 0, 0, {0, 1}}, dfb::OutputFormat::RGBA8, nullptr,
                             (std::size_t{64} << 20) << rank);
        });
    });
    INFO(joined(texts));
    for (const std::string& text : texts)
        CHECK((has(text, "InvalidArgument") && has(text, "poolBytes")));
}

TEST_CASE("Who ends a frame on a wall that another rank has left does not wait for that one", "[wall]")
{
    std::vector<std::string> texts(2);
    board::runOn(std::make_shared<Board>(), 2, [&](const BoardTransport::Communicator& communicator) {
        const auto connection = dfb::connect<BoardTransport>(communicator);
        auto wall = std::make_unique<dfb::DisplayWall>(connection, dfb::WallLayout{2, 1, 64, 64, 0, 0, {0, 1}},
                                                       dfb::OutputFormat::RGBA8);
        auto fb = std::make_unique<FrameBuffer>(connection, wall->frameBufferConfig(), dfb::ToWall{wall.get()});
        const auto rank = static_cast<std::size_t>(fb->rank());
        texts[rank] = outcomeOf([&] {
            auto frame = fb->begin();
            frame.cancel();
            frame.end();
        });
        if (rank == 1) {
            fb.reset();
            wall.reset();
        } else {
            texts[rank] = outcomeOf([&] { wall->finish(1); });
        }
    });
    INFO(joined(texts));
    CHECK(has(texts[1], "FrameError"));
    CHECK((has(texts[0], "TransportError") && has(texts[0], "rank 1") && has(texts[0], "destroyed")));
}

} // namespace wall_safety_cases
