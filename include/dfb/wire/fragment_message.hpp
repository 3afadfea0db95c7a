// Wire: encodes an input of a tile as a message, and decodes that to a fragment, which is read in place.
//
// The MessageHeader is followed by a FragmentHeader and a body as in sparse_planes.hpp, which is split if it is
// compressed. If the owner reads an input in the memory of its renderer, the body is a PlaceInMemory.
#pragma once

#include <dfb/base/function_ref.hpp>
#include <dfb/comm/compression.hpp>
#include <dfb/comm/message.hpp>
#include <dfb/fragment.hpp>
#include <dfb/tile_layout.hpp>
#include <dfb/wire/sparse_planes.hpp>
#include <dfb/wire/wire_format.hpp>
#include <dfb/wire/wire_kernels.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <type_traits>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

struct FragmentHeader {
    std::int32_t tile = 0;
    std::int32_t pass = 0;
    std::int32_t children = 0;
    std::uint32_t source = 0;
    std::uint32_t rawPayloadBytes = 0; // before compression
    SparseShape shape;
    std::uint16_t generation = 0;
    std::uint16_t part = 0;
    ChannelMask channels = 0;
    std::uint8_t codec = 0; // 0: the payload is raw
    WireFormat colorFormat = WireFormat::Float32;

    PlaneFormat format() const { return {channels, bytesOf(colorFormat)}; }
};
static_assert(sizeof(FragmentHeader) == 40 && std::is_trivially_copyable_v<FragmentHeader>);

inline constexpr std::size_t fragmentPrefix = sizeof(MessageHeader) + sizeof(FragmentHeader);
static_assert(fragmentPrefix % 16 == 0, "pixels are read in place");

// The largest size of a fragment message with `pixelBytes` bytes for each pixel. One span for each row is enough: each
// further span costs no more than the empty pixel that separates it from the span before.
inline std::size_t mostBytes(int width, int height, std::size_t pixelBytes)
{
    const auto rows = static_cast<std::size_t>(height), pixels = rows * static_cast<std::size_t>(width);
    static_assert(sizeof(Span) <= 4);
    return fragmentPrefix + alignedTo16((sizeof(std::uint16_t) + sizeof(Span)) * rows) + pixels * pixelBytes;
}
// The largest size in any colour format, as none is larger than Float32.
inline std::size_t largestFragment(int width, int height, ChannelMask channels)
{
    return mostBytes(width, height, PlaneFormat(channels, sizeof(float)).pixelBytes());
}

// Copies values of 3 floats a pixel, premultiplied by alpha, and premultiplies them by the rounded alpha instead. The
// owner gets the rounded alpha and divides by it in the end, so otherwise the result would not be a mean. `encoded`:
// the colours `rgba`, as they travel.
inline void multiplyByRounded(const WireCoder& coder, WireFormat format, const float* rgba, const std::byte* encoded,
                              const float* in, std::size_t pixels, float* out)
{
    static thread_local std::vector<float> decoded;
    decoded.resize(std::max(decoded.size(), 4 * pixels));
    coder.decodeColor(format, encoded, pixels, decoded.data());
    std::memcpy(out, in, 3 * sizeof(float) * pixels);
    for (std::size_t i = 0; i < pixels; ++i)
        if (const float alpha = rgba[4 * i + 3], rounded = decoded[4 * i + 3]; alpha > 0 && alpha != rounded)
            for (std::size_t c = 3 * i; c < 3 * i + 3; ++c)
                out[c] = in[c] * (rounded / alpha);
}

// Whether all pixels of the planes are equal, bit for bit.
inline bool areConstant(const InputPixels& tile, const ConstPlanes& planes, std::size_t pixels)
{
    for (std::size_t c = 0; c < channelCount; ++c) {
        const std::size_t bytes = tile.pixelBytes(c);
        if (planes.at[c] && std::memcmp(planes.at[c], planes.at[c] + bytes, bytes * (pixels - 1)) != 0)
            return false;
    }
    return true;
}

