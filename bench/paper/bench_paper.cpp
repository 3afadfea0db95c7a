// The figures of the paper (section 6), with data generated from a seed instead of the paper's own. Each rank holds
// only its part of the data (in figure 6 all of it, because rendering is image-parallel).
//   mpirun -n 8 bench_paper --figure 6|7|8|9|10 [--ranks 1,2,4,8] [--size 512x512,...] [--views 12] [--repeats 1]
//     [--scale 1] [--seed 1] [--threads 1] [--compress never|always|auto] [--check VIEWS] [--json FILE] [--svg FILE]
//     [--table FILE] [--ppm FILE] [--trace FILE] [--commit ID]
// Each number of ranks is measured with that many of the job's ranks, while the others sleep. --check compares the
// images from so many views with those of another distribution of the same scene. --scale: factor for the data's
// resolution along each side. --trace: of dfb, with the last number of ranks and size.
#include "marched_bricks.hpp"
#include "paper_figures.hpp"
#include "paper_particles.hpp"
#include "paper_volume.hpp"
#include "paper_ways.hpp"

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <fstream>
#include <functional>
#include <memory>
#include <string>
#include <vector>

namespace {

using bench::Measurement;
using bench::PaperScene;
using bench::PaperWay;

struct Options {
    int figure = 0, views = 12, repeats = 1, threads = 1, checked = 0;
    std::uint32_t seed = 1;
    double scale = 1;
    std::vector<int> ranks; // ascending
    std::vector<std::array<int, 2>> sizes{{512, 512}};
    std::string json, svg, table, ppm, trace, commit, compress = "never";

    int scaled(int count) const { return std::max(8, static_cast<int>(std::lround(count * scale))); }

    dfb::FrameBufferConfig config(int width, int height, const bench::Trace& traced) const
    {
        dfb::FrameBufferConfig c(width, height);
        c.executor = std::make_shared<dfb::ThreadExecutor>(threads);
        c.trace = traced.sink;
#if defined(DFB_HAS_SNAPPY)
        if (compress != "never")
            c.messages.codec = std::make_shared<dfb::SnappyCodec>();
#endif
        c.messages.compression = compress == "auto" ? dfb::CompressionMode::Auto : dfb::CompressionMode::Always;
        return c;
    }
};

void writePpm(const std::string& path, const std::vector<float>& linear, int width, int height)
{
    std::vector<std::byte> pixels(linear.size());
    dfb::convertPixels(linear.data(), static_cast<int>(linear.size() / 4), dfb::OutputFormat::SRGBA8, pixels.data());
    std::ofstream file(path, std::ios::binary);
    file << "P6 " << width << ' ' << height << " 255\n";
    for (std::size_t i = 0; i < pixels.size(); i += 4)
        file.write(reinterpret_cast<const char*>(&pixels[i]), 3);
    if (!file.flush())
        throw std::runtime_error("cannot write " + path);
}

class PaperFigure {
public:
    PaperFigure(MPI_Comm all, Options o) : all_(all), o_(std::move(o)) { MPI_Comm_rank(all, &rank_); }

    // Collective. Whether all images were as they should be.
    bool run()
    {
        if (rank_ == 0)
            std::printf("figure %d, %s\n", o_.figure, bench::environment(all_).c_str());
        for (const int ranks : o_.ranks) {
            bench::meet(all_);
            MPI_Comm some = MPI_COMM_NULL;
            MPI_Comm_split(all_, rank_ < ranks ? 0 : MPI_UNDEFINED, rank_, &some);
            for (const auto& [width, height] : o_.sizes) {
                if (some != MPI_COMM_NULL)
                    measure(some, ranks, width, height);
                bench::meet(all_); // others sleep
            }
            if (some != MPI_COMM_NULL)
                MPI_Comm_free(&some);
        }
        if (rank_ == 0) {
            bench::writeMeasurements(found_, caption(), o_.json, o_.table);
            if (!o_.svg.empty())
                bench::drawFigure(o_.figure, caption(), found_, o_.svg);
        }
        return bench::agree(all_, isRight_ ? 1 : 0) > 0;
    }

private:
    std::string caption() const
    {
        switch (o_.figure) {
        case 6: return "Figure 6: image-parallel strong scaling, " + sceneName_;
        case 7: return "Figure 7: data-parallel strong scaling, " + sceneName_;
        case 8: return "Figure 8: data-parallel strong scaling, " + sceneName_;
        case 9: return "Figure 9: dfb and IceT, a brick of 64^3 voxels a rank";
        default: return "Figure 10: bricks held by several ranks, " + sceneName_;
        }
    }

    PaperScene scene() const
    {
        return o_.figure == 6   ? bench::mixingLayer(o_.scaled(128), o_.seed)
               : o_.figure == 7 ? bench::particleWeb(o_.scaled(64), o_.seed)
                                : bench::channelFlow(o_.scaled(128), o_.seed);
    }

