// Systems: the ways to make one image of what all ranks have (dfb in its settings, plain loops, IceT), each of which
// makes the same image again and again; and measuring them in turns, on the same partial images in the same run.
#pragma once

#include "brick_images.hpp"
#include "direct_send.hpp"
#include "frame_times.hpp"
#include "memory_limit.hpp"
#include "radix_k.hpp"
#include "results.hpp"
#include "trace.hpp"
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
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace bench {

using dfb::Connection;

// The viewports of all ranks. Collective.
inline std::vector<std::array<int, 4>> viewportsOf(MPI_Comm comm, const PartialImage& image)
{
    std::vector<std::array<int, 4>> all(static_cast<std::size_t>(sizeOf(comm)));
    MPI_Request request = MPI_REQUEST_NULL;
    MPI_Iallgather(image.viewport.data(), 4, MPI_INT, all.data(), 4, MPI_INT, comm, &request);
    napThrough(request);
    return all;
}

// The partial images of one camera.
struct View {
    View(MPI_Comm comm, const Scene& scene, int rank)
        : image(scene.render(rank)), viewports(viewportsOf(comm, image)), order(scene.order())
    {
    }

    PartialImage image;                        // of this rank
    std::vector<std::array<int, 4>> viewports; // of all ranks
    std::vector<int> order;                    // the ranks, front to back
};

// The views of a run; frames take them in turn. A camera that does not move has one.
struct Inputs {
    Inputs(MPI_Comm communicator, const Scene& scene, int rank) : comm(communicator), views{View(comm, scene, rank)} {}

    MPI_Comm comm;
    std::vector<View> views;
    std::size_t frame = 0;     // that is under way
    bool isReadInside = false; // rank 0 reads the image within the clock
    std::string trace{};       // the file that gets a trace of the first of dfb's systems; empty: none

    bool isMoving() const { return views.size() > 1; }
    const View& view() const { return views[frame % views.size()]; }
    const PartialImage& image() const { return view().image; }
    const std::vector<std::array<int, 4>>& viewports() const { return view().viewports; }
    const std::vector<int>& order() const { return view().order; }
};

// Makes the image, and knows what it has cost.
struct Compositor {
    std::function<void()> frame; // collective
    // Of the last frame on rank 0: 4 floats or bytes a pixel, as the system's output says; none, if it makes no image.
    std::function<const void*()> image;
    std::function<std::pair<std::int64_t, std::int64_t>()> traffic; // of this rank: bytes, messages
    bool trafficIsOfAll = false;
    std::function<double()> peakMemory;
    std::function<void()> writeTrace; // collective; none without a trace
};

struct System {
    std::string name, config, output;  // output: of the image, "float" or "8 bit"
    std::function<Compositor()> start; // collective, as is the end of what it returns
    int copied = 0;                    // bytes a pixel of each view that it keeps beside the view
    Compositor compositor{};
    std::vector<double> ms{}, cpuMs{}, yieldMs{};
    Result result{};

    bool isFloat() const { return output == "float"; }
    std::string title() const { return name + ": " + config + ", to " + output; }
};

// Whether a title has one of the texts in `only`, which are separated by |; all have if it is empty.
inline bool isWanted(const std::string& title, const std::string& only)
{
    const std::vector<std::string> parts = partsOf(only, '|');
    return parts.empty() || std::any_of(parts.begin(), parts.end(), [&](const std::string& part) {
               return title.find(part) != std::string::npos;
           });
}

inline void keepWanted(std::vector<System>& systems, const std::string& only)
{
    const auto isUnwanted = [&](const System& s) { return !isWanted(s.title(), only); };
    systems.erase(std::remove_if(systems.begin(), systems.end(), isUnwanted), systems.end());
    if (systems.empty())
        throw std::runtime_error("--only: no system's title has '" + only + "'");
}

// ---- dfb: an ImageCompositor, or a framebuffer whose renderer shows it images that are ready, tile by tile

// Each rank has one brick, whose box only says which rank that is.
inline dfb::World worldOf(int rank)
{
    dfb::World world;
    const auto x = static_cast<float>(rank);
    world.add({static_cast<std::uint32_t>(rank), {{x, 0, 0}, {x + 1, 1, 1}}});
    return world;
}

// Projects a brick to the viewport of its rank.
struct ViewportCamera {
    const std::vector<std::array<int, 4>>& viewports;

    dfb::Region project(const dfb::Box3& box, int, int) const
    {
        const auto [x, y, columns, rows] = viewports[static_cast<std::size_t>(box.lower.x)];
        return {x, y, x + columns, y + rows};
    }
};

template <class TileOp>
inline constexpr bool isOrdered = TileOp::rule == dfb::BlendRule::InOrder;

// The row of a program that sets nothing.
inline const char* const defaultConfig = "float32, defaults";
inline bool hasDefaults(const Result& r) { return r.system == "dfb" && r.config.rfind(defaultConfig, 0) == 0; }

struct DfbSettings {
    dfb::Precision wire{};
    std::shared_ptr<const dfb::Codec> codec{};
    float minTransmittance = 0;
    dfb::CompressionMode compression = dfb::CompressionMode::Always;
    bool hasThreads = false;        // a worker; otherwise the executor has none
    bool hasDefaultThreads = false; // those that a framebuffer makes by itself
    bool isShared = false;          // the images lie in memory that the node shares, and are read there
    bool hasBytes = false;          // images of 8 bits a channel, which are ready
    bool isToldOrder = false;       // AlphaBlend gets FrameConfig::order, as loops with a SharedWorld give it
};

// The pixels of one view as a framebuffer gets them.
struct DfbImage {
    // `dfb`: a framebuffer or an ImageCompositor.
    template <class Dfb>
    DfbImage(const Dfb& dfb, const PartialImage& image, const DfbSettings& settings)
        : color(image.rgba.data()), depth(image.depth.data())
    {
        const std::size_t pixels = image.depth.size(), colorBytes = (settings.hasBytes ? 4 : 16) * pixels;
        if (!settings.isShared && !settings.hasBytes)
            return;
        std::byte* at = nullptr;
        if (settings.isShared) {
            shared = dfb.sharedMemory(colorBytes + 4 * pixels);
            at = shared.data();
        } else {
            own.resize(colorBytes + 4 * pixels);
            at = own.data();
        }
        std::memcpy(at + colorBytes, depth, 4 * pixels);
        depth = reinterpret_cast<const float*>(at + colorBytes);
        if (settings.hasBytes) {
            dfb::convertPixels(color, static_cast<int>(pixels), dfb::OutputFormat::RGBA8, at);
            color8 = reinterpret_cast<const std::uint8_t*>(at);
            color = nullptr;
        } else {
            std::memcpy(at, color, colorBytes);
            color = reinterpret_cast<const float*>(at);
        }
    }

    dfb::Buffer shared;
    std::vector<std::byte> own;
    const float *color, *depth;
    const std::uint8_t* color8 = nullptr;
};

// Returns a connection that some systems share. The first system that starts makes it. It ends with the last of them,
// and gives their memory back.
using Connect = std::function<std::shared_ptr<Connection>()>;

inline Connect connectBy(MPI_Comm comm, const dfb::NetworkConfig& options = {})
{
    return [comm, options, current = std::make_shared<std::weak_ptr<Connection>>()] {
        auto connection = current->lock();
        if (!connection)
            *current = connection = dfb::connect<dfb::MpiTransport>(comm, options);
        return connection;
    };
}

// Without `hasThreads` each rank works with one thread, as in the other systems.
inline Connect connectBy(MPI_Comm comm, bool hasThreads)
{
    dfb::NetworkConfig options;
    options.progress = hasThreads ? dfb::Progress::Thread : dfb::Progress::Caller;
    return connectBy(comm, options);
}

inline dfb::FrameBufferConfig configOf(const Inputs& inputs, const DfbSettings& settings, bool toBytes)
{
    dfb::FrameBufferConfig c(inputs.image().width, inputs.image().height,
                             toBytes ? dfb::OutputFormat::RGBA8 : dfb::OutputFormat::RGBA32F);
    c.precision = settings.wire;
    c.messages.codec = settings.codec;
    c.messages.compression = settings.compression;
    c.minTransmittance = settings.minTransmittance;
    if (settings.hasThreads)
        c.executor = std::make_shared<dfb::ThreadExecutor>(1);
    else if (!settings.hasDefaultThreads)
        c.executor = std::make_shared<dfb::CallerExecutor>();
    return c;
}

// Adds a system with float output and one with 8-bit output. `settings`: of dfb. `start(toBytes)` makes its Compositor.
template <class Start>
void addToBoth(std::vector<System>& systems, const char* name, const std::string& config, const DfbSettings& settings,
               const Start& start)
{
    for (const bool toBytes : {false, true}) {
        if (settings.hasBytes && !toBytes)
            continue;
        System s;
        s.name = name;
        s.config = config;
        s.output = toBytes ? "8 bit" : "float";
        s.copied = settings.hasBytes ? 8 : settings.isShared ? 20 : 0;
        s.start = [start, toBytes] { return start(toBytes); };
        systems.push_back(std::move(s));
    }
}

// Returns what does `render(renderer)` for each frame, with an object that has `dfb`, a framebuffer or an
// ImageCompositor, and `report`, that of the last frame.
template <class Renderer, class Render>
Compositor compositorOf(const std::shared_ptr<Renderer>& r, const Trace& trace, const Render& render)
{
    Compositor compositor;
    compositor.frame = [r, render] { r->report = render(*r); };
    compositor.image = [r] { return r->dfb.image().bytes(); };
    compositor.traffic = [r] { return std::make_pair(r->report.bytesSent, r->report.messagesSent); };
    compositor.trafficIsOfAll = true;
    compositor.peakMemory = [r] { return static_cast<double>(r->report.peakMemoryBytes); };
    if (trace.sink)
        compositor.writeTrace = [r, trace] { trace.write(r->dfb); };
    return compositor;
}

// Adds an ImageCompositor, which is told no more than IceT is. `inputs` must outlive the systems, here and below.
inline void addImages(std::vector<System>& systems, const Connect& connect, const Inputs& inputs,
                      const std::string& config, dfb::ImageBlend blend, const DfbSettings& settings)
{
    struct Renderer {
        Renderer(const std::shared_ptr<Connection>& sharedConnection, dfb::ImageBlend b,
                 const dfb::FrameBufferConfig& c)
            : dfb(sharedConnection, b, c)
        {
        }
        dfb::ImageCompositor dfb;
        std::vector<DfbImage> images; // by view
        dfb::FrameReport report;
    };
    addToBoth(systems, "dfb", config, settings, [connect, blend, settings, &inputs](bool toBytes) {
        dfb::FrameBufferConfig c = configOf(inputs, settings, toBytes);
        const Trace trace(inputs.trace);
        c.trace = trace.sink;
        const auto r = std::make_shared<Renderer>(connect(), blend, c);
        for (const View& view : inputs.views)
            r->images.emplace_back(r->dfb, view.image, settings);
        return compositorOf(r, trace, [blend, &inputs](Renderer& by) {
            const DfbImage& pixels = by.images[inputs.frame % by.images.size()];
            dfb::InputImage image;
            image.rgba32f = pixels.color;
            image.rgba8 = pixels.color8;
            const auto [left, top, columns, rows] = inputs.image().viewport;
            image.valid = {left, top, left + columns, top + rows};
            if (blend == dfb::ImageBlend::InOrder) {
                const std::vector<int>& order = inputs.order();
                const auto at = std::find(order.begin(), order.end(), by.dfb.rank());
                return by.dfb.composite(image, static_cast<int>(at - order.begin()));
            }
            image.depth = pixels.depth;
            return by.dfb.composite(image);
        });
    });
}

// Adds a framebuffer, with a renderer of bricks that shows its tiles.
template <class TileOp>
void addDfb(std::vector<System>& systems, const Connect& connect, const Inputs& inputs, const std::string& config,
            const DfbSettings& settings)
{
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp>;
    struct Renderer {
        Renderer(const std::shared_ptr<Connection>& sharedConnection, const dfb::FrameBufferConfig& c)
            : dfb(sharedConnection, c), world(worldOf(dfb.rank())), shared(dfb, world), loop(dfb, world),
              orderedLoop(dfb, shared, owner)
        {
        }
        FrameBuffer dfb;
        dfb::World world;
        dfb::SharedWorld shared;
        dfb::RoundRobinBricks owner;
        dfb::DataParallelLoop<FrameBuffer> loop;
        dfb::OrderedLoop<FrameBuffer, dfb::RoundRobinBricks> orderedLoop;
        std::vector<DfbImage> images; // by view
        dfb::FrameReport report;
    };
    addToBoth(systems, "dfb", config, settings, [connect, settings, &inputs](bool toBytes) {
        dfb::FrameBufferConfig c = configOf(inputs, settings, toBytes);
        const Trace trace(inputs.trace);
        c.trace = trace.sink;
        const auto r = std::make_shared<Renderer>(connect(), c);
        for (const View& view : inputs.views)
            r->images.emplace_back(r->dfb, view.image, settings);
        return compositorOf(r, trace, [&inputs, isToldOrder = settings.isToldOrder](Renderer& by) {
            const PartialImage& image = inputs.image();
            const DfbImage& pixels = by.images[inputs.frame % by.images.size()];
            const auto renderBrick = dfb::inPlace([&image, &pixels](const dfb::Brick&, auto& view) {
                view.stride = static_cast<std::size_t>(image.width);
                const std::size_t first = image.indexOf(view.region.x0, view.region.y0);
                view.color = pixels.color ? pixels.color + 4 * first : nullptr;
                view.color8 = pixels.color8 ? pixels.color8 + 4 * first : nullptr;
                view.depth = pixels.depth + first;
                view.staysUntilEnd = pixels.shared.size() > 0;
                const auto [left, top, columns, rows] = image.viewport; // as IceT has it
                view.valid = {left, top, left + columns, top + rows};
            });
            const ViewportCamera camera{inputs.viewports()};
            if constexpr (isOrdered<TileOp>) {
                return by.orderedLoop.render(camera, inputs.order(), renderBrick); // bricks are by rank
            } else {
                dfb::FrameConfig params;
                params.maxLayers = by.dfb.size();
                if (isToldOrder)
                    params.order = std::make_shared<const dfb::SourceOrder>(
                        std::vector<std::uint32_t>(inputs.order().begin(), inputs.order().end()));
                return by.loop.render(camera, renderBrick, params);
            }
        });
    });
}

// ---- the peers

// `make(toBytes)` makes a PlainCompositor, in a shared pointer. These compositors know one view only.
template <class Make>
void addPlain(std::vector<System>& systems, const Inputs& inputs, const std::string& config, const Make& make)
{
    addToBoth(systems, "plain", config, {}, [make, &inputs](bool toBytes) {
        const std::shared_ptr<PlainCompositor> plain = make(toBytes);
        const auto out = std::make_shared<const std::byte*>(nullptr);
        Compositor compositor;
        compositor.frame = [plain, out, &inputs] { *out = plain->composite(inputs.image().rgba); };
        compositor.image = [out] { return *out; };
        compositor.traffic = [plain] { return std::make_pair(plain->bytesSent(), plain->messagesSent()); };
        return compositor;
    });
}

inline void addDirectSend(std::vector<System>& systems, const Inputs& inputs)
{
    addPlain(systems, inputs, "direct send, float", [&inputs](bool toBytes) {
        return std::make_shared<DirectSend>(inputs.comm, inputs.order(), inputs.viewports(), inputs.image().width,
                                            inputs.image().height, toBytes);
    });
}

inline void addMemoryLimit(std::vector<System>& systems, const Inputs& inputs)
{
    addToBoth(systems, "limit", "inputs read, image written", {}, [&inputs](bool toBytes) {
        const auto limits = std::make_shared<std::vector<MemoryLimit>>();
        for (const View& view : inputs.views)
            limits->emplace_back(inputs.comm, view.viewports, toBytes);
        Compositor compositor;
        compositor.frame = [limits, &inputs] { (*limits)[inputs.frame % limits->size()].frame(inputs.image()); };
        compositor.traffic = [] { return std::make_pair(std::int64_t{0}, std::int64_t{0}); };
        return compositor;
    });
}

inline void addRadixK(std::vector<System>& systems, const Inputs& inputs, const std::string& name,
                      const std::vector<int>& factors)
{
    addPlain(systems, inputs, name + ", float", [&inputs, factors](bool toBytes) {
        return std::make_shared<RadixK>(inputs.comm, inputs.order(), inputs.viewports(), inputs.image().width,
                                        inputs.image().height, factors, toBytes);
    });
}

#ifdef DFB_BENCH_HAS_ICET
// With floats, and with bytes that are ready. With floats that become bytes: the image is converted within the clock,
// or the inputs are; by the library's own conversion, which is faster than a plain loop.
enum class IceTWay { Floats, FloatsToBytes, Bytes, BytesOfFloats };

inline void toBytes(const float* from, std::size_t count, std::uint8_t* to)
{
    dfb::convertPixels(from, static_cast<int>(count / 4), dfb::OutputFormat::RGBA8, reinterpret_cast<std::byte*>(to));
}

// The part of an image that has pixels.
inline void toBytes(const PartialImage& from, std::uint8_t* to)
{
    const auto [x, y, columns, rows] = from.viewport;
    for (int row = y; row < y + rows; ++row) {
        const std::size_t at = 4 * from.indexOf(x, row);
        toBytes(&from.rgba[at], 4 * static_cast<std::size_t>(columns), to + at);
    }
}

inline Compositor startIceT(const IceTStrategy& strategy, IceTWay way, const Inputs& inputs)
{
    const bool hasBytes = way == IceTWay::Bytes || way == IceTWay::BytesOfFloats;
    const PartialImage& first = inputs.image();
    const auto icet = std::make_shared<IceT>(inputs.comm, strategy, hasBytes, first.width, first.height);
    const std::size_t values = first.rgba.size();
    // Of all views if they are to be ready, else of one.
    const auto bytes = std::make_shared<std::vector<std::vector<std::uint8_t>>>(
        way == IceTWay::Floats ? 0 : inputs.views.size(), std::vector<std::uint8_t>(values));
    for (std::size_t v = 0; way == IceTWay::Bytes && v < inputs.views.size(); ++v)
        toBytes(inputs.views[v].image.rgba.data(), values, (*bytes)[v].data());
    const auto out = std::make_shared<const void*>(nullptr);
    Compositor compositor;
    compositor.frame = [=, &inputs] {
        const PartialImage& image = inputs.image();
        std::uint8_t* const own = bytes->empty() ? nullptr : (*bytes)[inputs.frame % bytes->size()].data();
        if (way == IceTWay::BytesOfFloats)
            toBytes(image, own);
        icet->resetTraffic();
        const void* const input = hasBytes ? static_cast<const void*>(own) : image.rgba.data();
        *out = icet->composite(input, image.viewport.data(), inputs.order());
        if (way == IceTWay::FloatsToBytes && *out) {
            toBytes(static_cast<const float*>(*out), values, own);
            *out = own;
        }
    };
    compositor.image = [out] { return *out; };
    compositor.traffic = [icet] { return std::make_pair(icet->bytesSent(), icet->messagesSent()); };
    return compositor;
}

inline void addIceT(std::vector<System>& systems, const Inputs& inputs)
{
    const auto ranks = inputs.viewports().size();
    const bool isPowerOf2 = (ranks & (ranks - 1)) == 0;
    for (const IceTStrategy& strategy : icetStrategies()) {
        const std::string name = strategy.name;
        // What "automatic" picks, and swaps of as many ranks as there is no power of 2 of, are others again.
        if (name.find("automatic") != std::string::npos || (isPowerOf2 && name.find("folding") != std::string::npos))
            continue;
        for (const IceTWay way : {IceTWay::Floats, IceTWay::FloatsToBytes, IceTWay::Bytes, IceTWay::BytesOfFloats}) {
            System s;
            s.name = "icet";
            s.config = (way == IceTWay::Bytes           ? "ubyte, "
                        : way == IceTWay::BytesOfFloats ? "ubyte of floats, "
                                                        : "float, ")
                       + name;
            s.output = way == IceTWay::Floats ? "float" : "8 bit";
            s.copied = way == IceTWay::Floats ? 0 : 4;
            s.start = [strategy, way, &inputs] { return startIceT(strategy, way, inputs); };
            systems.push_back(std::move(s));
        }
    }
}
#endif

// ---- measuring

// Like testing::toUnorm8() and as exact, but fast: 255 times a float fits in a double, which is rounded to even.
inline std::uint8_t levelOf(float value)
{
    return static_cast<std::uint8_t>(std::nearbyint(255 * std::min(std::max(0.0, static_cast<double>(value)), 1.0)));
}

// Of an image, 4 floats or bytes a pixel.
inline dfb::testing::ErrorReport errorOf(const void* image, bool isFloat, const ExactImage& exact)
{
    const auto* floats = isFloat ? static_cast<const float*>(image) : nullptr;
    const auto* bytes = static_cast<const std::uint8_t*>(image);
    dfb::testing::ErrorReport report;
    const std::size_t row = 4 * static_cast<std::size_t>(exact.width);
    for (std::size_t i = 0; i < 4 * exact.pixels.size(); ++i) {
        const std::size_t place = i / row * static_cast<std::size_t>(exact.rowStep) * row + i % row;
        report.add(floats ? floats[place] : static_cast<float>(bytes[place]) / 255, exact.pixels[i / 4].rgba[i % 4]);
        report.addByte(floats ? levelOf(floats[place]) : bytes[place], exact.levels[i]);
    }
    return report;
}

// Reads all of an image, as a program that shows or stores it does; returns something that depends on each byte.
inline std::uint64_t readAll(const void* image, std::size_t byteCount)
{
    const auto* bytes = static_cast<const std::byte*>(image);
    std::uint64_t all = 0;
    for (std::size_t i = 0; i + sizeof all <= byteCount; i += sizeof all) {
        std::uint64_t some = 0;
        std::memcpy(&some, bytes + i, sizeof some);
        all ^= some;
    }
    return all;
}

// Collective: one frame, from when the first rank begins to when rank 0 has the image; or, if `imagePixels` is not 0,
// has read it. `timer`: of `comm`.
inline void timeFrame(MPI_Comm comm, FrameTimer& timer, System& s, bool counts, std::size_t imagePixels = 0)
{
    const std::size_t readPixels = rankIn(comm) == 0 ? imagePixels : 0;
    timer.synchronize();
    meet(comm);
    const double start = timer.clock(), cpuBefore = processCpuSeconds(), yieldedBefore = yieldedSeconds();
    s.compositor.frame();
    static volatile std::uint64_t seen = 0;
    if (readPixels > 0 && s.compositor.image && s.compositor.image())
        seen = seen ^ readAll(s.compositor.image(), (s.isFloat() ? 16 : 4) * readPixels);
    const double end = timer.clock(), cpu = processCpuSeconds() - cpuBefore, yielded = yieldedSeconds() - yieldedBefore;
    const double first = reduce(comm, start, MPI_MIN);
    const double cpuOfAll = reduce(comm, cpu, MPI_SUM), yieldedByAll = reduce(comm, yielded, MPI_SUM);
    if (!counts)
        return;
    s.ms.push_back(1e3 * (end - first)); // on rank 0, when it has the image
    s.cpuMs.push_back(1e3 * cpuOfAll);
    s.yieldMs.push_back(1e3 * yieldedByAll);
}

// Collective: what the last frame of a system has cost, and on rank 0 how exact it is; times, if there are any.
inline void takeResult(MPI_Comm comm, System& s, const ExactImage& exact)
{
    Result& r = s.result;
    r.ranks = sizeOf(comm);
    r.system = s.name;
    r.config = s.config + ", to " + s.output;
    r.ms = figureOf(s.ms);
    r.cpuMs = figureOf(s.cpuMs);
    r.yieldMs = figureOf(s.yieldMs);
    const auto traffic = s.compositor.traffic();
    r.bytes = static_cast<double>(traffic.first);
    r.messages = static_cast<double>(traffic.second);
    if (!s.compositor.trafficIsOfAll) {
        r.bytes = reduce(comm, r.bytes, MPI_SUM);
        r.messages = reduce(comm, r.messages, MPI_SUM);
    }
    if (rankIn(comm) == 0 && s.compositor.image) {
        const dfb::testing::ErrorReport e = errorOf(s.compositor.image(), s.isFloat(), exact);
        r.maxError = e.maxAbs;
        r.rmse = e.rmse();
        r.levels = e.maxLevels;
    }
    if (s.compositor.peakMemory)
        r.peakMemoryBytes = s.compositor.peakMemory();
}

// Collective: starts the systems, each of which has its turn in every frame, takes their results and ends them.
// `exact`: of the first view.
inline void measureInTurns(Inputs& inputs, std::vector<System>& systems, int frames, const ExactImage& exact)
{
    const MPI_Comm comm = inputs.comm;
    const std::size_t pixels = inputs.isReadInside ? inputs.image().depth.size() : 0;
    for (System& s : systems)
        s.compositor = s.start();
    FrameTimer timer(comm);
    const auto views = static_cast<int>(inputs.views.size());
    const int all = (frames + views - 1) / views * views; // so that the last is of the first view
    for (int frame = -views; frame <= all; ++frame) {     // before 0: touches memory
        inputs.frame = static_cast<std::size_t>(frame + views);
        for (std::size_t i = 0; i < systems.size(); ++i)
            timeFrame(comm, timer, systems[(i + inputs.frame) % systems.size()], frame > 0, pixels);
    }
    for (System& s : systems)
        takeResult(comm, s, exact);
    const auto traced = std::find_if(systems.begin(), systems.end(),
                                     [](const System& s) { return s.compositor.writeTrace != nullptr; });
    if (traced != systems.end()) {
        traced->compositor.writeTrace();
        inputs.trace.clear();
    }
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
            if (!s.isFloat() && f.isFloat() && s.name == f.name && s.config == f.config
                && s.config.find("half a level") == std::string::npos) { // which leaves floats as they are
                s.result.maxError = f.result.maxError;
                s.result.rmse = f.result.rmse;
            }
}

} // namespace bench
