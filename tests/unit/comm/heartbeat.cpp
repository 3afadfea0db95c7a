// Heartbeat: which ranks listen for each other, when a rank is asked, when it counts as lost, and which time is left
// out.
#include "catch.hpp"

#include <dfb/comm/heartbeat.hpp>
#include <dfb/comm/reduction.hpp>

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <random>
#include <set>
#include <vector>

namespace heartbeat_cases {

namespace {

using dfb::detail::Heartbeat;
using dfb::detail::treeNeighbours;
using std::chrono::milliseconds;

constexpr int timeoutMs = 3200;
constexpr int stepMs = 100; // after so long due() is called again

// A Heartbeat whose clock the test advances.
struct Rank {
    Heartbeat beat;
    Heartbeat::Time now = Heartbeat::Time{} + std::chrono::hours(1);
    std::vector<int> asked;
    int lost = -1;
    int lostAt = -1; // ms since the first step
    int ms = 0;

    Rank(int rank, int size) : beat(treeNeighbours(rank, size), milliseconds(timeoutMs))
    {
        for (const int other : treeNeighbours(rank, size))
            beat.heard(other, true);
        step(0);
    }

    void step(int byMs = stepMs, bool expecting = true)
    {
        now += milliseconds(byMs);
        ms += byMs;
        CHECK(beat.isDue(now) == (byMs >= stepMs || ms == 0));
        const auto due = beat.due(now, expecting);
        asked.insert(asked.end(), due.ask.begin(), due.ask.end());
        if (due.lost >= 0 && lost < 0)
            lost = due.lost, lostAt = ms;
    }
    void steps(int count)
    {
        for (int i = 0; i < count; ++i)
            step();
    }
};

} // namespace

TEST_CASE("A rank listens for its neighbours in the tree of reductions, and they for it", "[heartbeat]")
{
    for (int size = 1; size <= 40; ++size) {
        std::vector<std::set<int>> listens(static_cast<std::size_t>(size));
        for (int rank = 0; rank < size; ++rank) {
            const auto neighbours = treeNeighbours(rank, size);
            const Heartbeat beat(neighbours, milliseconds(timeoutMs));
            listens[static_cast<std::size_t>(rank)].insert(neighbours.begin(), neighbours.end());
            CHECK(beat.isOn() == (size > 1));
            CHECK(listens[static_cast<std::size_t>(rank)].size() == neighbours.size());
            CHECK(neighbours.size() <= 6);
            // The neighbours are those of the reduction: the children, for which it waits, and the parent.
            dfb::ReductionTable table(rank, size, [](int, const dfb::ReductionKey&, bool, const auto&) {});
            const auto combine = [](const auto& a, const auto&) { return a; };
            const dfb::ReductionKey key{1, 1};
            std::set<int> tree;
            table.enter(key, {}, combine, [](const auto&) {});
            for (const auto& part : table.missing(key))
                tree.insert(part.rank);
            if (rank != 0)
                tree.insert(rank & (rank - 1));
            CHECK(tree == listens[static_cast<std::size_t>(rank)]);
        }
        for (int a = 0; a < size; ++a)
            for (const int b : listens[static_cast<std::size_t>(a)])
                CHECK(listens[static_cast<std::size_t>(b)].count(a) == 1);
        // The tree is connected: whichever ranks are lost, one of them has a neighbour that is not lost.
        std::set<int> reached{0};
        for (std::vector<int> open{0}; !open.empty();) {
            const int a = open.back();
            open.pop_back();
            for (const int b : listens[static_cast<std::size_t>(a)])
                if (reached.insert(b).second)
                    open.push_back(b);
        }
        CHECK(static_cast<int>(reached.size()) == size);
    }
}

TEST_CASE("Without a time-out it listens for nobody", "[heartbeat]")
{
    Heartbeat beat(treeNeighbours(0, 8), milliseconds(0));
    CHECK_FALSE(beat.isOn());
    const auto due = beat.due(Heartbeat::Time{} + std::chrono::hours(1), true);
    CHECK((due.ask.empty() && due.lost < 0));
}

TEST_CASE("A quiet rank is asked after each quarter of the time-out, and lost after all of it", "[heartbeat]")
{
    Rank rank(1, 2);
    rank.steps(timeoutMs / 4 / stepMs - 1);
    CHECK(rank.asked.empty());
    rank.step();
    CHECK(rank.asked == std::vector<int>{0});
    rank.steps(timeoutMs * 3 / 4 / stepMs - 1);
    CHECK(rank.asked == std::vector<int>{0, 0, 0});
    CHECK(rank.lost == -1);
    rank.step();
    CHECK(rank.lost == 0);
    CHECK(rank.lostAt == timeoutMs);
}

TEST_CASE("Any message is a sign of life of its sender, and of nobody else", "[heartbeat]")
{
    Rank rank(0, 3); // neighbours 1 and 2
    for (int i = 0; i < 3 * timeoutMs / stepMs && rank.lost < 0; ++i) {
        rank.beat.heard(1, false);
        rank.beat.heard(7, true); // a stranger
        rank.step();
    }
    CHECK(rank.lost == 2);
    CHECK(rank.lostAt == timeoutMs);
    CHECK(std::count(rank.asked.begin(), rank.asked.end(), 1) == 0);
    // A single message, at any time, postpones the loss by the whole time-out.
    Rank later(1, 2);
    later.steps(timeoutMs / stepMs - 1);
    later.beat.heard(0, false);
    later.step();
    later.steps(timeoutMs / stepMs - 1);
    CHECK(later.lost == -1);
    later.step();
    CHECK(later.lostAt == 2 * timeoutMs);
}

TEST_CASE("Who has never said that it answers is neither asked nor lost", "[heartbeat]")
{
    Heartbeat beat({0}, milliseconds(timeoutMs));
    auto now = Heartbeat::Time{} + std::chrono::hours(1);
    beat.heard(0, false); // a message, but no promise to answer
    for (int i = 0; i < 3 * timeoutMs / stepMs; ++i, now += milliseconds(stepMs)) {
        const auto due = beat.due(now, true);
        CHECK((due.ask.empty() && due.lost < 0));
    }
}

TEST_CASE("While no messages are expected nobody is asked, and time does not count", "[heartbeat]")
{
    Rank rank(1, 2);
    rank.steps(timeoutMs / stepMs - 1);
    const std::size_t asked = rank.asked.size();
    for (int i = 0; i < 3 * timeoutMs / stepMs; ++i)
        rank.step(stepMs, false);
    CHECK(rank.asked.size() == asked);
    CHECK(rank.lost == -1);
    const int start = rank.ms + stepMs;
    rank.steps(timeoutMs / stepMs);
    CHECK(rank.lost == -1);
    rank.step();
    CHECK(rank.lostAt == start + timeoutMs);
}

TEST_CASE("A rank that was held itself counts from then on", "[heartbeat]")
{
    for (const int heldMs : {timeoutMs / 4 + 1, timeoutMs, 100 * timeoutMs}) {
        Rank rank(1, 2);
        rank.steps(timeoutMs / stepMs - 1);
        CHECK(rank.lost == -1);
        rank.step(heldMs);
        CHECK(rank.lost == -1);
        const int start = rank.ms;
        rank.steps(timeoutMs / stepMs - 1);
        CHECK(rank.lost == -1);
        rank.step();
        CHECK(rank.lostAt == start + timeoutMs);
    }
    // A gap no longer than the time that a rank may take to answer does not count as one.
    Rank rank(1, 2);
    while (rank.lost < 0 && rank.ms < 10 * timeoutMs)
        rank.step(timeoutMs / 4);
    CHECK(rank.lostAt == timeoutMs);
}

TEST_CASE("Two ranks that answer in time never lose each other, however they are slowed down", "[heartbeat]")
{
    for (unsigned seed = 0; seed < 200; ++seed) {
        std::mt19937 random(seed);
        const auto upTo = [&](int ms) { return static_cast<int>(random() % static_cast<unsigned>(ms + 1)); };
        const milliseconds step(10);
        Heartbeat a({1}, milliseconds(timeoutMs)), b({0}, milliseconds(timeoutMs));
        a.heard(1, true), b.heard(0, true);
        struct Message {
            Heartbeat::Time at;
            bool toA, isQuestion;
        };
        std::vector<Message> wire;
        auto now = Heartbeat::Time{} + std::chrono::hours(1);
        auto aAwake = now, bAwake = now;
        int questions = 0;
        bool lost = false;
        const auto end = now + milliseconds(20 * timeoutMs);
        const auto turn = [&](Heartbeat& self, bool isA, Heartbeat::Time& awake) {
            if (now < awake)
                return;
            for (std::size_t i = 0; i < wire.size();) {
                if (wire[i].toA != isA || wire[i].at > now) {
                    ++i;
                    continue;
                }
                self.heard(isA ? 1 : 0, !wire[i].isQuestion);
                if (wire[i].isQuestion)
                    wire.push_back({now + milliseconds(upTo(timeoutMs / 16)), !isA, false});
                wire.erase(wire.begin() + static_cast<std::ptrdiff_t>(i));
            }
            const auto due = self.due(now, true);
            lost = lost || due.lost >= 0;
            for (std::size_t i = 0; i < due.ask.size(); ++i, ++questions)
                wire.push_back({now + milliseconds(upTo(timeoutMs / 16)), !isA, true});
            if (upTo(20) == 0)
                awake = now + milliseconds(upTo(timeoutMs / 8));
        };
        for (; now < end; now += step) {
            turn(a, true, aAwake);
            turn(b, false, bAwake);
        }
        INFO("seed " << seed << ", " << questions << " questions");
        CHECK_FALSE(lost);
        CHECK(questions > 0);
        CHECK(questions <= 2 * 4 * 20);
    }
}

} // namespace heartbeat_cases
