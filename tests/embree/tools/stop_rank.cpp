// Linked with the objects of dfb_render. Rank 1 stops itself (SIGSTOP) at its 100th call of MPI_Isend, which is between
// two frames or in the middle of one.
#include <mpi.h>

#include <atomic>
#include <csignal>

#include <sys/prctl.h>

extern "C" int MPI_Isend(const void* data, int count, MPI_Datatype type, int to, int tag, MPI_Comm comm,
                         MPI_Request* request)
{
    static std::atomic<int> calls{0};
    int rank = 0;
    MPI_Comm_rank(MPI_COMM_WORLD, &rank);
    if (rank == 1 && ++calls == 100) {
        prctl(PR_SET_PDEATHSIG, SIGKILL); // stopped, it does not outlive its launcher
        raise(SIGSTOP);
    }
    return PMPI_Isend(data, count, type, to, tag, comm, request);
}
