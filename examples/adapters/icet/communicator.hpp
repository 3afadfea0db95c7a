// The functions of this library that IceTMPI.h and IceTGL.h declare, and the MPI communicator of one of IceT.
#pragma once

#include <IceT.h>
#include <mpi.h>

extern "C" {
IceTCommunicator icetCreateMPICommunicator(MPI_Comm comm);
void icetDestroyMPICommunicator(IceTCommunicator communicator);
void icetGLInitialize();
IceTBoolean icetGLIsInitialized();
}

namespace dfb_icet {

// Throws Error if it is not from icetCreateMPICommunicator().
MPI_Comm mpiOf(IceTCommunicator communicator);

} // namespace dfb_icet
