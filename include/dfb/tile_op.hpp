// The contract of a tile operation (TileOp): how the inputs of one tile become a finished tile.
//
// A TileOp is a default-constructible type. The owner of a tile makes one object of it for each frame in flight, when
// the tile first needs it. If owners change, an object without keepsState may serve another tile later. Calls for one
// tile come one after the other, from any thread, so the operation needs no mutex. Calls for different tiles may come
// at once. It does not know the framebuffer, messages or threads. An exception makes the frame fail on all ranks; the
// error has its text.
//
// All passes of a tile come to one object. The operation composites each pass (TileHeader::pass) by itself, lays it
// over TileInfo::background, and averages the passes; PassImages does the last two. Inputs come in any order. Some are
// empty: see Fragment::empty().
//
//   static constexpr ChannelMask channels;       the channels its inputs have (Tile<channels, tileSize>)
//   void newFrame(const TileInfo&);              forget the last frame; or, with a FrameData,
//   void newFrame(const TileInfo&, const FrameData&);
//   void add(Fragment&&);                        keep one input; quick, and no loops on the executor: other threads
//                                                wait meanwhile. Inputs come in any order
//   void finish(FinishedTile&);                  all inputs have come: write every row; called
//                                                once, in a task; may take long
//
// Optional:
//   static constexpr int tileSize;               pixels a side, 8 to 256; default 64
//   static constexpr ChannelMask neededChannels; what must travel even if the output does not have it;
//                                                default: all of `channels`. Depth travels as well where positions
//                                                or ids of several passes are compared, see channels.hpp
//   using FrameData = ...;                       per-frame data, given to the framebuffer's begin(): a type that is
//                                                default-constructible and copy-assignable
//   static constexpr bool activeByDepth = true;  a pixel of an input is active if its depth is below +infinity,
//                                                whatever its colour; depth must be among neededChannels. Otherwise it
//                                                is active if one of its four colour channels is not 0, whatever its
//                                                depth. Only active pixels are sent and reach add()
//   bool isComplete() const;                     asked after each add(). True: it needs no more inputs. The tile is
//                                                finished at once, without the inputs still announced. When these
//                                                come, they are checked and counted, but not given to add()
//   static constexpr bool readsInPlace = true;   inputs may come as views of a renderer's memory
//                                                (FragmentEncoding::InPlace) or as bytes. The operation must read them
//                                                in finish(), by forEachPixel() or a FragmentCursor, not by
//                                                Fragment::color()
//   static constexpr bool takesOrder = true;     the operation follows TileInfo::order, and does without depth then
//   static bool opaqueHides(const TileInfo&);    whether in this frame an opaque input hides all inputs of a higher
//                                                generation: nobody need render them, and isComplete() does not wait
//                                                for them
//   static constexpr bool keepsState = true;     the object keeps values of its tile from frame to frame. A tile may
//                                                then have no pass in a frame: the image keeps its pixels. TileInfo
//                                                tells which samples come now. Until a tile has a sample that is
//                                                not empty, its object is not called. Its first newFrame() then
//                                                gets the number of empty samples in TileInfo::emptySamples
//   static constexpr bool emptyIsBackground = true;   inputs without any pixel give the background: finish() is then
//                                                not called and nothing is sent, if the pixel operation is pointwise
//   void report(TileReport&) const;              after finish(): figures of the tile
#pragma once

#include <dfb/base/detect.hpp>
#include <dfb/blend/background_pixels.hpp>
#include <dfb/compiled.hpp>
#include <dfb/fragment.hpp>
#include <dfb/image.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// The tile and the frame that newFrame() begins.
struct TileInfo {
    int rank = 0; // the rank that owns the tile
    std::int64_t frame = 0;
    int tile = 0;
    Region region;                               // the tile's pixels
    int passes = 1;                              // samples a pixel; each pass has a dependency tree of its own
    int firstSample = 0;                         // the sample number of pass 0, over all frames that accumulate
    int emptySamples = 0;                        // the number of samples before firstSample, if none had an input
    std::uint64_t accumulationId = 0;            // if it changes, the samples accumulated before are of no use
    float minTransmittance = 0;                  // a pixel whose layers let less than this through counts as opaque
    ChannelMask wanted = 0;                      // channels of the image beside the colour
    std::array<float, 4> background{0, 0, 0, 0}; // premultiplied linear RGBA, behind everything
    const SourceOrder* order = nullptr;          // FrameConfig::order; null if that is null, or without takesOrder
};

