// Credit: whatever the ranks send, the messages on the way to a rank and in its inbox stay within its message pool, and
// every frame ends. Ranks are threads; every test has a time limit.
#include "flood.hpp"
#include "board.hpp"
#include "catch.hpp"

#include <dfb/wire/fragment_message.hpp>

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
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace flood_cases {

namespace {

using board::Board;
using board::BoardTransport;
using board::joined;
using board::runOn;
using dfb::detail::MessageHeader;
using dfb::detail::MessageKind;
using flood::Adder;
using flood::executors;
using flood::fillTile;
using flood::floodConfig;
using flood::floodFrame;
using flood::From;
using flood::valueOf;
using flood::wrongSums;
using scene::configOf;
using scene::has;
using scene::Loop;
using scene::outcomeOf;
using scene::Picture;
using scene::Scene;

using AddingFrameBuffer = dfb::DistributedFrameBuffer<Adder, dfb::NoPixelOp, BoardTransport>;
template <class TileOp>
using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, BoardTransport>;
using Blend = dfb::BasicAlphaBlend<16>;

std::size_t blockBytes(std::size_t bytes) // as MemoryPool rounds up
{
    std::size_t block = 256;
    while (block < bytes)
        block = block + block / 2 >= bytes ? block + block / 2 : 2 * block;
    return block;
}

// Bytes of the message of a full tile of Adder.
constexpr std::size_t fullMessage = dfb::detail::fragmentPrefix + 16 * Adder::tileSize * Adder::tileSize;

Scene sceneFor(Loop loop, std::uint64_t seed = 1) { return scene::makeSceneFor(loop, 6, seed); }

} // namespace

TEST_CASE("All ranks flood one owner that has the smallest pool", "[messaging][flood]")
{
    for (const int ranks : {2, 4, 8})
        for (const auto& [name, makeExecutor] : executors())
            for (const From from : {From::Loop, From::Thread}) {
                INFO(ranks << " ranks, " << name << (from == From::Loop ? ", from a loop" : ", from a thread"));
                const int parts = 16 / ranks;
                std::size_t wrong = 1;
                std::vector<dfb::FrameReport> reports;
                std::size_t pool = 0;
                int threads = 0;
                runOn(std::make_shared<Board>(), ranks, [&, &make = makeExecutor](const auto& communicator) {
                    auto config = floodConfig(256, make());
                    config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
                    AddingFrameBuffer fb(communicator, config);
                    for (int i = 0; i < 2; ++i) {
                        const auto report = floodFrame(fb, parts, from);
                        if (fb.rank() == 0) {
                            wrong = wrongSums(fb.image(), ranks, parts);
                            reports.push_back(report);
                            pool = fb.config().messages.poolBytes;
                            threads = fb.executor().concurrency() + 1;
                        }
                    }
                });
                CHECK(wrong == 0);
                CHECK(pool == std::size_t{1} << 20); // 4 batches of finished tiles
                std::size_t otherMessages = 0;
                for (const dfb::FrameReport& r : reports) {
                    const std::int64_t inputs = 64 * parts * (ranks - 1);
                    CHECK(r.peakInboxBytes > 0);
                    CHECK(r.peakInboxBytes <= static_cast<std::int64_t>(pool));
                    CHECK(r.messagesSent > inputs);
                    CHECK(r.messagesSent < 4 * inputs); // requests and credits
                    otherMessages += static_cast<std::size_t>(r.messagesSent - inputs);
                }
                // The memory of a rank: a pool of inputs under way and one more for each thread that sets tiles, the
                // inputs that threads of the owner are just adding up, the small messages, the image. (In one process a
                // message stays in its sender's memory.)
                const std::size_t blocks = pool / fullMessage + 2 * static_cast<std::size_t>(threads);
                const std::size_t limit = blocks * blockBytes(fullMessage) + otherMessages * 256
                                          + blockBytes(256 * 256 * 16) + 64 * blockBytes(4096);
                REQUIRE(!reports.empty());
                INFO(reports.back().peakMemoryBytes << " bytes, limit " << limit);
                CHECK(reports.back().peakMemoryBytes <= static_cast<std::int64_t>(limit));
            }
}

TEST_CASE("Everybody floods everybody, with arrivals in order and shuffled", "[messaging][flood]")
{
    for (const int ranks : {2, 3, 8})
        for (const auto& [name, makeExecutor] : executors())
            for (const bool shuffle : {false, true}) {
                INFO(ranks << " ranks, " << name << (shuffle ? ", shuffled" : ""));
                std::size_t wrong = 1;
                dfb::FrameReport report;
                runOn(
                    std::make_shared<Board>(), ranks,
                    [&, &make = makeExecutor](const auto& communicator) {
                        AddingFrameBuffer fb(communicator, floodConfig(256, make()));
                        const auto r = floodFrame(fb, 3, From::Loop);
                        if (fb.isDisplayRank()) {
                            wrong = wrongSums(fb.image(), ranks, 3);
                            report = r;
                        }
                    },
                    shuffle ? std::optional<std::uint64_t>(ranks) : std::nullopt);
                CHECK(wrong == 0);
                CHECK(report.peakInboxBytes <= 1 << 20);
            }
}

TEST_CASE("A sender waits when a pool is under way; all workers of all ranks may wait at once", "[messaging][flood]")
{
    // No input arrives until every worker of every rank waits in setTile().
    for (const int ranks : {2, 4})
        for (const int workers : {1, 2}) {
            const std::int64_t fit = (1 << 20) / static_cast<std::int64_t>(fullMessage); // calls that need not wait
            const auto board = std::make_shared<Board>();
            std::atomic<bool> open{false};
            board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer&) {
                return header.kind == MessageKind::Fragment && !open ? Board::What::Hold : Board::What::Pass;
            };
            std::mutex mutex;
            std::condition_variable changed;
            std::vector<std::int64_t> begun(static_cast<std::size_t>(ranks)), done(begun), begunThen, doneThen;
            std::thread referee([&] {
                std::unique_lock<std::mutex> lock(mutex);
                changed.wait_for(lock, std::chrono::seconds(20), [&] {
                    bool all = true;
                    for (std::size_t rank = 0; rank < begun.size(); ++rank)
                        all = all && begun[rank] > fit && begun[rank] == done[rank] + workers;
                    return all;
                });
                begunThen = begun;
                doneThen = done;
                lock.unlock();
                open = true;
                board->release();
            });
            std::size_t wrong = 1;
            runOn(board, ranks, [&](const auto& communicator) {
                AddingFrameBuffer fb(communicator, floodConfig(256, std::make_shared<dfb::ThreadExecutor>(workers)));
                const auto rank = static_cast<std::size_t>(fb.rank());
                floodFrame(fb, 4, From::Loop, [&](int tile, const auto& send) {
                    if (fb.tileOwner(tile) == fb.rank()) {
                        send();
                        return;
                    }
                    const auto count = [&](auto& counts) {
                        const std::lock_guard<std::mutex> lock(mutex);
                        ++counts[rank];
                        changed.notify_all();
                    };
                    count(begun);
                    send();
                    count(done);
                });
                if (fb.isDisplayRank())
                    wrong = wrongSums(fb.image(), ranks, 4);
            });
            referee.join();
            INFO(ranks << " ranks, " << workers << " workers");
            for (std::size_t rank = 0; rank < begunThen.size(); ++rank) {
                CHECK(begunThen[rank] > fit);
                CHECK(begunThen[rank] == doneThen[rank] + workers);
                CHECK(doneThen[rank] <= fit);
            }
            CHECK(wrong == 0);
        }
}

