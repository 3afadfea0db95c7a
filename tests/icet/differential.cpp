// Compares libdfb_icet with IceT and with an exact reference. Both libraries are loaded and get the same random calls:
//   mpirun -n 3 test_icet_differential IceTCore.so libdfb_icet.so [--cases N] [--seed S] [--only CASE] [--multiple]
// A case is a frame in one of three contexts, which keep their settings. --multiple initialises MPI at
// MPI_THREAD_MULTIPLE, otherwise it is at MPI_THREAD_SINGLE. Returns 0 if all is well.
//   nearest: colours and depths equal the reference and IceT's bit for bit. Of equal depths the lowest rank's colour
//            wins. IceT's winner depends on its strategy, so it is not compared there.
//   blended: bytes are within half a level of the reference, floats within their rounding. IceT's may be off by a
//            level for each rank, and IceT drops light without opacity.
#include "reference.hpp"

#include "icet.hpp"

#include <mpi.h>

#include <algorithm>
#include <array>
#include <cfloat>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <memory>
#include <string>

namespace icet_test {
namespace {

using Matrix = std::array<double, 16>;

struct View {
    Matrix projection{}, modelview{};
    std::array<float, 4> background{};
    bool hasLimits = false;
    Rect limits; // a pre-rendered image has garbage outside of them
};

int rankOf(MPI_Comm comm)
{
    int rank = 0;
    MPI_Comm_rank(comm, &rank);
    return rank;
}
int sizeOf(MPI_Comm comm)
{
    int size = 0;
    MPI_Comm_size(comm, &size);
    return size;
}

// ---- what a client has and draws

// Pixels in the format of a kind.
struct Pixels {
    Pixels(Kind imageKind, int imageWidth, int imageHeight) : kind(imageKind), width(imageWidth)
    {
        const auto count = static_cast<std::size_t>(imageWidth) * static_cast<std::size_t>(imageHeight);
        bytes.resize(isBytes(kind) ? 4 * count : 0);
        floats.resize(isBytes(kind) ? 0 : static_cast<std::size_t>(channelsOf(kind)) * count);
        depth.resize(isBlend(kind) ? 0 : count);
    }

    void set(int x, int y, const Picture& picture, int px, int py, bool isGarbage)
    {
        const std::size_t at =
            static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x);
        const std::size_t channels = static_cast<std::size_t>(channelsOf(kind));
        if (isBytes(kind)) {
            const auto rgba = picture.bytes(px, py);
            for (std::size_t c = 0; c < 4; ++c)
                bytes[4 * at + c] = isGarbage ? std::uint8_t{255} : rgba[c];
        } else {
            const auto rgba = picture.floats(px, py);
            for (std::size_t c = 0; c < channels; ++c)
                floats[channels * at + c] = isGarbage ? 1.0f : rgba[c];
        }
        if (!depth.empty())
            depth[at] = isGarbage ? 0.0f : picture.depth(px, py);
    }
    const void* color() const
    {
        return isBytes(kind) ? static_cast<const void*>(bytes.data()) : floats.empty() ? nullptr : floats.data();
    }

