// The functions of dfb.h, on dfb::ImageCompositor and dfb::DataParallelLoop.
#include "dfb.h"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <exception>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <variant>

namespace {

// ---- errors

thread_local char lastError[1024] = ""; // not a string: there may be no memory for one

int failed(int status, const char* text) noexcept
{
    std::snprintf(lastError, sizeof lastError, "%s", text);
    return status;
}

// Calls body(). An exception becomes a status, and its text the last error.
template <class Body>
int guarded(const Body& body) noexcept
{
    try {
        body();
        return DFB_OK;
    } catch (const dfb::InvalidArgument& e) {
        return failed(DFB_INVALID_ARGUMENT, e.what());
    } catch (const dfb::FrameError& e) {
        return failed(DFB_FRAME_FAILED, e.what());
    } catch (const dfb::TransportError& e) {
        return failed(DFB_TRANSPORT_FAILED, e.what());
    } catch (const std::bad_alloc& e) {
        return failed(DFB_OUT_OF_MEMORY, e.what());
    } catch (const std::exception& e) {
        return failed(DFB_FAILED, e.what());
    } catch (...) {
        return failed(DFB_FAILED, "an exception of an unknown type");
    }
}

[[noreturn]] void refuse(const std::string& text) { throw dfb::InvalidArgument(text); }

// Returns a struct that the program gave. Throws InvalidArgument if its size is not that of the dfb.h that this was
// compiled with.
template <class Struct>
const Struct& checked(const Struct* given, const char* name)
{
    if (!given)
        refuse(std::string("a null ") + name);
    if (given->struct_size != sizeof(Struct))
        refuse(std::string("a ") + name + " of " + std::to_string(given->struct_size) + " bytes, where version "
               + dfb_version() + " has " + std::to_string(sizeof(Struct)) + ": fill it by " + name
               + "_init(), and compile with the dfb.h of this library");
    return *given;
}

// ---- the structs of dfb.h, converted to those of the library

dfb::FrameBufferConfig configOf(const dfb_config& given)
{
    const auto format = [&] {
        switch (given.format) {
        case DFB_RGBA8: return dfb::OutputFormat::RGBA8;
        case DFB_SRGBA8: return dfb::OutputFormat::SRGBA8;
        case DFB_RGBA32F: return dfb::OutputFormat::RGBA32F;
        default: refuse("there is no dfb_format " + std::to_string(given.format));
        }
    };
    dfb::FrameBufferConfig config(given.width, given.height, format(), given.depth != 0);
    config.image.displayRank = given.display_rank;
    return config;
}

dfb::ImageBlend blendOf(const dfb_config& given)
{
    switch (given.blend) {
    case DFB_NEAREST: return dfb::ImageBlend::Nearest;
    case DFB_BY_DEPTH: return dfb::ImageBlend::ByDepth;
    case DFB_IN_ORDER: return dfb::ImageBlend::InOrder;
    default: refuse("there is no dfb_blend " + std::to_string(given.blend));
    }
}

std::shared_ptr<dfb::Executor> executorOf(const dfb_config& given, const dfb::Connection& connection)
{
    if (given.threads < 0)
        refuse(std::to_string(given.threads) + " threads");
    if (given.threads == 1)
        return std::make_shared<dfb::CallerExecutor>();
    return std::make_shared<dfb::ThreadExecutor>(given.threads == 0 ? connection.threadShare() : given.threads);
}

dfb::Region regionOf(const int (&given)[4]) { return {given[0], given[1], given[2], given[3]}; }

dfb::InputImage imageOf(const dfb_input& given)
{
    dfb::InputImage image;
    image.rgba8 = given.rgba8;
    image.rgba32f = given.rgba32f;
    image.depth = given.depth;
    image.rowPixels = given.row_pixels;
    image.bottomUp = given.bottom_up != 0;
    image.isBgra = given.is_bgra != 0;
    image.hasStraightAlpha = given.has_straight_alpha != 0;
    image.farDepth = given.far_depth;
    image.region = regionOf(given.region);
    image.valid = regionOf(given.valid);
    return image;
}

dfb::MatrixCamera cameraOf(const double* view, const double* projection)
{
    if (!view || !projection)
        refuse("a null matrix");
    float viewMatrix[16], projectionMatrix[16];
    for (int i = 0; i < 16; ++i) {
        viewMatrix[i] = static_cast<float>(view[i]);
        projectionMatrix[i] = static_cast<float>(projection[i]);
    }
    return dfb::MatrixCamera(viewMatrix, projectionMatrix);
}

// The bricks and the renderer of this rank. `world` has the bricks in the order of the program's array.
struct Scene {
    Scene(const dfb_brick* given, int count, dfb_render_brick renderer, void* userData)
        : bricks(given), render(renderer), user(userData)
    {
        if (count < 0)
            refuse(std::to_string(count) + " bricks");
        if (count > 0 && !given)
            refuse("a null array of bricks");
        if (!renderer)
            refuse("a null renderer");
        for (int i = 0; i < count; ++i) {
            const auto pointOf = [](const float(&p)[3]) { return dfb::Vec3{p[0], p[1], p[2]}; };
            world.add({given[i].id, {pointOf(given[i].lower), pointOf(given[i].upper)}});
        }
    }

