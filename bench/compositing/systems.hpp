// Systems: the ways to make one image of what all ranks have (dfb in its settings, plain loops, IceT), each of which
// makes the same image again and again; and measuring them in turns, on the same partial images in the same run.
#pragma once

#include "brick_images.hpp"
#include "direct_send.hpp"
#include "memory_limit.hpp"
#include "radix_k.hpp"
#include "results.hpp"
#ifdef DFB_BENCH_HAS_ICET
#include "icet.hpp"
#endif

#include <dfb/dfb.hpp>
#include <dfb/testing/error_report.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

namespace bench {

using dfb::Connection;

// Of all ranks, of what this one has. Collective.
inline std::vector<std::array<int, 4>> viewportsOf(MPI_Comm comm, const PartialImage& image)
{
    int size = 1;
    MPI_Comm_size(comm, &size);
    std::vector<std::array<int, 4>> all(static_cast<std::size_t>(size));
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Iallgather(image.viewport.data(), 4, MPI_INT, all.data(), 4, MPI_INT, comm, &request);
    napThrough(request);
    return all;
}

// What an image is made of.
struct Inputs {
    Inputs(MPI_Comm communicator, const Scene& scene, int rank)
        : comm(communicator), image(scene.render(rank)), viewports(viewportsOf(communicator, image)),
          order(scene.order())
    {
    }

    MPI_Comm comm;
    PartialImage image;                        // of this rank
    std::vector<std::array<int, 4>> viewports; // of all ranks
    std::vector<int> order;                    // the ranks, front to back
};

// What makes the image, and what is known of it.
struct Compositor {
    std::function<void()> frame; // collective
    // Of the last frame on rank 0: 4 a pixel, one of the two; none, if it makes no image.
    std::function<const float*()> floats;
    std::function<const std::uint8_t*()> bytes;
    std::function<std::pair<std::int64_t, std::int64_t>()> traffic; // of this rank: bytes, messages
    bool trafficIsOfAll = false;
    std::function<double()> peakMemory;
};

struct System {
    std::string name, config, output;  // output: of the image, "float" or "8 bit"
    std::function<Compositor()> start; // collective, as is the end of what it returns
    bool isDefault = false;
    Compositor compositor{};
    std::vector<double> ms{}, cpuMs{};
    Result result{};

    std::string title() const { return name + ": " + config + ", to " + output; }
};

// Keeps those of which the title has one of the texts in `only`, with | between; all if it is empty.
inline void keepWanted(std::vector<System>& systems, const std::string& only)
{
    const std::vector<std::string> parts = partsOf(only, '|');
    const auto isUnwanted = [&](const System& s) {
        return !parts.empty() && std::none_of(parts.begin(), parts.end(), [&](const std::string& part) {
            return s.title().find(part) != std::string::npos;
        });
    };
    systems.erase(std::remove_if(systems.begin(), systems.end(), isUnwanted), systems.end());
}

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
inline dfb::World worldOf(const PartialImage& image, int rank)
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
    dfb::Precision wire{};
    std::shared_ptr<const dfb::Codec> codec{};
    float minTransmittance = 0;
    bool isDefault = false;
    dfb::CompressionMode compression = dfb::CompressionMode::Always;
    bool hasThreads = false; // a worker; else the executor has none
};

// Without `hasThreads` what each rank does is done by one thread, as with the other systems.
inline std::shared_ptr<Connection> makeConnection(MPI_Comm comm, bool hasThreads)
{
    dfb::NetworkConfig options;
    options.progress = hasThreads ? dfb::Progress::Thread : dfb::Progress::Caller;
    return dfb::connect<dfb::MpiTransport>(comm, options);
}

