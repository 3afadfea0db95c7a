// Plain calls of MPI, with which the benchmarks compare; and what their programs have in common.
#pragma once

#include "options.hpp"

#include <mpi.h>

#include <algorithm>
#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include <sched.h>
#include <sys/resource.h>
#if defined(__linux__)
#include <sys/prctl.h>
#endif

namespace bench {

// ---- what threads do while they wait

// How often threads of this process have gone to sleep.
inline double sleeps()
{
    rusage usage{};
    getrusage(RUSAGE_SELF, &usage);
    return static_cast<double>(usage.ru_nvcsw);
}

// Lets naps of this thread, and of threads that it starts later, last as long as asked, and not 50 us longer.
inline void shortenNaps()
{
#if defined(__linux__)
    prctl(PR_SET_TIMERSLACK, 1000, 0, 0, 0);
#endif
}

class Signal {
public:
    void set()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        set_ = true;
        changed_.notify_all();
    }
    void wait()
    {
        std::unique_lock<std::mutex> lock(mutex_);
        changed_.wait(lock, [this] { return set_; });
        set_ = false;
    }

private:
    std::mutex mutex_;
    std::condition_variable changed_;
    bool set_ = false;
};

// ---- plain MPI

inline int rankIn(MPI_Comm comm)
{
    int rank = 0;
    MPI_Comm_rank(comm, &rank);
    return rank;
}
inline int sizeOf(MPI_Comm comm)
{
    int size = 1;
    MPI_Comm_size(comm, &size);
    return size;
}

// How a thread waits for MPI: inside MPI; testing, and giving up its time slice in between; or testing for 5 us and
// then every 50 us.
enum class Waiting { Blocking, Yield, Nap };

inline const char* nameOf(Waiting waiting)
{
    return waiting == Waiting::Blocking ? "MPI blocking"
           : waiting == Waiting::Yield  ? "MPI test+yield"
                                        : "MPI test+nap";
}

// The CPU time that this thread has spent in sched_yield() while it waited: that is not work of the measured system.
inline double& yieldedSeconds()
{
    static thread_local double seconds = 0;
    return seconds;
}

// What to do between tests.
class Idler {
public:
    explicit Idler(Waiting waiting) : waiting_(waiting) {}
    void idle()
    {
        if (waiting_ == Waiting::Yield) {
            const double before = threadCpuSeconds();
            sched_yield();
            yieldedSeconds() += threadCpuSeconds() - before;
            return;
        }
        if (Clock::now() - since_ > std::chrono::microseconds(5))
            std::this_thread::sleep_for(std::chrono::microseconds(50));
    }

private:
    Waiting waiting_;
    const Clock::time_point since_ = Clock::now();
};

inline void complete(MPI_Request& request, Waiting waiting = Waiting::Yield)
{
    if (waiting == Waiting::Blocking) {
        MPI_Wait(&request, MPI_STATUS_IGNORE);
        return;
    }
    int done = 0;
    Idler idler(waiting);
    while (MPI_Test(&request, &done, MPI_STATUS_IGNORE), !done)
        idler.idle();
}

inline void plainSend(const std::byte* data, std::size_t byteCount, int to, int tag, MPI_Comm comm, Waiting waiting)
{
    if (waiting == Waiting::Blocking) {
        MPI_Send(data, static_cast<int>(byteCount), MPI_BYTE, to, tag, comm);
        return;
    }
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Isend(data, static_cast<int>(byteCount), MPI_BYTE, to, tag, comm, &request);
    complete(request, waiting);
}

inline void plainReceive(std::byte* data, std::size_t byteCount, int from, int tag, MPI_Comm comm, Waiting waiting)
{
    if (waiting == Waiting::Blocking) {
        MPI_Recv(data, static_cast<int>(byteCount), MPI_BYTE, from, tag, comm, MPI_STATUS_IGNORE);
        return;
    }
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Irecv(data, static_cast<int>(byteCount), MPI_BYTE, from, tag, comm, &request);
    complete(request, waiting);
}

