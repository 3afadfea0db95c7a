// Compositing while others render: each rank ray-marches a brick of 64^3 voxels, for real, and the images become one,
// from several sides. dfb sends tiles as they are finished, IceT composites when all is rendered; and the same
// rendering without any compositing, which both are compared with: on cores that are all busy what is done while others
// render only moves the end of rendering.
//   mpirun -n 4 bench_overlap [--size 512x512,...] [--views 12] [--json FILE] [--table FILE] [--commit ID] [--only
//   TEXT]
#include "systems.hpp"

#include <dfb/dfb.hpp>

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <fstream>
#include <functional>
#include <limits>
#include <memory>
#include <string>
#include <utility>
#include <vector>

namespace {

using bench::Figure;
using dfb::Region;
using dfb::Vec3;
using FrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicOrderedBlend<64>>;

constexpr int voxels = 64; // along each side of a brick, which has length 1

struct Options {
    std::vector<std::array<int, 2>> sizes{{512, 512}};
    int views = 12;
    std::string json, table, commit, only;
};

// A cube of bricks, one a rank, as near to a cube as their number allows.
struct Grid {
    explicit Grid(int ranks)
    {
        for (int left = ranks, axis = 0; left > 1; axis = (axis + 1) % 3) {
            int factor = 2;
            while (left % factor != 0)
                ++factor;
            cells[static_cast<std::size_t>(axis)] *= factor;
            left /= factor;
        }
    }
    dfb::Box3 box(int rank) const
    {
        const Vec3 lower{static_cast<float>(rank % cells[0]), static_cast<float>(rank / cells[0] % cells[1]),
                         static_cast<float>(rank / (cells[0] * cells[1]))};
        return {lower, lower + Vec3{1, 1, 1}};
    }
    Vec3 size() const
    {
        return {static_cast<float>(cells[0]), static_cast<float>(cells[1]), static_cast<float>(cells[2])};
    }

    std::array<int, 3> cells{1, 1, 1};
};

// A turbulent field, the same whoever makes which part of it.
float field(const Vec3& p)
{
    float sum = 0, weight = 0.5f, frequency = 3;
    for (int octave = 0; octave < 4; ++octave, weight *= 0.6f, frequency *= 2.1f)
        sum += weight * std::sin(frequency * p.x + 1.3f * std::sin(frequency * p.y))
               * std::cos(frequency * p.z + 0.7f * std::sin(frequency * p.x));
    return sum;
}

class Marcher {
public:
    explicit Marcher(const dfb::Box3& box) : box_(box), values_((voxels + 1) * (voxels + 1) * (voxels + 1))
    {
        std::size_t i = 0;
        for (int z = 0; z <= voxels; ++z)
            for (int y = 0; y <= voxels; ++y)
                for (int x = 0; x <= voxels; ++x)
                    values_[i++] = field(box.lower
                                         + Vec3{static_cast<float>(x) / voxels, static_cast<float>(y) / voxels,
                                                static_cast<float>(z) / voxels});
    }