inline FragmentHeader fragmentHeader(const InputPixels& tile, ChannelMask channels)
{
    FragmentHeader h;
    h.tile = tile.tile;
    h.pass = tile.pass;
    h.generation = static_cast<std::uint16_t>(tile.generation); // checked: it is below 2^16
    h.children = tile.children;
    h.source = tile.source;
    h.part = tile.part;
    h.channels = channels;
    return h;
}

// Compresses the message's body if that makes it smaller.
inline void compress(MemoryPool& pool, const Codec& codec, FragmentHeader& h, Buffer& message)
{
    static thread_local std::vector<std::byte> split;
    const std::size_t payload = h.rawPayloadBytes;
    split.resize(payload);
    h.format().split(h.shape, message.data() + fragmentPrefix, split.data());
    Buffer packed = pool.acquire(fragmentPrefix + codec.bound(payload));
    const std::size_t packedBytes = codec.compress(split.data(), payload, packed.data() + fragmentPrefix);
    if (packedBytes >= payload)
        return;
    packed.shrink(fragmentPrefix + packedBytes);
    message = std::move(packed);
    h.codec = codec.id();
    h.shape.isSplit = 1;
}

// Makes the message for a tile, with those channels of `wanted` that the tile has. The colour is in the format `color`
// if all colours are in its range. Adds to `faults`. `codec` may be null.
inline Buffer encodeFragment(MemoryPool& pool, const InputPixels& tile, ChannelMask wanted, std::uint32_t receiver,
                             const Codec* codec, const WireCoder& coder, WireFormat color, InputFaults& faults)
{
    static thread_local ActivePixels active;
    static thread_local std::vector<float> wide; // colours that are to be rounded
    const auto channels = static_cast<ChannelMask>((wanted & tile.channels) | colorChannel);
    const int width = tile.region.width(), height = tile.region.height();
    const auto pixelCount = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
    const bool isRounded = color != WireFormat::Float32 && !tile.hasBytes;
    // Pixels that travel unchanged are copied straight to the message, and to their final place if all are active.
    const PlaneFormat gathered(channels, tile.hasBytes ? 1 : sizeof(float));
    Buffer message = pool.acquire(isRounded ? fragmentPrefix : mostBytes(width, height, gathered.pixelBytes()));
    Buffer before; // keeps the first message if another one replaces it
    wide.resize(std::max(wide.size(), isRounded ? 4 * pixelCount : 0));
    auto* colors = isRounded ? reinterpret_cast<std::byte*>(wide.data()) : message.data() + fragmentPrefix;
    const float* rgba = floatsOf(colors);
    auto* depths = isRounded ? nullptr : floatsOf(colors + gathered.pixelBytes(Color) * pixelCount);
    const ConstPlanes planes = active.gather(tile, channels, coder.activeByDepth(), colors, depths, faults);

    FragmentHeader h = fragmentHeader(tile, channels);
    h.shape = shapeOf(active, tile.region);
    if (h.shape.encoding == FragmentEncoding::Dense && areConstant(tile, planes, pixelCount))
        h.shape.encoding = FragmentEncoding::Constant;
    const std::size_t stored = h.shape.stored();
    if (tile.hasBytes)
        h.colorFormat = WireFormat::Bytes;
    else if (isRounded && coder.inRange(rgba, static_cast<int>(stored)))
        h.colorFormat = color;
    const bool isCopied = h.colorFormat == WireFormat::Float32 || tile.hasBytes;
    const PlaneFormat format = h.format();
    const std::size_t payload = format.bodyBytes(h.shape), size = fragmentPrefix + payload;
    h.rawPayloadBytes = static_cast<std::uint32_t>(payload);

    // Moves a message that does not fit its block, or fills less than three quarters of it: this block is soon needed
    // again.
    if (4 * size < 3 * message.size() || message.size() < size) {
        Buffer smaller = pool.acquire(size);
        if (isCopied)
            std::memcpy(smaller.data() + fragmentPrefix, colors, format.pixelBytes(Color) * stored);
        before = std::move(message);
        message = std::move(smaller);
    }
    message.shrink(size);
    std::byte* const body = message.data() + fragmentPrefix;
    encodeSparse(format, h.shape, active, body, [&](std::size_t c, std::byte* out, std::size_t bytes) {
        if (c == Color && !isCopied)
            coder.encodeColor(h.colorFormat, rgba, static_cast<int>(stored), out);
        else if ((c == Normal || c == Albedo) && !isCopied)
            multiplyByRounded(coder, h.colorFormat, rgba, body, floatsOf(planes.at[c]), stored, floatsOf(out));
        else if (c != Color && out != planes.at[c])
            std::memmove(out, planes.at[c], bytes);
    });
    if (codec && payload > 0)
        compress(pool, *codec, h, message);
    storeAll(message.data(), MessageHeader::of(MessageKind::Fragment, receiver, tile.frame), h);
    return message;
}

