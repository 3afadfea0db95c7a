// What a rank sends and keeps when there are 2 to 1024 of them: messages and bytes of each rank and frame, counted on
// ranks that are threads of this process, beside the formulas of bench/README.md, of which they must not differ; then
// an estimate of a frame's time on up to 16,384 ranks in the LogGP model, beside binary swap and radix-k. No MPI.
//   bench_scaling [--ranks 2,4,...] [--size 2048x2048] [--scenes bricks,discs] [--frames 3] [--quick]
//   [--counts-only] [--rig L,o,g,G] [--hpc L,o,g,G] [--pixel-ns DFB,PLAIN] [--json FILE] [--svg FILE] [--table FILE]
//   [--trace FILE]
//   [--commit ID]
// `bricks`: each rank one brick of a cube, whose image is the smaller the more ranks there are. `discs`: each rank a
// disc that is as large whatever their number. L, o and g are in us, G in ns a byte. --trace: of the first scene, with
// the first number of ranks. The exit status is 1 if a count is not that of its formula.
#include "counted_transport.hpp"
#include "options.hpp"
#include "pixel_bricks.hpp"
#include "plot.hpp"
#include "results.hpp"
#include "scenes.hpp"
#include "trace.hpp"

#include <dfb/distributed_framebuffer.hpp>
#include <dfb/frame/verdict.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/render/loops.hpp>
#include <dfb/wire/fragment_message.hpp>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

namespace {

using bench::Kind;
using bench::MessageCount;
using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, bench::CountedTransport>;

constexpr int tileSize = dfb::AlphaBlend::tileSize;
constexpr std::int64_t bytesPerInput = 20; // float32 colour and depth of a pixel
constexpr std::int64_t bytesPerOutput = 4; // 8 bits a channel

// The pixels of each rank: half as many as four tiles have, wherever they lie.
class DiscScene : public bench::Scene {
public:
    DiscScene(int ranks, int width, int height) : Scene(ranks, width, height) {}

private:
    static constexpr double radius = 0.8 * tileSize;

    std::array<double, 2> centreOf(int rank) const
    {
        const double i = rank + 1; // a low-discrepancy sequence, so that all parts of the image have as many
        const double u = i * 0.7548776662466927, v = i * 0.5698402909980532;
        return {radius + (u - std::floor(u)) * (width() - 2 * radius),
                radius + (v - std::floor(v)) * (height() - 2 * radius)};
    }
    bool shade(int rank, int x, int y, float* rgba, float& depth) const override
    {
        const auto centre = centreOf(rank);
        if (std::hypot(x + 0.5 - centre[0], y + 0.5 - centre[1]) > radius)
            return false;
        const auto [u, v] = positionOf(x, y);
        paint(rank, u, v, 0.5, rgba);
        depth = static_cast<float>(placeOf(rank));
        return true;
    }
    std::array<int, 4> boundsOf(int rank) const override
    {
        const auto centre = centreOf(rank);
        const int x0 = std::max(0, static_cast<int>(centre[0] - radius)),
                  y0 = std::max(0, static_cast<int>(centre[1] - radius));
        const int side = static_cast<int>(2 * radius) + 2;
        return {x0, y0, std::min(side, width() - x0), std::min(side, height() - y0)};
    }
};

std::unique_ptr<bench::Scene> sceneOf(const std::string& name, int ranks, int width, int height)
{
    if (name == "discs")
        return std::make_unique<DiscScene>(ranks, width, height);
    return bench::makeScene(name, ranks, width, height);
}

// ---- the formulas, see bench/README.md

// A rank's input for one tile.
struct Input {
    int tile = 0;
    std::int64_t activePixels = 0, bytes = 0; // bytes of the message
};

std::vector<Input> inputsOf(const bench::PartialImage& image, const dfb::TileLayout& layout)
{
    std::vector<Input> inputs;
    const auto& v = image.viewport;
    const dfb::Region viewport{v[0], v[1], v[0] + v[2], v[1] + v[3]}, tiles = layout.tilesIn(viewport);
    for (int row = tiles.y0; row < tiles.y1; ++row)
        for (int column = tiles.x0; column < tiles.x1; ++column) {
            Input input;
            input.tile = layout.tileAt(column, row);
            const dfb::Region whole = layout.region(input.tile), part = intersection(whole, viewport);
            std::int64_t spans = 0, first = -1, last = -1;
            for (int y = part.y0; y < part.y1; ++y) {
                bool before = false;
                for (int x = part.x0; x < part.x1; ++x) {
                    const bool isActive = image.rgba[4 * image.indexOf(x, y) + 3] > 0;
                    spans += isActive && !before;
                    input.activePixels += isActive;
                    before = isActive;
                    if (isActive) {
                        first = first < 0 ? y : first;
                        last = y;
                    }
                }
            }
            const std::int64_t pixels = static_cast<std::int64_t>(whole.width()) * whole.height();
            input.bytes = 64 + bytesPerInput * input.activePixels;
            if (input.activePixels > 0 && input.activePixels < pixels)
                input.bytes += 2 * (last - first + 1) + 4 * spans;
            inputs.push_back(input);
        }
    return inputs;
}

struct Expected {
    // What a rank sends: in every frame, and beside that in a frame whose bricks or camera are new.
    MessageCount fragments, finished, done, verdict, manifests, acks, consensus;
    std::int64_t mostCredits = 0, mostCreditsIn = 0; // requests for credit and answers; and those that it takes
    bool asksForCredit = false;
    std::int64_t tiles = 0, activePixels = 0;
    std::int64_t inPixels = 0, inMessages = 0, inBytes = 0; // of fragments of others
    std::int64_t poolBytes = 0;                             // the most that its pool may hold

