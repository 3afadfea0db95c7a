#include "context.hpp"

#include "communicator.hpp"
#include "errors.hpp"

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <numeric>

#include <sched.h>

namespace dfb_icet {

namespace {

IceTContext current = nullptr;

// All existing contexts, in the order in which they were made, which is the same on all ranks.
std::vector<IceTContext> contexts;

void requireThere(IceTContext context)
{
    if (std::find(contexts.begin(), contexts.end(), context) == contexts.end())
        throw Error(ICET_INVALID_VALUE, "there is no such context");
}

// MPI_Finalize() calls this first, because a client may forget its contexts, which have messages under way.
int closeAll(MPI_Comm, int, void*, void*)
{
    for (const IceTContext context : contexts)
        guarded("MPI_Finalize", [&] { context->close(); });
    return MPI_SUCCESS;
}

void closeBeforeMpiEnds(IceTContext context)
{
    static bool isAsked = false;
    contexts.push_back(context);
    if (isAsked)
        return;
    int key = MPI_KEYVAL_INVALID;
    MPI_Comm_create_keyval(MPI_COMM_NULL_COPY_FN, closeAll, &key, nullptr);
    MPI_Comm_set_attr(MPI_COMM_SELF, key, nullptr);
    MPI_Comm_free_keyval(&key);
    isAsked = true;
}

void forget(IceTContext context) { contexts.erase(std::find(contexts.begin(), contexts.end(), context)); }

// Only the client's own thread calls MPI, at every thread level: all ranks composite at the same time anyway, and a
// client may forget its contexts. MPICH no longer locks once MPI_Finalize() has begun.
std::shared_ptr<dfb::Connection> connectRanks(MPI_Comm communicator)
{
    dfb::NetworkConfig network;
    network.progress = dfb::Progress::Caller;
    return dfb::connect(communicator, network);
}

// A rank with one processor composites in the thread that waits, and makes no threads.
std::shared_ptr<dfb::Executor> makeExecutor(dfb::Connection& connection)
{
    if (connection.threadShare() == 1)
        return std::make_shared<dfb::CallerExecutor>();
    return dfb::detail::makeThreads(connection);
}

} // namespace

Settings::Settings()
{
    for (const IceTEnum option :
         {ICET_FLOATING_VIEWPORT, ICET_COMPOSITE_ONE_BUFFER, ICET_INTERLACE_IMAGES, ICET_COLLECT_IMAGES})
        enabled[option - ICET_STATE_ENABLE_START] = true;
}

Region Settings::wall() const
{
    if (tiles.empty())
        return {};
    Region all = tiles.front().viewport;
    for (const auto& [tile, displayRank] : tiles)
        all = {std::min(all.x0, tile.x0), std::min(all.y0, tile.y0), std::max(all.x1, tile.x1),
               std::max(all.y1, tile.y1)};
    return all;
}

std::array<int, 2> Settings::largestTile() const
{
    std::array<int, 2> size{};
    for (const Tile& tile : tiles)
        size = {std::max(size[0], tile.viewport.width()), std::max(size[1], tile.viewport.height())};
    return size;
}

int Settings::tileOf(int displayRank) const
{
    const auto place =
        std::find_if(tiles.begin(), tiles.end(), [&](const Tile& tile) { return tile.displayRank == displayRank; });
    return place == tiles.end() ? -1 : static_cast<int>(place - tiles.begin());
}

void requireNotDrawing(const IceTContextStruct& context)
{
    if (context.isDrawing)
        throw Error(ICET_INVALID_OPERATION, "not while a frame is drawn");
}

std::vector<int> gatherColors(const IceTContextStruct& context, int color)
{
    struct Gather {
        int own;
        std::vector<int> all;
    };
    auto gather = std::make_unique<Gather>(Gather{color, std::vector<int>(static_cast<std::size_t>(context.size()))});
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Iallgather(&gather->own, 1, MPI_INT, gather->all.data(), 1, MPI_INT, context.comm, &request);
    const double limit = secondsNow() + std::chrono::duration<double>(timeLimit()).count();
    // While it waits, it yields the core to ranks that have not called yet.
    for (int isDone = 0; MPI_Test(&request, &isDone, MPI_STATUS_IGNORE), !isDone; sched_yield())
        if (timeLimit().count() > 0 && secondsNow() > limit) {
            gather.release(); // MPI may still write there
            throw Error(ICET_INVALID_OPERATION, "some ranks have not come here: they have left out this call, or only "
                                                "some ranks have changed tiles, formats, mode or background");
        }
    return gather->all;
}

double secondsNow()
{
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

bool wantsStatistics()
{
    const char* value = std::getenv("DFB_ICET_STATS");
    return value && *value && *value != '0';
}

std::chrono::milliseconds timeLimit()
{
    static const double seconds = [] {
        const char* value = std::getenv("DFB_ICET_TIMEOUT");
        char* end = nullptr;
        const double given = value ? std::strtod(value, &end) : 600.0;
        if (value && (end == value || *end != '\0' || !(given >= 0))) {
            std::fprintf(stderr, "dfb: DFB_ICET_TIMEOUT is '%s', which is no number of seconds; it is 600 now\n",
                         value);
            return 600.0;
        }
        return std::min(given, 1e6);
    }();
    return std::chrono::milliseconds(static_cast<std::int64_t>(1000 * seconds));
}

extern "C" IceTContext icetCreateContext(IceTCommunicator communicator)
{
    return guarded("icetCreateContext", [&] {
        if (current)
            requireNotDrawing(*current);
        return current = new IceTContextStruct(mpiOf(communicator));
    });
}

extern "C" void icetDestroyContext(IceTContext context)
{
    guarded("icetDestroyContext", [&] {
        requireThere(context);
        requireNotDrawing(*context);
        if (context == current)
            current = nullptr;
        delete context;
    });
}

extern "C" IceTContext icetGetContext() { return current; }

extern "C" void icetSetContext(IceTContext context)
{
    guarded("icetSetContext", [&] {
        if (context)
            requireThere(context);
        if (current)
            requireNotDrawing(*current);
        current = context;
    });
}

extern "C" void icetCopyState(IceTContext to, const IceTContext from)
{
    guarded("icetCopyState", [&] {
        requireThere(to);
        requireThere(from);
        requireNotDrawing(*to);
        to->settings = from->settings;
    });
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

extern "C" void icetDataReplicationGroup(IceTInt size, const IceTInt* processes)
{
    inContext("icetDataReplicationGroup", [&](IceTContextStruct& context) {
        const std::vector<int> group(processes, processes + std::max(size, 0));
        std::vector<int> ranks = group;
        std::sort(ranks.begin(), ranks.end());
        const bool isSet = std::adjacent_find(ranks.begin(), ranks.end()) == ranks.end();
        if (!isSet || !std::binary_search(ranks.begin(), ranks.end(), context.rank()) || ranks.front() < 0
            || ranks.back() >= context.size())
            throw Error(ICET_INVALID_VALUE, "a group has different ranks, and the calling one among them");
        context.replicas = group;
    });
}

extern "C" void icetGLInitialize()
{
    inContext("icetGLInitialize", [](IceTContextStruct& context) { context.hasGl = true; });
}

extern "C" IceTBoolean icetGLIsInitialized() { return current && current->hasGl ? ICET_TRUE : ICET_FALSE; }

} // namespace dfb_icet

IceTContextStruct::IceTContextStruct(MPI_Comm communicator)
    : connection(dfb_icet::connectRanks(communicator)), ownRank(connection->rank())
{
    MPI_Comm_dup(communicator, &comm);
    executor = dfb_icet::makeExecutor(*connection); // if this rank can make none, no other rank waits for it
    order.resize(static_cast<std::size_t>(connection->size()));
    std::iota(order.begin(), order.end(), 0);
    replicas = {ownRank};
    dfb_icet::closeBeforeMpiEnds(this);
}

IceTContextStruct::~IceTContextStruct()
{
    close();
    dfb_icet::forget(this);
}

void IceTContextStruct::close()
{
    if (!connection)
        return;
    rendered = {};
    result = {};
    pictures.clear();
    connection.reset();
    MPI_Comm_free(&comm);
}
