// FlowControl over a simulated network, without threads: any number of ranks, and messages that are delivered and
// consumed in an order that a seed determines.
#include "catch.hpp"

#include <dfb/comm/flow_control.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <deque>
#include <memory>
#include <random>
#include <string>
#include <utility>
#include <vector>

namespace flow_control_cases {

namespace {

using dfb::Buffer;
using dfb::detail::FlowControl;

std::size_t allowanceOf(int ranks, std::size_t pool)
{
    return ranks > 1 ? pool / 2 / (static_cast<std::size_t>(ranks) - 1) : 0;
}

// The most bytes that a rank may still count as under way when everything it sent was consumed: what each receiver may
// keep to itself for the time being.
std::size_t idleBound(int ranks, std::size_t pool)
{
    const std::size_t half = allowanceOf(ranks, pool) / 2;
    return (static_cast<std::size_t>(ranks) - 1) * (half > 0 ? half - 1 : 0);
}

// The next event is drawn by these weights. An event of weight 0 only happens if no other can.
struct Habits {
    unsigned send = 10, deliverData = 10, deliverControl = 10, consume = 10;
    enum class Order { Any, OldestFirst, NewestFirst } consumeOrder = Order::Any, deliverOrder = Order::Any;
};

class Network {
public:
    Network(int ranks, std::size_t pool, std::uint64_t seed, Habits habits = {}) : habits_(habits), random_(seed)
    {
        for (int rank = 0; rank < ranks; ++rank) {
            nodes_.push_back(std::make_unique<Node>());
            Node& node = *nodes_.back();
            node.flow = std::make_unique<FlowControl>(
                ranks, pool,
                FlowControl::Callbacks{[this, rank, &node](int to, Buffer&& message) {
                                           Packet p = packet(rank, to, node.epoch);
                                           p.bytes = message.size();
                                           std::memcpy(&p.number, message.data(),
                                                       std::min(sizeof p.number, message.size()));
                                           outstanding(to) += p.bytes;
                                           mostOutstanding_ = std::max(mostOutstanding_, outstanding(to));
                                           data_.push_back(p);
                                           ++dataSent;
                                       },
                                       [this, rank, &node](int to, const FlowControl::Request& request) {
                                           Packet p = packet(rank, to, node.epoch);
                                           p.isRequest = true;
                                           p.request = request;
                                           control_.push_back(p);
                                           ++requestsSent;
                                       },
                                       [this, rank, &node](int to, const FlowControl::Credit& credit) {
                                           Packet p = packet(rank, to, node.epoch);
                                           p.credit = credit;
                                           control_.push_back(p);
                                           ++creditsSent;
                                       }});
        }
    }

    int size() const { return static_cast<int>(nodes_.size()); }
    FlowControl& flow(int rank) { return *node(rank).flow; }
    std::size_t mostOutstanding() const { return mostOutstanding_; }

    // Adds a message that is sent when its turn comes.
    void plan(int from, int to, std::size_t bytes) { node(from).plan.push_back({to, bytes}); }

    // Runs until no event is possible, or for `steps` events.
    void run(std::size_t steps = static_cast<std::size_t>(-1))
    {
        while (steps-- > 0 && step()) {
        }
    }

    bool idle() const
    {
        return data_.empty() && control_.empty() && std::all_of(nodes_.begin(), nodes_.end(), [](const auto& n) {
                   return n->plan.empty() && n->inbox.empty();
               });
    }

    // ---- epochs

    // Begins the next epoch on one rank. Handles messages that came early for it, and drops the rest of the rank's
    // plan.
    void nextEpoch(int rank)
    {
        Node& n = node(rank);
        n.plan.clear();
        for (const Packet& p : n.inbox)
            if (p.epoch <= n.epoch)
                discard(rank, p);
        n.inbox.erase(
            std::remove_if(n.inbox.begin(), n.inbox.end(), [&](const Packet& p) { return p.epoch <= n.epoch; }),
            n.inbox.end());
        ++n.epoch;
        n.flow->newEpoch();
        const std::vector<Packet> early = std::exchange(n.early, {});
        for (const Packet& p : early)
            handleControl(p);
    }

    // Loses all messages under way.
    void loseAll()
    {
        for (const Packet& p : data_)
            outstanding(p.to) -= p.bytes;
        data_.clear();
        control_.clear();
    }

