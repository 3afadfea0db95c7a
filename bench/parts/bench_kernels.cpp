// What the loops over pixels cost, compared with memcpy: blending in a known order and sorted by depth, conversion to
// the output formats, encoding and decoding of inputs. Each is called as the pipeline of a tile calls it, on one
// thread, and counted in bytes of its input against memcpy of as many bytes in the same run. No MPI; half a minute.
//   bench_kernels [--json FILE] [--table FILE] [--benchmark_filter=REGEX and other options of Google Benchmark]
// For example --benchmark_filter='memcpy|encode', with memcpy, as others are compared with it. Times are of the
// thread's CPU, medians over repetitions that are interleaved at random, so that what else the machine does disturbs
// all alike.
#include "figures.hpp"

#include <dfb/blend/in_place_kernels.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/wire/fragment_message.hpp>

#include <benchmark/benchmark.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <functional>
#include <map>
#include <memory>
#include <numeric>
#include <random>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace {

using dfb::Buffer;
using dfb::Fragment;
using dfb::OutputFormat;
using dfb::WireFormat;

// Kernels "from memory" read this much, several times the size of the caches; each call gets the next piece.
constexpr std::size_t memoryBytes = std::size_t{64} << 20;

enum class From { Cache, Memory };

// ---- what is measured, and what it is compared with

// A kernel's line in the table.
struct Kernel {
    enum class Measure { Speed, Time }; // the ratio is of bytes per second, or of the time of a call

    std::string name;
    double bytes = 0;    // of the input of a call
    std::string against; // the name of another kernel; empty: nothing
    Measure measure = Measure::Speed;
    double target = 0; // of the ratio: at least, of a time at most; 0: none
    std::size_t callsPerIteration = 1;
};

std::vector<Kernel>& kernels()
{
    static std::vector<Kernel> all;
    return all;
}

using Function = std::function<void(benchmark::State&)>;

// `make` returns the function to be measured. It is called when the function is first needed, because each kernel has
// pixels of its own, and those of all kernels are many.
benchmark::internal::Benchmark* measure(const Kernel& kernel, std::function<Function()> make)
{
    kernels().push_back(kernel);
    const double bytes = kernel.bytes * static_cast<double>(kernel.callsPerIteration);
    return benchmark::RegisterBenchmark(
               kernel.name.c_str(),
               [make = std::move(make), made = Function(), bytes](benchmark::State& s) mutable {
                   if (!made)
                       made = make();
                   made(s);
                   s.SetBytesProcessed(static_cast<std::int64_t>(bytes * static_cast<double>(s.iterations())));
               })
        ->Unit(benchmark::kMicrosecond)
        ->ComputeStatistics("mad",
                            [](const std::vector<double>& samples) { return bench::figureOf(samples).deviation; });
}

const std::shared_ptr<dfb::MemoryPool>& pool()
{
    static const auto one = dfb::MemoryPool::create();
    return one;
}

// How many pieces of this size there are to go through.
std::size_t piecesOf(From from, std::size_t bytes)
{
    return from == From::Cache ? 1 : std::max<std::size_t>(2, memoryBytes / bytes);
}

std::string nameOf(From from) { return from == From::Cache ? "" : ", from memory"; }

// ---- memcpy

// The name of memcpy of this many bytes, which is measured from then on.
std::string memcpyOf(std::size_t bytes, From from = From::Cache)
{
    const std::string name = "memcpy " + bench::byteText(bytes) + nameOf(from);
    if (std::any_of(kernels().begin(), kernels().end(), [&](const Kernel& k) { return k.name == name; }))
        return name;
    Kernel kernel;
    kernel.name = name;
    kernel.bytes = static_cast<double>(bytes);
    measure(kernel, [bytes, from]() -> Function {
        const std::size_t pieces = piecesOf(from, bytes);
        const auto source = std::make_shared<Buffer>(pool()->acquire(pieces * bytes));
        const auto target = std::make_shared<Buffer>(pool()->acquire(pieces * bytes));
        std::memset(source->data(), 1, source->size());
        std::memset(target->data(), 0,
                    target->size()); // here as below: the system gives a page when it is first written
        return [=, next = std::size_t{0}](benchmark::State& s) mutable {
            for (auto _ : s) {
                std::memcpy(target->data() + next * bytes, source->data() + next * bytes, bytes);
                benchmark::ClobberMemory();
                next = (next + 1) % pieces;
            }
        };
    });
    return name;
}