    MessageCount everyFrame() const
    {
        MessageCount sum = fragments;
        for (const MessageCount* more : {&finished, &done, &verdict, &consensus})
            sum += *more;
        return sum;
    }
};

// The size of the memory pool's block for so many bytes: powers of 2, and the middles between them.
std::int64_t blockOf(std::int64_t bytes)
{
    std::int64_t block = 64;
    while (block < bytes)
        block = block * 3 / 2 >= bytes ? block * 3 / 2 : block * 2;
    return block;
}

// The tiles that a rank owns.
struct Owned {
    bool any = false;
    std::int64_t seen = 0; // of which somebody has a pixel; the others are background, which does not travel
};

std::vector<Owned> ownedOf(const std::vector<std::vector<Input>>& inputs, const std::vector<int>& owners)
{
    std::vector<bool> isSeen(owners.size());
    for (const std::vector<Input>& some : inputs)
        for (const Input& input : some)
            if (input.activePixels > 0)
                isSeen[static_cast<std::size_t>(input.tile)] = true;
    std::vector<Owned> owned(inputs.size());
    for (std::size_t tile = 0; tile < owners.size(); ++tile) {
        Owned& of = owned[static_cast<std::size_t>(owners[tile])];
        of.any = true;
        of.seen += isSeen[tile];
    }
    return owned;
}

using Receivers = std::map<int, MessageCount>; // the messages to each rank that need credit

// Inputs, manifests and their answers. Returns the inputs that travel.
Receivers expectInputs(int rank, const std::vector<Input>& inputs, const std::vector<int>& owners,
                       std::int64_t mostInput, std::vector<Expected>& all)
{
    Expected& e = all[static_cast<std::size_t>(rank)];
    Receivers to;
    for (const Input& input : inputs) {
        const int owner = owners[static_cast<std::size_t>(input.tile)];
        ++e.tiles;
        e.activePixels += input.activePixels;
        // It is made in a block that has room for any input, and stays there if it fills three quarters of that.
        e.poolBytes += blockOf(4 * input.bytes < 3 * mostInput ? input.bytes : mostInput);
        if (owner == rank)
            continue;
        to[owner].add(input.bytes);
        e.fragments.add(input.bytes);
        Expected& receiver = all[static_cast<std::size_t>(owner)];
        receiver.inPixels += input.activePixels;
        receiver.inBytes += input.bytes;
        ++receiver.inMessages;
    }
    for (const auto& [owner, count] : to) {
        e.manifests.add(24 + 10 * count.messages);
        e.poolBytes += blockOf(24 + 10 * count.messages);
        all[static_cast<std::size_t>(owner)].acks.add(24);
    }
    return to;
}

// To the display rank.
void expectFinished(Expected& e, const Owned& owned, Receivers& to)
{
    constexpr std::int64_t batchBytes = 256 << 10, batchPrefix = 40;
    constexpr std::int64_t record = 16 + bytesPerOutput * tileSize * tileSize;
    constexpr std::int64_t perBatch = (batchBytes - batchPrefix) / record;
    const std::int64_t batches = (owned.seen + perBatch - 1) / perBatch;
    e.finished.add(batches * batchPrefix + owned.seen * record, batches);
    if (batches > 0)
        to[0] += e.finished;
    e.poolBytes += batches * batchBytes + blockOf(record);
    if (owned.any)
        e.done.add(32);
}

// `allowance`: the bytes that may be on the way to a rank unasked.
void expectCredit(int rank, const Receivers& to, std::int64_t allowance, std::vector<Expected>& all)
{
    Expected& e = all[static_cast<std::size_t>(rank)];
    const auto bytesPerCredit =
        static_cast<std::int64_t>(dfb::detail::FlowControl::bytesPerCredit(static_cast<std::size_t>(allowance)));
    for (const auto& [other, count] : to) {
        const std::int64_t requests = count.bytes > allowance ? count.messages : 0;
        // One more than the bytes of this frame make, as some of the last one may have had no answer.
        const std::int64_t answers = requests + std::min(count.messages, count.bytes / bytesPerCredit + 1);
        e.mostCredits += requests;
        e.mostCreditsIn += answers;
        e.asksForCredit = e.asksForCredit || requests > 0;
        all[static_cast<std::size_t>(other)].mostCredits += answers;
        all[static_cast<std::size_t>(other)].mostCreditsIn += requests;
    }
}

// To the ranks above and below it in the tree.
void expectReductions(Expected& e, int rank, int ranks)
{
    constexpr std::int64_t consensusBytes = 28;
    const auto verdictBytes = consensusBytes + static_cast<std::int64_t>(dfb::detail::Verdict().bytes().size());
    const std::int64_t agreementBytes = 2048 + 8 * ranks; // at most: what all ranks agree on at first
    std::int64_t messages = rank != 0;
    for (int bit = 1; bit < ranks && !(rank & bit); bit <<= 1)
        if (rank + bit < ranks) {
            ++messages;
            e.poolBytes += blockOf(agreementBytes);
        }
    e.verdict.add(messages * verdictBytes, messages);
    e.consensus.add(messages * consensusBytes, messages);
}

std::vector<Expected> expectedOf(const std::vector<std::vector<Input>>& inputs, const dfb::TileLayout& layout)
{
    const auto ranks = static_cast<int>(inputs.size());
    std::vector<int> owners;
    for (int tile = 0; tile < layout.tileCount(); ++tile)
        owners.push_back(dfb::latticeOwner(tile, layout, ranks));
    const std::vector<Owned> owned = ownedOf(inputs, owners);
    const auto mostInput = static_cast<std::int64_t>(
        dfb::detail::largestFragment(tileSize, tileSize, dfb::colorChannel | dfb::depthChannel));
    const auto messagePoolBytes = static_cast<std::int64_t>(dfb::FrameBufferConfig().messages.poolBytes);
    std::vector<Expected> all(inputs.size());
    for (int rank = 0; rank < ranks; ++rank) {
        const auto r = static_cast<std::size_t>(rank);
        Expected& e = all[r];
        Receivers to = expectInputs(rank, inputs[r], owners, mostInput, all);
        if (rank != 0)
            expectFinished(e, owned[r], to);
        else // the display rank
            e.poolBytes += blockOf(bytesPerOutput * layout.width() * layout.height());
        expectCredit(rank, to, messagePoolBytes / 2 / (ranks - 1), all);
        expectReductions(e, rank, ranks);
        e.poolBytes += blockOf(mostInput) + (64 << 10); // and what is small, in blocks
    }
    for (Expected& e : all)
        e.poolBytes += blockOf(24) * (e.acks.messages + e.mostCredits + e.mostCreditsIn);
    return all;
}

// ---- what is counted

struct Counted {
    MessageCount fragments, finished, done, reductions, manifests, acks, credits, all, received;
    std::int64_t poolBytes = 0;