    // Loses one message under way, if there is any.
    void loseOne()
    {
        auto& list = random_() % 2 || control_.empty() ? data_ : control_;
        if (list.empty())
            return;
        const Packet p = take(list, Habits::Order::Any);
        outstanding(p.to) -= p.bytes;
    }

    std::int64_t dataSent = 0, requestsSent = 0, creditsSent = 0, consumed = 0;
    std::vector<std::uint64_t> consumedNumbers;

private:
    struct Packet {
        int from = 0, to = 0;
        int epoch = 0;
        std::size_t bytes = 0; // 0: no data
        std::uint64_t number = 0;
        bool isRequest = false;
        FlowControl::Request request;
        FlowControl::Credit credit;
    };
    struct Planned {
        int to;
        std::size_t bytes;
    };
    struct Node {
        std::unique_ptr<FlowControl> flow;
        int epoch = 1;
        std::deque<Planned> plan;
        std::vector<Packet> inbox; // data, also of later epochs
        std::vector<Packet> early; // other messages of later epochs
    };

    Node& node(int rank) { return *nodes_[static_cast<std::size_t>(rank)]; }
    // Bytes that were transmitted to this rank and are not yet out of its inbox, of all epochs.
    std::size_t& outstanding(int rank)
    {
        outstanding_.resize(nodes_.size());
        return outstanding_[static_cast<std::size_t>(rank)];
    }

    static Packet packet(int from, int to, int epoch)
    {
        Packet p;
        p.from = from, p.to = to, p.epoch = epoch;
        return p;
    }

    Packet take(std::vector<Packet>& list, Habits::Order order)
    {
        const std::size_t i = order == Habits::Order::Any           ? random_() % list.size()
                              : order == Habits::Order::OldestFirst ? 0
                                                                    : list.size() - 1;
        const Packet p = list[i];
        list.erase(list.begin() + static_cast<std::ptrdiff_t>(i));
        return p;
    }

    bool step()
    {
        std::vector<int> senders, consumers;
        for (int rank = 0; rank < size(); ++rank) {
            const Node& n = node(rank);
            if (!n.plan.empty())
                senders.push_back(rank);
            if (std::any_of(n.inbox.begin(), n.inbox.end(), [&](const Packet& p) { return p.epoch == n.epoch; }))
                consumers.push_back(rank);
        }
        enum { Send, Data, Control, Consume };
        const bool can[] = {!senders.empty(), !data_.empty(), !control_.empty(), !consumers.empty()};
        const unsigned weights[] = {habits_.send, habits_.deliverData, habits_.deliverControl, habits_.consume};
        unsigned total = 0, possible = 0;
        for (int i = 0; i < 4; ++i)
            total += can[i] ? weights[i] : 0, possible += can[i];
        if (possible == 0)
            return false;
        std::uint64_t draw = random_() % (total > 0 ? total : possible);
        int what = 0;
        for (;; ++what) {
            const unsigned weight = !can[what] ? 0 : total > 0 ? weights[what] : 1;
            if (draw < weight)
                break;
            draw -= weight;
        }
        if (what == Send)
            send(senders[random_() % senders.size()]);
        else if (what == Data)
            deliver(take(data_, habits_.deliverOrder));
        else if (what == Control)
            deliver(take(control_, habits_.deliverOrder));
        else
            consume(consumers[random_() % consumers.size()]);
        return true;
    }

    void send(int rank)
    {
        Node& n = node(rank);
        const Planned next = n.plan.front();
        n.plan.pop_front();
        Buffer message = memory_->acquire(next.bytes);
        const std::uint64_t number = ++numbers_;
        std::memcpy(message.data(), &number, std::min(sizeof number, message.size()));
        n.flow->send(next.to, std::move(message));
    }

    void deliver(const Packet& p)
    {
        Node& n = node(p.to);
        if (p.bytes > 0) {
            n.flow->arrived(p.bytes);
            if (p.epoch < n.epoch)
                discard(p.to, p);
            else
                n.inbox.push_back(p);
        } else if (p.epoch > n.epoch) {
            n.early.push_back(p);
        } else if (p.epoch == n.epoch) {
            handleControl(p);
        }
    }

    void handleControl(const Packet& p)
    {
        if (p.isRequest)
            node(p.to).flow->requested(p.from, p.request);
        else
            node(p.to).flow->credited(p.from, p.credit);
    }

