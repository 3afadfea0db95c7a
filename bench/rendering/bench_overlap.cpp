// Compositing while others render: each rank ray-marches a brick of 64^3 voxels, for real, and the images become one,
// from several sides. dfb sends tiles as they are finished, IceT composites when all is rendered; and the same
// rendering without any compositing, which both are compared with: on cores that are all busy what is done while others
// render only moves the end of rendering.
//   mpirun -n 4 bench_overlap [--size 512x512,...] [--views 12] [--json FILE] [--table FILE] [--commit ID] [--only
//   TEXT] [--trace FILE] [--in-a-row TIMES]
// --in-a-row: how many frames a second come out where all views follow each other without a pause, with 1, 2 and 3 of
// dfb's frames open at once, so many times in turns. --trace: of single frames, in the last size.
#include "marched_bricks.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <string>
#include <utility>
#include <vector>

namespace {

using bench::Figure;
using bench::MarchedSystem;
using bench::MarchedView;
using bench::Times;

struct Options {
    std::vector<std::array<int, 2>> sizes{{512, 512}};
    int views = 12;
    int inARow = 0; // times that all views are rendered in a row; 0: single frames
    std::string json, table, commit, only, trace;
};

// Of all views, in ms.
struct Row {
    Figure frame, beyond, overhead, cpu, cpuBeyond; // beyond: more than rendering alone takes
};

Row rowOf(const MarchedSystem& s, const MarchedSystem& alone)
{
    const auto figure = [&](const auto& valueOf) {
        std::vector<double> values;
        for (std::size_t v = 0; v < s.times.size(); ++v)
            values.push_back(valueOf(s.times[v], alone.times[v]));
        return bench::figureOf(values);
    };
    return {figure([](const Times& t, const Times&) { return t.image; }),
            figure([](const Times& t, const Times& without) { return t.image - without.image; }),
            figure([](const Times& t, const Times&) { return t.overhead(); }),
            figure([](const Times& t, const Times&) { return t.cpu; }),
            figure([](const Times& t, const Times& without) { return t.cpu - without.cpu; })};
}

// Images of one size.
class Bench {
public:
    Bench(MPI_Comm comm, const Options& o, int width, int height)
        : comm_(comm), o_(o), rank_(bench::rankIn(comm)), ranks_(bench::sizeOf(comm)), width_(width), height_(height)
    {
    }

    void run()
    {
        dfb::FrameBufferConfig config = oneThreadConfig();
        const bench::Trace trace(o_.trace);
        config.trace = trace.sink;
        bench::MarchedBricks bricks(comm_, config, o_.views, false);
        std::vector<MarchedSystem> systems{bricks.alone(), bricks.inOrder("dfb")};
        for (MarchedSystem& peer : peersOf(bricks))
            systems.push_back(std::move(peer));
        systems.erase(
            std::remove_if(systems.begin(), systems.end(),
                           [&](const MarchedSystem& s) { return s.image && !bench::isWanted(s.name, o_.only); }),
            systems.end());
        bench::FrameTimer timer(comm_);
        double largest = 0; // difference of two images
        const auto views = static_cast<std::size_t>(o_.views);
        const std::size_t values = 4 * static_cast<std::size_t>(width_) * static_cast<std::size_t>(height_);
        for (std::size_t v = 0; v <= views; ++v) { // the first touches memory
            takeTurns(timer, systems, v, bricks.views()[v % views]);
            if (systems.size() > 2)
                if (const double d = bench::differenceOf(systems[1].image(), systems.back().image(), values);
                    !(d <= largest))
                    largest = std::isnan(largest) ? largest : d;
        }
        std::vector<std::array<double, 2>> traffic; // bytes and messages, of the last frame
        for (const MarchedSystem& s : systems)
            traffic.push_back(s.traffic ? s.traffic() : std::array<double, 2>{});
        if (rank_ == 0)
            report(systems, traffic, largest);
        bricks.write(trace);
    }

    // All views in a row.
    void runInARow()
    {
        dfb::FrameBufferConfig config = oneThreadConfig();
        std::vector<std::unique_ptr<bench::MarchedBricks>> all;
        std::vector<MarchedSystem> systems;
        for (const int frames : {1, 2, 3}) {
            config.framesInFlight = frames;
            all.push_back(std::make_unique<bench::MarchedBricks>(comm_, config, o_.views, false));
            systems.push_back(all.back()->inFlight("dfb, " + std::to_string(frames) + " in flight"));
        }
        const std::vector<MarchedView>& views = all.front()->views();
        const auto addEachView = [&](const MarchedSystem& one) {
            const auto frame = [one, &views](const MarchedView&) {
                double rendered = 0;
                for (const MarchedView& view : views)
                    rendered = one.frame(view);
                return rendered;
            };
            systems.push_back({one.name, frame, one.image});
        };
        addEachView(all.front()->alone());
        for (const MarchedSystem& peer : peersOf(*all.front()))
            addEachView(peer);
        bench::FrameTimer timer(comm_);
        for (int turn = 0; turn <= o_.inARow; ++turn)
            takeTurns(timer, systems, static_cast<std::size_t>(turn), views.front());
        if (rank_ == 0)
            reportInARow(systems);
    }

private:
    // As IceT has it.
    dfb::FrameBufferConfig oneThreadConfig() const
    {
        dfb::FrameBufferConfig config(width_, height_);
        config.executor = std::make_shared<dfb::CallerExecutor>();
        return config;
    }

