// Frames, which make the pictures of the tiles from the images of all ranks; and icetCompositeImage, for images that
// the client has rendered already.
#include "context.hpp"
#include "errors.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <limits>
#include <tuple>

namespace dfb_icet {

namespace {

constexpr float nothing = std::numeric_limits<float>::infinity(); // the depth where no rank has anything

// How the pictures of a frame are made.
struct Plan {
    dfb::ImageBlend blend = dfb::ImageBlend::Nearest;
    dfb::OutputFormat format = dfb::OutputFormat::RGBA8;
    std::array<float, 4> background{}; // that the library puts below the images
    bool givesDepth = false;           // to the client
    bool fillsBackground = false;      // where no rank has a depth, afterwards
    int place = -1;                    // of this rank, from the front
};

// An 8-bit background has IceT's levels, which are rounded down.
std::array<float, 4> backgroundOf(const IceTContextStruct& context)
{
    std::array<float, 4> color = context.frame.background;
    if (context.settings.colorFormat == ICET_IMAGE_COLOR_RGBA_UBYTE)
        for (float& value : color)
            value = static_cast<float>(levelOf(value)) / 255;
    return color;
}

// Throws Error if no picture can be made with the client's settings.
Plan planOf(const IceTContextStruct& context)
{
    const Settings& s = context.settings;
    const bool hasColor = s.colorFormat != ICET_IMAGE_COLOR_NONE, hasDepth = s.depthFormat != ICET_IMAGE_DEPTH_NONE;
    const bool isBytes = s.colorFormat == ICET_IMAGE_COLOR_RGBA_UBYTE;
    Plan plan;
    plan.format = isBytes || !hasColor ? dfb::OutputFormat::RGBA8 : dfb::OutputFormat::RGBA32F;
    if (s.mode == ICET_COMPOSITE_MODE_BLEND) {
        if (!hasColor || colorBytes(s.colorFormat) == 3 * sizeof(float))
            throw Error(ICET_INVALID_OPERATION, "blending needs colors with alpha");
        if (hasDepth)
            raiseWarning("blending", ICET_INVALID_VALUE, "depth has no effect, and the picture has none");
        plan.blend = dfb::ImageBlend::InOrder;
        plan.place = context.rank();
        if (s.isEnabled(ICET_ORDERED_COMPOSITE))
            plan.place = static_cast<int>(std::find(context.order.begin(), context.order.end(), context.rank())
                                          - context.order.begin());
        plan.background = backgroundOf(context); // IceT 2 also does so without ICET_CORRECT_COLORED_BACKGROUND
        return plan;
    }
    if (!hasDepth)
        throw Error(ICET_INVALID_OPERATION, "the nearest pixels cannot be found without depth");
    plan.givesDepth = !hasColor || !s.isEnabled(ICET_COMPOSITE_ONE_BUFFER);
    plan.fillsBackground = hasColor && backgroundOf(context) != std::array<float, 4>{};
    return plan;
}

void useMatrices(IceTContextStruct& context, const View& view)
{
    constexpr std::array<double, 16> identity{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    Frame& frame = context.frame;
    const bool isComplete = view.projection && view.modelview;
    frame.projection = frame.modelview = identity;
    if (view.projection)
        std::copy_n(view.projection, 16, frame.projection.begin());
    if (view.modelview)
        std::copy_n(view.modelview, 16, frame.modelview.begin());
    if (isComplete)
        return;
    if (view.projection || view.modelview)
        raiseWarning("a frame", ICET_INVALID_VALUE, "it has one matrix and not the other");
    if (!context.settings.vertices.empty()) {
        raiseWarning("a frame", ICET_INVALID_VALUE, "it has no matrices, so the bounds of its geometry are of no use");
        context.settings.vertices.clear();
    }
}

// Copies colours, with `background` where there is nothing.
template <class Pixel>
void fillBackground(const dfb::Image& picture, const Pixel& background, std::byte* out)
{
    const float* depth = picture.depth();
    const std::byte* colors = picture.bytes();
    for (std::size_t i = 0; i < picture.pixelCount(); ++i, out += sizeof background, colors += sizeof background)
        std::memcpy(out, depth[i] == nothing ? static_cast<const void*>(background.data()) : colors, sizeof background);
}

void fillBackground(Image& to, const dfb::Image& picture, const std::array<float, 4>& color)
{
    std::byte* out = to.ownColor(picture.pixelCount() * dfb::bytesPerPixel(picture.format()));
    if (picture.format() == dfb::OutputFormat::RGBA32F) {
        fillBackground(picture, color, out);
        return;
    }
    std::array<std::uint8_t, 4> levels{};
    std::transform(color.begin(), color.end(), levels.begin(),
                   [](float value) { return static_cast<std::uint8_t>(std::lround(255 * value)); });
    fillBackground(picture, levels, out);
}

// The colours of a picture as the client wants them; the picture's own, if those are the same.
void takeColor(Image& to, const dfb::Image& picture, const IceTContextStruct& context, const Plan& plan)
{
    to.color = picture.bytes();
    if (plan.fillsBackground)
        fillBackground(to, picture, backgroundOf(context));
    if (to.colorFormat == ICET_IMAGE_COLOR_NONE)
        to.color = nullptr;
    if (const std::size_t bytes = colorBytes(to.colorFormat); bytes == 3 * sizeof(float)) {
        const auto* rgba = static_cast<const float*>(to.color);
        if (to.color != to.owned.data())
            to.ownColor(bytes * to.pixelCount());
        dropAlpha(rgba, to.pixelCount(), reinterpret_cast<float*>(to.owned.data()));
    }
}

// Makes a picture the result of this context. Where there is nothing, its depth is 1, as in IceT.
IceTImage present(IceTContextStruct& context, const dfb::Image& picture, const Plan& plan)
{
    Image& to = context.result;
    to.colorFormat = context.settings.colorFormat;
    to.depthFormat = plan.givesDepth ? ICET_IMAGE_DEPTH_FLOAT : ICET_IMAGE_DEPTH_NONE;
    to.width = picture.width();
    to.height = picture.height();
    takeColor(to, picture, context, plan);
    to.depth = nullptr;
    if (plan.givesDepth) {
        to.ownedDepth.resize(to.pixelCount());
        std::transform(picture.depth(), picture.depth() + to.pixelCount(), to.ownedDepth.begin(),
                       [](float depth) { return depth == nothing ? 1.0f : depth; });
        to.depth = to.ownedDepth.data();
    }
    return {&to};
}

std::vector<dfb::ImageCompositor*> picturesOf(IceTContextStruct& context, const Plan& plan)
{
    std::vector<dfb::ImageCompositor*> all;
    context.pictures.newFrame(context.frame.count);
    for (const Tile& tile : context.settings.tiles)
        all.push_back(
            &context.pictures.find({static_cast<int>(all.size()), tile.viewport.width(), tile.viewport.height(),
                                    tile.displayRank, plan.format, plan.blend, plan.givesDepth || plan.fillsBackground},
                                   context));
    return all;
}

void start(dfb::ImageCompositor& picture, const Source& source, int tile, const Plan& plan, std::int64_t number)
{
    dfb::FrameConfig frame;
    frame.accumulationId = static_cast<std::uint64_t>(number); // so it is an error if ranks have made different calls
    frame.background = plan.background;
    frame.timeout = timeLimit();
    dfb::InputImage input;
    try {
        input = source.input(tile);
    } catch (...) {
        picture.startFailed(std::current_exception(), frame);
        return;
    }
    picture.start(input, plan.place, frame);
}

// Ends all pictures, then throws `failure`, or else the first exception of any of them.
void end(const std::vector<dfb::ImageCompositor*>& pictures, Frame& frame, std::exception_ptr failure)
{
    frame.bytesSent = frame.tilesTouched = frame.tilesTotal = 0;
    for (dfb::ImageCompositor* picture : pictures)
        try {
            const dfb::FrameReport report = picture->end();
            frame.bytesSent += report.bytesSent;
            frame.tilesTouched += report.tilesTouched;
            frame.tilesTotal += report.tilesTotal;
        } catch (...) {
            if (!failure)
                failure = std::current_exception();
        }
    if (failure)
        std::rethrow_exception(failure);
}

void printStatistics(const IceTContextStruct& context)
{
    const Frame& frame = context.frame;
    const Region wall = context.settings.wall();
    std::fprintf(stderr,
                 "dfb_icet: frame %lld, %dx%d in %zu tiles, %s: rendered %.2f ms, composited %.2f ms, %.3f MB sent, "
                 "%lld of %lld blocks touched\n",
                 static_cast<long long>(frame.count), wall.width(), wall.height(), context.settings.tiles.size(),
                 context.settings.mode == ICET_COMPOSITE_MODE_BLEND ? "blended" : "nearest", 1e3 * frame.renderSeconds,
                 1e3 * (frame.totalSeconds - frame.renderSeconds), 1e-6 * static_cast<double>(frame.bytesSent),
                 static_cast<long long>(frame.tilesTouched), static_cast<long long>(frame.tilesTotal));
}

// True while a frame is drawn.
class Drawing {
public:
    explicit Drawing(bool& isDrawing) : isDrawing_(isDrawing)
    {
        if (isDrawing)
            throw Error(ICET_INVALID_OPERATION, "a frame is being drawn already");
        isDrawing = true;
    }
    Drawing(const Drawing&) = delete;
    Drawing& operator=(const Drawing&) = delete;
    ~Drawing() { isDrawing_ = false; }

private:
    bool& isDrawing_;
};

} // namespace

void Pictures::newFrame(std::int64_t frame)
{
    constexpr std::int64_t longAgo = 8;
    entries_.erase(std::remove_if(entries_.begin(), entries_.end(),
                                  [&](const Entry& entry) { return entry.lastUse + longAgo < frame; }),
                   entries_.end());
}

dfb::ImageCompositor& Pictures::find(const Key& key, const IceTContextStruct& context)
{
    const auto values = [](const Key& k) {
        return std::tie(k.tile, k.width, k.height, k.displayRank, k.format, k.blend, k.depth);
    };
    auto place = std::find_if(entries_.begin(), entries_.end(),
                              [&](const Entry& entry) { return values(entry.key) == values(key); });
    if (place == entries_.end()) {
        dfb::FrameBufferConfig config(key.width, key.height, key.format, key.depth);
        config.image.displayRank = key.displayRank;
        config.executor = context.executor;
        try {
            gatherColors(context, 0); // has a time limit, unlike the constructor
        } catch (const Error& e) {
            dfb::ErrorInfo error;
            error.kind = dfb::ErrorKind::Transport;
            error.message = e.what();
            context.connection->giveUp(error);
            throw;
        }
        entries_.push_back({key, 0, std::make_unique<dfb::ImageCompositor>(context.connection, key.blend, config)});
        place = entries_.end() - 1;
    }
    place->lastUse = context.frame.count;
    return *place->compositor;
}

dfb::InputImage inputOf(IceTContextStruct& context, const Image& image, const Region& memory, const Region& part,
                        const Region& tile)
{
    if (intersection(part, tile).empty())
        return {};
    dfb::InputImage input;
    if (image.colorFormat == ICET_IMAGE_COLOR_NONE)
        input.rgba8 = reinterpret_cast<const std::uint8_t*>(image.depth); // any colour, as it is not shown
    else if (!image.color)
        throw Error(ICET_INVALID_VALUE, "an image without colors");
    else if (image.colorFormat == ICET_IMAGE_COLOR_RGBA_UBYTE)
        input.rgba8 = static_cast<const std::uint8_t*>(image.color);
    else if (image.colorFormat == ICET_IMAGE_COLOR_RGBA_FLOAT)
        input.rgba32f = static_cast<const float*>(image.color);
    else
        input.rgba32f = addAlpha(static_cast<const float*>(image.color), regionIn(memory, part), image.width,
                                 image.height, context.withAlpha);
    if (context.settings.mode == ICET_COMPOSITE_MODE_Z_BUFFER) {
        if (!image.depth)
            throw Error(ICET_INVALID_VALUE, "an image without depths");
        input.depth = image.depth;
        input.farDepth = 1;
    }
    input.region = regionIn(tile, memory);
    input.valid = regionIn(tile, part);
    input.staysUntilEnd = !input.rgba32f || input.rgba32f != context.withAlpha.data(); // which the next tile uses again
    return input;
}

IceTImage makeFrame(IceTContextStruct& context, const View& view, const Source& source)
{
    const Drawing drawing(context.isDrawing);
    const double before = secondsNow();
    if (!context.connection)
        throw Error(ICET_INVALID_OPERATION, "MPI has been finalised");
    context.connection->throwIfFailed(); // ranks may still read what was rendered last
    Frame& frame = context.frame;
    ++frame.count;
    frame.isPreRendered = source.limits != nullptr;
    frame.renderSeconds = 0;
    frame.background = {};
    if (view.background)
        std::copy_n(view.background, 4, frame.background.begin());
    useMatrices(context, view);
    const Plan plan = planOf(context);
    findContained(context, source.limits);
    const auto pictures = picturesOf(context, plan);
    std::vector<dfb::ImageCompositor*> begun;
    std::exception_ptr failure;
    try {
        for (dfb::ImageCompositor* picture : pictures) {
            start(*picture, source, static_cast<int>(begun.size()), plan, frame.count);
            begun.push_back(picture);
        }
    } catch (...) {
        failure = std::current_exception();
    }
    end(begun, frame, failure);
    IceTImage result{nullptr};
    if (const int tile = context.settings.tileOf(context.rank()); tile >= 0)
        result = present(context, pictures[static_cast<std::size_t>(tile)]->image(), plan);
    frame.totalSeconds = secondsNow() - before;
    if (wantsStatistics() && context.rank() == 0)
        printStatistics(context);
    return result;
}

extern "C" IceTImage icetCompositeImage(const IceTVoid* color, const IceTVoid* depth, const IceTInt* valid,
                                        const IceTDouble* projection, const IceTDouble* modelview,
                                        const IceTFloat* background)
{
    const auto composite = [&] {
        IceTContextStruct& context = currentContext();
        const Region wall = context.settings.wall();
        const Region limits = valid ? viewport(valid[0], valid[1], valid[2], valid[3]) : wall;
        Image image;
        image.colorFormat = context.settings.colorFormat;
        image.depthFormat = context.settings.depthFormat;
        image.width = wall.width();
        image.height = wall.height();
        image.color = color;
        image.depth = static_cast<const float*>(depth);
        const auto input = [&](int tile) {
            const auto& tiles = context.frame.tiles;
            if (std::find(tiles.begin(), tiles.end(), tile) == tiles.end())
                return dfb::InputImage();
            return inputOf(context, image, wall, context.frame.contained,
                           context.settings.tiles[static_cast<std::size_t>(tile)].viewport);
        };
        return makeFrame(context, {projection, modelview, background}, {&limits, input});
    };
    return guarded("icetCompositeImage", composite);
}

} // namespace dfb_icet