// Waits; returns the indices of completed requests, at least one.
inline std::vector<int> someOf(std::vector<MPI_Request>& requests, Waiting waiting)
{
    std::vector<int> indices(requests.size());
    int count = 0;
    const auto size = static_cast<int>(requests.size());
    Idler idler(waiting);
    for (;;) {
        if (waiting == Waiting::Blocking)
            MPI_Waitsome(size, requests.data(), &count, indices.data(), MPI_STATUSES_IGNORE);
        else
            MPI_Testsome(size, requests.data(), &count, indices.data(), MPI_STATUSES_IGNORE);
        if (count != 0)
            break;
        idler.idle();
    }
    indices.resize(count == MPI_UNDEFINED ? 0 : static_cast<std::size_t>(count));
    return indices;
}

// ---- what ranks do between measurements: never a blocking call, which would take the cores from those that measure

inline void napThrough(MPI_Request& request)
{
    int done = 0;
    std::chrono::microseconds nap{20};
    while (MPI_Test(&request, &done, MPI_STATUS_IGNORE), !done) {
        std::this_thread::sleep_for(nap);
        nap = std::min(nap * 5 / 4, std::chrono::microseconds(1000));
    }
}

inline void meet(MPI_Comm comm)
{
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Ibarrier(comm, &request);
    napThrough(request);
}

// Returns the value of rank 0 on all ranks.
inline double agree(MPI_Comm comm, double value)
{
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Ibcast(&value, 1, MPI_DOUBLE, 0, comm, &request);
    napThrough(request);
    return value;
}

inline double reduce(MPI_Comm comm, double value, MPI_Op operation)
{
    double result = 0;
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Iallreduce(&value, &result, 1, MPI_DOUBLE, operation, comm, &request);
    napThrough(request);
    return result;
}

// On rank 0: the samples of all ranks, one after the other.
inline std::vector<double> collect(MPI_Comm comm, const std::vector<double>& samples)
{
    const auto count = static_cast<int>(samples.size());
    std::vector<int> counts(static_cast<std::size_t>(sizeOf(comm))), places(counts.size());
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Igather(&count, 1, MPI_INT, counts.data(), 1, MPI_INT, 0, comm, &request);
    napThrough(request);
    int total = 0;
    for (std::size_t r = 0; r < counts.size(); ++r) {
        places[r] = total;
        total += counts[r];
    }
    std::vector<double> all(rankIn(comm) == 0 ? static_cast<std::size_t>(total) : 0);
    MPI_Igatherv(samples.data(), count, MPI_DOUBLE, all.data(), counts.data(), places.data(), MPI_DOUBLE, 0, comm,
                 &request);
    napThrough(request);
    return all;
}

// ---- a program

// The arguments that all benchmarks take. Ends the program after --help, or if it was called wrongly.
struct Arguments {
    bool quick = false;
    std::string only; // digits of the parts to run; empty: all
    std::string trace;

    Arguments(int argc, char** argv, const char* usage)
    {
        for (int i = 1; i < argc; ++i) {
            const std::string argument = argv[i];
            if (argument == "--quick") {
                quick = true;
            } else if (argument == "--trace" && i + 1 < argc) {
                trace = argv[++i];
            } else if (argument.find_first_not_of("123456789") == std::string::npos) {
                only += argument;
            } else {
                std::printf("%s\n", usage);
                std::exit(argument == "--help" ? 0 : 2);
            }
        }
    }

    bool wants(char part) const { return only.empty() || only.find(part) != std::string::npos; }
};

// Calls `body(communicator)` between the beginning and the end of MPI.
template <class Body>
void withMpi(int argc, char** argv, const Body& body)
{
    int level = 0;
    MPI_Init_thread(&argc, &argv, MPI_THREAD_MULTIPLE, &level);
    shortenNaps();
    body(MPI_COMM_WORLD);
    MPI_Finalize();
}

inline std::string environment(MPI_Comm comm)
{
    int length = 0;
    char library[MPI_MAX_LIBRARY_VERSION_STRING];
    MPI_Get_library_version(library, &length);
    std::string version(library, static_cast<std::size_t>(length));
    version = version.substr(0, version.find('\n'));
    for (char& c : version)
        c = c == '\t' ? ' ' : c;
    return std::to_string(sizeOf(comm)) + " ranks, " + std::to_string(std::thread::hardware_concurrency()) + " cores, "
           + version;
}

} // namespace bench
