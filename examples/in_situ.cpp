// A simulation that renders its fields while it runs: two substances diffuse and react (the Gray-Scott model) on a
// periodic grid. The grid is cut into slabs, whose number does not depend on the number of ranks: each rank holds some
// consecutive slabs, or none. After every 80 steps (option --every) each rank renders its own slabs, and dfb composites
// them into one picture.
//   mpirun -n 4 in_situ        writes in_situ_0000.ppm and so on; in_situ --help has the options
//   mpirun -n 4 in_situ --live        shows the pictures in a browser, to turn them and to stop the simulation
#include "live/interrupt.hpp"
#include "live/live_view.hpp"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <charconv>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <iostream>
#include <map>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

using dfb::Vec3;

// ---- the simulation: plain MPI, nothing of rendering -----------------------------------------------------------

// Layers [begin, end) along z of a field of n x n x n voxels, with two ghost layers on either side.
struct Field {
    Field(int size, int first, int last) : n(size), begin(first), end(last), voxels(index(last + 2)) {}

    std::size_t index(int z) const { return std::size_t(z - begin + 2) * std::size_t(n) * std::size_t(n); }
    const float* layer(int z) const { return &voxels[index(z)]; }
    float* layer(int z) { return &voxels[index(z)]; }

    int n, begin, end;
    std::vector<float> voxels;
};

class GrayScott {
public:
    // This rank has layers [begin, end): none, or at least two. Ranks `below` and `above` have the layers next to them.
    GrayScott(MPI_Comm comm, int n, int begin, int end, int below, int above)
        : comm_(comm), below_(below), above_(above), u_(n, begin, end), v_(u_), nextU_(u_), nextV_(u_)
    {
        std::vector<Vec3> seeds; // scattered about the middle
        for (int i = 0; i < 9; ++i) {
            const auto place = [=](float jump) { return n * (0.35f + 0.3f * std::fmod(0.5f + i * jump, 1.0f)); };
            seeds.push_back({place(0.8192f), place(0.6710f), place(0.5497f)});
        }
        for (int z = begin; z < end; ++z)
            for (int i = 0; i < n * n; ++i) {
                const Vec3 voxel{float(i % n), float(i / n), float(z)};
                const bool inSeed = std::any_of(seeds.begin(), seeds.end(), [&](const Vec3& middle) {
                    return dot(voxel - middle, voxel - middle) < 12;
                });
                u_.layer(z)[i] = inSeed ? 0.5f : 1.0f;
                v_.layer(z)[i] = inSeed ? 0.25f : 0.0f;
            }
    }

    const Field& u() const { return u_; }
    const Field& v() const { return v_; }

    // One step in time. On any rank, a voxel is the same function of the same neighbours, so the fields are equal, bit
    // for bit, on any number of ranks.
    void advance(dfb::Executor& executor)
    {
        const int begin = u_.begin, end = u_.end;
        if (begin == end)
            return;
        startExchange(1);
        executor.parallelFor(std::size_t(end - begin - 2), // meanwhile, the layers that need no ghosts
                             [&](std::size_t i) { updateLayer(begin + 1 + int(i)); });
        finishExchange();
        executor.parallelFor(2, [&](std::size_t i) { updateLayer(i == 0 ? begin : end - 1); });
        std::swap(u_, nextU_);
        std::swap(v_, nextV_);
    }

    // Fills the ghosts for rendering: one layer is enough to interpolate values, but gradients need two.
    void prepareRendering()
    {
        if (u_.begin == u_.end)
            return;
        startExchange(2);
        finishExchange();
    }

private:
    // Sends the outermost layers and receives the ghosts. A rank may be its own neighbour, and the neighbours on both
    // sides may be one rank; tags tell the messages of the two sides apart.
    void startExchange(int layers)
    {
        const int down = 0, up = 1, count = layers * u_.n * u_.n;
        for (Field* field : {&u_, &v_}) {
            requests_.resize(requests_.size() + 4);
            MPI_Request* request = requests_.data() + requests_.size() - 4;
            MPI_Irecv(field->layer(field->begin - layers), count, MPI_FLOAT, below_, up, comm_, request);
            MPI_Irecv(field->layer(field->end), count, MPI_FLOAT, above_, down, comm_, request + 1);
            MPI_Isend(field->layer(field->begin), count, MPI_FLOAT, below_, down, comm_, request + 2);
            MPI_Isend(field->layer(field->end - layers), count, MPI_FLOAT, above_, up, comm_, request + 3);
        }
    }

