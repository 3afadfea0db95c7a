#include "catch.hpp"

#include <dfb/comm/mpi_transport.hpp>
#include <dfb/testing/fault_transport.hpp>
#include <dfb/testing/transport_conformance.hpp>

#include <chrono>
#include <cstddef>
#include <memory>
#include <string>

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
    options.timeLimit = std::chrono::milliseconds(20000);
    return options;
}

template <class Transport>
std::string check(const typename Transport::Communicator& communicator, const ConformanceOptions& options)
{
    return testing::describeFailures(testing::checkTransport<Transport>(communicator, options));
}

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
    options.timeLimit = std::chrono::milliseconds(20000);
    if (rankCount() > 3) // for the time it takes
        options.largestMessage = std::size_t{1} << 22;
    CHECK(check<MpiTransport>(MPI_COMM_WORLD, options) == "");
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
    options.timeLimit = std::chrono::milliseconds(300) * rankCount();
    options.modes = {Progress::Caller};
    const std::string text = check<Faulty>({MPI_COMM_WORLD, faults}, options);
    INFO(text);
    CHECK(contains(text, "no message from rank 0 within "));
    CHECK(contains(text, " of 65536 bytes is missing"));
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
