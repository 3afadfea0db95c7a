// Compositing alone: partial images that are ready, in scenes from nothing on any rank to everything on all of them,
// are made one image by dfb, by IceT and by plain loops, frame by frame in turn.
//   mpirun -n 4 bench_compositing [--scene bricks,overlap,dense,one,empty|all] [--size 1024x1024,...] [--frames 21]
//   [--systems dfb,icet,plain] [--moving] [--reader] [--only TEXT] [--json FILE] [--table FILE] [--commit ID]
//   [--trace FILE]
// --moving: each frame is seen from another side than the one before. --reader: rank 0 reads the image within the
// clock. --trace: of dfb's first system, in the last scene and size.
#include "scenes.hpp"
#include "systems.hpp"

#include <algorithm>
#include <array>
#include <fstream>
#include <functional>
#include <iterator>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#if defined(__GLIBC__)
#include <malloc.h>
#endif

namespace {

using bench::Inputs;
using bench::Result;
using bench::System;

struct Options {
    std::vector<std::string> scenes{"bricks"}, systems{"dfb", "icet", "plain"};
    std::vector<std::array<int, 2>> sizes{{1024, 1024}};
    int frames = 21;
    bool isMoving = false, isReadInside = false;
    std::string json, table, commit, trace;
    std::string only; // the systems whose name and configuration have one of these, with | between

    bool wants(const std::string& system) const
    {
        return std::find(systems.begin(), systems.end(), system) != systems.end();
    }
};

void addAllDfb(std::vector<System>& systems, const Inputs& inputs)
{
    using dfb::ImageBlend, dfb::WireFormat;
    const auto own = bench::connectBy(inputs.comm, false);
    const auto add = [&](const std::string& config, ImageBlend blend, const bench::DfbSettings& settings) {
        bench::addImages(systems, own, inputs, config, blend, settings);
    };
    const auto addOrdered = [&](const std::string& config, const bench::DfbSettings& settings) {
        add("in order, " + config, ImageBlend::InOrder, settings);
    };
    bench::DfbSettings shared, bytes, sharedBytes, threads, defaults, told;
    shared.isShared = sharedBytes.isShared = true;
    bytes.hasBytes = sharedBytes.hasBytes = true;
    threads.hasThreads = true;
    defaults.hasDefaultThreads = true;
    told.isToldOrder = true;
    addOrdered("float32", {});
    addOrdered("float32, all in place", shared);
    addOrdered("bytes", bytes);
    addOrdered("bytes, all in place", sharedBytes);
    add("float32", ImageBlend::ByDepth, {});
    add("float32, all in place", ImageBlend::ByDepth, shared);
    const auto withDefaults = bench::connectBy(inputs.comm);
    bench::addImages(systems, withDefaults, inputs, bench::defaultConfig, ImageBlend::ByDepth, defaults);
    bench::addImages(systems, bench::connectBy(inputs.comm, true), inputs, "in order, float32, threads of its own",
                     ImageBlend::InOrder, threads);
    addOrdered("within half a level", {dfb::HalfLevel{}});
    addOrdered("unorm16", {WireFormat::Unorm16});
    addOrdered("unorm8", {WireFormat::Unorm8});
#if defined(DFB_HAS_SNAPPY)
    const auto snappy = std::make_shared<dfb::SnappyCodec>();
    bench::DfbSettings packedBytes = bytes;
    packedBytes.codec = snappy;
    addOrdered("float32, snappy", {WireFormat::Float32, snappy});
    addOrdered("within half a level, snappy", {dfb::HalfLevel{}, snappy});
    addOrdered("bytes, snappy", packedBytes);
    addOrdered("float32, snappy if faster", {WireFormat::Float32, snappy, 0, dfb::CompressionMode::Auto});
#endif
    bench::addDfb<dfb::OrderedBlend>(systems, own, inputs, "tiles of 64, in order, float32", {});
    bench::addDfb<dfb::AlphaBlend>(systems, own, inputs, "tiles of 64, float32", {});
    bench::addDfb<dfb::AlphaBlend>(systems, own, inputs, "tiles of 64, float32, order told", told);
    bench::addDfb<dfb::AlphaBlend>(systems, withDefaults, inputs, "tiles of 64, float32, default threads", defaults);
}

void addAllPlain(std::vector<System>& systems, const Inputs& inputs)
{
    if (inputs.isMoving())
        return;
    const auto ranks = static_cast<int>(inputs.order().size());
    bench::addDirectSend(systems, inputs);
    const std::vector<int> twos = bench::RadixK::factorsOf(ranks, 2), fours = bench::RadixK::factorsOf(ranks, 4);
    const bool canSwap = std::all_of(twos.begin(), twos.end(), [](int factor) { return factor == 2; });
    if (canSwap)
        bench::addRadixK(systems, inputs, "binary swap", twos);
    if (!canSwap || fours != twos) // else it is the same
        bench::addRadixK(systems, inputs, "radix-k", fours);
}

// ---- memory: all ranks are taken to be on one node, as they are where these figures matter

// About what systems allocate on all ranks together, in bytes: measured at 8 and 16 ranks, rounded up.
class MemoryNeeds {
public:
    explicit MemoryNeeds(const Inputs& inputs)
        : image_(static_cast<double>(inputs.image().depth.size())),
          all_(image_ * static_cast<double>(inputs.viewports().size())),
          views_(static_cast<double>(inputs.views.size()))
    {
        for (const auto& v : inputs.viewports())
            used_ += static_cast<double>(v[2]) * v[3];
    }

