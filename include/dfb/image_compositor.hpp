// ImageCompositor: makes one picture from images that the ranks have already rendered. It needs no camera, bricks or
// tiles:
//
//   dfb::ImageCompositor compositor(communicator, dfb::ImageBlend::Nearest, {width, height});
//   dfb::InputImage mine(pixels, depths);
//   mine.bottomUp = true; // as glReadPixels() gives them
//   mine.farDepth = 1;
//   compositor.composite(mine);
//   if (compositor.isDisplayRank())
//       show(compositor.image());
#pragma once

#include <dfb/compiled.hpp>
#include <dfb/frame.hpp>
#include <dfb/frame/engine.hpp>
#include <dfb/render/link_owners.hpp>

#if defined(DFB_HAS_MPI)
#include <dfb/comm/mpi_transport.hpp>
#endif

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <limits>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// How the images of the ranks become one.
enum class ImageBlend : std::uint8_t {
    Nearest, // the nearest input of each pixel wins: for opaque geometry; a pixel at depth +infinity or NaN is empty
    ByDepth, // each pixel blended front to back by depth; at equal depths the lower rank is in front
    InOrder  // images blended front to back in an order of the ranks; no depth is needed
};

// The image that a rank has rendered, in the program's host memory (not a GPU's). ImageCompositor::start() reads it.
struct InputImage {
    // This rank has nothing to show.
    InputImage() = default;
    // 4 bytes or floats a pixel, and a depth for each. With ImageBlend::InOrder only a picture with depth needs
    // `depths`.
    explicit InputImage(const std::uint8_t* bytes, const float* depths = nullptr) : rgba8(bytes), depth(depths) {}
    explicit InputImage(const float* floats, const float* depths = nullptr) : rgba32f(floats), depth(depths) {}

    // Set one of these two. 8-bit colours are sent as bytes; level k means the float nearest to k / 255. Images in sRGB
    // are blended without decoding them: ask for OutputFormat::RGBA8, which does not encode them again.
    const std::uint8_t* rgba8 = nullptr;
    const float* rgba32f = nullptr;
    const float* depth = nullptr;  // grows away from the camera
    std::ptrdiff_t rowPixels = 0;  // from a row to the next, of colour and depth; 0: the width of `region`
    bool bottomUp = false;         // the first row is the lowest, as in OpenGL
    bool isBgra = false;           // pixels are blue, green, red, alpha
    bool hasStraightAlpha = false; // colours are not multiplied by alpha yet; 8-bit ones then travel as floats
    // A pixel at this depth or beyond is empty; 1 in OpenGL. Infinity: no limit.
    float farDepth = std::numeric_limits<float>::infinity();
    // The part of the picture that the memory holds; pixels outside of the picture are not read. x counts from the
    // left, y from the top, with bottomUp from the bottom. {0, 0, 0, 0}: the whole picture. Any other region of width
    // or height 0: this rank has nothing to show. A region of negative width or height is an error.
    Region region{0, 0, 0, 0};
    // Pixels outside of this part of the picture are empty and not read. Its coordinates are those of `region`. By
    // default it is everything.
    Region valid{0, 0, std::numeric_limits<int>::max(), std::numeric_limits<int>::max()};
    // A promise: the pixels do not change until end() has returned. Premultiplied RGBA pixels then need not be copied:
    // a rank reads its own pixels where they lie, and those of other ranks of its node if they lie in memory of
    // sharedMemory(). composite() sets it by itself.
    bool staysUntilEnd = false;
};

// One object per rank. Construction, destruction, resize(), composite(), end(), imageOnAllRanks() and allGather() are
// collective. One thread at a time may call members, except sharedMemory(), which any thread may call. The work is done
// on all threads of config.executor. Of the other members only start() may wait for other ranks, for room.
class ImageCompositor {
public:
    // Makes a compositor on a connection. config.image: the picture of the display rank. config.framesInFlight becomes
    // 1. Collective. Waits for all ranks. Throws as the constructor of DistributedFrameBuffer.
    ImageCompositor(std::shared_ptr<Connection> connection, ImageBlend blend, FrameBufferConfig config);
#if defined(DFB_HAS_MPI)
    // Makes a compositor on a connection of its own. Waits and throws as above.
    ImageCompositor(MPI_Comm communicator, ImageBlend blend, FrameBufferConfig config, NetworkConfig network = {})
        : ImageCompositor(connect<MpiTransport>(communicator, std::move(network)), blend, std::move(config))
    {
    }
#endif

