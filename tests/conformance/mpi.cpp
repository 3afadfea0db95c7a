// Runs the conformance suite on MpiTransport, also with faults put in. Over MPI, on any number of ranks.
#include "catch.hpp"
#include "ranks.hpp"

#include <dfb/comm/mpi_transport.hpp>
#include <dfb/testing/fault_transport.hpp>
#include <dfb/testing/transport_conformance.hpp>

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <string>
#include <thread>
#include <utility>
#include <vector>

using namespace dfb;
using testing::ConformanceOptions;
using testing::FaultOptions;
using Faulty = testing::FaultTransport<MpiTransport>;

namespace {

ConformanceOptions quick()
{
    ConformanceOptions options;
    options.largestMessage = std::size_t{1} << 20;
    options.smallMessages = 3000;
    options.timeLimit = std::chrono::seconds(60);
    return options;
}

template <class Transport>
std::string check(const typename Transport::Communicator& communicator, const ConformanceOptions& options)
{
    return testing::describeFailures(testing::checkTransport<Transport>(communicator, options));
}

// A transport that sends all messages through MPI.
struct Unshared : MpiTransport {
    Unshared(const Communicator& communicator, std::shared_ptr<MemoryPool>, Progress progress)
        : MpiTransport(communicator, MemoryPool::create(false), progress)
    {
    }
};

bool contains(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

int rankCount()
{
    int size = 0;
    MPI_Comm_size(MPI_COMM_WORLD, &size);
    return size;
}

} // namespace

TEST_CASE("MpiTransport keeps the contract")
{
    ConformanceOptions options;
    options.timeLimit = std::chrono::seconds(60);
    if (rankCount() > 3) // to save time
        options.largestMessage = std::size_t{1} << 22;
    CHECK(check<MpiTransport>(MPI_COMM_WORLD, options) == "");
    CHECK(check<Unshared>(MPI_COMM_WORLD, options) == "");
}

TEST_CASE("On one node blocks are lent, unless the pool may not be shared")
{
    struct Inbox : TransportHandler {
        void receive(int source, Buffer&& message) override
        {
            sources.push_back(source);
            messages.push_back(std::move(message));
        }
        void fail(const ErrorInfo&) override { isFailed = true; }
        bool failed() const override { return isFailed; }
        std::vector<int> sources;
        std::vector<Buffer> messages;
        bool isFailed = false;
    };
    int rank = 0;
    MPI_Comm_rank(MPI_COMM_WORLD, &rank);
    const int size = rankCount(), next = (rank + 1) % size;
    constexpr std::size_t byteCount = 100000;
    const bool canShare = size > 1 && seesNextRank(MPI_COMM_WORLD);
    for (const bool mayBeShared : {true, false}) {
        Inbox inbox;
        const auto pool = MemoryPool::create(mayBeShared);
        MpiTransport transport(MPI_COMM_WORLD, pool, Progress::Caller);
        CHECK(transport.lendsTo(next) == (mayBeShared && canShare)); // the tests' ranks are on one node
        transport.start(inbox);
        for (int i = 0; i < 3 && size > 1; ++i) {
            Buffer message = pool->acquire(byteCount);
            std::memset(message.data(), 10 * rank + i, byteCount);
            transport.send(next, std::move(message));
        }
        transport.stop(true);
        CHECK_FALSE(inbox.isFailed);
        CHECK(inbox.messages.size() == (size > 1 ? 3u : 0u));
        for (std::size_t i = 0; i < inbox.messages.size(); ++i) {
            const Buffer& message = inbox.messages[i]; // any of the 3, as order is not promised
            CHECK(inbox.sources[i] == (rank + size - 1) % size);
            REQUIRE(message.size() == byteCount);
            CHECK(std::to_integer<int>(message.data()[0]) / 10 == inbox.sources[i]);
            CHECK(std::count(message.data(), message.data() + byteCount, message.data()[0]) == byteCount);
        }
    }
}

TEST_CASE("Messages that are late and out of order keep the contract")
{
    FaultOptions faults;
    faults.seed = 400;
    faults.reorder = 0.3;
    faults.delay = 0.1;
    faults.counts = std::make_shared<testing::FaultCounts>();
    CAPTURE(faults.seed);
    CHECK(check<Faulty>({MPI_COMM_WORLD, faults}, quick()) == "");
    if (rankCount() > 1) {
        CHECK(faults.counts->reordered > faults.counts->sent / 5);
        CHECK(faults.counts->delayed > faults.counts->sent / 20);
    }
}

TEST_CASE("A lost message is found on all ranks, and named")
{
    if (rankCount() == 1)
        return;
    FaultOptions faults;
    faults.drop = 1;
    faults.maxLethal = 1;
    faults.only = [](int destination, const Buffer& message) { return destination == 1 && message.size() == 65536; };
    ConformanceOptions options = quick();
    options.modes = {Progress::Caller};
    const auto isFound = [](const std::string& text) {
        return contains(text, "no message from rank 0 within ") && contains(text, " of 65536 bytes is missing");
    };
    std::string text;
    // The time limit is short. On a machine that stands still another failure may come first; then it is longer.
    for (const int ms : {2100, 10000}) {
        options.timeLimit = std::chrono::milliseconds(ms);
        text = check<Faulty>({MPI_COMM_WORLD, faults}, options);
        bool all = isFound(text);
        MPI_Allreduce(MPI_IN_PLACE, &all, 1, MPI_CXX_BOOL, MPI_LAND, MPI_COMM_WORLD);
        if (all)
            break;
    }
    INFO(text);
    CHECK(isFound(text));
}

TEST_CASE("A message that comes twice is found on all ranks")
{
    if (rankCount() == 1)
        return;
    FaultOptions faults;
    faults.seed = 500;
    faults.duplicate = 0.02;
    ConformanceOptions options = quick();
    options.modes = {Progress::Thread};
    CAPTURE(faults.seed);
    const std::string text = check<Faulty>({MPI_COMM_WORLD, faults}, options);
    INFO(text);
    CHECK((contains(text, "came twice") || contains(text, "came once more, ")));
}

TEST_CASE("A rank that was built with another packet format is named on all ranks, and the communicator stays usable")
{
    STATIC_REQUIRE(detail::can_abort_v<Faulty>);
    STATIC_REQUIRE(detail::shares_memory_v<Faulty>);
    const int size = rankCount(), rank = rankIn(MPI_COMM_WORLD);
    for (const int odd : {0, size - 1}) {
        std::string text;
        if (rank == odd) {
            // The calls that any version makes first, see mpi_ranks.hpp.
            const std::uint64_t format = 12345;
            std::vector<std::uint64_t> all(static_cast<std::size_t>(size));
            MPI_Comm own = MPI_COMM_NULL;
            for (int step = 0; step < 2; ++step) {
                MPI_Request request = MPI_REQUEST_NULL;
                if (step == 0)
                    MPI_Comm_idup(MPI_COMM_WORLD, &own, &request);
                else
                    MPI_Iallgather(&format, 8, MPI_BYTE, all.data(), 8, MPI_BYTE, own, &request);
                for (int done = 0; MPI_Test(&request, &done, MPI_STATUS_IGNORE), !done;)
                    std::this_thread::sleep_for(std::chrono::microseconds(100));
            }
            CHECK(std::count(all.begin(), all.end(), detail::packetFormat) == size - 1);
            MPI_Comm_free(&own);
        } else {
            try {
                const MpiTransport transport(MPI_COMM_WORLD, MemoryPool::create(), Progress::Thread);
                text = "no exception";
            } catch (const TransportError& e) {
                text = e.what();
            }
            INFO(text);
            CHECK(contains(text, "cannot read each other"));
            CHECK(contains(text, "rank 0 sends packets of format "
                                     + std::to_string(odd == 0 ? 12345 : detail::packetFormat)));
            CHECK(contains(text, "rank " + std::to_string(odd == 0 ? 1 : odd) + " of format "
                                     + std::to_string(odd == 0 ? detail::packetFormat : 12345)));
        }
        ConformanceOptions options = quick();
        options.modes = {Progress::Caller};
        CHECK(check<MpiTransport>(MPI_COMM_WORLD, options) == "");
    }
}
