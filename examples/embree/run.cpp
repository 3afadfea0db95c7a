// dfb_render over MPI, and with threads as ranks.
#include "run.hpp"
#include "rank_run.hpp"

int example::runInproc(const dfb::InprocCommunicator& communicator, const Options& options, int threads)
{
    return runOver(dfb::connect<dfb::InprocTransport>(communicator, connectionOptionsOf(options)),
                   dfb::InprocTransport::name, options, threads);
}

#if defined(DFB_HAS_MPI)
int example::runMpi(MPI_Comm communicator, const Options& options, int threads)
{
    return runOver(dfb::connect<dfb::MpiTransport>(communicator, connectionOptionsOf(options)), dfb::MpiTransport::name,
                   options, threads);
}
#endif