    static std::vector<MarchedSystem> peersOf([[maybe_unused]] bench::MarchedBricks& bricks)
    {
        std::vector<MarchedSystem> peers;
#ifdef DFB_BENCH_HAS_ICET
        for (const bench::IceTStrategy& strategy : bench::icetStrategies()) {
            const std::string name = strategy.name;
            if (name == "direct" || name == "sequential, binary swap" || name == "sequential, tree")
                peers.push_back(bricks.icet(strategy));
        }
#endif
        return peers;
    }

    // A frame of each system; another one begins in each turn. The first turn does not count.
    static void takeTurns(bench::FrameTimer& timer, std::vector<MarchedSystem>& systems, std::size_t turn,
                          const MarchedView& view)
    {
        for (std::size_t i = 0; i < systems.size(); ++i) {
            MarchedSystem& s = systems[(i + turn) % systems.size()];
            const Times t = timer.time([&] { return s.frame(view); }, s.image != nullptr);
            if (turn > 0)
                s.times.push_back(t);
        }
    }

    std::string sizeText() const { return std::to_string(width_) + 'x' + std::to_string(height_); }
    std::string titleText() const
    {
        return sizeText() + ", " + std::to_string(ranks_) + " ranks, " + std::to_string(o_.views) + " views";
    }

    bench::Result resultOf(const MarchedSystem& s, const char* what, const Figure& ms, const Figure& cpuMs) const
    {
        const std::string system = s.name.substr(0, s.name.find_first_of(":,"));
        const std::string scene = "64^3 bricks, " + std::to_string(o_.views) + " views";
        return {"bench_overlap", system, s.name + what, scene, ranks_, width_, height_, o_.commit, ms, cpuMs};
    }

    void reportInARow(const std::vector<MarchedSystem>& systems) const
    {
        bench::Table table({"", "frames a second", "ms a frame", "CPU, all ranks [ms a frame]"});
        std::vector<bench::Result> results;
        for (const MarchedSystem& s : systems) {
            std::vector<double> perSecond, ms, cpu;
            for (const Times& t : s.times) {
                perSecond.push_back(1e3 * o_.views / t.image);
                ms.push_back(t.image / o_.views);
                cpu.push_back(t.cpu / o_.views);
            }
            results.push_back(resultOf(s, ", in a row", bench::figureOf(ms), bench::figureOf(cpu)));
            table.add({s.name, bench::text(bench::figureOf(perSecond)), bench::text(results.back().ms),
                       bench::text(results.back().cpuMs)});
        }
        table.print(titleText() + " in a row");
        bench::appendJson(o_.json, results);
    }

    void report(const std::vector<MarchedSystem>& systems, const std::vector<std::array<double, 2>>& traffic,
                double largest) const
    {
        std::vector<Row> rows;
        std::vector<bench::Result> results;
        bench::Table table({"", "frame [ms]", "beyond rendering alone [ms]", "after the slowest had rendered [ms]",
                            "CPU beyond rendering [ms]", "MB", "messages"});
        for (std::size_t i = 0; i < systems.size(); ++i) {
            const MarchedSystem& s = systems[i];
            const Row row = rowOf(s, systems.front());
            rows.push_back(row);
            const auto& [bytes, messages] = traffic[i];
            table.add({s.name, bench::text(row.frame), bench::text(row.beyond), bench::text(row.overhead),
                       bench::text(row.cpuBeyond), bench::text(1e-6 * bytes), bench::text(messages)});
            for (bench::Result r : {resultOf(s, ", frame", row.frame, row.cpu),
                                    resultOf(s, ", beyond rendering", row.beyond, row.cpuBeyond),
                                    resultOf(s, ", overhead", row.overhead, row.cpu)}) {
                r.bytes = bytes;
                r.messages = messages;
                results.push_back(std::move(r));
            }
        }
        std::string title = titleText();
        if (systems.size() > 2)
            title += "; images of " + systems[1].name + " and " + systems.back().name + " differ by "
                     + bench::text("%.2g", largest) + " at most";
        table.print(title);
        bench::appendJson(o_.json, results);
        if (systems.size() > 2 && systems[1].name == "dfb")
            compare(rows);
    }

    // Of dfb, whose row is the second, with the fastest of the peers, whose rows follow.
    void compare(const std::vector<Row>& rows) const
    {
        const Row& mine = rows[1];
        const Row& peer = *std::min_element(rows.begin() + 2, rows.end(),
                                            [](const Row& a, const Row& b) { return a.frame.median < b.frame.median; });
        const std::string line = "| " + sizeText() + " | " + std::to_string(ranks_) + " | " + bench::text(rows[0].frame)
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
    const Options& o_;
    int rank_, ranks_, width_, height_;
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
         {"--views", bench::readNumber(o.views, 1)},
         {"--in-a-row", bench::readNumber(o.inARow, 1)},
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
        for (const auto& [width, height] : options.sizes) {
            Bench bench(comm, options, width, height);
            options.inARow > 0 ? bench.runInARow() : bench.run();
        }
    });
}