// One row of the auxiliary channels of a finished tile; see channels.hpp for what they hold. Null: the channel is empty
// in the whole row.
struct AuxRow {
    const float* normal = nullptr;
    const float* albedo = nullptr;
    const float* position = nullptr;
    const std::uint32_t* primitiveId = nullptr;
    const std::uint32_t* instanceId = nullptr;
};

// Takes the result of a TileOp, row by row, and rounds it to the output format. Use it only within TileOp::finish(), on
// the thread of that call. Waits for nothing. Members that set pixels throw InvalidArgument, with nothing set, for
// pixels outside the region.
class FinishedTile {
public:
    // `to` points to pixel (0, 0) of the region in each plane that is wanted. Rows are `stride` pixels apart; colour is
    // in `format`. `background`: which of these pixels already show the background; may be null.
    FinishedTile(const Region& region, OutputFormat format, const detail::Planes& to, std::size_t stride,
                 bool dither = false, detail::BackgroundPixels* background = nullptr)
        : region_(region), format_(format), to_(to), stride_(stride), dither_(dither && bytesPerPixel(format) == 4),
          background_(background)
    {
    }

    // Uses non-temporal stores for float colours from now on: see streamPixels().
    void storePastCache() noexcept { isPastCache_ = format_ == OutputFormat::RGBA32F; }

    const Region& region() const noexcept { return region_; }
    int width() const noexcept { return region_.width(); }
    int height() const noexcept { return region_.height(); }
    OutputFormat format() const noexcept { return format_; }
    bool isDithered() const noexcept { return dither_; } // the colour, not alpha
    bool wantsDepth() const noexcept { return to_.at[detail::Depth] != nullptr; }

    // Sets row y, in [0, height()): 4 * width() premultiplied linear values; if wantsDepth(), width() depths (null: all
    // +infinity); and those auxiliary channels that the image has. Every row must be set once. Float colours of -0
    // become 0. Returns what convertPixels() or ditherPixels() returns.
    template <class Real>
    double setRow(int y, const Real* rgba, const float* depth, const AuxRow& aux = {});

    // Sets pixels [x, x + count) of row y, in place of setRow(), in an image without dithering and without auxiliary
    // channels. `depth` may be null if the image has none. Every pixel must be set once. Returns what setRow() does.
    template <class Real>
    double setPixels(int x, int y, int count, const Real* rgba, const float* depth = nullptr);
    // Sets pixels [x, x + count) of row y to colours that are given as they are stored, bytesPerPixel(format()) bytes
    // each, and to these depths, which may be null if the image has none.
    void setStored(int x, int y, int count, const std::byte* stored, const float* depth)
    {
        if (std::byte* color = overwrite(x, y, count, depth))
            std::memcpy(color, stored, static_cast<std::size_t>(count) * bytesPerPixel(format_));
    }
    // Sets pixels [x, x + count) of row y to the background, which is given as it is stored: bytesPerPixel(format())
    // bytes. Depth becomes +infinity. Pixels that are known to be background already are not written.
    void fillPixels(int x, int y, int count, const std::byte* stored)
    {
        require(x, y, count);
        if (count == 0)
            return;
        if (background_)
            background_->add(x, y, count, [&](int from, int some) { writeBackground(from, y, some, stored); });
        else
            writeBackground(x, y, count, stored);
    }
    std::int64_t writtenPixels() const noexcept { return writtenPixels_; }

    // The stored rows, after setRow(); null where a channel is not wanted.
    const detail::Planes& planes() const noexcept { return to_; }
    std::size_t stride() const noexcept { return stride_; } // from a row to the next, in pixels