    template <class Tile>
    void operator()(const dfb::Brick& brick, Tile& tile, const dfb::TileLayout& layout) const
    {
        const dfb::Region& r = tile.region;
        const dfb_tile pixels{r.x0,       r.y0,       r.x1,      r.y1, layout.width(), layout.height(),
                              Tile::size, tile.color, tile.depth};
        if (const int code = render(bricks + (&brick - world.bricks().data()), &pixels, user); code != 0)
            throw std::runtime_error("the renderer of brick " + std::to_string(brick.id) + " returned "
                                     + std::to_string(code));
    }

    dfb::World world;
    const dfb_brick* bricks;
    dfb_render_brick render;
    void* user;
};

// A framebuffer for pictures of bricks. Calls of its members are collective.
using BrickPicture =
    std::variant<dfb::DistributedFrameBuffer<dfb::AlphaBlend>, dfb::DistributedFrameBuffer<dfb::DepthComposite>>;

} // namespace

// Makes pictures of images and of bricks over one connection. The compositor of images is made at once, which compares
// the configurations of the ranks; the framebuffer of bricks is made when it is first needed.
struct dfb_framebuffer {
    // Collective. All ranks throw InvalidArgument if `given` is wrong on any rank, or if any has no place to store the
    // result at.
    dfb_framebuffer(std::shared_ptr<dfb::Connection> ranks, const dfb_config* given, bool hasPlace)
        : connection(std::move(ranks))
    {
        try {
            if (!hasPlace)
                refuse("a null pointer to store the framebuffer at");
            const dfb_config& config = checked(given, "dfb_config");
            blend = blendOf(config);
            frameBufferConfig = configOf(config);
            frameBufferConfig.executor = executorOf(config, *connection);
            std::copy_n(config.background, 4, frame.background.begin());
            if (config.timeout_ms < 0)
                refuse("a timeout_ms of " + std::to_string(config.timeout_ms));
            frame.timeout = std::chrono::milliseconds(config.timeout_ms);
        } catch (const std::exception& e) {
            // If an owner map throws on one rank, the library reports this on all ranks.
            frameBufferConfig = dfb::FrameBufferConfig(1, 1);
            frameBufferConfig.image.ownerMap = [text = reasonOf(e)](int, const dfb::TileLayout&, int) -> int {
                throw std::invalid_argument(text);
            };
        }
        images = std::make_unique<dfb::ImageCompositor>(connection, blend, frameBufferConfig);
    }

