// Tile: the dense square of pixels that a renderer fills (Listing 1 of the paper), with its size and its
// channels fixed at compile time.
#pragma once

#include <dfb/channels.hpp>
#include <dfb/image.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <iterator>
#include <limits>
#include <type_traits>
#include <vector>

DFB_NAMESPACE_BEGIN

// Identifies an input of a tile. (tile, pass, generation, source, part) is unique in a frame.
struct TileHeader {
    std::int64_t frame = -1;  // set by Frame::start
    int tile = -1;            // index in the TileLayout
    Region region;            // its pixels; smaller than the tile at the image's right and lower border
    int pass = 0;             // passes are composited each by itself, then averaged
    int generation = 0;       // level in the tile's dependency tree
    int children = 0;         // how many inputs of generation + 1 this one announces
    std::uint32_t source = 0; // brick id, or another number; where there are no bricks, the rank
    std::uint16_t part = 0;   // to tell apart several inputs of one source
    // For renderers, as a seed of random numbers: the number of this sample, over all frames that accumulate. Set by
    // Frame::start. It is 0 in the inputs of a tile operation, where TileInfo::firstSample + pass is the number.
    int sample = 0;
};

// An order of the sources of inputs, from front to back. Any thread may read it.
class SourceOrder {
public:
    // Throws InvalidArgument if a source comes twice.
    explicit SourceOrder(const std::vector<std::uint32_t>& frontToBack)
    {
        for (const std::uint32_t source : frontToBack)
            places_.push_back({source, static_cast<int>(places_.size())});
        std::sort(places_.begin(), places_.end(), [](const Place& a, const Place& b) { return a.source < b.source; });
        for (std::size_t i = 1; i < places_.size(); ++i)
            if (places_[i].source == places_[i - 1].source)
                detail::failArgument("source %u comes twice in an order", places_[i].source);
    }

    struct Place {
        std::uint32_t source = 0;
        int place = 0; // 0: in front
    };
    // Sorted by ascending source.
    const std::vector<Place>& places() const noexcept { return places_; }

    // The place of a source, 0 in front; -1 if it is not in the order.
    int placeOf(std::uint32_t source) const noexcept
    {
        const auto at = std::lower_bound(places_.begin(), places_.end(), source,
                                         [](const Place& p, std::uint32_t s) { return p.source < s; });
        return at != places_.end() && at->source == source ? at->place : -1;
    }

private:
    std::vector<Place> places_;
};

namespace detail {

constexpr std::size_t pixelsOf(int tileSize)
{
    return static_cast<std::size_t>(tileSize) * static_cast<std::size_t>(tileSize);
}

// Returns `array`. GCC 12.2 at -O2 drops the calls of a function that fills two arrays of one struct in nested loops,
// as if it wrote nothing. This hides from GCC where one of the pointers comes from: then it keeps the calls.
inline float* unknownOrigin(float* array) noexcept
{
#if defined(__GNUC__) && !defined(__clang__)
    asm("" : "+r"(array));
#endif
    return array;
}

// The array of a channel beside colour; nothing if the tile does not have the channel.
template <Channel Which, bool isThere, std::size_t PixelCount>
struct Plane {
};
template <std::size_t PixelCount>
struct Plane<Depth, true, PixelCount> {
    float depth[PixelCount];
};
template <std::size_t PixelCount>
struct Plane<Normal, true, PixelCount> {
    float normal[3 * PixelCount];
};
template <std::size_t PixelCount>
struct Plane<Albedo, true, PixelCount> {
    float albedo[3 * PixelCount];
};
template <std::size_t PixelCount>
struct Plane<Position, true, PixelCount> {
    float position[3 * PixelCount];
};
template <std::size_t PixelCount>
struct Plane<PrimitiveId, true, PixelCount> {
    std::uint32_t primitiveId[PixelCount];
};
template <std::size_t PixelCount>
struct Plane<InstanceId, true, PixelCount> {
    std::uint32_t instanceId[PixelCount];
};
template <std::size_t PixelCount>
struct Plane<Far, true, PixelCount> {
    float farDepth[PixelCount];
};

template <ChannelMask Channels, std::size_t PixelCount>
struct TilePlanes : Plane<Depth, hasChannel(Channels, Depth), PixelCount>,
                    Plane<Normal, hasChannel(Channels, Normal), PixelCount>,
                    Plane<Albedo, hasChannel(Channels, Albedo), PixelCount>,
                    Plane<Position, hasChannel(Channels, Position), PixelCount>,
                    Plane<PrimitiveId, hasChannel(Channels, PrimitiveId), PixelCount>,
                    Plane<InstanceId, hasChannel(Channels, InstanceId), PixelCount>,
                    Plane<Far, hasChannel(Channels, Far), PixelCount> {
    float color[4 * PixelCount];

    // Calls f(channel, array) for each array that there is.
    template <class Self, class F>
    static void forEachPlane(Self& self, const F& f) noexcept
    {
        f(Color, self.color);
        if constexpr (hasChannel(Channels, Depth))
            f(Depth, self.depth);
        if constexpr (hasChannel(Channels, Normal))
            f(Normal, self.normal);
        if constexpr (hasChannel(Channels, Albedo))
            f(Albedo, self.albedo);
        if constexpr (hasChannel(Channels, Position))
            f(Position, self.position);
        if constexpr (hasChannel(Channels, PrimitiveId))
            f(PrimitiveId, self.primitiveId);
        if constexpr (hasChannel(Channels, InstanceId))
            f(InstanceId, self.instanceId);
        if constexpr (hasChannel(Channels, Far))
            f(Far, self.farDepth);
    }

    ConstPlanes planes() const noexcept
    {
        ConstPlanes p;
        forEachPlane(*this, [&p](Channel channel, const auto& values) {
            p.at[channel] = reinterpret_cast<const std::byte*>(values);
        });
        return p;
    }
};

} // namespace detail