// The checksum of colour and depth of a tile's valid pixels.
inline std::uint32_t checksumOf(const InputPixels& tile)
{
    std::uint32_t sum = 0;
    const Region valid = tile.valid;
    for (const std::size_t c : {std::size_t{Color}, std::size_t{Depth}}) {
        const auto bytes = static_cast<std::ptrdiff_t>(tile.pixelBytes(c));
        for (int y = valid.y0 - tile.region.y0; tile.planes.at[c] && y < valid.y1 - tile.region.y0; ++y)
            sum = crc32c(tile.planes.at[c] + bytes * (y * tile.stride + valid.x0 - tile.region.x0),
                         static_cast<std::size_t>(bytes * valid.width()), sum);
    }
    return sum;
}

// Where the owner finds the pixels of an input, as bytes from the start of the memory that the sender shares with it.
struct PlaceInMemory {
    std::int64_t color = 0, depth = -1;           // of the region's first pixel; -1: none
    std::int64_t stride = 0;                      // from a row to the next, in pixels
    std::uint16_t x0 = 0, y0 = 0, x1 = 0, y1 = 0; // the valid pixels, counted from the region's first one
    float depthLimit = 0;                         // at this depth or beyond a pixel is empty
    std::uint32_t unused = 0;
};
static_assert(sizeof(PlaceInMemory) == 40 && std::is_trivially_copyable_v<PlaceInMemory>);

// The bytes from the first to the last valid pixel of a plane whose region begins at `first`.
struct ByteRange {
    std::int64_t begin = 0, end = 0;
};
inline ByteRange bytesOfPlane(std::int64_t first, std::int64_t stride, const Region& valid, std::int64_t pixelBytes)
{
    const std::int64_t upper = first + (valid.y0 * stride + valid.x0) * pixelBytes,
                       lower = first + ((valid.y1 - 1) * stride + valid.x0) * pixelBytes;
    return {std::min(upper, lower), std::max(upper, lower) + valid.width() * pixelBytes};
}

// Makes the message for a tile whose pixels the owner reads where they lie. `offsetOf(address)`: the offset from the
// start of the shared memory, or -1. Returns an empty buffer if the pixels do not lie in the shared memory.
template <class OffsetOf>
Buffer encodeInPlace(MemoryPool& pool, const InputPixels& tile, ChannelMask channels, std::uint32_t receiver,
                     const OffsetOf& offsetOf)
{
    const PixelsInPlace pixels = pixelsInPlace(tile, channels, false); // the owner knows whether they are by depth
    // Returns the offset of a plane's first pixel, or -1 unless all of the plane's valid pixels are in the shared
    // memory.
    const auto placeOf = [&](const std::byte* plane, std::int64_t pixelBytes) -> std::int64_t {
        const ByteRange bytes = bytesOfPlane(0, pixels.stride, pixels.valid, pixelBytes);
        const std::int64_t begin = offsetOf(plane + bytes.begin), end = offsetOf(plane + bytes.end - 1);
        return begin < 0 || end != begin + (bytes.end - bytes.begin) - 1 ? -1 : begin - bytes.begin;
    };
    PlaceInMemory place;
    place.color = placeOf(pixels.color, pixels.activity.colorBytes());
    place.depth = pixels.depth ? placeOf(reinterpret_cast<const std::byte*>(pixels.depth), 4) : -1;
    if (place.color < 0 || (pixels.depth && place.depth < 0))
        return Buffer();
    place.stride = pixels.stride;
    place.x0 = static_cast<std::uint16_t>(pixels.valid.x0);
    place.y0 = static_cast<std::uint16_t>(pixels.valid.y0);
    place.x1 = static_cast<std::uint16_t>(pixels.valid.x1);
    place.y1 = static_cast<std::uint16_t>(pixels.valid.y1);
    place.depthLimit = pixels.activity.depthLimit;
    FragmentHeader h = fragmentHeader(tile, channels);
    h.shape.encoding = FragmentEncoding::InPlace;
    h.colorFormat = tile.hasBytes ? WireFormat::Bytes : WireFormat::Float32;
    h.rawPayloadBytes = sizeof place;
    Buffer message = pool.acquire(fragmentPrefix + sizeof place);
    storeAll(message.data(), MessageHeader::of(MessageKind::Fragment, receiver, tile.frame), h, place);
    return message;
}

