// A rank that stops answering: the others name it within the time-out, in whatever call they wait, and can be
// destroyed. A rank that is only slow, or was itself held, raises no alarm. A rank that expects nothing sends nothing.
// Ranks are threads, each with a progress thread of its own, which a test can hold.
#include "board.hpp"
#include "catch.hpp"
#include "random_scene.hpp"

#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <vector>

namespace lost_peers_cases {

namespace {

using board::Board;
using board::BoardTransport;
using board::joined;
using board::runOn;
using dfb::detail::MessageHeader;
using dfb::detail::MessageKind;
using scene::configOf;
using scene::has;
using scene::outcomeOf;
using std::chrono::milliseconds;
using Clock = std::chrono::steady_clock;

// Long enough for a progress thread to get the processor on a busy machine.
constexpr int timeoutMs = 1200;
// How many ms later than that an error may come on a busy machine.
constexpr double marginMs = 5000;
constexpr std::uint64_t seed = 1; // messages are moved by poll()

struct Holds {
    explicit Holds(int ranks) : held(static_cast<std::size_t>(ranks)), slowMs(held.size()), naps(held.size()) {}
    std::vector<std::atomic<bool>> held;  // while true, poll() of that rank does not return
    std::vector<std::atomic<int>> slowMs; // poll() of that rank takes so long
    std::vector<std::atomic<int>> naps;   // number of naps of that rank
};

class HeldTransport : public Forward<BoardTransport> {
public:
    struct Communicator {
        BoardTransport::Communicator inner;
        std::shared_ptr<Holds> holds;
    };

