// Time against error: what every way to send tiles costs and how exact its image is; beside IceT with floats and bytes,
// and a plain loop in float, on the same partial images in the same run, frame by frame in turn. And what samples cost
// in a scene with noise.
//   mpirun -n 4 bench_error_time [--size 1024x1024] [--frames 21] [--json FILE] [--svg FILE] [--table FILE] [--commit
//   ID]
#include "direct_send.hpp"
#include "results.hpp"
#ifdef DFB_BENCH_HAS_ICET
#include "icet.hpp"
#endif

#include <dfb/dfb.hpp>
#include <dfb/testing/error_report.hpp>

#include <cstring>
#include <functional>
#include <map>
#include <memory>
#include <sstream>

namespace {

using bench::BrickImage;
using bench::Result;
using dfb::testing::ErrorReport;
using Messenger = dfb::Messenger<dfb::MpiTransport>;
using Exact = std::vector<dfb::testing::Pixel>;

struct Options {
    int width = 1024, height = 1024, frames = 21;
    std::string json, svg, table, commit;
    std::string only; // the systems whose name and configuration have one of these, with | between
};

// Something that makes an image of what all ranks have, and what is known of it.
struct System {
    std::string name, config, output; // output: of the image, "float" or "8 bit"
    std::function<void()> frame;      // collective
    // Of the last frame on rank 0: 4 a pixel, one of the two.
    std::function<const float*()> floats;
    std::function<const std::uint8_t*()> bytes;
    std::function<std::pair<std::int64_t, std::int64_t>()> traffic; // of this rank: bytes, messages
    bool trafficIsOfAll = false;
    std::function<double()> peakMemory;
    bool isDefault = false;
    std::vector<double> ms{}, cpuMs{};
    Result result{};
};

// ---- dfb: inputs that are ready are read where they are

// The boxes of bricks are in pixels.
struct PixelCamera {
    dfb::Region project(const dfb::Box3& box, int, int) const
    {
        return {static_cast<int>(box.lower.x), static_cast<int>(box.lower.y), static_cast<int>(box.upper.x),
                static_cast<int>(box.upper.y)};
    }
};

// Each rank has one brick.
dfb::World worldOf(const BrickImage& image, int rank)
{
    dfb::World world;
    const auto& v = image.viewport;
    if (v[2] > 0)
        world.add({static_cast<std::uint32_t>(rank),
                   {{static_cast<float>(v[0]), static_cast<float>(v[1]), 0},
                    {static_cast<float>(v[0] + v[2]), static_cast<float>(v[1] + v[3]), 1}}});
    return world;
}

template <class TileOp>
inline constexpr bool isOrdered = TileOp::rule == dfb::BlendRule::InOrder;

struct DfbSettings {
    dfb::WirePrecision wire{};
    std::shared_ptr<const dfb::Codec> codec{};
    float minTransmittance = 0;
    bool isDefault = false;
};

// `order`: the ranks front to back, for OrderedBlend.
template <class TileOp>
void addDfb(std::vector<System>& systems, const std::shared_ptr<Messenger>& messenger, const BrickImage& image,
            const std::vector<int>& order, const std::string& config, const DfbSettings& settings)
{
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp>;
    struct Renderer {
        Renderer(const std::shared_ptr<Messenger>& sharedMessenger, const dfb::FrameBufferConfig& c,
                 const BrickImage& brick)
            : fb(sharedMessenger, c), world(worldOf(brick, fb.rank())), shared(fb, world)
        {
        }
        FrameBuffer fb;
        dfb::World world;
        dfb::SharedWorld shared;
        dfb::RoundRobinBricks owner;
        dfb::FrameReport report;
    };
    for (const bool toBytes : {false, true}) {
        dfb::FrameBufferConfig c;
        c.width = image.width;
        c.height = image.height;
        c.format = toBytes ? dfb::OutputFormat::RGBA8 : dfb::OutputFormat::RGBA32F;
        c.wire = settings.wire;
        c.codec = settings.codec;
        c.minTransmittance = settings.minTransmittance;
        c.executor = std::make_shared<dfb::ThreadExecutor>(1);
        const auto r = std::make_shared<Renderer>(messenger, c, image);
        System s;
        s.name = "dfb";
        s.config = config;
        s.output = toBytes ? "8 bit" : "float";
        s.isDefault = settings.isDefault;
        s.frame = [r, from = &image, order] {
            const auto renderBrick = dfb::inPlace([from](const dfb::Brick&, auto& view) {
                view.stride = static_cast<std::size_t>(from->width);
                const std::size_t first = static_cast<std::size_t>(view.region.y0) * view.stride
                                          + static_cast<std::size_t>(view.region.x0);
                view.color = &from->rgba[4 * first];
                view.depth = &from->depth[first];
            });
            if constexpr (isOrdered<TileOp>) {
                std::vector<int> places; // of bricks in the shared world, which has them by id
                for (const int rank : order)
                    for (std::size_t i = 0; i < r->shared.bricks().size(); ++i)
                        if (r->shared.bricks()[i].brick.id == static_cast<std::uint32_t>(rank))
                            places.push_back(static_cast<int>(i));
                r->report = dfb::renderOrdered(r->fb, r->shared, PixelCamera(), places, r->owner, renderBrick);
            } else {
                dfb::FrameParams params;
                params.maxLayers = r->fb.size();
                r->report = dfb::renderDataParallel(r->fb, r->world, PixelCamera(), renderBrick, params);
            }
        };
        if (toBytes)
            s.bytes = [r] { return r->fb.image().rgba8(); };
        else
            s.floats = [r] { return r->fb.image().rgba32f(); };
        s.traffic = [r] { return std::make_pair(r->report.bytesSent, r->report.messagesSent); };
        s.trafficIsOfAll = true;
        s.peakMemory = [r] { return static_cast<double>(r->report.peakMemoryBytes); };
        systems.push_back(std::move(s));
    }
}

void addAllDfb(std::vector<System>& systems, const std::shared_ptr<Messenger>& messenger, const BrickImage& image,
               const std::vector<int>& order)
{
    using dfb::WireFormat;
    const auto add = [&](const std::string& config, const DfbSettings& settings) {
        addDfb<dfb::AlphaBlend>(systems, messenger, image, order, config, settings);
    };
    const auto addOrdered = [&](const std::string& config, const DfbSettings& settings) {
        addDfb<dfb::OrderedBlend>(systems, messenger, image, order, config, settings);
    };
    add("float32", {WireFormat::Float32, {}, 0, true});
    addOrdered("in order, float32", {WireFormat::Float32, {}, 0, true});
    for (const WireFormat format : {WireFormat::Float16, WireFormat::Unorm16, WireFormat::Unorm8}) {
        add(nameOf(format), {format});
        addOrdered(std::string("in order, ") + nameOf(format), {format});
    }
    for (const double budget : {1e-2, 2e-3, 5e-4, 1e-5}) {
        std::ostringstream name;
        name << "budget " << budget;
        add(name.str(), {dfb::ErrorBudget{budget}});
    }
    add("float32, transmittance 1e-3", {WireFormat::Float32, {}, 1e-3f});
    addDfb<dfb::BasicAlphaBlend<32>>(systems, messenger, image, order, "float32, tiles of 32", {});
    addDfb<dfb::BasicAlphaBlend<128>>(systems, messenger, image, order, "float32, tiles of 128", {});
    addDfb<dfb::BasicOrderedBlend<128>>(systems, messenger, image, order, "in order, float32, tiles of 128", {});
    addDfb<dfb::BasicOrderedBlend<128>>(systems, messenger, image, order, "in order, unorm16, tiles of 128",
                                        {WireFormat::Unorm16});
#if defined(DFB_HAS_SNAPPY)
    const auto snappy = std::make_shared<dfb::SnappyCodec>();
    for (const WireFormat format : {WireFormat::Float32, WireFormat::Float16, WireFormat::Unorm8})
        add(std::string(nameOf(format)) + ", snappy", {format, snappy});
#endif
}

// ---- the peers

void addPlain(std::vector<System>& systems, MPI_Comm comm, const bench::BrickScene& scene, const BrickImage& image,
              const std::vector<std::array<int, 4>>& viewports)
{
    for (const bool toBytes : {false, true}) {
        const auto plain =
            std::make_shared<bench::DirectSend>(comm, scene.order(), viewports, image.width, image.height, toBytes);
        const auto out = std::make_shared<const std::byte*>(nullptr);
        System s;
        s.name = "plain";
        s.config = "direct send, float";
        s.output = toBytes ? "8 bit" : "float";
        s.frame = [plain, out, &image] { *out = plain->composite(image.rgba); };
        if (toBytes)
            s.bytes = [out] { return reinterpret_cast<const std::uint8_t*>(*out); };
        else
            s.floats = [out] { return reinterpret_cast<const float*>(*out); };
        s.traffic = [plain] { return std::make_pair(plain->bytesSent(), plain->messagesSent()); };
        systems.push_back(std::move(s));
    }
}

#ifdef DFB_BENCH_HAS_ICET
// As a user would, whose renderer has floats: for bytes they are converted first; for bytes out of floats, afterwards.
void addIceT(std::vector<System>& systems, MPI_Comm comm, const bench::BrickScene& scene, const BrickImage& image)
{
    enum class Way { Floats, FloatsToBytes, Bytes };
    for (const bench::IceTStrategy& strategy : bench::icetStrategies()) {
        const std::string name = strategy.name;
        if (name != "direct" && name != "sequential, radix-k" && name != "sequential, binary swap"
            && name != "sequential, tree")
            continue;
        for (const Way way : {Way::Floats, Way::FloatsToBytes, Way::Bytes}) {
            bench::IceTSettings settings;
            settings.strategy = strategy.strategy;
            settings.singleImage = strategy.singleImage;
            settings.ubyte = way == Way::Bytes;
            const auto icet = std::make_shared<bench::IceT>(comm, settings, image.width, image.height);
            const std::size_t values =
                4 * static_cast<std::size_t>(image.width) * static_cast<std::size_t>(image.height);
            const auto converted = std::make_shared<std::vector<std::uint8_t>>(way == Way::Floats ? 0 : values);
            const auto out = std::make_shared<const void*>(nullptr);
            const auto toBytes = [](const float* from, std::uint8_t* to, std::size_t count) {
                for (std::size_t i = 0; i < count; ++i)
                    to[i] = static_cast<std::uint8_t>(std::min(std::max(from[i], 0.0f), 1.0f) * 255 + 0.5f);
            };
            System s;
            s.name = "icet";
            s.config = (way == Way::Bytes ? "ubyte, " : "float, ") + name;
            s.output = way == Way::Floats ? "float" : "8 bit";
            const std::vector<int> order = scene.order();
            s.frame = [=, &image] {
                const auto& v = image.viewport;
                const void* input = image.rgba.data();
                if (way == Way::Bytes) {
                    for (int y = v[1]; y < v[1] + v[3]; ++y) {
                        const std::size_t first = 4
                                                  * (static_cast<std::size_t>(y) * static_cast<std::size_t>(image.width)
                                                     + static_cast<std::size_t>(v[0]));
                        toBytes(&image.rgba[first], converted->data() + first, 4 * static_cast<std::size_t>(v[2]));
                    }
                    input = converted->data();
                }
                icet->resetTraffic();
                *out = icet->composite(input, v.data(), order);
                if (way == Way::FloatsToBytes && *out) {
                    toBytes(static_cast<const float*>(*out), converted->data(), values);
                    *out = converted->data();
                }
            };
            if (way == Way::Floats)
                s.floats = [out] { return static_cast<const float*>(*out); };
            else
                s.bytes = [out] { return static_cast<const std::uint8_t*>(*out); };
            s.traffic = [icet] { return std::make_pair(icet->bytesSent(), icet->messagesSent()); };
            systems.push_back(std::move(s));
        }
    }
}
#endif

// ---- measuring

// Of an image, 4 values a pixel, one of the two.
ErrorReport errorOf(const float* floats, const std::uint8_t* bytes, const Exact& exact)
{
    ErrorReport report;
    for (std::size_t i = 0; i < 4 * exact.size(); ++i) {
        const auto value = exact[i / 4].rgba[i % 4];
        const std::uint8_t level = dfb::testing::toUnorm8(value);
        if (floats) {
            report.add(floats[i], value);
            report.addByte(dfb::testing::toUnorm8(static_cast<dfb::testing::Exact>(floats[i])), level);
        } else {
            report.add(static_cast<float>(bytes[i]) / 255, value);
            report.addByte(bytes[i], level);
        }
    }
    return report;
}

class Bench {
public:
    Bench(MPI_Comm comm, Options o) : comm_(comm), o_(std::move(o))
    {
        MPI_Comm_rank(comm, &rank_);
        MPI_Comm_size(comm, &size_);
    }