    double of(const std::vector<System>& systems) const
    {
        double sum = 0;
        bool hasDfb = false;
        for (const System& s : systems) {
            const auto has = [&](const char* text) { return s.config.find(text) != std::string::npos; };
            hasDfb = hasDfb || s.name == "dfb";
            sum += s.copied * views_ * all_;
            if (s.name == "limit")
                sum += 16 * image_ * views_;
            else if (s.name == "dfb")
                sum += 4 * used_ + 16 * image_;
            else if (s.name == "plain")
                sum += 33 * used_ + 8 * all_ + 20 * image_;
            else
                sum += (has("direct") ? 20 : has("tree") ? 35 : 60) * used_ * (has("ubyte") ? 0.3 : 1) + 10 * all_;
        }
        return sum + (hasDfb ? 24 * used_ : 0); // messages
    }

private:
    double image_, all_, views_, used_ = 0; // pixels of the image, of all ranks' images, and of their viewports; views
};

// In bytes; as good as infinite where the system does not say.
double freeMemory()
{
    std::ifstream file("/proc/meminfo");
    for (std::string line; std::getline(file, line);)
        if (double kibibytes = 0; std::sscanf(line.c_str(), "MemAvailable: %lf", &kibibytes) == 1)
            return 1024 * kibibytes;
    return 1e18;
}

// What was freed is the system's again; malloc would keep it, and the next group has to fit beside it.
void giveBackMemory()
{
#if defined(__GLIBC__)
    malloc_trim(0);
#endif
}

// ---- the best of each kind, and how they compare

const Result* fastestOf(const std::vector<Result>& results, const std::function<bool(const Result&)>& isOfKind)
{
    const Result* fastest = nullptr;
    for (const Result& r : results)
        if (isOfKind(r) && (!fastest || r.ms.median < fastest->ms.median))
            fastest = &r;
    return fastest;
}

// Of results for one output. Null where there is none.
struct Best {
    // `hasAllRows`: whether the levels are those of all rows. If not, a row that rounds might be farther off elsewhere.
    Best(const std::vector<Result>& results, bool hasAllRows)
        : exact(
            fastestOf(results, [](const Result& r) { return isDfb(r) && has(r, nameOf(dfb::WireFormat::Float32)); })),
          defaults(fastestOf(results, bench::hasDefaults)),
          oneLevel(fastestOf(results,
                             [hasAllRows](const Result& r) {
                                 const bool isSure = has(r, nameOf(dfb::WireFormat::Float32)) || has(r, "half a level");
                                 return isDfb(r) && r.levels <= 1 && (hasAllRows || isSure);
                             })),
          limit(fastestOf(results, [](const Result& r) { return r.system == "limit"; })),
          icetFloat(fastestOf(results, [](const Result& r) { return r.system == "icet" && has(r, "float, "); })),
          icetUbyte(fastestOf(results, [](const Result& r) { return r.system == "icet" && has(r, "ubyte, "); }))
    {
    }
    static bool isDfb(const Result& r) { return r.system == "dfb"; }
    static bool has(const Result& r, const char* text) { return r.config.find(text) != std::string::npos; }

    const Result* exact;    // of dfb, whose inputs travel as float32
    const Result* defaults; // of dfb, whose user has set nothing
    const Result* oneLevel; // of dfb, with 8-bit values that are off by one at most
    const Result* limit;    // what reading and writing memory once take
    const Result *icetFloat, *icetUbyte;
};

// Median and quartiles.
std::string timeText(const Result* r)
{
    return r ? bench::text(r->ms.median) + " (" + bench::text(r->ms.low) + " to " + bench::text(r->ms.high) + ")" : "-";
}

// Of time, CPU time without yields, and bytes.
std::string ratios(const Result* a, const Result* b)
{
    if (!a || !b)
        return "-";
    const auto ratio = [](double x, double y) { return y > 0 ? bench::text(x / y) : std::string("-"); };
    return ratio(a->ms.median, b->ms.median) + ", " + ratio(a->workMs(), b->workMs()) + ", "
           + ratio(a->bytes, b->bytes);
}

class Bench {
public:
    Bench(MPI_Comm comm, Options o)
        : comm_(comm), o_(std::move(o)), rank_(bench::rankIn(comm)), size_(bench::sizeOf(comm))
    {
#ifndef DFB_BENCH_HAS_ICET
        if (rank_ == 0 && o_.wants("icet"))
            std::printf("IceT is not measured: this was built without it (bench/get_icet.sh gets it)\n");
#endif
    }

