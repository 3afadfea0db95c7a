// FaultTransport: its faults follow from the seed, and its counts are right. Ranks are threads.
#include "catch.hpp"

#include <dfb/comm/inproc_transport.hpp>
#include <dfb/testing/fault_transport.hpp>
#include <dfb/testing/transport_conformance.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <tuple>
#include <utility>
#include <vector>

namespace faults_cases {

using namespace dfb;
using testing::FaultDecision;
using testing::FaultOptions;
using Faulty = testing::FaultTransport<InprocTransport>;

namespace {

bool same(const FaultDecision& a, const FaultDecision& b)
{
    return std::tie(a.reorder, a.delay, a.duplicate, a.drop, a.corrupt, a.delayBy, a.copyDelayBy, a.overtakenBy,
                    a.random)
           == std::tie(b.reorder, b.delay, b.duplicate, b.drop, b.corrupt, b.delayBy, b.copyDelayBy, b.overtakenBy,
                       b.random);
}

// Keeps messages in the order in which they arrive.
struct Inbox final : TransportHandler {
    std::mutex mutex;
    std::vector<std::string> messages;

    void receive(int, Buffer&& message) override
    {
        const std::lock_guard<std::mutex> lock(mutex);
        messages.emplace_back(reinterpret_cast<const char*>(message.data()), message.size());
    }
    void fail(const ErrorInfo&) override {}
    bool failed() const override { return false; }
};

// The messages that rank 1 gets if rank 0 sends the numbers 0 to count-1, each as a text of 24 bytes.
struct Run {
    std::vector<std::string> received;
    std::shared_ptr<testing::FaultCounts> counts = std::make_shared<testing::FaultCounts>();
    bool neededPolls = false, quietAfterSend = false;
    std::uint64_t poolBytes = 0;
};

std::string textOf(int number)
{
    std::string text = std::to_string(number);
    return text + std::string(24 - text.size(), '.');
}

Run run(FaultOptions faults, int count, int threadCount = 1, bool orderly = true)
{
    Run result;
    faults.counts = result.counts;
    Inbox inbox;
    std::atomic<bool> receives{false}, done{false};
    const auto await = [](const std::atomic<bool>& flag) {
        while (!flag)
            std::this_thread::sleep_for(std::chrono::microseconds(100));
    };
    const auto receive = [&](const InprocCommunicator& communicator) {
        InprocTransport transport(communicator, MemoryPool::create(), Progress::Caller);
        transport.start(inbox);
        receives = true;
        await(done);
        transport.stop(true);
    };
    const auto send = [&](const InprocCommunicator& communicator) {
        await(receives);
        const auto pool = MemoryPool::create(), poolOfTransport = MemoryPool::create();
        Inbox own;
        Faulty transport({communicator, faults}, poolOfTransport, Progress::Caller);
        result.neededPolls = transport.needsPolling();
        transport.start(own);
        std::vector<std::thread> threads;
        for (int t = 0; t < threadCount; ++t)
            threads.emplace_back([&, t] {
                for (int number = t; number < count; number += threadCount) {
                    const std::string text = textOf(number);
                    Buffer message = pool->acquire(text.size());
                    std::memcpy(message.data(), text.data(), text.size());
                    transport.send(1, std::move(message));
                }
            });
        for (std::thread& thread : threads)
            thread.join();
        result.quietAfterSend = transport.quiet();
        transport.stop(orderly);
        result.poolBytes = poolOfTransport->peakBytes();
        done = true;
    };
    runRanks(2, [&](const InprocCommunicator& communicator) {
        communicator.rank() == 0 ? send(communicator) : receive(communicator);
    });
    result.received = std::move(inbox.messages);
    return result;
}

std::vector<std::string> sorted(std::vector<std::string> texts)
{
    std::sort(texts.begin(), texts.end());
    return texts;
}

std::vector<std::string> allOf(int count)
{
    std::vector<std::string> texts;
    texts.reserve(static_cast<std::size_t>(count));
    for (int number = 0; number < count; ++number)
        texts.push_back(textOf(number));
    return texts;
}

FaultOptions someOfAll()
{
    FaultOptions faults;
    faults.seed = 7;
    faults.reorder = 0.2;
    faults.delay = 0.1;
    faults.duplicate = 0.05;
    faults.drop = 0.1;
    faults.corrupt = 0.1;
    return faults;
}

} // namespace

TEST_CASE("A decision follows from seed, rank, destination and number alone")
{
    FaultOptions faults = someOfAll();
    faults.drop = faults.corrupt = faults.duplicate = faults.delay = faults.reorder = 0.5;
    std::map<std::string, int> differences;
    const int count = 1000;
    for (int i = 0; i < count; ++i) {
        const auto number = static_cast<std::uint64_t>(i);
        const FaultDecision decision = testing::decideFault(faults, 2, 3, number);
        REQUIRE(same(decision, testing::decideFault(faults, 2, 3, number)));
        CHECK(decision.delayBy < faults.maxDelay);
        CHECK(decision.overtakenBy >= 1);
        CHECK(decision.overtakenBy <= 4);
        FaultOptions other = faults;
        other.seed = 8;
        const auto compare = [&](const char* what, const FaultDecision& second) {
            differences[what] += decision.drop != second.drop;
        };
        compare("seed", testing::decideFault(other, 2, 3, number));
        compare("rank", testing::decideFault(faults, 3, 3, number));
        compare("destination", testing::decideFault(faults, 2, 2, number));
        compare("swapped", testing::decideFault(faults, 3, 2, number));
        compare("number", testing::decideFault(faults, 2, 3, number + 1));

        // Changing one probability does not change the other faults.
        other = faults;
        other.reorder = 0;
        FaultDecision without = testing::decideFault(other, 2, 3, number);
        without.reorder = decision.reorder;
        REQUIRE(same(without, decision));
    }
    for (const auto& [what, different] : differences) {
        CAPTURE(what);
        CHECK(different > count * 4 / 10);
        CHECK(different < count * 6 / 10);
    }
}

TEST_CASE("Faults come as often as asked for")
{
    const FaultOptions faults = someOfAll();
    const int count = 100000;
    int reorder = 0, delay = 0, duplicate = 0, drop = 0, corrupt = 0;
    for (int number = 0; number < count; ++number) {
        const FaultDecision decision = testing::decideFault(faults, 0, 1, static_cast<std::uint64_t>(number));
        reorder += decision.reorder;
        delay += decision.delay;
        duplicate += decision.duplicate;
        drop += decision.drop;
        corrupt += decision.corrupt;
    }
    for (const auto& [got, wanted] :
         {std::pair(reorder, faults.reorder), std::pair(delay, faults.delay), std::pair(duplicate, faults.duplicate),
          std::pair(drop, faults.drop), std::pair(corrupt, faults.corrupt)})
        CHECK(got == Approx(wanted * count).epsilon(0.05));
}

TEST_CASE("Without faults it does nothing")
{
    const Run plain = run({}, 1000);
    CHECK_FALSE(plain.neededPolls);
    CHECK(plain.quietAfterSend);
    CHECK(plain.poolBytes == 0);
    CHECK(plain.received == allOf(1000));
    CHECK(plain.counts->sent == 1000);
    for (const auto* counter : {&plain.counts->reordered, &plain.counts->delayed, &plain.counts->duplicated,
                                &plain.counts->dropped, &plain.counts->corrupted})
        CHECK(*counter == 0);
}

TEST_CASE("Late and out of order, all messages come")
{
    FaultOptions faults;
    faults.seed = 1;
    faults.reorder = 0.2;
    faults.delay = 0.2;
    const Run late = run(faults, 2000);
    CHECK(late.neededPolls);
    CHECK_FALSE(late.quietAfterSend);
    CHECK(late.received != allOf(2000));
    CHECK(sorted(late.received) == sorted(allOf(2000)));
}

TEST_CASE("A message that would be delayed and reordered counts as delayed")
{
    FaultOptions faults;
    faults.reorder = 1;
    faults.delay = 1;
    const Run late = run(faults, 100);
    CHECK(late.counts->delayed == 100);
    CHECK(late.counts->reordered == 0);
}

TEST_CASE("What is held is let go by an orderly stop, and dropped by another")
{
    FaultOptions faults;
    faults.delay = 1;
    faults.maxDelay = std::chrono::hours(1);
    CHECK(run(faults, 100).received.size() == 100);
    CHECK(run(faults, 100, 1, false).received.empty());
}

TEST_CASE("The same seed does the same, whatever threads do")
{
    const Run first = run(someOfAll(), 2000), second = run(someOfAll(), 2000);
    CHECK(sorted(first.received) == sorted(second.received));
    FaultOptions other = someOfAll();
    other.seed = 8;
    CHECK(sorted(run(other, 2000).received) != sorted(first.received));

    const Run threads = run(someOfAll(), 2000, 4); // other messages have the same numbers; the counts are equal
    CHECK(threads.received.size() == first.received.size());
    CHECK(threads.counts->reordered == first.counts->reordered);
    CHECK(threads.counts->delayed == first.counts->delayed);
    CHECK(threads.counts->duplicated == first.counts->duplicated);
    CHECK(threads.counts->dropped == first.counts->dropped);
    CHECK(threads.counts->corrupted == first.counts->corrupted);
}

TEST_CASE("The counts add up")
{
    const Run faulty = run(someOfAll(), 5000);
    const testing::FaultCounts& counts = *faulty.counts;
    CHECK(counts.sent == 5000);
    CHECK(faulty.received.size() == static_cast<std::size_t>(counts.sent - counts.dropped + counts.duplicated));

    std::map<std::string, int> received;
    for (const std::string& text : faulty.received)
        ++received[text];
    int intact = 0, twice = 0;
    for (const std::string& text : allOf(5000)) {
        intact += received[text] > 0;
        twice += received[text] == 2;
    }
    CHECK(intact == counts.sent - counts.dropped - counts.corrupted);
    CHECK(twice <= counts.duplicated); // some of the copies are of damaged messages
    CHECK(twice > counts.duplicated / 2);
}

TEST_CASE("At most so many are lost or damaged, and only those asked for")
{
    FaultOptions faults;
    faults.drop = 1;
    faults.maxLethal = 3;
    faults.only = [](int destination, const Buffer& message) {
        return destination == 1 && std::to_integer<char>(message.data()[0]) == '5';
    };
    const Run one = run(faults, 100);
    CHECK(one.counts->dropped == 3);
    std::vector<std::string> expected = allOf(100);
    for (const int number : {5, 50, 51})
        expected.erase(std::find(expected.begin(), expected.end(), textOf(number)));
    CHECK(one.received == expected);

    faults.drop = 0;
    faults.corrupt = 1;
    faults.maxLethal = 1;
    const Run damaged = run(faults, 100, 4);
    CHECK(damaged.counts->corrupted == 1);
    REQUIRE(damaged.received.size() == 100);
    int changed = 0;
    for (const std::string& text : allOf(100))
        changed += std::find(damaged.received.begin(), damaged.received.end(), text) == damaged.received.end();
    CHECK(changed == 1);
}

TEST_CASE("A message is damaged in up to 8 bytes, or its end is missing")
{
    FaultOptions faults;
    faults.seed = 3;
    faults.corrupt = 1;
    const Run damaged = run(faults, 2000);
    const std::vector<std::string> sent = allOf(2000);
    REQUIRE(damaged.received.size() == sent.size());
    int cut = 0, wrong = 0;
    for (std::size_t i = 0; i < sent.size(); ++i) {
        const std::string& text = damaged.received[i];
        std::size_t changed = 0;
        for (std::size_t c = 0; c < std::min(text.size(), sent[i].size()); ++c)
            changed += text[c] != sent[i][c];
        const bool isCut = text.size() < sent[i].size();
        cut += isCut;
        wrong += text.size() > sent[i].size() || (isCut ? changed > 0 : changed < 1 || changed > 8);
    }
    CHECK(wrong == 0);
    CHECK(cut == Approx(500).epsilon(0.1)); // one in four
}

TEST_CASE("A nap is not longer than what is held")
{
    std::chrono::steady_clock::duration time{0};
    Inbox inbox;
    runRanks(1, [&](const InprocCommunicator& communicator) {
        FaultOptions faults;
        faults.delay = 1;
        faults.maxDelay = std::chrono::milliseconds(20);
        const auto pool = MemoryPool::create();
        Faulty transport({communicator, faults}, pool, Progress::Caller);
        transport.start(inbox);
        transport.send(0, pool->acquire(1)); // to itself, as there is no other rank
        const auto before = std::chrono::steady_clock::now();
        while (!transport.quiet()) {
            transport.nap(std::chrono::seconds(10));
            transport.poll();
        }
        time = std::chrono::steady_clock::now() - before;
        transport.stop(true);
    });
    CHECK(time < std::chrono::seconds(5));
    CHECK(inbox.messages.size() == 1);
}

namespace {

// A transport with both optional abilities: to end the job, and to let other ranks see its memory.
struct Able : InprocTransport {
    struct Communicator {
        InprocCommunicator inner;
        std::string* said;
    };
    Able(const Communicator& c, std::shared_ptr<MemoryPool> pool, Progress progress)
        : InprocTransport(c.inner, std::move(pool), progress), said(c.said)
    {
    }
    void abort(const std::string& text) { *said = text; }
    bool lendsTo(int other) const { return other == 1; }
    std::int32_t placeOf(const std::byte* block) const { return block ? 7 : -1; }
    std::byte* blockAt(int, std::int32_t place, std::size_t) const { return place == 7 ? &byte : nullptr; }

    std::string* said;
    mutable std::byte byte{};
};

} // namespace

TEST_CASE("What a transport need not have is passed on if the one below has it, and is not there else")
{
    using Passing = testing::FaultTransport<Able>;
    STATIC_REQUIRE(detail::can_abort_v<Passing>);
    STATIC_REQUIRE(detail::shares_memory_v<Passing>);
    STATIC_REQUIRE_FALSE(detail::can_abort_v<Faulty>);
    STATIC_REQUIRE_FALSE(detail::shares_memory_v<Faulty>);
    std::string said;
    bool right = false;
    runRanks(1, [&](InprocCommunicator communicator) {
        Passing transport({{communicator, &said}, {}}, MemoryPool::create(), Progress::Thread);
        std::byte byte{};
        std::byte* block = transport.blockAt(1, 7, 1);
        right = transport.lendsTo(1) && !transport.lendsTo(2) && transport.placeOf(&byte) == 7
                && transport.placeOf(nullptr) == -1 && block && !transport.blockAt(1, 8, 1);
        transport.abort("rank 3 is lost");
    });
    CHECK(right);
    CHECK(said == "rank 3 is lost");
}

} // namespace faults_cases
