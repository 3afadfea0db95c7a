// dfb_render: renders volumes, meshes and spheres over several ranks; see --help.
#include "options.hpp"
#include "output.hpp"
#include "progress_line.hpp"
#include "rank_scene.hpp"

#include <dfb/dfb.hpp>

#if defined(DFB_HAS_TBB)
#include <tbb/global_control.h>
#endif

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <limits>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

namespace example {
namespace {

bool wantsFloat(const Options& o)
{
    return !o.stats.empty() || !o.alpha.empty()
           || (o.output.size() > 4 && o.output.substr(o.output.size() - 4) == ".pfm");
}

dfb::FrameBufferConfig configOf(const Options& o, int threads)
{
    dfb::FrameBufferConfig config;
    config.width = o.width;
    config.height = o.height;
    config.format = wantsFloat(o)                           ? dfb::OutputFormat::RGBA32F
                    : !o.output.empty() || !o.depth.empty() ? dfb::OutputFormat::SRGBA8
                                                            : dfb::OutputFormat::None;
    config.depth = !o.depth.empty();
    config.ownerMap = o.ownerMap == OwnerMap::Linear ? dfb::linearOwner
                      : o.ownerMap == OwnerMap::Hash ? dfb::hashOwner
                                                     : dfb::latticeOwner;
    if (o.compression == Compression::Snappy) {
#if defined(DFB_HAS_SNAPPY)
        config.codec = std::make_shared<dfb::SnappyCodec>();
#else
        throw std::runtime_error("this dfb_render was built without Snappy");
#endif
    }
#if defined(DFB_HAS_TBB)
    config.executor = std::make_shared<dfb::TbbExecutor>(threads);
#else
    config.executor = std::make_shared<dfb::ThreadExecutor>(threads);
#endif
    return config;
}

dfb::World worldOf(const RankScene& scene)
{
    dfb::World world;
    for (const std::uint32_t id : scene.brickIds) {
        const Box& c = scene.cells[id];
        world.add({id, {{c.lo.x, c.lo.y, c.lo.z}, {c.hi.x, c.hi.y, c.hi.z}}});
    }
    return world;
}

dfb::PerspectiveCamera cameraOf(const RankScene& scene, const RenderSettings& settings, int frame)
{
    const Camera c = frameCamera(scene.info, settings, frame);
    const auto vec = [](const Vec3& v) { return dfb::Vec3{v.x, v.y, v.z}; };
    return dfb::PerspectiveCamera::along(vec(c.origin), vec(c.forward), vec(c.up), settings.view.fieldOfView);
}

void writeFiles(const Options& o, const dfb::Image& image, const RunStats& stats)
{
    const bool isFloat = image.format() == dfb::OutputFormat::RGBA32F;
    if (!o.output.empty() && !isFloat) {
        writePng(o.output, o.width, o.height, image.rgba8());
    } else if (!o.output.empty() && o.output.substr(o.output.size() - 4) == ".pfm") {
        writePfm(o.output, o.width, o.height, image.rgba32f());
    } else if (!o.output.empty()) {
        std::vector<std::byte> srgb(4 * image.pixelCount());
        for (int y = 0; y < o.height; ++y) {
            const std::size_t first = 4 * static_cast<std::size_t>(y) * static_cast<std::size_t>(o.width);
            dfb::convertPixels(image.rgba32f() + first, o.width, dfb::OutputFormat::SRGBA8, srgb.data() + first);
        }
        writePng(o.output, o.width, o.height, reinterpret_cast<const std::uint8_t*>(srgb.data()));
    }
    if (!o.alpha.empty())
        writeGreyPfm(o.alpha, o.width, o.height, image.rgba32f() + 3, 4);
    if (!o.depth.empty())
        writeGreyPfm(o.depth, o.width, o.height, image.depth(), 1);
    if (!o.stats.empty())
        writeStats(o.stats, stats);
}

// Runs `step` on every rank. If it throws on any, the lowest of those says why, and all return false.
template <class FrameBuffer, class Step>
bool onAllRanks(FrameBuffer& fb, const Step& step)
{
    std::string error;
    bool failed = false;
    try {
        step();
    } catch (const std::exception& e) {
        error = e.what();
        failed = true;
    }
    const auto lowest = fb.allReduce({failed ? fb.rank() : fb.size()}, FrameBuffer::Reduce::Min).front();
    if (lowest == fb.rank())
        std::fprintf(stderr, "dfb_render: %s\n", error.c_str());
    return lowest == fb.size();
}

// One rank's whole run; the same exit code on all ranks.
template <class TileOp, class PixelOp, class Transport>
int render(const typename Transport::Communicator& communicator, const Options& o, int threads)
{
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, PixelOp, Transport>;
    FrameBuffer fb(communicator, configOf(o, threads));
    std::unique_ptr<RankScene> scene;
    if (!onAllRanks(fb, [&] {
            if (fb.isDisplayRank())
                for (const std::string* path : {&o.output, &o.alpha, &o.depth, &o.stats})
                    if (!path->empty())
                        requireWritable(*path);
            scene = std::make_unique<RankScene>(loadRankScene(o, fb.rank(), fb.size()));
        }))
        return 1;

    dfb::FrameParams params;
    params.passes = o.spp;
    if (o.background)
        params.background = {(*o.background)[0], (*o.background)[1], (*o.background)[2], 1.0f};
    typename FrameBuffer::PixelFrameData pixelData{};
    if constexpr (std::is_same_v<PixelOp, dfb::ToneMap>)
        pixelData.exposure = o.exposure;

    const RenderSettings settings = renderSettings(o);
    const dfb::World world = worldOf(*scene);
    ProgressLine progress(fb.isDisplayRank(), o.frames);
    std::vector<dfb::FrameReport> reports;
    for (int frame = 0; frame < o.frames; ++frame) {
        progress.beginFrame(frame);
        const auto renderTile = [&](const Renderer& renderer, auto& tile) {
            renderer.renderTile(tile, frame);
            progress.tileDone();
        };
        if constexpr (std::is_same_v<TileOp, dfb::AlphaBlend>) {
            const std::uint32_t firstId = scene->brickIds.empty() ? 0 : scene->brickIds.front(); // they are consecutive
            reports.push_back(dfb::renderDataParallel(
                fb, world, cameraOf(*scene, settings, frame),
                [&](const dfb::Brick& brick, auto& tile) { renderTile(scene->renderers[brick.id - firstId], tile); },
                params, {}, pixelData));
        } else {
            reports.push_back(dfb::renderImageParallel(
                fb, [&](auto& tile) { renderTile(scene->renderers.front(), tile); }, params, {}, pixelData));
        }
    }
    progress.end();

    // Own frame end minus own rendering end, the smallest over ranks: no clocks are compared.
    std::vector<std::int64_t> overheadNs, totalNs;
    for (const dfb::FrameReport& r : reports) {
        overheadNs.push_back(static_cast<std::int64_t>(1e6 * r.compositingOverheadMs));
        totalNs.push_back(static_cast<std::int64_t>(1e6 * r.totalMs));
    }
    overheadNs = fb.allReduce(overheadNs, FrameBuffer::Reduce::Min);
    totalNs = fb.allReduce(totalNs, FrameBuffer::Reduce::Max);

    const bool written = onAllRanks(fb, [&] {
        if (!fb.isDisplayRank())
            return;
        RunStats stats;
        stats.ranks = fb.size();
        stats.transport = Transport::name;
        stats.mode = o.mode == Mode::Data ? "data" : "image";
        stats.width = o.width;
        stats.height = o.height;
        for (std::size_t i = 0; i < reports.size(); ++i) {
            const dfb::FrameReport& r = reports[i];
            FrameStats s;
            s.totalMs = static_cast<double>(totalNs[i]) / 1e6;
            s.renderMsMax = r.renderMsMax;
            s.compositingOverheadMs = static_cast<double>(overheadNs[i]) / 1e6;
            s.bytesSent = static_cast<std::uint64_t>(r.bytesSent);
            s.messagesSent = static_cast<std::uint64_t>(r.messagesSent);
            s.tilesTotal = static_cast<std::uint64_t>(r.tilesTotal);
            s.tilesTouched = static_cast<std::uint64_t>(r.tilesTouched);
            s.peakMemoryBytes = static_cast<std::uint64_t>(r.peakMemoryBytes);
            stats.frames.push_back(s);
        }
        if (fb.image().format() == dfb::OutputFormat::RGBA32F) {
            stats.imageHash = hashPixels(fb.image().rgba32f(), fb.image().pixelCount());
            stats.meanAlpha = meanAlpha(fb.image().rgba32f(), fb.image().pixelCount());
        }
        writeFiles(o, fb.image(), stats);
        double total = 0;
        for (const FrameStats& s : stats.frames)
            total += s.totalMs;
        std::printf("%d %s of %dx%d on %d %s: %.1f ms a frame, %.1f ms of it after the slowest rank had rendered\n",
                    o.frames, o.frames == 1 ? "frame" : "frames", o.width, o.height, stats.ranks,
                    stats.ranks == 1 ? "rank" : "ranks", total / o.frames, stats.frames.back().compositingOverheadMs);
        for (const std::string* path : {&o.output, &o.alpha, &o.depth, &o.stats})
            if (!path->empty())
                std::printf("wrote %s\n", path->c_str());
    });
    return written ? 0 : 1;
}

// Threads of each of `ranksHere` ranks on this machine.
int threadsFor(const Options& o, int ranksHere)
{
    if (o.threads > 0)
        return o.threads;
    return std::max(1, static_cast<int>(std::thread::hardware_concurrency()) / std::max(1, ranksHere));
}

// Lets oneTBB have `threads` workers in this process also where there are fewer cores.
class WorkerLimit {
public:
#if defined(DFB_HAS_TBB)
    explicit WorkerLimit(int threads)
        : limit_(tbb::global_control::max_allowed_parallelism,
                 std::max<std::size_t>(static_cast<std::size_t>(threads) + 1, std::thread::hardware_concurrency()))
    {
    }

private:
    tbb::global_control limit_;
#else
    explicit WorkerLimit(int) {}
#endif
};

template <class Transport>
int renderWith(const typename Transport::Communicator& communicator, const Options& o, int threads)
{
    const bool toneMapped = o.exposure > 0;
    if (o.mode == Mode::Data)
        return toneMapped ? render<dfb::AlphaBlend, dfb::ToneMap, Transport>(communicator, o, threads)
                          : render<dfb::AlphaBlend, dfb::NoPixelOp, Transport>(communicator, o, threads);
    return toneMapped ? render<dfb::ImageParallel, dfb::ToneMap, Transport>(communicator, o, threads)
                      : render<dfb::ImageParallel, dfb::NoPixelOp, Transport>(communicator, o, threads);
}

int runInThreads(const Options& o, int ranks)
{
    const int threads = threadsFor(o, ranks);
    const WorkerLimit limit(threads * ranks);
    std::mutex mutex;
    int code = 0;
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        const int mine = renderWith<dfb::InprocTransport>(communicator, o, threads);
        const std::lock_guard<std::mutex> lock(mutex);
        code = std::max(code, mine);
    });
    return code;
}

