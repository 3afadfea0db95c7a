// Credit, several framebuffers, repeated and damaged messages, time-outs and progress by the caller. Over MPI, on any
// number of ranks. Every frame that could hang has a time-out.
#include "catch.hpp"
#include "flood.hpp"
#include "forward.hpp"
#include "random_scene.hpp"
#include "ranks.hpp"

#include <dfb/wire/fragment_message.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstring>
#include <functional>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace messaging_cases {

namespace {

using dfb::detail::MessageHeader;
using dfb::detail::MessageKind;
using flood::Adder;
using flood::executors;
using flood::floodConfig;
using flood::floodFrame;
using flood::From;
using flood::wrongSums;
using scene::has;
using scene::Loop;
using scene::outcomeOf;
using scene::Picture;
using scene::Scene;

constexpr int longMs = 30000; // no frame takes so long

// Messages that are held back until a test releases them.
struct Held {
    std::mutex mutex;
    std::vector<std::function<void()>> sends;

    void release()
    {
        std::vector<std::function<void()>> all;
        {
            const std::lock_guard<std::mutex> lock(mutex);
            all.swap(sends);
        }
        for (const auto& send : all)
            send();
    }
};

// An MpiTransport that loses, repeats, holds back or changes messages on the sending side.
class TamperingTransport : public Forward<dfb::MpiTransport> {
public:
    enum class What { Pass, Lose, Twice, Hold };
    using Tamper = std::function<What(int to, const MessageHeader&, dfb::Buffer&)>; // from any thread
    struct Communicator {
        MPI_Comm communicator;
        Tamper tamper;
        std::shared_ptr<Held> held{};
    };

    TamperingTransport(const Communicator& c, std::shared_ptr<dfb::MemoryPool> pool, dfb::Progress progress)
        : Forward(c.communicator, std::move(pool), progress), tamper_(c.tamper), held_(c.held)
    {
    }
    void send(int to, dfb::Buffer&& message)
    {
        const What what =
            tamper_ ? tamper_(to, dfb::detail::loadAs<MessageHeader>(message.data()), message) : What::Pass;
        if (what == What::Lose) {
            const dfb::Buffer lost = std::move(message);
            return;
        }
        if (what == What::Hold) {
            const auto kept = std::make_shared<dfb::Buffer>(std::move(message));
            const std::lock_guard<std::mutex> lock(held_->mutex);
            held_->sends.push_back([this, to, kept] { inner_.send(to, std::move(*kept)); });
            return;
        }
        if (what == What::Twice) {
            dfb::Buffer copy = copies_->acquire(message.size());
            std::memcpy(copy.data(), message.data(), message.size());
            inner_.send(to, std::move(copy));
        }
        inner_.send(to, std::move(message));
    }

private:
    Tamper tamper_;
    std::shared_ptr<Held> held_;
    std::shared_ptr<dfb::MemoryPool> copies_ = dfb::MemoryPool::create();
};

using AddingFrameBuffer = dfb::DistributedFrameBuffer<Adder>;
using Blend = dfb::BasicAlphaBlend<16>;
template <class TileOp>
using TamperedFrameBuffer = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, TamperingTransport>;

Scene sceneFor(int bricks, std::uint64_t seed)
{
    Scene s = scene::makeScene(bricks, seed);
    s.timeout = std::chrono::milliseconds(longMs);
    return s;
}

// Renders a good frame and returns whether its image is right.
template <class Fb>
bool goodFrame(Fb& fb, const Scene& s, Loop loop = Loop::Declared)
{
    const auto report = scene::renderLoop(fb, s, loop);
    return !fb.isDisplayRank() || scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s)) == 0;
}

// Renders a good frame and returns "right", "wrong", or its error.
template <class Fb>
std::string outcomeOfGoodFrame(Fb& fb, const Scene& s)
{
    bool isRight = false;
    const std::string text = outcomeOf([&] { isRight = goodFrame(fb, s); });
    return text != "fine" ? text : isRight ? "right" : "wrong";
}

} // namespace