// ---- pixels

// Numbers in [0, 1).
class Random {
public:
    explicit Random(unsigned seed) : engine_(seed) {}
    float operator()() { return static_cast<float>(engine_() >> 8) * 0x1p-24f; }
    std::mt19937& engine() { return engine_; }

private:
    std::mt19937 engine_;
};

// Premultiplied and in range, with an alpha above 0 and up to this.
void fillColor(float* rgba, std::size_t pixels, float mostAlpha, Random& random)
{
    for (std::size_t i = 0; i < pixels; ++i, rgba += 4) {
        rgba[3] = mostAlpha * (0.1f + 0.9f * random());
        for (int c = 0; c < 3; ++c)
            rgba[c] = rgba[3] * random();
    }
}

// ---- tiles and messages

constexpr dfb::ChannelMask wireChannels = dfb::colorChannel | dfb::depthChannel;
template <int Side>
using WireTile = dfb::Tile<wireChannels, Side>;

template <int Side>
Buffer encode(const WireTile<Side>& tile, WireFormat format, dfb::ChannelMask channels = wireChannels)
{
    static const dfb::detail::WireCoder coder;
    dfb::detail::InputFaults faults;
    Buffer message = dfb::detail::encodeFragment(*pool(), tile, channels, 0, nullptr, coder, format, faults);
    if (faults.nonFinite != 0 || faults.alphaOutside != 0)
        throw std::logic_error("pixels that are to be right are not");
    return message;
}

template <int Side>
Fragment decode(Buffer&& message)
{
    static const dfb::detail::WireCoder coder;
    static const dfb::TileLayout layout(Side, Side, Side);
    return dfb::detail::decodeFragment(
        *pool(), std::move(message), layout, [](int) { return 1; }, nullptr, coder);
}

// ---- blending

enum class Depths { None, Coherent, Random };

// Full inputs of one tile after the other, each in the memory of a message of its own as it is when it has been
// decoded.
template <class TileOp>
class Layers {
public:
    Layers(int count, Depths depths, From from) : count_(static_cast<std::size_t>(count))
    {
        constexpr int side = TileOp::tileSize;
        const auto channels = static_cast<dfb::ChannelMask>(dfb::colorChannel | TileOp::neededChannels);
        const std::size_t tiles = piecesOf(from, std::size_t{16} * side * side * count_);
        const auto tile = std::make_unique<WireTile<side>>();
        tile->frame = tile->tile = 0;
        tile->region = {0, 0, side, side};
        std::vector<int> places(count_);
        Random random(1);
        for (std::size_t t = 0; t < tiles; ++t) {
            // The order of depth is independent of the order of arrival and of the order in memory. Coherent depths:
            // surfaces at an angle to each other, one behind the other.
            std::iota(places.begin(), places.end(), 0);
            std::shuffle(places.begin(), places.end(), random.engine());
            for (const int place : places) {
                tile->generation = place;
                tile->source = static_cast<std::uint32_t>(fragments_.size() % count_);
                // A tenth of it on average: the last of 64 layers still shows, so that none is left out.
                fillColor(tile->color, std::size_t{side} * side, 0.2f, random);
                const float across = random(), down = random();
                for (int y = 0; y < side; ++y)
                    for (int x = 0; x < side; ++x) {
                        const float slope =
                            (across * static_cast<float>(x) + down * static_cast<float>(y)) / (2 * side);
                        tile->depth[y * side + x] =
                            depths == Depths::Random ? random() : static_cast<float>(place) + 0.9f * slope;
                    }
                fragments_.push_back(decode<side>(encode(*tile, WireFormat::Float32, channels)));
            }
        }
    }

    std::size_t tiles() const { return fragments_.size() / count_; }

    // Input k of this tile. Its pixels stay here, so that the operation may forget it.
    Fragment fragment(std::size_t tile, std::size_t k) const
    {
        const Fragment& kept = fragments_[tile * count_ + k];
        Fragment::Parts parts;
        parts.encoding = kept.encoding();
        parts.activePixels = kept.activePixels();
        parts.channels = kept.channels();
        parts.rowEnd = kept.header().region.height();
        parts.fullRow = {0, static_cast<std::uint16_t>(kept.header().region.width())};
        const dfb::FragmentRow first = dfb::FragmentCursor(kept).next();
        parts.color = first.color;
        parts.depth = first.depth;
        return Fragment(kept.header(), Buffer(), parts);
    }

private:
    std::size_t count_;
    std::vector<Fragment> fragments_;
};

