// The contract of a tile operation (TileOp): how the inputs of one tile become a finished tile.
//
// A TileOp is a default-constructible type; the framebuffer keeps one object per tile that it owns and calls it
// for one tile at a time, so it needs no mutex. It does not know the framebuffer, messages or threads.
//
//   static constexpr ChannelMask channels;       the channels its inputs have (Tile<channels, tileSize>)
//   void newFrame(const TileInfo&);              forget the last frame; or, with a FrameData,
//   void newFrame(const TileInfo&, const FrameData&);
//   void add(Fragment&&);                        keep one input; cheap; any arrival order
//   void finish(FinishedTile&);                  all inputs have come: write every row; heavy, once, as a task
//
// Optional:
//   static constexpr int tileSize;               pixels a side, 8 to 256; default 64
//   static constexpr ChannelMask neededChannels; what must travel even if the output does not have it;
//                                                default: all of `channels`
//   using FrameData = ...;                       copyable per-frame data, given to the framebuffer's begin()
//   bool isComplete() const;                     true: finish now, whatever is still announced; later inputs are
//                                                then expected and counted
#pragma once

#include <dfb/fragment.hpp>

#include <array>
#include <cstddef>
#include <cstdint>
#include <type_traits>
#include <utility>

namespace dfb {

// What a TileOp is told of the tile and the frame.
struct TileInfo {
    int rank = 0; // that owns the tile
    std::int64_t frame = 0;
    int tile = 0;
    Region region;                               // the tile's pixels
    int passes = 1;                              // samples a pixel; each pass has a dependency tree of its own
    bool wantsDepth = false;                     // the output has a depth channel
    std::array<float, 4> background{0, 0, 0, 0}; // premultiplied linear RGBA, behind everything
};

// Where a TileOp writes its result, row by row; the rows are rounded to the output format on the way.
class FinishedTile {
public:
    // Rows of `region.width()` pixels: colour in `format` at color + y * colorStride, depth (may be null) at
    // depth + y * depthStride.
    FinishedTile(const Region& region, OutputFormat format, std::byte* color, std::size_t colorStride, float* depth,
                 std::size_t depthStride)
        : region_(region), format_(format), color_(color), colorStride_(colorStride), depth_(depth),
          depthStride_(depthStride)
    {
    }

    const Region& region() const noexcept { return region_; }
    int width() const noexcept { return region_.width(); }
    int height() const noexcept { return region_.height(); }
    bool wantsDepth() const noexcept { return depth_ != nullptr; }

    // Row y in [0, height()): 4 * width() premultiplied linear values and, if wantsDepth(), width() depths (null:
    // all +infinity). Every row must be set once.
    void setRow(int y, const double* rgba, const float* depth)
    {
        if (color_)
            convertPixels(rgba, width(), format_, color_ + static_cast<std::size_t>(y) * colorStride_);
        if (!depth_)
            return;
        float* out = depth_ + static_cast<std::size_t>(y) * depthStride_;
        if (depth)
            std::copy(depth, depth + width(), out);
        else
            std::fill(out, out + width(), std::numeric_limits<float>::infinity());
    }

private:
    Region region_;
    OutputFormat format_;
    std::byte* color_;
    std::size_t colorStride_;
    float* depth_;
    std::size_t depthStride_;
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

template <class T, class = void>
struct TileSizeOf : std::integral_constant<int, 64> {
};
template <class T>
struct TileSizeOf<T, std::void_t<decltype(T::tileSize)>> : std::integral_constant<int, T::tileSize> {
};

template <class T, class = void>
struct HasChannels : std::false_type {
};
template <class T>
struct HasChannels<T, std::void_t<decltype(T::channels)>> : std::is_convertible<decltype(T::channels), ChannelMask> {
};

template <class T, class = void>
struct NeededChannelsOf {
    static constexpr ChannelMask value = T::channels;
};
template <class T>
struct NeededChannelsOf<T, std::void_t<decltype(T::neededChannels)>> {
    static constexpr ChannelMask value = T::neededChannels;
};

template <class T, class = void>
struct HasNewFrame : std::false_type {
};
template <class T>
struct HasNewFrame<T, std::void_t<decltype(std::declval<T&>().newFrame(std::declval<const TileInfo&>()))>>
    : std::true_type {
};

template <class T, class = void>
struct HasNewFrameWithData : std::false_type {
};
template <class T>
struct HasNewFrameWithData<T,
                           std::void_t<decltype(std::declval<T&>().newFrame(
                               std::declval<const TileInfo&>(), std::declval<const typename FrameDataOf<T>::type&>()))>>
    : std::true_type {
};

template <class T, class = void>
struct HasAdd : std::false_type {
};
template <class T>
struct HasAdd<T, std::void_t<decltype(std::declval<T&>().add(std::declval<Fragment&&>()))>> : std::true_type {
};

template <class T, class = void>
struct HasFinish : std::false_type {
};
template <class T>
struct HasFinish<T, std::void_t<decltype(std::declval<T&>().finish(std::declval<FinishedTile&>()))>> : std::true_type {
};

template <class T, class = void>
struct HasIsComplete : std::false_type {
};
template <class T>
struct HasIsComplete<T, std::void_t<decltype(std::declval<const T&>().isComplete())>>
    : std::is_same<bool, decltype(std::declval<const T&>().isComplete())> {
};

} // namespace detail

template <class T>
inline constexpr bool is_tile_op_v = std::is_default_constructible_v<T>&& detail::HasChannels<T>::value
                                     && (detail::HasNewFrame<T>::value || detail::HasNewFrameWithData<T>::value)
                                     && detail::HasAdd<T>::value&& detail::HasFinish<T>::value;

namespace detail {

// One readable line per member that is missing.
template <class T>
constexpr bool checkTileOp()
{
    static_assert(std::is_default_constructible_v<T>,
                  "dfb: TileOp must provide a default constructor (the framebuffer makes one per owned tile)");
    static_assert(HasChannels<T>::value, "dfb: TileOp must provide static constexpr ChannelMask channels");
    static_assert(HasNewFrame<T>::value || HasNewFrameWithData<T>::value,
                  "dfb: TileOp must provide void newFrame(const TileInfo&) "
                  "or void newFrame(const TileInfo&, const FrameData&)");
    static_assert(HasAdd<T>::value, "dfb: TileOp must provide void add(Fragment&&)");
    static_assert(HasFinish<T>::value, "dfb: TileOp must provide void finish(FinishedTile&)");
    return is_tile_op_v<T>;
}

} // namespace detail

} // namespace dfb