int report(const ParsedOptions& parsed)
{
    std::fprintf(parsed.exitCode == 0 ? stdout : stderr, "%s\n", parsed.message.c_str());
    return parsed.exitCode;
}

#if defined(DFB_HAS_MPI)
// What a launcher (MPICH's or Open MPI's) has told this process, or `otherwise`.
int fromLauncher(const char* mpich, const char* openMpi, int otherwise)
{
    for (const char* name : {mpich, openMpi})
        if (const char* value = std::getenv(name))
            return std::atoi(value);
    return otherwise;
}

int runWithMpi(int argc, char** argv, const ParsedOptions& parsed)
{
    const dfb::MpiSession mpi(argc, argv);
    const int rank = mpi.rank();
    int code = 1;
    try {
        if (!parsed.options) {
            code = rank == 0 ? report(parsed) : parsed.exitCode;
        } else {
            MPI_Comm here = MPI_COMM_NULL;
            int ranksHere = 1;
            MPI_Comm_split_type(MPI_COMM_WORLD, MPI_COMM_TYPE_SHARED, 0, MPI_INFO_NULL, &here);
            MPI_Comm_size(here, &ranksHere);
            MPI_Comm_free(&here);
            const int threads = threadsFor(*parsed.options, ranksHere);
            const WorkerLimit limit(threads);
            code = renderWith<dfb::MpiTransport>(MPI_COMM_WORLD, *parsed.options, threads);
        }
    } catch (const dfb::InvalidArgument& e) { // this and the next are the same on all ranks
        if (rank == 0)
            std::fprintf(stderr, "dfb_render: %s\n", e.what());
    } catch (const dfb::FrameError& e) {
        if (rank == 0)
            std::fprintf(stderr, "dfb_render: %s\n", e.what());
    } catch (const std::exception& e) {
        std::fprintf(stderr, "dfb_render: rank %d: %s\n", rank, e.what());
        MPI_Abort(MPI_COMM_WORLD, 1); // the others may wait for this rank
    }
    return code;
}
#endif

} // namespace
} // namespace example

int main(int argc, char** argv)
{
    using namespace example;
    const ParsedOptions parsed = parseOptions(argc, argv);
    try {
#if defined(DFB_HAS_MPI)
        if (!parsed.options || parsed.options->ranks == 0)
            return runWithMpi(argc, argv, parsed);
        if (fromLauncher("PMI_SIZE", "OMPI_COMM_WORLD_SIZE", 1) > 1) {
            if (fromLauncher("PMI_RANK", "OMPI_COMM_WORLD_RANK", 0) == 0)
                std::fprintf(stderr, "dfb_render: --ranks makes ranks of threads; start it without mpirun, or leave "
                                     "--ranks out\n");
            return 2;
        }
#endif
        if (!parsed.options)
            return report(parsed);
        return runInThreads(*parsed.options, std::max(1, parsed.options->ranks));
    } catch (const std::exception& e) {
        std::fprintf(stderr, "dfb_render: %s\n", e.what());
        return 1;
    }
}