TEST_CASE("An owner that takes nothing out of its inbox is sent no more than its pool", "[messaging][flood]")
{
    for (const int ranks : {2, 5}) {
        const auto board = std::make_shared<Board>();
        std::mutex mutex;
        std::condition_variable changed;
        std::size_t inputBytes = 0, bytesThen = 0;
        std::vector<bool> blocked(static_cast<std::size_t>(ranks));
        bool watching = true;
        board->inspect = [&](int, int to, const MessageHeader& header, dfb::Buffer& message) {
            const std::lock_guard<std::mutex> lock(mutex);
            if (to == 0 && header.kind == MessageKind::Fragment && watching)
                inputBytes += message.size();
            return Board::What::Pass;
        };
        std::size_t wrong = 1;
        runOn(board, ranks, [&](const auto& communicator) {
            auto config = floodConfig(256, std::make_shared<dfb::ThreadExecutor>(1));
            config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
            AddingFrameBuffer fb(communicator, config);
            // Rank 0's only worker and its main thread are busy with something else until every other rank has set more
            // than a pool's worth.
            const auto allBlocked = [&] {
                std::unique_lock<std::mutex> lock(mutex);
                changed.wait_for(lock, std::chrono::seconds(20),
                                 [&] { return std::count(blocked.begin(), blocked.end(), true) == ranks - 1; });
                if (watching)
                    bytesThen = inputBytes;
                watching = false;
            };
            if (fb.rank() == 0)
                fb.executor().submit(allBlocked);
            std::int64_t begun = 0;
            if (fb.rank() > 0) {
                floodFrame(fb, 2, From::Thread, [&](int, const auto& send) {
                    if (++begun > (1 << 20) / static_cast<std::int64_t>(fullMessage)) {
                        const std::lock_guard<std::mutex> lock(mutex);
                        blocked[static_cast<std::size_t>(fb.rank())] = true;
                        changed.notify_all();
                    }
                    send();
                });
            } else {
                dfb::FrameConfig params;
                params.declared = true;
                auto frame = fb.begin(params);
                frame.declare({});
                allBlocked();
                frame.end();
                const Picture p(fb.image(), {});
                int expected = 0;
                for (int rank = 1; rank < ranks; ++rank)
                    expected += valueOf(rank, 0, 9, 0, 0) + valueOf(rank, 1, 9, 0, 0);
                wrong = p.value(4 * 9) != static_cast<float>(expected);
            }
        });
        INFO(ranks << " ranks, " << bytesThen << " bytes");
        CHECK(bytesThen > 0);
        CHECK(bytesThen <= std::size_t{1} << 20);
        CHECK(wrong == 0);
    }
}