    void run(const std::string& sceneName, int width, int height)
    {
        const auto scene = bench::makeScene(sceneName, size_, width, height);
        Inputs inputs(comm_, *scene, rank_);
        inputs.isReadInside = o_.isReadInside;
        inputs.trace = o_.trace;
        for (int i = 1; o_.isMoving && i < 4; ++i)
            inputs.views.emplace_back(comm_, *bench::makeScene(sceneName, size_, width, height, 0.15 * i), rank_);
        bench::ExactImage exact;
        exact.rowStep = rowStepOf(width, height);
        if (rank_ == 0)
            exact = scene->exact(exact.rowStep);
        bench::meet(comm_);
        std::vector<System> systems;
        if (o_.wants("dfb"))
            addAllDfb(systems, inputs);
        if (o_.wants("plain"))
            addAllPlain(systems, inputs);
#ifdef DFB_BENCH_HAS_ICET
        if (o_.wants("icet"))
            bench::addIceT(systems, inputs);
#endif
        bench::addMemoryLimit(systems, inputs);
        bench::keepWanted(systems, o_.only);
        systems = measure(std::move(systems), inputs, exact);
        bench::takeErrorsOfFloats(systems);
        if (rank_ != 0)
            return;
        std::vector<Result> all, floats, bytes;
        for (System& s : systems) {
            s.result.bench = "bench_compositing";
            s.result.scene = sceneName + (o_.isMoving ? ", moving" : "") + (o_.isReadInside ? ", read" : "");
            s.result.width = width;
            s.result.height = height;
            s.result.commit = o_.commit;
            all.push_back(s.result);
            (s.isFloat() ? floats : bytes).push_back(s.result);
        }
        bench::appendJson(o_.json, all);
        report(std::move(floats), "float", exact.rowStep);
        report(std::move(bytes), "8 bit", exact.rowStep);
    }

private:
    // Errors are taken of about a million pixels. An odd step meets all rows of the tiles.
    static int rowStepOf(int width, int height)
    {
        const std::int64_t pixels = std::int64_t{width} * height, most = std::int64_t{1} << 20;
        return pixels <= most ? 1 : static_cast<int>((pixels + most - 1) / most) | 1;
    }

    // All in turns, if they have room in memory together; else some after the others. Returns those that were measured.
    std::vector<System> measure(std::vector<System> systems, Inputs& inputs, const bench::ExactImage& exact) const
    {
        const MemoryNeeds needs(inputs);
        const double room = 0.7 * bench::reduce(comm_, freeMemory(), MPI_MIN);
        std::vector<std::vector<System>> groups(1);
        for (System& s : systems) {
            std::vector<System>& group = groups.back();
            group.push_back(std::move(s));
            if (needs.of(group) <= room)
                continue;
            std::vector<System> next;
            next.push_back(std::move(group.back()));
            group.pop_back();
            if (needs.of(next) > room) {
                if (rank_ == 0)
                    std::printf("\nNOT MEASURED, as it may need %.1f GB, and there are %.1f: %s\n",
                                needs.of(next) / 1e9, room / 1e9, next.back().title().c_str());
            } else {
                groups.push_back(std::move(next));
            }
        }
        if (groups.size() > 1 && rank_ == 0)
            std::printf("\nThe systems have no room in memory together (%.1f GB): they are measured in %zu groups, in "
                        "turns only within each\n",
                        room / 1e9, groups.size());
        std::vector<System> measured;
        for (std::vector<System>& group : groups) {
            bench::measureInTurns(inputs, group, o_.frames, exact);
            giveBackMemory();
            std::move(group.begin(), group.end(), std::back_inserter(measured));
        }
        return measured;
    }

