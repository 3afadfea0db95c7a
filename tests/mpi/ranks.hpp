// Rank and size of a communicator as values.
#pragma once

#include <mpi.h>

inline int rankIn(MPI_Comm communicator)
{
    int rank = 0;
    MPI_Comm_rank(communicator, &rank);
    return rank;
}

inline int sizeOf(MPI_Comm communicator)
{
    int size = 0;
    MPI_Comm_size(communicator, &size);
    return size;
}
