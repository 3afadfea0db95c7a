// Wire: the format of messages; a tile to bytes, and bytes to a fragment that is read in place.
//
// After the MessageHeader a fragment message goes on with a FragmentHeader and the payload:
//   Sparse:    uint16 span counts of the rows [rowBegin, rowEnd) | spans | padding to 16 | planes
//   Dense:     planes: all pixels of the region row by row
//   Constant:  planes: one pixel
//   Empty:     nothing
// The planes are the channels in the order of their bits: the colour of all pixels, then the depth of all, ..., each
// from a multiple of 4 on. A payload that is compressed has its planes split into bytes before that, see PlaneFilter.
#pragma once

#include <dfb/comm/compression.hpp>
#include <dfb/comm/message.hpp>
#include <dfb/detail/plane_filter.hpp>
#include <dfb/fragment.hpp>
#include <dfb/tile_layout.hpp>
#include <dfb/wire_format.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <string>
#include <type_traits>
#include <vector>

namespace dfb::detail {

struct FragmentHeader {
    std::int32_t tile = 0;
    std::int32_t pass = 0;
    std::int32_t children = 0;
    std::uint32_t source = 0;
    std::uint32_t activePixels = 0;
    std::uint32_t rawPayloadBytes = 0; // before compression
    std::uint16_t generation = 0;
    std::uint16_t part = 0;
    std::uint16_t spanCount = 0;
    std::uint16_t rowBegin = 0, rowEnd = 0;
    ChannelMask channels = 0;
    FragmentEncoding encoding = FragmentEncoding::Empty;
    std::uint8_t codec = 0; // 0: the payload is raw
    WireFormat colorFormat = WireFormat::Float32, depthFormat = WireFormat::Float32;
};
static_assert(sizeof(FragmentHeader) == 40 && std::is_trivially_copyable_v<FragmentHeader>);

inline constexpr std::size_t fragmentPrefix = sizeof(MessageHeader) + sizeof(FragmentHeader);
static_assert(fragmentPrefix % 16 == 0, "pixels are read in place");

inline std::size_t alignedTo16(std::size_t byteCount) { return (byteCount + 15) / 16 * 16; }

inline WireFormat formatOf(const FragmentHeader& h, std::size_t channel)
{
    return channel == Color ? h.colorFormat : channel == Depth ? h.depthFormat : WireFormat::Float32;
}

// What a plane of so many pixels takes up in a message.
inline std::size_t planeBytes(const FragmentHeader& h, std::size_t channel, std::size_t pixels)
{
    return (bytesOf(formatOf(h, channel)) * static_cast<std::size_t>(channelWords[channel]) * pixels + 3) / 4 * 4;
}
inline std::size_t planesBytes(const FragmentHeader& h, std::size_t pixels)
{
    std::size_t bytes = 0;
    for (std::size_t c = 0; c < channelCount; ++c)
        if (hasChannel(h.channels, c))
            bytes += planeBytes(h, c, pixels);
    return bytes;
}

// Splits the planes of a payload, or joins them again; what comes before, the table, is copied.
template <class Transform>
void transformPlanes(const FragmentHeader& h, std::size_t tableBytes, std::size_t pixels, const std::byte* in,
                     std::byte* out, const Transform& transform)
{
    std::memcpy(out, in, tableBytes);
    std::size_t at = tableBytes;
    for (std::size_t c = 0; c < channelCount; ++c)
        if (hasChannel(h.channels, c)) {
            const std::size_t bytes = planeBytes(h, c, pixels);
            transform(in + at, bytes, bytesOf(formatOf(h, c)), static_cast<std::size_t>(channelWords[c]), out + at);
            at += bytes;
        }
}

// The most that a fragment message can have. No format is larger than Float32. A row's second span costs less than the
// pixel that parts it from the first.
inline std::size_t largestFragment(int tileSize, ChannelMask channels)
{
    const auto side = static_cast<std::size_t>(tileSize), pixels = side * side;
    const std::size_t perPixel = sizeof(float) * static_cast<std::size_t>(wordsPerPixel(channels));
    static_assert(sizeof(Span) <= 4 * sizeof(float));
    return fragmentPrefix + alignedTo16((sizeof(std::uint16_t) + sizeof(Span)) * side) + pixels * perPixel;
}

// The active pixels of a tile: those with any colour channel that is not 0. A pixel of colour 0 and alpha 0
// contributes nothing, whatever its depth; one with colour and alpha 0 is emission and does.
struct ActiveSpans {
    std::vector<std::uint16_t> rowCounts; // of rows [rowBegin, rowEnd)
    std::vector<Span> spans;
    int rowBegin = 0, rowEnd = 0;
    std::uint32_t pixels = 0;