    Kind kind;
    int width;
    std::vector<std::uint8_t> bytes;
    std::vector<float> floats, depth;
};

// What the draw callback needs to know of the frame, and the calls that it got.
struct Drawing {
    const Api* api = nullptr;
    const Setup* setup = nullptr;
    const View* view = nullptr;
    const Picture* picture = nullptr;
    std::vector<Rect> asked; // rectangles of the wall that were drawn
    int empty = 0;
    std::string wrong;
} drawing;

// Finds the window that was put in front of a projection: P' = W P, where W scales and moves x and y.
bool findWindow(const IceTDouble* projected, const Setup& setup, const Matrix& projection, Rect& window)
{
    const Rect wall = setup.wall();
    const int places[2] = {wall.x, wall.y}, sizes[2] = {wall.width, wall.height},
              shown[2] = {window.width, window.height};
    int found[2] = {0, 0};
    for (std::size_t row = 0; row < 2; ++row) {
        // Solves for scale * a + offset * b with the two columns that determine it best.
        double best = 0, scale = 0, offset = 0;
        for (std::size_t i = 0; i < 4; ++i)
            for (std::size_t j = 0; j < i; ++j) {
                const double a = projection[4 * i + row], b = projection[4 * i + 3], c = projection[4 * j + row],
                             d = projection[4 * j + 3], p = projected[4 * i + row], q = projected[4 * j + row];
                if (std::abs(a * d - b * c) <= best)
                    continue;
                best = std::abs(a * d - b * c);
                scale = (p * d - b * q) / (a * d - b * c);
                offset = (a * q - p * c) / (a * d - b * c);
            }
        const double place = (sizes[row] + 2.0 * places[row] - shown[row] - offset * shown[row]) / 2;
        found[row] = static_cast<int>(std::lround(place));
        if (std::abs(place - found[row]) > 1e-6 || std::abs(scale * shown[row] / sizes[row] - 1) > 1e-9)
            return false;
    }
    window.x = found[0], window.y = found[1];
    return true;
}

void draw(const IceTDouble* projection, const IceTDouble* modelview, const IceTFloat* background,
          const IceTInt* readback, IceTImage result)
{
    const Api& api = *drawing.api;
    const Kind kind = drawing.setup->kind;
    Rect window{0, 0, api.icetImageGetWidth(result), api.icetImageGetHeight(result)};
    if (!findWindow(projection, *drawing.setup, drawing.view->projection, window))
        drawing.wrong = "the projection is of no window";
    if (!std::equal(modelview, modelview + 16, drawing.view->modelview.begin()))
        drawing.wrong = "the modelview matrix is another";
    for (std::size_t c = 0; c < 4; ++c)
        if (background[c] != (isBlend(kind) ? 0 : drawing.view->background[c]))
            drawing.wrong = "the background is another";
    const Rect read{readback[0], readback[1], readback[2], readback[3]};
    if (read.width > 0 && read.height > 0)
        drawing.asked.push_back({window.x + read.x, window.y + read.y, read.width, read.height});
    else
        ++drawing.empty;
    Pixels pixels(kind, window.width, window.height);
    for (int y = 0; y < window.height; ++y)
        for (int x = 0; x < window.width; ++x)
            pixels.set(x, y, *drawing.picture, window.x + x, window.y + y, !read.contains(x, y));
    if (isBytes(kind))
        std::copy(pixels.bytes.begin(), pixels.bytes.end(), api.icetImageGetColorub(result));
    else if (!pixels.floats.empty())
        std::copy(pixels.floats.begin(), pixels.floats.end(), api.icetImageGetColorf(result));
    if (!pixels.depth.empty())
        std::copy(pixels.depth.begin(), pixels.depth.end(), api.icetImageGetDepthf(result));
}

// ---- a client

const IceTEnum anySingle[] = {ICET_SINGLE_IMAGE_STRATEGY_AUTOMATIC, ICET_SINGLE_IMAGE_STRATEGY_BSWAP,
                              ICET_SINGLE_IMAGE_STRATEGY_TREE, ICET_SINGLE_IMAGE_STRATEGY_RADIXK};

void apply(const Api& api, const Setup& setup, int rank, IceTEnum strategy, IceTEnum single)
{
    const auto enable = [&](IceTEnum option, bool value) { (value ? api.icetEnable : api.icetDisable)(option); };
    api.icetResetTiles();
    for (const auto& [place, display] : setup.tiles)
        api.icetAddTile(place.x, place.y, place.width, place.height, display);
    int width = 0, height = 0;
    for (const auto& [place, display] : setup.tiles)
        width = std::max(width, place.width), height = std::max(height, place.height);
    api.icetPhysicalRenderSize(width + setup.extraWidth, height + setup.extraHeight);
    api.icetSetColorFormat(isBytes(setup.kind)                ? ICET_IMAGE_COLOR_RGBA_UBYTE
                           : setup.kind == Kind::NearestRgb   ? ICET_IMAGE_COLOR_RGB_FLOAT
                           : setup.kind == Kind::NearestDepth ? ICET_IMAGE_COLOR_NONE
                                                              : ICET_IMAGE_COLOR_RGBA_FLOAT);
    api.icetSetDepthFormat(isBlend(setup.kind) ? ICET_IMAGE_DEPTH_NONE : ICET_IMAGE_DEPTH_FLOAT);
    api.icetCompositeMode(isBlend(setup.kind) ? ICET_COMPOSITE_MODE_BLEND : ICET_COMPOSITE_MODE_Z_BUFFER);
    api.icetCompositeOrder(setup.order.data());
    enable(ICET_ORDERED_COMPOSITE, setup.ordered);
    enable(ICET_CORRECT_COLORED_BACKGROUND, setup.corrects);
    enable(ICET_COMPOSITE_ONE_BUFFER, setup.oneBuffer);
    enable(ICET_FLOATING_VIEWPORT, setup.floats);
    enable(ICET_RENDER_EMPTY_IMAGES, setup.rendersEmpty);
    if (setup.boxes.empty())
        api.icetBoundingVertices(0, ICET_VOID, 0, 0, nullptr);
    else if (const auto& box = setup.boxes[static_cast<std::size_t>(rank)]; rank % 2 == 0)
        api.icetBoundingBoxd(box[0], box[1], box[2], box[3], box[4], box[5]);
    else {
        std::vector<float> vertices; // with a gap after each vertex
        for (int i = 0; i < 8; ++i)
            for (const std::size_t c :
                 {std::size_t(i / 4), std::size_t(2 + i / 2 % 2), std::size_t(4 + i % 2), std::size_t(0)})
                vertices.push_back(static_cast<float>(box[c]));
        api.icetBoundingVertices(3, ICET_FLOAT, 4 * sizeof(float), 8, vertices.data());
    }
    api.icetDataReplicationGroupColor(setup.groups[static_cast<std::size_t>(rank)]);
    api.icetStrategy(strategy);
    api.icetSingleImageStrategy(single);
    api.icetDrawCallback(draw);
}

struct Outcome {
    bool isNull = true;
    int width = 0, height = 0;
    IceTEnum colorFormat = ICET_IMAGE_COLOR_NONE, depthFormat = ICET_IMAGE_DEPTH_NONE, error = ICET_NO_ERROR;
    std::vector<std::uint8_t> bytes;
    std::vector<float> floats, depth;
    Rect contained;
    std::vector<Rect> asked;
    int empty = 0;
    std::string wrong;
};

std::vector<IceTInt> integers(const Api& api, IceTEnum name, std::size_t most)
{
    std::vector<IceTInt> values(most, -12345);
    api.icetGetIntegerv(name, values.data());
    return values;
}

// Reads the result with all functions that can, and writes to everything that a client may change.
void read(const Api& api, IceTImage image, Outcome& out)
{
    out.isNull = api.icetImageIsNull(image);
    out.width = api.icetImageGetWidth(image);
    out.height = api.icetImageGetHeight(image);
    out.colorFormat = api.icetImageGetColorFormat(image);
    out.depthFormat = api.icetImageGetDepthFormat(image);
    const auto count = static_cast<std::size_t>(api.icetImageGetNumPixels(image));
    const auto expect = [&](bool isFine, const char* what) {
        if (!isFine)
            out.wrong = what;
    };
    if (out.colorFormat == ICET_IMAGE_COLOR_RGBA_UBYTE) {
        const IceTUByte* bytes = api.icetImageGetColorcub(image);
        out.bytes.assign(bytes, bytes + 4 * count);
        std::vector<std::uint8_t> copy(4 * count);
        std::vector<float> converted(4 * count);
        api.icetImageCopyColorub(image, copy.data(), ICET_IMAGE_COLOR_RGBA_UBYTE);
        api.icetImageCopyColorf(image, converted.data(), ICET_IMAGE_COLOR_RGBA_FLOAT);
        expect(copy == out.bytes, "icetImageCopyColorub");
        for (std::size_t i = 0; i < 4 * count; ++i)
            expect(converted[i] == static_cast<float>(copy[i]) / 255.0f, "icetImageCopyColorf");
        IceTUByte* own = api.icetImageGetColorub(image);
        expect(std::equal(out.bytes.begin(), out.bytes.end(), own), "icetImageGetColorub");
        expect(reinterpret_cast<IceTUByte*>(api.icetImageGetColorui(image)) == own, "icetImageGetColorui");
        expect(reinterpret_cast<const IceTUByte*>(api.icetImageGetColorcui(image)) == own, "icetImageGetColorcui");
        std::fill_n(own, 4 * count, IceTUByte{77});
        expect(api.icetImageGetColorcub(image) == own, "a changed image");
    } else if (out.colorFormat != ICET_IMAGE_COLOR_NONE) {
        const std::size_t channels = out.colorFormat == ICET_IMAGE_COLOR_RGBA_FLOAT ? 4 : 3;
        const IceTFloat* floats = api.icetImageGetColorcf(image);
        out.floats.assign(floats, floats + channels * count);
        std::vector<float> copy(channels * count);
        api.icetImageCopyColorf(image, copy.data(), out.colorFormat);
        expect(copy == out.floats, "icetImageCopyColorf");
        std::fill_n(api.icetImageGetColorf(image), channels * count, 77.0f);
    }
    if (out.depthFormat != ICET_IMAGE_DEPTH_NONE) {
        const IceTFloat* depth = api.icetImageGetDepthcf(image);
        out.depth.assign(depth, depth + count);
        std::vector<float> copy(count);
        api.icetImageCopyDepthf(image, copy.data(), ICET_IMAGE_DEPTH_FLOAT);
        expect(copy == out.depth, "icetImageCopyDepthf");
        std::fill_n(api.icetImageGetDepthf(image), count, 0.5f);
    }
}

Outcome makeFrame(const Api& api, const Setup& setup, const View& view, const Picture& picture)
{
    IceTImage image{nullptr};
    Outcome out;
    const Rect wall = setup.wall();
    Pixels pixels(setup.kind, wall.width, wall.height);
    if (setup.draws) {
        drawing = {&api, &setup, &view, &picture, {}, 0, {}};
        image = api.icetDrawFrame(view.projection.data(), view.modelview.data(), view.background.data());
        out.asked = drawing.asked;
        out.empty = drawing.empty;
        out.wrong = drawing.wrong;
    } else {
        for (int y = 0; y < wall.height; ++y)
            for (int x = 0; x < wall.width; ++x)
                pixels.set(x, y, picture, x, y, view.hasLimits && !view.limits.contains(x, y));
        const auto limits = view.limits.values();
        image = api.icetCompositeImage(pixels.color(), pixels.depth.empty() ? nullptr : pixels.depth.data(),
                                       view.hasLimits ? limits.data() : nullptr, view.projection.data(),
                                       view.modelview.data(), view.background.data());
    }
    out.error = api.icetGetError();
    if (out.error == ICET_NO_ERROR)
        read(api, image, out);
    const auto contained = integers(api, ICET_CONTAINED_VIEWPORT, 4);
    out.contained = {contained[0], contained[1], contained[2], contained[3]};
    if (out.contained.width <= 0 || out.contained.height <= 0)
        out.contained = {};
    return out;
}

// ---- the cases

std::vector<std::array<double, 6>> drawBoxes(Random& random, int ranks)
{
    std::vector<std::array<double, 6>> boxes;
    for (int rank = 0; rank < ranks; ++rank) {
        std::array<double, 6> box{};
        for (std::size_t c = 0; c < 3; ++c) {
            // numbers that floats represent exactly
            box[2 * c] = pick(random, -64, 64) / 64.0;
            box[2 * c + 1] = box[2 * c] + pick(random, 0, 64) / 64.0;
        }
        if (chance(random, 0.1))
            box = {FLT_MAX, FLT_MAX, 0, 0, 0, 0}; // how ParaView says that it has nothing
        boxes.push_back(box);
    }
    return boxes;
}

std::vector<IceTInt> drawOrder(Random& random, const std::vector<int>& groups)
{
    std::vector<IceTInt> order(groups.size());
    std::iota(order.begin(), order.end(), 0);
    std::shuffle(order.begin(), order.end(), random);
    // Ranks with the same data follow each other. They share out the pixels, so their order must not matter.
    std::vector<int> first(groups.size(), -1);
    for (std::size_t i = 0; i < order.size(); ++i)
        if (int& place = first[static_cast<std::size_t>(groups[static_cast<std::size_t>(order[i])])]; place < 0)
            place = static_cast<int>(i);
    std::stable_sort(order.begin(), order.end(), [&](IceTInt a, IceTInt b) {
        const auto placeOf = [&](IceTInt rank) {
            return first[static_cast<std::size_t>(groups[static_cast<std::size_t>(rank)])];
        };
        return placeOf(a) < placeOf(b);
    });
    return order;
}

void change(Setup& setup, Random& random, int ranks)
{
    if (setup.tiles.empty() || chance(random, 0.4))
        setup.tiles = drawTiles(random, ranks);
    else if (chance(random, 0.2))
        drawDisplays(random, ranks, setup.tiles);
    if (chance(random, 0.4))
        setup.kind = static_cast<Kind>(pick(random, 0, 5));
    if (setup.groups.empty() || chance(random, 0.3)) {
        setup.groups.resize(static_cast<std::size_t>(ranks));
        std::iota(setup.groups.begin(), setup.groups.end(), 0);
        if (chance(random, 0.3))
            for (int& group : setup.groups)
                group = pick(random, 0, (ranks - 1) / 2);
    }
    setup.order = drawOrder(random, setup.groups);
    setup.ordered = chance(random, 0.7) || setup.replicates();
    setup.corrects = chance(random, 0.5);
    setup.oneBuffer = chance(random, 0.5);
    setup.floats = chance(random, 0.6);
    setup.rendersEmpty = chance(random, 0.3);
    setup.draws = chance(random, 0.5);
    setup.extraWidth = chance(random, 0.5) ? 0 : pick(random, 0, 40);
    setup.extraHeight = chance(random, 0.5) ? 0 : pick(random, 0, 40);
    setup.boxes.clear();
    if (chance(random, 0.5) && !setup.replicates())
        setup.boxes = drawBoxes(random, ranks);
    if (setup.draws && chance(random, 0.5)) // a wall that does not begin at 0
        for (auto& tile : setup.tiles)
            tile.place.x += 13, tile.place.y += 7;
    if (!setup.draws) {
        const Rect wall = setup.wall();
        for (auto& tile : setup.tiles)
            tile.place.x -= wall.x, tile.place.y -= wall.y;
    }
}

View drawView(Random& shared, Random& own, const Setup& setup)
{
    View view;
    for (std::size_t i = 0; i < 4; ++i)
        view.projection[5 * i] = view.modelview[5 * i] = 1;
    view.modelview[12] = real(shared, -0.3, 0.3);
    view.modelview[13] = real(shared, -0.3, 0.3);
    view.modelview[0] = std::cos(0.3), view.modelview[5] = view.modelview[0];
    view.modelview[1] = std::sin(0.3), view.modelview[4] = -view.modelview[1];
    if (chance(shared, 0.5)) { // a frustum; some geometry lies behind the eye
        const double nearest = 0.25, farthest = 8;
        view.projection[0] = real(shared, 0.5, 2), view.projection[5] = real(shared, 0.5, 2);
        view.projection[8] = real(shared, -0.2, 0.2);
        view.projection[10] = -(farthest + nearest) / (farthest - nearest);
        view.projection[11] = -1;
        view.projection[14] = -2 * farthest * nearest / (farthest - nearest);
        view.projection[15] = 0;
        view.modelview[14] = real(shared, -3, -0.5);
    }
    if (chance(shared, 0.5))
        for (float& value : view.background)
            value = static_cast<float>(real(shared, 0, 1));
    view.hasLimits = !setup.draws && chance(shared, 0.5);
    const Rect wall = setup.wall();
    Random& limited = setup.replicates() ? shared : own; // ranks with the same data have the same limits
    view.limits.x = pick(limited, 0, wall.width - 1), view.limits.y = pick(limited, 0, wall.height - 1);
    view.limits.width = pick(limited, 1, wall.width - view.limits.x);
    view.limits.height = pick(limited, 1, wall.height - view.limits.y);
    return view;
}

// Whether IceT does what it documents, as far as its sources tell. Its window for all tiles is overwritten when another
// tile is rendered. It forgets limits that begin left of or below the bounds. If ranks have the same data, it forgets
// limits, too, and counts their shares of overlapping tiles twice.
bool isIceTRight(const Setup& setup, const View& view)
{
    if (view.hasLimits && (!setup.boxes.empty() || setup.replicates()))
        return false;
    return setup.tiles.size() == 1 || (!(setup.draws && setup.floats) && !setup.replicates());
}

class Run {
public:
    Run(const Api& icet, const Api& dfb, MPI_Comm comm) : icet_(icet), dfb_(dfb), comm_(comm), mpi_(comm, traffic_)
    {
        dfb_.find(createCommunicator_, "icetCreateMPICommunicator");
        dfb_.find(destroyCommunicator_, "icetDestroyMPICommunicator");
        for (auto& context : contexts_)
            create(context);
    }
    ~Run()
    {
        for (auto& context : contexts_)
            destroy(context);
    }
    Run(const Run&) = delete;
    Run& operator=(const Run&) = delete;