TEST_CASE("All ranks flood one owner that has the smallest pool", "[messaging]")
{
    const int ranks = sizeOf(MPI_COMM_WORLD), parts = 2;
    for (const flood::NamedExecutor& e : executors())
        for (const From from : {From::Loop, From::Thread}) {
            auto config = floodConfig(256, e.make());
            dfb::NetworkConfig options;
            options.sharedMemory = from == From::Loop;
            config.image.ownerMap = [](int, const dfb::TileLayout&, int size) { return size - 1; };
            config.image.displayRank = ranks - 1;
            AddingFrameBuffer fb(MPI_COMM_WORLD, config, options);
            dfb::FrameReport report;
            for (int i = 0; i < 2; ++i) {
                report = floodFrame(fb, parts, from, longMs);
                if (fb.isDisplayRank())
                    CHECK(wrongSums(fb.image(), ranks, parts) == 0);
                CHECK(report.peakInboxBytes <= static_cast<std::int64_t>(fb.config().messages.poolBytes));
                CHECK((report.peakInboxBytes > 0) == (ranks > 1));
            }
            // The memory of a rank: a pool in its inbox and on the way to it; a pool under way to others, and one
            // message more for each thread that sets tiles; what is just being added up; manifests and small messages;
            // the image. Blocks are up to 1.5 times as large as their contents.
            const std::size_t message = dfb::detail::fragmentPrefix + 16 * 32 * 32;
            const auto threads = static_cast<std::size_t>(fb.executor().concurrency()) + 1;
            const std::size_t limit =
                (2 * fb.config().messages.poolBytes + 2 * threads * message + 256 * 256 * 16) * 3 / 2
                + 256 * static_cast<std::size_t>(report.messagesSent) + static_cast<std::size_t>(ranks) * 8192;
            INFO(e.name << ": " << report.peakMemoryBytes << " bytes, limit " << limit);
            CHECK(report.peakMemoryBytes <= static_cast<std::int64_t>(limit));
        }
}

TEST_CASE("Everybody floods everybody, and the display rank is flooded by finished tiles", "[messaging]")
{
    const int ranks = sizeOf(MPI_COMM_WORLD);
    for (const flood::NamedExecutor& e : executors())
        for (const bool shared : {true, false})
            for (const auto progress : {dfb::Progress::Thread, dfb::Progress::Caller}) {
                auto config = floodConfig(384, e.make()); // 2.4 MB of finished tiles
                dfb::NetworkConfig options;
                options.progress = progress;
                options.sharedMemory = shared;
                AddingFrameBuffer fb(MPI_COMM_WORLD, config, options);
                const auto report = floodFrame(fb, 2, From::Loop, longMs);
                INFO(e.name);
                if (fb.isDisplayRank())
                    CHECK(wrongSums(fb.image(), ranks, 2) == 0);
                CHECK(report.peakInboxBytes <= static_cast<std::int64_t>(fb.config().messages.poolBytes));
            }
}

TEST_CASE("All through MPI gives the same image bit for bit", "[messaging]")
{
    const Scene s = sceneFor(7, 3);
    std::vector<std::uint64_t> hashes;
    for (const bool shared : {true, false}) {
        auto config = configOf(s);
        dfb::NetworkConfig options;
        options.sharedMemory = shared;
        dfb::DistributedFrameBuffer<Blend> fb(MPI_COMM_WORLD, config, options);
        for (int i = 0; i < 2; ++i) {
            const auto report = scene::renderLoop(fb, s, Loop::Declared);
            hashes.push_back(fb.isDisplayRank() ? Picture(fb.image(), report).hash() : 0);
        }
    }
    CHECK(std::count(hashes.begin(), hashes.end(), hashes.front()) == 4);
}