// A tile's inputs become a finished tile, by the operation as the pipeline calls it.
template <class TileOp>
Function blending(int count, OutputFormat format, Depths depths, From from)
{
    constexpr int side = TileOp::tileSize;
    const auto layers = std::make_shared<Layers<TileOp>>(count, depths, from);
    const auto op = std::make_shared<TileOp>();
    const auto out = std::make_shared<Buffer>(pool()->acquire(std::size_t{side} * side * dfb::bytesPerPixel(format)));
    return [=, next = std::size_t{0}](benchmark::State& s) mutable {
        dfb::TileInfo info;
        info.region = {0, 0, side, side};
        dfb::detail::Planes planes;
        planes.at[dfb::detail::Color] = out->data();
        for (auto _ : s) {
            op->newFrame(info);
            for (std::size_t k = 0; k < static_cast<std::size_t>(count); ++k)
                op->add(layers->fragment(next, k));
            dfb::FinishedTile tile(info.region, format, planes, side);
            op->finish(tile);
            benchmark::ClobberMemory();
            next = (next + 1) % layers->tiles();
        }
    };
}

std::string inputsOf(int count, int side, OutputFormat format, From from)
{
    return std::to_string(count) + " x " + std::to_string(side) + "² to " + nameOf(format) + nameOf(from);
}

template <int Side>
void measureInOrder(int count, OutputFormat format, From from = From::Cache)
{
    Kernel kernel;
    kernel.name = "in order, " + inputsOf(count, Side, format, from);
    const std::size_t bytes = std::size_t{16} * Side * Side * static_cast<std::size_t>(count);
    kernel.bytes = static_cast<double>(bytes);
    kernel.against = memcpyOf(bytes, from);
    kernel.target = 0.7;
    measure(kernel, [=] { return blending<dfb::BasicOrderedBlend<Side>>(count, format, Depths::None, from); });
}

template <int Side>
void measureSorted(int count, Depths depths, double target, From from = From::Cache)
{
    const OutputFormat format = OutputFormat::RGBA8;
    Kernel kernel;
    kernel.name =
        (depths == Depths::Coherent ? "sorted, coherent, " : "sorted, random, ") + inputsOf(count, Side, format, from);
    kernel.bytes = 20.0 * Side * Side * count;
    kernel.against = "in order, " + inputsOf(count, Side, format, from);
    kernel.target = target;
    measure(kernel, [=] { return blending<dfb::BasicAlphaBlend<Side>>(count, format, depths, from); });
}

void measureBlending()
{
    for (const OutputFormat format : {OutputFormat::RGBA8, OutputFormat::RGBA32F})
        for (const int count : {1, 4, 16, 64}) {
            measureInOrder<64>(count, format);
            measureInOrder<128>(count, format);
        }
    measureInOrder<64>(4, OutputFormat::RGBA8, From::Memory);
    measureInOrder<64>(16, OutputFormat::RGBA8, From::Memory);
    for (const int count : {4, 16, 64}) {
        measureSorted<64>(count, Depths::Coherent, 0.8);
        measureSorted<128>(count, Depths::Coherent, 0.8);
    }
    measureSorted<64>(16, Depths::Coherent, 0.8, From::Memory);
    measureSorted<64>(16, Depths::Random, 0.3);
    measureSorted<128>(16, Depths::Random, 0.3);
}

