// Quiescence, checked with a model of ranks that send each other work in random order. It must never claim that nothing
// is under way while something is, however unlikely that is, and must claim it at some time when nothing is.
#include "catch.hpp"

#include <dfb/comm/quiescence.hpp>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <random>
#include <vector>

namespace quiescence_cases {

namespace {

using dfb::detail::Quiescence;

struct Outcome {
    int claims = 0, wrongClaims = 0;  // that nothing is under way
    int wrongRounds = 0;              // sums were equal while work was under way: needs a second round
    bool isQuiet = false;             // the world, at the end
    std::vector<std::int64_t> rounds; // that each rank has ended by then
};

class World {
public:
    // `loses`: one of so many messages never arrives; 0: none is lost.
    World(std::uint64_t seed, int ranks, int work, int loses = 0)
        : random_(seed), loses_(loses), work_(work), ranks_(static_cast<std::size_t>(ranks))
    {
        for (Rank& r : ranks_) {
            r.quiescence.newFrame();
            r.tasks = pick(3);
        }
    }

    Outcome run(int steps)
    {
        // The frequency of each kind of event: in some worlds messages are slow, in others rounds are.
        int weights[4];
        for (int& w : weights)
            w = 1 + pick(pick(2) == 0 ? 3 : 40);
        std::discrete_distribution<int> what(weights, weights + 4);
        for (int step = 0; step < steps && outcome_.claims == 0; ++step)
            switch (what(random_)) {
            case 0: deliver(); break;
            case 1: doTask(any()); break;
            case 2: enter(any()); break;
            default: tellResult(any()); break;
            }
        outcome_.isQuiet = isQuiet();
        for (const Rank& r : ranks_)
            outcome_.rounds.push_back(r.rounds);
        return outcome_;
    }

private:
    struct Rank {
        Quiescence quiescence{std::chrono::milliseconds(1)};
        int tasks = 0;   // arrived messages, and own work
        int untaken = 0; // how many of them are messages
        std::uint64_t sent = 0, taken = 0;
        std::deque<Quiescence::Report> results; // of rounds, on their way to this rank
        std::int64_t rounds = 0;
    };

    int pick(int below) { return static_cast<int>(random_() % static_cast<std::uint64_t>(below)); }
    std::size_t any() { return static_cast<std::size_t>(pick(static_cast<int>(ranks_.size()))); }

    bool isQuiet() const
    {
        for (const Rank& r : ranks_)
            if (r.tasks > 0)
                return false;
        return underWay_.empty();
    }

    void deliver()
    {
        if (underWay_.empty())
            return;
        const auto which = static_cast<std::size_t>(pick(static_cast<int>(underWay_.size())));
        Rank& to = ranks_[underWay_[which]];
        underWay_.erase(underWay_.begin() + static_cast<std::ptrdiff_t>(which));
        if (loses_ > 0 && pick(loses_) == 0)
            return;
        ++to.tasks;
        ++to.untaken;
    }

    void doTask(std::size_t which)
    {
        Rank& r = ranks_[which];
        if (r.tasks == 0)
            return;
        if (r.untaken > 0) {
            --r.untaken;
            ++r.taken;
        }
        for (int messages = pick(3); messages > 0 && work_ > 0; --messages, --work_) {
            ++r.sent;
            underWay_.push_back(any());
        }
        if (pick(3) > 0) // otherwise it goes on
            --r.tasks;
    }

    void enter(std::size_t which)
    {
        Rank& r = ranks_[which];
        if (r.tasks > 0 || !r.quiescence.tryEnter())
            return;
        round_ = Quiescence::sum(round_, {r.sent, r.taken, 1});
        if (++entered_ < ranks_.size())
            return;
        outcome_.wrongRounds += round_.sent == round_.taken && !isQuiet();
        for (Rank& other : ranks_)
            other.results.push_back(round_);
        round_ = {};
        entered_ = 0;
    }

    void tellResult(std::size_t which)
    {
        Rank& r = ranks_[which];
        if (r.results.empty())
            return;
        const Quiescence::Report all = r.results.front();
        r.results.pop_front();
        ++r.rounds;
        if (r.quiescence.endRound(all)) {
            ++outcome_.claims;
            outcome_.wrongClaims += !isQuiet();
        }
    }