    static Counted of(const bench::Traffic& sent, const bench::Traffic& received)
    {
        Counted c;
        c.fragments = sent.of({Kind::Fragment});
        c.finished = sent.of({Kind::FinishedTiles});
        c.done = sent.of({Kind::TilesDone});
        c.reductions = sent.of({Kind::ReduceUp, Kind::ReduceDown});
        c.manifests = sent.of({Kind::Manifest});
        c.acks = sent.of({Kind::ManifestAck});
        c.credits = sent.of({Kind::CreditRequest, Kind::Credit});
        c.all = sent.all();
        c.received = received.all();
        return c;
    }
};

struct Measured {
    std::vector<Counted> first, last; // of each rank: a frame with new bricks, and one with the same again
    std::vector<double> ms, cpuMs;
    dfb::FrameReport report;
};

// `tracePath`: empty without a trace.
Measured measure(const std::vector<bench::PartialImage>& images, int width, int height, int frames,
                 const std::string& tracePath)
{
    const auto ranks = static_cast<int>(images.size());
    const auto counters = std::make_shared<bench::Counters>(ranks);
    Measured result;
    result.first.resize(images.size());
    result.last.resize(images.size());
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        const auto rank = static_cast<std::size_t>(communicator.rank());
        const bench::PartialImage& image = images[rank];
        const auto connection =
            dfb::connect<bench::CountedTransport>(bench::CountedTransport::Communicator{communicator, counters});
        dfb::FrameBufferConfig config(width, height);
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        config.quiet = std::chrono::minutes(10); // or slow frames have messages that say that nothing is lost
        const bench::Trace trace(tracePath);
        config.trace = trace.sink;
        FrameBuffer fb(connection, config);
        const auto [left, top, columns, rows] = image.viewport;
        const dfb::World world = bench::worldOf(communicator.rank(), {left, top, left + columns, top + rows});
        dfb::DataParallelLoop loop(fb, world);
        const auto find = dfb::inPlace([&image](const dfb::Brick&, auto& view) {
            const std::size_t first = image.indexOf(view.region.x0, view.region.y0);
            view.stride = static_cast<std::size_t>(image.width);
            view.color = &image.rgba[4 * first];
            view.depth = &image.depth[first];
        });
        for (int frame = 0; frame < frames; ++frame) {
            counters->meet();
            counters->sent[rank].reset();
            counters->received[rank].reset();
            counters->meet();
            const double start = bench::now(), cpu = bench::processCpuSeconds();
            const dfb::FrameReport report = loop.render(bench::PixelCamera(), find);
            counters->meet();
            if (rank == 0)
                result.report = report;
            if (rank == 0 && frame > 0) { // the first takes memory
                result.ms.push_back(1e3 * (bench::now() - start));
                result.cpuMs.push_back(1e3 * (bench::processCpuSeconds() - cpu));
            }
            Counted& counted = (frame == 0 ? result.first : result.last)[rank];
            counted = Counted::of(counters->sent[rank], counters->received[rank]);
            counted.poolBytes = static_cast<std::int64_t>(connection->pool()->peakBytes());
        }
        counters->meet();
        trace.write(fb);
    });
    return result;
}