    // MPI_Waitall would spin. Where ranks share a core, that takes some ms each time, until the scheduler gives the
    // core to the rank that is waited for.
    void finishExchange()
    {
        int done = 0;
        while (MPI_Testall(int(requests_.size()), requests_.data(), &done, MPI_STATUSES_IGNORE), !done)
            std::this_thread::sleep_for(std::chrono::microseconds(50));
        requests_.clear();
    }

    void updateLayer(int z)
    {
        constexpr float feed = 0.025f, kill = 0.060f, spreadOfU = 0.14f, spreadOfV = 0.07f;
        const int n = u_.n;
        std::vector<float> flowU(n), flowV(n);
        for (int y = 0; y < n; ++y) {
            laplacian(u_, y, z, flowU.data());
            laplacian(v_, y, z, flowV.data());
            const float *u = u_.layer(z) + y * n, *v = v_.layer(z) + y * n;
            float *nextU = nextU_.layer(z) + y * n, *nextV = nextV_.layer(z) + y * n;
            for (std::size_t x = 0; x < flowU.size(); ++x) {
                const float reaction = u[x] * v[x] * v[x];
                const float next = v[x] + spreadOfV * flowV[x] + reaction - (feed + kill) * v[x];
                nextU[x] = u[x] + spreadOfU * flowU[x] - reaction + feed * (1 - u[x]);
                nextV[x] = next > 1e-15f ? next : 0; // denormal numbers would make it many times slower
            }
        }
    }

    // The Laplacian of a row of voxels, from 18 neighbours. With only 6, shapes would grow along the axes and become
    // cubes.
    static void laplacian(const Field& field, int y, int z, float* result)
    {
        const int n = field.n, before = (y + n - 1) % n * n, here = y * n, behind = (y + 1) % n * n;
        const float *lower = field.layer(z - 1), *middle = field.layer(z), *upper = field.layer(z + 1);
        const float *a = lower + before, *b = lower + here, *c = lower + behind;
        const float *d = middle + before, *e = middle + here, *f = middle + behind;
        const float *g = upper + before, *h = upper + here, *i = upper + behind;
        const auto voxel = [=](int x, int left, int right) {
            const float faces = b[x] + d[x] + e[left] + e[right] + f[x] + h[x];
            const float edges = a[x] + b[left] + b[right] + c[x] + d[left] + d[right] + f[left] + f[right] + g[x]
                                + h[left] + h[right] + i[x];
            result[x] = (2 * faces + edges) / 6 - 4 * e[x];
        };
        voxel(0, n - 1, 1);
        for (int x = 1; x < n - 1; ++x)
            voxel(x, x - 1, x + 1);
        voxel(n - 1, n - 2, 0);
    }

    MPI_Comm comm_;
    int below_, above_;
    Field u_, v_, nextU_, nextV_;
    std::vector<MPI_Request> requests_;
};

// ---- the renderer: one slab into one tile, nothing of MPI ------------------------------------------------------

constexpr int width = 640, height = 480; // of the pictures, unless viewers want another size
constexpr float fieldOfView = 32;        // vertical, in degrees
constexpr float visible = 0.1f;          // values of v above this are visible
constexpr float rayStep = 0.5f;          // voxels from sample to sample

// The box around all that is visible in layers [begin, end). Rays skip what is outside, and tiles that the box does not
// touch cost nothing. Voxels lie at integer coordinates; a sample needs the 8 voxels around it, and its gradient those
// next to these. If nothing is visible, lower and upper are equal.
dfb::Box3 visibleBox(const Field& v, int begin, int end)
{
    const float last = float(v.n - 2);
    Vec3 lower{last, last, float(end)}, upper{1, 1, float(begin)};
    for (int z = begin; z <= end; ++z)
        for (int i = 0; i < v.n * v.n; ++i)
            if (v.layer(z)[i] > visible) {
                const float x = float(i % v.n), y = float(i / v.n);
                lower = {std::min(lower.x, x - 1), std::min(lower.y, y - 1), std::min(lower.z, float(z - 1))};
                upper = {std::max(upper.x, x + 1), std::max(upper.y, y + 1), std::max(upper.z, float(z + 1))};
            }
    const float first = std::max(1.0f, float(begin)), beyond = std::min(last, float(end)); // along z
    if (lower.x > upper.x)
        return {};
    return {{std::max(lower.x, 1.0f), std::max(lower.y, 1.0f), std::max(lower.z, first)},
            {std::min(upper.x, last), std::min(upper.y, last), std::min(upper.z, beyond)}};
}