    // Returns whether this rank found no fault.
    bool check(std::uint64_t seed, int number)
    {
        Random shared(seed * 1000003 + static_cast<std::uint64_t>(number));
        Random own(shared() + static_cast<std::uint64_t>(rank_));
        Context& context = contexts_[static_cast<std::size_t>(pick(shared, 0, 2))];
        number_ = number;
        const auto wrong = failures_;
        if (chance(shared, 0.01)) {
            destroy(context);
            create(context);
            context.setup = {};
        }
        change(context.setup, shared, size_);
        const View view = drawView(shared, own, context.setup);
        const auto pictureOf = [&, all = shared()](int rank) {
            return Picture(all + static_cast<std::uint64_t>(context.setup.groups[static_cast<std::size_t>(rank)]),
                           context.setup.kind);
        };
        const IceTEnum single = anySingle[pick(shared, 0, 3)];
        icet_.icetSetContext(context.icet);
        apply(icet_, context.setup, rank_, ICET_STRATEGY_SEQUENTIAL, single);
        const Outcome theirs = makeFrame(icet_, context.setup, view, pictureOf(rank_));
        dfb_.icetSetContext(context.dfb);
        apply(dfb_, context.setup, rank_, ICET_STRATEGY_SEQUENTIAL, single);
        const Outcome ours = makeFrame(dfb_, context.setup, view, pictureOf(rank_));
        compareStates(context.setup);
        compareCalls(context.setup, view, ours, theirs);
        comparePixels(context.setup, view, ours, theirs, layers(context.setup, view, ours, pictureOf));
        return failures_ == wrong;
    }