TEST_CASE("The display rank is flooded by finished tiles", "[messaging][flood]")
{
    for (const auto& [name, makeExecutor] : executors()) {
        INFO(name);
        std::vector<std::size_t> wrong;
        dfb::FrameReport report;
        std::size_t pool = 0;
        runOn(std::make_shared<Board>(), 5, [&, &make = makeExecutor](const auto& communicator) {
            auto config = floodConfig(800, make());
            config.image.displayRank = 3;
            // The display rank owns no tile, so 10 MB are sent to it.
            config.image.ownerMap = [](int tile, const dfb::TileLayout&, int) { return tile % 4 == 3 ? 4 : tile % 4; };
            AddingFrameBuffer fb(communicator, config);
            for (int i = 0; i < 2; ++i) {
                auto frame = fb.begin();
                fb.executor().parallelFor(fb.ownedTiles().size(), [&](std::size_t k) {
                    const auto tile = std::make_unique<AddingFrameBuffer::Tile>();
                    frame.start(*tile, fb.ownedTiles()[k]);
                    fillTile(*tile, 0, 0);
                    frame.setTile(*tile);
                });
                const auto r = frame.end();
                if (fb.isDisplayRank()) {
                    wrong.push_back(wrongSums(fb.image(), 1, 1));
                    report = r;
                    pool = fb.config().messages.poolBytes;
                }
            }
        });
        CHECK(wrong == std::vector<std::size_t>(2));
        CHECK(report.peakInboxBytes > 0);
        CHECK(report.peakInboxBytes <= static_cast<std::int64_t>(pool));
    }
}

TEST_CASE("A flood in a frame that fails: everybody gets the error, and the next frame is right", "[messaging][flood]")
{
    for (const int ranks : {2, 5})
        for (int culprit = 0; culprit < ranks; culprit += 2) {
            std::vector<std::string> texts(static_cast<std::size_t>(ranks));
            std::size_t wrong = 1;
            std::int64_t peakInbox = 0;
            runOn(std::make_shared<Board>(), ranks, [&](const auto& communicator) {
                auto config = floodConfig(256, std::make_shared<dfb::ThreadExecutor>(2));
                config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
                AddingFrameBuffer fb(communicator, config);
                for (int i = 0; i < 3; ++i) {
                    std::atomic<int> calls{0};
                    texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] {
                        auto frame = fb.begin();
                        fb.executor().parallelFor(64 * 4, [&](std::size_t k) {
                            if (fb.rank() == culprit && calls++ == 100)
                                frame.abort(std::make_exception_ptr(std::runtime_error("enough")));
                            const auto tile = std::make_unique<AddingFrameBuffer::Tile>();
                            frame.start(*tile, static_cast<int>(k % 64));
                            tile->generation = 1;
                            tile->source = static_cast<std::uint32_t>(fb.rank());
                            tile->part = static_cast<std::uint16_t>(k / 64);
                            fillTile(*tile, 0, 0);
                            frame.setTile(*tile);
                        });
                        frame.end();
                    });
                }
                floodFrame(fb, 2, From::Loop);
                if (fb.isDisplayRank())
                    wrong = wrongSums(fb.image(), ranks, 2);
                const auto report = floodFrame(fb, 2, From::Loop); // what was left of the failed ones is gone by now
                if (fb.isDisplayRank())
                    peakInbox = report.peakInboxBytes;
            });
            INFO("rank " << culprit << joined(texts));
            for (const std::string& text : texts)
                CHECK((text == texts[0] && has(text, "FrameError") && has(text, "enough")
                       && has(text, "rank " + std::to_string(culprit))));
            CHECK(wrong == 0);
            CHECK(peakInbox > 0);
            CHECK(peakInbox <= 1 << 20);
        }
}