    ImageCompositor(const ImageCompositor&) = delete;
    ImageCompositor& operator=(const ImageCompositor&) = delete;
    // Collective. Whoever releases the connection last waits for all ranks. Must come before MPI_Finalize(). An open
    // picture fails on all ranks, except that it may end well after start().
    ~ImageCompositor()
    {
        if (engine_->isOpen())
            engine_->leave();
    }

    int rank() const noexcept { return engine_->rank(); }
    int size() const noexcept { return engine_->size(); }
    bool isDisplayRank() const noexcept { return rank() == config().image.displayRank; }
    ImageBlend blend() const noexcept { return blend_; }
    const FrameBufferConfig& config() const noexcept { return engine_->config(); }

    // True: row 0 of image() is the lowest row, as OpenGL takes it. False, the default: the top row. Call it with the
    // same value on all ranks while no picture is open; nobody checks that. Waits for nothing.
    void setBottomUp(bool bottomUp) { bottomUp_ = bottomUp; }

    // Makes one picture from the images of all ranks: start(), then end(). `place` is this rank's place in the order of
    // ImageBlend::InOrder: 0 is in front, and each rank gives a different one. Other blends ignore it. `frame` must
    // have one pass and no samples. If config.executor was not given and this rank's share is one processor, the
    // calling thread does all the work. Collective. Waits as end(). Throws what start() and end() throw.
    FrameReport composite(const InputImage& image, int place, const FrameConfig& frame = {});
    // As above, for ImageBlend::Nearest and ByDepth, which need no place.
    FrameReport composite(const InputImage& image, const FrameConfig& frame = {})
    {
        return composite(image, -1, frame);
    }

    // Begins a picture: reads this rank's image and sends it. Every rank must call start() or startFailed() once for
    // each picture, then end(). The image's memory may be used again when this returns, unless you have promised
    // InputImage::staysUntilEnd. If a thread of the library moves messages and the executor has workers, other ranks
    // need not wait for this one's end(). Waits for another rank only if this one has too much under way
    // (MessageConfig::poolBytes). Throws InvalidArgument if a picture is open, if a field of `frame` is out of range,
    // or on a thread that may not call MPI. Throws TransportError. For a wrong image, `place` or number of samples
    // end() throws, on all ranks.
    void start(const InputImage& image, int place, const FrameConfig& frame = {});
    void start(const InputImage& image, const FrameConfig& frame = {}) { start(image, -1, frame); }
    // In place of start(), on a rank that could not make its image: end() throws a FrameError with the text of `why`
    // on all ranks, this one among them, unless FrameConfig::allowPartial is set. The next picture can be made. Waits
    // for nobody. Throws as start().
    void startFailed(const std::exception_ptr& why, const FrameConfig& frame = {});

    // Whether end() would return without waiting; see DistributedFrameBuffer::Frame::isDone(). False without start().
    // Moves messages if no thread does. Waits for nothing. Throws InvalidArgument on a thread that may not call MPI.
    bool isDone()
    {
        if (!engine_->isOpen())
            return false;
        engine_->requireProgress();
        return engine_->isDone();
    }

    // Ends the picture. Collective. Waits until it is complete on the display rank, or has failed. Throws FrameError,
    // the same on all ranks, after which the next picture can be made; see also FrameConfig::allowPartial. Throws
    // TransportError. Throws InvalidArgument without start(), or on a thread that may not call MPI.
    FrameReport end();

    // The last picture, on the display rank, until the next start(). Empty on other ranks, before the first picture,
    // and after one for which end() threw. Pixels that no image has show FrameConfig::background, at a depth of
    // +infinity.
    const Image& image() const noexcept { return engine_->image(); }

    // As DistributedFrameBuffer::imageOnAllRanks(), between pictures.
    Image imageOnAllRanks() { return engine_->imageOnAllRanks(*engine_); }

    // As DistributedFrameBuffer::sharedMemory(): an image in it need not be copied. After a TransportError do not write
    // to it until the compositor is destroyed.
    Buffer sharedMemory(std::size_t byteCount) const { return connection_->pool()->acquire(byteCount); }

    // As DistributedFrameBuffer::allGather(), between pictures.
    std::vector<std::vector<std::byte>> allGather(const std::vector<std::byte>& bytes, const char* call = "allGather()")
    {
        return engine_->allGather(bytes, call);
    }

