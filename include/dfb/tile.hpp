// Tile: the dense square of pixels that a renderer fills (Listing 1 of the paper), with its size and its
// channels fixed at compile time.
#pragma once

#include <dfb/channels.hpp>
#include <dfb/image.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>
#include <vector>

DFB_NAMESPACE_BEGIN

// Identifies an input of a tile. (tile, pass, generation, source, part) is unique in a frame.
struct TileHeader {
    std::int64_t frame = -1;  // set by Frame::start
    int tile = -1;            // index in the TileLayout
    Region region;            // its pixels; at the right and lower border smaller than the tile
    int pass = 0;             // passes are composited each by itself, then averaged
    int generation = 0;       // level in the tile's dependency tree
    int children = 0;         // how many inputs of generation + 1 this one announces
    std::uint32_t source = 0; // brick id; the rank where there are no bricks
    std::uint16_t part = 0;   // to tell apart several inputs of one source
    int sample = 0;           // of the pixel, over all frames that accumulate: the index to seed with; set by start
};

// An order of the sources of inputs, from front to back.
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
    // By ascending source.
    const std::vector<Place>& places() const noexcept { return places_; }

    // Returns -1 if the source is not in the order.
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

// The arrays of a tile, each there if the tile has the channel.
template <bool Present, int PixelCount>
struct DepthPlane {
    float depth[PixelCount];
};
template <bool Present, int PixelCount>
struct NormalPlane {
    float normal[3 * PixelCount];
};
template <bool Present, int PixelCount>
struct AlbedoPlane {
    float albedo[3 * PixelCount];
};
template <bool Present, int PixelCount>
struct PositionPlane {
    float position[3 * PixelCount];
};
template <bool Present, int PixelCount>
struct PrimitiveIdPlane {
    std::uint32_t primitiveId[PixelCount];
};
template <bool Present, int PixelCount>
struct InstanceIdPlane {
    std::uint32_t instanceId[PixelCount];
};
template <bool Present, int PixelCount>
struct FarPlane {
    float farDepth[PixelCount];
};
template <int PixelCount>
struct DepthPlane<false, PixelCount> {
};
template <int PixelCount>
struct NormalPlane<false, PixelCount> {
};
template <int PixelCount>
struct AlbedoPlane<false, PixelCount> {
};
template <int PixelCount>
struct PositionPlane<false, PixelCount> {
};
template <int PixelCount>
struct PrimitiveIdPlane<false, PixelCount> {
};
template <int PixelCount>
struct InstanceIdPlane<false, PixelCount> {
};
template <int PixelCount>
struct FarPlane<false, PixelCount> {
};

template <ChannelMask Channels, int PixelCount>
struct TilePlanes : DepthPlane<hasChannel(Channels, Depth), PixelCount>,
                    NormalPlane<hasChannel(Channels, Normal), PixelCount>,
                    AlbedoPlane<hasChannel(Channels, Albedo), PixelCount>,
                    PositionPlane<hasChannel(Channels, Position), PixelCount>,
                    PrimitiveIdPlane<hasChannel(Channels, PrimitiveId), PixelCount>,
                    InstanceIdPlane<hasChannel(Channels, InstanceId), PixelCount>,
                    FarPlane<hasChannel(Channels, Far), PixelCount> {
    float color[4 * PixelCount];

    ConstPlanes planes() const noexcept
    {
        ConstPlanes p;
        const auto set = [&p](Channel channel, const void* data) {
            p.at[channel] = static_cast<const std::byte*>(data);
        };
        set(Color, color);
        if constexpr (hasChannel(Channels, Depth))
            set(Depth, this->depth);
        if constexpr (hasChannel(Channels, Normal))
            set(Normal, this->normal);
        if constexpr (hasChannel(Channels, Albedo))
            set(Albedo, this->albedo);
        if constexpr (hasChannel(Channels, Position))
            set(Position, this->position);
        if constexpr (hasChannel(Channels, PrimitiveId))
            set(PrimitiveId, this->primitiveId);
        if constexpr (hasChannel(Channels, InstanceId))
            set(InstanceId, this->instanceId);
        if constexpr (hasChannel(Channels, Far))
            set(Far, this->farDepth);
        return p;
    }
};