    // Pixel (x, y) of the image: premultiplied RGBA. Not inlined, so that all run the same code: where it was, it
    // differed by a tenth in time.
#if defined(__GNUC__)
    __attribute__((noinline))
#endif
    void
    shade(const dfb::PerspectiveCamera& camera, int x, int y, int width, int height, float* rgba) const
    {
        const Vec3 eye = camera.eye(), d = camera.direction(x + 0.5, y + 0.5, width, height);
        float first = 0, last = std::numeric_limits<float>::max();
        const auto clip = [&](float lower, float upper, float from, float along) {
            const float a = (lower - from) / along, b = (upper - from) / along;
            first = std::max(first, std::min(a, b));
            last = std::min(last, std::max(a, b));
        };
        clip(box_.lower.x, box_.upper.x, eye.x, d.x);
        clip(box_.lower.y, box_.upper.y, eye.y, d.y);
        clip(box_.lower.z, box_.upper.z, eye.z, d.z);
        constexpr float step = 1.0f / voxels;
        float through = 1;
        for (float k = std::ceil(first / step); k * step < last; ++k) { // the same samples, however space is cut
            const float value = at(eye + k * step * d - box_.lower);
            const float alpha = std::min(std::max(value - 0.05f, 0.0f) * 0.35f, 0.9f);
            const float part = through * alpha;
            rgba[0] += part * (0.5f + value);
            rgba[1] += part * 0.6f;
            rgba[2] += part * (1.0f - value);
            rgba[3] += part;
            through *= 1 - alpha;
        }
    }

private:
    float at(const Vec3& p) const
    {
        const auto place = [](float v) { return std::min(std::max(v * voxels, 0.0f), voxels - 0.001f); };
        const float x = place(p.x), y = place(p.y), z = place(p.z);
        const auto i = static_cast<int>(x), j = static_cast<int>(y), k = static_cast<int>(z);
        const float u = x - static_cast<float>(i), v = y - static_cast<float>(j), w = z - static_cast<float>(k);
        constexpr std::size_t row = voxels + 1, slice = row * row;
        const float* c = &values_[static_cast<std::size_t>(k) * slice + static_cast<std::size_t>(j) * row
                                  + static_cast<std::size_t>(i)];
        const auto mix = [](float a, float b, float t) { return a + t * (b - a); };
        return mix(mix(mix(c[0], c[1], u), mix(c[row], c[row + 1], u), v),
                   mix(mix(c[slice], c[slice + 1], u), mix(c[slice + row], c[slice + row + 1], u), v), w);
    }

    dfb::Box3 box_;
    std::vector<float> values_;
};

struct View {
    dfb::PerspectiveCamera camera;
    std::vector<int> order; // the ranks, front to back; their bricks have the same numbers
};

// Times of a frame on all ranks, in ms from when the first rank began.
struct Times {
    double image = 0;    // rank 0 has it; without compositing: all ranks have rendered
    double rendered = 0; // the slowest rank has rendered
};

struct System {
    std::string name;
    std::function<double(const View&)> frame; // collective; returns when this rank had rendered
    bool makesImage = true;
    std::vector<Times> times{};
};

class Bench {
public:
    Bench(MPI_Comm comm, Options o) : comm_(comm), o_(std::move(o))
    {
        MPI_Comm_rank(comm, &rank_);
        MPI_Comm_size(comm, &size_);
    }