    // Changes the size of the picture; image() is empty then. Collective. Waits for all ranks. Throws InvalidArgument
    // on this rank if a picture is open; on all ranks if the size is not 1 to 65536 or differs between ranks, or if
    // memory is short. Throws TransportError.
    void resize(int width, int height);

private:
    std::unique_ptr<detail::Operations> makeOperations(const ImageConfig& image) const;
    void makeEngine(const FrameBufferConfig& config);
    TileOwners findOwners();
    void begin(const FrameConfig& frame);
    void send(const InputImage& image, int place);

    std::shared_ptr<Connection> connection_;
    std::shared_ptr<ThreadExecutor> oneThread_; // made here, for a rank with one processor
    ImageBlend blend_;
    bool bottomUp_ = false;
    std::unique_ptr<detail::Operations> operations_;
    std::unique_ptr<detail::Engine> engine_;
    std::vector<TileInput> inputs_;
    // Used only if ranks are on several nodes:
    std::optional<detail::LinkOwners> owners_;
    std::vector<Region> regions_, nextRegions_; // of each rank's image in the last picture; empty: it had none
    TileOwners regionOwners_;                   // by regions_; null: not found yet
};

DFB_NAMESPACE_END

#if DFB_HAS_BODIES
#include <dfb/frame/frame_engine.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/render/visibility.hpp>

DFB_NAMESPACE_BEGIN

namespace detail {

// Blends inputs front to back by their source, which is the `place` of their rank.
using BlendBySource = SortLast<BlendRule::InOrder, 64, colorChannel | depthChannel>;

// On one node the tiles are strips, as wide as the picture (at most 4096 pixels). A strip is one piece of memory in
// each image. A square tile of as many pixels touches a page of memory for each of its rows, which takes up to 1.5
// times as long. 4 strips a rank share the work well enough. Smaller strips than 4096 pixels cost more to send than to
// blend.
//
// Between nodes, sent bytes cost more than touched pages. Tiles are square there, and small compared with most images.
// So many tiles have pixels of one rank alone. That rank owns them, and their pixels are sent only once.
template <class TileOp>
std::unique_ptr<Operations> imageOperations(const char* name, const ImageConfig& image, int ranks, bool isOneNode)
{
    auto traits = OperationTraits::of<TileOp, NoPixelOp>();
    traits.tileOp = name;
    traits.tileWidth = traits.tileHeight = 64;
    if (isOneNode) {
        traits.tileWidth = std::clamp(image.width, 1, 4096);
        const std::int64_t share = std::int64_t{image.width} * image.height / (4 * ranks);
        const std::int64_t rows = std::clamp<std::int64_t>(share, 4096, 32768) / traits.tileWidth;
        traits.tileHeight = static_cast<int>(std::clamp<std::int64_t>(rows, 1, 256));
    }
    return std::make_unique<OperationsOf<TileOp, NoPixelOp>>(NoPixelOp(), std::move(traits));
}

// A rank's region of the picture as a Figure, which all ranks get with the verdict: the key has the rank and the upper
// left pixel, the value the lower right one.
inline Figure figureOf(int rank, const Region& r)
{
    return {static_cast<std::uint64_t>(rank) << 32 | static_cast<std::uint32_t>(r.x0) << 16
                | static_cast<std::uint32_t>(r.y0),
            65536.0 * (r.x1 - 1) + (r.y1 - 1)};
}
inline Region regionOf(const Figure& figure)
{
    if (!(figure.value >= 0 && figure.value < 0x1p32)) // a message can be damaged
        return {};
    const auto first = static_cast<std::uint32_t>(figure.key), last = static_cast<std::uint32_t>(figure.value);
    const auto low = [](std::uint32_t bits) { return static_cast<int>(bits & 0xffff); };
    return {low(first >> 16), low(first), low(last >> 16) + 1, low(last) + 1};
}

// The part of an input image that is in one tile, as a view of pixels that a framebuffer takes.
class InputTile {
public:
    using View = TileView<colorChannel | depthChannel, 64>;
    struct Converted {
        std::vector<float> color, depth;
        std::vector<std::uint8_t> color8;
    };

    // `isFlipped`: the image's first row is the last of the picture. `usesDepth`: whether depths are sent.
    InputTile(const InputImage& image, const Region& region, const TileLayout& layout, bool isFlipped, bool usesDepth)
        : image_(image), held_(region), height_(layout.height()), isFlipped_(isFlipped)
    {
        hasFarDepth_ = image.depth && image.farDepth < std::numeric_limits<float>::infinity();
        isConverted_ = image.hasStraightAlpha || image.isBgra || (hasFarDepth_ && !usesDepth);
        valid_ = intersection(intersection(held_, image.valid), {0, 0, layout.width(), layout.height()});
        if (isFlipped)
            valid_ = {valid_.x0, height_ - valid_.y1, valid_.x1, height_ - valid_.y0};
    }

