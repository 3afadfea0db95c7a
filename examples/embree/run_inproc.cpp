// dfb_render with threads as ranks.
#include "rank_run.hpp"
#include "run.hpp"

int example::runInproc(const dfb::InprocCommunicator& communicator, const Options& options, int threads)
{
    return runWith<dfb::InprocTransport>(communicator, options, threads);
}
