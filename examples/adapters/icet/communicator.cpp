// Communicators. icetCreateMPICommunicator() is the only way to get one: the library talks to MPI itself, so a
// client's own table of functions is of no use to it.
#include "communicator.hpp"

#include "errors.hpp"

#include <dfb/comm/mpi_calls.hpp>

namespace dfb_icet {

namespace {

MPI_Comm& commOf(IceTCommunicator self) { return *static_cast<MPI_Comm*>(self->data); }

IceTCommunicator make(MPI_Comm from);

IceTCommunicator duplicate(IceTCommunicator self) { return make(commOf(self)); }

void destroy(IceTCommunicator self)
{
    int isFinalised = 0;
    MPI_Finalized(&isFinalised);
    if (!isFinalised)
        MPI_Comm_free(&commOf(self));
    delete &commOf(self);
    delete self;
}

IceTCommunicator make(MPI_Comm from)
{
    int isThere = 0;
    MPI_Initialized(&isThere);
    if (!isThere)
        throw Error(ICET_INVALID_OPERATION, "MPI is not initialised");
    if (from == MPI_COMM_NULL) // on ranks outside of a part of the job
        return nullptr;
    auto* comm = new IceTCommunicatorStruct{};
    comm->data = new MPI_Comm(MPI_COMM_NULL);
    MPI_Comm_dup(from, &commOf(comm));
    comm->Duplicate = duplicate;
    comm->Destroy = destroy;
    comm->Barrier = [](IceTCommunicator self) { MPI_Barrier(commOf(self)); };
    comm->Comm_size = [](IceTCommunicator self) {
        int size = 0;
        MPI_Comm_size(commOf(self), &size);
        return size;
    };
    comm->Comm_rank = [](IceTCommunicator self) {
        int rank = 0;
        MPI_Comm_rank(commOf(self), &rank);
        return rank;
    };
    return comm;
}

} // namespace

MPI_Comm mpiOf(IceTCommunicator communicator)
{
    if (!communicator)
        throw Error(ICET_INVALID_VALUE, "there is no communicator");
    if (communicator->Duplicate != duplicate)
        throw Error(ICET_INVALID_OPERATION, "this communicator has functions of its own, which cannot be used here: "
                                            "make one with icetCreateMPICommunicator()");
    return commOf(communicator);
}

extern "C" IceTCommunicator icetCreateMPICommunicator(MPI_Comm comm)
{
    return guarded("icetCreateMPICommunicator", [&] {
        dfb::detail::requireMpiOfHeaders();
        return make(comm);
    });
}

extern "C" void icetDestroyMPICommunicator(IceTCommunicator communicator)
{
    guarded("icetDestroyMPICommunicator", [&] {
        if (communicator)
            mpiOf(communicator), destroy(communicator);
    });
}

} // namespace dfb_icet