    const Region& valid() const noexcept { return valid_; } // in the picture

    // Returns where the pixels of the tile `view` are, and points `view` to them. Pixels that have to be converted are
    // written to `converted`.
    InputPixels find(View& view, Converted& converted) const
    {
        const std::ptrdiff_t rowPixels = image_.rowPixels != 0 ? image_.rowPixels : held_.width();
        const std::ptrdiff_t row =
            std::ptrdiff_t{isFlipped_ ? height_ - 1 - view.region.y0 : view.region.y0} - held_.y0;
        const std::ptrdiff_t first = row * rowPixels + (std::ptrdiff_t{view.region.x0} - held_.x0);
        view.valid = valid_;
        view.stride = isFlipped_ ? -rowPixels : rowPixels;
        view.color8 = image_.rgba8 ? image_.rgba8 + 4 * first : nullptr;
        view.color = image_.rgba32f ? image_.rgba32f + 4 * first : nullptr;
        view.depth = image_.depth ? image_.depth + first : nullptr;
        if (isConverted_) {
            convert(view, converted);
            return InputPixels(view);
        }
        view.staysUntilEnd = image_.staysUntilEnd;
        InputPixels pixels(view);
        pixels.depthLimit = image_.farDepth;
        return pixels;
    }

private:
    // Copies the valid pixels, converted to what a framebuffer takes.
    void convert(View& view, Converted& to) const
    {
        const Region some = intersection(view.region, valid_);
        const bool staysBytes = view.color8 && !image_.hasStraightAlpha;
        const int width = view.region.width();
        const auto pixels = static_cast<std::size_t>(width) * static_cast<std::size_t>(view.region.height());
        to.color.resize(staysBytes ? 0 : 4 * pixels);
        to.color8.resize(staysBytes ? 4 * pixels : 0);
        to.depth.resize(view.depth ? pixels : 0);
        const int red = image_.isBgra ? 2 : 0, blue = 2 - red;
        for (int y = some.y0 - view.region.y0; y < some.y1 - view.region.y0; ++y)
            for (int x = some.x0 - view.region.x0; x < some.x1 - view.region.x0; ++x) {
                const std::ptrdiff_t from = y * view.stride + x, at = y * width + x;
                const bool isEmpty = hasFarDepth_ && view.depth[from] >= image_.farDepth;
                if (view.depth)
                    to.depth.data()[at] = isEmpty ? std::numeric_limits<float>::infinity() : view.depth[from];
                if (staysBytes) {
                    const std::uint8_t* in = view.color8 + 4 * from;
                    std::uint8_t* out = to.color8.data() + 4 * at;
                    out[0] = in[red], out[1] = in[1], out[2] = in[blue], out[3] = in[3];
                    std::fill_n(out, isEmpty ? 4 : 0, std::uint8_t{0});
                } else {
                    const auto value = [&](int c) {
                        return view.color8 ? static_cast<float>(view.color8[4 * from + c]) / 255.0f
                                           : view.color[4 * from + c];
                    };
                    const float alpha = value(3), factor = image_.hasStraightAlpha ? alpha : 1.0f;
                    float* out = to.color.data() + 4 * at;
                    out[0] = value(red) * factor, out[1] = value(1) * factor, out[2] = value(blue) * factor;
                    out[3] = alpha;
                    std::fill_n(out, isEmpty ? 4 : 0, 0.0f);
                }
            }
        view.stride = width;
        view.color8 = staysBytes ? to.color8.data() : nullptr;
        view.color = staysBytes ? nullptr : to.color.data();
        view.depth = view.depth ? to.depth.data() : nullptr;
    }

    const InputImage& image_;
    Region held_, valid_;
    int height_;
    bool isFlipped_, isConverted_, hasFarDepth_;
};

} // namespace detail

DFB_COMPILED_ONCE ImageCompositor::ImageCompositor(std::shared_ptr<Connection> connection, ImageBlend blend,
                                                   FrameBufferConfig config)
    : connection_(std::move(connection)), blend_(blend)
{
    config.framesInFlight = 1;
    if (!config.executor) {
        const auto threads = detail::makeThreads(*connection_);
        config.executor = threads;
        if (threads->concurrency() == 1)
            oneThread_ = threads;
    }
    makeEngine(config);
}

