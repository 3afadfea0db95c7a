// mpirun -n 2 mpi_late_testsome: one poll() delivers all messages that have arrived, even if MPI_Testsome returns only
// what it knew before the call and then looks for more, as Open MPI's does. Otherwise a rank might nap after such a
// poll while a message waits. This program makes every MPI_Testsome behave so. Returns 0 if all is well.
#include <dfb/comm/mpi_session.hpp>
#include <dfb/comm/mpi_transport.hpp>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <set>
#include <thread>
#include <utility>
#include <vector>

namespace {

std::vector<MPI_Request> posted; // receives of packets
std::set<MPI_Request> known;     // those that the last MPI_Testsome has seen to be done

bool isDone(MPI_Request request)
{
    int done = 0;
    PMPI_Request_get_status(request, &done, MPI_STATUS_IGNORE);
    return done != 0;
}

struct Handler final : dfb::TransportHandler {
    void receive(int, dfb::Buffer&&) override { ++received; }
    void fail(const dfb::ErrorInfo& error) override
    {
        std::fprintf(stderr, "mpi_late_testsome: %s\n", error.message.c_str());
        hasFailed = true;
    }
    bool failed() const override { return hasFailed; }

    int received = 0;
    bool hasFailed = false;
};

} // namespace

extern "C" int MPI_Irecv(void* to, int count, MPI_Datatype type, int from, int tag, MPI_Comm communicator,
                         MPI_Request* request)
{
    const int code = PMPI_Irecv(to, count, type, from, tag, communicator, request);
    posted.push_back(*request);
    return code;
}

extern "C" int MPI_Testsome(int count, MPI_Request* requests, int* outCount, int* indices, MPI_Status* statuses)
{
    *outCount = 0;
    for (int i = 0; i < count; ++i)
        if (const auto at = known.find(requests[i]); at != known.end()) {
            known.erase(at);
            posted.erase(std::remove(posted.begin(), posted.end(), requests[i]), posted.end());
            int done = 0;
            PMPI_Test(&requests[i], &done, &statuses[*outCount]);
            indices[(*outCount)++] = i;
        }
    for (int i = 0; i < count; ++i)
        if (requests[i] != MPI_REQUEST_NULL && isDone(requests[i]))
            known.insert(requests[i]);
    return MPI_SUCCESS;
}

int main(int argc, char** argv)
{
    const dfb::MpiSession mpi(argc, argv);
    const auto pool = dfb::MemoryPool::create();
    dfb::MpiTransport transport(mpi.communicator(), pool, dfb::Progress::Caller);
    Handler handler;
    transport.start(handler);
    constexpr int rounds = 20;
    int late = 0;
    for (int round = 0; round < rounds; ++round) {
        if (mpi.rank() != 0) {
            transport.send(0, pool->acquire(100));
            while (!transport.quiet())
                transport.poll();
        } else {
            const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(10);
            while (std::none_of(posted.begin(), posted.end(), isDone) && std::chrono::steady_clock::now() < limit)
                std::this_thread::yield();
            transport.poll();
            late += handler.received != round + 1;
            while (handler.received <= round && std::chrono::steady_clock::now() < limit)
                transport.poll();
        }
        MPI_Barrier(mpi.communicator());
    }
    const bool fine = late == 0 && handler.received == (mpi.rank() == 0 ? rounds : 0) && !handler.hasFailed;
    if (!fine)
        std::fprintf(stderr, "mpi_late_testsome: rank %d got %d of %d messages, %d of them only by another poll()\n",
                     mpi.rank(), handler.received, rounds, late);
    transport.stop(true);
    return fine ? 0 : 1;
}
