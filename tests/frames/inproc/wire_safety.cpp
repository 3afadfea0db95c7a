// Ranks that were built differently, and invalid messages: every rank gets an error that says so, and none waits for
// ever. (tests/fuzz checks that arbitrary bytes do no harm.) Ranks are threads.
#include "board.hpp"
#include "catch.hpp"
#include "random_scene.hpp"

#include <dfb/wire/fragment_message.hpp>

#include <atomic>
#include <cstdint>
#include <cstring>
#include <functional>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace wire_safety_cases {

namespace {

using board::allSame;
using board::Board;
using board::BoardTransport;
using board::joined;
using board::runOn;
using dfb::detail::FragmentHeader;
using dfb::detail::MessageHeader;
using dfb::detail::MessageKind;
using scene::configOf;
using scene::has;
using scene::Loop;
using scene::outcomeOf;
using scene::Picture;
using scene::Scene;

template <class TileOp>
using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, BoardTransport>;
using Blend = dfb::BasicAlphaBlend<16>;
constexpr std::size_t body = sizeof(MessageHeader);
enum : std::uint32_t { OwnScope, AllDeclared, FrameVerdict };

template <class T>
void put(dfb::Buffer& message, std::size_t at, const T& value)
{
    if (message.size() < at + sizeof value)
        throw std::logic_error("the message is too short for the test");
    std::memcpy(message.data() + at, &value, sizeof value);
}

// The errors of 4 ranks that make a framebuffer, rank 3 with another operation than the others.
template <class Odd>
std::vector<std::string> madeWith()
{
    std::vector<std::string> texts(4);
    runOn(std::make_shared<Board>(), 4, [&](const BoardTransport::Communicator& communicator) {
        const auto config = configOf(scene::makeScene(1));
        texts[static_cast<std::size_t>(communicator.inner.rank())] = outcomeOf([&] {
            if (communicator.inner.rank() == 3)
                FrameBuffer<Odd>(communicator, config);
            else
                FrameBuffer<Blend>(communicator, config);
        });
    });
    return texts;
}

} // namespace

TEST_CASE("Ranks that were built differently learn what differs, and which ranks", "[wire_safety]")
{
    struct Case {
        const char* name;
        std::vector<std::string> texts, parts;
    };
    const dfb::ChannelMask more = dfb::colorChannel | dfb::depthChannel | dfb::albedoChannel;
    const dfb::ChannelMask deep = dfb::colorChannel | dfb::depthChannel | dfb::farChannel;
    const std::vector<Case> cases{
        {"tile size", madeWith<dfb::BasicAlphaBlend<8>>(), {"the size of tiles is 16x16 on rank 2 and 8x8 on rank 3"}},
        {"channels",
         madeWith<dfb::BasicAlphaBlend<16, more>>(),
         {"the mask of channels is 3 on rank 2 and 11 on rank 3"}},
        {"channels that travel",
         madeWith<dfb::BasicAlphaBlend<16, deep>>(),
         {"the mask of channels is 3 on rank 2 and 131 on rank 3",
          "the mask of channels that travel is 3 on rank 2 and 131 on rank 3"}},
    };
    for (const Case& c : cases) {
        INFO(c.name << joined(c.texts));
        CHECK(allSame(c.texts));
        CHECK(has(c.texts[0], "InvalidArgument"));
        for (const std::string& part : c.parts)
            CHECK(has(c.texts[0], part));
        CHECK_FALSE(has(c.texts[0], "width")); // which is the same
    }
}

TEST_CASE("Small differences of a configuration are found as well", "[wire_safety]")
{
    std::vector<std::string> texts(3);
    runOn(std::make_shared<Board>(), 3, [&](const BoardTransport::Communicator& communicator) {
        auto config = configOf(scene::makeScene(1));
        config.minTransmittance = communicator.inner.rank() == 1 ? 1e-9f : 2e-9f;
        texts[static_cast<std::size_t>(communicator.inner.rank())] =
            outcomeOf([&] { FrameBuffer<Blend> fb(communicator, config); });
    });
    INFO(joined(texts));
    CHECK(allSame(texts));
    CHECK(has(texts[0], "minTransmittance is 2e-09 on rank 0 and 1e-09 on rank 1"));
}

