// icetDrawFrame: the client renders when it is called back, into a window that shows a part of the wall.
#include "context.hpp"
#include "errors.hpp"

#include <algorithm>

namespace dfb_icet {

namespace {

using Matrix = std::array<double, 16>;

// The part of the wall that the client renders for a tile, and what is read of it.
struct Window {
    Region shown;        // as large as icetPhysicalRenderSize() says
    Region part;         // the part of the wall that is read
    bool floats = false; // it shows everything of this rank, for all tiles
};

Window windowFor(const IceTContextStruct& context, const Region& tile)
{
    const Settings& s = context.settings;
    const Region& all = context.frame.contained;
    const int width = s.physicalWidth, height = s.physicalHeight;
    const bool fits = all.width() <= width && all.height() <= height;
    if (s.isEnabled(ICET_FLOATING_VIEWPORT) && fits && intersection(tile, all) != all)
        return {viewport(all.x0, all.y0, width, height), all, true};
    const Region shown = viewport(tile.x0, tile.y0, width, height); // a client may make it smaller than the tile
    return {shown, intersection(intersection(tile, all), shown), false};
}

// Changes `projection` to that of a window on the wall.
Matrix project(const Matrix& projection, const Region& wall, const Region& window)
{
    const double scale[2] = {double(wall.width()) / window.width(), double(wall.height()) / window.height()};
    const double offset[2] = {double(wall.width() + 2 * (wall.x0 - window.x0) - window.width()) / window.width(),
                              double(wall.height() + 2 * (wall.y0 - window.y0) - window.height()) / window.height()};
    Matrix out = projection;
    for (std::size_t column = 0; column < 4; ++column)
        for (std::size_t row = 0; row < 2; ++row)
            out[4 * column + row] = scale[row] * out[4 * column + row] + offset[row] * out[4 * column + 3];
    return out;
}

// Makes room for the client's pixels, in memory that ranks of the node can read.
void prepare(IceTContextStruct& context)
{
    const Settings& s = context.settings;
    Image& image = context.rendered;
    if (s.physicalWidth < 1 || s.physicalHeight < 1)
        throw Error(ICET_INVALID_VALUE, "icetPhysicalRenderSize() has left no pixels");
    const std::size_t color = colorBytes(s.colorFormat),
                      depth = s.depthFormat == ICET_IMAGE_DEPTH_NONE ? 0 : sizeof(float);
    image.colorFormat = s.colorFormat;
    image.depthFormat = s.depthFormat;
    image.width = s.physicalWidth;
    image.height = s.physicalHeight;
    const std::size_t bytes = image.pixelCount() * (color + depth);
    if (image.shared.size() < bytes)
        image.shared = context.connection->pool()->acquire(bytes);
    image.color = color > 0 ? image.shared.data() : nullptr;
    image.depth = depth > 0 ? reinterpret_cast<float*>(image.shared.data() + image.pixelCount() * color) : nullptr;
}

// Calls the client's draw callback. `read` is in coordinates of the window; empty if no pixels are needed.
void callBack(IceTContextStruct& context, const Region& window, const Region& read)
{
    Frame& frame = context.frame;
    if (!context.settings.draw)
        throw Error(ICET_INVALID_OPERATION, "there is nothing to draw: call icetDrawCallback()");
    const bool blends = context.settings.mode == ICET_COMPOSITE_MODE_BLEND;
    const std::array<float, 4> background = blends ? std::array<float, 4>{} : frame.background;
    const Matrix projection = project(frame.projection, context.settings.wall(), window);
    const IceTInt readback[4] = {read.x0, read.y0, read.width(), read.height()};
    const double before = secondsNow();
    context.settings.draw(projection.data(), frame.modelview.data(), background.data(), readback, {&context.rendered});
    frame.renderSeconds += secondsNow() - before;
}

// Renders the tiles of a frame, one after the other.
class Renderer {
public:
    explicit Renderer(IceTContextStruct& context) : context_(context) {}

    dfb::InputImage operator()(int index)
    {
        const Frame& frame = context_.frame;
        const Region& tile = context_.settings.tiles[static_cast<std::size_t>(index)].viewport;
        const Window window = windowFor(context_, tile);
        // icetPhysicalRenderSize() may be so small that the window shows nothing of this rank.
        if (window.part.empty() || std::find(frame.tiles.begin(), frame.tiles.end(), index) == frame.tiles.end()) {
            if (context_.settings.isEnabled(ICET_RENDER_EMPTY_IMAGES))
                render(viewport(tile.x0, tile.y0, window.shown.width(), window.shown.height()), {}, false);
            return {};
        }
        const Region read = regionIn(window.shown, window.part);
        if (!window.floats || !hasFloated_)
            render(window.shown, read, window.floats);
        dfb::InputImage input = inputOf(context_, context_.rendered, window.shown, window.part, tile);
        input.staysUntilEnd =
            input.staysUntilEnd && context_.settings.tiles.size() == 1; // otherwise the next tile is rendered there
        return input;
    }

private:
    void render(const Region& window, const Region& read, bool floats)
    {
        prepare(context_);
        callBack(context_, window, read);
        hasFloated_ = floats;
    }

    IceTContextStruct& context_;
    bool hasFloated_ = false; // the image of all tiles is still in memory
};

} // namespace

extern "C" IceTImage icetDrawFrame(const IceTDouble* projection, const IceTDouble* modelview,
                                   const IceTFloat* background)
{
    return guarded("icetDrawFrame", [&] {
        IceTContextStruct& context = currentContext();
        return makeFrame(context, {projection, modelview, background}, {nullptr, Renderer(context)});
    });
}

} // namespace dfb_icet
