// Calls of MPI: errors become exceptions, and nothing waits in a call that blocks, because MPI libraries spin there.
// The only header that includes mpi.h.
#pragma once

#include <dfb/comm/progress.hpp>
#include <dfb/error.hpp>

#include <mpi.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <thread>

DFB_NAMESPACE_BEGIN

namespace detail {

inline const char* mpiLevelName(int level)
{
    return level == MPI_THREAD_SINGLE       ? "MPI_THREAD_SINGLE"
           : level == MPI_THREAD_FUNNELED   ? "MPI_THREAD_FUNNELED"
           : level == MPI_THREAD_SERIALIZED ? "MPI_THREAD_SERIALIZED"
                                            : "MPI_THREAD_MULTIPLE";
}

// Throws TransportError unless the call was successful. `rank`: this rank. `peer`: the rank that the call was about, or
// -1. That rank may be the cause: MPI can find that a rank is gone before the library does.
inline void checkMpi(int code, const char* call, int rank, int peer = -1)
{
    if (code == MPI_SUCCESS)
        return;
    char text[MPI_MAX_ERROR_STRING];
    int length = 0;
    if (MPI_Error_string(code, text, &length) != MPI_SUCCESS || length == 0)
        length = std::snprintf(text, sizeof text, "error %d, of which MPI knows nothing", code);
    throw TransportError(peer < 0 ? printed("%s: %.*s", call, length, text)
                                  : printed("%s with rank %d: %.*s", call, peer, length, text),
                         rank);
}

inline constexpr const char* finalizedTooEarly =
    "dfb: MPI_Finalize() was called before the last framebuffer, compositor or wall was destroyed\n";

// Asks MPI_Initialized, MPI_Finalized or MPI_Is_thread_main.
inline bool mpiSays(int (*ask)(int*))
{
    int answer = 0;
    ask(&answer);
    return answer != 0;
}

// Throws TransportError if this code was compiled for Open MPI but runs with another MPI, or the other way round: their
// communicators differ. Those of MPICH and its relatives do not.
inline void requireMpiOfHeaders()
{
    char text[16384] = ""; // MPI_MAX_LIBRARY_VERSION_STRING of the other MPI may be larger than that of this one
    int length = 0;
    MPI_Get_library_version(text, &length);
    // Only the first word: a library that translates between MPIs also names those.
    const bool isOpenMpi = std::strncmp(text, "Open MPI", 8) == 0;
#if defined(OPEN_MPI)
    const char* const compiledFor = "Open MPI";
    const bool isOther = !isOpenMpi && (std::strstr(text, "MPICH") || std::strstr(text, "Intel(R) MPI"));
#else
    const char* const compiledFor = "MPICH or a relative of it";
    const bool isOther = isOpenMpi;
#endif
    if (isOther)
        throw TransportError(printed("dfb was compiled for %s, but the MPI of this process is %.*s: compile dfb for it",
                                     compiledFor, static_cast<int>(std::strcspn(text, ",\n")), text));
}

// If MPI_Finalize() is called while this object lives, ends the process and says why. For transports that another
// thread polls, which might call MPI at that time. (MPI_Finalize() deletes the attributes of MPI_COMM_SELF first.)
class NoFinalize {
public:
    explicit NoFinalize(bool isNeeded)
    {
        if (isNeeded) {
            MPI_Comm_create_keyval(MPI_COMM_NULL_COPY_FN, deleted, &key_, nullptr);
            MPI_Comm_set_attr(MPI_COMM_SELF, key_, &lives_);
        }
    }
    NoFinalize(const NoFinalize&) = delete;
    NoFinalize& operator=(const NoFinalize&) = delete;
    ~NoFinalize()
    {
        if (key_ == MPI_KEYVAL_INVALID)
            return;
        lives_ = false;
        MPI_Comm_delete_attr(MPI_COMM_SELF, key_);
        MPI_Comm_free_keyval(&key_);
    }

private:
    static int deleted(MPI_Comm, int, void* lives, void*)
    {
        if (*static_cast<bool*>(lives)) {
            std::fputs(finalizedTooEarly, stderr);
            std::abort();
        }
        return MPI_SUCCESS;
    }

    int key_ = MPI_KEYVAL_INVALID;
    bool lives_ = true;
};

// The thread level of MPI. Throws TransportError if MPI is not initialised, or is finalised.
inline int mpiLevel()
{
    const bool finalized = mpiSays(MPI_Finalized);
    if (finalized || !mpiSays(MPI_Initialized))
        throw TransportError(finalized ? "MPI has been finalised"
                                       : "MPI is not initialised: call MPI_Init or MPI_Init_thread first");
    int level = MPI_THREAD_SINGLE;
    MPI_Query_thread(&level);
    return level;
}

// For waiting without spinning and without a blocking call.
class Backoff {
public:
    void nap()
    {
        std::this_thread::sleep_for(next_);
        next_ = std::min<std::chrono::microseconds>(next_ + next_ / 4, std::chrono::microseconds(200));
    }
    void reset() { next_ = shortest; }

private:
    static constexpr std::chrono::microseconds shortest{20};
    std::chrono::microseconds next_ = shortest;
};

// Waits until the request has completed, and meanwhile polls as ProgressThread::pollOthers() does. Throws as checkMpi()
// does.
inline void waitMpi(MPI_Request& request, int rank, MPI_Status* status = MPI_STATUS_IGNORE)
{
    int done = 0;
    for (Backoff backoff; checkMpi(MPI_Test(&request, &done, status), "MPI_Test", rank), !done;) {
        if (ProgressThread::pollOthers())
            backoff.reset();
        else
            backoff.nap();
    }
}

} // namespace detail

DFB_NAMESPACE_END