#if defined(DFB_HAS_AVX2_CLONES)
// Rows of whole images of 1024 x 1024 are blended where they lie, tile by tile.
void measureInPlace(int count, const char* instructions, decltype(&dfb::detail::blendFullRowsAvx2<false>) blend)
{
    constexpr std::size_t side = 64, width = 1024, tiles = (width / side) * (width / side);
    Kernel kernel;
    const std::string inputs = "in place, " + std::to_string(count) + " x 64², ", avx2 = inputs + "AVX2, from memory";
    kernel.name = inputs + instructions + ", from memory";
    kernel.bytes = 16.0 * side * side * count;
    kernel.against = kernel.name == avx2 ? "" : avx2;
    kernel.measure = Kernel::Measure::Time;
    measure(kernel, [=]() -> Function {
        std::vector<float> image(4 * width * width);
        Random random(5);
        fillColor(image.data(), width * width, 0.2f, random);
        const auto images =
            std::make_shared<std::vector<std::vector<float>>>(static_cast<std::size_t>(count), std::move(image));
        return [=, next = std::size_t{0}](benchmark::State& s) mutable {
            std::vector<double> rgba(4 * side), transmittance(side);
            std::vector<dfb::detail::RowInPlace> rows(images->size());
            for (auto _ : s) {
                const std::size_t x = next % (width / side) * side, y = next / (width / side) * side;
                for (std::size_t row = y; row < y + side; ++row) {
                    for (std::size_t k = 0; k < rows.size(); ++k) {
                        const auto* const pixels = reinterpret_cast<const std::byte*>((*images)[k].data() + 4 * x);
                        rows[k].span = {0, side};
                        rows[k].first.color = pixels + 16 * width * row;
                        rows[k].ahead.color = pixels + 16 * width * std::min(row + 1, y + side - 1);
                    }
                    benchmark::DoNotOptimize(blend(rows.data(), count, 0, rgba.data(), transmittance.data()));
                    benchmark::ClobberMemory();
                }
                next = (next + 1) % tiles;
            }
        };
    });
}

void measureInPlace()
{
    for (const int count : {2, 4, 8, 16}) {
        if (dfb::detail::cpuHasAvx2())
            measureInPlace(count, "AVX2", dfb::detail::blendFullRowsAvx2<false>);
        if (dfb::detail::cpuHasAvx512())
            measureInPlace(count, "AVX-512", dfb::detail::blendFullRowsAvx512<false>);
    }
}
#endif

// ---- conversion

// Rows of a tile of `Real` become rows of the output: out of double when no pixel operation is there, else out of
// float.
template <class Real>
void measureConversion(OutputFormat format, From from)
{
    constexpr std::size_t side = 64, pixels = side * side, bytes = 4 * sizeof(Real) * pixels;
    Kernel kernel;
    kernel.name =
        std::string("convert ") + (sizeof(Real) == 4 ? "float" : "double") + " to " + nameOf(format) + nameOf(from);
    kernel.bytes = bytes;
    kernel.against = memcpyOf(bytes, from);
    kernel.target = 0.7;
    measure(kernel, [=]() -> Function {
        const std::size_t tiles = piecesOf(from, bytes);
        const auto in = std::make_shared<std::vector<Real>>(4 * pixels * tiles);
        std::vector<float> tile(4 * pixels);
        Random random(2);
        fillColor(tile.data(), pixels, 1, random);
        for (std::size_t t = 0; t < tiles; ++t)
            std::copy(tile.begin(), tile.end(), in->begin() + static_cast<std::ptrdiff_t>(4 * pixels * t));
        const std::size_t outBytes = pixels * dfb::bytesPerPixel(format);
        const auto out = std::make_shared<Buffer>(pool()->acquire(tiles * outBytes));
        std::memset(out->data(), 0, out->size());
        return [=, next = std::size_t{0}](benchmark::State& s) mutable {
            const dfb::Region region{0, 0, static_cast<int>(side), static_cast<int>(side)};
            for (auto _ : s) {
                const Real* rgba = in->data() + 4 * pixels * next;
                std::byte* to = out->data() + outBytes * next;
                if constexpr (sizeof(Real) == sizeof(double)) {
                    dfb::detail::Planes planes;
                    planes.at[dfb::detail::Color] = to;
                    dfb::FinishedTile finished(region, format, planes, side);
                    for (std::size_t y = 0; y < side; ++y)
                        benchmark::DoNotOptimize(finished.setRow(static_cast<int>(y), rgba + 4 * side * y, nullptr));
                } else {
                    for (std::size_t y = 0; y < side; ++y)
                        benchmark::DoNotOptimize(dfb::convertPixels(rgba + 4 * side * y, static_cast<int>(side), format,
                                                                    to + y * side * dfb::bytesPerPixel(format)));
                }
                benchmark::ClobberMemory();
                next = (next + 1) % tiles;
            }
        };
    });
}

void measureConversions()
{
    for (const OutputFormat format : {OutputFormat::RGBA8, OutputFormat::SRGBA8, OutputFormat::RGBA32F}) {
        measureConversion<double>(format, From::Cache);
        measureConversion<float>(format, From::Cache);
        measureConversion<float>(format, From::Memory);
    }
}

// ---- encoding and decoding