// Whether isOpaqueAt(i) holds for all pixels of the region. Looks at no more of them than it must.
template <class IsOpaqueAt>
bool isOpaque(const Region& region, std::ptrdiff_t stride, const IsOpaqueAt& isOpaqueAt) noexcept
{
    for (int y = 0; y < region.height(); ++y)
        for (int x = 0; x < region.width(); ++x)
            if (!isOpaqueAt(y * stride + x))
                return false;
    return true;
}

} // namespace detail

// Keep tiles on the heap or one per worker: 64x64 pixels of colour and depth are 80 KiB, 256x256 are 1.3 MB.
//
// Pixel (x, y) of the tile, counted from region.x0 and region.y0, is pixel i = y * size + x: color[4 * i], and as far
// as the tile has the channels depth[i], normal[3 * i], albedo[3 * i], position[3 * i], primitiveId[i], instanceId[i],
// farDepth[i]. Pixels outside the region are never read.
template <ChannelMask Channels, int Size>
struct Tile : TileHeader, detail::TilePlanes<Channels, Size * Size> {
    static_assert(Size >= 8 && Size <= 256, "dfb: the tile size must be 8 to 256 pixels");
    static_assert(Channels & colorChannel, "dfb: a tile has at least the colour channel");

    static constexpr int size = Size;
    static constexpr ChannelMask channels = Channels;
    static constexpr bool hasDepth = (Channels & depthChannel) != 0;
    using detail::TilePlanes<Channels, Size * Size>::color;

    // All pixels: nothing here (all 0, depth +infinity, no id). Channels that are not in `which` are left as they are.
    void clear(ChannelMask which = Channels)
    {
        const auto has = [which](ChannelMask channel) { return (which & channel) != 0; };
        constexpr std::size_t count = static_cast<std::size_t>(Size) * Size;
        const float infinity = std::numeric_limits<float>::infinity();
        std::memset(color, 0, sizeof color);
        (void)has;
        if constexpr (hasDepth)
            if (has(depthChannel))
                std::fill_n(this->depth, count, infinity);
        if constexpr ((Channels & normalChannel) != 0)
            if (has(normalChannel))
                std::memset(this->normal, 0, sizeof this->normal);
        if constexpr ((Channels & albedoChannel) != 0)
            if (has(albedoChannel))
                std::memset(this->albedo, 0, sizeof this->albedo);
        if constexpr ((Channels & positionChannel) != 0)
            if (has(positionChannel))
                std::memset(this->position, 0, sizeof this->position);
        if constexpr ((Channels & primitiveIdChannel) != 0)
            if (has(primitiveIdChannel))
                std::fill_n(this->primitiveId, count, noId);
        if constexpr ((Channels & instanceIdChannel) != 0)
            if (has(instanceIdChannel))
                std::fill_n(this->instanceId, count, noId);
        if constexpr ((Channels & farChannel) != 0)
            if (has(farChannel))
                std::fill_n(this->farDepth, count, -infinity); // nobody has said: no farther than the depth
    }

    // All pixels: one premultiplied RGBA colour at one depth.
    void fill(const float (&rgba)[4], float depthValue = std::numeric_limits<float>::infinity())
    {
        for (int i = 0; i < Size * Size; ++i)
            std::memcpy(color + 4 * i, rgba, sizeof rgba);
        if constexpr (hasDepth)
            std::fill_n(this->depth, Size * Size, depthValue);
        (void)depthValue;
    }

    // Calls f(x, y, rgba, depth), or f(x, y, rgba), for each pixel of the region, row by row: x and y are its place in
    // the image, `rgba` points to its 4 floats, `depth` is a reference to its depth, if there is a depth channel. For
    // other channels f may take the pixel's number i as its last argument, as in tile.normal + 3 * i.
    template <class PixelFunction>
    void forEachPixel(const PixelFunction& f)
    {
        for (int y = 0; y < region.height(); ++y)
            for (int x = 0; x < region.width(); ++x) {
                const int i = y * Size + x;
                if constexpr (hasDepth && std::is_invocable_v<const PixelFunction&, int, int, float*, float&, int>)
                    f(region.x0 + x, region.y0 + y, pixel(x, y), this->depth[i], i);
                else if constexpr (hasDepth && !std::is_invocable_v<const PixelFunction&, int, int, float*>)
                    f(region.x0 + x, region.y0 + y, pixel(x, y), this->depth[i]);
                else if constexpr (std::is_invocable_v<const PixelFunction&, int, int, float*, int>)
                    f(region.x0 + x, region.y0 + y, pixel(x, y), i);
                else
                    f(region.x0 + x, region.y0 + y, pixel(x, y));
                (void)i;
            }
    }