// `inputs` must outlive the systems, here and below.
template <class TileOp>
void addDfb(std::vector<System>& systems, const std::shared_ptr<Connection>& connection, const Inputs& inputs,
            const std::string& config, const DfbSettings& settings)
{
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp>;
    struct Renderer {
        Renderer(const std::shared_ptr<Connection>& sharedConnection, const dfb::FrameBufferConfig& c,
                 const PartialImage& image)
            : fb(sharedConnection, c), world(worldOf(image, fb.rank())), shared(fb, world), loop(fb, world),
              orderedLoop(fb, shared, owner)
        {
        }
        FrameBuffer fb;
        dfb::World world;
        dfb::SharedWorld shared;
        dfb::RoundRobinBricks owner;
        dfb::DataParallelLoop<FrameBuffer> loop;
        dfb::OrderedLoop<FrameBuffer, dfb::RoundRobinBricks> orderedLoop;
        dfb::FrameReport report;
    };
    for (const bool toBytes : {false, true}) {
        dfb::FrameBufferConfig c;
        c.image.width = inputs.image.width;
        c.image.height = inputs.image.height;
        c.image.format = toBytes ? dfb::OutputFormat::RGBA8 : dfb::OutputFormat::RGBA32F;
        c.precision = settings.wire;
        c.messages.codec = settings.codec;
        c.messages.compression = settings.compression;
        c.minTransmittance = settings.minTransmittance;
        System s;
        s.name = "dfb";
        s.config = config;
        s.output = toBytes ? "8 bit" : "float";
        s.isDefault = settings.isDefault;
        s.start = [c, connection, toBytes, hasThreads = settings.hasThreads, from = &inputs.image,
                   order = inputs.order] {
            dfb::FrameBufferConfig ownConfig = c;
            if (hasThreads)
                ownConfig.executor = std::make_shared<dfb::ThreadExecutor>(1);
            else
                ownConfig.executor = std::make_shared<dfb::CallerExecutor>();
            const auto r = std::make_shared<Renderer>(connection, ownConfig, *from);
            Compositor compositor;
            compositor.frame = [r, from, order] {
                const auto renderBrick = dfb::inPlace([from](const dfb::Brick&, auto& view) {
                    view.stride = static_cast<std::size_t>(from->width);
                    const std::size_t first = static_cast<std::size_t>(view.region.y0) * view.stride
                                              + static_cast<std::size_t>(view.region.x0);
                    view.color = &from->rgba[4 * first];
                    view.depth = &from->depth[first];
                    const auto [left, top, columns, rows] = from->viewport; // as IceT has it
                    view.valid = {left, top, left + columns, top + rows};
                });
                if constexpr (isOrdered<TileOp>) {
                    std::vector<int> places; // of bricks in the shared world, which has them by id
                    for (const int rank : order)
                        for (std::size_t i = 0; i < r->shared.bricks().size(); ++i)
                            if (r->shared.bricks()[i].brick.id == static_cast<std::uint32_t>(rank))
                                places.push_back(static_cast<int>(i));
                    r->report = r->orderedLoop.render(PixelCamera(), places, renderBrick);
                } else {
                    dfb::FrameConfig params;
                    params.maxLayers = r->fb.size();
                    r->report = r->loop.render(PixelCamera(), renderBrick, params);
                }
            };
            if (toBytes)
                compositor.bytes = [r] { return r->fb.image().rgba8(); };
            else
                compositor.floats = [r] { return r->fb.image().rgba32f(); };
            compositor.traffic = [r] { return std::make_pair(r->report.bytesSent, r->report.messagesSent); };
            compositor.trafficIsOfAll = true;
            compositor.peakMemory = [r] { return static_cast<double>(r->report.peakMemoryBytes); };
            return compositor;
        };
        systems.push_back(std::move(s));
    }
}

// ---- the peers

// `make(toBytes)` makes a PlainCompositor, in a shared pointer.
template <class Make>
void addPlain(std::vector<System>& systems, const Inputs& inputs, const std::string& config, const Make& make)
{
    for (const bool toBytes : {false, true}) {
        System s;
        s.name = "plain";
        s.config = config;
        s.output = toBytes ? "8 bit" : "float";
        s.start = [make, toBytes, image = &inputs.image] {
            const std::shared_ptr<PlainCompositor> plain = make(toBytes);
            const auto out = std::make_shared<const std::byte*>(nullptr);
            Compositor compositor;
            compositor.frame = [plain, out, image] { *out = plain->composite(image->rgba); };
            if (toBytes)
                compositor.bytes = [out] { return reinterpret_cast<const std::uint8_t*>(*out); };
            else
                compositor.floats = [out] { return reinterpret_cast<const float*>(*out); };
            compositor.traffic = [plain] { return std::make_pair(plain->bytesSent(), plain->messagesSent()); };
            return compositor;
        };
        systems.push_back(std::move(s));
    }
}

