// Time against error: what every way to send tiles costs and how exact its image is; beside IceT with floats and bytes,
// and a plain loop in float, on the same partial images in the same run, frame by frame in turn. And what samples cost
// in a scene with noise.
//   mpirun -n 4 bench_error_time [--size 1024x1024] [--frames 21] [--only TEXT] [--json FILE] [--table FILE]
//   [--commit ID] [--trace FILE]
// --trace: of dfb's first system.
#include "systems.hpp"

#include <dfb/blend/compositing.hpp>

#include <memory>
#include <sstream>

namespace {

using bench::Inputs;
using bench::Result;
using bench::System;

struct Options {
    int width = 1024, height = 1024, frames = 21;
    std::string json, table, commit, trace;
    std::string only; // the systems whose name and configuration have one of these, with | between
};

void addAllDfb(std::vector<System>& systems, const Inputs& inputs)
{
    const auto connect = bench::connectBy(inputs.comm, false);
    using bench::DfbSettings, dfb::ImageBlend, dfb::WireFormat;
    const auto add = [&](const std::string& config, const DfbSettings& settings) {
        bench::addImages(systems, connect, inputs, config, ImageBlend::ByDepth, settings);
    };
    const auto addOrdered = [&](const std::string& config, const DfbSettings& settings) {
        bench::addImages(systems, connect, inputs, "in order, " + config, ImageBlend::InOrder, settings);
    };
    DfbSettings defaults;
    defaults.hasDefaultThreads = true;
    bench::addImages(systems, bench::connectBy(inputs.comm), inputs, bench::defaultConfig, ImageBlend::ByDepth,
                     defaults);
    add("float32", {});
    addOrdered("float32", {});
    for (const WireFormat format : {WireFormat::Float16, WireFormat::Unorm16, WireFormat::Unorm8}) {
        add(nameOf(format), {format});
        addOrdered(nameOf(format), {format});
    }
    for (const double budget : {1e-2, 2e-3, 5e-4, 1e-5}) {
        std::ostringstream name;
        name << "budget " << budget;
        add(name.str(), {dfb::ErrorBudget{budget}});
    }
    addOrdered("within half a level", {dfb::HalfLevel{}});
    add("float32, transmittance 1e-3", {WireFormat::Float32, {}, 1e-3f});
    DfbSettings inPlace;
    inPlace.isShared = true;
    add("float32, all in place", inPlace);
    addOrdered("float32, all in place", inPlace);
    inPlace.hasBytes = true;
    addOrdered("bytes, all in place", inPlace);
#if defined(DFB_HAS_SNAPPY)
    const auto snappy = std::make_shared<dfb::SnappyCodec>();
    for (const WireFormat format : {WireFormat::Float32, WireFormat::Float16, WireFormat::Unorm8})
        add(std::string(nameOf(format)) + ", snappy", {format, snappy});
#endif
    for (const auto& [side, addTiles] : {std::make_pair("32", &bench::addDfb<dfb::BasicAlphaBlend<32>>),
                                         std::make_pair("64", &bench::addDfb<dfb::BasicAlphaBlend<64>>),
                                         std::make_pair("128", &bench::addDfb<dfb::BasicAlphaBlend<128>>)})
        addTiles(systems, connect, inputs, std::string("tiles of ") + side + ", float32", {});
}

// A disc with a noisy rim and half of it in noisy light before a background without any. It renders a sample of each
// pixel of a tile, of which each takes 1 us.
struct NoisyDisc {
    static constexpr int side = 256; // of the image

    template <class Tile>
    void operator()(Tile& tile) const
    {
        const double until = bench::now() + 1e-6 * tile.region.width() * tile.region.height();
        tile.forEachPixel([&](int x, int y, float* rgba, float&) {
            std::uint64_t h =
                static_cast<std::uint64_t>(y * side + x) * 1000003u + static_cast<std::uint64_t>(tile.sample);
            h = (h ^ h >> 31) * 0x9e3779b97f4a7c15u;
            h = (h ^ h >> 29) * 0xbf58476d1ce4e5b9u;
            const double random = static_cast<double>(h >> 11) * 0x1p-53;
            const auto value = static_cast<float>(mean(x, y) + spread(x, y) * (2 * random - 1));
            for (int c = 0; c < 3; ++c)
                rgba[c] = value;
            rgba[3] = 1;
        });
        while (bench::now() < until) {
        }
    }

