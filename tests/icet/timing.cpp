// Measures icetCompositeImage of IceT, with each of its strategies, and of libdfb_icet, in turn for each frame:
//   mpirun -n 4 test_icet_timing IceTCore.so libdfb_icet.so [--frames N] [--size PIXELS]
// Prints medians over the frames: of the time from a barrier until the last rank returns, and of the processor time of
// all ranks, without what IceT's ranks spend in sched_yield() while they wait. On a machine that does other work,
// compare processor times.
//   dense:  each rank has pixels everywhere
//   bricks: each rank has pixels in a rectangle of its own, of 1/ranks of the picture and half as much around it
#include "setup.hpp"

#include "icet.hpp"

#include <mpi.h>

#include <cstdio>
#include <cstdlib>
#include <string>

#include <sys/resource.h>

namespace icet_test {
namespace {

// ---- the images

struct Images {
    std::vector<std::uint8_t> bytes;
    std::vector<float> floats, depth;
    IceTInt valid[4] = {0, 0, 0, 0};
};

// A smooth layer, a third of which is opaque, as rendered images often are.
Images makeImages(int size, int rank, int ranks, bool isBricks)
{
    Images images;
    int columns = 1;
    while ((columns + 1) * (columns + 1) <= ranks)
        ++columns;
    const int rows = (ranks + columns - 1) / columns;
    const int width = isBricks ? size / columns : size, height = isBricks ? size / rows : size;
    const int x0 = isBricks ? std::max(0, rank % columns * width - width / 8) : 0;
    const int y0 = isBricks ? std::max(0, rank / columns * height - height / 8) : 0;
    const int x1 = std::min(size, x0 + width * 5 / 4), y1 = std::min(size, y0 + height * 5 / 4);
    const auto count = static_cast<std::size_t>(size) * static_cast<std::size_t>(size);
    images.bytes.resize(4 * count);
    images.depth.assign(count, 1.0f);
    for (int y = y0; y < y1; ++y)
        for (int x = x0; x < x1; ++x) {
            const std::size_t at =
                static_cast<std::size_t>(y) * static_cast<std::size_t>(size) + static_cast<std::size_t>(x);
            const int alpha = (x / 32 + y / 32 + rank) % 3 == 0 ? 255 : 40 + (x + y) % 120;
            images.bytes[4 * at + 3] = static_cast<std::uint8_t>(alpha);
            for (std::size_t c = 0; c < 3; ++c)
                images.bytes[4 * at + c] =
                    static_cast<std::uint8_t>(alpha * ((x + 50 * static_cast<int>(c)) % 256) / 255);
            images.depth[at] = static_cast<float>((7 * x + 3 * y + 400 * rank) % 1000) / 1000;
        }
    images.floats.resize(4 * count);
    for (std::size_t i = 0; i < 4 * count; ++i)
        images.floats[i] = static_cast<float>(images.bytes[i]) / 255;
    images.valid[0] = x0, images.valid[1] = y0, images.valid[2] = x1 - x0, images.valid[3] = y1 - y0;
    return images;
}

// ---- what is timed

enum class Way { BlendBytes, BlendFloats, NearestBytes, NearestFloats };
bool blends(Way way) { return way == Way::BlendBytes || way == Way::BlendFloats; }
bool isFloat(Way way) { return way == Way::BlendFloats || way == Way::NearestFloats; }

struct Strategy {
    const char* name;
    IceTEnum strategy, single;
};
const Strategy strategies[] = {
    {"sequential, automatic", ICET_STRATEGY_SEQUENTIAL, ICET_SINGLE_IMAGE_STRATEGY_AUTOMATIC},
    {"sequential, binary swap", ICET_STRATEGY_SEQUENTIAL, ICET_SINGLE_IMAGE_STRATEGY_BSWAP},
    {"sequential, tree", ICET_STRATEGY_SEQUENTIAL, ICET_SINGLE_IMAGE_STRATEGY_TREE},
    {"sequential, radix-k", ICET_STRATEGY_SEQUENTIAL, ICET_SINGLE_IMAGE_STRATEGY_RADIXK},
    {"sequential, radix-kr", ICET_STRATEGY_SEQUENTIAL, ICET_SINGLE_IMAGE_STRATEGY_RADIXKR},
    {"reduce", ICET_STRATEGY_REDUCE, ICET_SINGLE_IMAGE_STRATEGY_AUTOMATIC},
    {"direct", ICET_STRATEGY_DIRECT, ICET_SINGLE_IMAGE_STRATEGY_AUTOMATIC},
    {"split", ICET_STRATEGY_SPLIT, ICET_SINGLE_IMAGE_STRATEGY_AUTOMATIC},
    {"vtree", ICET_STRATEGY_VTREE, ICET_SINGLE_IMAGE_STRATEGY_AUTOMATIC},
};

struct Client {
    const Api* api;
    IceTContext context;
    Strategy strategy;
    std::vector<double> seconds, cpuSeconds;

