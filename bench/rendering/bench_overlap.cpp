// Compositing while others render: each rank ray-marches a brick of 64^3 voxels, for real, and the images become one,
// from several sides. dfb sends tiles as they are finished, IceT composites when all is rendered; and the same
// rendering without any compositing, which both are compared with: on cores that are all busy what is done while others
// render only moves the end of rendering.
//   mpirun -n 4 bench_overlap [--size 512x512,...] [--views 12] [--json FILE] [--table FILE] [--commit ID] [--only
//   TEXT] [--trace FILE] [--in-a-row TIMES]
// --in-a-row: how many frames a second come out where all views follow each other without a pause, with 1, 2 and 3 of
// dfb's frames open at once, so many times in turns. --trace: of single frames, in the last size.
#include "marched_bricks.hpp"

#include <array>
#include <cmath>
#include <cstdlib>
#include <memory>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

namespace {

using bench::Figure;
using bench::MarchedSystem;

struct Options {
    std::vector<std::array<int, 2>> sizes{{512, 512}};
    int views = 12;
    int inARow = 0; // times that all views are rendered in a row; 0: single frames
    std::string json, table, commit, only, trace;
};

class Bench {
public:
    Bench(MPI_Comm comm, Options o)
        : comm_(comm), o_(std::move(o)), rank_(bench::rankIn(comm)), size_(bench::sizeOf(comm))
    {
    }

    void run(int width, int height)
    {
        dfb::FrameBufferConfig config(width, height);
        config.executor = std::make_shared<dfb::CallerExecutor>(); // one thread per rank, as IceT has
        const bench::Trace trace(o_.trace);
        config.trace = trace.sink;
        bench::MarchedBricks bricks(comm_, config, o_.views, false);
        std::vector<MarchedSystem> systems{bricks.alone(), bricks.inOrder("dfb")};
#ifdef DFB_BENCH_HAS_ICET
        for (const bench::IceTStrategy& strategy : bench::icetStrategies()) {
            const std::string name = strategy.name;
            if (name == "direct" || name == "sequential, binary swap" || name == "sequential, tree")
                systems.push_back(bricks.icet(strategy));
        }
#endif
        systems.erase(
            std::remove_if(systems.begin(), systems.end(),
                           [&](const MarchedSystem& s) { return s.image && !bench::isWanted(s.name, o_.only); }),
            systems.end());
        bench::FrameTimer timer(comm_);
        double largest = 0; // difference of two images
        const auto views = static_cast<std::size_t>(o_.views);
        for (std::size_t v = 0; v <= views; ++v) { // the first touches memory
            const bench::MarchedView& view = bricks.views()[v % views];
            for (std::size_t i = 0; i < systems.size(); ++i) {
                MarchedSystem& s = systems[(i + v) % systems.size()];
                const bench::Times t = timer.time([&] { return s.frame(view); }, s.image != nullptr);
                if (v > 0)
                    s.times.push_back(t);
            }
            const float *ours = systems.size() > 2 ? systems[1].image() : nullptr,
                        *theirs = systems.size() > 2 ? systems.back().image() : nullptr;
            const std::size_t values = 4 * static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
            for (std::size_t i = 0; ours && theirs && i < values; ++i)
                largest = std::max(largest, std::abs(static_cast<double>(ours[i]) - static_cast<double>(theirs[i])));
        }
        std::vector<std::array<double, 2>> traffic; // bytes and messages, of the last frame
        for (const MarchedSystem& s : systems)
            traffic.push_back(s.traffic ? s.traffic() : std::array<double, 2>{});
        report(systems, traffic, width, height, largest);
        bricks.write(trace);
    }