TEST_CASE("A rank of another minor version is refused by all ranks, with both versions", "[wire_safety]")
{
    const std::string minor = std::to_string(DFB_VERSION_MAJOR) + '.' + std::to_string(DFB_VERSION_MINOR);
    const std::string setting = "the version of dfb=" + minor;
    const auto watched = std::make_shared<Board>();
    watched->inspect = [&](int from, int, const MessageHeader&, dfb::Buffer& message) {
        const std::string_view text(reinterpret_cast<const char*>(message.data()), message.size());
        if (const std::size_t at = text.find(setting); from == 3 && at != text.npos)
            put(message, at + setting.size() - 1, 'x');
        return Board::What::Pass;
    };
    std::vector<std::string> texts(4);
    runOn(watched, 4, [&](const BoardTransport::Communicator& communicator) {
        texts[static_cast<std::size_t>(communicator.inner.rank())] =
            outcomeOf([&] { FrameBuffer<Blend> fb(communicator, configOf(scene::makeScene(1))); });
    });
    INFO(joined(texts));
    CHECK(allSame(texts));
    CHECK(has(texts[0], "InvalidArgument"));
    CHECK(has(texts[0], "the version of dfb is " + minor + " on rank 2 and " + minor.substr(0, minor.size() - 1)
                            + "x on rank 3"));
}

TEST_CASE("A rank of another version or byte order is found when framebuffers are made", "[wire_safety]")
{
    for (const bool byteOrder : {false, true})
        for (int odd = 0; odd < 4; ++odd) {
            const auto watched = std::make_shared<Board>();
            watched->inspect = [&](int from, int to, const MessageHeader& header, dfb::Buffer& message) {
                // Changes the messages so that each side sees the other as different.
                if (byteOrder && (from == odd || to == odd))
                    put(message, 0, MessageHeader::magicSwapped);
                else if (from == odd || to == odd)
                    put(message, offsetof(MessageHeader, version),
                        static_cast<std::uint8_t>(header.version + (from == odd ? 1 : -1)));
                return Board::What::Pass;
            };
            std::vector<std::string> texts(4);
            runOn(watched, 4, [&](const BoardTransport::Communicator& communicator) {
                texts[static_cast<std::size_t>(communicator.inner.rank())] =
                    outcomeOf([&] { FrameBuffer<Blend> fb(communicator, configOf(scene::makeScene(1))); });
            });
            INFO("rank " << odd << joined(texts));
            for (const std::string& text : texts) {
                CHECK(has(text, "TransportError"));
                CHECK(has(text, byteOrder ? "another byte order" : "another version of dfb"));
                CHECK(has(text, "in a message from rank "));
            }
        }
}

namespace {

// The outcome of a frame of 3 ranks, and of the next one. In the first frame, the first message of a kind (and scope,
// if it belongs to a reduction) from one rank was changed.
struct Changed {
    bool done = false;
    std::vector<std::string> texts, after;
    std::size_t wrong = 0;
};

Changed changed(MessageKind kind, std::uint32_t scope, int sender, const std::function<void(dfb::Buffer&)>& change,
                std::optional<MessageKind> overtaken = std::nullopt)
{
    Changed result;
    result.texts.resize(3);
    result.after.resize(3);
    const auto watched = std::make_shared<Board>();
    std::atomic<bool> done{false};
    watched->inspect = [&](int from, int, const MessageHeader& header, dfb::Buffer& message) {
        const bool isReduction = header.kind == MessageKind::ReduceUp || header.kind == MessageKind::ReduceDown;
        if (from == sender && header.kind == kind
            && (!isReduction || dfb::detail::loadAs<std::uint32_t>(message.data() + body) == scope)
            && !done.exchange(true))
            change(message);
        return from == sender && overtaken == header.kind && !done ? Board::What::Hold : Board::What::Pass;
    };
    watched->passed = [&](int from, int, const MessageHeader& header) {
        if (from == sender && header.kind == kind && done)
            watched->release();
    };
    const Scene s = scene::makeScene(6);
    runOn(
        watched, 3,
        [&](const BoardTransport::Communicator& communicator) {
            // Two threads could handle what is overtaken first. Without workers one handles all, in their order.
            FrameBuffer<Blend> fb(communicator, configOf(s, overtaken ? 0 : 1));
            const auto frame = [&] {
                return outcomeOf([&] {
                    const auto report = scene::renderLoop(fb, s, Loop::Declared);
                    if (fb.isDisplayRank())
                        result.wrong += scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
                });
            };
            const auto rank = static_cast<std::size_t>(fb.rank());
            result.texts[rank] = frame();
            result.after[rank] = frame();
        },
        std::nullopt, std::chrono::seconds(20));
    result.done = done;
    return result;
}

} // namespace