inline void addDirectSend(std::vector<System>& systems, const Inputs& inputs)
{
    addPlain(systems, inputs, "direct send, float", [&inputs](bool toBytes) {
        return std::make_shared<DirectSend>(inputs.comm, inputs.order, inputs.viewports, inputs.image.width,
                                            inputs.image.height, toBytes);
    });
}

inline void addMemoryLimit(std::vector<System>& systems, const Inputs& inputs)
{
    for (const bool toBytes : {false, true}) {
        System s;
        s.name = "limit";
        s.config = "inputs read, image written";
        s.output = toBytes ? "8 bit" : "float";
        s.start = [&inputs, toBytes] {
            const auto limit = std::make_shared<MemoryLimit>(inputs.comm, inputs.viewports, toBytes);
            Compositor compositor;
            compositor.frame = [limit, &inputs] { limit->frame(inputs.image); };
            compositor.traffic = [] { return std::make_pair(std::int64_t{0}, std::int64_t{0}); };
            return compositor;
        };
        systems.push_back(std::move(s));
    }
}

inline void addRadixK(std::vector<System>& systems, const Inputs& inputs, const std::string& name,
                      const std::vector<int>& factors)
{
    addPlain(systems, inputs, name + ", float", [&inputs, factors](bool toBytes) {
        return std::make_shared<RadixK>(inputs.comm, inputs.order, inputs.viewports, inputs.image.width,
                                        inputs.image.height, factors, toBytes);
    });
}

#ifdef DFB_BENCH_HAS_ICET
// As a user would, whose renderer has floats: for bytes they are converted first; for bytes out of floats, afterwards.
inline void addIceT(std::vector<System>& systems, const Inputs& inputs)
{
    enum class Way { Floats, FloatsToBytes, Bytes };
    for (const IceTStrategy& strategy : icetStrategies()) {
        const std::string name = strategy.name;
        if (name != "direct" && name != "sequential, radix-k" && name != "sequential, binary swap"
            && name != "sequential, tree")
            continue;
        for (const Way way : {Way::Floats, Way::FloatsToBytes, Way::Bytes}) {
            IceTSettings settings;
            settings.strategy = strategy.strategy;
            settings.singleImage = strategy.singleImage;
            settings.ubyte = way == Way::Bytes;
            System s;
            s.name = "icet";
            s.config = (way == Way::Bytes ? "ubyte, " : "float, ") + name;
            s.output = way == Way::Floats ? "float" : "8 bit";
            s.start = [settings, way, &inputs] {
                const PartialImage& image = inputs.image;
                const auto icet = std::make_shared<IceT>(inputs.comm, settings, image.width, image.height);
                const std::size_t values = image.rgba.size();
                const auto converted = std::make_shared<std::vector<std::uint8_t>>(way == Way::Floats ? 0 : values);
                const auto out = std::make_shared<const void*>(nullptr);
                Compositor compositor;
                compositor.frame = [=, &inputs] {
                    const auto& v = inputs.image.viewport;
                    const std::vector<float>& rgba = inputs.image.rgba;
                    const void* input = rgba.data();
                    if (way == Way::Bytes) {
                        for (int y = v[1]; y < v[1] + v[3]; ++y) {
                            const std::size_t first =
                                4
                                * (static_cast<std::size_t>(y) * static_cast<std::size_t>(inputs.image.width)
                                   + static_cast<std::size_t>(v[0]));
                            PlainCompositor::convertToBytes(&rgba[first], 4 * static_cast<std::size_t>(v[2]),
                                                            converted->data() + first);
                        }
                        input = converted->data();
                    }
                    icet->resetTraffic();
                    *out = icet->composite(input, v.data(), inputs.order);
                    if (way == Way::FloatsToBytes && *out) {
                        PlainCompositor::convertToBytes(static_cast<const float*>(*out), values, converted->data());
                        *out = converted->data();
                    }
                };
                if (way == Way::Floats)
                    compositor.floats = [out] { return static_cast<const float*>(*out); };
                else
                    compositor.bytes = [out] { return static_cast<const std::uint8_t*>(*out); };
                compositor.traffic = [icet] { return std::make_pair(icet->bytesSent(), icet->messagesSent()); };
                return compositor;
            };
            systems.push_back(std::move(s));
        }
    }
}
#endif

