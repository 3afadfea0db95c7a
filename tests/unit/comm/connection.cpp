// SequenceWindow and Connection, over a transport that the test simulates: numbers, checksums, addresses, failures.
#include "catch.hpp"

#include <dfb/comm/connection.hpp>

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <memory>
#include <mutex>
#include <numeric>
#include <random>
#include <set>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace connection_cases {

namespace {

using dfb::Buffer;
using dfb::detail::MessageHeader;
using dfb::detail::MessageKind;
using dfb::detail::SequenceWindow;

// The messages that a rank's transport has sent, and its handler, to hand it messages.
struct Wire {
    int rank = 0, size = 1;
    dfb::TransportHandler* handler = nullptr;
    std::mutex mutex;
    std::vector<std::pair<int, Buffer>> sent; // under mutex
    std::vector<bool> stops;                  // stop(orderly)
};

class PlayedTransport {
public:
    using Communicator = std::shared_ptr<Wire>;

    PlayedTransport(const Communicator& wire, std::shared_ptr<dfb::MemoryPool>, dfb::Progress) : wire_(wire) {}
    int rank() const { return wire_->rank; }
    int size() const { return wire_->size; }
    bool needsPolling() const { return false; }
    bool mayPoll() const { return true; }
    bool quiet() const { return true; }
    void nap(std::chrono::nanoseconds) {}
    void interrupt() {}
    void start(dfb::TransportHandler& handler) { wire_->handler = &handler; }
    void send(int destination, Buffer&& message)
    {
        const std::lock_guard<std::mutex> lock(wire_->mutex);
        wire_->sent.emplace_back(destination, std::move(message));
    }
    bool poll() { return false; }
    void stop(bool orderly) { wire_->stops.push_back(orderly); }

private:
    std::shared_ptr<Wire> wire_;
};
using dfb::connect;

struct Receiver : dfb::detail::MessageReceiver {
    struct Got {
        int source;
        std::int64_t number;
        std::string text;
    };
    std::vector<Got> got;
    std::vector<int> malformedFrom;
    int failures = 0;

    void receive(int source, const MessageHeader& header, Buffer&& message) override
    {
        got.push_back({source, header.number,
                       std::string(reinterpret_cast<const char*>(message.data()) + sizeof header,
                                   message.size() - sizeof header)});
    }
    void malformed(const dfb::ErrorInfo& error) override
    {
        CHECK(error.kind == dfb::ErrorKind::MalformedMessage);
        malformedFrom.push_back(error.from);
    }
    void connectionFailed() override { ++failures; }
};

std::shared_ptr<Wire> wireOf(int rank, int size)
{
    auto wire = std::make_shared<Wire>();
    wire->rank = rank, wire->size = size;
    return wire;
}

Buffer messageOf(dfb::MemoryPool& pool, std::uint32_t receiver, std::int64_t number, const std::string& text = "abc")
{
    MessageHeader header;
    header.receiver = receiver;
    header.number = number;
    const auto* first = reinterpret_cast<const std::byte*>(text.data());
    return dfb::detail::makeMessage(pool, header, {first, first + text.size()});
}

Buffer copyOf(dfb::MemoryPool& pool, const Buffer& message)
{
    Buffer copy = pool.acquire(message.size());
    std::memcpy(copy.data(), message.data(), message.size());
    return copy;
}

MessageHeader headerOf(const Buffer& message) { return dfb::detail::loadAs<MessageHeader>(message.data()); }

// Delivers the messages of `from` that are for `to`.
void carry(Wire& from, Wire& to)
{
    for (auto& [destination, message] : std::exchange(from.sent, {}))
        if (destination == to.rank)
            to.handler->receive(from.rank, std::move(message));
}

} // namespace

TEST_CASE("Each number is new once, in whatever order", "[connection]")
{
    std::vector<std::uint32_t> order{0, 1, 2, 3, 4, 5, 6};
    do {
        SequenceWindow window;
        std::set<std::uint32_t> seen;
        bool right = true;
        for (std::uint32_t n : order) {
            right = right && window.arrive(n);
            seen.insert(n);
            for (std::uint32_t old : seen)
                right = right && !window.arrive(old);
            right = right && window.missing() == *seen.rbegin() + 1 - seen.size();
        }
        INFO("order " << order[0] << order[1] << order[2] << order[3] << order[4] << order[5] << order[6]);
        REQUIRE((right && window.missing() == 0));
    } while (std::next_permutation(order.begin(), order.end()));
}

