// A program that has initialised MPI at any thread level gets its images with default settings. On each rank a progress
// thread moves messages or, below MPI_THREAD_MULTIPLE, the caller does, and then no other thread calls MPI. Also tests
// the errors of the constructor if Progress::Thread is not possible, and if MPI is not initialised, or not the one of
// the headers. MPI can be initialised only once in a process:
//   mpirun -n 2 mpi_level mixed      rank 0 with MPI_Init, the others at MPI_THREAD_MULTIPLE
// Returns 0 if all is well.
#include <dfb/dfb.hpp>

#include <mpi.h>

#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <memory>
#include <string>
#include <thread>
#include <vector>

namespace {

using Single = dfb::BasicImageParallel<16>;
using FrameBuffer = dfb::DistributedFrameBuffer<Single>;

int failures = 0;

void check(bool fine, const std::string& what, const std::string& text = "")
{
    if (fine)
        return;
    ++failures;
    std::fprintf(stderr, "mpi_level: %s: %s\n", what.c_str(), text.c_str());
}

bool has(const std::string& text, const char* part) { return text.find(part) != std::string::npos; }

std::thread::id mainThread;
std::atomic<int> callsElsewhere{0}; // of MPI, by other threads than that

std::atomic<int> sends{0};

std::atomic<int> callsNow{0}, overlaps{0}; // of sending and testing
std::atomic<bool> areSlow{false};          // so that overlaps are likely

struct Call {
    Call()
    {
        overlaps += callsNow++ > 0;
        if (areSlow)
            std::this_thread::sleep_for(std::chrono::microseconds(30));
    }
    ~Call() { --callsNow; }
};

bool isOtherMpi = false; // then MPI calls itself by another name

void noteCall() { callsElsewhere += std::this_thread::get_id() != mainThread; }

dfb::FrameBufferConfig smallConfig()
{
    dfb::FrameBufferConfig config;
    config.image.width = 50;
    config.image.height = 40;
    config.executor = std::make_shared<dfb::ThreadExecutor>(2); // other threads, also where there is one core
    return config;
}

std::string transportErrorOf(dfb::Progress progress)
{
    try {
        dfb::NetworkConfig options;
        options.progress = progress;
        dfb::connect(MPI_COMM_WORLD, options);
    } catch (const dfb::TransportError& e) {
        return e.what();
    } catch (const std::exception& e) {
        return std::string("another exception: ") + e.what();
    }
    return "no exception";
}

// Green and blue of tile `index` in frame `frame`, in 8 bits.
std::uint8_t greenOf(int frame) { return static_cast<std::uint8_t>(51 * frame); }
std::uint8_t blueOf(int index) { return static_cast<std::uint8_t>(51 * (index % 6)); }

template <class Fb>
dfb::FrameReport renderTiles(Fb& fb, int frame)
{
    return dfb::ImageParallelLoop(fb).render([&](auto& tile) {
        tile.fill({0, greenOf(frame) / 255.0f, blueOf(tile.tile) / 255.0f, 1});
    });
}

// `origin`: where the image is in the framebuffer's.
void checkImage(const dfb::Image& image, const dfb::TileLayout& layout, int frame, const std::string& what,
                int originX = 0)
{
    int wrong = 0;
    for (int y = 0; y < image.height(); ++y)
        for (int x = 0; x < image.width(); ++x) {
            const std::uint8_t* p = image.rgba8() + 4 * (image.width() * y + x);
            wrong += p[1] != greenOf(frame) || p[2] != blueOf(layout.tileAt((originX + x) / 16, y / 16)) || p[3] != 255;
        }
    check(wrong == 0, what + ": pixels that are wrong", std::to_string(wrong));
}

void frames(const dfb::FrameBufferConfig& config, dfb::Progress expected, const std::string& what)
{
    FrameBuffer fb(MPI_COMM_WORLD, config);
    for (int frame = 0; frame < 3; ++frame) {
        const dfb::FrameReport report = renderTiles(fb, frame);
        check(report.progress == expected, what + ": who moved the messages");
        if (fb.isDisplayRank())
            checkImage(fb.image(), fb.layout(), frame, what);
        // No more is needed of this rank: others get on while it waits in MPI for them.
        MPI_Barrier(MPI_COMM_WORLD);
    }
}

// What a camera must have.
struct Flat {
    dfb::Region project(const dfb::Box3& bounds, int, int) const
    {
        return {static_cast<int>(bounds.lower.x), static_cast<int>(bounds.lower.y), static_cast<int>(bounds.upper.x),
                static_cast<int>(bounds.upper.y)};
    }
};

// A wall, and beside its framebuffer another on the same connection, with bricks that all ranks have.
void wallAndSharedWorld()
{
    const auto connection = dfb::connect<dfb::MpiTransport>(MPI_COMM_WORLD);
    const int last = connection->size() - 1;
    const dfb::WallLayout layout{2, 1, 40, 30, 0, 0, {last, 0}};
    dfb::DisplayWall wall(connection, layout, dfb::OutputFormat::RGBA8);
    dfb::DistributedFrameBuffer<Single, dfb::ToWall> fb(connection, wall.frameBufferConfig(), {&wall});
    dfb::FrameBufferConfig config;
    config.image.width = 64;
    config.image.height = 32;
    dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>> bricks(connection, config);
    const dfb::World both({{3, {{0, 0, 0}, {32, 32, 1}}}, {9, {{32, 0, 0}, {64, 32, 1}}}});
    const dfb::SharedWorld world(bricks, both);
    dfb::RoundRobinBricks inTurn;
    for (int frame = 0; frame < 3; ++frame) {
        const dfb::FrameReport report = renderTiles(fb, frame);
        wall.finish(report.frame);
        for (int d = 0; d < 2; ++d)
            if (layout.ranks[static_cast<std::size_t>(d)] == connection->rank())
                checkImage(wall.image(d), fb.layout(), frame, "display " + std::to_string(d), 40 * d);

        dfb::MixedParallelLoop(bricks, world, inTurn).render(Flat(), [&](const dfb::Brick& brick, auto& tile) {
            const dfb::Region inside = dfb::intersection(tile.region, Flat().project(brick.bounds, 64, 32));
            tile.forEachPixel([&](int x, int y, float* rgba, float& depth) {
                if (x < inside.x0 || x >= inside.x1 || y < inside.y0 || y >= inside.y1)
                    return;
                rgba[0] = static_cast<float>(brick.id) / 255;
                rgba[1] = greenOf(frame) / 255.0f;
                rgba[3] = depth = 1;
            });
        });
        int wrong = 0;
        for (std::size_t i = 0; bricks.isDisplayRank() && i < bricks.image().pixelCount(); ++i) {
            const std::uint8_t* p = bricks.image().rgba8() + 4 * i;
            wrong += p[0] != (i % 64 < 32 ? 3 : 9) || p[1] != greenOf(frame);
        }
        check(wrong == 0, "bricks of a shared world: pixels that are wrong", std::to_string(wrong));
    }
}

std::string invalidArgumentOf(const std::function<void()>& call)
{
    std::string text = "no exception";
    std::thread([&] {
        try {
            call();
        } catch (const dfb::InvalidArgument& e) {
            text = e.what();
        } catch (const std::exception& e) {
            text = std::string("another exception: ") + e.what();
        }
    }).join();
    return text;
}

// What waits for messages on a thread that may not move them says so; it would wait for ever.
void otherThread()
{
    const char* const owner = "only the thread that has initialised MPI";
    FrameBuffer fb(MPI_COMM_WORLD, smallConfig());
    const std::string begin = invalidArgumentOf([&] { (void)fb.begin(); });
    check(has(begin, owner), "begin() on another thread", begin);
    const std::string reduce = invalidArgumentOf([&] { fb.allReduce({1}, FrameBuffer::Reduce::Sum); });
    check(has(reduce, owner), "allReduce() on another thread", reduce);
    auto frame = dfb::ImageParallelLoop(fb, dfb::WorkDistribution::Owned).start([](auto& tile) {
        tile.fill({0, greenOf(2) / 255.0f, blueOf(tile.tile) / 255.0f, 1});
    });
    const std::string end = invalidArgumentOf([&] { frame.end(); });
    check(has(end, owner), "end() on another thread", end);
    frame.end();
    if (fb.isDisplayRank())
        checkImage(fb.image(), fb.layout(), 2, "after end() on another thread");
}

// A renderer that polls, with owners far behind: workers have to wait in setTile(), and may have to poll.
void smallPool()
{
    auto config = smallConfig();
    config.messages.poolBytes = 1;
    config.image.ownerMap = [](int, const dfb::TileLayout&, int ranks) { return ranks - 1; };
    FrameBuffer fb(MPI_COMM_WORLD, config);
    std::vector<int> mine;
    for (int tile = fb.rank(); tile < fb.layout().tileCount(); tile += fb.size())
        mine.push_back(tile);
    for (int frame = 0; frame < 3; ++frame) {
        auto open = fb.begin();
        open.forEachTile(mine, [&](auto& tile) {
            tile.fill({0, greenOf(frame) / 255.0f, blueOf(tile.tile) / 255.0f, 1});
            fb.poll();
            open.setTile(tile);
        });
        open.end();
        if (fb.isDisplayRank())
            checkImage(fb.image(), fb.layout(), frame, "a small pool");
    }
}

// Messages leave while workers render, even if these may not call MPI, whatever the renderer does.
void whileWorkersRender()
{
    auto config = smallConfig();
    config.image.ownerMap = [](int tile, const dfb::TileLayout&, int ranks) { return (tile + 1) % ranks; };
    FrameBuffer fb(MPI_COMM_WORLD, config);
    std::vector<int> mine; // owned by others
    for (int tile = fb.rank(); tile < fb.layout().tileCount(); tile += fb.size())
        mine.push_back(tile);
    auto frame = fb.begin();
    std::atomic<int> kept{0};
    frame.forEachTile(mine, [&](auto& tile) {
        const int before = sends;
        tile.fill({0, greenOf(1) / 255.0f, blueOf(tile.tile) / 255.0f, 1});
        frame.setTile(tile);
        const auto limit = std::chrono::steady_clock::now() + std::chrono::seconds(5);
        while (sends == before && std::chrono::steady_clock::now() < limit)
            std::this_thread::yield();
        kept += sends == before;
    });
    frame.end();
    check(kept == 0, "inputs that were kept while workers rendered", std::to_string(kept));
    if (fb.isDisplayRank())
        checkImage(fb.image(), fb.layout(), 1, "while workers rendered");
}

// Workers wait for jobs, which come even if they may not call MPI; also while the thread that moves messages takes part
// in the loop, or runs a task that has a loop of its own.
void jobsOnDemand(const std::shared_ptr<dfb::Executor>& executor, int frameCount, std::chrono::milliseconds perTile)
{
    auto config = smallConfig();
    config.image.width = config.image.height = 100;
    config.executor = executor;
    config.onTile = [&](int, const auto&, const auto&) { executor->parallelFor(4, [](std::size_t) {}); };
    FrameBuffer fb(MPI_COMM_WORLD, config);
    dfb::ImageParallelLoop loop(fb, dfb::WorkDistribution::Dynamic);
    dfb::FrameConfig params;
    params.passes = 3;
    for (int frame = 0; frame < frameCount; ++frame)
        loop.render(
            [&](auto& tile) {
                const auto end = std::chrono::steady_clock::now() + perTile;
                while (std::chrono::steady_clock::now() < end)
                    std::this_thread::yield();
                tile.fill({0, greenOf(1) / 255.0f, blueOf(tile.tile) / 255.0f, 1});
            },
            params);
    if (fb.isDisplayRank())
        checkImage(fb.image(), fb.layout(), 1, "jobs on demand");
}

// Workers give tiles to two framebuffers, each with a connection of its own.
void twoConnections()
{
    auto config = smallConfig();
    config.image.width = config.image.height = 256;
    FrameBuffer left(MPI_COMM_WORLD, config), right(MPI_COMM_WORLD, config);
    std::vector<int> mine;
    for (int tile = left.rank(); tile < left.layout().tileCount(); tile += left.size())
        mine.push_back(tile);
    areSlow = true;
    for (int number = 0; number < 5; ++number) {
        auto one = left.begin(), two = right.begin();
        one.forEachTile(mine, [&](auto& tile) {
            tile.fill({0, greenOf(1) / 255.0f, blueOf(tile.tile) / 255.0f, 1});
            one.setTile(tile);
            const auto other = std::make_unique<FrameBuffer::Tile>();
            two.start(*other, tile.tile, 0);
            other->fill({0, greenOf(1) / 255.0f, blueOf(tile.tile) / 255.0f, 1});
            two.setTile(*other);
        });
        one.end();
        two.end();
    }
    areSlow = false;
    if (left.isDisplayRank())
        for (const FrameBuffer* fb : {&left, &right})
            checkImage(fb->image(), fb->layout(), 1, "two connections");
}

} // namespace