    // The 8-bit level of value i in [0, 4 * width()) of row y, after setRow(); and its replacement. Nobody checks these
    // numbers.
    int level(int y, int i) const { return static_cast<int>(*levelAt(y, i)); }
    void setLevel(int y, int i, std::uint8_t level) { *levelAt(y, i) = static_cast<std::byte>(level); }

private:
    template <class Real>
    double convert(const Real* rgba, int count, std::byte* color) const;

    std::byte* levelAt(int y, int i) const
    {
        return to_.at[detail::Color] + 4 * pixelAt(0, y) + static_cast<std::size_t>(i);
    }

    std::size_t pixelAt(int x, int y) const
    {
        return static_cast<std::size_t>(y) * stride_ + static_cast<std::size_t>(x);
    }

    void require(int x, int y, int count) const
    {
        if (y < 0 || y >= height() || x < 0 || count < 0 || count > width() - x)
            detail::failArgument("pixels %d to %d of row %d of a tile of %dx%d", x, x + count - 1, y, width(),
                                 height());
    }

    // Sets depths, unless they are null. Returns where the colours belong; null if they are not wanted.
    std::byte* overwrite(int x, int y, int count, const float* depth = nullptr)
    {
        require(x, y, count);
        writtenPixels_ += count;
        if (background_)
            background_->remove(x, y, count);
        const std::size_t first = pixelAt(x, y);
        if (float* out = detail::floatsOf(to_.at[detail::Depth]); out && depth)
            std::copy(depth, depth + count, out + first);
        std::byte* color = to_.at[detail::Color];
        return color ? color + first * bytesPerPixel(format_) : nullptr;
    }

    void writeBackground(int x, int y, int count, const std::byte* stored)
    {
        writtenPixels_ += count;
        const std::size_t first = pixelAt(x, y), bytes = bytesPerPixel(format_);
        if (float* out = detail::floatsOf(to_.at[detail::Depth]))
            std::fill_n(out + first, count, std::numeric_limits<float>::infinity());
        if (std::byte* out = to_.at[detail::Color]) {
            out += first * bytes;
            std::memcpy(out, stored, bytes);
            for (std::size_t done = 1, all = static_cast<std::size_t>(count); done < all; done *= 2)
                std::memcpy(out + done * bytes, out, std::min(done, all - done) * bytes);
        }
    }

    Region region_;
    OutputFormat format_;
    detail::Planes to_;
    std::size_t stride_;
    bool dither_, isPastCache_ = false;
    detail::BackgroundPixels* background_;
    std::int64_t writtenPixels_ = 0;
};

// The passes of a tile as images, for tile operations of your own: lays each over the background, and averages them.
// Holds 32 bytes for each pixel and pass.
class PassImages {
public:
    // Begins a frame: all pixels of all passes are empty. Call it in TileOp::newFrame(). Throws std::bad_alloc. No
    // member checks pixel numbers, passes or positions.
    void newFrame(const TileInfo& info)
    {
        width_ = info.region.width();
        pixels_ = static_cast<std::size_t>(width_) * static_cast<std::size_t>(info.region.height());
        passes_ = static_cast<std::size_t>(info.passes);
        background_ = info.background;
        color_.assign(4 * pixels_ * passes_, 0.0);
    }

    // The index of a pixel, 0 to count() - 1. An operation can use it for its own arrays, too.
    // `pass` is TileHeader::pass; x and y count from the tile's upper left corner.
    std::size_t index(int pass, int x, int y) const noexcept
    {
        return static_cast<std::size_t>(pass) * pixels_ + static_cast<std::size_t>(y * width_ + x);
    }
    std::size_t count() const noexcept { return pixels_ * passes_; }

    // The pixel's premultiplied linear RGBA: 4 values to be set.
    double* pixel(std::size_t index) noexcept { return &color_[4 * index]; }