    static bench::ExactImage exact()
    {
        bench::ExactImage image{side};
        for (int i = 0; i < side * side; ++i) {
            const double grey = mean(i % side, i / side);
            dfb::testing::Pixel pixel;
            pixel.rgba = {grey, grey, grey, 1.0};
            image.add(pixel);
        }
        return image;
    }

private:
    // From the middle of the image, whose sides have length 1.
    static double across(int x) { return (x + 0.5) / side - 0.5; }
    static double distance(int x, int y) { return std::sqrt(across(x) * across(x) + across(y) * across(y)); }

    static double mean(int x, int y) { return distance(x, y) < 0.2 ? 0.3 + 0.4 * (0.5 + across(x)) : 0.1; }
    static double spread(int x, int y)
    {
        const double r = distance(x, y);
        return r > 0.2 ? 0.0 : r > 0.18 || across(x) > 0 ? 0.25 : 0.05;
    }
};

class Bench {
public:
    Bench(MPI_Comm comm, Options o)
        : comm_(comm), o_(std::move(o)), rank_(bench::rankIn(comm)), size_(bench::sizeOf(comm))
    {
    }

    void bricks()
    {
        const bench::BrickScene scene(size_, o_.width, o_.height);
        Inputs inputs(comm_, scene, rank_);
        inputs.trace = o_.trace;
        bench::ExactImage exact;
        if (rank_ == 0)
            exact = scene.exact();
        bench::meet(comm_);
        std::vector<System> systems;
        addAllDfb(systems, inputs);
        bench::addDirectSend(systems, inputs);
#ifdef DFB_BENCH_HAS_ICET
        bench::addIceT(systems, inputs);
#endif
        bench::keepWanted(systems, o_.only);
        bench::measureInTurns(inputs, systems, o_.frames, exact);
        bench::takeErrorsOfFloats(systems);
        for (System& s : systems) {
            describe(s, "bricks", o_.width, o_.height);
            if (rank_ == 0)
                (s.isFloat() ? floats_ : bytes_).push_back(s.result);
        }
    }

    // The noisy disc: the time of samples, and how far they are from its mean.
    void noise()
    {
        using Op = dfb::Progressive<dfb::BasicImageParallel<16>>;
        dfb::FrameBufferConfig c(NoisyDisc::side, NoisyDisc::side, dfb::OutputFormat::RGBA32F);
        c.executor = std::make_shared<dfb::ThreadExecutor>(1);
        dfb::DistributedFrameBuffer<Op> fb(comm_, c);
        dfb::ImageParallelLoop loop(fb, dfb::WorkDistribution::Dynamic);
        const bench::ExactImage exact = NoisyDisc::exact();
        std::uint64_t accumulation = 1;
        std::vector<System> systems;
        const auto add = [&](const std::string& config, int samples, double threshold) {
            System s;
            s.name = "dfb";
            s.config = config;
            s.output = "float";
            const auto bytes = std::make_shared<std::pair<std::int64_t, std::int64_t>>();
            s.compositor.frame = [&fb, &loop, &accumulation, samples, threshold, bytes] {
                *bytes = {0, 0};
                const auto take = [&](const dfb::FrameReport& report) {
                    bytes->first += report.bytesSent;
                    bytes->second += report.messagesSent;
                    return report;
                };
                dfb::FrameConfig params;
                params.accumulationId = ++accumulation;
                if (threshold > 0) {
                    dfb::AdaptiveSampler sampler(fb.layout(), {threshold, 8, samples, 64});
                    while (!sampler.done())
                        sampler.update(take(loop.render(NoisyDisc(), sampler.next(params))));
                } else {
                    params.passes = samples;
                    take(loop.render(NoisyDisc(), params));
                }
            };
            s.compositor.image = [&fb] { return fb.image().bytes(); };
            s.compositor.traffic = [bytes] { return *bytes; };
            s.compositor.trafficIsOfAll = true;
            systems.push_back(std::move(s));
        };
        for (const int samples : {1, 4, 16, 64})
            add(std::to_string(samples) + (samples == 1 ? " sample" : " samples"), samples, 0);
        for (const double threshold : {0.05, 0.02, 0.01}) {
            std::ostringstream name;
            name << "adaptive, " << threshold;
            add(name.str(), 256, threshold);
        }
        const int frames = std::max(3, o_.frames / 4);
        bench::FrameTimer timer(comm_);
        for (System& s : systems) {
            for (int frame = -1; frame < frames; ++frame)
                bench::timeFrame(comm_, timer, s, frame >= 0);
            bench::takeResult(comm_, s, exact); // before the next one's image is in the framebuffer
            describe(s, "noise", NoisyDisc::side, NoisyDisc::side);
            if (rank_ == 0)
                noise_.push_back(s.result);
        }
    }