// In place of MPI's own: all that the library does once it is there.
extern "C" {

int MPI_Isend(const void* data, int count, MPI_Datatype type, int to, int tag, MPI_Comm comm, MPI_Request* request)
{
    noteCall();
    const Call call;
    ++sends;
    return PMPI_Isend(data, count, type, to, tag, comm, request);
}

int MPI_Irecv(void* data, int count, MPI_Datatype type, int from, int tag, MPI_Comm comm, MPI_Request* request)
{
    noteCall();
    return PMPI_Irecv(data, count, type, from, tag, comm, request);
}

int MPI_Testsome(int count, MPI_Request requests[], int* done, int indices[], MPI_Status statuses[])
{
    noteCall();
    const Call call;
    return PMPI_Testsome(count, requests, done, indices, statuses);
}

int MPI_Testall(int count, MPI_Request requests[], int* done, MPI_Status statuses[])
{
    noteCall();
    return PMPI_Testall(count, requests, done, statuses);
}

int MPI_Get_library_version(char* text, int* length)
{
#if defined(OPEN_MPI)
    const std::string other = "MPICH Version: 4.0.2\nand more";
#else
    const std::string other = "Open MPI v4.1.4, and more";
#endif
    if (!isOtherMpi)
        return PMPI_Get_library_version(text, length);
    std::strcpy(text, other.c_str());
    *length = static_cast<int>(other.size());
    return MPI_SUCCESS;
}

int MPI_Test(MPI_Request* request, int* done, MPI_Status* status)
{
    noteCall();
    return PMPI_Test(request, done, status);
}

} // extern "C"