    int failures() const { return failures_; }
    int framesAgainstIceT() const { return againstIceT_; }

private:
    struct Context {
        IceTContext icet = nullptr, dfb = nullptr;
        Setup setup;
    };

    void create(Context& context)
    {
        context.icet = icet_.icetCreateContext(&mpi_);
        icet_.icetDiagnostics(ICET_DIAG_OFF);
        IceTCommunicator communicator = createCommunicator_(comm_);
        context.dfb = dfb_.icetCreateContext(communicator);
        destroyCommunicator_(communicator);
    }
    void destroy(Context& context)
    {
        icet_.icetSetContext(context.icet);
        icet_.icetDestroyContext(context.icet);
        dfb_.icetDestroyContext(context.dfb);
    }

    void expect(bool isFine, const std::string& what) { expect(isFine, what.c_str(), -1, -1); }
    void expect(bool isFine, const char* what, int x = -1, int y = -1)
    {
        if (isFine)
            return;
        if (++failures_ <= 10)
            std::fprintf(stderr, "icet differential, rank %d of %d, case %d: %s (%d, %d)\n", rank_, size_, number_,
                         what, x, y);
    }

    void compareStates(const Setup& setup)
    {
        const auto tiles = setup.tiles.size();
        for (const auto& [name, count] :
             std::vector<std::pair<IceTEnum, std::size_t>>{{ICET_RANK, 1},
                                                           {ICET_NUM_PROCESSES, 1},
                                                           {ICET_NUM_TILES, 1},
                                                           {ICET_TILE_VIEWPORTS, 4 * tiles},
                                                           {ICET_GLOBAL_VIEWPORT, 4},
                                                           {ICET_TILE_MAX_WIDTH, 1},
                                                           {ICET_TILE_MAX_HEIGHT, 1},
                                                           {ICET_DISPLAY_NODES, tiles},
                                                           {ICET_TILE_DISPLAYED, 1},
                                                           {ICET_NUM_BOUNDING_VERTS, 1},
                                                           {ICET_STRATEGY, 1},
                                                           {ICET_SINGLE_IMAGE_STRATEGY, 1},
                                                           {ICET_COMPOSITE_MODE, 1},
                                                           {ICET_COMPOSITE_ORDER, setup.order.size()},
                                                           {ICET_PROCESS_ORDERS, setup.order.size()},
                                                           {ICET_COLOR_FORMAT, 1},
                                                           {ICET_DEPTH_FORMAT, 1},
                                                           {ICET_PHYSICAL_RENDER_WIDTH, 1},
                                                           {ICET_PHYSICAL_RENDER_HEIGHT, 1},
                                                           {ICET_DATA_REPLICATION_GROUP_SIZE, 1},
                                                           {ICET_FRAME_COUNT, 1},
                                                           {ICET_BACKGROUND_COLOR_WORD, 1},
                                                           {ICET_TRUE_BACKGROUND_COLOR_WORD, 1},
                                                           {ICET_VALID_PIXELS_TILE, 1},
                                                           {ICET_VALID_PIXELS_OFFSET, 1},
                                                           {ICET_VALID_PIXELS_NUM, 1},
                                                           {ICET_FLOATING_VIEWPORT, 1},
                                                           {ICET_ORDERED_COMPOSITE, 1},
                                                           {ICET_IS_DRAWING_FRAME, 1}})
            expect(integers(dfb_, name, count) == integers(icet_, name, count),
                   "state " + std::to_string(name) + " is another");
        for (const bool single : {false, true}) {
            const auto name = single ? &Api::icetGetSingleImageStrategyName : &Api::icetGetStrategyName;
            expect(std::string((dfb_.*name)()) == (icet_.*name)(), "the name of a strategy");
        }
        expect(dfb_.icetIsEnabled(ICET_FLOATING_VIEWPORT) == icet_.icetIsEnabled(ICET_FLOATING_VIEWPORT), "an option");
        for (const Api* api : {&dfb_, &icet_}) { // in the other types
            IceTEnum mode = 0;
            IceTBitField format = 0;
            std::array<IceTFloat, 4> color{};
            std::array<IceTDouble, 4> same{};
            IceTVoid* callback = nullptr;
            api->icetGetEnumv(ICET_COMPOSITE_MODE, &mode);
            api->icetGetBitFieldv(ICET_COLOR_FORMAT, &format);
            api->icetGetFloatv(ICET_TRUE_BACKGROUND_COLOR, color.data());
            api->icetGetDoublev(ICET_TRUE_BACKGROUND_COLOR, same.data());
            api->icetGetPointerv(ICET_DRAW_FUNCTION, &callback);
            expect(static_cast<IceTInt>(mode) == integers(icet_, ICET_COMPOSITE_MODE, 1)[0], "an enumerator");
            expect(static_cast<IceTInt>(format) == integers(icet_, ICET_COLOR_FORMAT, 1)[0], "bits");
            expect(std::equal(color.begin(), color.end(), same.begin()), "floats");
            expect(callback == reinterpret_cast<IceTVoid*>(draw), "the draw callback");
        }
        for (const IceTEnum name : {ICET_RENDER_TIME, ICET_COMPOSITE_TIME, ICET_TOTAL_DRAW_TIME}) {
            double seconds = -1;
            dfb_.icetGetDoublev(name, &seconds);
            expect(seconds >= 0 && seconds < 100, "a time");
        }
        expect(dfb_.icetGetError() == ICET_NO_ERROR, "a query fails");
    }