    static double median(std::vector<double> all)
    {
        std::sort(all.begin(), all.end());
        return 1e3 * all[all.size() / 2];
    }
    double wallMs() const { return median(seconds); }
    double cpuMs() const { return median(cpuSeconds); }
};

// Processor time of this process, without what it spends in sched_yield() while it waits.
double cpuSeconds()
{
    rusage usage{};
    getrusage(RUSAGE_SELF, &usage);
    const auto seconds = [](const timeval& t) {
        return static_cast<double>(t.tv_sec) + 1e-6 * static_cast<double>(t.tv_usec);
    };
    return seconds(usage.ru_utime) + seconds(usage.ru_stime) - bench::yieldedSeconds();
}

void barrier()
{
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Ibarrier(MPI_COMM_WORLD, &request);
    bench::complete(request);
}

void set(const Client& client, Way way, int size)
{
    const Api& api = *client.api;
    api.icetSetContext(client.context);
    api.icetDiagnostics(ICET_DIAG_ERRORS | ICET_DIAG_ALL_NODES);
    api.icetResetTiles();
    api.icetAddTile(0, 0, size, size, 0);
    api.icetSetColorFormat(isFloat(way) ? ICET_IMAGE_COLOR_RGBA_FLOAT : ICET_IMAGE_COLOR_RGBA_UBYTE);
    api.icetSetDepthFormat(blends(way) ? ICET_IMAGE_DEPTH_NONE : ICET_IMAGE_DEPTH_FLOAT);
    api.icetCompositeMode(blends(way) ? ICET_COMPOSITE_MODE_BLEND : ICET_COMPOSITE_MODE_Z_BUFFER);
    api.icetEnable(ICET_ORDERED_COMPOSITE);
    api.icetStrategy(client.strategy.strategy);
    api.icetSingleImageStrategy(client.strategy.single);
}

// Notes the longest time of any rank, and the processor time of all ranks.
void timeFrame(Client& client, Way way, const Images& images, bool counts)
{
    constexpr IceTDouble identity[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    constexpr IceTFloat background[4] = {0, 0, 0, 0};
    const void* color = isFloat(way) ? static_cast<const void*>(images.floats.data()) : images.bytes.data();
    client.api->icetSetContext(client.context);
    barrier();
    const double before = MPI_Wtime(), cpuBefore = cpuSeconds();
    client.api->icetCompositeImage(color, blends(way) ? nullptr : images.depth.data(), images.valid, identity, identity,
                                   background);
    const double seconds = MPI_Wtime() - before, cpu = cpuSeconds() - cpuBefore;
    double longest = 0, all = 0;
    MPI_Request requests[2];
    MPI_Iallreduce(&seconds, &longest, 1, MPI_DOUBLE, MPI_MAX, MPI_COMM_WORLD, &requests[0]);
    MPI_Iallreduce(&cpu, &all, 1, MPI_DOUBLE, MPI_SUM, MPI_COMM_WORLD, &requests[1]);
    for (MPI_Request& request : requests)
        bench::complete(request);
    if (!counts)
        return;
    client.seconds.push_back(longest);
    client.cpuSeconds.push_back(all);
}

int run(int count, char** words)
{
    if (count < 3)
        throw std::runtime_error("usage: test_icet_timing ICET DFB_ICET [--frames N] [--size PIXELS]");
    int frames = 40, size = 1024, rank = 0, ranks = 1;
    for (int i = 3; i + 1 < count; i += 2)
        (words[i] == std::string("--size") ? size : frames) = std::atoi(words[i + 1]);
    MPI_Comm_rank(MPI_COMM_WORLD, &rank);
    MPI_Comm_size(MPI_COMM_WORLD, &ranks);
    const Api icet("IceT", words[1]), dfb("dfb_icet", words[2]);
    bench::IceTTraffic traffic;
    bench::IceTMpi mpi(MPI_COMM_WORLD, traffic);
    IceTCommunicator (*create)(MPI_Comm) = nullptr;
    dfb.find(create, "icetCreateMPICommunicator");
    std::vector<Client> clients;
    for (const Strategy& strategy : strategies)
        clients.push_back({&icet, icet.icetCreateContext(&mpi), strategy, {}, {}});
    clients.push_back({&dfb, dfb.icetCreateContext(create(MPI_COMM_WORLD)), strategies[0], {}, {}});
    const Client& ours = clients.back();
    for (const bool isBricks : {false, true}) {
        const Images images = makeImages(size, rank, ranks, isBricks);
        for (const auto& [way, name] :
             {std::make_pair(Way::BlendBytes, "blend, 8 bit"), std::make_pair(Way::BlendFloats, "blend, float"),
              std::make_pair(Way::NearestBytes, "nearest, 8 bit"),
              std::make_pair(Way::NearestFloats, "nearest, float")}) {
            for (Client& client : clients) {
                set(client, way, size);
                client.seconds.clear();
                client.cpuSeconds.clear();
            }
            for (int frame = -2; frame < frames; ++frame) // the first two frames allocate memory
                for (Client& client : clients)
                    timeFrame(client, way, images, frame >= 0);
            const auto best =
                std::min_element(clients.begin(), clients.end() - 1,
                                 [](const Client& a, const Client& b) { return a.wallMs() < b.wallMs(); });
            if (rank == 0)
                std::printf(
                    "%d ranks, %-6s %-14s IceT %6.2f ms, CPU %6.2f (%s); dfb %6.2f ms, CPU %6.2f: %.2f, %.2f of it\n",
                    ranks, isBricks ? "bricks" : "dense", name, best->wallMs(), best->cpuMs(), best->strategy.name,
                    ours.wallMs(), ours.cpuMs(), ours.wallMs() / best->wallMs(), ours.cpuMs() / best->cpuMs());
        }
    }
    for (Client& client : clients)
        client.api->icetDestroyContext(client.context);
    return 0;
}

} // namespace
} // namespace icet_test

int main(int count, char** words)
{
    MPI_Init(&count, &words);
    try {
        icet_test::run(count, words);
    } catch (const std::exception& e) {
        std::fprintf(stderr, "%s\n", e.what());
        MPI_Abort(MPI_COMM_WORLD, 2);
    }
    MPI_Finalize();
    return 0;
}