TEST_CASE("Numbers that come in any order, twice or never", "[connection]")
{
    for (std::uint64_t seed = 0; seed < 50; ++seed) {
        std::mt19937_64 random(seed);
        std::vector<std::uint32_t> numbers(2000);
        std::iota(numbers.begin(), numbers.end(), 0u);
        std::set<std::uint32_t> lost;
        for (int i = 0; i < 20; ++i)
            lost.insert(static_cast<std::uint32_t>(random() % 1990));
        numbers.erase(std::remove_if(numbers.begin(), numbers.end(), [&](auto n) { return lost.count(n) > 0; }),
                      numbers.end());
        const std::size_t once = numbers.size();
        for (int i = 0; i < 500; ++i)
            numbers.push_back(numbers[random() % once]);
        std::shuffle(numbers.begin(), numbers.end(), random);
        SequenceWindow window;
        std::size_t fresh = 0, duplicates = 0;
        for (std::uint32_t n : numbers) {
            const bool isNew = window.arrive(n);
            fresh += isNew;
            duplicates += !isNew;
        }
        CHECK(fresh == once);
        CHECK(duplicates == 500);
        CHECK(window.missing() == lost.size());
    }
}

TEST_CASE("A number far from the others is refused and changes nothing", "[connection]")
{
    SequenceWindow window;
    CHECK(window.arrive(0));
    CHECK_THROWS_AS(window.arrive((1u << 20) + 2), dfb::Error); // one more than may be missing
    CHECK_THROWS_AS(window.arrive(0x7fffffffu), dfb::Error);
    CHECK(window.missing() == 0);
    CHECK_FALSE(window.arrive(0x80000000u + 1)); // behind the window: never missing, so not new
    CHECK_FALSE(window.arrive(0xffffffffu));
    CHECK(window.arrive(1));
    CHECK(window.missing() == 0);
    CHECK(window.arrive((1u << 20) + 2)); // now it is as far as can be
    CHECK(window.missing() == 1u << 20);
    CHECK(window.arrive(2));
    CHECK_FALSE(window.arrive(2));
    CHECK(window.missing() == (1u << 20) - 1);
    CHECK_THROWS_AS(window.arrive((1u << 20) + 5), dfb::Error); // too many would be missing in all
    CHECK(window.arrive((1u << 20) + 4));
    CHECK(window.missing() == 1u << 20);
}

TEST_CASE("Numbers run per destination, from 0, from any thread; checksums are there if they are wanted",
          "[connection]")
{
    for (const bool checksums : {false, true}) {
        const auto wire = wireOf(1, 3);
        {
            const auto connection = connect<PlayedTransport>(wire, {dfb::Progress::Thread, checksums});
            std::vector<std::thread> threads;
            for (int t = 0; t < 4; ++t)
                threads.emplace_back([&, t] {
                    for (int i = 0; i < 100; ++i)
                        connection->send(2 * (i % 2), messageOf(*connection->pool(), 0, t));
                });
            for (std::thread& t : threads)
                t.join();
        }
        std::set<std::pair<int, std::uint32_t>> numbers;
        for (const auto& [destination, message] : wire->sent) {
            numbers.insert({destination, headerOf(message).sequence});
            CHECK((headerOf(message).checksum != 0) == checksums);
        }
        CHECK(numbers.size() == 400);
        CHECK(numbers.count({0, 0}) == 1);
        CHECK(numbers.count({0, 199}) == 1);
        CHECK(numbers.count({2, 199}) == 1);
        CHECK(wire->stops == std::vector<bool>{true});
    }
}