TEST_CASE("Two framebuffers on one connection, and one with its own, with frames open at once", "[messaging]")
{
    const Scene s = sceneFor(6, 4), t = sceneFor(5, 5);
    const auto connection = dfb::connect<dfb::MpiTransport>(MPI_COMM_WORLD);
    using Fb = dfb::DistributedFrameBuffer<Blend>;
    auto a = std::make_unique<Fb>(connection, configOf(s));
    auto b = std::make_unique<dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<32>>>(connection, configOf(t));
    auto c = std::make_unique<Fb>(MPI_COMM_WORLD, configOf(s));
    for (int i = 0; i < 3; ++i) {
        auto frame = a->begin(scene::paramsOf(s));
        const auto tile = std::make_unique<Fb::Tile>();
        for (int index : a->ownedTiles())
            scene::sendParent(frame, *tile, index, 6);
        CHECK(goodFrame(*b, t));
        {
            auto broken = c->begin(scene::paramsOf(s));
            if (c->rank() == c->size() - 1)
                broken.abort(std::make_exception_ptr(std::runtime_error("C broke")));
            const std::string text = outcomeOf([&] { broken.end(); });
            CHECK(has(text, "C broke"));
        }
        for (const dfb::Brick& brick : scene::bricksOf(s, a->rank(), a->size()))
            for (int index = 0; index < a->layout().tileCount(); ++index)
                scene::sendInput(frame, *tile, s, brick, index);
        const auto report = frame.end();
        if (a->isDisplayRank())
            CHECK(scene::wrongValues(Picture(a->image(), report), scene::referenceOf(s)) == 0);
        CHECK(goodFrame(*c, s, Loop::Listing3));
    }
    if (a->rank() % 2 == 0)
        a.reset(), b.reset();
    else
        b.reset(), a.reset();
}

// A rank that waits for room in `b` sends nothing for `a`, unless it moves the messages of both.
TEST_CASE("Two framebuffers with connections of their own, whose messages only waiting threads move", "[messaging]")
{
    using Fb = dfb::DistributedFrameBuffer<dfb::AlphaBlend>;
    dfb::FrameBufferConfig config(1024, 1024);
    config.messages.poolBytes = 1 << 20; // far less than a frame needs
    config.executor = std::make_shared<dfb::CallerExecutor>();
    dfb::NetworkConfig network;
    network.progress = dfb::Progress::Caller;
    Fb a(MPI_COMM_WORLD, config, network), b(MPI_COMM_WORLD, config, network);
    const auto z = static_cast<float>(-a.rank());
    const dfb::World world({{static_cast<std::uint32_t>(a.rank()), {{-1, -1, z}, {1, 1, z + 1}}}});
    const dfb::PerspectiveCamera camera({0, 0, 6}, {0, 0, 0}, {0, 1, 0}, 30);
    const auto draw = [](const dfb::Brick&, auto& tile) {
        tile.forEachPixel([](int x, int y, float* rgba, float& depth) {
            rgba[0] = 0.1f;
            rgba[3] = 0.3f + 1e-5f * static_cast<float>(x);
            depth = 1e-4f * static_cast<float>(y);
        });
    };
    dfb::FrameConfig params;
    params.timeout = std::chrono::seconds(20);
    dfb::DataParallelLoop loopA(a, world), loopB(b, world);
    for (int i = 0; i < 3; ++i) {
        auto frameA = loopA.start(camera, draw, params), frameB = loopB.start(camera, draw, params);
        CHECK(outcomeOf([&] { frameA.end(); }) == "fine");
        CHECK(outcomeOf([&] { frameB.end(); }) == "fine");
    }
    // A rank that waits in a constructor is needed by those that still wait for room.
    config.executor = std::make_shared<dfb::ThreadExecutor>(1);
    Fb c(MPI_COMM_WORLD, config, network);
    auto frame = dfb::DataParallelLoop(c, world).start(camera, draw, params);
    const Fb made(MPI_COMM_WORLD, config, network);
    CHECK(outcomeOf([&] { frame.end(); }) == "fine");
}

TEST_CASE("Messages that come twice are dropped and counted", "[messaging]")
{
    const Scene s = sceneFor(6, 6);
    const auto twice = [](int, const MessageHeader&, dfb::Buffer&) { return TamperingTransport::What::Twice; };
    TamperedFrameBuffer<Blend> fb({MPI_COMM_WORLD, twice}, configOf(s));
    for (int i = 0; i < 3; ++i) {
        const auto report = scene::renderLoop(fb, s, i == 1 ? Loop::Declared : Loop::Listing3);
        CHECK((report.repeatedMessages > 0) == (fb.size() > 1));
        CHECK(report.lateMessages == 0);
        if (fb.isDisplayRank())
            CHECK(scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s)) == 0);
    }
}