    // Compares the calls that the draw callback got.
    void compareCalls(const Setup& setup, const View& view, const Outcome& ours, const Outcome& theirs)
    {
        expect(ours.error == ICET_NO_ERROR, "there is an error");
        expect(ours.wrong.empty(), ours.wrong);
        expect(ours.isNull
                   == (setup.tiles.end()
                       == std::find_if(setup.tiles.begin(), setup.tiles.end(),
                                       [&](const Tile& tile) { return tile.displayRank == rank_; })),
               "an image where none is displayed, or none where one is");
        if (setup.replicates() || (view.hasLimits && !setup.boxes.empty()))
            return;
        expect(ours.contained.values() == theirs.contained.values(), "the contained viewport is another");
        if (!isIceTRight(setup, view))
            return;
        const auto same = [](const Rect& a, const Rect& b) { return a.values() == b.values(); };
        expect(std::equal(ours.asked.begin(), ours.asked.end(), theirs.asked.begin(), theirs.asked.end(), same),
               "another part is asked for");
        expect(ours.empty == theirs.empty, "other empty images are asked for");
    }

    // The layers of all ranks. Of a group of ranks with the same data, only the first rank's counts.
    template <class PictureOf>
    std::vector<Layer> layers(const Setup& setup, const View& view, const Outcome& ours, const PictureOf& pictureOf)
    {
        Rect mine = ours.contained;
        if (setup.replicates())
            mine = view.hasLimits ? intersection(setup.wall(), view.limits) : setup.wall();
        std::vector<int> all(static_cast<std::size_t>(4 * size_));
        MPI_Request request = MPI_REQUEST_NULL;
        MPI_Iallgather(mine.values().data(), 4, MPI_INT, all.data(), 4, MPI_INT, comm_, &request);
        bench::complete(request);
        std::vector<Layer> layers;
        for (int rank = 0; rank < size_; ++rank) {
            const int* part = all.data() + 4 * rank;
            layers.push_back({pictureOf(rank), {part[0], part[1], part[2], part[3]}});
            const auto& groups = setup.groups;
            const auto first = std::find(groups.begin(), groups.end(), groups[static_cast<std::size_t>(rank)]);
            if (first - groups.begin() < rank)
                layers.back().part = {}; // the group is counted already
        }
        return layers;
    }

