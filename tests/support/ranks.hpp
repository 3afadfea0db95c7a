// Helpers for ranks of MPI. All but rankIn() and sizeOf() are collective.
#pragma once

#include "undisturbed.hpp"

#include <dfb/comm/node_memory.hpp>

#include <mpi.h>

#include <algorithm>
#include <cstddef>
#include <string>
#include <vector>

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

// Whether this rank has the same text as rank 0, of which 3999 characters count. Collective over MPI_COMM_WORLD.
inline bool sameEverywhere(const std::string& text)
{
    std::vector<char> first(4000);
    std::copy_n(text.begin(), std::min(text.size(), first.size() - 1), first.begin());
    MPI_Bcast(first.data(), static_cast<int>(first.size()), MPI_CHAR, 0, MPI_COMM_WORLD);
    return text.compare(0, first.size() - 1, first.data()) == 0;
}

// Calls run() up to four times, as long as any rank's process stood still meanwhile; see undisturbed(). Collective over
// MPI_COMM_WORLD.
template <class Run>
auto undisturbedRanks(const Run& run)
{
    return undisturbed(run, [](bool stoodStill, const auto&) {
        MPI_Allreduce(MPI_IN_PLACE, &stoodStill, 1, MPI_CXX_BOOL, MPI_LOR, MPI_COMM_WORLD);
        return stoodStill;
    });
}

// Whether each rank can open memory of the next one. A system may forbid it. Collective over `communicator`.
inline bool seesNextRank(MPI_Comm communicator)
{
    using Memory = dfb::detail::NodeMemory;
    const auto mine = Memory::create();
    const Memory::Address address = mine ? mine->address() : Memory::Address();
    const int size = sizeOf(communicator), rank = rankIn(communicator);
    std::vector<Memory::Address> all(static_cast<std::size_t>(size));
    MPI_Allgather(&address, sizeof address, MPI_BYTE, all.data(), sizeof address, MPI_BYTE, communicator);
    int sees = Memory::open(all[static_cast<std::size_t>((rank + 1) % size)]) != nullptr;
    MPI_Allreduce(MPI_IN_PLACE, &sees, 1, MPI_INT, MPI_MIN, communicator);
    return sees != 0;
}