TEST_CASE("With checksums a changed byte is an error on every rank, and the next frame is right", "[messaging]")
{
    const Scene s = sceneFor(6, 7);
    Scene nothing = s; // shown first, so that the next frame's inputs have to be declared
    nothing.bricks.clear();
    for (const auto kind : {MessageKind::Fragment, MessageKind::Manifest, MessageKind::TilesDone})
        for (const int place : {9, 25, 70}) {
            std::atomic<bool> done{false};
            const auto damage = [&](int, const MessageHeader& header, dfb::Buffer& message) {
                // Damages one message of rank 1 in the second frame. In the first frame, its receiver may still be in
                // the constructor.
                if (header.kind == kind && header.number == 2 && rankIn(MPI_COMM_WORLD) == 1 && !done.exchange(true))
                    message.data()[std::min<std::size_t>(static_cast<std::size_t>(place), message.size() - 1)] ^=
                        std::byte{64};
                return TamperingTransport::What::Pass;
            };
            dfb::NetworkConfig options;
            options.checksums = true;
            TamperedFrameBuffer<Blend> fb({MPI_COMM_WORLD, damage}, configOf(s), options);
            CHECK(goodFrame(fb, nothing));
            bool right = true;
            const std::string text = outcomeOf([&] {
                Scene mine = s;
                // The time-out is long, as a message that comes after its frame has ended makes the next frame fail.
                mine.timeout = std::chrono::milliseconds(20000);
                right = goodFrame(fb, mine);
            });
            const bool same = sameEverywhere(text);
            INFO(static_cast<int>(kind) << ", byte " << place << ": " << text);
            CHECK(right);
            CHECK(same);
            if (fb.size() > 1)
                CHECK(has(text, "FrameError: dfb: malformed message"));
            else
                CHECK(text == "fine");
            CHECK(goodFrame(fb, s));
        }
}

TEST_CASE("Tiles of a cancelled frame that come in a later one are dropped and counted", "[messaging]")
{
    constexpr std::int64_t sent = 5;
    const Scene s = sceneFor(0, 12);
    const auto held = std::make_shared<Held>();
    const auto hold = [](int, const MessageHeader& header, dfb::Buffer&) {
        return header.kind == MessageKind::Fragment && header.number == 1 ? TamperingTransport::What::Hold
                                                                          : TamperingTransport::What::Pass;
    };
    auto config = configOf(s);
    config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
    TamperedFrameBuffer<Blend> fb({MPI_COMM_WORLD, hold, held}, config);
    const int last = fb.size() - 1;
    const auto sendTiles = [&](auto& frame, int count, float alpha) {
        const auto tile = std::make_unique<decltype(fb)::Tile>();
        for (int index = 0; index < count && fb.rank() == last; ++index) {
            frame.start(*tile, index);
            tile->pixel(0, 0)[3] = alpha;
            frame.setTile(*tile);
        }
    };
    const std::string text = outcomeOf([&] {
        auto frame = fb.begin(paramsOf(s));
        sendTiles(frame, sent, 0.5f);
        if (fb.rank() == last)
            frame.cancel();
        frame.end();
    });
    CHECK(has(text, "FrameError: dfb: frame cancelled: rank " + std::to_string(last)));
    fb.allReduce({0}, decltype(fb)::Reduce::Sum); // the frame is over on all
    // On a busy machine the last of them may be looked at only when the next frame's verdict is already under way.
    std::int64_t late = 0;
    std::size_t wrong = 0;
    const std::int64_t expected = fb.size() > 1 ? sent : 0;
    for (int i = 0; i < 2 || (late < expected && i < 500); ++i) {
        auto frame = fb.begin(paramsOf(s));
        held->release();
        sendTiles(frame, fb.layout().tileCount(), 0);
        const auto report = frame.end();
        late += report.lateMessages; // the same on all ranks
        if (fb.isDisplayRank())
            wrong += scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s));
    }
    CHECK(late == expected);
    CHECK(wrong == 0);
}