    void run(int width, int height)
    {
        const Grid grid(size_);
        const Marcher marcher(grid.box(rank_));
        const auto messenger = std::make_shared<bench::Messenger>(comm_);
        dfb::FrameBufferConfig config;
        config.width = width;
        config.height = height;
        config.format = dfb::OutputFormat::RGBA32F;
        config.executor = std::make_shared<dfb::ThreadExecutor>(1);
        FrameBuffer fb(messenger, config);
        const dfb::SharedWorld world(fb, dfb::World({{static_cast<std::uint32_t>(rank_), grid.box(rank_)}}));
        const std::vector<View> views = viewsOf(grid, world);

        std::vector<float> image(4 * static_cast<std::size_t>(width) * static_cast<std::size_t>(height), 0.0f);
        const auto renderAll = [&](const View& view) {
            const Region r = view.camera.project(grid.box(rank_), width, height).region();
            for (int y = r.y0; y < r.y1; ++y)
                for (int x = r.x0; x < r.x1; ++x) {
                    float* pixel = &image[4
                                          * (static_cast<std::size_t>(y) * static_cast<std::size_t>(width)
                                             + static_cast<std::size_t>(x))];
                    std::fill_n(pixel, 4, 0.0f);
                    marcher.shade(view.camera, x, y, width, height, pixel);
                }
            return r;
        };

        std::vector<System> systems;
        systems.push_back(
            {"rendering alone", [&](const View& view) { return (renderAll(view), bench::now()); }, false});
        systems.push_back({"dfb", [&](const View& view) {
                               const Region whole = view.camera.project(grid.box(rank_), width, height).region();
                               const auto renderBrick = [&](const dfb::Brick&, auto& tile) {
                                   const Region r = dfb::intersection(tile.region, whole);
                                   for (int y = r.y0; y < r.y1; ++y)
                                       for (int x = r.x0; x < r.x1; ++x)
                                           marcher.shade(view.camera, x, y, width, height,
                                                         tile.pixel(x - tile.region.x0, y - tile.region.y0));
                               };
                               dfb::RoundRobinBricks owner;
                               auto frame = dfb::startOrdered(fb, world, view.camera, view.order, owner, renderBrick);
                               const double rendered = bench::now();
                               frame.end();
                               return rendered;
                           }});
        const float* ours = fb.isDisplayRank() ? fb.image().rgba32f() : nullptr;
        const void* theirs = nullptr;
#ifdef DFB_BENCH_HAS_ICET
        std::vector<std::unique_ptr<bench::IceT>> icets;
        for (const bench::IceTStrategy& strategy : bench::icetStrategies()) {
            const std::string name = strategy.name;
            if (name != "direct" && name != "sequential, binary swap" && name != "sequential, tree")
                continue;
            bench::IceTSettings settings;
            settings.strategy = strategy.strategy;
            settings.singleImage = strategy.singleImage;
            icets.push_back(std::make_unique<bench::IceT>(comm_, settings, width, height));
            systems.push_back({"icet: " + name, [&, icet = icets.back().get()](const View& view) {
                                   const Region r = renderAll(view);
                                   const double rendered = bench::now();
                                   const int viewport[4] = {r.x0, r.y0, r.width(), r.height()};
                                   theirs = icet->composite(image.data(), viewport, ranksOf(world, view.order));
                                   return rendered;
                               }});
        }
#endif
        systems.erase(std::remove_if(systems.begin(), systems.end(),
                                     [&](const System& s) {
                                         return s.makesImage && !o_.only.empty()
                                                && s.name.find(o_.only) == std::string::npos;
                                     }),
                      systems.end());
        double largest = 0;                               // difference of the two images
        for (std::size_t v = 0; v <= views.size(); ++v) { // the first touches memory
            const View& view = views[v % views.size()];
            for (std::size_t i = 0; i < systems.size(); ++i)
                time(systems[(i + v) % systems.size()], view, v > 0);
            for (std::size_t i = 0; ours && theirs && i < image.size(); ++i)
                largest = std::max(largest, std::abs(static_cast<double>(ours[i])
                                                     - static_cast<double>(static_cast<const float*>(theirs)[i])));
        }
        report(systems, width, height, largest);
    }

private:
    static std::vector<int> ranksOf(const dfb::SharedWorld& world, const std::vector<int>& order)
    {
        std::vector<int> ranks;
        for (const int brick : order)
            ranks.push_back(static_cast<int>(world.bricks()[static_cast<std::size_t>(brick)].brick.id));
        return ranks;
    }

    std::vector<View> viewsOf(const Grid& grid, const dfb::SharedWorld& world) const
    {
        std::vector<View> views;
        const Vec3 target = 0.5f * grid.size();
        const float distance = 1.9f * std::sqrt(dot(grid.size(), grid.size()));
        for (int v = 0; v < o_.views; ++v) {
            const float angle = 0.3f + 6.2831853f * static_cast<float>(v) / static_cast<float>(o_.views);
            const Vec3 eye = target + distance * Vec3{0.9f * std::cos(angle), 0.44f, 0.9f * std::sin(angle)};
            views.push_back({dfb::PerspectiveCamera(eye, target, {0, 1, 0}, 36), dfb::visibilityOrder(world, eye)});
        }
        return views;
    }

