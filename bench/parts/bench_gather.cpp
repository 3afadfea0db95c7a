// The way of finished tiles to the display rank: in batches while others still render, or with one MPI_Gatherv. Each
// rank renders the tiles that it owns, with renderers that cost nothing, CPU time, or only waiting time.
//   mpirun -n 2 bench_gather        or -n 4, -n 8; --quick; a list of parts such as 12 takes only those image sizes
// --trace FILE: of dfb, with the last renderer and size.
#include "baselines.hpp"
#include "trace.hpp"

#include <dfb/comm/mpi_transport.hpp>
#include <dfb/distributed_framebuffer.hpp>
#include <dfb/ops/image_parallel.hpp>
#include <dfb/render/loops.hpp>

#include <array>
#include <atomic>
#include <cstring>
#include <memory>

namespace {

using bench::Table;
using bench::Waiting;
using FrameBuffer = dfb::DistributedFrameBuffer<dfb::ImageParallel, dfb::NoPixelOp, dfb::MpiTransport>;
using dfb::Connection;
using Tile = FrameBuffer::Tile;

// ---- renderers

enum class Cost { Cheap, Uneven, Elsewhere };
constexpr std::array<Cost, 3> costs{Cost::Cheap, Cost::Uneven, Cost::Elsewhere};

const char* nameOf(Cost cost)
{
    switch (cost) {
    case Cost::Cheap: return "cheap";
    case Cost::Uneven: return "computes";
    default: return "waits";
    }
}

// Colours a tile, after work that differs between tiles by a factor of up to 7: none, time on this core, or time in
// which something else computes, as with a renderer on an accelerator. Records when it last finished.
class Renderer {
public:
    Renderer(Cost cost, double meanSeconds, double stepsPerSecond)
        : cost_(cost), meanSeconds_(meanSeconds), stepsPerSecond_(stepsPerSecond)
    {
    }

    void operator()(Tile& tile) const
    {
        const double seconds = meanSeconds_ * (0.25 + 0.5 * static_cast<double>(hashOf(tile.tile) % 4));
        if (cost_ == Cost::Uneven)
            sum_ = compute(static_cast<std::int64_t>(seconds * stepsPerSecond_));
        else if (cost_ == Cost::Elsewhere)
            std::this_thread::sleep_for(std::chrono::duration<double>(seconds));
        tile.forEachPixel([](int x, int y, float* rgba, float&) {
            rgba[0] = static_cast<float>(x & 255) / 255;
            rgba[1] = static_cast<float>(y & 255) / 255;
            rgba[2] = static_cast<float>((x ^ y) & 255) / 255;
            rgba[3] = 1;
        });
        finished_ = bench::now();
    }

    double finished() const { return finished_; }

    static float compute(std::int64_t steps)
    {
        float value = 1;
        for (; steps > 0; --steps)
            value = value * 0.999f + 0.001f * static_cast<float>(steps & 7);
        return value;
    }

private:
    static std::uint32_t hashOf(int tile) { return (static_cast<std::uint32_t>(tile) * 2654435761u) >> 24; }

    Cost cost_;
    double meanSeconds_, stepsPerSecond_;
    mutable std::atomic<float> sum_{0};
    mutable std::atomic<double> finished_{0};
};

// ---- the image by MPI_Gatherv

// The display rank's own tiles go straight into the image; the others' are laid out there from where they were
// gathered. Blocking or tested with naps.
class GathervImage {
public:
    GathervImage(const FrameBuffer& fb, MPI_Comm comm)
        : comm_(comm), layout_(fb.layout()), format_(fb.config().image.format), own_(fb.ownedTiles()),
          tilesOf_(fb.size()), display_(fb.isDisplayRank())
    {
        int offset = 0;
        for (int tile = 0; tile < layout_.tileCount(); ++tile)
            tilesOf_[static_cast<std::size_t>(fb.tileOwner(tile))].push_back(tile);
        for (std::size_t rank = 0; rank < tilesOf_.size(); ++rank) {
            std::size_t bytes = 0;
            if (static_cast<int>(rank) != fb.config().image.displayRank)
                for (const int tile : tilesOf_[rank])
                    bytes += bytesOf(tile);
            counts_.push_back(static_cast<int>(bytes));
            places_.push_back(offset);
            offset += counts_.back();
        }
        sent_.resize(static_cast<std::size_t>(counts_[static_cast<std::size_t>(fb.rank())]));
        if (display_) {
            gathered_.resize(static_cast<std::size_t>(offset));
            image_.resize(static_cast<std::size_t>(layout_.width()) * static_cast<std::size_t>(layout_.height())
                          * dfb::bytesPerPixel(format_));
        }
        tile_.reset(new Tile);
    }