// Which pixels of a tile are active: those of a disc in its middle, as a brick's footprint is in one piece; or any.
struct Activity {
    int percent = 100;
    bool scattered = false;

    std::string name() const
    {
        return percent == 100 ? "full" : std::to_string(percent) + " %" + (scattered ? " scattered" : "");
    }
    std::vector<bool> pixels(int side) const
    {
        std::vector<std::pair<double, std::size_t>> order;
        Random random(3);
        for (int y = 0; y < side; ++y)
            for (int x = 0; x < side; ++x) {
                const double fromMiddle = std::hypot(x - 0.5 * side + 0.5, y - 0.5 * side + 0.5);
                order.emplace_back(scattered ? static_cast<double>(random()) : fromMiddle, order.size());
            }
        std::sort(order.begin(), order.end());
        std::vector<bool> active(order.size());
        for (std::size_t i = 0; i < order.size() * static_cast<std::size_t>(percent) / 100; ++i)
            active[order[i].second] = true;
        return active;
    }
};

template <int Side>
void fillTile(WireTile<Side>& tile, const Activity& activity, unsigned seed)
{
    static_cast<dfb::TileHeader&>(tile) = {};
    tile.frame = 0;
    tile.tile = 0;
    tile.region = {0, 0, Side, Side};
    tile.clear();
    const std::vector<bool> active = activity.pixels(Side);
    Random random(seed);
    for (std::size_t i = 0; i < active.size(); ++i)
        if (active[i]) {
            fillColor(tile.color + 4 * i, 1, 1, random);
            tile.depth[i] = random();
        }
}

std::string wireName(const char* what, int side, WireFormat format, const Activity& activity, From from)
{
    return std::string(what) + ' ' + dfb::nameOf(format) + ", " + std::to_string(side) + "² " + activity.name()
           + nameOf(from);
}

// A full tile is compared with memcpy. A tile with fewer active pixels should cost less in proportion; there is no
// target for one without active pixels, or with scattered ones.
void compare(Kernel& kernel, const char* what, int side, WireFormat format, const Activity& activity, From from)
{
    if (activity.percent == 100) {
        const auto bytes = static_cast<std::size_t>(kernel.bytes);
        kernel.against = memcpyOf(bytes - bytes % 1024, from); // without the header of a message
        kernel.target = 0.7;
    } else {
        kernel.against = wireName(what, side, format, {}, from);
        kernel.measure = Kernel::Measure::Time;
        kernel.target = activity.scattered ? 0 : 0.01 * activity.percent;
    }
}

template <int Side>
void measureEncoding(WireFormat format, const Activity& activity, From from)
{
    constexpr std::size_t bytes = std::size_t{20} * Side * Side; // also if few are active: all are looked at
    Kernel kernel;
    kernel.name = wireName("encode", Side, format, activity, from);
    kernel.bytes = bytes;
    compare(kernel, "encode", Side, format, activity, from);
    measure(kernel, [=]() -> Function {
        const auto tiles = std::make_shared<std::vector<WireTile<Side>>>(piecesOf(from, bytes));
        for (WireTile<Side>& tile : *tiles)
            if (&tile == &tiles->front())
                fillTile(tile, activity, 4);
            else
                tile = tiles->front();
        // Messages are kept, so that others are written elsewhere, and the written memory is not in a cache either.
        const auto messages = std::make_shared<std::vector<Buffer>>();
        for (const WireTile<Side>& tile : *tiles)
            messages->push_back(encode(tile, format));
        return [=, next = std::size_t{0}](benchmark::State& s) mutable {
            for (auto _ : s) {
                (*messages)[next] = encode((*tiles)[next], format);
                benchmark::ClobberMemory();
                next = (next + 1) % tiles->size();
            }
        };
    });
}