DFB_COMPILED_ONCE std::unique_ptr<detail::Operations> ImageCompositor::makeOperations(const ImageConfig& image) const
{
    const int ranks = connection_->size();
    const bool isOneNode = !owners_ || owners_->isOneNode();
    switch (blend_) {
    case ImageBlend::ByDepth:
        return detail::imageOperations<AlphaBlend>("ImageBlend::ByDepth", image, ranks, isOneNode);
    case ImageBlend::InOrder:
        return detail::imageOperations<detail::BlendBySource>("ImageBlend::InOrder", image, ranks, isOneNode);
    case ImageBlend::Nearest: break;
    }
    return detail::imageOperations<DepthComposite>("ImageBlend::Nearest", image, ranks, isOneNode);
}

DFB_COMPILED_ONCE void ImageCompositor::makeEngine(const FrameBufferConfig& config)
{
    std::unique_ptr<detail::Operations> operations;
    connection_->giveUpWithoutMemory([&] {
        operations = makeOperations(config.image);
        engine_ = detail::makeEngine(connection_, config, *operations, 0);
    });
    operations_ = std::move(operations);
    regions_.clear();
    regionOwners_ = nullptr;
    if (owners_)
        return;
    owners_.emplace(engine_->nodeOf());
    if (owners_->isOneNode())
        return;
    regions_.reserve(static_cast<std::size_t>(size()));
    nextRegions_.reserve(static_cast<std::size_t>(size()));
    makeEngine(config); // with square tiles
}

// Finds owners by the regions of the last picture, because those of this one are not known yet. Returns null if no
// regions are known, or none are needed.
DFB_COMPILED_ONCE TileOwners ImageCompositor::findOwners()
{
    if (regions_.empty() || config().image.ownerMap)
        return nullptr;
    if (regionOwners_)
        return regionOwners_;
    const TileLayout& layout = engine_->layout();
    owners_->start(layout);
    for (const std::vector<int>& ranks : owners_->byNode())
        for (const int rank : ranks)
            detail::forEachTile(regions_[static_cast<std::size_t>(rank)], layout,
                                [&](int tile, const Region& pixels) { owners_->add(tile, pixels, rank); });
    regionOwners_ =
        owners_->find(config(), blend_ != ImageBlend::InOrder, [this](int tile) { return engine_->tileOwner(tile); });
    return regionOwners_;
}

DFB_COMPILED_ONCE void ImageCompositor::resize(int width, int height)
{
    if (engine_->isOpen())
        detail::failArgument("resize() while a picture is open: end() it first");
    connection_->giveUpWithoutMemory([&] {
        FrameBufferConfig config = engine_->config();
        config.image.width = width;
        config.image.height = height;
        engine_->allGather({}, "resize()"); // the new engine does not hear of other calls
        makeEngine(config);
    });
}

DFB_COMPILED_ONCE void ImageCompositor::begin(const FrameConfig& frame)
{
    if (engine_->isOpen())
        detail::failArgument("start() while a picture is open: end() it first");
    FrameConfig declared = frame;
    declared.passes = 1;
    declared.samples = nullptr;
    declared.declared = true;
    std::exception_ptr failure; // end() throws it on all ranks
    try {
        if (!declared.owners)
            declared.owners = findOwners();
    } catch (...) {
        failure = std::current_exception();
    }
    if (declared.maxLayers == 0)
        declared.maxLayers = size();
    engine_->begin(declared, [&] {
        if (failure)
            std::rethrow_exception(failure);
    });
}

DFB_COMPILED_ONCE void ImageCompositor::startFailed(const std::exception_ptr& why, const FrameConfig& frame)
{
    begin(frame);
    engine_->abort(engine_->frame(), why, -1);
    engine_->closeInputs();
}

DFB_COMPILED_ONCE void ImageCompositor::start(const InputImage& image, int place, const FrameConfig& frame)
{
    begin(frame);
    try {
        if (frame.passes != 1 || frame.samples)
            detail::failArgument("a picture of images has one sample a pixel");
        send(image, place);
    } catch (...) {
        engine_->abort(engine_->frame(), std::current_exception(), -1);
    }
    // A vote with checksums says whether pixels that must stay have changed, so that has to wait for end().
    if (!image.staysUntilEnd || !connection_->config().checksums)
        engine_->closeInputs();
}