    static std::string reasonOf(const std::exception& e)
    {
        const auto* error = dynamic_cast<const dfb::Error*>(&e);
        return error ? error->info().message : e.what();
    }

    const dfb::Image& image() const
    {
        if (!everywhere.empty())
            return everywhere;
        if (!showsBricks)
            return images->image();
        return std::visit([](const auto& framebuffer) -> const dfb::Image& { return framebuffer.image(); }, *bricks);
    }

    std::shared_ptr<dfb::Connection> connection;
    dfb::ImageBlend blend = dfb::ImageBlend::Nearest;
    dfb::FrameBufferConfig frameBufferConfig;
    dfb::FrameConfig frame;
    std::unique_ptr<dfb::ImageCompositor> images;
    std::optional<BrickPicture> bricks;
    bool showsBricks = false; // the last picture
    dfb::Image everywhere;    // the last picture, if this rank has asked for a copy
    std::optional<dfb::FrameReport> report;
    bool isBusy = false;
};

namespace {

// Throws TransportError if MPI has been finalised: it ends a process that calls it then.
void requireMpi()
{
    int isFinalized = 0;
    MPI_Finalized(&isFinalized);
    if (isFinalized)
        throw dfb::TransportError("MPI has been finalised");
}

// Calls body(framebuffer). It is an error if the framebuffer is in another call, as when a renderer calls a function on
// it.
template <class Body>
int inFramebuffer(dfb_framebuffer* framebuffer, const Body& body) noexcept
{
    return guarded([&] {
        if (!framebuffer)
            refuse("a null dfb_framebuffer");
        requireMpi();
        if (framebuffer->isBusy)
            refuse("this framebuffer is in another call: a renderer cannot call functions on it");
        framebuffer->isBusy = true;
        struct Done {
            bool& isBusy;
            ~Done() { isBusy = false; }
        } done{framebuffer->isBusy};
        body(*framebuffer);
    });
}

// Makes a picture with make(), which returns its report. If that throws InvalidArgument, the picture was not begun, and
// the last one is still shown.
template <class Make>
void makePicture(dfb_framebuffer& fb, bool showsBricks, const Make& make)
{
    const bool showedBricks = std::exchange(fb.showsBricks, showsBricks);
    dfb::Image copy = std::exchange(fb.everywhere, {});
    try {
        fb.report = make();
    } catch (const dfb::InvalidArgument&) {
        fb.showsBricks = showedBricks;
        fb.everywhere = std::move(copy);
        throw;
    }
}

// The picture, for the functions that return its colour or depth; null if there is none.
const dfb::Image* shownImage(const dfb_framebuffer* framebuffer)
{
    if (!framebuffer || framebuffer->isBusy || framebuffer->image().empty())
        return nullptr;
    return &framebuffer->image();
}

template <class Struct>
void store(const Struct& from, Struct* to, std::size_t structSize)
{
    static_assert(std::is_trivially_copyable_v<Struct>);
    if (to)
        std::memcpy(to, &from, std::min(sizeof from, structSize));
}

} // namespace