    // Collective over the ranks that take part, as is what it calls.
    void measure(MPI_Comm comm, int ranks, int width, int height)
    {
        if (o_.figure == 9) {
            measureMarched(comm, ranks, width, height);
            return;
        }
        const PaperScene scene = this->scene();
        sceneName_ = scene.name;
        const bench::Trace trace(o_.trace);
        bench::PaperStage stage(comm, scene, o_.config(width, height, trace), o_.views);
        std::vector<PaperWay> ways = waysOf(stage, ranks, dfb::OutputFormat::SRGBA8);
        if (o_.checked > 0 || !o_.ppm.empty()) {
            std::vector<PaperWay> exact = waysOf(stage, ranks, dfb::OutputFormat::RGBA32F);
            const std::function<std::vector<float>(int)> reference = [&](int view) { return stage.uncut(view); };
            check(exact, ranks, width, height, reference, o_.figure == 6 ? 0 : 2e-5, o_.figure == 10);
            for (std::size_t i = 0; i < ways.size(); ++i)
                ways[i].maxError = exact[i].maxError;
            if (o_.figure != 6)
                stage.forgetUncut();
        }
        bench::measureWays(comm, ways, o_.views, o_.repeats);
        stage.write(trace);
        keep(ways, scene.name, ranks, width, height);
    }

    std::vector<PaperWay> waysOf(bench::PaperStage& stage, int ranks, dfb::OutputFormat format) const
    {
        if (o_.figure == 6)
            return {stage.imageParallel("owners render", dfb::WorkDistribution::Owned, format),
                    stage.imageParallel("on demand", dfb::WorkDistribution::Dynamic, format)};
        if (o_.figure < 10)
            return {stage.dataParallel("one brick a rank", format)};
        std::vector<PaperWay> ways;
        int most = 1;
        for (int bricks = 1; bricks <= std::min(4, ranks); bricks *= 2, most = bricks)
            ways.push_back(stage.mixedParallel<dfb::RoundRobinBricks>(
                std::to_string(bricks) + (bricks == 1 ? " brick a rank" : " bricks a rank"), bricks, format));
        if (most > 2)
            ways.push_back(stage.mixedParallel<dfb::MeasuredCostBricks>(
                std::to_string(most / 2) + " bricks a rank, by cost", most / 2, format));
        return ways;
    }

    void measureMarched(MPI_Comm comm, int ranks, int width, int height)
    {
        sceneName_ = "64^3 bricks";
        const bench::Trace trace(o_.trace);
        bench::MarchedBricks bricks(comm, o_.config(width, height, trace), o_.views);
        std::vector<bench::MarchedSystem> systems{bricks.sorted("dfb: sorted"), bricks.inOrder("dfb: in order")};
#ifdef DFB_BENCH_HAS_ICET
        for (const bench::IceTStrategy& strategy : bench::icetStrategies())
            if (const std::string name = strategy.name; name == "sequential, automatic" || name == "direct")
                systems.push_back(bricks.icet(strategy));
#endif
        const std::size_t values = 4 * static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
        std::vector<PaperWay> ways;
        for (const bench::MarchedSystem& s : systems) {
            PaperWay way;
            const std::size_t colon = s.name.find(": ");
            way.system = s.name.substr(0, colon);
            way.config = s.name.substr(colon + 2);
            way.frame = [&, frame = s.frame](int view) {
                return frame(bricks.views()[static_cast<std::size_t>(view)]);
            };
            way.image = [image = s.image, values] { return std::vector<float>(image(), image() + values); };
            way.traffic = s.traffic;
            ways.push_back(std::move(way));
        }
        // All bricks by one rank, one after the other.
        const auto reference = [&](int view) {
            const bench::MarchedView& v = bricks.views()[static_cast<std::size_t>(view)];
            std::vector<double> sum(values, 0.0);
            for (const int rank : v.order) {
                const bench::BrickMarcher marcher(bricks.boxOf(rank));
                for (std::size_t i = 0; i < values; i += 4) {
                    float rgba[4] = {0, 0, 0, 0};
                    const int pixel = static_cast<int>(i / 4);
                    marcher.shade(v.camera, pixel % width, pixel / width, width, height, rgba);
                    const double through = 1 - sum[i + 3];
                    for (std::size_t c = 0; c < 4; ++c)
                        sum[i + c] += through * static_cast<double>(rgba[c]);
                }
            }
            return std::vector<float>(sum.begin(), sum.end());
        };
        check(ways, ranks, width, height, reference, 2e-5, false);
        bench::measureWays(comm, ways, o_.views, o_.repeats);
        bricks.write(trace);
        keep(ways, sceneName_, ranks, width, height);
    }