// Keep tiles on the heap or one per worker: 64x64 pixels of colour and depth are 80 KiB, 256x256 are 1.3 MB.
//
// Pixel (x, y) of the tile, counted from region.x0 and region.y0, is pixel i = y * size + x: color[4 * i], and as far
// as the tile has the channels depth[i], normal[3 * i], albedo[3 * i], position[3 * i], primitiveId[i], instanceId[i],
// farDepth[i]. Pixels outside the region are never read.
template <ChannelMask Channels, int Size>
struct Tile : TileHeader, detail::TilePlanes<Channels, detail::pixelsOf(Size)> {
    static_assert(Size >= 8 && Size <= 256, "dfb: the tile size must be 8 to 256 pixels");
    static_assert(Channels & colorChannel, "dfb: a tile has at least the colour channel");

    static constexpr int size = Size;
    static constexpr ChannelMask channels = Channels;
    static constexpr bool hasDepth = (Channels & depthChannel) != 0;
    using detail::TilePlanes<Channels, detail::pixelsOf(Size)>::color;

    Tile() = default;
    // Explicit, so that a renderer that takes `auto tile` in place of `auto& tile`, and so would fill a copy, does not
    // compile.
    explicit Tile(const Tile&) = default;
    Tile(Tile&&) = default;
    Tile& operator=(const Tile&) = default;

    // Makes all pixels empty: all channels 0, but depth +infinity, farDepth -infinity, and ids noId. Of the channels
    // beside colour only those in `which` are written. Throws nothing.
    void clear(ChannelMask which = Channels)
    {
        this->forEachPlane(*this, [which](detail::Channel channel, auto& values) {
            const float infinity = std::numeric_limits<float>::infinity();
            if (channel != detail::Color && !detail::hasChannel(which, channel))
                return;
            if constexpr (std::is_same_v<decltype(values[0]), std::uint32_t&>)
                std::fill(std::begin(values), std::end(values), noId);
            else if (channel == detail::Depth)
                std::fill(std::begin(values), std::end(values), infinity);
            else if (channel == detail::Far) // not set: no farther than the depth
                std::fill(std::begin(values), std::end(values), -infinity);
            else
                std::memset(values, 0, sizeof values);
        });
    }

    // Sets all pixels to one premultiplied RGBA colour at one depth.
    void fill(const float (&rgba)[4], [[maybe_unused]] float depthValue = std::numeric_limits<float>::infinity())
    {
        for (int i = 0; i < Size * Size; ++i)
            std::memcpy(color + 4 * i, rgba, sizeof rgba);
        if constexpr (hasDepth)
            std::fill_n(this->depth, Size * Size, depthValue);
    }

    // Calls f(x, y, rgba, depth), or f(x, y, rgba), for each pixel of the region, row by row: x and y are its place in
    // the image, `rgba` points to its 4 floats, `depth` is a reference to its depth, if there is a depth channel. For
    // other channels f may take the pixel's number i as its last argument, as in tile.normal + 3 * i.
    template <class PixelFunction>
    void forEachPixel(const PixelFunction& f)
    {
        float* const colors = detail::unknownOrigin(color);
        for (int y = 0; y < region.height(); ++y)
            for (int x = 0; x < region.width(); ++x) {
                const int i = y * Size + x;
                if constexpr (hasDepth && std::is_invocable_v<const PixelFunction&, int, int, float*, float&, int>)
                    f(region.x0 + x, region.y0 + y, colors + 4 * i, this->depth[i], i);
                else if constexpr (hasDepth && !std::is_invocable_v<const PixelFunction&, int, int, float*>)
                    f(region.x0 + x, region.y0 + y, colors + 4 * i, this->depth[i]);
                else if constexpr (std::is_invocable_v<const PixelFunction&, int, int, float*, int>)
                    f(region.x0 + x, region.y0 + y, colors + 4 * i, i);
                else
                    f(region.x0 + x, region.y0 + y, colors + 4 * i);
            }
    }