TEST_CASE("What comes for a frame that is over does not take up room in the inbox", "[messaging]")
{
    const auto board = std::make_shared<Board>();
    board->inspect = [](int, int, const MessageHeader& header, dfb::Buffer&) {
        return header.kind == MessageKind::Fragment && header.number == 1 ? Board::What::Hold : Board::What::Pass;
    };
    std::vector<std::int64_t> peaks, late;
    std::promise<void> allSet;
    runOn(board, 2, [&](const auto& communicator) {
        auto config = floodConfig(256, std::make_shared<dfb::ThreadExecutor>(1));
        config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
        AddingFrameBuffer fb(communicator, config);
        const auto tile = std::make_unique<AddingFrameBuffer::Tile>();
        const auto sendOne = [&](AddingFrameBuffer::Frame& frame, int index) {
            frame.start(*tile, index);
            tile->generation = 1;
            fillTile(*tile, 0, 0);
            frame.setTile(*tile);
        };
        dfb::FrameConfig params;
        params.declared = true;
        {
            auto frame = fb.begin(params); // all ranks leave it without end()
            if (fb.rank() == 1)
                for (int index = 0; index < 30; ++index)
                    sendOne(frame, index);
            if (fb.rank() == 1)
                allSet.set_value();
            else
                allSet.get_future().wait_for(std::chrono::seconds(20));
        }
        fb.allReduce({0}, AddingFrameBuffer::Reduce::Sum);
        if (fb.rank() == 1)
            board->release();
        fb.allReduce({0}, AddingFrameBuffer::Reduce::Sum);
        std::promise<void> tasksDone; // the only worker runs tasks in order
        fb.executor().submit([&] { tasksDone.set_value(); });
        tasksDone.get_future().wait();
        for (int i = 0; i < 2; ++i) {
            auto frame = fb.begin(params);
            frame.declare(fb.rank() == 1 ? std::vector<dfb::TileInput>{{3, 1, 0}} : std::vector<dfb::TileInput>());
            if (fb.rank() == 1)
                sendOne(frame, 3);
            const auto report = frame.end();
            if (fb.rank() == 0) {
                peaks.push_back(report.peakInboxBytes);
                late.push_back(report.lateMessages);
            }
        }
    });
    // 30 inputs, and up to two messages that say that a rank has left.
    CHECK((late.size() == 2 && late[0] >= 30 && late[0] <= 32 && late[1] == 0));
    CHECK(peaks == std::vector<std::int64_t>(2, static_cast<std::int64_t>(fullMessage)));
}

TEST_CASE("A message pool below the largest message's fourfold is raised to it; a larger one stays", "[messaging]")
{
    const Scene s = sceneFor(Loop::Declared);
    std::vector<std::size_t> pools;
    for (const std::size_t bytes : {std::size_t{0}, std::size_t{1} << 20, std::size_t{1} << 21, std::size_t{64} << 20})
        runOn(std::make_shared<Board>(), 2, [&](const auto& communicator) {
            auto config = configOf(s);
            config.messages.poolBytes = bytes;
            FrameBuffer<Blend> fb(communicator, config);
            if (fb.rank() == 0)
                pools.push_back(fb.config().messages.poolBytes);
        });
    CHECK(pools
          == std::vector<std::size_t>{std::size_t{1} << 20, std::size_t{1} << 20, std::size_t{1} << 21,
                                      std::size_t{64} << 20});
    std::size_t large = 0;
    runOn(std::make_shared<Board>(), 1, [&](const auto& communicator) {
        auto config = configOf(s);
        config.messages.poolBytes = 1;
        FrameBuffer<dfb::BasicAlphaBlend<256>> fb(communicator, config);
        large = fb.config().messages.poolBytes;
    });
    CHECK(large == 4 * dfb::detail::largestFragment(256, 256, dfb::colorChannel | dfb::depthChannel));
}