// Looks up bytes, by offset and count, in the memory that the sender shares with this rank. Returns null if they are
// not in it.
using SharedBytes = FunctionRef<const std::byte*(std::int64_t offset, std::int64_t byteCount)>;

// Whether a fragment message says that its pixels are read in place. The message need not have been checked.
inline bool saysInPlace(const Buffer& message)
{
    return message.size() >= fragmentPrefix
           && loadAs<FragmentHeader>(message.data() + sizeof(MessageHeader)).shape.encoding
                  == FragmentEncoding::InPlace;
}

// The size in bytes that a message of encodeFragment() would have without a codec.
inline std::size_t rawFragmentBytes(const Buffer& message)
{
    return fragmentPrefix + loadAs<FragmentHeader>(message.data() + sizeof(MessageHeader)).rawPayloadBytes;
}

// Decompresses the payload if needed, and converts its colours to Float32 unless the coder keeps them. Returns where
// the payload is in `message`, which is replaced by another buffer if needed. Throws Error (MalformedMessage).
inline const std::byte* unpack(MemoryPool& pool, Buffer& message, const FragmentHeader& h, const Codec* codec,
                               const WireCoder& coder)
{
    const PlaneFormat format = h.format(), wide(h.channels, sizeof(float));
    const std::size_t payload = format.bodyBytes(h.shape), stored = h.shape.stored();
    if (h.rawPayloadBytes != payload)
        failMalformed("wrong payload size", static_cast<std::int64_t>(payload), h.rawPayloadBytes);
    std::size_t offset = fragmentPrefix;
    if (h.codec != 0) {
        if (!codec || codec->id() != h.codec)
            failMalformed("compressed by a codec that this rank does not have", codec ? codec->id() : 0, h.codec);
        if (h.shape.isSplit == 0)
            failMalformed("compressed and not split", 1, 0);
        Buffer raw = pool.acquire(payload);
        if (!codec->decompress(message.data() + fragmentPrefix, message.size() - fragmentPrefix, raw.data(), payload))
            failMalformed("the payload does not decompress to its size", static_cast<std::int64_t>(payload), -1);
        message = pool.acquire(payload);
        format.join(h.shape, raw.data(), message.data());
        offset = 0;
    } else if (h.shape.isSplit != 0) {
        failMalformed("split and not compressed", 0, h.shape.isSplit);
    } else if (message.size() - fragmentPrefix != payload) {
        failMalformed("wrong message size", static_cast<std::int64_t>(fragmentPrefix + payload),
                      static_cast<std::int64_t>(message.size()));
    }
    if (h.colorFormat == WireFormat::Float32 || coder.keeps(h.colorFormat))
        return message.data() + offset;

    Buffer floats = pool.acquire(wide.bodyBytes(h.shape));
    const std::byte* in = message.data() + offset;
    if (!coder.decodeColor(h.colorFormat, in, stored, floatsOf(floats.data())))
        failMalformed("a colour that is out of its format's range");
    const std::size_t colors = format.pixelBytes(Color) * stored;
    // Everything behind the colours is copied unchanged.
    std::copy_n(in + colors, payload - colors, floats.data() + wide.pixelBytes(Color) * stored);
    message = std::move(floats);
    return message.data();
}