    void report(std::vector<Result> results, const std::string& output, int rowStep) const
    {
        if (results.empty())
            return;
        std::sort(results.begin(), results.end(),
                  [](const Result& a, const Result& b) { return a.ms.median < b.ms.median; });
        const Result& first = results.front();
        const std::string size = std::to_string(first.width) + 'x' + std::to_string(first.height);
        std::string title = first.scene + ", " + size + ", " + std::to_string(size_) + " ranks, to " + output;
        if (rowStep > 1)
            title += "; errors are those of every " + std::to_string(rowStep) + "th row";
        bench::Table table({"", "ms", "CPU ms", "yields", "MB sent", "messages", "max error", "RMSE", "levels off"});
        for (const Result& r : results) {
            table.add({r.system + ": " + r.config, bench::text(r.ms), bench::text(r.cpuMs),
                       bench::text(r.yieldMs.median), bench::text("%.2f", r.bytes / 1e6),
                       bench::text("%.0f", r.messages), bench::text("%.2g", r.maxError), bench::text("%.2g", r.rmse),
                       std::to_string(r.levels)});
        }
        table.print(title);

        const Best best(results, rowStep == 1);
        std::printf(
            "\n%s: ms: dfb float32 %s, defaults %s, within a level %s, IceT float %s, ubyte %s; ratios of time, CPU "
            "time, bytes: dfb float32 to IceT float %s, to ubyte %s; dfb within a level to IceT float %s, to "
            "ubyte %s\n",
            title.c_str(), timeText(best.exact).c_str(), timeText(best.defaults).c_str(),
            timeText(best.oneLevel).c_str(), timeText(best.icetFloat).c_str(), timeText(best.icetUbyte).c_str(),
            ratios(best.exact, best.icetFloat).c_str(), ratios(best.exact, best.icetUbyte).c_str(),
            ratios(best.oneLevel, best.icetFloat).c_str(), ratios(best.oneLevel, best.icetUbyte).c_str());
        std::fflush(stdout);
        if (!o_.table.empty())
            addToTable(best, {first.scene, size, std::to_string(size_), output});
    }

    // With a head, if the file has no table yet.
    void addToTable(const Best& best, const std::array<std::string, 4>& what) const
    {
        std::string lines;
        if (!bench::hasTable(o_.table))
            lines = "| scene | size | ranks | to | memory alone [ms] | dfb float32 [ms] | dfb defaults [ms] | dfb "
                    "within a level [ms] | "
                    "IceT float [ms] "
                    "| IceT ubyte [ms] | dfb float32 : IceT float | : ubyte | dfb within a level : IceT float "
                    "| : ubyte |\n|---|---|--:|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n";
        for (const std::string& text : what)
            lines += "| " + text + ' ';
        for (const Result* r : {best.limit, best.exact, best.defaults, best.oneLevel, best.icetFloat, best.icetUbyte})
            lines += "| " + timeText(r) + ' ';
        for (const Result* mine : {best.exact, best.oneLevel})
            for (const Result* peer : {best.icetFloat, best.icetUbyte})
                lines += "| " + ratios(mine, peer) + ' ';
        bench::appendTo(o_.table, lines + "|\n");
    }

    MPI_Comm comm_;
    Options o_;
    int rank_, size_;
};

// Ends the program after --help, or if it was called wrongly.
Options optionsOf(int argc, char** argv)
{
    Options o;
    const auto isOneOf = [](const std::vector<std::string>& some, const std::vector<std::string>& all) {
        return !some.empty() && std::all_of(some.begin(), some.end(), [&](const std::string& name) {
            return std::find(all.begin(), all.end(), name) != all.end();
        });
    };
    const auto readScenes = [&](const std::string& value) {
        o.scenes = value == "all" ? bench::sceneNames() : bench::partsOf(value, ',');
        return isOneOf(o.scenes, bench::sceneNames());
    };
    const auto readSystems = [&](const std::string& value) {
        o.systems = bench::partsOf(value, ',');
        return isOneOf(o.systems, Options().systems);
    };
    bench::readOptions(
        argc, argv,
        "usage: mpirun -n RANKS bench_compositing [--scene bricks,overlap,dense,one,empty|all] [--size WxH,...] "
        "[--frames N] [--systems dfb,icet,plain] [--moving] [--reader] [--only TEXT] [--json FILE] [--table FILE] "
        "[--commit ID] [--trace FILE]\n"
        "  --moving     each frame is seen from another side\n"
        "  --reader     a rank reads the image within the time that is measured\n"
        "  --only TEXT  only systems whose title has TEXT; several texts with | between them\n"
        "  --commit ID  is written to the JSON file",
        {{"--scene", readScenes},
         {"--size", bench::readSizes(o.sizes)},
         {"--systems", readSystems},
         {"--frames", bench::readNumber(o.frames, 1)},
         {"--only", bench::readText(o.only)},
         {"--json", bench::readText(o.json)},
         {"--table", bench::readText(o.table)},
         {"--trace", bench::readText(o.trace)},
         {"--commit", bench::readText(o.commit)}},
        {{"--moving", &o.isMoving}, {"--reader", &o.isReadInside}});
    return o;
}

} // namespace

int main(int argc, char** argv)
{
    const Options options = optionsOf(argc, argv);
    bench::withMpi(argc, argv, [&](MPI_Comm comm) {
        Bench bench(comm, options);
        for (const auto& [width, height] : options.sizes)
            for (const std::string& scene : options.scenes)
                bench.run(scene, width, height);
    });
}