    // What exactness costs: layers in known order, in rows of tiles that stay in the cache, to bytes; in double with
    // exact rounding, as the library does it, and in plain float. On rank 0.
    void kernels()
    {
        if (rank_ != 0)
            return;
        constexpr int width = 64, rounds = 2000;
        for (const int layers : {1, 4, 16}) {
            std::vector<std::vector<float>> pixels;
            std::vector<dfb::Layer> stack;
            std::vector<int> order;
            for (int k = 0; k < layers; ++k) {
                pixels.emplace_back();
                for (int i = 0; i < 4 * width; ++i)
                    pixels.back().push_back(0.001f * static_cast<float>((i * 37 + k * 11) % 200));
            }
            for (int k = 0; k < layers; ++k) {
                stack.push_back({pixels[static_cast<std::size_t>(k)].data(), nullptr, nullptr});
                order.push_back(k);
            }
            dfb::CompositeRow row;
            row.wantsDepth = false;
            row.resize(width);
            std::vector<std::byte> bytes(4 * width);
            std::vector<float> sum(4 * width);
            std::vector<double> exact, plain;
            for (int sample = 0; sample < 41; ++sample) {
                double start = bench::now();
                for (int i = 0; i < rounds; ++i) {
                    dfb::detail::blend(row, 0, 0, width, stack, order);
                    dfb::convertPixels(row.rgba.data(), width, dfb::OutputFormat::RGBA8, bytes.data());
                }
                exact.push_back(1e9 * (bench::now() - start) / rounds / width);
                start = bench::now();
                for (int i = 0; i < rounds; ++i) {
                    bench::DirectSend::blendRow(nullptr, sum.data(), width);
                    for (const auto& p : pixels)
                        bench::DirectSend::blendRow(p.data(), sum.data(), width);
                    bench::DirectSend::convertToBytes(sum.data(), sum.size(),
                                                      reinterpret_cast<std::uint8_t*>(bytes.data()));
                }
                plain.push_back(1e9 * (bench::now() - start) / rounds / width);
            }
            kernels_.push_back({layers, bench::figureOf(exact), bench::figureOf(plain)});
        }
    }