// ---- measuring

// As testing::toUnorm8(), and as exact, but fast: 255 times a float is a double, and rounds to even.
inline std::uint8_t levelOf(float value)
{
    return static_cast<std::uint8_t>(std::nearbyint(255 * std::min(std::max(0.0, static_cast<double>(value)), 1.0)));
}

// Of an image, 4 values a pixel, one of the two.
inline dfb::testing::ErrorReport errorOf(const float* floats, const std::uint8_t* bytes, const ExactImage& exact)
{
    dfb::testing::ErrorReport report;
    const std::size_t row = 4 * static_cast<std::size_t>(exact.width);
    for (std::size_t i = 0; i < 4 * exact.pixels.size(); ++i) {
        const std::size_t place = i / row * static_cast<std::size_t>(exact.rowStep) * row + i % row;
        report.add(floats ? floats[place] : static_cast<float>(bytes[place]) / 255, exact.pixels[i / 4].rgba[i % 4]);
        report.addByte(floats ? levelOf(floats[place]) : bytes[place], exact.levels[i]);
    }
    return report;
}

// Collective: one frame, from when the first rank begins to when rank 0 has the image.
inline void timeFrame(MPI_Comm comm, System& s, bool counts)
{
    meet(comm);
    const double start = now(), cpuBefore = processCpuSeconds();
    s.compositor.frame();
    const double end = now(), cpu = processCpuSeconds() - cpuBefore;
    const double first = reduce(comm, start, MPI_MIN);
    const double cpuOfAll = reduce(comm, cpu, MPI_SUM);
    if (!counts)
        return;
    s.ms.push_back(1e3 * (end - first)); // on rank 0, when it has the image
    s.cpuMs.push_back(1e3 * cpuOfAll);
}

// Collective: what the last frame of a system has cost, and on rank 0 how exact it is; times, if there are any.
inline void takeResult(MPI_Comm comm, System& s, const ExactImage& exact)
{
    Result& r = s.result;
    int rank = 0;
    MPI_Comm_rank(comm, &rank);
    MPI_Comm_size(comm, &r.ranks);
    r.system = s.name;
    r.config = s.config + ", to " + s.output;
    r.ms = figureOf(s.ms);
    r.cpuMs = figureOf(s.cpuMs);
    const auto traffic = s.compositor.traffic();
    r.bytes = static_cast<double>(traffic.first);
    r.messages = static_cast<double>(traffic.second);
    if (!s.compositor.trafficIsOfAll) {
        r.bytes = reduce(comm, r.bytes, MPI_SUM);
        r.messages = reduce(comm, r.messages, MPI_SUM);
    }
    if (rank == 0 && (s.compositor.floats || s.compositor.bytes)) {
        const dfb::testing::ErrorReport e = errorOf(s.compositor.floats ? s.compositor.floats() : nullptr,
                                                    s.compositor.bytes ? s.compositor.bytes() : nullptr, exact);
        r.maxError = e.maxAbs;
        r.rmse = e.rmse();
        r.levels = e.maxLevels;
    }
    if (s.compositor.peakMemory)
        r.peakMemoryBytes = s.compositor.peakMemory();
}

// Collective: starts the systems, each of which has its turn in every frame, takes their results and ends them.
inline void measureInTurns(MPI_Comm comm, std::vector<System>& systems, int frames, const ExactImage& exact)
{
    for (System& s : systems)
        s.compositor = s.start();
    for (int frame = -1; frame < frames; ++frame) // the first touches memory
        for (std::size_t i = 0; i < systems.size(); ++i)
            timeFrame(comm, systems[(i + static_cast<std::size_t>(frame + 1)) % systems.size()], frame >= 0);
    for (System& s : systems)
        takeResult(comm, s, exact);
    for (System& s : systems) {
        s.compositor = {};
        s.start = {}; // may hold memory too
    }
}

// Of a system that makes 8 bits out of an image in float, the error is that of the image.
inline void takeErrorsOfFloats(std::vector<System>& systems)
{
    for (System& s : systems)
        for (const System& f : systems)
            if (s.output == "8 bit" && f.output == "float" && s.name == f.name && s.config == f.config) {
                s.result.maxError = f.result.maxError;
                s.result.rmse = f.result.rmse;
            }
}

} // namespace bench
