// MpiSession: initialises and finalises MPI, for programs that do not do so themselves.
//
//   int main(int argc, char** argv)
//   {
//       dfb::MpiSession mpi(argc, argv);
//       dfb::DistributedFrameBuffer<dfb::AlphaBlend> fb(mpi.communicator(), config);
//       ...
//   }
#pragma once

#include <dfb/comm/mpi_calls.hpp>
#include <dfb/compiled.hpp>

#include <chrono>
#include <cstddef>
#include <cstdlib>
#include <exception>
#include <optional>
#include <thread>
#include <vector>

DFB_NAMESPACE_BEGIN

// One object in a process. Make it before the framebuffers, compositors and walls, so that it is destroyed after them.
// Below MPI_THREAD_SERIALIZED only the constructor's thread may call MPI (see Progress).
class MpiSession {
public:
    // Initialises MPI at this thread level or a higher one; without `level` at the highest that the library has. With
    // MPI_THREAD_MULTIPLE messages move by themselves (see Progress). Throws TransportError if MPI has been initialised
    // or finalised before, or does not have the level. Collective over MPI_COMM_WORLD; waits as MPI_Init_thread() does.
    MpiSession(int& argc, char**& argv, std::optional<int> level = std::nullopt);

    MpiSession(const MpiSession&) = delete;
    MpiSession& operator=(const MpiSession&) = delete;

    // Waits for all ranks, then finalises MPI, unless that has been done. Collective. If an exception destroys this
    // object, it waits for no other rank: they may wait for messages that never come. The program can still report the
    // exception; when the process exits, it aborts the job with code 1.
    ~MpiSession();

    // Call it to go on after a TransportError. Other ranks may have gone, and MPI_Finalize would wait for them for
    // ever. The destructor then waits for nobody, and when the process exits, it aborts the job with code 1.
    void giveUp() noexcept { isGivenUp_ = true; }

    // Rank and size in MPI_COMM_WORLD, and the level. Any thread may call these members. They wait for nothing.
    int rank() const noexcept { return rank_; }
    int size() const noexcept { return size_; }
    int level() const noexcept { return level_; } // that MPI was initialised at
    MPI_Comm communicator() const noexcept { return MPI_COMM_WORLD; }

private:
    static void abortJob();
    void finalize();
    void partFromAll();
    void check(int code, const char* call) const { detail::checkMpi(code, call, rank_); }

    int level_ = MPI_THREAD_SINGLE, rank_ = 0, size_ = 1;
    int exceptions_ = std::uncaught_exceptions();
    bool isGivenUp_ = false;
};

#if DFB_HAS_BODIES
DFB_COMPILED_ONCE MpiSession::MpiSession(int& argc, char**& argv, std::optional<int> level)
{
    if (detail::mpiSays(MPI_Finalized))
        throw TransportError("MPI has been finalised: it cannot be initialised again");
    if (detail::mpiSays(MPI_Initialized))
        throw TransportError("MPI is already initialised: an MpiSession does it itself, and there can be one only");
    detail::checkMpi(MPI_Init_thread(&argc, &argv, level.value_or(MPI_THREAD_MULTIPLE), &level_), "MPI_Init_thread",
                     -1);
    check(MPI_Comm_rank(MPI_COMM_WORLD, &rank_), "MPI_Comm_rank");
    check(MPI_Comm_size(MPI_COMM_WORLD, &size_), "MPI_Comm_size");
    if (level && level_ < *level) {
        finalize();
        throw TransportError(detail::printed("this MPI library has the thread level %s at most, %s was asked for",
                                             detail::mpiLevelName(level_), detail::mpiLevelName(*level)),
                             rank_);
    }
}

DFB_COMPILED_ONCE MpiSession::~MpiSession()
{
    if (detail::mpiSays(MPI_Finalized))
        return;
    if (!isGivenUp_ && std::uncaught_exceptions() == exceptions_)
        finalize();
    else if (std::atexit(abortJob) != 0)
        abortJob();
}

// If all ranks end with one exception, they come here together. So this waits, half a second at most, until all can
// have reported it. Then it waits for the launcher, which may drop output that a rank writes just before MPI_Abort.
DFB_COMPILED_ONCE void MpiSession::abortJob()
{
    if (detail::mpiSays(MPI_Finalized))
        return;
    int done = 0;
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Ibarrier(MPI_COMM_WORLD, &request);
    detail::Backoff backoff;
    for (const auto limit = std::chrono::steady_clock::now() + std::chrono::milliseconds(500);
         MPI_Test(&request, &done, MPI_STATUS_IGNORE) == MPI_SUCCESS && !done
         && std::chrono::steady_clock::now() < limit;)
        backoff.nap();
    std::this_thread::sleep_for(std::chrono::milliseconds(50));
    MPI_Abort(MPI_COMM_WORLD, 1);
}

DFB_COMPILED_ONCE void MpiSession::finalize()
{
    try {
        partFromAll();
    } catch (const std::exception&) { // it is only a precaution
    }
    MPI_Finalize();
}

// MPI_Finalize of MPICH 4 sometimes hangs where ranks are connected by TCP: each rank waits for answers of the others
// on its connections, but a rank that is already further on answers no more. It does not hang if the connections have
// been idle for a while. With more than `most` ranks, opening all would cost too much.
DFB_COMPILED_ONCE void MpiSession::partFromAll()
{
#if defined(MPICH_VERSION)
    constexpr int most = 256;
    if (size_ == 1)
        return;
    MPI_Comm comm = MPI_COMM_NULL;
    MPI_Request request = MPI_REQUEST_NULL;
    check(MPI_Comm_idup(MPI_COMM_WORLD, &comm, &request), "MPI_Comm_idup");
    detail::waitMpi(request, rank_);
    check(MPI_Comm_set_errhandler(comm, MPI_ERRORS_RETURN), "MPI_Comm_set_errhandler");

    std::vector<char> bytes(static_cast<std::size_t>(size_) + 1);
    std::vector<MPI_Request> requests;
    for (int other = 0; other < size_ && size_ <= most; ++other)
        if (other != rank_) {
            requests.push_back(MPI_REQUEST_NULL);
            check(MPI_Irecv(&bytes[static_cast<std::size_t>(other)], 1, MPI_CHAR, other, 0, comm, &requests.back()),
                  "MPI_Irecv");
            requests.push_back(MPI_REQUEST_NULL);
            check(MPI_Isend(&bytes.back(), 1, MPI_CHAR, other, 0, comm, &requests.back()), "MPI_Isend");
        }
    for (MPI_Request& each : requests)
        detail::waitMpi(each, rank_);
    check(MPI_Ibarrier(comm, &request), "MPI_Ibarrier");
    detail::waitMpi(request, rank_);
    MPI_Comm_free(&comm);
    std::this_thread::sleep_for(std::chrono::milliseconds(50)); // longer than ranks come after each other
#endif
}
#endif

DFB_NAMESPACE_END