// Makes a row of copies of the one pixel that a Constant body has.
inline Buffer rowOf(MemoryPool& pool, const PlaneFormat& format, const ConstPlanes& pixel, std::size_t width)
{
    Buffer row = pool.acquire(width * format.pixelBytes());
    format.forEachPlane(width, [&](std::size_t c, std::size_t at, std::size_t bytes) {
        const std::size_t each = format.pixelBytes(c);
        for (std::size_t x = 0; x < bytes; x += each)
            std::memcpy(row.data() + at + x, pixel.at[c], each);
    });
    return row;
}

// Reads where the pixels of an input lie, and checks the message completely. Throws Error (MalformedMessage).
inline Fragment::Parts decodeInPlace(const Buffer& message, const FragmentHeader& h, const Region& region, bool byDepth,
                                     const SharedBytes& sharedBytes, FaultCounts* faults)
{
    if (message.size() != fragmentPrefix + sizeof(PlaceInMemory) || h.rawPayloadBytes != sizeof(PlaceInMemory)
        || h.codec != 0)
        failMalformed("wrong size of a place in memory", sizeof(PlaceInMemory), h.rawPayloadBytes);
    if ((h.channels & ~(colorChannel | depthChannel)) != 0
        || (h.colorFormat != WireFormat::Float32 && h.colorFormat != WireFormat::Bytes))
        failMalformed("channels or a format that are not read in place", colorChannel | depthChannel, h.channels);
    const auto place = loadAs<PlaceInMemory>(message.data() + fragmentPrefix);
    Fragment::Parts parts;
    PixelsInPlace& p = parts.inPlace;
    p.valid = {place.x0, place.y0, place.x1, place.y1};
    const std::int64_t largest = std::int64_t{1} << 40; // offset or stride, so that sums cannot overflow
    const auto isSmall = [&](std::int64_t value) { return value >= -largest && value <= largest; };
    if (p.valid.x0 >= p.valid.x1 || p.valid.y0 >= p.valid.y1 || p.valid.x1 > region.width()
        || p.valid.y1 > region.height())
        failMalformed("valid pixels outside the tile", region.width(), p.valid.x1);
    if (!isSmall(place.stride) || !isSmall(place.color) || !isSmall(place.depth)
        || std::abs(place.stride) < p.valid.width() || (h.colorFormat != WireFormat::Bytes && place.color % 4 != 0))
        failMalformed("rows that cannot be", p.valid.width(), place.stride);
    // The address of the region's first pixel, which need not lie in the memory itself.
    const auto planeAt = [&](std::int64_t first, std::int64_t pixelBytes) {
        const ByteRange bytes = bytesOfPlane(first, place.stride, p.valid, pixelBytes);
        const std::byte* begin = bytes.begin < 0 ? nullptr : sharedBytes(bytes.begin, bytes.end - bytes.begin);
        if (!begin)
            failMalformed("a place outside of the memory that the sender shares", -1, bytes.begin);
        return begin - (bytes.begin - first);
    };
    p.activity = {byDepth, h.colorFormat == WireFormat::Bytes, place.depthLimit};
    p.stride = static_cast<std::ptrdiff_t>(place.stride);
    p.color = planeAt(place.color, p.activity.colorBytes());
    if (hasChannel(h.channels, Depth)) {
        if (place.depth % 4 != 0)
            failMalformed("a depth between two words", 0, place.depth % 4);
        p.depth = floatsOf(planeAt(place.depth, 4));
    } else if (byDepth) {
        failMalformed("an input without the depth that tells which pixels it has");
    }
    parts.encoding = FragmentEncoding::InPlace;
    parts.channels = h.channels;
    parts.colorFormat = h.colorFormat;
    parts.faults = faults;
    return parts;
}