int main(int argc, char** argv)
{
    mainThread = std::this_thread::get_id();
    std::string asked = argc > 1 ? argv[1] : "";
    const bool isMixed = asked == "mixed"; // then what is collective is for all ranks or none
    if (isMixed) {
        const char* rank = std::getenv("PMI_RANK") ? std::getenv("PMI_RANK") : std::getenv("OMPI_COMM_WORLD_RANK");
        asked = rank && std::atoi(rank) == 0 ? "single" : "multiple";
    }
    isOtherMpi = true;
    const std::string other = transportErrorOf(dfb::Progress::Auto);
    isOtherMpi = false;
    check(has(other, "transport failure") && has(other, "compiled for") && has(other, "of this process is"),
          "headers of another MPI", other);
    for (const auto progress : {dfb::Progress::Auto, dfb::Progress::Thread, dfb::Progress::Caller}) {
        const std::string text = transportErrorOf(progress);
        check(has(text, "transport failure") && has(text, "not initialised"), "before MPI_Init", text);
    }

    int wanted = MPI_THREAD_SINGLE, level = 0;
    if (asked == "single") {
        MPI_Init(&argc, &argv);
        MPI_Query_thread(&level);
    } else {
        wanted = asked == "funneled"     ? MPI_THREAD_FUNNELED
                 : asked == "serialized" ? MPI_THREAD_SERIALIZED
                                         : MPI_THREAD_MULTIPLE;
        MPI_Init_thread(&argc, &argv, wanted, &level);
    }
    if (level != wanted)
        std::printf("mpi_level: this MPI gives another level than asked for: level %d is what is tested\n", level);
    const auto expected = level == MPI_THREAD_MULTIPLE ? dfb::Progress::Thread : dfb::Progress::Caller;
    try {
        if (isMixed || level < MPI_THREAD_MULTIPLE) { // on all ranks, also those that could have it
            const std::string text = transportErrorOf(dfb::Progress::Thread);
            check(has(text, "transport failure")
                      && has(text, dfb::detail::mpiLevelName(isMixed ? MPI_THREAD_SINGLE : level))
                      && has(text, "MPI_THREAD_MULTIPLE"),
                  "Progress::Thread", text);
        }
        frames({50, 40}, expected, "default settings");
        frames(smallConfig(), expected, "two workers");
        wallAndSharedWorld();
        smallPool();
        whileWorkersRender();
        jobsOnDemand(std::make_shared<dfb::ThreadExecutor>(1), 2, std::chrono::milliseconds(3));
        jobsOnDemand(std::make_shared<dfb::ThreadExecutor>(2), 2, std::chrono::milliseconds(1));
#if defined(DFB_HAS_TBB)
        jobsOnDemand(std::make_shared<dfb::TbbExecutor>(2), 300, std::chrono::milliseconds(0));
#endif
        overlaps = 0;
        twoConnections();
        check(level == MPI_THREAD_MULTIPLE || overlaps == 0, "calls of MPI at once", std::to_string(overlaps));
        if (!isMixed && level < MPI_THREAD_SERIALIZED)
            otherThread();
    } catch (const std::exception& e) {
        check(false, "an exception", e.what());
    }
    if (level < MPI_THREAD_SERIALIZED)
        check(callsElsewhere == 0, "calls of MPI by other threads", std::to_string(callsElsewhere));
    else if (level == MPI_THREAD_MULTIPLE)
        check(callsElsewhere > 0, "no call of MPI by a progress thread");

    MPI_Finalize();
    const std::string after = transportErrorOf(dfb::Progress::Auto);
    check(has(after, "finalised"), "after MPI_Finalize", after);
    return failures;
}
