// A whole life of the framebuffer calls none of MPI's functions that wait for other ranks: they would spin, hold the
// library's lock, and wait for ever for a rank that has failed.   mpirun -n 3 mpi_blocking
// This program takes the place of those functions and counts. Returns 0 if all is well.
#include <dfb/comm/mpi_session.hpp>
#include <dfb/dfb.hpp>

#include <cstdint>
#include <cstdio>
#include <map>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

class Counts {
public:
    void add(const char* call)
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        ++calls_[call];
    }

    // "MPI_Barrier 1 times ...", empty if there were none; starts anew.
    std::string take()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        std::string text;
        for (const auto& [call, count] : calls_)
            text += call + " " + std::to_string(count) + " times ";
        calls_.clear();
        return text;
    }

private:
    std::mutex mutex_;
    std::map<std::string, int> calls_;
};

Counts counts;

} // namespace

#define DFB_COUNTED(name, parameters, arguments) \
    int MPI_##name parameters                    \
    {                                            \
        counts.add("MPI_" #name);                \
        return PMPI_##name arguments;            \
    }

extern "C" {

// clang-format off
DFB_COUNTED(Send, (const void* b, int n, MPI_Datatype t, int to, int tag, MPI_Comm c), (b, n, t, to, tag, c))
DFB_COUNTED(Ssend, (const void* b, int n, MPI_Datatype t, int to, int tag, MPI_Comm c), (b, n, t, to, tag, c))
DFB_COUNTED(Bsend, (const void* b, int n, MPI_Datatype t, int to, int tag, MPI_Comm c), (b, n, t, to, tag, c))
DFB_COUNTED(Rsend, (const void* b, int n, MPI_Datatype t, int to, int tag, MPI_Comm c), (b, n, t, to, tag, c))
DFB_COUNTED(Recv, (void* b, int n, MPI_Datatype t, int from, int tag, MPI_Comm c, MPI_Status* s),
            (b, n, t, from, tag, c, s))
DFB_COUNTED(Mrecv, (void* b, int n, MPI_Datatype t, MPI_Message* m, MPI_Status* s), (b, n, t, m, s))
DFB_COUNTED(Sendrecv,
            (const void* b, int n, MPI_Datatype t, int to, int tag, void* rb, int rn, MPI_Datatype rt, int from,
             int rtag, MPI_Comm c, MPI_Status* s),
            (b, n, t, to, tag, rb, rn, rt, from, rtag, c, s))
DFB_COUNTED(Sendrecv_replace,
            (void* b, int n, MPI_Datatype t, int to, int tag, int from, int rtag, MPI_Comm c, MPI_Status* s),
            (b, n, t, to, tag, from, rtag, c, s))
DFB_COUNTED(Probe, (int from, int tag, MPI_Comm c, MPI_Status* s), (from, tag, c, s))
DFB_COUNTED(Mprobe, (int from, int tag, MPI_Comm c, MPI_Message* m, MPI_Status* s), (from, tag, c, m, s))

DFB_COUNTED(Wait, (MPI_Request* r, MPI_Status* s), (r, s))
DFB_COUNTED(Waitall, (int n, MPI_Request r[], MPI_Status s[]), (n, r, s))
DFB_COUNTED(Waitany, (int n, MPI_Request r[], int* i, MPI_Status* s), (n, r, i, s))
DFB_COUNTED(Waitsome, (int n, MPI_Request r[], int* m, int i[], MPI_Status s[]), (n, r, m, i, s))

DFB_COUNTED(Barrier, (MPI_Comm c), (c))
DFB_COUNTED(Bcast, (void* b, int n, MPI_Datatype t, int root, MPI_Comm c), (b, n, t, root, c))
DFB_COUNTED(Reduce, (const void* a, void* b, int n, MPI_Datatype t, MPI_Op o, int root, MPI_Comm c),
            (a, b, n, t, o, root, c))
DFB_COUNTED(Allreduce, (const void* a, void* b, int n, MPI_Datatype t, MPI_Op o, MPI_Comm c), (a, b, n, t, o, c))
DFB_COUNTED(Reduce_scatter, (const void* a, void* b, const int n[], MPI_Datatype t, MPI_Op o, MPI_Comm c),
            (a, b, n, t, o, c))
DFB_COUNTED(Reduce_scatter_block, (const void* a, void* b, int n, MPI_Datatype t, MPI_Op o, MPI_Comm c),
            (a, b, n, t, o, c))
DFB_COUNTED(Scan, (const void* a, void* b, int n, MPI_Datatype t, MPI_Op o, MPI_Comm c), (a, b, n, t, o, c))
DFB_COUNTED(Exscan, (const void* a, void* b, int n, MPI_Datatype t, MPI_Op o, MPI_Comm c), (a, b, n, t, o, c))
DFB_COUNTED(Gather,
            (const void* a, int n, MPI_Datatype t, void* b, int m, MPI_Datatype u, int root, MPI_Comm c),
            (a, n, t, b, m, u, root, c))
DFB_COUNTED(Gatherv,
            (const void* a, int n, MPI_Datatype t, void* b, const int m[], const int d[], MPI_Datatype u, int root,
             MPI_Comm c),
            (a, n, t, b, m, d, u, root, c))
DFB_COUNTED(Scatter,
            (const void* a, int n, MPI_Datatype t, void* b, int m, MPI_Datatype u, int root, MPI_Comm c),
            (a, n, t, b, m, u, root, c))
DFB_COUNTED(Scatterv,
            (const void* a, const int n[], const int d[], MPI_Datatype t, void* b, int m, MPI_Datatype u, int root,
             MPI_Comm c),
            (a, n, d, t, b, m, u, root, c))
DFB_COUNTED(Allgather, (const void* a, int n, MPI_Datatype t, void* b, int m, MPI_Datatype u, MPI_Comm c),
            (a, n, t, b, m, u, c))
DFB_COUNTED(Allgatherv,
            (const void* a, int n, MPI_Datatype t, void* b, const int m[], const int d[], MPI_Datatype u, MPI_Comm c),
            (a, n, t, b, m, d, u, c))
DFB_COUNTED(Alltoall, (const void* a, int n, MPI_Datatype t, void* b, int m, MPI_Datatype u, MPI_Comm c),
            (a, n, t, b, m, u, c))
DFB_COUNTED(Alltoallv,
            (const void* a, const int n[], const int d[], MPI_Datatype t, void* b, const int m[], const int e[],
             MPI_Datatype u, MPI_Comm c),
            (a, n, d, t, b, m, e, u, c))
DFB_COUNTED(Alltoallw,
            (const void* a, const int n[], const int d[], const MPI_Datatype t[], void* b, const int m[],
             const int e[], const MPI_Datatype u[], MPI_Comm c),
            (a, n, d, t, b, m, e, u, c))

DFB_COUNTED(Comm_dup, (MPI_Comm c, MPI_Comm* d), (c, d))
DFB_COUNTED(Comm_dup_with_info, (MPI_Comm c, MPI_Info i, MPI_Comm* d), (c, i, d))
DFB_COUNTED(Comm_split, (MPI_Comm c, int color, int key, MPI_Comm* d), (c, color, key, d))
DFB_COUNTED(Comm_split_type, (MPI_Comm c, int type, int key, MPI_Info i, MPI_Comm* d), (c, type, key, i, d))
DFB_COUNTED(Comm_create, (MPI_Comm c, MPI_Group g, MPI_Comm* d), (c, g, d))
DFB_COUNTED(Comm_create_group, (MPI_Comm c, MPI_Group g, int tag, MPI_Comm* d), (c, g, tag, d))
DFB_COUNTED(Comm_disconnect, (MPI_Comm* c), (c))

DFB_COUNTED(Win_create, (void* b, MPI_Aint n, int unit, MPI_Info i, MPI_Comm c, MPI_Win* w), (b, n, unit, i, c, w))
DFB_COUNTED(Win_create_dynamic, (MPI_Info i, MPI_Comm c, MPI_Win* w), (i, c, w))
DFB_COUNTED(Win_allocate, (MPI_Aint n, int unit, MPI_Info i, MPI_Comm c, void* b, MPI_Win* w), (n, unit, i, c, b, w))
DFB_COUNTED(Win_allocate_shared, (MPI_Aint n, int unit, MPI_Info i, MPI_Comm c, void* b, MPI_Win* w),
            (n, unit, i, c, b, w))
DFB_COUNTED(Win_free, (MPI_Win* w), (w))
DFB_COUNTED(Win_fence, (int assert, MPI_Win w), (assert, w))
DFB_COUNTED(Win_start, (MPI_Group g, int assert, MPI_Win w), (g, assert, w))
DFB_COUNTED(Win_complete, (MPI_Win w), (w))
DFB_COUNTED(Win_wait, (MPI_Win w), (w))
DFB_COUNTED(Win_lock, (int type, int rank, int assert, MPI_Win w), (type, rank, assert, w))
DFB_COUNTED(Win_lock_all, (int assert, MPI_Win w), (assert, w))
DFB_COUNTED(Win_unlock, (int rank, MPI_Win w), (rank, w))
DFB_COUNTED(Win_unlock_all, (MPI_Win w), (w))
DFB_COUNTED(Win_flush, (int rank, MPI_Win w), (rank, w))
DFB_COUNTED(Win_flush_all, (MPI_Win w), (w))
// clang-format on

} // extern "C"

namespace {

int failures = 0;

void check(bool fine, const std::string& what, const std::string& text = "")
{
    if (fine)
        return;
    ++failures;
    std::fprintf(stderr, "mpi_blocking: %s: %s\n", what.c_str(), text.c_str());
}

template <class FrameBuffer>
void checkPicture(const FrameBuffer& fb, const std::string& what, const std::vector<std::uint8_t>& rgba)
{
    if (!fb.isDisplayRank())
        return;
    std::size_t wrong = 0;
    for (std::size_t i = 0; i < 4 * fb.image().pixelCount(); ++i)
        wrong += fb.image().rgba8()[i] != rgba[i % 4];
    check(wrong == 0, what + ": values that are wrong", std::to_string(wrong));
}

dfb::FrameBufferConfig smallConfig()
{
    dfb::FrameBufferConfig config;
    config.image.width = 200;
    config.image.height = 150;
    config.executor = std::make_shared<dfb::ThreadExecutor>(2);
    return config;
}

// Some of it is larger than MpiTransport's packets.
void renderAll(MPI_Comm communicator, dfb::Progress progress)
{
    const std::string name = progress == dfb::Progress::Thread ? "with a thread" : "without a thread";
    dfb::NetworkConfig options;
    options.progress = progress;
    {
        dfb::DistributedFrameBuffer<dfb::BasicImageParallel<64>> fb(communicator, smallConfig(), options);
        const auto sum = fb.allReduce({1, fb.rank()}, decltype(fb)::Reduce::Sum);
        check(sum[0] == fb.size() && sum[1] == fb.size() * (fb.size() - 1) / 2, "allReduce() " + name);
        dfb::ImageParallelLoop loop(fb);
        for (int frame = 0; frame < 3; ++frame) {
            const std::uint8_t red = static_cast<std::uint8_t>(51 * frame);
            loop.render([frame](auto& tile) { tile.fill({frame * 0.2f, 0, 0, 1}); });
            checkPicture(fb, "ImageParallelLoop " + name, {red, 0, 0, 255});
        }
    }
    dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<64>> fb(communicator, smallConfig(), options);
    const float z = static_cast<float>(fb.rank());
    const dfb::World world({{static_cast<std::uint32_t>(fb.rank()), {{-100, -100, z}, {100, 100, z + 0.5f}}}});
    const dfb::PerspectiveCamera camera({0, 0, -10}, {0, 0, 0}, {0, 1, 0}, 30);
    dfb::DataParallelLoop loop(fb, world);
    for (const bool failing : {false, true, false}) {
        bool failed = false;
        try {
            loop.render(camera, [&](const dfb::Brick&, auto& tile) {
                if (failing && fb.rank() == fb.size() - 1)
                    throw std::runtime_error("on purpose");
                tile.forEachPixel([&](int, int, float* rgba, float& depth) {
                    rgba[1] = rgba[3] = 1;
                    depth = z;
                });
            });
        } catch (const dfb::FrameError&) {
            failed = true;
        }
        check(failed == failing, "DataParallelLoop " + name + (failing ? " does not fail" : " fails"));
        if (!failing)
            checkPicture(fb, "DataParallelLoop " + name, {0, 255, 0, 255});
    }
}

} // namespace

int main(int argc, char** argv)
{
    {
        dfb::MpiSession mpi(argc, argv);
        for (const auto progress : {dfb::Progress::Thread, dfb::Progress::Caller})
            renderAll(mpi.communicator(), progress);
        const std::string blocking = counts.take();
        check(blocking.empty(), "calls that block", blocking);

        // That the counting works.
        MPI_Barrier(mpi.communicator());
        const std::string own = counts.take();
        check(own == "MPI_Barrier 1 times ", "MPI_Barrier was not counted", own);
    }
    const std::string blocking = counts.take();
    check(blocking.empty(), "calls that block at the end", blocking);
    return failures;
}