    // All views in a row.
    void runInARow(int width, int height)
    {
        dfb::FrameBufferConfig config(width, height);
        config.executor = std::make_shared<dfb::CallerExecutor>();
        std::vector<std::unique_ptr<bench::MarchedBricks>> all;
        std::vector<MarchedSystem> systems;
        for (const int frames : {1, 2, 3}) {
            config.framesInFlight = frames;
            all.push_back(std::make_unique<bench::MarchedBricks>(comm_, config, o_.views, false));
            systems.push_back(all.back()->inFlight("dfb, " + std::to_string(frames) + " in flight"));
        }
        const std::vector<bench::MarchedView>& views = all.front()->views();
        const auto eachView = [&views](const MarchedSystem& one) {
            return MarchedSystem{one.name,
                                 [one, &views](const bench::MarchedView&) {
                                     double rendered = 0;
                                     for (const bench::MarchedView& view : views)
                                         rendered = one.frame(view);
                                     return rendered;
                                 },
                                 one.image};
        };
        systems.push_back(eachView(all.front()->alone()));
#ifdef DFB_BENCH_HAS_ICET
        for (const bench::IceTStrategy& strategy : bench::icetStrategies()) {
            const std::string name = strategy.name;
            if (name == "direct" || name == "sequential, binary swap" || name == "sequential, tree")
                systems.push_back(eachView(all.front()->icet(strategy)));
        }
#endif
        bench::FrameTimer timer(comm_);
        for (int turn = 0; turn <= o_.inARow; ++turn)
            for (std::size_t i = 0; i < systems.size(); ++i) {
                MarchedSystem& s = systems[(i + static_cast<std::size_t>(turn)) % systems.size()];
                const bench::Times t = timer.time([&] { return s.frame(views.front()); }, s.image != nullptr);
                if (turn > 0)
                    s.times.push_back(t);
            }
        if (rank_ != 0)
            return;
        bench::Table table({"", "frames a second", "ms a frame", "CPU, all ranks [ms a frame]"});
        std::vector<bench::Result> results;
        for (const MarchedSystem& s : systems) {
            std::vector<double> perSecond, ms, cpu;
            for (const bench::Times& t : s.times) {
                perSecond.push_back(1e3 * o_.views / t.image);
                ms.push_back(t.image / o_.views);
                cpu.push_back(t.cpu / o_.views);
            }
            bench::Result r;
            r.bench = "bench_overlap";
            r.system = s.name.substr(0, s.name.find_first_of(":,"));
            r.config = s.name + ", in a row";
            r.scene = "64^3 bricks, " + std::to_string(o_.views) + " views";
            r.ranks = size_;
            r.width = width;
            r.height = height;
            r.commit = o_.commit;
            r.ms = bench::figureOf(ms);
            r.cpuMs = bench::figureOf(cpu);
            results.push_back(r);
            table.add({s.name, bench::text(bench::figureOf(perSecond)), bench::text(r.ms), bench::text(r.cpuMs)});
        }
        const std::string title = std::to_string(width) + 'x' + std::to_string(height) + ", " + std::to_string(size_)
                                  + " ranks, " + std::to_string(o_.views) + " views in a row";
        table.print(title);
        bench::appendJson(o_.json, results);
    }

private:
    void report(const std::vector<MarchedSystem>& systems, const std::vector<std::array<double, 2>>& traffic, int width,
                int height, double largest) const
    {
        if (rank_ != 0)
            return;
        const auto figure = [](const MarchedSystem& s, const auto& valueOf) {
            std::vector<double> values;
            for (std::size_t v = 0; v < s.times.size(); ++v)
                values.push_back(valueOf(v));
            return bench::figureOf(values);
        };
        const MarchedSystem& alone = systems.front();
        struct Row {
            Figure frame, beyond, overhead, cpu, cpuBeyond;
        };
        std::vector<Row> rows;
        std::vector<bench::Result> results;
        bench::Table table({"", "frame [ms]", "beyond rendering alone [ms]", "after the slowest had rendered [ms]",
                            "CPU beyond rendering [ms]", "MB", "messages"});
        for (std::size_t i = 0; i < systems.size(); ++i) {
            const MarchedSystem& s = systems[i];
            rows.push_back({figure(s, [&](std::size_t v) { return s.times[v].image; }),
                            figure(s, [&](std::size_t v) { return s.times[v].image - alone.times[v].image; }),
                            figure(s, [&](std::size_t v) { return s.times[v].overhead(); }),
                            figure(s, [&](std::size_t v) { return s.times[v].cpu; }),
                            figure(s, [&](std::size_t v) { return s.times[v].cpu - alone.times[v].cpu; })});
            const Row& row = rows.back();
            const auto& [bytes, messages] = traffic[i];
            table.add({s.name, bench::text(row.frame), bench::text(row.beyond), bench::text(row.overhead),
                       bench::text(row.cpuBeyond), bench::text(1e-6 * bytes), bench::text(messages)});
            bench::Result r;
            r.bench = "bench_overlap";
            r.system = s.name.substr(0, s.name.find(':'));
            r.scene = "64^3 bricks, " + std::to_string(o_.views) + " views";
            r.ranks = size_;
            r.width = width;
            r.height = height;
            r.commit = o_.commit;
            r.bytes = bytes;
            r.messages = messages;
            const std::tuple<const char*, const Figure*, const Figure*> parts[] = {
                {", frame", &row.frame, &row.cpu},
                {", beyond rendering", &row.beyond, &row.cpuBeyond},
                {", overhead", &row.overhead, &row.cpu}};
            for (const auto& [part, ms, cpu] : parts) {
                r.config = s.name + part;
                r.ms = *ms;
                r.cpuMs = *cpu;
                results.push_back(r);
            }
        }
        const std::string size = std::to_string(width) + 'x' + std::to_string(height);
        std::string title = size + ", " + std::to_string(size_) + " ranks, " + std::to_string(o_.views) + " views";
        if (systems.size() > 2)
            title += "; images of " + systems[1].name + " and " + systems.back().name + " differ by "
                     + bench::text("%.2g", largest) + " at most";
        table.print(title);
        bench::appendJson(o_.json, results);
        std::size_t best = 0; // of the peer's
        for (std::size_t i = 2; i < rows.size(); ++i)
            if (best == 0 || rows[i].frame.median < rows[best].frame.median)
                best = i;
        if (best == 0 || systems[1].name != "dfb")
            return;
        const Row &mine = rows[1], &peer = rows[best];
        const std::string line = "| " + size + " | " + std::to_string(size_) + " | " + bench::text(rows[0].frame)
                                 + " | " + bench::text(mine.frame) + " | " + bench::text(peer.frame) + " | "
                                 + bench::text(mine.frame.median / peer.frame.median) + " | " + bench::text(mine.beyond)
                                 + " | " + bench::text(peer.beyond) + " | "
                                 + bench::text(mine.beyond.median / peer.beyond.median) + " | "
                                 + bench::text(mine.overhead) + " | " + bench::text(peer.overhead) + " | "
                                 + bench::text(mine.cpuBeyond) + " | " + bench::text(peer.cpuBeyond) + " |\n";
        const char* head = "| size | ranks | rendering alone [ms] | dfb [ms] | best IceT [ms] | ratio | dfb beyond "
                           "rendering | IceT beyond | ratio | dfb after rendering | IceT after | dfb CPU beyond "
                           "rendering | IceT CPU beyond |\n"
                           "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n";
        std::printf("\n%s%s", head, line.c_str());
        bench::appendTo(o_.table, (bench::hasTable(o_.table) ? "" : head) + line);
    }