TEST_CASE("What is missing when the time is up is named on every rank, and the next frame is right", "[messaging]")
{
    const Scene s = sceneFor(6, 8);
    const int last = sizeOf(MPI_COMM_WORLD) - 1;
    const int owner = dfb::DistributedFrameBuffer<Blend>(MPI_COMM_WORLD, configOf(s)).tileOwner(5);
    dfb::FrameConfig params;
    // So much later than the others may a rank begin the frame: they give it up after twice this time.
    params.timeout = std::chrono::milliseconds(2000);
    for (const bool declared : {true, false}) {
        params.declared = declared;
        const auto [text, after] = undisturbedRanks([&] {
            dfb::DistributedFrameBuffer<Blend> fb(MPI_COMM_WORLD, configOf(s));
            const std::string missing = outcomeOf([&] {
                auto frame = fb.begin(params);
                const auto tile = std::make_unique<decltype(fb)::Tile>();
                if (declared)
                    frame.declare(fb.rank() == last ? std::vector<dfb::TileInput>{{5, 77, 3}}
                                                    : std::vector<dfb::TileInput>());
                else
                    for (int index : fb.ownedTiles())
                        scene::sendParent(frame, *tile, index, index == 5 ? 2 : 0);
                frame.end();
            });
            return std::pair(missing, outcomeOfGoodFrame(fb, s));
        });
        const bool same = sameEverywhere(text);
        INFO(text);
        CHECK(same);
        CHECK(has(text, "FrameError: dfb: timed out: noticed by rank " + std::to_string(owner) + ", announced by rank "
                            + std::to_string(declared ? last : owner)));
        CHECK(has(text, "tile 5"));
        CHECK(has(text, "generation 1"));
        CHECK(has(text, declared ? "expected 1, got 0" : "expected 2, got 0"));
        if (declared)
            CHECK(has(text, "missing source 77 part 3 declared by rank " + std::to_string(last)));
        else
            CHECK(has(text, "; announced by source " + std::to_string(owner) + " of rank " + std::to_string(owner)));
        CHECK(after == "right");
    }
}

TEST_CASE("A lost message is an error in time on every rank", "[messaging]")
{
    const Scene s = sceneFor(6, 9);
    for (const auto kind : {MessageKind::Fragment, MessageKind::ManifestAck, MessageKind::TilesDone}) {
        const auto [text, after] = undisturbedRanks([&] {
            std::atomic<bool> done{false};
            const auto lose = [&](int, const MessageHeader& header, dfb::Buffer&) {
                return header.kind == kind && header.number == 1 && !done.exchange(true)
                           ? TamperingTransport::What::Lose
                           : TamperingTransport::What::Pass;
            };
            TamperedFrameBuffer<Blend> fb({MPI_COMM_WORLD, lose}, configOf(s));
            const std::string lost = outcomeOf([&] {
                Scene mine = s;
                mine.timeout = std::chrono::milliseconds(1000); // enough for all but the lost message, even if busy
                goodFrame(fb, mine);
            });
            return std::pair(lost, outcomeOfGoodFrame(fb, s));
        });
        const bool same = sameEverywhere(text);
        INFO(text);
        CHECK(same);
        CHECK((sizeOf(MPI_COMM_WORLD) > 1 ? has(text, "FrameError: dfb: timed out") : text == "fine"));
        CHECK(after == "right");
    }
}