// Decoding keeps the message, so that each call needs a new one. They are made in batches, which is not timed.
template <int Side>
void measureDecoding(WireFormat format, const Activity& activity, From from)
{
    const auto tile = std::make_unique<WireTile<Side>>();
    fillTile(*tile, activity, 4);
    const auto message = std::make_shared<const Buffer>(encode(*tile, format));
    const std::uint32_t active = decode<Side>(encode(*tile, format)).activePixels();
    if (100 * active / (Side * Side) > static_cast<std::uint32_t>(activity.percent))
        throw std::logic_error("more pixels have come out than went in");
    const std::size_t bytes = message->size(), cacheBytes = std::size_t{256} << 10;
    Kernel kernel;
    kernel.name = wireName("decode", Side, format, activity, from);
    kernel.bytes = static_cast<double>(bytes);
    compare(kernel, "decode", Side, format, activity, from);
    const std::size_t batch =
        from == From::Memory ? piecesOf(from, bytes) : std::clamp<std::size_t>(cacheBytes / bytes, 4, 256);
    kernel.callsPerIteration = batch;
    measure(kernel, [=]() -> Function {
        const auto messages = std::make_shared<std::vector<Buffer>>(batch);
        const auto fragments = std::make_shared<std::vector<Fragment>>(batch);
        const auto decodeBatch = [=] { // returns what that took
            for (Buffer& m : *messages) {
                m = pool()->acquire(bytes);
                std::memcpy(m.data(), message->data(), bytes);
            }
            benchmark::ClobberMemory();
            const double start = bench::threadCpuSeconds();
            for (std::size_t i = 0; i < batch; ++i)
                (*fragments)[i] = decode<Side>(std::move((*messages)[i]));
            benchmark::ClobberMemory();
            const double seconds = bench::threadCpuSeconds() - start;
            for (Fragment& fragment : *fragments)
                fragment = {};
            return seconds;
        };
        decodeBatch();
        return [=](benchmark::State& s) {
            for (auto _ : s)
                s.SetIterationTime(decodeBatch());
        };
    })->UseManualTime();
}

void measureWire()
{
    constexpr std::array<WireFormat, 4> formats{WireFormat::Float32, WireFormat::Float16, WireFormat::Unorm16,
                                                WireFormat::Unorm8};
    const auto both = [](auto side, WireFormat format, const Activity& activity, From from) {
        measureEncoding<decltype(side)::value>(format, activity, from);
        measureDecoding<decltype(side)::value>(format, activity, from);
    };
    constexpr std::integral_constant<int, 64> usual{};
    constexpr std::integral_constant<int, 128> large{};
    for (const WireFormat format : formats) {
        for (const int percent : {100, 50, 10, 1, 0})
            both(usual, format, {percent}, From::Cache);
        both(large, format, {}, From::Cache);
    }
    both(usual, WireFormat::Float32, {10, true}, From::Cache);
    both(usual, WireFormat::Float32, {}, From::Memory);
    both(usual, WireFormat::Unorm8, {}, From::Memory);
}

// ---- report

// Keeps what every repetition took, and prints medians and deviations, at the end, in the order of the table.
class Reporter : public benchmark::ConsoleReporter {
public:
    Reporter() : benchmark::ConsoleReporter(OO_Tabular) {}

    void ReportRuns(const std::vector<Run>& runs) override
    {
        for (const Run& run : runs) {
            if (run.run_type == Run::RT_Iteration && run.iterations > 0)
                seconds_[run.run_name.function_name].push_back(secondsOf(run));
            else if (run.aggregate_name == "median" || run.aggregate_name == "mad")
                aggregates_.push_back(run);
        }
    }

    void Finalize() override
    {
        std::stable_sort(aggregates_.begin(), aggregates_.end(),
                         [](const Run& a, const Run& b) { return a.family_index < b.family_index; });
        benchmark::ConsoleReporter::ReportRuns(aggregates_);
        benchmark::ConsoleReporter::Finalize();
    }

    // Of one call.
    bench::Figure figureOf(const Kernel& kernel) const
    {
        const auto found = seconds_.find(kernel.name);
        if (found == seconds_.end())
            return {};
        std::vector<double> samples = found->second;
        for (double& sample : samples)
            sample /= static_cast<double>(kernel.callsPerIteration);
        return bench::figureOf(std::move(samples));
    }

private:
    // Google Benchmark gives a time that the kernel measured itself for the real one.
    static double secondsOf(const Run& run)
    {
        const bool isManual = run.run_name.time_type.find("manual") != std::string::npos;
        const double total = isManual ? run.real_accumulated_time : run.cpu_accumulated_time;
        return total / static_cast<double>(run.iterations);
    }

    std::map<std::string, std::vector<double>> seconds_; // of an iteration, by the kernel's name
    std::vector<Run> aggregates_;
};