    void render(const Renderer& renderer, Waiting waiting)
    {
        std::byte* to = sent_.data();
        for (const int index : own_) {
            tile_->clear();
            tile_->tile = index;
            tile_->region = layout_.region(index);
            renderer(*tile_);
            for (int y = 0; y < tile_->region.height(); ++y) {
                std::byte* row = display_ ? inImage(index, y) : to;
                dfb::convertPixels(tile_->pixel(0, y), tile_->region.width(), format_, row);
                to += display_ ? 0 : rowBytes(index);
            }
        }
        const auto count = static_cast<int>(sent_.size());
        if (waiting == Waiting::Blocking) {
            MPI_Gatherv(sent_.data(), count, MPI_BYTE, gathered_.data(), counts_.data(), places_.data(), MPI_BYTE, 0,
                        comm_);
        } else {
            MPI_Request request = MPI_REQUEST_NULL;
            MPI_Igatherv(sent_.data(), count, MPI_BYTE, gathered_.data(), counts_.data(), places_.data(), MPI_BYTE, 0,
                         comm_, &request);
            bench::complete(request, waiting);
        }
        if (!display_)
            return;
        for (std::size_t rank = 0; rank < tilesOf_.size(); ++rank) {
            if (counts_[rank] == 0)
                continue;
            const std::byte* from = gathered_.data() + places_[rank];
            for (const int tile : tilesOf_[rank])
                for (int y = 0; y < layout_.region(tile).height(); ++y, from += rowBytes(tile))
                    std::memcpy(inImage(tile, y), from, rowBytes(tile));
        }
    }

    const std::vector<std::byte>& image() const { return image_; }

private:
    std::size_t rowBytes(int tile) const
    {
        return static_cast<std::size_t>(layout_.region(tile).width()) * dfb::bytesPerPixel(format_);
    }
    std::size_t bytesOf(int tile) const
    {
        return rowBytes(tile) * static_cast<std::size_t>(layout_.region(tile).height());
    }
    std::byte* inImage(int tile, int y)
    {
        const dfb::Region region = layout_.region(tile);
        return image_.data()
               + (static_cast<std::size_t>(region.y0 + y) * static_cast<std::size_t>(layout_.width())
                  + static_cast<std::size_t>(region.x0))
                     * dfb::bytesPerPixel(format_);
    }

    MPI_Comm comm_;
    dfb::TileLayout layout_;
    dfb::OutputFormat format_;
    std::vector<int> own_;
    std::vector<std::vector<int>> tilesOf_; // of each rank
    std::vector<int> counts_, places_;      // bytes
    std::vector<std::byte> sent_, gathered_, image_;
    std::unique_ptr<Tile> tile_;
    bool display_;
};

// ---- measuring

constexpr std::array<const char*, 3> variants{"dfb", "MPI_Gatherv", "MPI_Igatherv, test+nap"};

// How many steps of Renderer::compute() an undisturbed core does in a second.
double stepsPerSecond(MPI_Comm comm)
{
    constexpr std::int64_t steps = 500000;
    double best = 0;
    volatile float keep = 0; // so that it is computed
    for (int i = 0; i < 20; ++i) {
        const double start = bench::now();
        keep = keep + Renderer::compute(steps);
        best = std::max(best, static_cast<double>(steps) / (bench::now() - start));
    }
    return bench::agree(comm, best);
}

struct Case {
    int side;
    dfb::OutputFormat format;
    Cost cost;
};

class GatherBench {
public:
    GatherBench(MPI_Comm comm, bool quick, std::string trace)
        : comm_(comm), rank_(bench::rankIn(comm)), quick_(quick), trace_(std::move(trace)),
          stepsPerSecond_(stepsPerSecond(comm)), tails_(head()), frames_(head()), cpu_(head())
    {
    }