    void time(System& s, const View& view, bool counts)
    {
        bench::meet(comm_);
        const double start = bench::now(), rendered = s.frame(view), end = bench::now();
        const double first = bench::reduce(comm_, start, MPI_MIN);
        Times t;
        t.rendered = 1e3 * (bench::reduce(comm_, rendered, MPI_MAX) - first);
        t.image = s.makesImage ? 1e3 * (bench::agree(comm_, end) - first) : t.rendered;
        if (counts)
            s.times.push_back(t);
    }

    void report(const std::vector<System>& systems, int width, int height, double largest) const
    {
        if (rank_ != 0)
            return;
        const auto figure = [](const System& s, const auto& valueOf) {
            std::vector<double> values;
            for (std::size_t v = 0; v < s.times.size(); ++v)
                values.push_back(valueOf(v));
            return bench::figureOf(values);
        };
        const System& alone = systems.front();
        struct Row {
            Figure frame, beyond, overhead;
        };
        std::vector<Row> rows;
        std::vector<bench::Result> results;
        bench::Table table({"", "frame [ms]", "beyond rendering alone [ms]", "after the slowest had rendered [ms]"});
        for (const System& s : systems) {
            rows.push_back({figure(s, [&](std::size_t v) { return s.times[v].image; }),
                            figure(s, [&](std::size_t v) { return s.times[v].image - alone.times[v].image; }),
                            figure(s, [&](std::size_t v) { return s.times[v].image - s.times[v].rendered; })});
            table.add({s.name, bench::text(rows.back().frame), bench::text(rows.back().beyond),
                       bench::text(rows.back().overhead)});
            bench::Result r;
            r.bench = "bench_overlap";
            r.system = s.name.substr(0, s.name.find(':'));
            r.scene = "64^3 bricks, " + std::to_string(o_.views) + " views";
            r.ranks = size_;
            r.width = width;
            r.height = height;
            r.commit = o_.commit;
            const std::pair<const char*, const Figure*> parts[] = {{", frame", &rows.back().frame},
                                                                   {", beyond rendering", &rows.back().beyond},
                                                                   {", overhead", &rows.back().overhead}};
            for (const auto& [part, ms] : parts) {
                r.config = s.name + part;
                r.ms = *ms;
                results.push_back(r);
            }
        }
        const std::string size = std::to_string(width) + 'x' + std::to_string(height);
        table.print(size + ", " + std::to_string(size_) + " ranks, " + std::to_string(o_.views)
                    + " views; images of dfb "
                      "and IceT differ by "
                    + bench::text(largest) + " at most");
        if (!o_.json.empty())
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
                                 + bench::text(mine.overhead) + " | " + bench::text(peer.overhead) + " |\n";
        const char* head = "| size | ranks | rendering alone [ms] | dfb [ms] | best IceT [ms] | ratio | dfb beyond "
                           "rendering | IceT beyond | ratio | dfb after rendering | IceT after |\n"
                           "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n";
        std::printf("\n%s%s", head, line.c_str());
        if (o_.table.empty())
            return;
        const bool isNew = !std::ifstream(o_.table).good();
        std::ofstream(o_.table, std::ios::app) << (isNew ? head : "") << line;
    }

    MPI_Comm comm_;
    Options o_;
    int rank_ = 0, size_ = 1;
};

// Ends the program after --help, or if it was called wrongly.
Options optionsOf(int argc, char** argv)
{
    Options o;
    bench::readOptions(
        argc, argv,
        "usage: mpirun -n RANKS bench_overlap [--size WxH,...] [--views N] [--json FILE] [--table FILE] "
        "[--commit ID] [--only TEXT]",
        {{"--size", bench::readSizes(o.sizes)},
         {"--views", [&o](const std::string& value) { return (o.views = std::atoi(value.c_str())) > 0; }},
         {"--json", bench::readText(o.json)},
         {"--table", bench::readText(o.table)},
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
            bench.run(width, height);
    });
}