    // The RGBA of a pixel; x and y count from the tile's upper left corner, unlike those of forEachPixel().
    float* pixel(int x, int y) noexcept { return detail::unknownOrigin(color) + 4 * (y * Size + x); }
    const float* pixel(int x, int y) const noexcept { return color + 4 * (y * Size + x); }
    // Whether nothing behind it can be seen: alpha is 1 in all pixels of the region.
    bool isOpaque() const noexcept
    {
        return detail::isOpaque(this->planes().at[detail::Color], false, region.width(), region.height(), Size);
    }
};

// A tile whose pixels lie elsewhere in host memory, such as in a renderer's own image. They are read there, and have
// the meaning of a Tile's. All pointers point to the first pixel of the region. Channels that neither the operation nor
// the image needs may be null. A tile without colour is empty.
template <ChannelMask Channels, int Size>
struct TileView : TileHeader {
    static constexpr int size = Size;
    static constexpr ChannelMask channels = Channels;

    std::ptrdiff_t stride = 0; // from a row to the next, in pixels; negative where rows lie bottom-up
    const float *color = nullptr, *depth = nullptr, *normal = nullptr, *albedo = nullptr, *position = nullptr;
    // In place of `color`: premultiplied linear RGBA of 8 bits a channel, level / 255. If both are set, `color` is
    // used. The bytes are sent as they are, and composited exactly.
    const std::uint8_t* color8 = nullptr;
    const std::uint32_t *primitiveId = nullptr, *instanceId = nullptr;
    const float* farDepth = nullptr;
    // Pixels of the image outside of this region are empty, and are not read. Set it if you know where your data
    // project to. By default there is no limit.
    Region valid{std::numeric_limits<int>::min(), std::numeric_limits<int>::min(), std::numeric_limits<int>::max(),
                 std::numeric_limits<int>::max()};
    Region validRegion() const noexcept { return intersection(region, valid); }
    // A promise: the pixels do not change until the frame's end() has returned. Then they need not be copied. They are
    // read in place if this rank owns the tile, or if the owner is on the same node and they are in memory of
    // sharedMemory(). They are copied all the same if the operation has no readsInPlace or keeps state, or if a channel
    // other than colour and depth is sent. So they are with a WireFormat that rounds, with an ErrorBudget, with
    // minTransmittance above 0, and with HalfLevel for an 8-bit image if not all ranks share memory. After a
    // TransportError do not write to such memory until the framebuffer is destroyed. NetworkConfig::checksums finds
    // broken promises.
    bool staysUntilEnd = false;

    detail::ConstPlanes planes() const noexcept
    {
        const void* const pixels = color ? static_cast<const void*>(color) : color8;
        const void* const all[detail::channelCount] = {pixels,   depth,       normal,     albedo,
                                                       position, primitiveId, instanceId, farDepth};
        detail::ConstPlanes p;
        for (std::size_t c = 0; c < detail::channelCount; ++c)
            p.at[c] = static_cast<const std::byte*>(all[c]);
        return p;
    }
    bool isOpaque() const noexcept
    {
        const std::byte* pixels = planes().at[detail::Color];
        return pixels && validRegion() == region
               && detail::isOpaque(pixels, !color, region.width(), region.height(), stride);
    }
};

namespace detail {

// A Tile or a TileView of any size and channels: its header, and where its pixels lie. So nothing inside the
// framebuffer is a template on the type of a tile.
struct InputPixels : TileHeader {
    template <ChannelMask Channels, int Size>
    InputPixels(const Tile<Channels, Size>& from)
        : TileHeader(from), channels(Channels), planes(from.planes()), stride(Size), valid(from.region)
    {
    }
    template <ChannelMask Channels, int Size>
    InputPixels(const TileView<Channels, Size>& from)
        : TileHeader(from), channels(Channels), planes(from.planes()), stride(from.stride), valid(from.validRegion()),
          hasBytes(!from.color && from.color8), staysUntilEnd(from.staysUntilEnd)
    {
    }

    // Bytes of a pixel in a channel.
    std::size_t pixelBytes(std::size_t channel) const noexcept
    {
        return channel == Color && hasBytes ? 4 : 4 * channelWords[channel];
    }

    ChannelMask channels;
    ConstPlanes planes;    // to the first pixel of the region; null: not there
    std::ptrdiff_t stride; // from a row to the next, in pixels
    Region valid;          // part of the region; pixels outside of it are empty and not read
    bool hasBytes = false; // the colour has 8 bits a channel
    bool staysUntilEnd = false;
    float depthLimit = std::numeric_limits<float>::infinity(); // at this depth or beyond a pixel is empty
};

} // namespace detail

DFB_NAMESPACE_END