    static Rect intersection(const Rect& a, const Rect& b)
    {
        const int x = std::max(a.x, b.x), y = std::max(a.y, b.y);
        return {x, y, std::min(a.x + a.width, b.x + b.width) - x, std::min(a.y + a.height, b.y + b.height) - y};
    }

    void comparePixels(const Setup& setup, const View& view, const Outcome& ours, const Outcome& theirs,
                       const std::vector<Layer>& layers)
    {
        const bool isSure = isIceTRight(setup, view) && theirs.error == ICET_NO_ERROR;
        againstIceT_ += isSure;
        const auto tile =
            std::find_if(setup.tiles.begin(), setup.tiles.end(), [&](const Tile& t) { return t.displayRank == rank_; });
        if (tile == setup.tiles.end() || ours.isNull)
            return;
        const bool givesDepth = !isBlend(setup.kind) && (!setup.oneBuffer || setup.kind == Kind::NearestDepth);
        expect(ours.width == tile->place.width && ours.height == tile->place.height, "the size is another");
        expect(ours.depth.empty() != givesDepth, "a depth too much or too little");
        if (isSure)
            expect(ours.colorFormat == theirs.colorFormat && ours.depthFormat == theirs.depthFormat,
                   "the format is another than IceT's");
        const auto background = backgroundOf(setup, view);
        std::vector<const Layer*> order;
        for (int place = 0; place < size_; ++place)
            order.push_back(&layers[static_cast<std::size_t>(
                setup.ordered ? setup.order[static_cast<std::size_t>(place)] : place)]);
        for (int y = 0; y < ours.height; ++y)
            for (int x = 0; x < ours.width; ++x) {
                const int wx = tile->place.x + x, wy = tile->place.y + y;
                const Pixel pixel = isBlend(setup.kind) ? blended(order, setup.kind, background, wx, wy)
                                                        : nearest(layers, setup.kind, background, wx, wy);
                comparePixel(setup, pixel, ours, isSure ? &theirs : nullptr, x, y);
            }
    }