// ---- the LogGP model, see bench/README.md

// Times in us.
struct Network {
    std::string name;
    double latency, overhead, gap, perByte;
};

// The work of a rank in a phase of all ranks.
struct Work {
    double out = 0, in = 0, outBytes = 0, inBytes = 0, cpu = 0;
};

// The time until the slowest rank has sent and received all.
double phase(const Network& n, const Work& w)
{
    if (w.out + w.in == 0)
        return w.cpu;
    return n.latency
           + std::max({n.overhead * (w.out + w.in) + w.cpu, n.gap * std::max(w.out, w.in),
                       n.perByte * std::max(w.outBytes, w.inBytes)});
}

struct PixelCosts {
    double dfbNs = 0, plainNs = 0; // of an active pixel of an input: all that is done with it, on both sides together
};

// In ms.
double dfbMs(const Network& n, const std::vector<Expected>& ranks, const PixelCosts& costs)
{
    double inputs = 0;
    Work display;
    bool asksForCredit = false;
    for (const Expected& e : ranks) {
        const bool isDisplay = &e == &ranks.front();
        Work w;
        w.out = static_cast<double>(e.fragments.messages);
        w.outBytes = static_cast<double>(e.fragments.bytes);
        w.in = static_cast<double>(e.inMessages);
        w.inBytes = static_cast<double>(e.inBytes);
        Work& withCredit = isDisplay ? display : w; // which gives most of it to finished tiles
        withCredit.out += static_cast<double>(e.mostCredits);
        withCredit.in += static_cast<double>(e.mostCreditsIn);
        asksForCredit = asksForCredit || e.asksForCredit;
        // Half of it where it is encoded, half where it is blended.
        w.cpu = 1e-3 * costs.dfbNs / 2 * static_cast<double>(e.activePixels + e.inPixels);
        inputs = std::max(inputs, phase(n, w));
        display.in += static_cast<double>(e.finished.messages + e.done.messages);
        display.inBytes += static_cast<double>(e.finished.bytes + e.done.bytes);
    }
    const double hop = n.latency + 2 * n.overhead, levels = std::ceil(std::log2(static_cast<double>(ranks.size())));
    return 1e-3 * (inputs + phase(n, display) + 2 * levels * hop + (asksForCredit ? 2 * hop : 0));
}