TEST_CASE("A message that says what cannot be fails its frame on every rank, and the next is right", "[wire_safety]")
{
    struct Lie {
        const char* name;
        MessageKind kind;
        int sender;
        std::function<void(dfb::Buffer&)> change;
        std::string part;                       // of the error
        std::optional<MessageKind> overtaken{}; // those of this kind come after it
    };
    const dfb::TileLayout layout(97, 61, 16);
    // A tile that rank 1 does not own, as large as this one.
    const auto ofOther = [&](std::int32_t like) {
        const dfb::Region size = layout.region(like);
        std::int32_t tile = 0;
        while (dfb::latticeOwner(tile, layout, 3) == 1 || layout.region(tile).width() != size.width()
               || layout.region(tile).height() != size.height())
            ++tile;
        return tile;
    };
    std::int32_t owned = 0; // by rank 1
    for (int tile = 0; tile < layout.tileCount(); ++tile)
        owned += dfb::latticeOwner(tile, layout, 3) == 1;
    // Changes what a rank says of its finished tiles: how many there are, and in how many messages.
    const auto oneLess = [](dfb::Buffer& m) { put(m, body, dfb::detail::loadAs<std::int32_t>(m.data() + body) - 1); };
    const auto oneMessageLess = [](dfb::Buffer& m) {
        put(m, body + 4, dfb::detail::loadAs<std::int32_t>(m.data() + body + 4) - 1);
    };
    const auto oneMessageMore = [](dfb::Buffer& m) {
        put(m, body + 4, dfb::detail::loadAs<std::int32_t>(m.data() + body) + 1);
    };
    const std::vector<Lie> lies{
        {"an input of a frame far ahead", MessageKind::Fragment, 2,
         [](dfb::Buffer& m) { put(m, offsetof(MessageHeader, number), std::int64_t{1000}); }, "no rank can have begun"},
        {"an input for an object far ahead", MessageKind::Fragment, 2,
         [](dfb::Buffer& m) { put(m, offsetof(MessageHeader, receiver), std::uint32_t{5000}); }, "far from having"},
        {"an input with other channels", MessageKind::Fragment, 2,
         [](dfb::Buffer& m) {
             auto h = dfb::detail::loadAs<FragmentHeader>(m.data() + body);
             h.channels = dfb::colorChannel;
             h.shape = {};
             h.rawPayloadBytes = 0;
             put(m, body, h);
             m.shrink(dfb::detail::fragmentPrefix);
         },
         "other channels"},
        {"a manifest of another's tile", MessageKind::Manifest, 2,
         [](dfb::Buffer& m) { put(m, body, std::int32_t{-1}); }, "a tile of another owner"},
        {"a manifest cut short", MessageKind::Manifest, 2, [](dfb::Buffer& m) { m.shrink(m.size() - 1); }, "too short"},
        {"hidden inputs where everything counts", MessageKind::Manifest, 2,
         [](dfb::Buffer& m) {
             put(m, offsetof(MessageHeader, kind), MessageKind::Hidden);
             m.shrink(body + sizeof(dfb::detail::HidingWord));
         },
         "word of hidden inputs"},
        {"a lost tile in a frame that cannot be partial", MessageKind::Manifest, 2,
         [](dfb::Buffer& m) {
             put(m, offsetof(MessageHeader, kind), MessageKind::TileLost);
             m.shrink(body + sizeof(std::int32_t));
         },
         "a lost tile of another owner, or in a frame that cannot be partial"},
        {"a finished tile of another owner", MessageKind::FinishedTiles, 1,
         [&](dfb::Buffer& m) { put(m, body + 16, ofOther(dfb::detail::loadAs<std::int32_t>(m.data() + body + 16))); },
         "a finished tile of another owner"},
        {"a batch that is longer than it says", MessageKind::FinishedTiles, 1,
         [](dfb::Buffer& m) { put(m, body, std::uint64_t{16}); }, "a batch of tiles has the wrong size"},
        {"more finished tiles than there are", MessageKind::TilesDone, 1,
         [](dfb::Buffer& m) { put(m, body, std::int32_t{1000}); }, "a count of tiles that cannot be"},
        {"more finished tiles than the rank owns", MessageKind::TilesDone, 1,
         [=](dfb::Buffer& m) { put(m, body, owned + 1); }, "a count of tiles that cannot be"},
        {"fewer finished tiles than come", MessageKind::TilesDone, 1, oneLess, "more finished tiles than were counted"},
        {"fewer finished tiles than come after it", MessageKind::TilesDone, 1, oneLess,
         "more finished tiles than were counted", MessageKind::FinishedTiles},
        {"fewer messages of finished tiles than come", MessageKind::TilesDone, 1, oneMessageLess,
         "finished tiles than were counted"},
        {"fewer messages of finished tiles than come after it", MessageKind::TilesDone, 1, oneMessageLess,
         "fewer finished tiles than were counted", MessageKind::FinishedTiles},
        {"more messages than tiles", MessageKind::TilesDone, 1, oneMessageMore, "a count of tiles that cannot be"},
    };
    for (const Lie& lie : lies) {
        const Changed c = changed(lie.kind, 0, lie.sender, lie.change, lie.overtaken);
        INFO(lie.name << joined(c.texts) << "\n after it" << joined(c.after));
        CHECK(c.done);
        CHECK(allSame(c.texts));
        CHECK(has(c.texts[0], "FrameError: dfb: malformed message"));
        CHECK(has(c.texts[0], lie.part));
        CHECK(has(c.texts[0], "in a message from rank " + std::to_string(lie.sender)));
        CHECK(c.after == std::vector<std::string>(3, "fine"));
        CHECK(c.wrong == 0);
    }
}