    static std::array<double, 4> backgroundOf(const Setup& setup, const View& view)
    {
        std::array<double, 4> background{};
        for (std::size_t c = 0; c < 4; ++c)
            background[c] = isBytes(setup.kind) ? std::floor(255 * view.background[c]) : view.background[c];
        return background;
    }

    void comparePixel(const Setup& setup, const Pixel& pixel, const Outcome& ours, const Outcome* theirs, int x, int y)
    {
        const std::size_t at =
            static_cast<std::size_t>(y) * static_cast<std::size_t>(ours.width) + static_cast<std::size_t>(x);
        const auto channels = static_cast<std::size_t>(channelsOf(setup.kind));
        const bool asks = theirs && !pixel.isTied;
        for (std::size_t c = 0; c < channels; ++c) {
            const auto value = [&](const Outcome& outcome) -> double {
                return isBytes(setup.kind) ? outcome.bytes[channels * at + c] : outcome.floats[channels * at + c];
            };
            const double exact = pixel.color[c], mine = value(ours);
            if (!isBlend(setup.kind)) {
                expect(mine == exact || (pixel.isTied && setup.replicates()), "the nearest color is wrong", x, y);
                expect(!asks || mine == value(*theirs), "the nearest color is not IceT's", x, y);
                continue;
            }
            const double most = isBytes(setup.kind) ? 255.0 : exact;
            const double rounding = isBytes(setup.kind) ? 0.5 + 1e-9 : 0x1p-24 * std::max(1e-3, exact);
            const double off = isBytes(setup.kind) ? size_ + 1.0 : 1e-5;
            expect(std::abs(mine - std::min(exact, most)) <= rounding, "the blended color is wrong", x, y);
            expect(!asks || std::abs(mine - value(*theirs)) <= off, "the blended color is far from IceT's", x, y);
        }
        if (ours.depth.empty())
            return;
        expect(ours.depth[at] == pixel.depth, "the depth is wrong", x, y);
        expect(!theirs || ours.depth[at] == theirs->depth[at], "the depth is not IceT's", x, y);
    }