    void bricks()
    {
        const bench::BrickScene scene(size_, o_.width, o_.height);
        const BrickImage image = scene.render(rank_);
        std::vector<std::array<int, 4>> viewports;
        for (int rank = 0; rank < size_; ++rank)
            viewports.push_back(rank == rank_ ? image.viewport : scene.render(rank).viewport);
        Exact exact;
        if (rank_ == 0)
            exact = scene.exact();
        bench::meet(comm_);
        const auto messenger = std::make_shared<Messenger>(comm_);
        std::vector<System> systems;
        addAllDfb(systems, messenger, image, scene.order());
        addPlain(systems, comm_, scene, image, viewports);
#ifdef DFB_BENCH_HAS_ICET
        addIceT(systems, comm_, scene, image);
#endif
        systems.erase(std::remove_if(
                          systems.begin(), systems.end(),
                          [this](const System& s) { return !isWanted(s.name + ": " + s.config + ", to " + s.output); }),
                      systems.end());
        for (int frame = -1; frame < o_.frames; ++frame) // the first touches memory
            for (std::size_t i = 0; i < systems.size(); ++i)
                time(systems[(i + static_cast<std::size_t>(frame + 1)) % systems.size()], frame >= 0);
        for (System& s : systems) {
            describe(s, "bricks");
            const auto traffic = s.traffic();
            s.result.bytes = static_cast<double>(traffic.first);
            s.result.messages = static_cast<double>(traffic.second);
            if (!s.trafficIsOfAll) {
                s.result.bytes = bench::reduce(comm_, s.result.bytes, MPI_SUM);
                s.result.messages = bench::reduce(comm_, s.result.messages, MPI_SUM);
            }
            if (rank_ == 0) {
                const ErrorReport e = errorOf(s.floats ? s.floats() : nullptr, s.bytes ? s.bytes() : nullptr, exact);
                s.result.maxError = e.maxAbs;
                s.result.rmse = e.rmse();
                s.result.levels = e.maxLevels;
            }
            if (s.peakMemory)
                s.result.peakMemoryBytes = s.peakMemory();
        }
        // Of a system that makes 8 bits out of an image in float, the error is that of the image.
        for (System& s : systems)
            for (const System& f : systems)
                if (s.bytes && f.floats && s.name == f.name && s.config == f.config) {
                    s.result.maxError = f.result.maxError;
                    s.result.rmse = f.result.rmse;
                }
        for (System& s : systems)
            if (rank_ == 0)
                (s.bytes ? bytes_ : floats_).push_back({s.result, s.output, s.isDefault});
    }