TEST_CASE("A vote or a verdict that is none ends the connection, as there is no other", "[wire_safety]")
{
    struct Lie {
        const char* name;
        MessageKind kind;
        std::uint32_t scope;
        int sender;
        std::function<void(dfb::Buffer&)> change;
    };
    const auto shorter = [](dfb::Buffer& m) { m.shrink(m.size() - 1); };
    const std::vector<Lie> lies{
        {"a vote cut short", MessageKind::ReduceUp, FrameVerdict, 2, shorter},
        {"a vote that neither failed nor did not", MessageKind::ReduceUp, FrameVerdict, 1,
         [](dfb::Buffer& m) { put(m, body + 4, std::uint8_t{7}); }},
        {"a vote on something else", MessageKind::ReduceUp, FrameVerdict, 2,
         [](dfb::Buffer& m) { put(m, body, std::uint32_t{9}); }},
        {"all have declared, from below, as a result", MessageKind::ReduceUp, AllDeclared, 2,
         [](dfb::Buffer& m) { put(m, offsetof(MessageHeader, kind), MessageKind::ReduceDown); }},
        {"a verdict cut short", MessageKind::ReduceDown, FrameVerdict, 0, shorter},
    };
    for (const Lie& lie : lies) {
        const Changed c = changed(lie.kind, lie.scope, lie.sender, lie.change);
        INFO(lie.name << joined(c.texts) << "\n after it" << joined(c.after));
        CHECK(c.done);
        CHECK(c.wrong == 0);
        // A rank that already has the verdict gets the error in the next frame.
        for (std::size_t rank = 0; rank < 3; ++rank) {
            CHECK((has(c.texts[rank], "TransportError")
                   || (lie.kind == MessageKind::ReduceDown && c.texts[rank] == "fine")));
            CHECK(has(c.after[rank], "TransportError"));
        }
    }
}