TEST_CASE("A flood with progress by the caller: setTile() makes the progress that it waits for", "[messaging][flood]")
{
    for (const int ranks : {2, 4})
        for (const From from : {From::Thread, From::Loop})
            for (const bool toOne : {true, false}) {
                std::size_t wrong = 1;
                dfb::FrameReport report;
                runOn(
                    std::make_shared<Board>(), ranks,
                    [&](const auto& communicator) {
                        auto config = floodConfig(256, std::make_shared<dfb::ThreadExecutor>(2));
                        if (toOne)
                            config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
                        dfb::NetworkConfig options;
                        options.progress = dfb::Progress::Caller;
                        AddingFrameBuffer fb(communicator, config, options);
                        const auto r = floodFrame(fb, 3, from);
                        if (fb.isDisplayRank()) {
                            wrong = wrongSums(fb.image(), ranks, 3);
                            report = r;
                        }
                    },
                    5);
                INFO(ranks << " ranks" << (toOne ? ", to one" : "") << (from == From::Loop ? ", from a loop" : ""));
                CHECK(wrong == 0);
                CHECK(report.peakInboxBytes <= 1 << 20);
            }
}

TEST_CASE("Who has voted on a partial frame that was cancelled sends no more inputs", "[messaging][flood]")
{
    // The owner may have left the frame, and would give no credit for further inputs. No input arrives before the frame
    // is cancelled. A sender may use a quarter of the pool without asking, and half of it on request.
    constexpr int pool = 1 << 20, bytes = static_cast<int>(fullMessage);
    const auto board = std::make_shared<Board>();
    std::atomic<int> held{0};
    std::promise<void> noCreditLeft;
    std::atomic<int> sentLate{0};
    std::atomic<bool> voted{false};
    board->inspect = [&](int from, int, const MessageHeader& header, dfb::Buffer& message) {
        if (from == 2 && header.kind == MessageKind::ReduceUp && header.number == 1
            && dfb::detail::loadAs<std::uint32_t>(message.data() + sizeof header) == 2)
            voted = true;
        if (header.kind != MessageKind::Fragment)
            return Board::What::Pass;
        sentLate += voted;
        if (++held == pool / 4 * 3 / bytes)
            noCreditLeft.set_value();
        return Board::What::Hold;
    };
    board->passed = [&](int from, int to, const MessageHeader& header) {
        if (from == 2 && to == 1 && header.kind == MessageKind::Abort)
            board->release();
    };
    std::vector<std::string> texts(3);
    runOn(board, 3, [&](const auto& communicator) {
        auto config = floodConfig(256, std::make_shared<dfb::ThreadExecutor>(1));
        config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 1; };
        AddingFrameBuffer fb(communicator, config);
        dfb::FrameConfig params;
        params.declared = params.allowPartial = true;
        auto frame = fb.begin(params);
        std::vector<dfb::TileInput> inputs;
        for (int tile = 0; fb.rank() == 2 && tile < pool / bytes; ++tile) // so many need not wait in setTile()
            inputs.push_back({tile, 2, 0});
        frame.declare(inputs);
        const auto tile = std::make_unique<AddingFrameBuffer::Tile>();
        for (const dfb::TileInput& input : inputs) {
            frame.start(*tile, input.tile);
            tile->generation = 1;
            fillTile(*tile, 2, 0);
            frame.setTile(*tile);
        }
        if (fb.rank() == 2) {
            noCreditLeft.get_future().wait_for(std::chrono::seconds(20));
            frame.cancel();
        }
        texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] { frame.end(); });
    });
    CHECK(voted);
    CHECK(sentLate == 0);
    CHECK(texts == std::vector<std::string>(3, "fine"));
}

TEST_CASE("A frame fails for damaged credit, also if what waits for it never goes", "[messaging][flood]")
{
    const auto board = std::make_shared<Board>();
    std::atomic<bool> done{false};
    board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer& message) {
        if (header.kind != MessageKind::Credit || header.number != 1)
            return Board::What::Pass;
        if (done.exchange(true)) // the next credit would replace the damaged one
            return Board::What::Lose;
        message.data()[message.size() - 1] ^= std::byte{1};
        return Board::What::Pass;
    };
    std::vector<std::string> texts(2);
    std::size_t wrong = 1;
    runOn(
        board, 2,
        [&](const auto& communicator) {
            auto config = floodConfig(256, std::make_shared<dfb::ThreadExecutor>(1));
            config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
            dfb::NetworkConfig options;
            options.progress = dfb::Progress::Caller;
            options.checksums = true;
            options.peerTimeout = std::chrono::milliseconds(0);
            AddingFrameBuffer fb(communicator, config, options);
            texts[static_cast<std::size_t>(fb.rank())] = outcomeOf([&] { floodFrame(fb, 2, From::Thread); });
            floodFrame(fb, 2, From::Thread);
            if (fb.isDisplayRank())
                wrong = wrongSums(fb.image(), 2, 2);
        },
        5);
    INFO(joined(texts));
    for (const std::string& text : texts)
        CHECK(has(text, "FrameError: dfb: malformed message: noticed by rank 1"));
    CHECK(wrong == 0);
}