    template <class TileType>
    void find(const TileType& tile)
    {
        rowCounts.clear();
        spans.clear();
        rowBegin = rowEnd = 0;
        pixels = 0;
        const int width = tile.region.width(), height = tile.region.height();
        for (int y = 0; y < height; ++y) {
            const std::size_t before = spans.size();
            const float* row = tile.pixel(0, y);
            const auto active = [row](int x) -> int { // all bits but the signs; int, as Clang warns of & on bool
                std::uint64_t halves[2];
                std::memcpy(halves, row + 4 * x, sizeof halves);
                return ((halves[0] | halves[1]) & 0x7fffffff7fffffffu) != 0;
            };
            for (int x = 0; x < width;) {
                while (x < width && !active(x))
                    ++x;
                const int begin = x;
                while (x + 4 <= width && active(x) & active(x + 1) & active(x + 2) & active(x + 3))
                    x += 4;
                while (x < width && active(x))
                    ++x;
                if (x > begin) {
                    spans.push_back({static_cast<std::uint16_t>(begin), static_cast<std::uint16_t>(x - begin)});
                    pixels += static_cast<std::uint32_t>(x - begin);
                }
            }
            const auto count = static_cast<std::uint16_t>(spans.size() - before);
            if (count > 0 && rowEnd == 0)
                rowBegin = y;
            if (count > 0)
                rowEnd = y + 1;
            if (rowEnd > 0)
                rowCounts.push_back(count);
        }
        rowCounts.resize(static_cast<std::size_t>(rowEnd - rowBegin));
    }
};

// `planes`: of a tile of this type, those that travel.
template <class TileType>
bool isConstant(const TileType& tile, const ConstPlanes& planes)
{
    const auto size = static_cast<std::size_t>(TileType::size);
    for (int y = 0; y < tile.region.height(); ++y)
        for (std::size_t c = 0; c < channelCount; ++c) {
            if (!planes.at[c])
                continue;
            const std::size_t bytes = 4 * static_cast<std::size_t>(channelWords[c]);
            const std::byte* row = planes.at[c] + static_cast<std::size_t>(y) * size * bytes;
            for (int x = 0; x < tile.region.width(); ++x)
                if (std::memcmp(row + static_cast<std::size_t>(x) * bytes, planes.at[c], bytes) != 0)
                    return false;
        }
    return true;
}

template <class TileType>
bool allInRange(const TileType& tile, const ActiveSpans& active, const WireCoder& coder)
{
    const Span* span = active.spans.data();
    for (int y = active.rowBegin; y < active.rowEnd; ++y)
        for (int i = 0; i < active.rowCounts[static_cast<std::size_t>(y - active.rowBegin)]; ++i, ++span)
            if (!coder.inRange(tile.pixel(span->x, y), span->count))
                return false;
    return true;
}

// Depth as it travels: NaN counts as farthest, and -0 as 0, so that comparing is enough to order.
inline float canonicalDepth(float depth)
{
    const std::uint32_t bits = bitsOf(depth), some = bits == 0x80000000u ? 0u : bits;
    return floatOf((bits & 0x7fffffffu) > 0x7f800000u ? 0x7f800000u : some); // integers, so that it can be vectorized
}

// What is wrong with the pixels of an input.
struct InputFaults {
    std::uint64_t nonFinite = 0;    // pixels with an infinity or a NaN in the colour, or a NaN for a depth
    std::uint64_t alphaOutside = 0; // of the others, those whose alpha is not within [0, 1]
};

// Whether countFaults() would count anything. No branches, so that it can be vectorized.
inline bool hasFault(const float* rgba, const float* depth, int count)
{
    // As a number, the bits of a float without its sign grow with it: infinity has 0x7f800000, what is above is NaN.
    std::uint32_t largest = 0, nanDepth = 0;
    int alpha = 0;
    for (int i = 0; i < 4 * count; ++i)
        largest |= static_cast<std::uint32_t>((bitsOf(rgba[i]) & 0x7fffffffu) + 0x00800000u); // its top bit: not finite
    for (int i = 0; i < count; ++i)
        alpha |= static_cast<int>(!(rgba[4 * i + 3] >= 0.0f)) | static_cast<int>(!(rgba[4 * i + 3] <= 1.0f));
    for (int i = 0; depth && i < count; ++i)
        nanDepth |= static_cast<std::uint32_t>(depth[i] != depth[i]);
    return (largest & 0x80000000u) != 0 || alpha != 0 || nanDepth != 0;
}

// `depth` may be null. Each pixel counts `repeats` times.
inline void countFaults(const float* rgba, const float* depth, int count, std::uint64_t repeats, InputFaults& faults)
{
    for (int i = 0; i < count; ++i, rgba += 4) {
        const bool finite = std::isfinite(rgba[0]) && std::isfinite(rgba[1]) && std::isfinite(rgba[2])
                            && std::isfinite(rgba[3]) && !(depth && depth[i] != depth[i]);
        faults.nonFinite += finite ? 0 : repeats;
        faults.alphaOutside += finite && !(rgba[3] >= 0.0f && rgba[3] <= 1.0f) ? repeats : 0;
    }
}

// Makes the message for a tile, with the channels of `wanted` that the tile has, the colour in this format if it is in
// its range. Adds to `faults`. `codec` may be null.
template <class TileType>
Buffer encodeFragment(MemoryPool& pool, const TileType& tile, ChannelMask wanted, std::uint32_t receiver,
                      const Codec* codec, const WireCoder& coder, WireFormat color, InputFaults& faults)
{
    static thread_local ActiveSpans active;
    active.find(tile);
    const auto channels = static_cast<ChannelMask>((wanted & TileType::channels) | colorChannel);
    ConstPlanes planes = tile.planes();
    for (std::size_t c = 0; c < channelCount; ++c)
        if (!hasChannel(channels, c))
            planes.at[c] = nullptr;
    const int width = tile.region.width(), height = tile.region.height();

    FragmentHeader h;
    h.tile = tile.tile;
    h.pass = tile.pass;
    h.generation = static_cast<std::uint16_t>(tile.generation); // checked: it is below 2^16
    h.children = tile.children;
    h.source = tile.source;
    h.part = tile.part;
    h.channels = channels;
    h.activePixels = active.pixels;
    h.rowBegin = static_cast<std::uint16_t>(active.rowBegin);
    h.rowEnd = static_cast<std::uint16_t>(active.rowEnd);
    std::size_t stored = active.pixels, tableBytes = 0;
    if (active.pixels == 0) {
        h.encoding = FragmentEncoding::Empty;
    } else if (active.pixels == static_cast<std::uint32_t>(width * height)) {
        h.encoding = isConstant(tile, planes) ? FragmentEncoding::Constant : FragmentEncoding::Dense;
        if (h.encoding == FragmentEncoding::Constant)
            stored = 1;
    } else {
        h.encoding = FragmentEncoding::Sparse;
        h.spanCount = static_cast<std::uint16_t>(active.spans.size()); // at most 128 a row, 256 rows
        tableBytes = alignedTo16(sizeof(std::uint16_t) * active.rowCounts.size() + sizeof(Span) * active.spans.size());
    }
    const bool fits = color != WireFormat::Float32 && allInRange(tile, active, coder);
    h.colorFormat = fits ? color : WireFormat::Float32;
    h.depthFormat = coder.depth();
    const std::size_t payload = tableBytes + planesBytes(h, stored);
    h.rawPayloadBytes = static_cast<std::uint32_t>(payload);

    Buffer message = pool.acquire(fragmentPrefix + payload);
    MessageHeader m;
    m.kind = MessageKind::Fragment;
    m.receiver = receiver;
    m.number = tile.frame;
    std::byte* out = message.data() + fragmentPrefix;
    if (h.encoding == FragmentEncoding::Sparse) {
        const std::size_t countBytes = sizeof(std::uint16_t) * active.rowCounts.size();
        const std::size_t spanBytes = sizeof(Span) * active.spans.size();
        std::memcpy(out, active.rowCounts.data(), countBytes);
        std::memcpy(out + countBytes, active.spans.data(), spanBytes);
        std::memset(out + countBytes + spanBytes, 0, tableBytes - countBytes - spanBytes);
    }
    Planes to;
    std::byte* section = out + tableBytes;
    for (std::size_t c = 0; c < channelCount; ++c)
        if (planes.at[c]) {
            to.at[c] = section;
            section += planeBytes(h, c, stored);
            if (stored > 0)
                std::memset(section - 4, 0, 4); // what fills it up
        }
    const bool hasMore = (channels & ~(colorChannel | depthChannel)) != 0;
    const std::uint64_t repeats = h.encoding == FragmentEncoding::Constant ? active.pixels : 1;
    const auto copyPixels = [&](int x, int y, int count) {
        const float* from = tile.pixel(x, y);
        const std::size_t first = static_cast<std::size_t>(y) * TileType::size + static_cast<std::size_t>(x);
        coder.encodeColor(h.colorFormat, from, count, to.at[Color]);
        to.at[Color] += 4 * bytesOf(h.colorFormat) * static_cast<std::size_t>(count);
        const float* fromDepth = planes.at[Depth] ? floatsOf(planes.at[Depth]) + first : nullptr;
        if (hasFault(from, fromDepth, count))
            countFaults(from, fromDepth, count, repeats, faults);
        if (fromDepth) {
            float rounded[256];
            float* depth = h.depthFormat == WireFormat::Float32 ? floatsOf(to.at[Depth]) : rounded;
            for (int i = 0; i < count; ++i)
                depth[i] = canonicalDepth(fromDepth[i]);
            if (depth == rounded)
                coder.encodeDepth(h.depthFormat, rounded, count, to.at[Depth]);
            to.at[Depth] += bytesOf(h.depthFormat) * static_cast<std::size_t>(count);
        }
        if (!hasMore)
            return;
        for (std::size_t c = Normal; c < channelCount; ++c)
            if (planes.at[c]) {
                const std::size_t bytes = 4 * static_cast<std::size_t>(channelWords[c]);
                std::memcpy(to.at[c], planes.at[c] + first * bytes, bytes * static_cast<std::size_t>(count));
                to.at[c] += bytes * static_cast<std::size_t>(count);
            }
    };
    if (h.encoding == FragmentEncoding::Sparse) {
        const Span* span = active.spans.data();
        for (int y = active.rowBegin; y < active.rowEnd; ++y)
            for (int i = 0; i < active.rowCounts[static_cast<std::size_t>(y - active.rowBegin)]; ++i, ++span)
                copyPixels(span->x, y, span->count);
    } else if (h.encoding == FragmentEncoding::Dense) {
        for (int y = 0; y < height; ++y)
            copyPixels(0, y, width);
    } else if (h.encoding == FragmentEncoding::Constant) {
        copyPixels(0, 0, 1);
    }

    if (codec && payload > 0) {
        static thread_local std::vector<std::byte> split;
        split.resize(payload);
        transformPlanes(h, tableBytes, stored, out, split.data(), PlaneFilter::split);
        Buffer packed = pool.acquire(fragmentPrefix + codec->bound(payload));
        const std::size_t packedBytes = codec->compress(split.data(), payload, packed.data() + fragmentPrefix);
        if (packedBytes < payload) {
            packed.shrink(fragmentPrefix + packedBytes);
            message = std::move(packed);
            h.codec = codec->id();
        }
    }
    std::memcpy(message.data(), &m, sizeof m);
    std::memcpy(message.data() + sizeof m, &h, sizeof h);
    return message;
}

// Where the planes of `pixels` pixels are that start at `data`.
inline ConstPlanes planesAt(const std::byte* data, ChannelMask channels, std::size_t pixels)
{
    ConstPlanes planes;
    for (std::size_t c = 0; c < channelCount; ++c)
        if (hasChannel(channels, c)) {
            planes.at[c] = data;
            data += 4 * pixels * static_cast<std::size_t>(channelWords[c]);
        }
    return planes;
}

// A body with its planes as Float32.
inline Buffer expanded(MemoryPool& pool, const FragmentHeader& h, std::size_t tableBytes, std::size_t pixels,
                       const std::byte* body, const WireCoder& coder)
{
    FragmentHeader wide = h;
    wide.colorFormat = wide.depthFormat = WireFormat::Float32;
    Buffer floats = pool.acquire(tableBytes + planesBytes(wide, pixels));
    std::memcpy(floats.data(), body, tableBytes);
    const std::byte* in = body + tableBytes;
    std::byte* out = floats.data() + tableBytes;
    for (std::size_t c = 0; c < channelCount; ++c) {
        if (!hasChannel(h.channels, c))
            continue;
        if (c == Color)
            coder.decodeColor(h.colorFormat, in, pixels, floatsOf(out));
        else if (c == Depth)
            coder.decodeDepth(h.depthFormat, in, pixels, floatsOf(out));
        else
            std::memcpy(out, in, planeBytes(h, c, pixels));
        in += planeBytes(h, c, pixels);
        out += planeBytes(wide, c, pixels);
    }
    return floats;
}

// Checks a fragment message completely and makes the fragment of it, which keeps the message's memory (or that of its
// decompressed form). `passesOf(tile)`: how many passes the tile has. Throws Error (MalformedMessage).
template <class PassesOf>
Fragment decodeFragment(MemoryPool& pool, Buffer&& message, const TileLayout& layout, const PassesOf& passesOf,
                        const Codec* codec, const WireCoder& coder)
{
    if (message.size() < fragmentPrefix)
        failMalformed("shorter than a fragment's header", fragmentPrefix, static_cast<std::int64_t>(message.size()));
    const auto m = loadAs<MessageHeader>(message.data());
    const auto h = loadAs<FragmentHeader>(message.data() + sizeof(MessageHeader));
    if (h.tile < 0 || h.tile >= layout.tileCount())
        failMalformed("tile index outside the image", layout.tileCount() - 1, h.tile);
    if (const int passes = passesOf(h.tile); h.pass < 0 || h.pass >= passes)
        failMalformed("pass outside the tile's", passes - 1, h.pass);
    if (!(h.channels & colorChannel) || (h.channels & ~allChannels))
        failMalformed("unknown set of channels", colorChannel, h.channels);

    if (h.colorFormat > WireFormat::Unorm8 || h.depthFormat > WireFormat::Unorm8)
        failMalformed("unknown format of colour or depth", static_cast<std::int64_t>(WireFormat::Unorm8),
                      static_cast<std::int64_t>(std::max(h.colorFormat, h.depthFormat)));

    TileHeader header;
    header.frame = m.number;
    header.tile = h.tile;
    header.region = layout.region(h.tile);
    header.pass = h.pass;
    header.generation = h.generation;
    header.children = h.children;
    header.source = h.source;
    header.part = h.part;

    const int width = header.region.width(), height = header.region.height();
    const auto pixelCount = static_cast<std::uint32_t>(width * height);
    const std::size_t pixelBytes = sizeof(float) * static_cast<std::size_t>(wordsPerPixel(h.channels));
    std::size_t stored = h.activePixels, tableBytes = 0;
    switch (h.encoding) {
    case FragmentEncoding::Empty:
        if (h.activePixels != 0)
            failMalformed("an empty fragment with pixels", 0, h.activePixels);
        break;
    case FragmentEncoding::Sparse:
        if (h.rowBegin >= h.rowEnd || h.rowEnd > height)
            failMalformed("rows outside the tile", height, h.rowEnd);
        if (h.spanCount > pixelCount)
            failMalformed("more spans than pixels", pixelCount, h.spanCount);
        tableBytes = alignedTo16(sizeof(std::uint16_t) * static_cast<std::size_t>(h.rowEnd - h.rowBegin)
                                 + sizeof(Span) * h.spanCount);
        break;
    case FragmentEncoding::Dense:
    case FragmentEncoding::Constant:
        if (h.activePixels != pixelCount)
            failMalformed("wrong number of pixels", pixelCount, h.activePixels);
        if (h.encoding == FragmentEncoding::Constant)
            stored = 1;
        break;
    default: failMalformed("unknown encoding", -1, static_cast<std::int64_t>(h.encoding));
    }
    if (stored > pixelCount)
        failMalformed("more pixels than the tile has", pixelCount, static_cast<std::int64_t>(stored));
    const std::size_t payload = tableBytes + planesBytes(h, stored);
    if (h.rawPayloadBytes != payload)
        failMalformed("wrong payload size", static_cast<std::int64_t>(payload), h.rawPayloadBytes);

    std::size_t offset = fragmentPrefix;
    if (h.codec != 0) {
        if (!codec || codec->id() != h.codec)
            failMalformed("compressed by a codec that this rank does not have", codec ? codec->id() : 0, h.codec);
        Buffer raw = pool.acquire(payload);
        if (!codec->decompress(message.data() + fragmentPrefix, message.size() - fragmentPrefix, raw.data(), payload))
            failMalformed("the payload does not decompress to its size", static_cast<std::int64_t>(payload), -1);
        message = pool.acquire(payload);
        transformPlanes(h, tableBytes, stored, raw.data(), message.data(), PlaneFilter::join);
        offset = 0;
    } else if (message.size() - fragmentPrefix != payload) {
        failMalformed("wrong message size", static_cast<std::int64_t>(fragmentPrefix + payload),
                      static_cast<std::int64_t>(message.size()));
    }

    if (h.colorFormat != WireFormat::Float32 || h.depthFormat != WireFormat::Float32) {
        message = expanded(pool, h, tableBytes, stored, message.data() + offset, coder);
        offset = 0;
    }

    Fragment::Parts parts;
    parts.colorFormat = h.colorFormat;
    parts.encoding = h.encoding;
    parts.activePixels = h.activePixels;
    parts.rowEnd = height;
    parts.fullRow = {0, static_cast<std::uint16_t>(width)};
    const std::byte* body = message.data() + offset;
    if (h.encoding == FragmentEncoding::Sparse) {
        parts.rowBegin = h.rowBegin;
        parts.rowEnd = h.rowEnd;
        parts.rowSpanCounts = reinterpret_cast<const std::uint16_t*>(body);
        parts.spans = reinterpret_cast<const Span*>(parts.rowSpanCounts + (h.rowEnd - h.rowBegin));
        const Span* span = parts.spans;
        std::uint32_t spans = 0, pixels = 0;
        for (int row = 0; row < h.rowEnd - h.rowBegin; ++row) {
            int x = 0;
            if ((spans += parts.rowSpanCounts[row]) > h.spanCount)
                failMalformed("more spans in the rows than in all", h.spanCount, spans);
            for (int i = 0; i < parts.rowSpanCounts[row]; ++i, ++span) {
                if (span->x < x || span->count == 0 || span->x + span->count > width)
                    failMalformed("a span outside its row", width, span->x + span->count);
                x = span->x + span->count;
                pixels += span->count;
            }
        }
        if (spans != h.spanCount || pixels != h.activePixels)
            failMalformed("the spans do not add up to the active pixels", h.activePixels, pixels);
    }
    ConstPlanes planes = planesAt(body + tableBytes, h.channels, stored);
    if (h.encoding == FragmentEncoding::Constant) {
        // One row that every row reads.
        const auto count = static_cast<std::size_t>(width);
        Buffer row = pool.acquire(count * pixelBytes);
        const ConstPlanes rowPlanes = planesAt(row.data(), h.channels, count);
        std::byte* out = row.data();
        for (std::size_t c = 0; c < channelCount; ++c)
            for (std::size_t x = 0; planes.at[c] && x < count; ++x, out += 4 * channelWords[c])
                std::memcpy(out, planes.at[c], 4 * static_cast<std::size_t>(channelWords[c]));
        planes = rowPlanes;
        message = std::move(row);
    }
    parts.channels = h.channels;
    parts.color = floatsOf(planes.at[Color]);
    parts.depth = floatsOf(planes.at[Depth]);
    planes.at[Color] = planes.at[Depth] = nullptr;
    parts.aux = planes;
    if (parts.depth && h.encoding != FragmentEncoding::Empty) {
        const std::size_t count = h.encoding == FragmentEncoding::Constant ? static_cast<std::size_t>(width) : stored;
        std::uint32_t isNan = 0;
        for (std::size_t i = 0; i < count; ++i)
            isNan |= static_cast<std::uint32_t>(parts.depth[i] != parts.depth[i]);
        if (isNan != 0)
            failMalformed("a depth is NaN");
    }
    return Fragment(header, std::move(message), parts);
}

} // namespace dfb::detail