extern "C" {

void dfb_config_init_sized(dfb_config* config, size_t struct_size, int width, int height)
{
    dfb_config all{};
    all.struct_size = struct_size;
    all.width = width;
    all.height = height;
    all.blend = DFB_BY_DEPTH;
    all.format = DFB_SRGBA8;
    all.threads = 1;
    store(all, config, struct_size);
}

int dfb_create(MPI_Comm communicator, const dfb_config* config, dfb_framebuffer** framebuffer)
{
    // They end after an exception that all ranks get, in order.
    std::shared_ptr<dfb::Connection> connection;
    std::unique_ptr<dfb_framebuffer> made;
    const int status = guarded([&] {
        if (communicator == MPI_COMM_NULL)
            refuse("the communicator is MPI_COMM_NULL");
        connection = dfb::connect(communicator);
        try {
            made = std::make_unique<dfb_framebuffer>(connection, config, framebuffer != nullptr);
        } catch (const dfb::Error&) {
            throw;
        } catch (const std::exception& e) { // on this rank alone: the others would wait for it
            connection->giveUp(dfb::detail::errorInfo(dfb::ErrorKind::Transport, e.what(), connection->rank()));
            throw;
        }
    });
    if (framebuffer)
        *framebuffer = made.release();
    return status;
}

int dfb_create_fortran(MPI_Fint communicator, const dfb_config* config, dfb_framebuffer** framebuffer)
{
    int isInitialized = 0; // if it is 0, the handle cannot be converted; dfb_create() then reports that
    MPI_Initialized(&isInitialized);
    return dfb_create(isInitialized ? MPI_Comm_f2c(communicator) : MPI_COMM_WORLD, config, framebuffer);
}

void dfb_destroy(dfb_framebuffer* framebuffer)
{
    if (framebuffer && framebuffer->isBusy)
        failed(DFB_INVALID_ARGUMENT, "this framebuffer is in another call: a renderer cannot destroy it");
    else
        delete framebuffer;
}

int dfb_resize(dfb_framebuffer* framebuffer, int width, int height)
{
    return inFramebuffer(framebuffer, [&](dfb_framebuffer& fb) {
        if (fb.showsBricks) // another rank may have called dfb_image_on_all_ranks() on it
            std::visit([](auto& bricks) { bricks.allGather({}, "resize()"); }, *fb.bricks);
        fb.images->resize(width, height); // if this throws, nothing has changed
        fb.everywhere = {};
        fb.showsBricks = false;
        fb.bricks.reset(); // is made anew when it is needed
        fb.frameBufferConfig.image.width = width;
        fb.frameBufferConfig.image.height = height;
    });
}

int dfb_rank(const dfb_framebuffer* framebuffer) { return framebuffer ? framebuffer->connection->rank() : -1; }

int dfb_size(const dfb_framebuffer* framebuffer) { return framebuffer ? framebuffer->connection->size() : -1; }

int dfb_is_display_rank(const dfb_framebuffer* framebuffer)
{
    return framebuffer && framebuffer->images->isDisplayRank() ? 1 : 0;
}

int dfb_width(const dfb_framebuffer* framebuffer)
{
    return framebuffer ? framebuffer->frameBufferConfig.image.width : 0;
}

int dfb_height(const dfb_framebuffer* framebuffer)
{
    return framebuffer ? framebuffer->frameBufferConfig.image.height : 0;
}

void dfb_input_init_sized(dfb_input* input, size_t struct_size)
{
    dfb_input all{};
    all.struct_size = struct_size;
    all.far_depth = std::numeric_limits<float>::infinity();
    all.valid[2] = all.valid[3] = std::numeric_limits<int>::max();
    store(all, input, struct_size);
}

int dfb_composite(dfb_framebuffer* framebuffer, const dfb_input* input, int place)
{
    return inFramebuffer(framebuffer, [&](dfb_framebuffer& fb) {
        dfb::InputImage image;
        std::exception_ptr wrong;
        try {
            image = imageOf(checked(input, "dfb_input"));
        } catch (...) {
            wrong = std::current_exception();
        }
        makePicture(fb, false, [&] {
            if (!wrong)
                return fb.images->composite(image, place, fb.frame);
            fb.images->startFailed(wrong, fb.frame);
            return fb.images->end();
        });
    });
}

int dfb_render(dfb_framebuffer* framebuffer, const dfb_brick* bricks, int count, const double view[16],
               const double projection[16], dfb_render_brick render_brick, void* user)
{
    return inFramebuffer(framebuffer, [&](dfb_framebuffer& fb) {
        if (fb.blend == dfb::ImageBlend::InOrder)
            refuse("bricks are blended by depth, not in an order of the ranks");
        if (!fb.bricks && fb.blend == dfb::ImageBlend::Nearest)
            fb.bricks.emplace(std::in_place_index<1>, fb.connection, fb.frameBufferConfig);
        else if (!fb.bricks)
            fb.bricks.emplace(std::in_place_index<0>, fb.connection, fb.frameBufferConfig);
        std::optional<Scene> scene;
        std::optional<dfb::MatrixCamera> camera;
        std::exception_ptr wrong;
        try {
            scene.emplace(bricks, count, render_brick, user);
            camera.emplace(cameraOf(view, projection));
        } catch (...) {
            wrong = std::current_exception();
        }
        const auto render = [&](auto& bricksOfAll) {
            std::optional<decltype(dfb::DataParallelLoop(bricksOfAll, scene->world))> loop;
            try {
                if (!wrong)
                    loop.emplace(bricksOfAll, scene->world);
            } catch (...) {
                wrong = std::current_exception();
            }
            if (!wrong)
                return loop->render(
                    *camera, [&](const dfb::Brick& brick, auto& tile) { (*scene)(brick, tile, bricksOfAll.layout()); },
                    fb.frame);
            dfb::FrameConfig frame = fb.frame;
            frame.declared = true; // as in the loop that the other ranks are in
            auto open = bricksOfAll.begin(frame);
            open.abort(wrong);
            return open.end();
        };
        makePicture(fb, true, [&] { return std::visit(render, *fb.bricks); });
    });
}

const uint8_t* dfb_image_rgba8(const dfb_framebuffer* framebuffer)
{
    const dfb::Image* image = shownImage(framebuffer);
    return image && image->format() != dfb::OutputFormat::RGBA32F ? image->rgba8() : nullptr;
}

const float* dfb_image_rgba32f(const dfb_framebuffer* framebuffer)
{
    const dfb::Image* image = shownImage(framebuffer);
    return image && image->format() == dfb::OutputFormat::RGBA32F ? image->rgba32f() : nullptr;
}

const float* dfb_image_depth(const dfb_framebuffer* framebuffer)
{
    const dfb::Image* image = shownImage(framebuffer);
    return image && image->hasDepth() ? image->depth() : nullptr;
}

int dfb_image_on_all_ranks(dfb_framebuffer* framebuffer)
{
    return inFramebuffer(framebuffer, [](dfb_framebuffer& fb) {
        fb.everywhere = fb.showsBricks ? std::visit([](auto& bricks) { return bricks.imageOnAllRanks(); }, *fb.bricks)
                                       : fb.images->imageOnAllRanks();
    });
}

int dfb_get_report_sized(const dfb_framebuffer* framebuffer, dfb_report* report, size_t struct_size)
{
    return guarded([&] {
        if (!framebuffer || !report)
            refuse(framebuffer ? "a null dfb_report" : "a null dfb_framebuffer");
        if (!framebuffer->report)
            refuse("there has been no picture yet");
        const dfb::FrameReport& from = *framebuffer->report;
        dfb_report all{};
        all.frame = from.frame;
        all.total_ms = from.totalMs;
        all.render_ms = from.renderMs;
        all.compositing_overhead_ms = from.compositingOverheadMs;
        all.render_ms_max = from.renderMsMax;
        all.bytes_sent = from.bytesSent;
        all.messages_sent = from.messagesSent;
        all.tiles_total = from.tilesTotal;
        all.tiles_touched = from.tilesTouched;
        all.non_finite_pixels = from.nonFinitePixels;
        all.alpha_outside_pixels = from.alphaOutsidePixels;
        all.order_undefined_pixels = from.orderUndefinedPixels;
        all.peak_memory_bytes = from.peakMemoryBytes;
        all.threads = from.threads;
        store(all, report, struct_size);
    });
}

const char* dfb_last_error(void) { return lastError; }

const char* dfb_version(void) { return DFB_VERSION; }

} // extern "C"