    // A disc with a noisy rim and half of it in noisy light before a background without any: what samples cost, of
    // which each takes 1 us.
    void noise()
    {
        const int width = 256, height = 256;
        const auto meanOf = [=](int x, int y) {
            const double u = (x + 0.5) / width - 0.5, v = (y + 0.5) / height - 0.5, r = std::sqrt(u * u + v * v);
            return r < 0.2 ? 0.3 + 0.4 * (0.5 + u) : 0.1;
        };
        const auto spreadOf = [=](int x, int y) {
            const double u = (x + 0.5) / width - 0.5, v = (y + 0.5) / height - 0.5, r = std::sqrt(u * u + v * v);
            return r > 0.2 ? 0.0 : r > 0.18 || u > 0 ? 0.25 : 0.05;
        };
        using Op = dfb::Progressive<dfb::BasicImageParallel<16>>;
        const auto render = [=](auto& tile) {
            const double until = bench::now() + 1e-6 * tile.region.width() * tile.region.height();
            tile.forEachPixel([&](int x, int y, float* rgba, float&) {
                std::uint64_t h =
                    static_cast<std::uint64_t>(y * width + x) * 1000003u + static_cast<std::uint64_t>(tile.sample);
                h = (h ^ h >> 31) * 0x9e3779b97f4a7c15u;
                h = (h ^ h >> 29) * 0xbf58476d1ce4e5b9u;
                const double random = static_cast<double>(h >> 11) * 0x1p-53;
                const auto value = static_cast<float>(meanOf(x, y) + spreadOf(x, y) * (2 * random - 1));
                for (int c = 0; c < 3; ++c)
                    rgba[c] = value;
                rgba[3] = 1;
            });
            while (bench::now() < until) {
            }
        };
        dfb::FrameBufferConfig c;
        c.width = width;
        c.height = height;
        c.format = dfb::OutputFormat::RGBA32F;
        c.executor = std::make_shared<dfb::ThreadExecutor>(1);
        dfb::DistributedFrameBuffer<Op> fb(comm_, c);
        Exact exact;
        for (int i = 0; i < width * height; ++i) {
            dfb::testing::Pixel pixel;
            for (std::size_t k = 0; k < 4; ++k)
                pixel.rgba[k] = k == 3 ? 1.0 : meanOf(i % width, i / width);
            exact.push_back(pixel);
        }
        std::uint64_t accumulation = 1;
        std::vector<System> systems;
        const auto add = [&](const std::string& config, int samples, double threshold) {
            System s;
            s.name = "dfb";
            s.config = config;
            s.output = "float";
            const auto bytes = std::make_shared<std::pair<std::int64_t, std::int64_t>>();
            s.frame = [&fb, &accumulation, render, samples, threshold, bytes] {
                *bytes = {0, 0};
                const auto take = [&](const dfb::FrameReport& report) {
                    bytes->first += report.bytesSent;
                    bytes->second += report.messagesSent;
                    return report;
                };
                dfb::FrameParams params;
                params.accumulationId = ++accumulation;
                if (threshold > 0) {
                    dfb::AdaptiveSampler sampler(fb.layout(), {threshold, 8, samples, 64});
                    while (!sampler.done())
                        sampler.update(take(dfb::renderImageParallel(fb, dfb::WorkDistribution::Dynamic, render,
                                                                     sampler.next(params))));
                } else {
                    params.passes = samples;
                    take(dfb::renderImageParallel(fb, dfb::WorkDistribution::Dynamic, render, params));
                }
            };
            s.floats = [&fb] { return fb.image().rgba32f(); };
            s.traffic = [bytes] { return *bytes; };
            systems.push_back(std::move(s));
        };
        for (const int samples : {1, 4, 16, 64})
            add(std::to_string(samples) + " samples", samples, 0);
        for (const double threshold : {0.05, 0.02, 0.01}) {
            std::ostringstream name;
            name << "adaptive, " << threshold;
            add(name.str(), 256, threshold);
        }
        const int frames = std::max(3, o_.frames / 4);
        for (System& s : systems)
            for (int frame = -1; frame < frames; ++frame) {
                time(s, frame >= 0);
                if (frame + 1 == frames && rank_ == 0) {
                    const ErrorReport e = errorOf(s.floats(), nullptr, exact);
                    s.result.maxError = e.maxAbs;
                    s.result.rmse = e.rmse();
                    s.result.levels = e.maxLevels;
                }
            }
        for (System& s : systems) {
            describe(s, "noise");
            const auto traffic = s.traffic();
            s.result.bytes = static_cast<double>(traffic.first);
            s.result.messages = static_cast<double>(traffic.second);
            s.result.width = width;
            s.result.height = height;
            if (rank_ == 0)
                noise_.push_back({s.result, s.output, s.isDefault});
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
            std::vector<Result> these;
            for (const Row& r : *rows)
                these.push_back(r.result);
            results.insert(results.end(), these.begin(), these.end());
            const std::string head = "\n| " + these.front().scene + ", " + std::to_string(size_) + " ranks, to "
                                     + rows->front().output
                                     + " | ms | CPU ms | MB sent | max error | RMSE | levels off |\n"
                                       "|---|--:|--:|--:|--:|--:|--:|\n";
            all << head;
            chosen << head;
            for (const Row& r : *rows) {
                all << line(r.result, these);
                if (r.isDefault || isOnFront(r.result, these) || isBestOfKind(r.result, these) || rows == &noise_)
                    chosen << line(r.result, these);
            }
            for (const Row& r : *rows)
                if (r.isDefault && !isOnFront(r.result, these))
                    all << "\nNot on the front, though a default: " << r.result.config << ".\n",
                        chosen << "\nNot on the front, though a default: " << r.result.config << ".\n";
            if (!o_.svg.empty()) {
                const std::string kind = rows == &floats_ ? "float" : rows == &bytes_ ? "8bit" : "noise";
                bench::writeSvg(o_.svg + '.' + kind + ".svg",
                                these.front().scene + ", " + std::to_string(these.front().width) + " x "
                                    + std::to_string(these.front().height) + ", " + std::to_string(size_)
                                    + " ranks, to " + rows->front().output + "; * on the Pareto front",
                                these);
            }
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
        if (!o_.json.empty())
            bench::appendJson(o_.json, results);
        if (!o_.table.empty())
            std::ofstream(o_.table, std::ios::app) << chosen.str();
    }

private:
    struct Row {
        Result result;
        std::string output;
        bool isDefault;
    };

    // The fastest of a peer's strategies with this kind of pixels.
    static bool isBestOfKind(const Result& r, const std::vector<Result>& all)
    {
        const auto kindOf = [](const Result& x) { return x.system + x.config.substr(0, x.config.find(',')); };
        return r.system != "dfb" && std::none_of(all.begin(), all.end(), [&](const Result& o) {
                   return kindOf(o) == kindOf(r) && o.ms.median < r.ms.median;
               });
    }

    bool isWanted(const std::string& name) const
    {
        std::istringstream parts(o_.only);
        bool any = o_.only.empty();
        for (std::string part; std::getline(parts, part, '|');)
            any = any || name.find(part) != std::string::npos;
        return any;
    }

    struct Kernel {
        int layers;
        bench::Figure exact, plain;
    };

    void time(System& s, bool counts)
    {
        bench::meet(comm_);
        const double start = bench::now(), cpuBefore = bench::processCpuSeconds();
        s.frame();
        const double end = bench::now(), cpu = bench::processCpuSeconds() - cpuBefore;
        const double first = bench::reduce(comm_, start, MPI_MIN);
        const double cpuOfAll = bench::reduce(comm_, cpu, MPI_SUM);
        if (!counts)
            return;
        s.ms.push_back(1e3 * (end - first)); // on rank 0, when it has the image
        s.cpuMs.push_back(1e3 * cpuOfAll);
    }

    void describe(System& s, const std::string& scene) const
    {
        Result& r = s.result;
        r.bench = "bench_error_time";
        r.system = s.name;
        r.config = s.config + ", to " + s.output;
        r.scene = scene;
        r.ranks = size_;
        r.width = o_.width;
        r.height = o_.height;
        r.ms = bench::figureOf(s.ms);
        r.cpuMs = bench::figureOf(s.cpuMs);
        r.commit = o_.commit;
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
    int rank_ = 0, size_ = 1;
    std::vector<Row> floats_, bytes_, noise_; // on rank 0
    std::vector<Kernel> kernels_;
};

// Ends the program after --help, or if it was called wrongly.
Options optionsOf(int argc, char** argv)
{
    Options o;
    const char* usage =
        "usage: mpirun -n RANKS bench_error_time [--size WxH] [--frames N] [--json FILE] [--svg PREFIX] "
        "[--table FILE] [--commit ID] [--only TEXT]";
    const auto fail = [usage](int code) {
        std::printf("%s\n", usage);
        std::exit(code);
    };
    for (int i = 1; i < argc; ++i) {
        const std::string name = argv[i];
        if (name == "--help")
            fail(0);
        if (i + 1 == argc)
            fail(2);
        const std::string value = argv[++i];
        if (name == "--size") {
            if (std::sscanf(value.c_str(), "%dx%d", &o.width, &o.height) != 2)
                fail(2);
        } else if (name == "--frames") {
            o.frames = std::atoi(value.c_str());
        } else if (name == "--json") {
            o.json = value;
        } else if (name == "--svg") {
            o.svg = value;
        } else if (name == "--table") {
            o.table = value;
        } else if (name == "--only") {
            o.only = value;
        } else if (name == "--commit") {
            o.commit = value;
        } else {
            fail(2);
        }
    }
    if (o.width < 16 || o.height < 16 || o.frames < 1)
        fail(2);
    return o;
}

} // namespace

int main(int argc, char** argv)
{
    const Options options = optionsOf(argc, argv);
    int level = 0;
    MPI_Init_thread(&argc, &argv, MPI_THREAD_MULTIPLE, &level);
    bench::shortenNaps();
    {
        Bench bench(MPI_COMM_WORLD, options);
        bench.bricks();
        if (options.only.empty()) {
            bench.noise();
            bench.kernels();
        }
        bench.write();
    }
    MPI_Finalize();
}