// Adds a sample behind those that a pixel already has.
void addSample(float u, float v, const Vec3& gradient, const Vec3& way, const Vec3& light, float* rgba)
{
    const float density = std::min(1.0f, (v - visible) / 0.12f);
    const float alpha = (1 - rgba[3]) * (1 - std::exp(-2 * rayStep * density * density));
    // In crowded places little is left of both substances: these are dark clefts, the others bright ridges.
    const float plenty = std::clamp((u + v - 0.6f) / 0.18f, 0.0f, 1.0f);
    const Vec3 cleft{0.05f, 0.01f, 0.15f}, flank{0.70f, 0.05f, 0.14f}, ridge{1.0f, 0.55f, 0.20f};
    Vec3 color = plenty < 0.5f ? cleft + 2 * plenty * (flank - cleft) : flank + (2 * plenty - 1) * (ridge - flank);
    const float steepness = std::sqrt(dot(gradient, gradient));
    if (steepness > 1e-4f) {
        const Vec3 normal = (-1 / steepness) * gradient;
        const float shine = std::max(0.0f, dot(normal, normalize(light - way)));
        color = (0.15f + 0.95f * std::max(0.0f, dot(normal, light))) * color
                + 0.3f * plenty * std::pow(shine, 40.0f) * Vec3{1, 1, 1};
    }
    rgba[0] += alpha * color.x;
    rgba[1] += alpha * color.y;
    rgba[2] += alpha * color.z;
    rgba[3] += alpha;
}

template <class Tile>
void renderSlab(const GrayScott& fields, const dfb::PerspectiveCamera& camera, const Vec3& light, const dfb::Box3& box,
                const dfb::TileLayout& image, Tile& tile)
{
    const Vec3 eye = camera.eye(), &lower = box.lower, &upper = box.upper;
    const std::ptrdiff_t dx = 1, dy = fields.v().n, dz = dy * dy;
    tile.forEachPixel([&](int column, int line, float* rgba, float& depth) {
        const Vec3 way = camera.direction(column + 0.5, line + 0.5, image.width(), image.height());
        float enter = 0, leave = 1e6f;
        const auto clip = [&](float a, float b) { // with the arguments in this order, a NaN changes nothing
            enter = std::max(enter, std::min(a, b));
            leave = std::min(leave, std::max(a, b));
        };
        clip((lower.x - eye.x) / way.x, (upper.x - eye.x) / way.x);
        clip((lower.y - eye.y) / way.y, (upper.y - eye.y) / way.y);
        clip((lower.z - eye.z) / way.z, (upper.z - eye.z) / way.z);
        if (!(enter < leave))
            return;
        // In all slabs, samples lie at multiples of rayStep from the eye. A sample belongs to the slab whose half-open
        // box it is in, so none is missed or taken twice where two slabs meet. The loop takes one step more than
        // needed, because of rounding.
        const int last = int(leave / rayStep) + 1;
        for (int k = int(enter / rayStep); k <= last && rgba[3] < 0.995f; ++k) {
            const float distance = float(k) * rayStep;
            const Vec3 p = eye + distance * way;
            if (!(p.x >= lower.x && p.x < upper.x && p.y >= lower.y && p.y < upper.y && p.z >= lower.z
                  && p.z < upper.z))
                continue;
            const int x = int(p.x), y = int(p.y), z = int(p.z);
            const float fx = p.x - float(x), fy = p.y - float(y), fz = p.z - float(z);
            const auto value = [=](const float* q) {
                const auto lerp = [](float a, float b, float f) { return a + f * (b - a); };
                return lerp(lerp(lerp(q[0], q[dx], fx), lerp(q[dy], q[dy + dx], fx), fy),
                            lerp(lerp(q[dz], q[dz + dx], fx), lerp(q[dz + dy], q[dz + dy + dx], fx), fy), fz);
            };
            const float* q = fields.v().layer(z) + y * dy + x;
            const float v = value(q);
            if (v <= visible)
                continue;
            if (rgba[3] == 0)
                depth = distance;
            const Vec3 gradient{value(q + dx) - value(q - dx), value(q + dy) - value(q - dy),
                                value(q + dz) - value(q - dz)};
            addSample(value(fields.u().layer(z) + y * dy + x), v, gradient, way, light, rgba);
        }
    });
}

// ---- both together ---------------------------------------------------------------------------------------------

struct Options {
    int size = 96, steps = 0, every = 80, slabs = 0;
    std::string out; // empty: no pictures are written
    std::optional<int> live;
};