    void discard(int rank, const Packet& p)
    {
        outstanding(rank) -= p.bytes;
        node(rank).flow->discarded(p.bytes);
    }

    void consume(int rank)
    {
        Node& n = node(rank);
        std::vector<Packet> mine, other;
        for (const Packet& p : n.inbox)
            (p.epoch == n.epoch ? mine : other).push_back(p);
        const Packet p = take(mine, habits_.consumeOrder);
        mine.insert(mine.end(), other.begin(), other.end());
        n.inbox = std::move(mine);
        outstanding(rank) -= p.bytes;
        ++consumed;
        consumedNumbers.push_back(p.number);
        n.flow->consumed(p.from, p.bytes);
    }

    Habits habits_;
    std::mt19937_64 random_;
    std::shared_ptr<dfb::MemoryPool> memory_ = dfb::MemoryPool::create();
    std::vector<std::unique_ptr<Node>> nodes_;
    std::vector<Packet> data_, control_; // under way
    std::vector<std::size_t> outstanding_;
    std::size_t mostOutstanding_ = 0;
    std::uint64_t numbers_ = 0;
};

// A configuration that follows from a seed.
struct Case {
    int ranks;
    std::size_t largest, pool;
    Habits habits;
    int messages; // of each rank
    bool toOne;   // all to rank 0, otherwise to any rank
    enum class Sizes { Any, Largest, MostlySmall } sizes;
};

Case caseOf(std::uint64_t seed)
{
    std::mt19937_64 random(seed);
    const auto pick = [&](std::uint64_t n) { return static_cast<std::size_t>(random() % n); };
    Case c{};
    const int ranks[] = {2, 3, 4, 5, 8, 13, 64};
    c.ranks = ranks[pick(7)];
    const std::size_t largest[] = {1, 2, 7, 30, 256};
    c.largest = largest[pick(5)];
    const std::size_t factor[] = {4, 4, 5, 16, 300};
    c.pool = c.largest * factor[pick(5)] + pick(3);
    c.habits.send = pick(2) ? 1 : 100;
    c.habits.deliverData = pick(4) ? 10 : 0;
    c.habits.deliverControl = pick(4) ? 10 : 0;
    c.habits.consume = pick(3) ? 10 : pick(2); // at the extreme, only when nothing else is possible
    c.habits.consumeOrder = static_cast<Habits::Order>(pick(3));
    c.habits.deliverOrder = static_cast<Habits::Order>(pick(3));
    c.messages = c.ranks > 13 ? 4 : 3 + static_cast<int>(pick(60));
    c.toOne = pick(2) == 0;
    c.sizes = static_cast<Case::Sizes>(pick(3));
    return c;
}

// Plans the messages of a case and returns their number.
std::int64_t planFor(Network& network, const Case& c, std::uint64_t seed)
{
    std::mt19937_64 random(seed * 977 + 1);
    std::int64_t count = 0;
    for (int rank = 0; rank < c.ranks; ++rank)
        for (int i = 0; i < c.messages; ++i) {
            int to = c.toOne ? 0 : static_cast<int>(random() % static_cast<std::uint64_t>(c.ranks));
            if (to == rank)
                continue;
            const std::size_t bytes = c.sizes == Case::Sizes::Largest ? c.largest
                                      : c.sizes == Case::Sizes::Any || random() % 10 == 0
                                          ? 1 + random() % c.largest
                                          : 1 + random() % (c.largest / 8 + 1);
            network.plan(rank, to, std::min(bytes, c.largest));
            ++count;
        }
    return count;
}

std::string describe(const Case& c, std::uint64_t seed)
{
    return "seed " + std::to_string(seed) + ": " + std::to_string(c.ranks) + " ranks, largest "
           + std::to_string(c.largest) + ", pool " + std::to_string(c.pool) + (c.toOne ? ", all to one" : "");
}

// Checks the figures of all ranks when everything is over. Returns "" if they are right.
std::string wrongAtRest(Network& network, std::size_t pool)
{
    for (int rank = 0; rank < network.size(); ++rank) {
        if (network.flow(rank).underWay() > idleBound(network.size(), pool))
            return "rank " + std::to_string(rank) + " still has " + std::to_string(network.flow(rank).underWay())
                   + " bytes under way";
        if (network.flow(rank).peakInboxBytes() > pool)
            return "the inbox of rank " + std::to_string(rank) + " held more than the pool";
    }
    return {};
}

// As wrongAtRest(), after a case in which `count` messages were sent, none was lost and no epoch failed.
std::string wrongWithoutLoss(Network& network, const Case& c, std::int64_t count, std::uint64_t seed)
{
    std::string wrong;
    if (network.consumed != count)
        wrong = "only " + std::to_string(network.consumed) + " of " + std::to_string(count) + " messages arrived";
    else if (network.mostOutstanding() > c.pool)
        wrong = std::to_string(network.mostOutstanding()) + " bytes on the way or in the inbox";
    else
        wrong = wrongAtRest(network, c.pool);
    return wrong.empty() ? wrong : wrong + ", " + describe(c, seed);
}

struct Link {
    std::vector<std::size_t> transmitted;
    std::vector<FlowControl::Request> requests;
    std::vector<FlowControl::Credit> credits;
    std::unique_ptr<FlowControl> flow;