    void run(const Case& c)
    {
        // Framebuffers and memory of a case go before the next.
        const auto connection = dfb::connect<dfb::MpiTransport>(comm_);
        const auto executor = std::make_shared<dfb::ThreadExecutor>(1);
        FrameBuffer::Config config(c.side, c.side, c.format);
        config.executor = executor;
        const bench::Trace trace(trace_);
        config.trace = trace.sink;
        FrameBuffer fb(connection, config);
        dfb::ImageParallelLoop loop(fb);
        GathervImage plain(fb, comm_);
        const Renderer renderer(c.cost, 100e-6, stepsPerSecond_);

        Samples tails, frames, cpu;
        const double limit = bench::now() + (quick_ ? 0.5 : 6);
        const int least = quick_ ? 2 : 5, most = 40;
        for (int round = -1; bench::agree(comm_, round < least || (bench::now() < limit && round < most)) != 0;
             ++round) {
            for (std::size_t i = 0; i < variants.size(); ++i) {
                const std::size_t v = (i + static_cast<std::size_t>(round + 1)) % variants.size();
                bench::meet(comm_);
                const double start = bench::now(), cpuBefore = bench::processCpuSeconds();
                if (v == 0)
                    loop.render(renderer);
                else
                    plain.render(renderer, v == 1 ? Waiting::Blocking : Waiting::Nap);
                const double end = bench::now(), cpuSpent = bench::processCpuSeconds() - cpuBefore;
                const double first = bench::reduce(comm_, start, MPI_MIN);
                const double cpuOfAll = bench::reduce(comm_, cpuSpent, MPI_SUM);
                const double slowest = bench::reduce(comm_, renderer.finished(), MPI_MAX);
                if (round < 0) // memory is touched for the first time
                    continue;
                tails[v].push_back(1e3 * (end - slowest));
                frames[v].push_back(1e3 * (end - first));
                cpu[v].push_back(1e3 * cpuOfAll);
            }
            if (round < 0)
                requireSame(fb, plain);
        }
        trace.write(fb);
        const std::string image =
            std::to_string(c.side) + "² " + (c.format == dfb::OutputFormat::RGBA8 ? "RGBA8" : "RGBA32F");
        tails_.add(rowOf(image, c.cost, tails));
        frames_.add(rowOf(image, c.cost, frames));
        cpu_.add(rowOf(image, c.cost, cpu));
        if (rank_ == 0)
            std::fprintf(stderr, "%s, %s: done\n", image.c_str(), nameOf(c.cost));
    }

    void print() const
    {
        if (rank_ != 0)
            return;
        tails_.print("From the end of the slowest rendering to the finished image [ms]");
        frames_.print("The whole frame [ms]");
        cpu_.print("CPU time of a frame, all ranks together [ms]");
    }

private:
    using Samples = std::array<std::vector<double>, variants.size()>; // a sample per round

    static std::vector<std::string> head()
    {
        std::vector<std::string> names{"image", "renderer", "rounds"};
        names.insert(names.end(), variants.begin(), variants.end());
        names.push_back("dfb - MPI_Igatherv");
        return names;
    }

    // The last figure is taken round by round.
    static std::vector<std::string> rowOf(const std::string& image, Cost cost, const Samples& samples)
    {
        std::vector<std::string> row{image, nameOf(cost), std::to_string(samples[0].size())};
        for (const auto& s : samples)
            row.push_back(bench::text(bench::figureOf(s)));
        std::vector<double> differences;
        for (std::size_t i = 0; i < samples[0].size(); ++i)
            differences.push_back(samples[0][i] - samples[2][i]);
        row.push_back(bench::text(bench::figureOf(differences)));
        return row;
    }

    void requireSame(const FrameBuffer& fb, const GathervImage& plain) const
    {
        if (rank_ != 0)
            return;
        const std::vector<std::byte>& image = plain.image();
        if (std::memcmp(fb.image().bytes(), image.data(), image.size()) != 0) {
            std::printf("the images differ\n");
            MPI_Abort(comm_, 1);
        }
    }

    MPI_Comm comm_;
    int rank_;
    bool quick_;
    std::string trace_;
    double stepsPerSecond_;
    Table tails_, frames_, cpu_;
};

} // namespace

int main(int argc, char** argv)
{
    const bench::Arguments arguments(argc, argv,
                                     "usage: mpirun -n RANKS bench_gather [--quick] [--trace FILE] [PARTS]\n"
                                     "  --quick  fewer repetitions\n"
                                     "  PARTS    1: images of 1024², 2: 2048², 3: 4096²; 12: the first two\n"
                                     "           (default: all)");
    bench::withMpi(argc, argv, [&](MPI_Comm comm) {
        if (bench::rankIn(comm) == 0)
            std::printf("bench_gather: %s. Medians ± median absolute deviations. A worker per rank.\n",
                        bench::environment(comm).c_str());
        GatherBench benchmark(comm, arguments.quick, arguments.trace);
        for (int part = 0; part < 3; ++part)
            if (arguments.wants(static_cast<char>('1' + part)))
                for (const auto format : {dfb::OutputFormat::RGBA8, dfb::OutputFormat::RGBA32F})
                    for (const Cost cost : costs)
                        benchmark.run({1024 << part, format, cost});
        benchmark.print();
        bench::meet(comm);
    });
}
