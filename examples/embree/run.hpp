// Run: one rank's whole run of dfb_render. It has source files of its own, as it takes long to compile.
#pragma once

#include "options.hpp"

#include <dfb/dfb.hpp>

#include <memory>

namespace example {

// Return the exit code, the same on all ranks. Exceptions are not caught.
int runInproc(const dfb::InprocCommunicator& communicator, const Options& options, int threads);
#if defined(DFB_HAS_MPI)
int runMpi(MPI_Comm communicator, const Options& options, int threads);
#endif
// For either transport, with --live.
int runLive(std::shared_ptr<dfb::Connection> connection, const Options& options, int threads);

} // namespace example