    Link(int ranks, std::size_t pool)
        : flow(std::make_unique<FlowControl>(
            ranks, pool,
            FlowControl::Callbacks{[this](int, Buffer&& m) { transmitted.push_back(m.size()); },
                                   [this](int, const FlowControl::Request& r) { requests.push_back(r); },
                                   [this](int, const FlowControl::Credit& c) { credits.push_back(c); }}))
    {
    }
    void send(std::size_t bytes) { flow->send(1, memory->acquire(bytes)); }
    std::shared_ptr<dfb::MemoryPool> memory = dfb::MemoryPool::create();
};

} // namespace

TEST_CASE("Whatever the order of delivery and consumption, all arrives and no pool overflows", "[flow]")
{
    std::string wrong, where;
    std::int64_t asked = 0;
    double most = 0; // other messages for each with data
    for (std::uint64_t seed = 1; seed <= 3000 && wrong.empty(); ++seed) {
        const Case c = caseOf(seed);
        Network network(c.ranks, c.pool, seed, c.habits);
        const std::int64_t count = planFor(network, c, seed);
        network.run();
        asked += network.requestsSent;
        wrong = wrongWithoutLoss(network, c, count, seed);
        const double perMessage = static_cast<double>(network.requestsSent + network.creditsSent)
                                  / static_cast<double>(std::max<std::int64_t>(network.dataSent, 1));
        if (perMessage > most) {
            most = perMessage;
            where = describe(c, seed);
        }
    }
    INFO(wrong << "\n" << most << " in " << where);
    CHECK(wrong.empty());
    CHECK(asked > 10000); // the cases are tight
    CHECK(most <= 3);     // a request for each, a Credit for the request and one for the consumption
}

TEST_CASE("One message after the other from each of many senders, with no part of the pool of their own", "[flow]")
{
    for (const int ranks : {2, 9, 64})
        for (const auto order : {Habits::Order::OldestFirst, Habits::Order::NewestFirst, Habits::Order::Any}) {
            Habits habits;
            habits.deliverOrder = habits.consumeOrder = order;
            Network network(ranks, 4, 5, habits);
            for (int rank = 1; rank < ranks; ++rank)
                for (int i = 0; i < 20; ++i)
                    network.plan(rank, 0, 1);
            network.run();
            INFO(ranks << " ranks, order " << static_cast<int>(order));
            CHECK(network.consumed == 20 * (ranks - 1));
            CHECK(network.mostOutstanding() <= 4);
            for (int rank = 0; rank < ranks && ranks > 3; ++rank)
                CHECK(network.flow(rank).underWay() == 0); // every consumption is reported
        }
}

TEST_CASE("Epochs that end well follow each other, begun by each rank at its own time", "[flow]")
{
    // One rank may begin the next epoch before others do. Both epochs together stay below the pool.
    std::string wrong;
    for (std::uint64_t seed = 1; seed <= 400 && wrong.empty(); ++seed) {
        const Case c = caseOf(seed);
        Network network(c.ranks, c.pool, seed, c.habits);
        std::mt19937_64 random(seed);
        std::int64_t count = planFor(network, c, seed);
        network.run();
        for (std::uint64_t epoch = 1; epoch < 4; ++epoch) {
            std::vector<int> order(static_cast<std::size_t>(c.ranks));
            for (int rank = 0; rank < c.ranks; ++rank)
                order[static_cast<std::size_t>(rank)] = rank;
            std::shuffle(order.begin(), order.end(), random);
            Network plans(c.ranks, c.pool, 0);
            for (int rank : order) {
                network.nextEpoch(rank);
                for (int i = 0; i < c.messages; ++i) {
                    const int to = c.toOne ? 0 : static_cast<int>(random() % static_cast<std::uint64_t>(c.ranks));
                    if (to == rank)
                        continue;
                    network.plan(rank, to, 1 + random() % c.largest);
                    ++count;
                }
                network.run(random() % 50);
            }
            network.run();
        }
        wrong = wrongWithoutLoss(network, c, count, seed);
    }
    INFO(wrong);
    CHECK(wrong.empty());
}

TEST_CASE("After an epoch that lost messages or was dropped the next one works like the first", "[flow]")
{
    std::string wrong;
    for (std::uint64_t seed = 1; seed <= 1000 && wrong.empty(); ++seed) {
        const Case c = caseOf(seed);
        Network network(c.ranks, c.pool, seed, c.habits);
        std::mt19937_64 random(seed);
        for (int epoch = 0; epoch < 3; ++epoch) {
            planFor(network, c, seed + static_cast<std::uint64_t>(epoch));
            for (int i = 0; i < 10; ++i) {
                network.run(random() % 20);
                network.loseOne();
            }
            const bool lose = random() % 2; // otherwise messages under way come after their epoch
            for (int rank = 0; rank < c.ranks; ++rank)
                if (random() % 2)
                    network.flow(rank).drop([](const dfb::Buffer&) { return false; }, random() % 2 == 0);
            network.run(random() % 20);
            if (lose)
                network.loseAll();
            for (int rank = 0; rank < c.ranks; ++rank) {
                network.nextEpoch(rank);
                if (network.flow(rank).underWay() != 0)
                    wrong = "under way in a new epoch";
            }
        }
        network.run(); // the last late ones
        for (int rank = 0; rank < c.ranks; ++rank)
            network.nextEpoch(rank);
        if (!network.idle())
            wrong = "something is left over";
        const std::int64_t before = network.consumed, count = planFor(network, c, seed);
        network.run();
        if (network.consumed - before != count)
            wrong = "only " + std::to_string(network.consumed - before) + " of " + std::to_string(count)
                    + " messages arrived";
        else if (wrong.empty())
            wrong = wrongAtRest(network, c.pool);
        if (!wrong.empty())
            wrong += ", " + describe(c, seed);
    }
    INFO(wrong);
    CHECK(wrong.empty());
}

TEST_CASE("With a large window there is little else than data", "[flow]")
{
    for (const int ranks : {2, 8, 64}) {
        const std::size_t pool = 1 << 16, bytes = 64;
        Habits prompt; // what is delivered is consumed before more is sent
        prompt.send = 0;
        Network network(ranks, pool, 3, prompt);
        const int messages = ranks == 2 ? 5000 : 500;
        for (int rank = 1; rank < ranks; ++rank)
            for (int i = 0; i < messages; ++i)
                network.plan(rank, 0, bytes);
        network.run();
        // Each Credit is for at least half of a sender's part.
        const std::size_t perSender = bytes * static_cast<std::size_t>(messages) / (allowanceOf(ranks, pool) / 2);
        INFO(ranks << " ranks: " << network.dataSent << " messages, " << network.requestsSent << " requests, "
                   << network.creditsSent << " credits");
        CHECK(network.consumed == network.dataSent);
        CHECK(network.dataSent == static_cast<std::int64_t>(messages) * (ranks - 1));
        CHECK(network.requestsSent == 0);
        CHECK(network.creditsSent <= static_cast<std::int64_t>(perSender) * (ranks - 1));
        CHECK(network.creditsSent > 0);
    }
}

TEST_CASE("What a sender has without asking, and what it asks for", "[flow]")
{
    Link link(2, 400); // a part of 200, 200 on request; a quarter is 100
    for (int i = 0; i < 4; ++i)
        link.send(50);
    CHECK(link.transmitted.size() == 4);
    CHECK(link.requests.empty());
    link.send(60);
    REQUIRE(link.requests.size() == 1);
    CHECK(link.requests[0].first == 260);
    CHECK(link.requests[0].all == 260);
    link.send(1); // small as it is, it does not overtake, and is not asked for twice
    link.send(30);
    link.send(30);
    CHECK(link.transmitted.size() == 4);
    CHECK(link.requests.size() == 1);
    CHECK(link.flow->underWay() == 321);
    link.flow->credited(1, {260, 50});
    CHECK(link.transmitted == std::vector<std::size_t>{50, 50, 50, 50, 60});
    CHECK(link.flow->underWay() == 271);
    REQUIRE(link.requests.size() == 2);
    CHECK(link.requests[1].first == 261);
    CHECK(link.requests[1].all == 321); // all that waits is below a quarter of the pool
    link.flow->credited(1, {321, 260});
    CHECK(link.transmitted.size() == 8);
    CHECK(link.requests.size() == 2);
    CHECK(link.flow->underWay() == 61);
    link.flow->credited(1, {321, 321});
    CHECK(link.flow->underWay() == 0);
}

TEST_CASE("A request is for a quarter of the pool at most, but for one message at least", "[flow]")
{
    Link link(2, 400);
    for (const std::size_t bytes : {100, 100, 70, 30, 30, 60})
        link.send(bytes);
    REQUIRE(link.requests.size() == 1);
    CHECK((link.requests[0].first == 270 && link.requests[0].all == 270));
    link.flow->credited(1, {270, 0});
    CHECK(link.transmitted.size() == 3);
    REQUIRE(link.requests.size() == 2);
    CHECK((link.requests[1].first == 300 && link.requests[1].all == 330)); // the 60 would make it 120
}

TEST_CASE("A request that is not met yet is not repeated", "[flow]")
{
    Link link(2, 400);
    for (const std::size_t bytes : {100, 100, 70})
        link.send(bytes);
    CHECK(link.requests.size() == 1);
    for (const std::uint64_t consumed : {10u, 20u, 30u})
        link.flow->credited(1, {200 + consumed, consumed}); // not enough
    CHECK(link.transmitted.size() == 2);
    CHECK(link.requests.size() == 1);
    link.flow->credited(1, {270, 100});
    CHECK(link.transmitted.size() == 3);
    CHECK(link.requests.size() == 1);
}

TEST_CASE("A request that a later one has overtaken changes nothing", "[flow]")
{
    std::vector<std::uint64_t> granted;
    // A part of 50 each, and 200 on request.
    FlowControl flow(5, 400,
                     {[](int, Buffer&&) {}, [](int, const FlowControl::Request&) {},
                      [&](int, const FlowControl::Credit& credit) { granted.push_back(credit.granted); }});
    flow.requested(1, {150, 250}); // all of it
    flow.requested(2, {90, 90});
    CHECK(granted == std::vector<std::uint64_t>{250});
    flow.requested(2, {60, 60}); // of before
    for (int i = 0; i < 5; ++i) {
        flow.arrived(50);
        flow.consumed(1, 50);
    }
    CHECK(std::count(granted.begin(), granted.end(), 90u) == 1);
}

TEST_CASE("Credits that overtake each other, come twice or say nonsense", "[flow]")
{
    Link link(2, 400);
    for (int i = 0; i < 10; ++i)
        link.send(50);
    CHECK(link.transmitted.size() == 4);
    link.flow->credited(1, {400, 200});
    CHECK(link.transmitted.size() == 8);
    CHECK(link.flow->underWay() == 300);
    link.flow->credited(1, {300, 100}); // an older one
    link.flow->credited(1, {400, 200}); // again
    CHECK(link.transmitted.size() == 8);
    CHECK(link.flow->underWay() == 300);
    CHECK_THROWS_AS(link.flow->credited(1, {600, 401}), dfb::Error); // more than was ever sent
    CHECK(link.transmitted.size() == 8);
    CHECK(link.flow->underWay() == 300);
    link.flow->credited(1, {500, 400});
    CHECK(link.transmitted.size() == 10);
    CHECK(link.flow->underWay() == 100);
    link.flow->credited(1, {500, 500});
    CHECK(link.flow->underWay() == 0);
}

TEST_CASE("More than a pool is neither granted nor asked for", "[flow]")
{
    Link link(2, 400);
    for (int i = 0; i < 10; ++i)
        link.send(50);
    CHECK_THROWS_AS(link.flow->credited(1, {601, 200}), dfb::Error);
    CHECK(link.transmitted.size() == 4);
    CHECK_NOTHROW(link.flow->credited(1, {600, 200}));
    const std::uint64_t most = ~std::uint64_t{0};
    CHECK_THROWS_AS(link.flow->requested(1, {most, most}), dfb::Error);
    CHECK_THROWS_AS(link.flow->requested(1, {300, 299}), dfb::Error);
    // A request for a message that cannot exist.
    CHECK_THROWS_AS(link.flow->requested(1, {301, 301}), dfb::Error);
    link.flow->requested(1, {300, 350}); // and nobody waits behind them
    REQUIRE(link.credits.size() == 1);
    CHECK(link.credits[0].granted == 350);
}

TEST_CASE("drop() forgets what waits, or what nobody has asked for, and keeps nothing more; a new epoch does", "[flow]")
{
    Link all(2, 400), link(2, 400);
    for (int i = 0; i < 10; ++i) {
        all.send(50);
        link.send(50);
    }
    CHECK(link.flow->underWay() == 500);
    all.flow->drop([](const dfb::Buffer&) { return false; }, false);
    CHECK(all.flow->underWay() == 200); // what is under way
    CHECK(all.flow->allSent());
    link.flow->drop([](const dfb::Buffer&) { return false; }, true);
    CHECK_FALSE(link.flow->allSent());
    // The messages under way, and the one whose credit the receiver will reserve. If that credit stayed unused, others
    // would get none.
    CHECK(link.flow->underWay() == 250);
    link.send(50);
    CHECK(link.transmitted.size() == 4);
    CHECK(link.flow->underWay() == 250);
    link.flow->credited(1, {600, 200});
    CHECK(link.transmitted.size() == 5);
    CHECK(link.flow->underWay() == 50);
    link.flow->newEpoch();
    CHECK(link.flow->underWay() == 0);
    for (int i = 0; i < 5; ++i)
        link.send(50);
    CHECK(link.transmitted.size() == 9); // the own part again, not the 600 bytes of the last epoch
    CHECK(link.flow->underWay() == 250);
}

TEST_CASE("A message counts as sent when the callback has it, not when it leaves the queue", "[flow]")
{
    std::unique_ptr<FlowControl> flow;
    std::vector<bool> allSent; // as the callback sees it for each message
    flow = std::make_unique<FlowControl>(
        2, 400,
        FlowControl::Callbacks{[&](int, Buffer&&) { allSent.push_back(flow->allSent()); },
                               [](int, const FlowControl::Request&) {}, [](int, const FlowControl::Credit&) {}});
    const auto memory = dfb::MemoryPool::create();
    for (int i = 0; i < 5; ++i)
        flow->send(1, memory->acquire(50));
    CHECK_FALSE(flow->allSent()); // there is credit for four
    flow->credited(1, {400, 200});
    CHECK(allSent == std::vector<bool>(5, false));
    CHECK(flow->allSent());
}

TEST_CASE("A receiver answers in the order of asking, the whole or the first message, never more than it has", "[flow]")
{
    struct Told {
        int source;
        std::uint64_t granted;
    };
    std::vector<Told> told;
    // 4 senders with a part of 50 each, and 200 on request.
    FlowControl flow(5, 400,
                     {[](int, Buffer&&) {}, [](int, const FlowControl::Request&) {},
                      [&](int source, const FlowControl::Credit& credit) {
                          told.push_back({source, credit.granted});
                      }});
    const auto last = [&] { return told.empty() ? Told{-1, 0} : told.back(); };
    flow.requested(1, {100, 100});
    CHECK((told.size() == 1 && last().source == 1 && last().granted == 100));
    flow.requested(2, {80, 150});
    CHECK((told.size() == 2 && last().source == 2 && last().granted == 150));
    flow.requested(3, {100, 150}); // 50 are left: only the first
    CHECK((told.size() == 3 && last().source == 3 && last().granted == 100));
    flow.requested(4, {51, 51}); // none is left
    flow.requested(1, {101, 101});
    CHECK(told.size() == 3);
    // What comes back goes to the first in the queue, though the other request would fit as well.
    flow.arrived(30);
    flow.consumed(3, 30);
    REQUIRE(told.size() >= 4);
    bool fourFirst = false;
    for (std::size_t i = 3; i < told.size() && !fourFirst; ++i) {
        if (told[i].source == 1)
            break;
        fourFirst = told[i].source == 4 && told[i].granted == 51;
    }
    CHECK(fourFirst);
    CHECK((last().source == 1 && last().granted == 101));
    CHECK(flow.peakInboxBytes() == 30);
}

} // namespace flow_control_cases