    void write() const
    {
        if (rank_ != 0)
            return;
        std::ostringstream all, chosen;
        std::vector<Result> results;
        for (const auto* rows : {&floats_, &bytes_, &noise_}) {
            if (rows->empty())
                continue;
            results.insert(results.end(), rows->begin(), rows->end());
            const std::string head = "\n| " + rows->front().scene + ", " + std::to_string(size_) + " ranks, to "
                                     + (rows == &bytes_ ? "8 bit" : "float")
                                     + " | ms | CPU ms | MB sent | max error | RMSE | levels off |\n"
                                       "|---|--:|--:|--:|--:|--:|--:|\n";
            all << head;
            chosen << head;
            for (const Result& r : *rows) {
                all << line(r, *rows);
                if (bench::hasDefaults(r) || isOnFront(r, *rows) || isBestOfKind(r, *rows) || rows == &noise_)
                    chosen << line(r, *rows);
            }
            for (const Result& r : *rows)
                if (bench::hasDefaults(r) && !isOnFront(r, *rows))
                    all << "\nThe defaults are not on the front.\n", chosen << "\nThe defaults are not on the front.\n";
        }
        for (std::ostringstream* table : {&all, &chosen}) {
            if (kernels_.empty())
                continue;
            *table << "\n| compositing to 8 bit alone, ns a pixel | double, rounded exactly | plain float | ratio |\n"
                      "|---|--:|--:|--:|\n";
            for (const Kernel& k : kernels_)
                *table << "| " << k.layers << (k.layers == 1 ? " layer | " : " layers | ") << bench::text(k.exact)
                       << " | " << bench::text(k.plain) << " | " << bench::text(k.exact.median / k.plain.median)
                       << " |\n";
        }
        std::printf("%s", all.str().c_str());
        bench::appendJson(o_.json, results);
        bench::appendTo(o_.table, chosen.str());
    }

private:
    // The fastest of a peer's strategies with this kind of pixels.
    static bool isBestOfKind(const Result& r, const std::vector<Result>& all)
    {
        const auto kindOf = [](const Result& x) { return x.system + x.config.substr(0, x.config.find(',')); };
        return r.system != "dfb" && std::none_of(all.begin(), all.end(), [&](const Result& o) {
                   return kindOf(o) == kindOf(r) && o.ms.median < r.ms.median;
               });
    }

    struct Kernel {
        int layers;
        bench::Figure exact, plain;
    };

    void describe(System& s, const std::string& scene, int width, int height) const
    {
        s.result.bench = "bench_error_time";
        s.result.scene = scene;
        s.result.width = width;
        s.result.height = height;
        s.result.commit = o_.commit;
    }

    static std::string line(const Result& r, const std::vector<Result>& all)
    {
        const bool front = isOnFront(r, all);
        char text[512];
        std::snprintf(text, sizeof text, "| %s%s: %s%s | %s | %s | %.2f | %.2g | %.2g | %d |\n", front ? "**" : "",
                      r.system.c_str(), r.config.c_str(), front ? "**" : "", bench::text(r.ms).c_str(),
                      bench::text(r.cpuMs).c_str(), r.bytes / 1e6, r.maxError, r.rmse, r.levels);
        return text;
    }

    MPI_Comm comm_;
    Options o_;
    int rank_, size_;
    std::vector<Result> floats_, bytes_, noise_; // on rank 0
    std::vector<Kernel> kernels_;
};

// Ends the program after --help, or if it was called wrongly.
Options optionsOf(int argc, char** argv)
{
    Options o;
    bench::readOptions(
        argc, argv,
        "usage: mpirun -n RANKS bench_error_time [--size WxH] [--frames N] [--json FILE] [--table FILE] [--commit ID] "
        "[--only TEXT] [--trace FILE]",
        {{"--size", [&o](const std::string& value) { return bench::readSize(value, o.width, o.height); }},
         {"--frames", bench::readNumber(o.frames, 1)},
         {"--json", bench::readText(o.json)},
         {"--table", bench::readText(o.table)},
         {"--trace", bench::readText(o.trace)},
         {"--only", bench::readText(o.only)},
         {"--commit", bench::readText(o.commit)}});
    return o;
}

} // namespace

int main(int argc, char** argv)
{
    const Options options = optionsOf(argc, argv);
    bench::withMpi(argc, argv, [&](MPI_Comm comm) {
        Bench bench(comm, options);
        bench.bricks();
        if (options.only.empty()) {
            bench.noise();
            bench.kernels();
        }
        bench.write();
    });
}