// Checks a fragment message completely and makes a fragment from it. The fragment keeps the message's memory (or that
// of its decompressed form). `passesOf(tile)`: how many passes the tile has. If the fragment is read in place, the
// faults that are found while it is read are added to `faults`. Throws Error (MalformedMessage).
inline Fragment decodeFragment(
    MemoryPool& pool, Buffer&& message, const TileLayout& layout, const FunctionRef<int(int)>& passesOf,
    const Codec* codec, const WireCoder& coder,
    const SharedBytes& sharedBytes = [](std::int64_t, std::int64_t) -> const std::byte* { return nullptr; },
    FaultCounts* faults = nullptr)
{
    if (message.size() < fragmentPrefix)
        failMalformed("shorter than a fragment's header", fragmentPrefix, static_cast<std::int64_t>(message.size()));
    const auto h = loadAs<FragmentHeader>(message.data() + sizeof(MessageHeader));
    if (h.tile < 0 || h.tile >= layout.tileCount())
        failMalformed("tile index outside the image", layout.tileCount() - 1, h.tile);
    if (const int passes = passesOf(h.tile); h.pass < 0 || h.pass >= passes)
        failMalformed("pass outside the tile's", passes - 1, h.pass);
    TileHeader header;
    header.frame = loadAs<MessageHeader>(message.data()).number;
    header.tile = h.tile;
    header.region = layout.region(h.tile);
    header.pass = h.pass;
    header.generation = h.generation;
    header.children = h.children;
    header.source = h.source;
    header.part = h.part;

    if (!(h.channels & colorChannel) || (h.channels & ~allChannels))
        failMalformed("unknown set of channels", colorChannel, h.channels);
    if (h.colorFormat > WireFormat::Bytes)
        failMalformed("unknown format of colour", static_cast<std::int64_t>(WireFormat::Bytes),
                      static_cast<std::int64_t>(h.colorFormat));
    if (h.shape.encoding == FragmentEncoding::InPlace)
        return Fragment(header, Buffer(),
                        decodeInPlace(message, h, header.region, coder.activeByDepth(), sharedBytes, faults));
    h.shape.check(header.region);
    const std::byte* in = unpack(pool, message, h, codec, coder);
    const int width = header.region.width();
    const bool keepsBytes = coder.keeps(h.colorFormat);
    const PlaneFormat format(h.channels, keepsBytes ? 1 : sizeof(float));
    SparseBody body = decodeSparse(format, h.shape, width, in);
    const float* depth = floatsOf(body.planes.at[Depth]);
    if (depth && hasNan(depth, h.shape.stored()))
        failMalformed("a depth is NaN");
    if (h.shape.encoding == FragmentEncoding::Constant) { // every row reads the same one
        message = rowOf(pool, format, body.planes, static_cast<std::size_t>(width));
        body.planes = format.planesAt(std::as_const(message).data(), static_cast<std::size_t>(width));
    }

    Fragment::Parts parts;
    parts.encoding = h.shape.encoding;
    parts.activePixels = h.shape.pixels;
    const bool isSparse = h.shape.encoding == FragmentEncoding::Sparse;
    parts.rowBegin = isSparse ? h.shape.rowBegin : 0;
    parts.rowEnd = isSparse ? h.shape.rowEnd : header.region.height();
    parts.rowSpanCounts = body.rowCounts;
    parts.spans = body.spans;
    parts.channels = h.channels;
    parts.colorFormat = h.colorFormat;
    parts.fullRow = {0, static_cast<std::uint16_t>(width)};
    parts.color = keepsBytes ? nullptr : floatsOf(body.planes.at[Color]);
    parts.bytes = keepsBytes ? body.planes.at[Color] : nullptr;
    parts.depth = floatsOf(body.planes.at[Depth]);
    parts.aux = body.planes;
    parts.aux.at[Color] = parts.aux.at[Depth] = nullptr;
    return Fragment(header, std::move(message), parts);
}

} // namespace detail
DFB_NAMESPACE_END