constexpr const char* usage =
    "usage: in_situ [OPTION VALUE]...\n"
    "  --size N      voxels along each side of the grid (96)\n"
    "  --steps N     steps of the simulation (1600; with --live: until it is ended)\n"
    "  --every N     render a picture after every N steps (80)\n"
    "  --slabs N     slabs that the grid is cut into, which are dealt out to the ranks (8, or\n"
    "                half of --size if that is less)\n"
    "  --out PREFIX  pictures to write: PREFIX_0000.ppm, PREFIX_0001.ppm ... (in_situ; with --live: none)\n"
    "  --live [PORT] show the pictures in a browser on this machine (port 8080, or any free port)\n"
    "Exit code: 0: done, 1: the run failed, 2: the command line is wrong.\n";

// Throws std::invalid_argument.
Options parse(int argc, char** argv)
{
    Options options;
    const auto isNumber = [](const std::string& text) {
        return !text.empty() && text.find_first_not_of("0123456789") == std::string::npos;
    };
    const std::map<std::string, int*> numbers = {{"--size", &options.size},
                                                 {"--steps", &options.steps},
                                                 {"--every", &options.every},
                                                 {"--slabs", &options.slabs}};
    for (int i = 1; i < argc; i += 2) {
        const std::string name = argv[i], value = i + 1 < argc ? argv[i + 1] : "";
        const auto number = numbers.find(name);
        if (name == "--live") {
            options.live = -1;
            if (!isNumber(value))
                --i; // the next option
            else if (value.size() > 5 || (options.live = std::stoi(value)) > 65535)
                throw std::invalid_argument("--live takes a port from 0 to 65535, not '" + value + "'");
        } else if (number != numbers.end()) {
            const auto [end, error] = std::from_chars(value.data(), value.data() + value.size(), *number->second);
            if (error != std::errc() || *end || *number->second < 1)
                throw std::invalid_argument(name + " takes a whole number above 0, not '" + value + "'");
        } else if (name == "--out" && !value.empty()) {
            options.out = value;
        } else {
            throw std::invalid_argument("there is no '" + name + ' ' + value + "'; --help lists the options");
        }
    }
    if (!options.live && options.steps == 0)
        options.steps = 1600;
    if (!options.live && options.out.empty())
        options.out = "in_situ";
    if (options.size < 8 || options.size > 1024)
        throw std::invalid_argument("--size must be 8 to 1024");
    if (options.slabs == 0)
        options.slabs = std::min(8, options.size / 2);
    if (options.slabs > options.size / 2) // ghosts come from the adjacent slab only
        throw std::invalid_argument("--slabs must be half of --size at most: a slab has two layers or more");
    return options;
}

using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend>;

// The camera of a picture, and the direction to its light, which comes from above and the left.
struct Sight {
    dfb::PerspectiveCamera camera;
    Vec3 light;

    // `outward`: the direction from the target to the eye; (c, s): x and z of the same, if it were horizontal.
    Sight(const Vec3& target, const Vec3& outward, float distance, float c, float s)
        : camera(dfb::PerspectiveCamera::along(target + distance * outward, -1 * outward, {0, 1, 0}, fieldOfView)),
          light(dfb::normalize(outward + Vec3{0.6f * s, 0.7f, -0.6f * c}))
    {
    }
};

constexpr float wholeView = 2.4f; // the distance, in sides of the grid, from which all of it is in the image

// The view of a step, from a slow orbit around a grid of n^3 voxels.
Sight orbit(int n, std::int64_t step)
{
    const float angle = 0.6f + 6e-4f * float(step), c = std::cos(angle), s = std::sin(angle);
    return {0.5f * float(n - 1) * Vec3{1, 1, 1}, dfb::normalize(Vec3{c, 0.5f, s}), wholeView * float(n), c, s};
}

// The view that the viewers want.
Sight wished(int n, const example::LiveCamera& camera)
{
    constexpr double degree = 3.14159265358979323846 / 180;
    const double elevation = std::clamp(camera.elevation, -89.9, 89.9) * degree;
    const float c = float(std::sin(camera.azimuth * degree)), s = float(std::cos(camera.azimuth * degree)),
                flat = float(std::cos(elevation));
    const Vec3 target{float(camera.target[0]), float(camera.target[1]), float(camera.target[2])};
    return {target, {flat * c, float(std::sin(elevation)), flat * s}, float(camera.distance) * float(n), c, s};
}