    float* pixel(int x, int y) noexcept { return color + 4 * (y * Size + x); }
    const float* pixel(int x, int y) const noexcept { return color + 4 * (y * Size + x); }
    // Whether nothing behind it can be seen: alpha is 1 in all pixels of the region.
    bool isOpaque() const noexcept
    {
        return detail::isOpaque(region, Size, [this](std::ptrdiff_t i) { return color[4 * i + 3] == 1.0f; });
    }
};

// A tile whose pixels lie elsewhere, such as in an image that a renderer has made by itself. They are read there and
// mean what those of a Tile mean. All pointers point to the first pixel of the region; channels that neither the
// operation nor the image needs may be null. A tile without colour is empty.
template <ChannelMask Channels, int Size>
struct TileView : TileHeader {
    static constexpr int size = Size;
    static constexpr ChannelMask channels = Channels;

    std::ptrdiff_t stride = 0; // from a row to the next, in pixels; negative where rows lie bottom-up
    const float *color = nullptr, *depth = nullptr, *normal = nullptr, *albedo = nullptr, *position = nullptr;
    // In place of `color`: premultiplied linear RGBA of 8 bits a channel, level / 255. It is sent as it is, a byte a
    // channel, and composited exactly.
    const std::uint8_t* color8 = nullptr;
    const std::uint32_t *primitiveId = nullptr, *instanceId = nullptr;
    const float* farDepth = nullptr;
    // Pixels of the image outside of it have nothing, and are not read: for a renderer that knows where its data
    // project to. To begin with there is no such limit.
    Region valid{std::numeric_limits<int>::min(), std::numeric_limits<int>::min(), std::numeric_limits<int>::max(),
                 std::numeric_limits<int>::max()};
    Region validRegion() const noexcept { return intersection(region, valid); }
    // A promise: the pixels do not change until the frame's end() has returned. Then they need not be copied. They are
    // read in place if this rank owns the tile, or if the owner is on the same node and they are in memory of
    // sharedMemory(). They are copied all the same if the operation has no readsInPlace or keeps state, if a channel
    // beside colour and depth is sent, with a WireFormat that rounds, an ErrorBudget, or minTransmittance above 0.
    // After a TransportError do not write to such memory until the framebuffer is gone. NetworkConfig::checksums finds
    // promises that are not kept.
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
        if (!(color || color8) || validRegion() != region)
            return false;
        return color ? detail::isOpaque(region, stride, [this](std::ptrdiff_t i) { return color[4 * i + 3] == 1.0f; })
                     : detail::isOpaque(region, stride, [this](std::ptrdiff_t i) { return color8[4 * i + 3] == 255; });
    }
};

namespace detail {

// A Tile or a TileView of any size and channels: its header, and where its pixels lie. Behind the door of the
// framebuffer nothing is a template on the type of a tile.
struct InputPixels : TileHeader {
    template <ChannelMask Channels, int Size>
    InputPixels(const Tile<Channels, Size>& from)
        : TileHeader(from), channels(Channels), at(from.planes()), stride(Size), valid(from.region)
    {
    }
    template <ChannelMask Channels, int Size>
    InputPixels(const TileView<Channels, Size>& from)
        : TileHeader(from), channels(Channels), at(from.planes()), stride(from.stride), valid(from.validRegion()),
          hasBytes(!from.color && from.color8), staysUntilEnd(from.staysUntilEnd)
    {
    }

    const ConstPlanes& planes() const noexcept { return at; }
    // Bytes of a pixel in a channel.
    std::size_t pixelBytes(std::size_t channel) const noexcept
    {
        return channel == Color && hasBytes ? 4 : 4 * static_cast<std::size_t>(channelWords[channel]);
    }
    // The colour of a pixel, counted from the first of the region.
    const std::byte* colorAt(int x, int y) const noexcept
    {
        return at.at[Color] + static_cast<std::ptrdiff_t>(pixelBytes(Color)) * (y * stride + x);
    }

    ChannelMask channels;
    ConstPlanes at;        // to the first pixel of the region; null: not there
    std::ptrdiff_t stride; // from a row to the next, in pixels
    Region valid;          // of the region; pixels outside of it have nothing, and are not read
    bool hasBytes = false; // the colour has 8 bits a channel
    bool staysUntilEnd = false;
    float depthLimit = std::numeric_limits<float>::infinity(); // at this depth or beyond a pixel is empty
};

} // namespace detail

DFB_NAMESPACE_END