    MPI_Comm comm_;
    Options o_;
    int rank_, size_;
};

// Ends the program after --help, or if it was called wrongly.
Options optionsOf(int argc, char** argv)
{
    Options o;
    bench::readOptions(
        argc, argv,
        "usage: mpirun -n RANKS bench_overlap [--size WxH,...] [--views N] [--json FILE] [--table FILE] "
        "[--commit ID] [--only TEXT] [--trace FILE] [--in-a-row TIMES]\n"
        "  --only TEXT       only systems whose name has TEXT; several texts with | between them\n"
        "  --in-a-row TIMES  renders all views so often without a pause, and gives the frames per second, of all "
        "systems;\n"
        "                    --table and --trace have no effect then\n"
        "  --commit ID       is written to the JSON file",
        {{"--size", bench::readSizes(o.sizes)},
         {"--views", [&o](const std::string& value) { return (o.views = std::atoi(value.c_str())) > 0; }},
         {"--in-a-row", [&o](const std::string& value) { return (o.inARow = std::atoi(value.c_str())) > 0; }},
         {"--json", bench::readText(o.json)},
         {"--table", bench::readText(o.table)},
         {"--trace", bench::readText(o.trace)},
         {"--commit", bench::readText(o.commit)},
         {"--only", bench::readText(o.only)}});
    return o;
}

} // namespace

int main(int argc, char** argv)
{
    const Options options = optionsOf(argc, argv);
    bench::withMpi(argc, argv, [&](MPI_Comm comm) {
        Bench bench(comm, options);
        for (const auto& [width, height] : options.sizes)
            options.inARow > 0 ? bench.runInARow(width, height) : bench.run(width, height);
    });
}