// Radix-k as in radix_k.hpp: rows are shared out, viewports are sent without their depth, as the order is known. The
// image goes to rank 0 along a binomial tree.
double radixMs(const Network& n, const std::vector<std::array<int, 4>>& viewports, const std::vector<int>& order,
               int width, int height, int most, const PixelCosts& costs)
{
    using Box = std::array<double, 4>; // x0, y0, x1, y1
    const std::size_t ranks = order.size();
    std::vector<Box> boxes, slices(ranks, Box{0, 0, static_cast<double>(width), static_cast<double>(height)});
    for (const int rank : order) {
        const auto& v = viewports[static_cast<std::size_t>(rank)];
        boxes.push_back({1.0 * v[0], 1.0 * v[1], 1.0 * v[0] + v[2], 1.0 * v[1] + v[3]});
    }
    const auto share = [](Box slice, double i, double k) {
        const double rows = slice[3] - slice[1];
        return Box{slice[0], slice[1] + rows * i / k, slice[2], slice[1] + rows * (i + 1) / k};
    };
    const auto pixelsOf = [](const Box& a, const Box& b) {
        return std::max(0.0, std::min(a[2], b[2]) - std::max(a[0], b[0]))
               * std::max(0.0, std::min(a[3], b[3]) - std::max(a[1], b[1]));
    };
    double us = 0;
    for (std::size_t stride = 1; stride < ranks;) {
        auto k = std::min(static_cast<std::size_t>(most), ranks / stride);
        double slowest = 0;
        std::vector<Box> next(slices);
        for (std::size_t own = 0; own < ranks; ++own) {
            const std::size_t me = own / stride % k, first = own - me * stride;
            const Box mine = share(slices[own], static_cast<double>(me), static_cast<double>(k));
            Work w;
            for (std::size_t i = 0; i < k; ++i) {
                const double in = pixelsOf(boxes[(first + i * stride) / stride], mine);
                const double out =
                    pixelsOf(boxes[own / stride], share(slices[own], static_cast<double>(i), static_cast<double>(k)));
                w.cpu += 1e-3 * costs.plainNs / 2 * (in + out);
                if (i == me)
                    continue;
                w.in += in > 0, w.inBytes += 16 * in;
                w.out += out > 0, w.outBytes += 16 * out;
            }
            slowest = std::max(slowest, phase(n, w));
            next[own] = mine;
        }
        us += slowest;
        slices = std::move(next);
        stride *= k;
        std::vector<Box> joined; // what `stride` ranks next to each other have
        for (std::size_t g = 0; g < boxes.size(); g += k) {
            Box all = boxes[g];
            for (std::size_t i = g + 1; i < g + k; ++i) {
                if (boxes[i][2] <= boxes[i][0])
                    continue;
                all = {std::min(all[0], boxes[i][0]), std::min(all[1], boxes[i][1]), std::max(all[2], boxes[i][2]),
                       std::max(all[3], boxes[i][3])};
            }
            joined.push_back(all);
        }
        boxes = std::move(joined);
    }
    const double levels = std::ceil(std::log2(static_cast<double>(ranks)));
    us += levels * (n.latency + 2 * n.overhead) + n.perByte * bytesPerOutput * width * height;
    return 1e-3 * us;
}

// ---- the program

struct Options {
    std::vector<int> ranks;
    std::vector<std::string> scenes{"bricks", "discs"};
    int width = 0, height = 0, frames = 3;
    bool quick = false, countsOnly = false;
    // As measured between 4 hosts as network namespaces of one machine, 1 Gbit/s, 50 us.
    Network rig{"rig", 53, 14.4, 26, 8.5e-3};
    // Those that the scripts of ATLAHS (github.com/spcl/atlahs) give to LogGOPSim for links of 200 Gbit/s.
    Network hpc{"hpc", 3.7, 0.2, 0.005, 0.04e-3};
    // CPU time of bench_compositing, 4 ranks, bricks, to 8 bit, by the pixels that are worked on: float32, and radix-k.
    PixelCosts costs{4.1, 7};
    std::string json, svg, table, trace, commit;
};

class Bench {
public:
    explicit Bench(Options options) : o_(std::move(options)) {}