TEST_CASE("What an owner keeps of inputs is their active bytes, once for each frame in flight", "[messaging][flood]")
{
    // 16 tiles with 8 full inputs and one that comes after all others. The owner copies inputs to its own memory, as it
    // does with those of another node.
    using Fb = dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, BoardTransport>;
    constexpr int tiles = 16, parts = 8, side = dfb::AlphaBlend::tileSize, width = 4 * side;
    constexpr std::size_t active = std::size_t{20} * side * side;
    for (const int frames : {1, 2}) {
        const auto board = std::make_shared<Board>();
        std::atomic<int> arrived{0};
        std::promise<void> all;
        std::shared_ptr<dfb::MemoryPool> ownersPool;
        board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer& message) {
            if (header.kind == MessageKind::Fragment) {
                dfb::Buffer copy = ownersPool->acquire(message.size());
                std::memcpy(copy.data(), message.data(), message.size());
                message = std::move(copy);
            }
            return Board::What::Pass;
        };
        board->passed = [&](int, int, const MessageHeader& header) {
            if (header.kind == MessageKind::Fragment && ++arrived == frames * tiles * parts)
                all.set_value();
        };
        std::vector<dfb::FrameReport> reports(2);
        runOn(board, 2, [&](const auto& communicator) {
            dfb::FrameBufferConfig config;
            config.image.width = config.image.height = width;
            config.framesInFlight = frames;
            config.executor = std::make_shared<dfb::ThreadExecutor>(1);
            config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
            config.messages.poolBytes = std::size_t{1} << 30; // so large that it limits nothing here
            const auto connection = dfb::connect<BoardTransport>(communicator);
            if (connection->rank() == 0)
                ownersPool = connection->pool();
            Fb fb(connection, config);
            std::vector<typename Fb::Frame> open;
            const auto tile = std::make_unique<Fb::Tile>();
            const auto send = [&](auto& frame, int index, int generation, int children) {
                frame.start(*tile, index);
                tile->generation = generation;
                tile->children = children;
                frame.setTile(*tile);
            };
            for (int i = 0; i < frames; ++i) {
                open.push_back(fb.begin());
                for (int index = 0; index < tiles; ++index) {
                    if (fb.rank() == 0) {
                        send(open.back(), index, 0, parts + 1);
                        continue;
                    }
                    for (int part = 0; part < parts; ++part) {
                        open.back().start(*tile, index);
                        tile->generation = 1;
                        tile->part = static_cast<std::uint16_t>(part + 1);
                        tile->forEachPixel([&](int x, int y, float* rgba, float& depth) {
                            rgba[0] = static_cast<float>((31 * x + 17 * y) % 97) / 400;
                            rgba[3] = 0.25f;
                            depth = static_cast<float>(part * 100 + x + y);
                        });
                        open.back().setTile(*tile);
                    }
                }
            }
            if (fb.rank() == 0) {
                all.get_future().wait_for(std::chrono::seconds(20));
                for (auto& frame : open)
                    for (int index = 0; index < tiles; ++index)
                        send(frame, index, 1, 0);
            }
            for (auto& frame : open)
                reports[static_cast<std::size_t>(fb.rank())] = frame.end();
        });
        const auto inputs = static_cast<std::size_t>(frames * tiles * parts);
        const std::size_t images = static_cast<std::size_t>(frames) * blockBytes(std::size_t{4} * width * width);
        const std::size_t limit = inputs * blockBytes(dfb::detail::fragmentPrefix + active) + images
                                  + 4 * blockBytes(dfb::detail::fragmentPrefix + active) + (std::size_t{1} << 18);
        INFO(frames << " in flight: " << reports[0].peakMemoryBytes << " bytes, limit " << limit);
        CHECK(reports[0].peakMemoryBytes >= static_cast<std::int64_t>(inputs * active));
        CHECK(reports[0].peakMemoryBytes <= static_cast<std::int64_t>(limit));
    }
}

} // namespace flood_cases
