#include "context.hpp"

#include "communicator.hpp"
#include "errors.hpp"

#include <algorithm>
#include <cstdlib>
#include <numeric>

#include <sched.h>

namespace dfb_icet {

namespace {

IceTContext current = nullptr;

// How often each rank, by its place, has which colour. Waits without keeping the core of a rank that has to come yet.
std::vector<int> gatherColors(const IceTContextStruct& context, int color)
{
    std::vector<int> all(static_cast<std::size_t>(context.size()));
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Iallgather(&color, 1, MPI_INT, all.data(), 1, MPI_INT, context.comm, &request);
    const double limit = secondsNow() + std::chrono::duration<double>(timeLimit()).count();
    for (int isDone = 0; MPI_Test(&request, &isDone, MPI_STATUS_IGNORE), !isDone; sched_yield())
        if (timeLimit().count() > 0 && secondsNow() > limit)
            throw Error(ICET_INVALID_OPERATION, "some rank does not call it");
    return all;
}

} // namespace

Settings::Settings()
{
    for (const IceTEnum option :
         {ICET_FLOATING_VIEWPORT, ICET_COMPOSITE_ONE_BUFFER, ICET_INTERLACE_IMAGES, ICET_COLLECT_IMAGES})
        enabled[option - ICET_STATE_ENABLE_START] = true;
}

Viewport Settings::wall() const
{
    Viewport all;
    for (const Tile& tile : tiles)
        all = hull(all, tile.viewport);
    return all;
}

int Settings::tileOf(int displayRank) const
{
    const auto place =
        std::find_if(tiles.begin(), tiles.end(), [&](const Tile& tile) { return tile.displayRank == displayRank; });
    return place == tiles.end() ? -1 : static_cast<int>(place - tiles.begin());
}

double secondsNow() { return MPI_Wtime(); }

bool wantsStatistics()
{
    const char* value = std::getenv("DFB_ICET_STATS");
    return value && *value && *value != '0';
}

std::chrono::milliseconds timeLimit()
{
    static const double seconds = [] {
        const char* value = std::getenv("DFB_ICET_TIMEOUT");
        return value ? std::clamp(std::atof(value), 0.0, 1e6) : 600.0;
    }();
    return std::chrono::milliseconds(static_cast<std::int64_t>(1000 * seconds));
}

extern "C" IceTContext icetCreateContext(IceTCommunicator communicator)
{
    return guarded(
        "icetCreateContext", [&] { return current = new IceTContextStruct(mpiOf(communicator)); }, IceTContext{});
}

extern "C" void icetDestroyContext(IceTContext context)
{
    if (context == current)
        current = nullptr;
    guarded(
        "icetDestroyContext", [&] { return delete context, 0; }, 0);
}

extern "C" IceTContext icetGetContext() { return current; }

extern "C" void icetSetContext(IceTContext context) { current = context; }

extern "C" void icetCopyState(IceTContext to, const IceTContext from)
{
    if (to && from)
        to->settings = from->settings;
    else
        raiseError("icetCopyState", Error(ICET_INVALID_VALUE, "there is no such context"));
}

extern "C" void icetDataReplicationGroupColor(IceTInt color)
{
    inContext("icetDataReplicationGroupColor", [&](IceTContextStruct& context) {
        const std::vector<int> all = gatherColors(context, color);
        context.replicas.clear();
        for (int rank = 0; rank < context.size(); ++rank)
            if (all[static_cast<std::size_t>(rank)] == color)
                context.replicas.push_back(rank);
    });
}

extern "C" void icetGLInitialize()
{
    inContext("icetGLInitialize", [](IceTContextStruct& context) { context.hasGl = true; });
}

extern "C" IceTBoolean icetGLIsInitialized() { return current && current->hasGl ? ICET_TRUE : ICET_FALSE; }

} // namespace dfb_icet

IceTContextStruct::IceTContextStruct(MPI_Comm communicator) : connection(dfb::connect(communicator))
{
    MPI_Comm_dup(communicator, &comm);
    executor = std::make_shared<dfb::ThreadExecutor>(connection->threadShare());
    order.resize(static_cast<std::size_t>(size()));
    std::iota(order.begin(), order.end(), 0);
    replicas = {rank()};
}

IceTContextStruct::~IceTContextStruct()
{
    int isFinalised = 0;
    MPI_Finalized(&isFinalised);
    if (!isFinalised)
        MPI_Comm_free(&comm);
}