    // Compares images with those of `reference`, which only rank 0 makes; with `alike` also with each other, bit for
    // bit. Writes the first one.
    void check(std::vector<PaperWay>& ways, int ranks, int width, int height,
               const std::function<std::vector<float>(int)>& reference, double tolerance, bool alike)
    {
        const int count = std::min(o_.views, std::max(o_.checked, o_.ppm.empty() ? 0 : 1));
        for (int i = 0; i < count; ++i) {
            const int view = i * o_.views / count;
            const std::vector<float> expected = rank_ == 0 && o_.checked > 0 ? reference(view) : std::vector<float>();
            std::vector<float> first;
            for (PaperWay& way : ways) {
                way.frame(view);
                if (rank_ != 0)
                    continue;
                const std::vector<float> image = way.image();
                if (i == 0 && first.empty() && !o_.ppm.empty())
                    writePpm(o_.ppm, image, width, height);
                if (first.empty())
                    first = image;
                if (expected.empty())
                    continue;
                const double difference = bench::differenceOf(image.data(), expected.data(), expected.size());
                const bool isSame = !alike || image == first, isRight = difference <= tolerance && isSame;
                way.maxError = std::max(way.maxError, difference);
                std::printf("%s %dx%d, %d ranks, view %d, %s: off by %.2g, %g is allowed%s\n",
                            isRight ? "right:" : "WRONG:", width, height, ranks, view,
                            (way.system + ": " + way.config).c_str(), difference, tolerance,
                            !alike   ? ""
                            : isSame ? "; as one brick a rank, bit for bit"
                                     : "; not as one brick a rank");
                std::fflush(stdout);
                isRight_ = isRight_ && isRight;
            }
        }
    }

    void keep(const std::vector<PaperWay>& ways, const std::string& sceneName, int ranks, int width, int height)
    {
        for (const PaperWay& way : ways) {
            Measurement m = bench::measurementOf(way);
            if (rank_ != 0)
                continue;
            m.figure = o_.figure;
            m.threads = o_.threads;
            m.result.scene = sceneName;
            m.result.ranks = ranks;
            m.result.width = width;
            m.result.height = height;
            m.result.commit = o_.commit;
            if (way.system == "dfb" && o_.compress != "never")
                m.result.config += o_.compress == "auto" ? ", Snappy if faster" : ", Snappy";
            std::printf("%dx%d, %d ranks, %s: %s: %s ms\n", width, height, ranks, way.system.c_str(),
                        way.config.c_str(), bench::text(m.result.ms).c_str());
            found_.push_back(std::move(m));
        }
        std::fflush(stdout);
    }

    MPI_Comm all_;
    Options o_;
    int rank_ = 0;
    bool isRight_ = true;
    std::string sceneName_;
    std::vector<Measurement> found_; // on rank 0
};

// Ends the program after --help, or if it was called wrongly.
Options optionsOf(int argc, char** argv)
{
    Options o;
    const auto isCompression = [&o](const std::string& value) {
        o.compress = value;
#if defined(DFB_HAS_SNAPPY)
        return value == "never" || value == "always" || value == "auto";
#else
        return value == "never";
#endif
    };
    const char* usage =
        "usage: mpirun -n RANKS bench_paper --figure 6|7|8|9|10 [--ranks N,...] [--size WxH,...] [--views N] "
        "[--repeats N] [--scale S] [--seed K] [--threads N] [--compress never|always|auto] [--check VIEWS] [--json "
        "FILE] [--svg FILE] "
        "[--table FILE] [--ppm FILE] [--trace FILE] [--commit ID]\n"
        "  --scale S      factor of the resolution of the data\n"
        "  --check VIEWS  the images of so many views are compared with a reference\n"
        "  --repeats N    frames of each view";
    bench::readOptions(
        argc, argv, usage,
        {{"--figure", bench::readNumber(o.figure, 6)},
         {"--ranks", bench::readNumbers(o.ranks, 1, 1 << 20)},
         {"--size", bench::readSizes(o.sizes)},
         {"--views", bench::readNumber(o.views, 1)},
         {"--repeats", bench::readNumber(o.repeats, 1)},
         {"--scale", [&o](const std::string& value) { return (o.scale = std::atof(value.c_str())) > 0; }},
         {"--seed", bench::readNumber(o.seed, 0)},
         {"--threads", bench::readNumber(o.threads, 1)},
         {"--compress", isCompression},
         {"--check", bench::readNumber(o.checked, 0)},
         {"--json", bench::readText(o.json)},
         {"--svg", bench::readText(o.svg)},
         {"--table", bench::readText(o.table)},
         {"--ppm", bench::readText(o.ppm)},
         {"--trace", bench::readText(o.trace)},
         {"--commit", bench::readText(o.commit)}});
    if (o.figure < 6 || o.figure > 10 || !std::is_sorted(o.ranks.begin(), o.ranks.end())) {
        std::printf("%s\n", usage);
        std::exit(2);
    }
    return o;
}

} // namespace

int main(int argc, char** argv)
{
    Options options = optionsOf(argc, argv);
    bool isRight = true;
    bench::withMpi(argc, argv, [&](MPI_Comm comm) {
        const int size = bench::sizeOf(comm);
        std::vector<int>& ranks = options.ranks;
        if (ranks.empty()) {
            for (int n = 1; n < size && options.figure != 10; n *= 2)
                ranks.push_back(n);
            ranks.push_back(size);
        }
        isRight = ranks.back() <= size;
        if (isRight)
            isRight = PaperFigure(comm, options).run();
        else
            std::fprintf(stderr, "--ranks %d: there are only %d\n", ranks.back(), size);
    });
    return isRight ? 0 : 1;
}