// What the viewers of a live view want to see (their wishes), on all ranks. Without a live view there are none.
class Viewers {
public:
    Viewers(FrameBuffer& fb, const Options& options) : fb_(fb), isLive_(options.live.has_value()) {}

    // Opens the live view, if there is to be one. Returns on all ranks why it failed, or an empty string. Collective.
    std::string open(const Options& options)
    {
        if (!isLive_)
            return {};
        interrupt_.emplace();
        std::string error;
        try {
            if (fb_.isDisplayRank())
                view_ = example::LiveView::listen("in_situ", *options.live, true);
        } catch (const std::runtime_error& e) {
            error = e.what();
        }
        if (fb_.allReduce({error.empty()}, FrameBuffer::Reduce::Min)[0] == 0)
            return error.empty() ? "the display rank cannot listen" : error;
        const double middle = 0.5 * (options.size - 1);
        wishes_.camera = {55, 26, double(wholeView), {middle, middle, middle}};
        wishes_.width = width;
        wishes_.height = height;
        if (!view_)
            return {};
        example::LiveScene scene;
        scene.unit = options.size;
        scene.fieldOfView = double(fieldOfView);
        scene.ranks = fb_.size();
        view_->open(scene, wishes_);
        std::fputs(view_->invitation().c_str(), stdout);
        std::fflush(stdout);
        return {};
    }

    // Takes new wishes, and calls show() if the viewers want another picture of the same step. Returns true when the
    // simulation may go on: at once, or, if they have paused it, when they let it go on. Returns false if the job is to
    // end. Collective, outside frames.
    template <class Show>
    bool mayGoOn(bool isBetweenPictures, const Show& show)
    {
        if (!isLive_)
            return true;
        for (;;) {
            const bool waits = wishes_.isPaused && stepsTaken_ >= wishes_.steps && !isBetweenPictures;
            const std::uint64_t look = wishes_.look;
            wishes_ = example::shareWishes(fb_, heard(waits));
            if (wishes_.camera.distance == 0)
                wishes_.camera.distance = double(wholeView);
            if (wishes_.ends)
                return false;
            if (!wishes_.isPaused)
                stepsTaken_ = wishes_.steps;
            if (wishes_.look != look)
                show();
            if (!wishes_.isPaused || isBetweenPictures)
                return true;
            if (stepsTaken_ < wishes_.steps) {
                ++stepsTaken_;
                return true;
            }
        }
    }

    bool isLive() const { return isLive_; }
    const example::LiveWishes& wishes() const { return wishes_; }

    void show(const dfb::FrameReport& report, std::int64_t step)
    {
        if (!view_)
            return;
        example::LivePicture picture;
        picture.wishes = wishes_;
        picture.distance = wishes_.camera.distance;
        picture.step = step;
        example::tellTiles(fb_, picture);
        view_->show(fb_.image().rgba8(), fb_.image().width(), fb_.image().height(), report, std::move(picture));
    }

private:
    example::LiveWishes heard(bool waits) const
    {
        if (view_)
            return view_->waitForChange(wishes_.number,
                                        waits ? std::chrono::milliseconds::max() : std::chrono::milliseconds(0));
        example::LiveWishes mine;
        mine.ends = example::Interrupt::happened();
        return mine;
    }

    FrameBuffer& fb_;
    bool isLive_;
    std::optional<example::Interrupt> interrupt_;
    std::unique_ptr<example::LiveView> view_; // on the display rank
    example::LiveWishes wishes_;
    std::int64_t stepsTaken_ = 0;
};

// Returns whether the image could be written, on all ranks. Collective.
bool write(FrameBuffer& fb, const std::string& name)
{
    bool isWritten = true;
    try {
        if (fb.isDisplayRank())
            dfb::writePpm(name, fb.image());
    } catch (const std::runtime_error&) {
        isWritten = false;
    }
    return fb.allReduce({isWritten}, FrameBuffer::Reduce::Min)[0] == 1; // the other ranks cannot see whether it is
}