    // Writes all rows of the finished tile. Call it in TileOp::finish(). `depth` and `aux` have the other channels of
    // all its pixels, row by row; null: the channel is empty, and depth +infinity.
    void finish(FinishedTile& out, const float* depth = nullptr, const AuxRow& aux = {}) const
    {
        std::vector<double> row(4 * static_cast<std::size_t>(width_));
        const double share = 1.0 / static_cast<double>(passes_);
        for (int y = 0; y < out.height(); ++y) {
            std::fill(row.begin(), row.end(), 0.0);
            for (std::size_t pass = 0; pass < passes_; ++pass) {
                const double* from = &color_[4 * index(static_cast<int>(pass), 0, y)];
                for (std::size_t i = 0; i < row.size(); ++i)
                    row[i] += from[i] + (1 - from[i | 3]) * static_cast<double>(background_[i % 4]);
            }
            for (double& value : row)
                value *= share;
            const auto rowOf = [first = static_cast<std::size_t>(y * width_)](auto* all, std::size_t values) {
                return all ? all + values * first : nullptr;
            };
            out.setRow(y, row.data(), rowOf(depth, 1),
                       {rowOf(aux.normal, 3), rowOf(aux.albedo, 3), rowOf(aux.position, 3), rowOf(aux.primitiveId, 1),
                        rowOf(aux.instanceId, 1)});
        }
    }

private:
    int width_ = 0;
    std::size_t pixels_ = 0, passes_ = 1;
    std::array<float, 4> background_{};
    std::vector<double> color_;
};

// Figures of a finished tile: TileOp::report() sets them.
struct TileReport {
    double error = -1;                     // how far the tile's pixels may be off, in units of colour; < 0: not known
    std::int64_t orderUndefinedPixels = 0; // pixels whose inputs overlap in depth, so that no order is right
};

struct NoFrameData {};

namespace detail {

template <class T, class = void>
struct FrameDataOf {
    using type = NoFrameData;
};
template <class T>
struct FrameDataOf<T, std::void_t<typename T::FrameData>> {
    using type = typename T::FrameData;
};

DFB_SETTING(int, tile_size_v, 64, tileSize);
DFB_SETTING(ChannelMask, needed_channels_v, T::channels, neededChannels);
DFB_SETTING(bool, active_by_depth_v, false, activeByDepth);
DFB_SETTING(bool, empty_is_background_v, false, emptyIsBackground);
DFB_SETTING(bool, reads_in_place_v, false, readsInPlace);
DFB_SETTING(bool, takes_order_v, false, takesOrder);
DFB_SETTING(bool, keeps_state_v, false, keepsState);

DFB_DETECTS(has_new_frame_v, std::declval<T&>().newFrame(std::declval<const TileInfo&>()));
DFB_DETECTS(has_new_frame_with_data_v,
            std::declval<T&>().newFrame(std::declval<const TileInfo&>(),
                                        std::declval<const typename FrameDataOf<T>::type&>()));
DFB_DETECTS(has_add_v, std::declval<T&>().add(std::declval<Fragment&&>()));
DFB_DETECTS(has_finish_v, std::declval<T&>().finish(std::declval<FinishedTile&>()));
DFB_DETECTS(opaque_hides_v, T::opaqueHides(std::declval<const TileInfo&>()));
DFB_DETECTS(has_report_v, std::declval<const T&>().report(std::declval<TileReport&>()));
DFB_DETECTS(has_channels_v, std::enable_if_t<std::is_convertible_v<decltype(T::channels), ChannelMask>, bool>{});
DFB_DETECTS(has_is_complete_v,
            std::enable_if_t<std::is_same_v<bool, decltype(std::declval<const T&>().isComplete())>, bool>{});

// One readable line per member that is missing.
template <class T>
constexpr bool checkTileOp()
{
    static_assert(std::is_default_constructible_v<T>,
                  "dfb: TileOp must provide a default constructor (the framebuffer makes its objects)");
    static_assert(has_channels_v<T>, "dfb: TileOp must provide static constexpr ChannelMask channels");
    static_assert(has_new_frame_v<T> || has_new_frame_with_data_v<T>,
                  "dfb: TileOp must provide void newFrame(const TileInfo&) "
                  "or void newFrame(const TileInfo&, const FrameData&)");
    static_assert(std::is_same_v<typename FrameDataOf<T>::type, NoFrameData> || has_new_frame_with_data_v<T>,
                  "dfb: a TileOp with a FrameData must provide void newFrame(const TileInfo&, const FrameData&)");
    static_assert(tile_size_v<T> >= 8 && tile_size_v<T> <= 256,
                  "dfb: the tile size of a TileOp must be 8 to 256 pixels");
    static_assert(has_add_v<T>, "dfb: TileOp must provide void add(Fragment&&)");
    static_assert(has_finish_v<T>, "dfb: TileOp must provide void finish(FinishedTile&)");
    if constexpr (active_by_depth_v<T>)
        static_assert((T::channels & needed_channels_v<T> & depthChannel) != 0,
                      "dfb: a TileOp with activeByDepth must have depthChannel in channels and neededChannels");
    return true;
}

} // namespace detail