TEST_CASE("With progress by the caller messages move in poll(), and not without it", "[messaging]")
{
    const Scene s = sceneFor(6, 10);
    auto config = configOf(s);
    dfb::NetworkConfig options;
    options.progress = dfb::Progress::Caller;
    const int size = sizeOf(MPI_COMM_WORLD), rank = rankIn(MPI_COMM_WORLD);
    config.image.ownerMap = [](int, const dfb::TileLayout&, int) { return 0; };
    static std::atomic<int> inputs;
    inputs = 0;
    struct Counter : dfb::BasicAlphaBlend<16> {
        void add(dfb::Fragment&& fragment)
        {
            BasicAlphaBlend::add(std::move(fragment));
            ++inputs;
        }
    };
    dfb::DistributedFrameBuffer<Counter> fb(MPI_COMM_WORLD, config, options);
    {
        auto frame = fb.begin(scene::paramsOf(s));
        MPI_Barrier(MPI_COMM_WORLD); // rank 0 has left the calls in which it moves messages by itself
        const auto tile = std::make_unique<decltype(fb)::Tile>();
        if (rank > 0)
            for (const dfb::Brick& brick : scene::bricksOf(s, rank, size))
                for (int index = 0; index < 28; ++index)
                    scene::sendInput(frame, *tile, s, brick, index);
        MPI_Barrier(MPI_COMM_WORLD); // all inputs were sent
        if (rank == 0) {
            CHECK(inputs == 0); // it has not polled
            int expected = 0;
            for (int other = 1; other < size; ++other)
                expected += 28 * static_cast<int>(scene::bricksOf(s, other, size).size());
            const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(20);
            while (inputs < expected && std::chrono::steady_clock::now() < limit)
                fb.poll();
            CHECK(inputs == expected);
            for (const dfb::Brick& brick : scene::bricksOf(s, rank, size))
                for (int index = 0; index < 28; ++index)
                    scene::sendInput(frame, *tile, s, brick, index);
            for (int index : fb.ownedTiles())
                scene::sendParent(frame, *tile, index, 6);
        }
        const auto report = frame.end();
        if (fb.isDisplayRank())
            CHECK(scene::wrongValues(Picture(fb.image(), report), scene::referenceOf(s)) == 0);
    }
    CHECK(goodFrame(fb, s));
}

TEST_CASE("A transport that is left behind keeps no memory", "[messaging]")
{
    struct Inbox : dfb::TransportHandler {
        void receive(int, dfb::Buffer&&) override {}
        void fail(const dfb::ErrorInfo&) override {}
        bool failed() const override { return false; }
    } inbox;
    std::weak_ptr<dfb::MemoryPool> memory;
    {
        const auto pool = dfb::MemoryPool::create();
        memory = pool;
        dfb::MpiTransport transport(MPI_COMM_WORLD, pool, dfb::Progress::Caller);
        transport.start(inbox);
        transport.stop(false); // as if an exception were passing
    }
    CHECK(memory.expired());
    MPI_Barrier(MPI_COMM_WORLD);
}

// Takes 3 GiB of memory on the first and the last rank.
TEST_CASE("A message of more than 2 GiB comes whole", "[messaging][.stress]")
{
    struct Inbox : dfb::TransportHandler {
        void receive(int, dfb::Buffer&& message) override
        {
            byteCount = message.size();
            checksum = dfb::crc32c(message.data(), message.size());
        }
        void fail(const dfb::ErrorInfo& error) override { failure = error.describe(); }
        bool failed() const override { return !failure.empty(); }
        std::size_t byteCount = 0;
        std::uint32_t checksum = 0;
        std::string failure;
    } inbox;
    const int last = sizeOf(MPI_COMM_WORLD) - 1, rank = rankIn(MPI_COMM_WORLD);
    const auto pool = dfb::MemoryPool::create();
    dfb::MpiTransport transport(MPI_COMM_WORLD, pool, dfb::Progress::Caller);
    transport.start(inbox);
    const std::size_t byteCount = (std::size_t{5} << 29) + 12345;
    std::uint32_t checksum = 0;
    if (rank == 0) {
        dfb::Buffer message = pool->acquire(byteCount);
        for (std::size_t i = 0; i < byteCount; ++i)
            message.data()[i] = std::byte(i * 2654435761u >> 24);
        checksum = dfb::crc32c(message.data(), byteCount);
        transport.send(last, std::move(message));
    }
    MPI_Bcast(&checksum, 1, MPI_UINT32_T, 0, MPI_COMM_WORLD);
    transport.stop(true);
    CHECK(inbox.failure == "");
    CHECK(inbox.byteCount == (rank == last ? byteCount : 0));
    CHECK(inbox.checksum == (rank == last ? checksum : 0));
}

} // namespace messaging_cases