DFB_COMPILED_ONCE FrameReport ImageCompositor::composite(const InputImage& image, int place, const FrameConfig& frame)
{
    // On one processor this thread does all the work, including the progress thread's, as it has to wait anyway.
    std::optional<Connection::StandIn> standIn;
    const auto wake = [](ThreadExecutor* threads) { threads->rest(false); };
    const std::unique_ptr<ThreadExecutor, decltype(wake)> resting(oneThread_.get(), wake);
    if (resting) {
        resting->rest(true);
        standIn.emplace(*connection_);
    }
    InputImage staying = image;
    staying.staysUntilEnd = true;
    start(staying, place, frame);
    return end();
}

DFB_COMPILED_ONCE FrameReport ImageCompositor::end()
{
    if (!engine_->isOpen())
        detail::failArgument("end() without start()");
    engine_->requireProgress();
    FrameReport report = engine_->end();
    const std::vector<Figure> figures = std::exchange(report.figures, {});
    nextRegions_.assign(figures.empty() ? 0 : static_cast<std::size_t>(size()), {});
    for (const Figure& figure : figures)
        if (const std::uint64_t rank = figure.key >> 32; rank < nextRegions_.size()) // a message can be damaged
            nextRegions_[rank] = detail::regionOf(figure);
    if (nextRegions_ != regions_) {
        regions_.swap(nextRegions_);
        regionOwners_ = nullptr;
    }
    return report;
}

// Declares and sends the tiles that the image covers at least in part.
DFB_COMPILED_ONCE void ImageCompositor::send(const InputImage& image, int place)
{
    const TileLayout& layout = engine_->layout();
    const Region region = image.region == Region{} ? Region{0, 0, layout.width(), layout.height()} : image.region;
    const auto isRange = [](int begin, int end) {
        return begin <= end && end <= std::int64_t{begin} + std::numeric_limits<int>::max();
    };
    if (!isRange(region.x0, region.x1) || !isRange(region.y0, region.y1))
        detail::failArgument("an image of columns %d to %d and rows %d to %d", region.x0, region.x1, region.y0,
                             region.y1);
    if (image.depth && !image.rgba8 && !image.rgba32f && !region.empty())
        detail::failArgument("an image with depth and without colour");
    const bool isThere = (image.rgba8 || image.rgba32f) && !region.empty();
    const bool usesDepth = (engine_->sent() & depthChannel) != 0;
    if (isThere && usesDepth && !image.depth)
        detail::failArgument("an image without depth: %s", blend_ == ImageBlend::InOrder
                                                               ? "the picture is to have depth"
                                                               : "images that are not blended in order need it");
    if (std::isnan(image.farDepth))
        detail::failArgument("farDepth is not a number");
    if (image.rowPixels != 0 && image.rowPixels < region.width())
        detail::failArgument("rows of %d pixels that are %lld pixels apart", region.width(),
                             static_cast<long long>(image.rowPixels));
    if (image.rgba8 && image.rgba32f)
        detail::failArgument("an image of 8 bits and of floats");
    if (isThere && blend_ == ImageBlend::InOrder && (place < 0 || place >= size()))
        detail::failArgument(
            "place %d in an order of %d ranks: each rank gives its own to composite(), from 0, in front, to %d", place,
            size(), size() - 1);
    const detail::InputTile part(image, region, layout, image.bottomUp != bottomUp_, usesDepth);
    const auto source = static_cast<std::uint32_t>(blend_ == ImageBlend::InOrder ? place : rank());
    inputs_.clear();
    if (isThere)
        detail::forEachTile(part.valid(), layout, [&](int tile, const Region&) {
            inputs_.push_back({tile, source, 0});
        });
    if (!inputs_.empty() && !owners_->isOneNode()) {
        const Figure figure = detail::figureOf(rank(), part.valid());
        engine_->addFigure(figure.key, figure.value);
    }
    engine_->declare(inputs_);
    const auto sendTile = [&](std::size_t i) {
        if (engine_->failed())
            return;
        const detail::FloatEnvironment floatEnvironment; // straight alpha is multiplied here
        detail::InputTile::View view;
        static_cast<TileHeader&>(view) = engine_->headerOf(inputs_[i].tile, 0);
        view.generation = 1;
        view.source = source;
        static thread_local detail::InputTile::Converted converted; // keeps its memory from tile to tile
        engine_->setTile(part.find(view, converted));
    };
    engine_->parallelFor(inputs_.size(), sendTile);
}

DFB_NAMESPACE_END
#endif