    int run()
    {
        for (const std::string& scene : o_.scenes)
            count(scene);
        if (!o_.countsOnly)
            estimate();
        bench::appendJson(o_.json, results_);
        std::printf("\n%s\n", failures_ == 0 ? "All counts are those of the formulas."
                                             : "SOME COUNTS ARE NOT THOSE OF THE FORMULAS.");
        return failures_ == 0 ? 0 : 1;
    }

private:
    template <class Get>
    static std::pair<double, double> medianAndMost(std::size_t count, const Get& get)
    {
        std::vector<double> values;
        for (std::size_t i = 0; i < count; ++i)
            values.push_back(static_cast<double>(get(i)));
        const double most = *std::max_element(values.begin(), values.end());
        return {bench::medianOf(values), most};
    }

    void check(bool fine, int ranks, const std::string& what, std::int64_t measured, std::int64_t expected)
    {
        if (fine)
            return;
        ++failures_;
        std::printf("NOT AS THE FORMULA SAYS: %d ranks, %s: %lld, expected %lld\n", ranks, what.c_str(),
                    static_cast<long long>(measured), static_cast<long long>(expected));
    }

    void checkCounts(int ranks, const Counted& c, const Expected& e, bool isNew)
    {
        const auto same = [&](const char* what, const MessageCount& is, const MessageCount& should) {
            check(is.messages == should.messages, ranks, std::string(what) + ", messages", is.messages,
                  should.messages);
            check(is.bytes == should.bytes, ranks, std::string(what) + ", bytes", is.bytes, should.bytes);
        };
        MessageCount reductions = e.verdict;
        reductions += e.consensus; // it comes in each frame
        same("inputs", c.fragments, e.fragments);
        check(c.finished.messages <= e.finished.messages && c.finished.bytes <= e.finished.bytes, ranks,
              "finished tiles, bytes", c.finished.bytes, e.finished.bytes); // pixels that are alike do not travel
        same("counts of finished tiles", c.done, e.done);
        same("reductions", c.reductions, reductions);
        same("manifests", c.manifests, isNew ? e.manifests : MessageCount());
        same("their answers", c.acks, isNew ? e.acks : MessageCount());
        check(c.credits.messages <= e.mostCredits, ranks, "credit, messages", c.credits.messages, e.mostCredits);
        check(c.poolBytes <= e.poolBytes, ranks, "bytes of the pool", c.poolBytes, e.poolBytes);
    }

    bench::Result resultOf(const std::string& system, const std::string& config, const std::string& scene,
                           int ranks) const
    {
        return {"scaling", system, config, scene, ranks, o_.width, o_.height, o_.commit};
    }

    // Of all ranks in the last frame.
    struct Sums {
        MessageCount all, formula, credits;
        std::int64_t mostCredits = 0;
    };

    Sums checkAll(int ranks, const Measured& m, const std::vector<Expected>& expected)
    {
        Sums sums;
        for (std::size_t r = 0; r < expected.size(); ++r) {
            checkCounts(ranks, m.first[r], expected[r], true);
            checkCounts(ranks, m.last[r], expected[r], false);
            sums.all += m.last[r].all;
            sums.credits += m.last[r].credits;
            Expected e = expected[r];
            e.finished = m.last[r].finished; // of which there is but a bound
            sums.formula += e.everyFrame();
            sums.mostCredits += expected[r].mostCredits;
        }
        // The report of a frame has what was sent before each rank entered the verdict: not the messages of that.
        const std::int64_t unreported = sums.all.messages - 2 * (ranks - 1) - m.report.messagesSent;
        check(unreported >= 0 && unreported <= sums.credits.messages, ranks, "messages that no report has", unreported,
              0);
        return sums;
    }

    void count(const std::string& sceneName)
    {
        bench::Table sent({"ranks", "tiles", "active pixels", "messages", "most", "kB", "most", "off the formulas [%]",
                           "credit, all ranks", "at most", "new bricks: messages", "most", "memory [MB]", "most",
                           "rank 0 takes", "ms"});
        for (const int ranks : o_.ranks)
            countOn(ranks, sceneName, sent);
        print(sent, sceneName + ", " + std::to_string(o_.width) + 'x' + std::to_string(o_.height)
                        + ": what a rank sends in a frame; the median of the ranks, and the rank with most");
    }