// The table, also into the file `tablePath`, and JSON lines into `json`, if these are not empty.
void report(const Reporter& reporter, const std::string& json, const std::string& tablePath)
{
    std::ofstream file;
    if (!json.empty())
        file.open(json, std::ios::app);
    bench::Table table({"kernel", "us", "GB/s", "ratio", "to", "target", "met"});
    const auto find = [](const std::string& name) {
        return std::find_if(kernels().begin(), kernels().end(), [&](const Kernel& k) { return k.name == name; });
    };
    const auto isPlain = [](const Kernel& kernel) { return kernel.name.rfind("memcpy", 0) == 0; };
    std::stable_partition(kernels().begin(), kernels().end(), isPlain);
    for (const Kernel& kernel : kernels()) {
        const bench::Figure time = reporter.figureOf(kernel);
        if (time.count == 0)
            continue; // filtered out
        const bool isTime = kernel.measure == Kernel::Measure::Time;
        const double speed = 1e-9 * kernel.bytes / time.median;
        double ratio = 0;
        if (const auto other = find(kernel.against); other != kernels().end())
            if (const double its = reporter.figureOf(*other).median; its > 0)
                ratio = isTime ? time.median / its : speed / (1e-9 * other->bytes / its);
        const bool isMet = isTime ? ratio <= kernel.target : ratio >= kernel.target;
        const bool wasAsked = kernel.target > 0 && ratio > 0;
        table.add({kernel.name, bench::text({1e6 * time.median, 1e6 * time.deviation, time.count}),
                   isTime ? "" : bench::text("%.1f", speed),
                   ratio > 0 ? bench::text(ratio < 0.1 ? "%.3f" : "%.2f", ratio) : "",
                   ratio > 0 ? (isTime ? "time of " : "") + kernel.against : "",
                   kernel.target > 0 ? (isTime ? "<= " : ">= ") + bench::text("%.2f", kernel.target) : "",
                   wasAsked ? isMet ? "yes" : "no" : ""});
        if (json.empty())
            continue;
        file << R"({"bench": "kernels", "system": ")" << (isPlain(kernel) ? "memcpy" : "dfb") << R"(", "config": ")"
             << kernel.name << R"(", "median_ms": )" << bench::text("%.7f", 1e3 * time.median) << R"(, "mad_ms": )"
             << bench::text("%.7f", 1e3 * time.deviation) << R"(, "bytes": )" << bench::text("%.0f", kernel.bytes)
             << R"(, "gb_per_s": )" << bench::text("%.4g", speed);
        if (ratio > 0)
            file << R"(, "ratio": )" << bench::text("%.4g", ratio) << R"(, "ratio_of": ")"
                 << (isTime ? "time" : "speed") << R"(", "ratio_to": ")" << kernel.against << '"';
        if (kernel.target > 0)
            file << R"(, "target": )" << bench::text("%g", kernel.target);
        file << "}\n";
    }
    const char* title = "Medians of the thread's CPU time ± median absolute deviation; bytes are of the input:";
    table.print(title);
    table.appendTo(tablePath, title);
    if (!json.empty() && !file.flush())
        throw std::runtime_error("cannot write " + json);
}

} // namespace

int main(int argc, char** argv)
{
    // What Google Benchmark is told unless the command line says otherwise: the last one counts.
    std::vector<std::string> arguments{argv[0], "--benchmark_repetitions=15", "--benchmark_min_time=0.008",
                                       "--benchmark_enable_random_interleaving=true"};
    std::string json, table;
    for (int i = 1; i < argc; ++i) {
        const std::string argument = argv[i];
        if (argument == "--json" && i + 1 < argc)
            json = argv[++i];
        else if (argument == "--table" && i + 1 < argc)
            table = argv[++i];
        else
            arguments.push_back(argument);
    }
    std::vector<char*> pointers;
    for (std::string& argument : arguments)
        pointers.push_back(argument.data());
    pointers.push_back(nullptr);
    auto count = static_cast<int>(arguments.size());
    benchmark::Initialize(&count, pointers.data());
    if (benchmark::ReportUnrecognizedArguments(count, pointers.data()))
        return 2;
    try {
        measureBlending();
#if defined(DFB_HAS_AVX2_CLONES)
        measureInPlace();
#endif
        measureConversions();
        measureWire();
        Reporter reporter;
        benchmark::RunSpecifiedBenchmarks(&reporter);
        report(reporter, json, table);
    } catch (const std::exception& e) {
        std::fprintf(stderr, "bench_kernels: %s\n", e.what());
        return 1;
    }
}
