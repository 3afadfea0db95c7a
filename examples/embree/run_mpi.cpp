// dfb_render over MPI.
#include "rank_run.hpp"
#include "run.hpp"

#if defined(DFB_HAS_MPI)
int example::runMpi(MPI_Comm communicator, const Options& options, int threads)
{
    return runWith<dfb::MpiTransport>(communicator, options, threads);
}
#endif