namespace {

// The offset of a rank's own part in the message of a call: behind the scope, the lowest rank, and the call's name.
constexpr std::size_t ownPart(std::string_view call) { return body + 4 + 4 + sizeof(std::uint32_t) + call.size(); }

} // namespace

TEST_CASE("Bytes that are gathered wrongly are an error on every rank", "[wire_safety]")
{
    constexpr std::size_t first = ownPart("allGather()");
    for (const bool isRank : {false, true}) {
        std::atomic<bool> armed{false};
        const auto watched = std::make_shared<Board>();
        watched->inspect = [&](int from, int, const MessageHeader& header, dfb::Buffer& message) {
            if (from == 2 && header.kind == MessageKind::ReduceUp && armed.exchange(false)) {
                if (isRank)
                    put(message, first, std::int32_t{3});
                else
                    put(message, first + 4, ~std::uint64_t{0});
            }
            return Board::What::Pass;
        };
        std::vector<std::string> texts(3);
        runOn(watched, 3, [&](const BoardTransport::Communicator& communicator) {
            FrameBuffer<Blend> fb(communicator, configOf(scene::makeScene(1)));
            fb.allReduce({0}, FrameBuffer<Blend>::Reduce::Sum);
            if (fb.rank() == 2)
                armed = true;
            texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] { fb.allGather(std::vector<std::byte>(5)); });
            fb.allReduce({0}, FrameBuffer<Blend>::Reduce::Sum);
        });
        INFO(joined(texts));
        CHECK(allSame(texts));
        CHECK(has(texts[0], "malformed message"));
    }
}

TEST_CASE("Bricks that no rank can have are an error on every rank", "[wire_safety]")
{
    struct Lie {
        const char* name;
        std::function<void(dfb::Buffer&)> change;
        std::string part; // of the error
    };
    constexpr std::size_t record = 4 + 6 * 4, first = ownPart("SharedWorld()") + 4 + 8, second = first + record;
    const float infinity = std::numeric_limits<float>::infinity();
    const std::vector<Lie> lies{
        {"a bound that is NaN", [=](dfb::Buffer& m) { put(m, first + 4, std::numeric_limits<float>::quiet_NaN()); },
         "the bounds of brick 10 of rank 1 are not a box"},
        {"an infinite one", [=](dfb::Buffer& m) { put(m, second + 16, infinity); }, "brick 11 of rank 1 are not a box"},
        {"a box from its end to its beginning", [=](dfb::Buffer& m) { put(m, first + 4, 9.0f); }, "are not a box"},
        {"a brick twice", [=](dfb::Buffer& m) { std::memcpy(m.data() + second, m.data() + first, record); },
         "brick 10 comes twice from rank 1"},
        {"half a brick",
         [=](dfb::Buffer& m) {
             put(m, first - 8, std::uint64_t{record + 5});
             m.shrink(second + 5);
         },
         "the bricks of rank 1 have 33 bytes"},
    };
    for (const Lie& lie : lies) {
        std::atomic<bool> armed{false};
        const auto watched = std::make_shared<Board>();
        watched->inspect = [&](int from, int, const MessageHeader& header, dfb::Buffer& message) {
            if (from == 1 && header.kind == MessageKind::ReduceUp && armed.exchange(false))
                lie.change(message);
            return Board::What::Pass;
        };
        std::vector<std::string> texts(2);
        runOn(watched, 2, [&](const BoardTransport::Communicator& communicator) {
            FrameBuffer<Blend> fb(communicator, configOf(scene::makeScene(1)));
            dfb::World world;
            if (fb.rank() == 1) {
                armed = true;
                world.add({10, {{0, 0, 0}, {1, 1, 1}}});
                world.add({11, {{1, 0, 0}, {2, 1, 1}}});
            }
            texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] { dfb::SharedWorld(fb, world); });
        });
        INFO(lie.name << joined(texts));
        CHECK_FALSE(armed);
        CHECK(allSame(texts));
        CHECK(has(texts[0], "InvalidArgument"));
        CHECK(has(texts[0], lie.part));
    }
}

} // namespace wire_safety_cases