// Returns what went wrong, on all ranks, or an empty string. The message of rank 0 is the most precise.
std::string run(MPI_Comm comm, const Options& options)
{
    FrameBuffer fb(comm, {width, height, dfb::OutputFormat::SRGBA8});
    Viewers viewers(fb, options);
    const std::string refused = viewers.open(options);
    if (!refused.empty())
        return refused;

    const int n = options.size, slabs = options.slabs, ranks = fb.size();
    const auto firstLayer = [=](int slab) { return slab * n / slabs; };
    const auto firstSlab = [=](int rank) { return rank * slabs / ranks; };
    const auto holder = [=](int slab) { return (((slab + slabs) % slabs + 1) * ranks - 1) / slabs; }; // its inverse
    const int begin = firstSlab(fb.rank()), end = firstSlab(fb.rank() + 1);
    GrayScott simulation(comm, n, firstLayer(begin), firstLayer(end), holder(begin - 1), holder(end));

    dfb::World world; // boxes around what is visible of this rank's slabs
    dfb::DataParallelLoop loop(fb, world);
    const auto render = [&](std::int64_t step) {
        const example::LiveWishes& wishes = viewers.wishes();
        if (viewers.isLive() && (wishes.width != fb.layout().width() || wishes.height != fb.layout().height()))
            fb.resize(wishes.width, wishes.height);
        const Sight sight = viewers.isLive() ? wished(n, wishes.camera) : orbit(n, step);
        simulation.prepareRendering();
        world = {};
        for (int slab = begin; slab < end; ++slab) {
            const dfb::Box3 box = visibleBox(simulation.v(), firstLayer(slab), firstLayer(slab + 1));
            if (box.lower.z < box.upper.z)
                world.add({std::uint32_t(slab), box}); // a slab has the same number on any rank
        }
        dfb::FrameConfig params;
        params.background = {0.004f, 0.006f, 0.012f, 1};
        const auto renderBrick = [&](const dfb::Brick& brick, FrameBuffer::Tile& tile) {
            renderSlab(simulation, sight.camera, sight.light, brick.bounds, fb.layout(), tile);
        };
        viewers.show(loop.render(sight.camera, renderBrick, params), step);
    };

    double simulationTime = 0, renderingTime = 0;
    std::int64_t step = 0;
    int frames = 0;
    while (options.steps == 0 || step < options.steps) {
        if (!viewers.mayGoOn(step % options.every != 0, [&] { render(step); }))
            break;
        ++step;
        const double started = MPI_Wtime();
        simulation.advance(fb.executor());
        const double advanced = MPI_Wtime();
        simulationTime += advanced - started;
        if (step % options.every != 0)
            continue;

        render(step);
        if (!options.out.empty()) {
            char number[16];
            std::snprintf(number, sizeof number, "_%04d.ppm", frames);
            if (const std::string name = options.out + number; !write(fb, name))
                return name + " cannot be written";
        }
        ++frames;
        renderingTime += MPI_Wtime() - advanced;
    }

    const auto longest =
        fb.allReduce({std::int64_t(1e6 * simulationTime), std::int64_t(1e6 * renderingTime)}, FrameBuffer::Reduce::Max);
    const double simulated = 1e-6 * double(longest[0]), rendered = 1e-6 * double(longest[1]);
    if (fb.isDisplayRank())
        std::printf("%d ranks: %lld steps of %d^3 voxels in %.3f s, %d pictures in %.3f s, %.1f %% of the run\n", ranks,
                    static_cast<long long>(step), n, simulated, frames, rendered,
                    100 * rendered / (simulated + rendered));
    return {};
}

int main(int argc, char** argv)
try {
    dfb::MpiSession mpi(argc, argv);
    // MPI_COMM_WORLD may hold several runs of this program: `mpirun -n 2 in_situ --out a : -n 2 in_situ --out b` runs
    // two simulations. Each gets a communicator and a framebuffer of its own.
    const int* program = nullptr;
    int known = 0, rank = 0;
    MPI_Comm_get_attr(mpi.communicator(), MPI_APPNUM, &program, &known);
    MPI_Comm comm = MPI_COMM_NULL;
    MPI_Comm_split(mpi.communicator(), known ? *program : 0, mpi.rank(), &comm);
    MPI_Comm_rank(comm, &rank);
    std::string error;
    int code = 1;
    try {
        if (argc != 2 || std::string(argv[1]) != "--help")
            error = run(comm, parse(argc, argv));
        else if (rank == 0)
            std::cout << usage;
    } catch (const std::invalid_argument& wrong) { // the same on all ranks, as they have the same options
        error = wrong.what();
        code = 2;
    } catch (const dfb::FrameError& failure) { // the same on all ranks
        error = failure.what();
    }
    if (!error.empty() && rank == 0)
        std::cerr << "in_situ: " << error << '\n';
    MPI_Comm_free(&comm);
    return error.empty() ? 0 : code;
} catch (const std::exception& e) {
    std::cerr << "in_situ: " << e.what() << '\n';
    return 1;
}
