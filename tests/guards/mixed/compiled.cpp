// The file that is compiled with dfb::compiled; see headers.cpp.
#define DFB_COMPILED
#include <dfb/comm/connection.hpp>
#include <dfb/comm/inproc_transport.hpp>

int compiled();

int compiled()
{
    int threads = 0;
    dfb::runRanks(1, [&](const dfb::InprocCommunicator& communicator) {
        threads = dfb::detail::makeThreads(*dfb::connect<dfb::InprocTransport>(communicator))->concurrency();
    });
    return threads > 0 ? 0 : 1;
}
