// Runs the conformance suite on InprocTransport, also with faults put in. 1 to 5 ranks, which are threads.
#include "catch.hpp"
#include "shuffled.hpp"

#include <dfb/comm/inproc_transport.hpp>
#include <dfb/testing/fault_transport.hpp>
#include <dfb/testing/transport_conformance.hpp>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <optional>
#include <string>

namespace inproc_cases {

using namespace dfb;
using testing::ConformanceOptions;
using testing::FaultOptions;
using Faulty = testing::FaultTransport<ShuffledTransport>;

namespace {

// Returns the failures of all ranks.
template <class Transport, class Make>
std::string check(int ranks, const ConformanceOptions& options, const Make& communicatorOf)
{
    std::mutex mutex;
    std::string text;
    runRanks(ranks, [&](const InprocCommunicator& communicator) {
        const auto results = testing::checkTransport<Transport>(communicatorOf(communicator), options);
        const std::string own = testing::describeFailures(results);
        const std::lock_guard<std::mutex> lock(mutex);
        if (!own.empty() || results.size() < 2 * 10)
            text += "rank " + std::to_string(communicator.rank()) + ":\n" + own;
    });
    return text;
}

std::string checkFaulty(int ranks, const FaultOptions& faults, const ConformanceOptions& options,
                        std::optional<std::uint64_t> shuffleSeed = std::nullopt)
{
    return check<Faulty>(ranks, options, [&](const InprocCommunicator& communicator) {
        return Faulty::Communicator{{communicator, shuffleSeed}, faults};
    });
}

InprocCommunicator same(const InprocCommunicator& communicator) { return communicator; }

ConformanceOptions quick(std::uint64_t seed = 1)
{
    ConformanceOptions options;
    options.seed = seed;
    options.largestMessage = std::size_t{1} << 20;
    options.smallMessages = 3000;
    options.timeLimit = std::chrono::seconds(60);
    return options;
}

bool contains(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

// Whether every rank reports a failure.
bool failedOnAll(const std::string& text, int ranks)
{
    for (int rank = 0; rank < ranks; ++rank)
        if (!contains(text, "rank " + std::to_string(rank) + ":\n"))
            return false;
    return true;
}

// For cases that must fail. Their time limit is short; if not all of `isFound` is found, they run again with a longer
// one, as on a machine that stands still another failure may come first.
template <class IsFound>
std::string failuresOf(int ranks, const FaultOptions& faults, const IsFound& isFound)
{
    ConformanceOptions options = quick();
    options.modes = {Progress::Caller};
    options.timeLimit = std::chrono::seconds(2);
    const std::string text = checkFaulty(ranks, faults, options);
    if (isFound(text))
        return text;
    options.timeLimit = std::chrono::seconds(10);
    return checkFaulty(ranks, faults, options);
}

} // namespace

TEST_CASE("InprocTransport keeps the contract")
{
    ConformanceOptions options = quick();
    const int ranks = GENERATE(1, 2, 3, 5);
    if (ranks == 2 || ranks == 5) {
        options.smallMessages = ConformanceOptions().smallMessages;
        options.largestMessage = std::size_t{1} << (ranks == 2 ? 24 : 22);
    }
    CAPTURE(ranks, options.seed);
    CHECK(check<InprocTransport>(ranks, options, same) == "");
}

TEST_CASE("Messages that are shuffled keep the contract")
{
    const int ranks = GENERATE(2, 3, 5);
    const std::uint64_t seed = 100 + static_cast<std::uint64_t>(ranks);
    CAPTURE(ranks, seed);
    CHECK(checkFaulty(ranks, FaultOptions(), quick(seed), seed) == "");
}

TEST_CASE("Messages that are late and out of order keep the contract")
{
    const int ranks = GENERATE(2, 3, 5);
    const bool shuffled = ranks == 3;
    FaultOptions faults;
    faults.seed = 200 + static_cast<std::uint64_t>(ranks);
    faults.reorder = 0.3;
    faults.delay = 0.1;
    faults.counts = std::make_shared<testing::FaultCounts>();
    CAPTURE(ranks, shuffled, faults.seed);
    CHECK(checkFaulty(ranks, faults, quick(faults.seed), shuffled ? std::optional(faults.seed) : std::nullopt) == "");
    CHECK(faults.counts->reordered > faults.counts->sent / 5);
    CHECK(faults.counts->delayed > faults.counts->sent / 20);
}

TEST_CASE("A lost message is found, and named")
{
    const std::size_t size = GENERATE(0, 65536);
    FaultOptions faults;
    faults.drop = 1;
    faults.maxLethal = 1;
    faults.only = [size](int destination, const Buffer& message) { return destination == 1 && message.size() == size; };
    CAPTURE(size);
    const auto isFound = [size](const std::string& text) {
        return failedOnAll(text, 3)
               && (contains(text, "no message from rank 0 within 2 s: got ")
                   || contains(text, "no message from rank 0 within 10 s: got "))
               && contains(text, " of " + std::to_string(size) + " bytes is missing");
    };
    const std::string text = failuresOf(3, faults, isFound);
    INFO(text);
    CHECK(isFound(text));
}

TEST_CASE("A message that comes twice is found, unless that is allowed")
{
    FaultOptions faults;
    faults.seed = 300;
    faults.duplicate = 0.01;
    ConformanceOptions options = quick(faults.seed);
    CAPTURE(faults.seed);
    const std::string text = checkFaulty(3, faults, options);
    INFO(text);
    CHECK(failedOnAll(text, 3));
    CHECK((contains(text, "came twice") || contains(text, "came once more, ")));
    options.duplicatesAllowed = true;
    CHECK(checkFaulty(3, faults, options) == "");
}

TEST_CASE("A damaged message is found")
{
    FaultOptions faults;
    faults.seed = GENERATE(1, 2, 3);
    faults.corrupt = 0.1;
    faults.maxLethal = 1;
    faults.only = [](int, const Buffer& message) { return message.size() >= 1000; };
    CAPTURE(faults.seed);
    const auto isFound = [](const std::string& text) {
        return failedOnAll(text, 2) && (contains(text, "changed") || contains(text, " bytes came"));
    };
    const std::string text = failuresOf(2, faults, isFound);
    INFO(text);
    CHECK(isFound(text));
}

} // namespace inproc_cases