    std::mt19937_64 random_;
    int loses_, work_; // so many messages may still be sent
    std::vector<Rank> ranks_;
    std::vector<std::size_t> underWay_; // where to
    Quiescence::Report round_;
    std::size_t entered_ = 0;
    Outcome outcome_;
};

dfb::detail::Quiescence::Report reportOf(std::uint64_t sent, std::uint64_t taken, std::uint64_t unfinished = 1)
{
    return {sent, taken, unfinished};
}

} // namespace

TEST_CASE("Whatever the order, nothing is said while something is under way, and at last it is", "[quiescence]")
{
    int wrongRounds = 0, claims = 0;
    for (std::uint64_t seed = 0; seed < 5000; ++seed) {
        const int ranks = 1 + static_cast<int>(seed % 7);
        const Outcome o = World(seed, ranks, static_cast<int>(seed % 60)).run(100000);
        wrongRounds += o.wrongRounds;
        claims += o.claims;
        if (o.wrongClaims > 0 || o.claims != 1 || !o.isQuiet)
            FAIL("seed " << seed);
    }
    CHECK(claims == 5000);
    CHECK(wrongRounds > 5); // otherwise the orders are too easy
}

TEST_CASE("Where a message was lost nothing is said", "[quiescence]")
{
    int claims = 0, lossless = 0;
    for (std::uint64_t seed = 0; seed < 300; ++seed) {
        const Outcome o = World(seed, 2 + static_cast<int>(seed % 3), 40, 4).run(5000);
        claims += o.claims;
        lossless += o.claims > 0 && o.wrongClaims == 0;
    }
    CHECK(claims == lossless);
    CHECK(claims < 150); // those in which no message was lost
}

TEST_CASE("It takes two rounds with the same sums, as many taken as sent, and a rank that waits", "[quiescence]")
{
    Quiescence q{std::chrono::milliseconds(10)};
    const auto says = [&](const std::vector<Quiescence::Report>& rounds) {
        q.newFrame();
        bool last = false;
        for (const Quiescence::Report& round : rounds) {
            CHECK_FALSE(last);
            CHECK(q.tryEnter());
            CHECK_FALSE(q.tryEnter());
            last = q.endRound(round);
        }
        return last;
    };
    CHECK_FALSE(says({reportOf(0, 0)}));
    CHECK(says({reportOf(0, 0), reportOf(0, 0)}));
    CHECK(says({reportOf(5, 5), reportOf(5, 5, 3)}));
    CHECK(says({reportOf(5, 3), reportOf(5, 5), reportOf(5, 5)}));
    CHECK_FALSE(says({reportOf(5, 5), reportOf(6, 6)}));
    CHECK_FALSE(says({reportOf(5, 5), reportOf(6, 5), reportOf(6, 6)}));
    CHECK_FALSE(says({reportOf(6, 5), reportOf(6, 5), reportOf(6, 5)}));
    CHECK_FALSE(says({reportOf(5, 6), reportOf(5, 6)}));
    CHECK_FALSE(says({reportOf(5, 5), reportOf(5, 5, 0)})); // all are done, so their verdict is on its way
    CHECK_FALSE(says({reportOf(5, 5), reportOf(5, 6), reportOf(5, 5)}));
}

TEST_CASE("Rounds become rarer, up to a limit, and begin again with the next frame", "[quiescence]")
{
    Quiescence q{std::chrono::milliseconds(3)};
    for (int frame = 0; frame < 2; ++frame) {
        q.newFrame();
        std::vector<std::int64_t> waits;
        for (int round = 0; round < 8; ++round) {
            waits.push_back(q.interval().count());
            q.tryEnter();
            q.endRound(reportOf(static_cast<std::uint64_t>(round), 0));
        }
        CHECK(waits == std::vector<std::int64_t>{3, 3, 6, 12, 24, 48, 48, 48});
    }
    CHECK(Quiescence(std::chrono::milliseconds(0)).interval().count() == 1);
}

} // namespace quiescence_cases
