// dfb_render over MPI, and with threads as ranks.
#include "run.hpp"
#include "rank_run.hpp"

namespace example {

namespace {

int runOver(std::shared_ptr<dfb::Connection> connection, const char* transport, const Options& o, int threads)
{
    if (o.live)
        return runLive(std::move(connection), o, threads);
    return RankRun(std::move(connection), transport, o, threads).run();
}

} // namespace

int runInproc(const dfb::InprocCommunicator& communicator, const Options& options, int threads)
{
    return runOver(dfb::connect<dfb::InprocTransport>(communicator, networkOf(options)), "inproc", options, threads);
}

#if defined(DFB_HAS_MPI)
int runMpi(MPI_Comm communicator, const Options& options, int threads)
{
    return runOver(dfb::connect<dfb::MpiTransport>(communicator, networkOf(options)), "mpi", options, threads);
}
#endif

} // namespace example
