// Ranks: makes a connection from what a program gives as `comm`.
#pragma once

#include "errors.hpp"

#include <dfb/comm/inproc_transport.hpp>
#if defined(DFB_HAS_MPI)
#include <dfb/comm/mpi_transport.hpp>
#endif

#include <pybind11/pybind11.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace dfb_python {

// Connects the ranks of `comm`: None is one rank, a dfb.ThreadCommunicator a group of threads, an int the address of an
// MPI_Comm. With the GIL, which it releases. Collective. Throws dfb::Error.
inline std::shared_ptr<dfb::Connection> connect(const py::object& comm)
{
    std::optional<dfb::InprocCommunicator> threads;
    if (comm.is_none())
        threads.emplace(std::make_shared<dfb::detail::InprocHub>(1), 0);
    else if (py::isinstance<dfb::InprocCommunicator>(comm))
        threads = comm.cast<dfb::InprocCommunicator>();
    if (threads) {
        const py::gil_scoped_release released;
        return dfb::connect<dfb::InprocTransport>(*threads);
    }
#if defined(DFB_HAS_MPI)
    const auto* communicator = reinterpret_cast<const MPI_Comm*>(comm.cast<std::uintptr_t>());
    const py::gil_scoped_release released;
    return dfb::connect<dfb::MpiTransport>(*communicator);
#else
    throw dfb::InvalidArgument("this module was built without MPI");
#endif
}

#if defined(DFB_HAS_MPI)
// The MPI of the headers that this module was compiled with.
inline std::string mpiHeaders()
{
#if defined(OPEN_MPI)
    return dfb::detail::printed("Open MPI %d.%d.%d", OMPI_MAJOR_VERSION, OMPI_MINOR_VERSION, OMPI_RELEASE_VERSION);
#elif defined(MPICH_VERSION)
    return std::string("MPICH ") + MPICH_VERSION;
#else
    return dfb::detail::printed("a library of MPI %d.%d", MPI_VERSION, MPI_SUBVERSION);
#endif
}

// The MPI whose functions this module calls, by its own words. If the process has loaded another MPI too, these may not
// be the functions of the library that this module was linked to.
inline std::string mpiLibrary()
{
    std::vector<char> text(MPI_MAX_LIBRARY_VERSION_STRING);
    int length = 0;
    if (MPI_Get_library_version(text.data(), &length) != MPI_SUCCESS)
        return "unknown";
    return std::string(text.data(), static_cast<std::size_t>(length));
}
#endif

// Calls body(communicator) on `count` threads, one for each rank, and returns the results by rank. Throws the first
// exception of a body, unchanged.
inline py::list runRanks(int count, const py::object& body)
{
    const auto cause = Cause::make();
    std::vector<py::object> results(static_cast<std::size_t>(std::max(count, 0)));
    try {
        const py::gil_scoped_release released;
        dfb::runRanks(count, [&](const dfb::InprocCommunicator& communicator) {
            withPython(*cause, [&] { results[static_cast<std::size_t>(communicator.rank())] = body(communicator); });
        });
    } catch (...) {
        const py::object first = cause->take();
        if (first.is_none())
            throw;
        setAgain(first);
        throw py::error_already_set();
    }
    py::list list;
    for (const py::object& result : results)
        list.append(result);
    return list;
}

} // namespace dfb_python