// Whether T has the members that a tile operation needs; see the head of this file.
template <class T>
inline constexpr bool is_tile_op_v =
    std::is_default_constructible_v<T>&& detail::has_channels_v<
        T> && (detail::has_new_frame_v<T> || detail::has_new_frame_with_data_v<T>)&&detail::has_add_v<T>&& detail::has_finish_v<T>;

DFB_NAMESPACE_END

#if DFB_HAS_BODIES
#include <dfb/base/levels.hpp>

DFB_NAMESPACE_BEGIN

template <class Real>
double FinishedTile::convert(const Real* rgba, int count, std::byte* color) const
{
    const int stored = isPastCache_ ? detail::streamPixels(rgba, count, detail::floatsOf(color)) : 0;
    rgba += 4 * stored;
    color += 16 * stored;
    if constexpr (std::is_same_v<Real, float>)
        if (format_ == OutputFormat::RGBA32F) {
            detail::fastest<detail::copyFloats>(rgba, 4 * (count - stored), detail::floatsOf(color));
            return 0;
        }
    return convertPixels(rgba, count - stored, format_, color);
}

template <class Real>
double FinishedTile::setRow(int y, const Real* rgba, const float* depth, const AuxRow& aux)
{
    double farthest = 0;
    if (std::byte* color = overwrite(0, y, width()))
        farthest = dither_ ? ditherPixels(rgba, width(), format_, region_.x0, region_.y0 + y, color)
                           : convert(rgba, width(), color);
    const auto set = [&](detail::Channel channel, const auto* from, auto empty) {
        if (!to_.at[channel])
            return;
        const std::size_t words = detail::channelWords[channel];
        const std::size_t count = words * static_cast<std::size_t>(width());
        auto* out = reinterpret_cast<decltype(empty)*>(to_.at[channel]) + words * pixelAt(0, y);
        if (from)
            std::copy(from, from + count, out);
        else
            std::fill(out, out + count, empty);
    };
    set(detail::Depth, depth, std::numeric_limits<float>::infinity());
    set(detail::Normal, aux.normal, 0.0f);
    set(detail::Albedo, aux.albedo, 0.0f);
    set(detail::Position, aux.position, 0.0f);
    set(detail::PrimitiveId, aux.primitiveId, noId);
    set(detail::InstanceId, aux.instanceId, noId);
    return farthest;
}

template <class Real>
double FinishedTile::setPixels(int x, int y, int count, const Real* rgba, const float* depth)
{
    std::byte* color = overwrite(x, y, count, depth);
    return color ? convert(rgba, count, color) : 0;
}

DFB_NAMESPACE_END
#endif

DFB_NAMESPACE_BEGIN
DFB_COMPILED_TEMPLATE(double FinishedTile::setRow(int, const float*, const float*, const AuxRow&));
DFB_COMPILED_TEMPLATE(double FinishedTile::setRow(int, const double*, const float*, const AuxRow&));
DFB_COMPILED_TEMPLATE(double FinishedTile::setPixels(int, int, int, const float*, const float*));
DFB_COMPILED_TEMPLATE(double FinishedTile::setPixels(int, int, int, const double*, const float*));
DFB_NAMESPACE_END