TEST_CASE("Messages that come twice are dropped and counted, whatever they are for", "[connection]")
{
    const auto a = wireOf(0, 2), b = wireOf(1, 2);
    const auto sender = connect<PlayedTransport>(a), connection = connect<PlayedTransport>(b);
    Receiver receiver;
    std::uint32_t address = 9;
    connection->attach(receiver, address);
    REQUIRE(address == 0);
    for (int i = 0; i < 10; ++i)
        sender->send(1, messageOf(*sender->pool(), 0, i));
    for (auto& [destination, message] : a->sent)
        b->handler->receive(0, copyOf(*sender->pool(), message));
    CHECK(receiver.got.size() == 10);
    CHECK(connection->takeDuplicates() == 0);
    for (auto& [destination, message] : a->sent)
        b->handler->receive(0, copyOf(*sender->pool(), message));
    CHECK(receiver.got.size() == 10);
    CHECK(connection->takeDuplicates() == 10);
    // The same numbers from another rank are not duplicates.
    b->handler->receive(3, copyOf(*sender->pool(), a->sent[0].second));
    CHECK(receiver.got.size() == 11);
    CHECK(connection->takeDuplicates() == 0);
    CHECK(receiver.malformedFrom.empty());
}

TEST_CASE("Messages for an object that is not there yet wait for it; for one that is gone they are dropped",
          "[connection]")
{
    const auto a = wireOf(0, 2), b = wireOf(1, 2);
    const auto sender = connect<PlayedTransport>(a), connection = connect<PlayedTransport>(b);
    for (std::uint32_t to : {1u, 0u, 1u, 2u})
        sender->send(1, messageOf(*sender->pool(), to, to, "early"));
    carry(*a, *b);
    Receiver first, second, third;
    std::uint32_t one = 9, two = 9, three = 9;
    connection->attach(first, one);
    CHECK(one == 0);
    CHECK(first.got.size() == 1);
    connection->attach(second, two);
    CHECK(two == 1);
    CHECK(second.got.size() == 2);
    CHECK((!second.got.empty() && second.got[0].text == "early" && second.got[0].number == 1));
    connection->detach(one);
    sender->send(1, messageOf(*sender->pool(), 0, 7));
    sender->send(1, messageOf(*sender->pool(), 1, 7));
    carry(*a, *b);
    CHECK(first.got.size() == 1);
    CHECK(second.got.size() == 3);
    connection->attach(third, three); // addresses are not used again
    CHECK(three == 2);
    CHECK(third.got.size() == 1);
    connection->detach(two);
    connection->detach(three);
}

TEST_CASE("With checksums, no single bit, no byte and no length can be changed unnoticed", "[connection]")
{
    const auto a = wireOf(0, 2), b = wireOf(1, 2);
    const auto sender = connect<PlayedTransport>(a, {dfb::Progress::Thread, true}),
               connection = connect<PlayedTransport>(b, {dfb::Progress::Thread, true});
    Receiver first, second;
    std::uint32_t address = 0;
    connection->attach(first, address);
    connection->attach(second, address);
    sender->send(1, messageOf(*sender->pool(), 1, 5, "Sorting is for mail, not for pixels."));
    const Buffer good = std::move(a->sent[0].second);
    const auto deliver = [&](Buffer&& message) { b->handler->receive(0, std::move(message)); };
    std::size_t tries = 0;
    for (std::size_t i = 0; i < good.size(); ++i)
        for (int bit = 0; bit < 9; ++bit) { // the 9th: all of the byte
            Buffer bad = copyOf(*sender->pool(), good);
            bad.data()[i] ^= static_cast<std::byte>(bit < 8 ? 1 << bit : 0xff);
            deliver(std::move(bad));
            ++tries;
        }
    for (std::size_t length = 0; length < good.size(); ++length) {
        Buffer bad = copyOf(*sender->pool(), good);
        bad.shrink(length);
        deliver(std::move(bad));
        ++tries;
    }
    CHECK(first.got.empty());
    CHECK(second.got.empty());
    // The damaged message may have been for either receiver.
    CHECK(first.malformedFrom.size() == tries);
    CHECK(second.malformedFrom == std::vector<int>(tries, 0));
    CHECK(connection->takeDuplicates() == 0);
    // Messages that were refused do not count as received.
    deliver(copyOf(*sender->pool(), good));
    CHECK(second.got.size() == 1);
    CHECK(connection->lost().empty());
    connection->detach(0);
    connection->detach(1);
}

TEST_CASE("Where checksums are wanted an input without one is refused", "[connection]")
{
    const auto a = wireOf(0, 2), b = wireOf(1, 2);
    const auto sender = connect<PlayedTransport>(a),
               connection = connect<PlayedTransport>(b, {dfb::Progress::Thread, true});
    Receiver receiver;
    std::uint32_t address = 0;
    connection->attach(receiver, address);
    sender->send(1, messageOf(*sender->pool(), 0, 5));
    carry(*a, *b);
    CHECK(receiver.got.empty());
    CHECK(receiver.malformedFrom.size() == 1);
    connection->detach(address);
}