    const Api &icet_, &dfb_;
    MPI_Comm comm_;
    bench::IceTTraffic traffic_;
    bench::IceTMpi mpi_;
    IceTCommunicator (*createCommunicator_)(MPI_Comm) = nullptr;
    void (*destroyCommunicator_)(IceTCommunicator) = nullptr;
    int rank_ = rankOf(comm_), size_ = sizeOf(comm_), number_ = 0, failures_ = 0, againstIceT_ = 0;
    std::array<Context, 3> contexts_;
};

int run(int count, char** words)
{
    if (count < 3)
        throw std::runtime_error("usage: test_icet_differential ICET DFB_ICET [--cases N] [--seed S] [--only CASE]");
    std::uint64_t seed = 1;
    int cases = 300, only = -1;
    for (int i = 3; i < count; i += 2) {
        const std::string word = words[i];
        if (word == "--multiple")
            --i;
        else if (i + 1 == count)
            throw std::runtime_error(word + " needs a number");
        else if (word == "--cases")
            cases = std::atoi(words[i + 1]);
        else if (word == "--seed")
            seed = std::strtoull(words[i + 1], nullptr, 10);
        else if (word == "--only")
            only = std::atoi(words[i + 1]);
        else
            throw std::runtime_error("unknown: " + word);
    }
    const Api icet("IceT", words[1]), dfb("dfb_icet", words[2]);
    int failures = 0, all = 0, checked = 0;
    {
        Run run(icet, dfb, MPI_COMM_WORLD);
        for (int number = 0; number < cases; ++number)
            if (only < 0 || number == only)
                run.check(seed, number);
        failures = run.failures();
        checked = run.framesAgainstIceT();
    }
    MPI_Allreduce(&failures, &all, 1, MPI_INT, MPI_SUM, MPI_COMM_WORLD);
    if (rankOf(MPI_COMM_WORLD) == 0)
        std::printf("%d cases from seed %llu on %d ranks, %d of them also against IceT: %d differences\n", cases,
                    static_cast<unsigned long long>(seed), sizeOf(MPI_COMM_WORLD), checked, all);
    return all == 0 ? 0 : 1;
}

} // namespace
} // namespace icet_test

int main(int count, char** words)
{
    const bool isMultiple = std::find(words, words + count, std::string("--multiple")) != words + count;
    int level = 0;
    MPI_Init_thread(&count, &words, isMultiple ? MPI_THREAD_MULTIPLE : MPI_THREAD_SINGLE, &level);
    int status = 1;
    try {
        status = icet_test::run(count, words);
    } catch (const std::exception& e) {
        std::fprintf(stderr, "%s\n", e.what());
        MPI_Abort(MPI_COMM_WORLD, 2);
    }
    MPI_Finalize();
    return status;
}