    HeldTransport(const Communicator& c, std::shared_ptr<dfb::MemoryPool> pool, dfb::Progress progress)
        : Forward(c.inner, std::move(pool), progress), holds_(c.holds)
    {
    }
    bool poll()
    {
        const auto self = static_cast<std::size_t>(rank());
        while (holds_->held[self])
            std::this_thread::sleep_for(milliseconds(1));
        if (const int slowMs = holds_->slowMs[self]; slowMs > 0)
            std::this_thread::sleep_for(milliseconds(slowMs));
        return inner_.poll();
    }
    void nap(std::chrono::nanoseconds limit)
    {
        ++holds_->naps[static_cast<std::size_t>(rank())];
        inner_.nap(limit);
    }

private:
    std::shared_ptr<Holds> holds_;
};

using FrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, HeldTransport>;

dfb::FrameBufferConfig smallConfig()
{
    auto config = configOf(scene::makeScene(0));
    config.executor = std::make_shared<dfb::ThreadExecutor>(1);
    return config;
}

dfb::NetworkConfig timedOptions(int peerTimeoutMs = timeoutMs)
{
    dfb::NetworkConfig options;
    options.peerTimeout = std::chrono::milliseconds(peerTimeoutMs);
    return options;
}

FrameBuffer::Frame begin(FrameBuffer& fb)
{
    dfb::FrameConfig params;
    params.declared = true;
    auto frame = fb.begin(params);
    frame.declare({});
    return frame;
}

void emptyFrame(FrameBuffer& fb) { begin(fb).end(); }

// The outcome on a rank that waited for a lost one.
struct Told {
    std::optional<dfb::ErrorInfo> error;
    double ms = 0;    // from the moment when that rank was held
    double endMs = 0; // that destruction then took
};

// Whether a message only says or asks whether a rank is there.
bool isSign(const MessageHeader& header)
{
    return header.kind == MessageKind::Ping || header.kind == MessageKind::Pong;
}

// Calls `wait(connection, fb)` on all ranks but `victim`, which no longer answers. The victim is held after the
// framebuffer was made and a first frame has ended, or, without `withFrameBuffer`, as soon as there is a connection.
std::vector<Told> lose(int ranks, int victim, bool withFrameBuffer,
                       const std::function<void(std::shared_ptr<dfb::Connection>, std::unique_ptr<FrameBuffer>&)>& wait)
{
    const auto holds = std::make_shared<Holds>(ranks);
    std::vector<Told> told(static_cast<std::size_t>(ranks));
    std::atomic<int> ready{0}, over{0};
    std::atomic<std::int64_t> heldAt{0};
    runOn(
        std::make_shared<Board>(), ranks,
        [&](const BoardTransport::Communicator& communicator) {
            const int rank = communicator.inner.rank();
            auto connection =
                dfb::connect<HeldTransport>(HeldTransport::Communicator{communicator, holds}, timedOptions());
            std::unique_ptr<FrameBuffer> fb;
            if (withFrameBuffer) {
                fb = std::make_unique<FrameBuffer>(connection, smallConfig());
                emptyFrame(*fb);
            } else {
                std::this_thread::sleep_for(milliseconds(100)); // until all have heard that the others answer
            }
            for (++ready; ready < ranks;)
                std::this_thread::sleep_for(milliseconds(1));
            Told& mine = told[static_cast<std::size_t>(rank)];
            if (rank == victim) {
                heldAt = Clock::now().time_since_epoch().count();
                holds->held[static_cast<std::size_t>(rank)] = true;
                while (over < ranks - 1)
                    std::this_thread::sleep_for(milliseconds(1));
                holds->held[static_cast<std::size_t>(rank)] = false; // it comes back, too late
            } else {
                while (heldAt == 0)
                    std::this_thread::sleep_for(milliseconds(1));
            }
            try {
                wait(connection, fb);
            } catch (const dfb::TransportError& e) {
                mine.error = e.info();
            }
            const auto now = Clock::now();
            mine.ms = std::chrono::duration<double, std::milli>(now - Clock::time_point(Clock::duration(heldAt.load())))
                          .count();
            fb.reset();
            connection.reset();
            mine.endMs = std::chrono::duration<double, std::milli>(Clock::now() - now).count();
            ++over;
        },
        seed);
    return told;
}

// Checks the errors of all ranks. Returns after how many ms the first rank got its error.
double checkTold(const std::vector<Told>& told, int victim)
{
    double soonest = timeoutMs + marginMs;
    for (std::size_t rank = 0; rank < told.size(); ++rank) {
        INFO("rank " << rank << ", after " << told[rank].ms << " ms");
        CHECK(told[rank].endMs < marginMs);
        if (static_cast<int>(rank) == victim && !told[rank].error)
            continue; // its result was there already when it came back
        REQUIRE(told[rank].error);
        CHECK(told[rank].error->kind == dfb::ErrorKind::Transport);
        CHECK(told[rank].error->rank == victim);
        CHECK(has(told[rank].error->describe(), "is lost"));
        if (static_cast<int>(rank) != victim) {
            CHECK(told[rank].ms >= timeoutMs / 2);
            CHECK(told[rank].ms < timeoutMs + marginMs);
            soonest = std::min(soonest, told[rank].ms);
        }
    }
    return soonest;
}

} // namespace

TEST_CASE("A rank that stops answering is named by all others, in whatever call they wait", "[lost_peers]")
{
    using dfb::Connection;
    const auto constructor = [](const std::shared_ptr<Connection>& connection, std::unique_ptr<FrameBuffer>& fb) {
        fb = std::make_unique<FrameBuffer>(connection, smallConfig());
    };
    const auto frame = [](const std::shared_ptr<Connection>&, std::unique_ptr<FrameBuffer>& fb) { emptyFrame(*fb); };
    const auto reduction = [](const std::shared_ptr<Connection>&, std::unique_ptr<FrameBuffer>& fb) {
        fb->allReduce({1}, FrameBuffer::Reduce::Sum);
    };
    struct Case {
        int ranks, victim;
        bool withFrameBuffer;
        std::function<void(std::shared_ptr<Connection>, std::unique_ptr<FrameBuffer>&)> wait;
    };
    std::vector<Case> cases;
    for (const int ranks : {2, 5})
        for (const int victim : {0, ranks - 1}) {
            cases.push_back({ranks, victim, false, constructor});
            cases.push_back({ranks, victim, true, frame});
            cases.push_back({ranks, victim, true, reduction});
        }
    double soonest = timeoutMs + marginMs;
    for (int attempt = 0; attempt < 3 && soonest >= 2 * timeoutMs; ++attempt)
        board::eachAtOnce(
            cases, [](const Case& c) { return lose(c.ranks, c.victim, c.withFrameBuffer, c.wait); },
            [&](const Case& c, const std::vector<Told>& told) {
                INFO("rank " << c.victim << " of " << c.ranks);
                soonest = std::min(soonest, checkTold(told, c.victim));
            });
    CHECK(soonest < 2 * timeoutMs); // the machine is not always late
}

TEST_CASE("A frame that is open while rendering fails when a rank is lost, and says so before end()", "[lost_peers]")
{
    std::atomic<int> failed{0};
    const auto render = [&](const std::shared_ptr<dfb::Connection>&, std::unique_ptr<FrameBuffer>& fb) {
        auto frame = begin(*fb);
        for (const auto start = Clock::now(); !frame.failed() && Clock::now() - start < std::chrono::seconds(10);)
            std::this_thread::sleep_for(milliseconds(1));
        failed += frame.failed();
        frame.end();
    };
    const auto told = undisturbed([&] {
        failed = 0;
        return lose(3, 2, true, render);
    });
    checkTold(told, 2);
    CHECK(failed >= 2); // the lost rank may not even begin the frame
}

TEST_CASE("The handler is called where a rank was found lost, once, and not on the others", "[lost_peers]")
{
    constexpr int ranks = 5, victim = 4; // only rank 0 listens for the victim
    struct Outcome {
        std::vector<int> calls = std::vector<int>(ranks);
        int lost = -1;
        std::vector<std::string> texts = std::vector<std::string>(ranks);
    };
    const Outcome o = undisturbed([&] {
        const auto holds = std::make_shared<Holds>(ranks);
        std::vector<std::atomic<int>> calls(ranks);
        std::atomic<int> lost{-1}, over{0};
        Outcome outcome;
        runOn(
            std::make_shared<Board>(), ranks,
            [&](const BoardTransport::Communicator& communicator) {
                const auto rank = static_cast<std::size_t>(communicator.inner.rank());
                auto options = timedOptions();
                options.onPeerLost = [&, rank](const dfb::ErrorInfo& error) {
                    ++calls[rank];
                    lost = error.rank;
                };
                FrameBuffer fb({communicator, holds}, smallConfig(), options);
                emptyFrame(fb);
                if (fb.rank() == victim) {
                    holds->held[victim] = true;
                    while (over < ranks - 1)
                        std::this_thread::sleep_for(milliseconds(1));
                    holds->held[victim] = false;
                }
                outcome.texts[rank] = outcomeOf([&] { emptyFrame(fb); });
                ++over;
            },
            seed);
        std::copy(calls.begin(), calls.end(), outcome.calls.begin());
        outcome.lost = lost;
        return outcome;
    });
    INFO(joined(o.texts));
    CHECK(o.lost == victim);
    CHECK(o.calls[0] == 1);
    for (std::size_t rank = 1; rank < ranks; ++rank)
        CHECK(o.calls[rank] == 0);
    for (const std::string& text : o.texts)
        CHECK(has(text, "rank 4"));
}

namespace {

// Calls run(communicator, holds) on each rank, and checks that it is fine.
template <class Run>
void checkFine(int ranks, const Run& run)
{
    const auto all = undisturbed([&] {
        const auto holds = std::make_shared<Holds>(ranks);
        std::vector<std::string> texts(static_cast<std::size_t>(ranks));
        runOn(
            std::make_shared<Board>(), ranks,
            [&](const BoardTransport::Communicator& communicator) {
                texts[static_cast<std::size_t>(communicator.inner.rank())] =
                    outcomeOf([&] { run(communicator, holds); });
            },
            seed);
        return texts;
    });
    INFO(joined(all));
    for (const std::string& text : all)
        CHECK(text == "fine");
}

} // namespace

TEST_CASE("A rank that renders long, or polls slowly, raises no alarm", "[lost_peers]")
{
    checkFine(3, [](const BoardTransport::Communicator& communicator, const std::shared_ptr<Holds>& holds) {
        FrameBuffer fb({communicator, holds}, smallConfig(), timedOptions());
        emptyFrame(fb);
        const auto rank = static_cast<std::size_t>(fb.rank());
        if (rank == 2)
            holds->slowMs[rank] = 20; // the others take about 1 ms
        auto frame = begin(fb);
        if (rank == 2)
            std::this_thread::sleep_for(milliseconds(2 * timeoutMs));
        frame.end();
        if (rank == 1) // and between frames, with the others in a call that waits for all
            std::this_thread::sleep_for(milliseconds(2 * timeoutMs));
        fb.allReduce({1}, FrameBuffer::Reduce::Sum);
        holds->slowMs[rank] = 0;
    });
}

TEST_CASE("A rank that was held itself does not take the others for lost", "[lost_peers]")
{
    checkFine(3, [](const BoardTransport::Communicator& communicator, const std::shared_ptr<Holds>& holds) {
        const bool isHeld = communicator.inner.rank() == 1;
        FrameBuffer fb({communicator, holds}, smallConfig(), timedOptions(isHeld ? timeoutMs : 60000));
        emptyFrame(fb);
        auto frame = begin(fb);
        if (isHeld) {
            std::this_thread::sleep_for(milliseconds(timeoutMs / 2));
            holds->held[1] = true;
            std::this_thread::sleep_for(milliseconds(2 * timeoutMs));
            holds->held[1] = false;
            std::this_thread::sleep_for(milliseconds(timeoutMs));
        }
        frame.end();
    });
}

TEST_CASE("Ranks without a progress thread, or without a time-out, are not taken for lost", "[lost_peers]")
{
    for (const bool byCaller : {true, false})
        checkFine(2, [&](const BoardTransport::Communicator& communicator, const std::shared_ptr<Holds>& holds) {
            const bool isOther = communicator.inner.rank() == 1;
            auto options = timedOptions(isOther && !byCaller ? 0 : timeoutMs);
            if (isOther && byCaller)
                options.progress = dfb::Progress::Caller;
            FrameBuffer fb({communicator, holds}, smallConfig(), options);
            auto frame = begin(fb);
            holds->held[1] = isOther && !byCaller;
            if (isOther)
                std::this_thread::sleep_for(milliseconds(2 * timeoutMs));
            holds->held[1] = false;
            frame.end();
        });
}

TEST_CASE("Who expects nothing sends nothing and sleeps; in a silent frame a few messages are sent", "[lost_peers]")
{
    constexpr int ranks = 4, quietMs = 2 * timeoutMs;
    constexpr int pairs = ranks - 1; // pairs of neighbours in the tree
    struct Counts {
        int atStart, idle, silent, napsIdle;
        double idleMs, silentMs; // as long as it took
    };
    for (const int peerTimeoutMs : {0, timeoutMs}) {
        const int expected = peerTimeoutMs > 0 ? 2 * pairs : 0;
        const Counts c = undisturbed([&] {
            const auto holds = std::make_shared<Holds>(ranks);
            const auto board = std::make_shared<Board>();
            std::atomic<int> signs{0}, others{0};
            board->inspect = [&](int, int, const MessageHeader& header, dfb::Buffer&) {
                ++(isSign(header) ? signs : others);
                return Board::What::Pass;
            };
            std::atomic<int> out{0}, atStart{0}, idle{0}, silent{0}, napsIdle{0}, napsBefore{0}, begun{0};
            std::atomic<double> idleMs{0}, silentMs{0};
            const auto msSince = [](Clock::time_point start) {
                return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
            };
            const auto waitFor = [](const auto& condition) {
                for (const auto end = Clock::now() + std::chrono::seconds(20); !condition() && Clock::now() < end;)
                    std::this_thread::sleep_for(milliseconds(1));
            };
            const auto allNaps = [&] {
                int sum = 0;
                for (const auto& n : holds->naps)
                    sum += n;
                return sum;
            };
            runOn(
                board, ranks,
                [&](const BoardTransport::Communicator& communicator) {
                    FrameBuffer fb({communicator, holds}, smallConfig(), timedOptions(peerTimeoutMs));
                    emptyFrame(fb);
                    ++out;
                    if (fb.rank() == 0) {
                        waitFor([&] { return out == ranks && signs >= expected; });
                        std::this_thread::sleep_for(milliseconds(300)); // until all are asleep
                        atStart = signs.load();
                        napsBefore = allNaps();
                        const auto start = Clock::now();
                        std::this_thread::sleep_for(milliseconds(quietMs));
                        idle = signs - atStart;
                        napsIdle = allNaps() - napsBefore;
                        idleMs = msSince(start);
                        ++out;
                    }
                    waitFor([&] { return out > ranks; });
                    auto frame = begin(fb);
                    ++begun;
                    if (fb.rank() == 0) {
                        waitFor([&] { return begun == ranks; });
                        const auto start = Clock::now();
                        const int before = signs;
                        std::this_thread::sleep_for(milliseconds(quietMs));
                        waitFor([&] { return peerTimeoutMs == 0 || signs > before; });
                        silent = signs - before;
                        silentMs = msSince(start);
                        ++begun;
                    }
                    waitFor([&] { return begun > ranks; });
                    frame.end();
                },
                seed);
            return Counts{atStart, idle, silent, napsIdle, idleMs, silentMs};
        });
        INFO("time-out " << peerTimeoutMs << ": " << c.atStart << " signs of life at the start, " << c.idle << " idle, "
                         << c.silent << " in a frame of " << c.silentMs << " ms; " << c.napsIdle << " naps in "
                         << c.idleMs << " ms");
        CHECK(c.atStart == expected);
        CHECK(c.idle == 0);
        if (peerTimeoutMs == 0) {
            CHECK(c.silent == 0);
        } else {
            CHECK(c.silent > 0);
            // At most a question and an answer in each direction, for each quarter of the time-out.
            CHECK(c.silent <= pairs * 4 * 4 * (c.silentMs / timeoutMs + 1));
        }
        // Idle threads wake up once a second, or once in a quarter of the time-out if that is shorter.
        CHECK(c.napsIdle <= ranks * (c.idleMs / (peerTimeoutMs > 0 ? timeoutMs / 4 : 1000) + 2));
    }
}

TEST_CASE("A time-out for peers that cannot be is refused on all ranks", "[lost_peers]")
{
    for (const milliseconds wrong : {milliseconds(-1), milliseconds(1), milliseconds(99), milliseconds::max()}) {
        std::vector<std::string> texts(2);
        const auto holds = std::make_shared<Holds>(2);
        runOn(
            std::make_shared<Board>(), 2,
            [&](const BoardTransport::Communicator& communicator) {
                const int rank = communicator.inner.rank();
                dfb::NetworkConfig options;
                options.peerTimeout = rank == 1 ? wrong : milliseconds(0);
                texts[static_cast<std::size_t>(rank)] = outcomeOf([&] {
                    FrameBuffer fb({communicator, holds}, smallConfig(), options);
                });
            },
            seed);
        INFO(joined(texts));
        for (const std::string& text : texts)
            CHECK((has(text, "InvalidArgument") && has(text, std::to_string(wrong.count()) + " ms")));
    }
}

} // namespace lost_peers_cases