    void countOn(int ranks, const std::string& sceneName, bench::Table& table)
    {
        const auto scene = sceneOf(sceneName, ranks, o_.width, o_.height);
        const dfb::TileLayout layout(o_.width, o_.height, tileSize);
        std::vector<bench::PartialImage> images(static_cast<std::size_t>(ranks));
        std::vector<std::vector<Input>> inputs;
        for (int rank = 0; rank < ranks; ++rank) {
            bench::PartialImage& image = images[static_cast<std::size_t>(rank)];
            scene->renderPart(rank, tileSize, image);
            inputs.push_back(inputsOf(image, layout));
        }
        const std::vector<Expected> expected = expectedOf(inputs, layout);
        const Measured m = measure(images, o_.width, o_.height, std::max(2, o_.frames), std::exchange(o_.trace, {}));
        const auto [all, formula, credits, mostCredits] = checkAll(ranks, m, expected);
        const auto text = [](double v) { return bench::text(v); };
        const auto whole = [](double v) { return std::to_string(static_cast<std::int64_t>(v)); };
        const std::size_t n = images.size();
        const auto tiles = medianAndMost(n, [&](std::size_t r) { return expected[r].tiles; });
        const auto pixels = medianAndMost(n, [&](std::size_t r) { return expected[r].activePixels; });
        const auto messages = medianAndMost(n, [&](std::size_t r) { return m.last[r].all.messages; });
        const auto bytes = medianAndMost(n, [&](std::size_t r) { return m.last[r].all.bytes; });
        const auto fresh = medianAndMost(n, [&](std::size_t r) { return m.first[r].all.messages; });
        const auto memory = medianAndMost(n, [&](std::size_t r) { return m.last[r].poolBytes; });
        const double off = 100.0 * static_cast<double>(all.bytes - formula.bytes) / static_cast<double>(formula.bytes);
        bench::Result r = resultOf("dfb", "counted, a frame", sceneName, ranks);
        r.ms = bench::figureOf(m.ms);
        r.cpuMs = bench::figureOf(m.cpuMs);
        r.bytes = static_cast<double>(all.bytes);
        r.messages = static_cast<double>(all.messages);
        r.peakMemoryBytes = memory.second;
        char more[512];
        std::snprintf(more, sizeof more,
                      R"(, "tiles_median": %.0f, "active_pixels_median": %.0f, "messages_median": %.0f, )"
                      R"("messages_max": %.0f, "bytes_median": %.0f, "bytes_max": %.0f, "formula_bytes": %lld, )"
                      R"("credit_messages": %lld, "peak_memory_median": %.0f, "display_messages_in": %lld)",
                      tiles.first, pixels.first, messages.first, messages.second, bytes.first, bytes.second,
                      static_cast<long long>(formula.bytes), static_cast<long long>(credits.messages), memory.first,
                      static_cast<long long>(m.last[0].received.messages));
        r.more = more;
        table.add({std::to_string(ranks), whole(tiles.first), whole(pixels.first), whole(messages.first),
                   whole(messages.second), text(bytes.first / 1e3), text(bytes.second / 1e3), text(off),
                   std::to_string(credits.messages), std::to_string(mostCredits), whole(fresh.first),
                   whole(fresh.second), text(memory.first / 1e6), text(memory.second / 1e6),
                   std::to_string(m.last[0].received.messages), text(r.ms.median)});
        std::fprintf(stderr, "%s, %d ranks: %.1f ms a frame\n", sceneName.c_str(), ranks, r.ms.median);
        results_.push_back(std::move(r));
    }

    void estimate()
    {
        const std::vector<std::string> systems{"dfb", "binary swap", "radix-4", "radix-8"};
        std::vector<bench::PlotLine> lines;
        std::vector<bench::Table> tables;
        const std::vector<Network> networks{o_.rig, o_.hpc};
        for (const Network& network : networks) {
            tables.emplace_back(std::vector<std::string>{"ranks", "dfb [ms]", "binary swap", "radix-4", "radix-8"});
            for (std::size_t i = 0; i < systems.size(); ++i)
                lines.push_back({systems[i] + ", " + network.name, {}, i, network.name == "rig"});
        }
        const dfb::TileLayout layout(o_.width, o_.height, tileSize);
        for (int ranks = 2; ranks <= (o_.quick ? 1024 : 16384); ranks *= 2) {
            const auto scene = sceneOf("bricks", ranks, o_.width, o_.height);
            std::vector<std::vector<Input>> inputs;
            std::vector<std::array<int, 4>> viewports;
            bench::PartialImage image;
            for (int rank = 0; rank < ranks; ++rank) {
                scene->renderPart(rank, tileSize, image);
                inputs.push_back(inputsOf(image, layout));
                viewports.push_back(image.viewport);
            }
            const std::vector<Expected> expected = expectedOf(inputs, layout);
            for (std::size_t n = 0; n < networks.size(); ++n) {
                std::vector<double> ms{dfbMs(networks[n], expected, o_.costs)};
                for (const int most : {2, 4, 8})
                    ms.push_back(radixMs(networks[n], viewports, scene->order(), o_.width, o_.height, most, o_.costs));
                std::vector<std::string> row{std::to_string(ranks)};
                for (std::size_t s = 0; s < systems.size(); ++s) {
                    row.push_back(bench::text(ms[s]));
                    lines[n * systems.size() + s].points.emplace_back(ranks, ms[s]);
                    results_.push_back(resultOf(systems[s], "LogGP, " + networks[n].name, "bricks", ranks));
                    results_.back().ms.median = ms[s];
                }
                tables[n].add(std::move(row));
            }
        }
        for (std::size_t n = 0; n < networks.size(); ++n) {
            char title[256];
            std::snprintf(
                title, sizeof title,
                "LogGP, %s: L %g us, o %g us, g %g us, G %g ns a byte; %.2f and %.2f ns a pixel; bricks, %dx%d",
                networks[n].name.c_str(), networks[n].latency, networks[n].overhead, networks[n].gap,
                1e3 * networks[n].perByte, o_.costs.dfbNs, o_.costs.plainNs, o_.width, o_.height);
            print(tables[n], title);
        }
        if (!o_.svg.empty())
            bench::writePlot(o_.svg, "A frame in the LogGP model, bricks", "ranks", "ms", lines, true);
    }