TEST_CASE("By which messages ranks find out that only one of them uses checksums", "[connection]")
{
    using Kind = dfb::detail::MessageKind;
    for (const bool uses : {false, true})
        for (const bool isAlike : {false, true})
            for (const Kind kind : {Kind::ReduceUp, Kind::ReduceDown, Kind::Fragment, Kind::Manifest, Kind::Abort}) {
                const auto a = wireOf(0, 2), b = wireOf(1, 2);
                const auto sender = connect<PlayedTransport>(a, {dfb::Progress::Thread, !uses}),
                           connection = connect<PlayedTransport>(b, {dfb::Progress::Thread, uses});
                if (isAlike)
                    connection->setAlike();
                Receiver receiver;
                std::uint32_t address = 0;
                connection->attach(receiver, address);
                dfb::Buffer message = messageOf(*sender->pool(), 0, 5);
                auto header = headerOf(message);
                header.kind = kind;
                std::memcpy(message.data(), &header, sizeof header);
                sender->send(1, std::move(message));
                carry(*a, *b);
                INFO((uses ? "the receiver" : "the sender") << " uses checksums, kind " << static_cast<int>(kind));
                const bool isTaken = !isAlike && (kind == Kind::ReduceUp || kind == Kind::ReduceDown);
                CHECK(receiver.got.size() == (isTaken ? 1u : 0u));
                CHECK(receiver.malformedFrom.size() == (isTaken ? 0u : 1u));
                connection->detach(address);
            }
}

TEST_CASE("What is lost is said in words, by rank", "[connection]")
{
    const auto a = wireOf(0, 4), b = wireOf(1, 4);
    const auto sender = connect<PlayedTransport>(a), connection = connect<PlayedTransport>(b);
    Receiver receiver;
    std::uint32_t address = 0;
    connection->attach(receiver, address);
    for (int i = 0; i < 6; ++i)
        sender->send(1, messageOf(*sender->pool(), 0, i));
    for (const std::size_t i : {5u, 1u, 2u})
        b->handler->receive(3, copyOf(*sender->pool(), a->sent[i].second));
    b->handler->receive(2, copyOf(*sender->pool(), a->sent[1].second));
    b->handler->receive(0, copyOf(*sender->pool(), a->sent[0].second));
    CHECK(connection->lost() == "messages on the way or lost: 1 from rank 2, 3 from rank 3");
    connection->detach(address);
}

TEST_CASE("Who gives up says so to all others, once, and they cannot go on either", "[connection]")
{
    const auto a = wireOf(0, 3), b = wireOf(1, 3);
    {
        const auto quitter = connect<PlayedTransport>(a), other = connect<PlayedTransport>(b);
        Receiver ofQuitter, ofOther;
        std::uint32_t address = 0;
        quitter->attach(ofQuitter, address);
        other->attach(ofOther, address);
        CHECK_FALSE(other->failed());
        CHECK_NOTHROW(other->throwIfFailed());
        dfb::ErrorInfo info;
        info.kind = dfb::ErrorKind::Transport;
        info.rank = 0;
        info.message = "the moon is full";
        quitter->giveUp(info);
        quitter->giveUp(info);
        CHECK(a->sent.size() == 2);
        CHECK(quitter->failed());
        CHECK(ofQuitter.failures == 1);
        carry(*a, *b);
        CHECK(other->failed());
        CHECK(ofOther.failures == 1);
        CHECK(ofOther.got.empty());
        std::string text;
        try {
            other->throwIfFailed();
        } catch (const dfb::TransportError& e) {
            text = e.what();
        }
        INFO(text);
        CHECK(text.find("rank 0") != std::string::npos);
        CHECK(text.find("the moon is full") != std::string::npos);
        CHECK(b->sent.empty()); // a rank that is told does not tell others
        quitter->detach(address);
        other->detach(address);
    }
    CHECK(a->stops == std::vector<bool>{false}); // waits for nobody
    CHECK(b->stops == std::vector<bool>{false});
}

} // namespace connection_cases