    void print(const bench::Table& table, const std::string& title) const
    {
        table.print(title);
        table.appendTo(o_.table, title);
    }

    Options o_;
    int failures_ = 0;
    std::vector<bench::Result> results_;
};

// "L,o,g,G"
std::function<bool(const std::string&)> readNetwork(Network& n)
{
    return [&n](const std::string& value) {
        double nsPerByte = 0;
        if (std::sscanf(value.c_str(), "%lf,%lf,%lf,%lf", &n.latency, &n.overhead, &n.gap, &nsPerByte) != 4)
            return false;
        n.perByte = 1e-3 * nsPerByte;
        return true;
    };
}

Options optionsOf(int argc, char** argv)
{
    Options o;
    const auto readScenes = [&](const std::string& value) {
        o.scenes = bench::partsOf(value, ',');
        return std::all_of(o.scenes.begin(), o.scenes.end(),
                           [](const std::string& name) { return name == "bricks" || name == "discs"; });
    };
    const auto readSize = [&](const std::string& value) {
        return bench::readSize(value, o.width, o.height) && o.width % tileSize == 0
               && o.height % tileSize == 0; // so that all tiles are as large
    };
    bench::readOptions(
        argc, argv,
        "usage: bench_scaling [--ranks 2,4,...] [--size WxH, multiples of 64] [--scenes bricks,discs] [--frames N] "
        "[--quick] [--counts-only] [--rig L,o,g,G] [--hpc L,o,g,G] [--pixel-ns DFB,PLAIN] [--json FILE] [--svg FILE] "
        "[--table FILE] "
        "[--trace FILE] [--commit ID]\n"
        "  --counts-only without the estimate\n"
        "  --rig, --hpc  a network of 1 Gbit/s and one of a cluster: latency, overhead and gap of a message in us, "
        "and\n"
        "                ns a byte\n"
        "  --pixel-ns    processor time of an active pixel, in ns, with dfb and with plain loops",
        {{"--ranks", bench::readNumbers(o.ranks, 2, 4096)},
         {"--size", readSize},
         {"--scenes", readScenes},
         {"--frames", bench::readNumber(o.frames, 1)},
         {"--rig", readNetwork(o.rig)},
         {"--hpc", readNetwork(o.hpc)},
         {"--pixel-ns",
          [&o](const std::string& value) {
              return std::sscanf(value.c_str(), "%lf,%lf", &o.costs.dfbNs, &o.costs.plainNs) == 2;
          }},
         {"--json", bench::readText(o.json)},
         {"--svg", bench::readText(o.svg)},
         {"--table", bench::readText(o.table)},
         {"--trace", bench::readText(o.trace)},
         {"--commit", bench::readText(o.commit)}},
        {{"--quick", &o.quick}, {"--counts-only", &o.countsOnly}});
    if (o.ranks.empty())
        o.ranks =
            o.quick ? std::vector<int>{2, 8, 64, 256} : std::vector<int>{2, 4, 8, 16, 32, 64, 128, 256, 512, 1024};
    if (o.width == 0)
        o.width = o.height = o.quick ? 1024 : 2048;
    return o;
}

} // namespace

int main(int argc, char** argv) { return Bench(optionsOf(argc, argv)).run(); }
