// Wire: the format of messages; a tile to bytes, and bytes to a fragment that is read in place.
//
// After the MessageHeader a fragment message goes on with a FragmentHeader and the payload:
//   Sparse:    planes | spans | uint16 span counts of the rows [rowBegin, rowEnd) | padding to 16
//   Dense:     planes: all pixels of the region row by row
//   Constant:  planes: one pixel
//   Empty:     nothing
// The planes are the channels in the order of their bits: the colour of all pixels, then the depth of all, ..., each
// from a multiple of 4 on. A payload that is compressed has its planes split into bytes before that, see PlaneFilter.
#pragma once

#include <dfb/base/cpu.hpp>
#include <dfb/comm/compression.hpp>
#include <dfb/comm/message.hpp>
#include <dfb/fragment.hpp>
#include <dfb/tile_layout.hpp>
#include <dfb/wire/active_pixels.hpp>
#include <dfb/wire/plane_filter.hpp>
#include <dfb/wire/wire_format.hpp>

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
    WireFormat colorFormat = WireFormat::Float32;
    std::uint8_t reserved = 0;
};
static_assert(sizeof(FragmentHeader) == 40 && std::is_trivially_copyable_v<FragmentHeader>);

inline constexpr std::size_t fragmentPrefix = sizeof(MessageHeader) + sizeof(FragmentHeader);
static_assert(fragmentPrefix % 16 == 0, "pixels are read in place");

inline std::size_t alignedTo16(std::size_t byteCount) { return (byteCount + 15) / 16 * 16; }

inline WireFormat formatOf(const FragmentHeader& h, std::size_t channel)
{
    return channel == Color ? h.colorFormat : WireFormat::Float32;
}

// What a plane of so many pixels takes up in a message.
inline std::size_t planeBytes(const FragmentHeader& h, std::size_t channel, std::size_t pixels)
{
    return bytesOf(formatOf(h, channel)) * static_cast<std::size_t>(channelWords[channel]) * pixels;
}
inline std::size_t planesBytes(const FragmentHeader& h, std::size_t pixels)
{
    std::size_t bytes = 0;
    for (std::size_t c = 0; c < channelCount; ++c)
        if (hasChannel(h.channels, c))
            bytes += planeBytes(h, c, pixels);
    return bytes;
}

// Splits the planes of a payload, or joins them again; what comes behind, the table, is copied.
template <class Transform>
void transformPlanes(const FragmentHeader& h, std::size_t tableBytes, std::size_t pixels, const std::byte* in,
                     std::byte* out, const Transform& transform)
{
    std::size_t at = 0;
    for (std::size_t c = 0; c < channelCount; ++c)
        if (hasChannel(h.channels, c)) {
            const std::size_t bytes = planeBytes(h, c, pixels);
            transform(in + at, bytes, bytesOf(formatOf(h, c)), static_cast<std::size_t>(channelWords[c]), out + at);
            at += bytes;
        }
    std::memcpy(out + at, in + at, tableBytes);
}

// The most that a fragment message can have. No format is larger than Float32. A row's second span costs less than the
// pixel that parts it from the first.
inline std::size_t largestFragment(int width, int height, ChannelMask channels)
{
    const auto rows = static_cast<std::size_t>(height), pixels = rows * static_cast<std::size_t>(width);
    const std::size_t perPixel = sizeof(float) * static_cast<std::size_t>(wordsPerPixel(channels));
    static_assert(sizeof(Span) <= 4 * sizeof(float));
    return fragmentPrefix + alignedTo16((sizeof(std::uint16_t) + sizeof(Span)) * rows) + pixels * perPixel;
}

// What is wrong with the pixels of an input.
struct InputFaults {
    std::uint64_t nonFinite = 0;    // pixels with an infinity or a NaN in the colour, or a NaN for a depth
    std::uint64_t alphaOutside = 0; // of the others, those whose alpha is not within [0, 1]
};

// `depth` may be null.
inline void countFaults(const float* rgba, const float* depth, int count, InputFaults& faults)
{
    for (int i = 0; i < count; ++i, rgba += 4) {
        const bool finite = std::isfinite(rgba[0]) && std::isfinite(rgba[1]) && std::isfinite(rgba[2])
                            && std::isfinite(rgba[3]) && !(depth && depth[i] != depth[i]);
        faults.nonFinite += finite ? 0 : 1;
        faults.alphaOutside += finite && !(rgba[3] >= 0.0f && rgba[3] <= 1.0f) ? 1 : 0;
    }
}

// Whether all pixels of a plane are alike, bit for bit.
inline bool isConstant(const std::byte* plane, std::size_t channel, std::size_t pixels)
{
    const std::size_t bytes = 4 * static_cast<std::size_t>(channelWords[channel]);
    return std::memcmp(plane, plane + bytes, bytes * (pixels - 1)) == 0;
}

// Copies what is premultiplied by alpha, 3 floats a pixel, and makes it so by the alpha that the owner gets: else what
// is divided by that in the end would not be a mean. `encoded`: the colours `rgba`, as they travel.
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

// Makes the message for a tile, with the channels of `wanted` that the tile has, the colour in this format if it is in
// its range. Adds to `faults`. `codec` may be null.
inline Buffer encodeFragment(MemoryPool& pool, const InputPixels& tile, ChannelMask wanted, std::uint32_t receiver,
                             const Codec* codec, const WireCoder& coder, WireFormat color, InputFaults& faults)
{
    static thread_local ActivePixels active;
    static thread_local std::vector<float> wide; // colours that are to be rounded
    const auto channels = static_cast<ChannelMask>((wanted & tile.channels) | colorChannel);
    const int width = tile.region.width(), height = tile.region.height();
    const auto pixelCount = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
    // Colours that travel as they are go straight to their place in the message.
    Buffer message =
        pool.acquire(color == WireFormat::Float32 ? largestFragment(width, height, channels) : fragmentPrefix);
    wide.resize(std::max(wide.size(), color == WireFormat::Float32 ? 0 : 4 * pixelCount));
    float* rgba = color == WireFormat::Float32 ? floatsOf(message.data() + fragmentPrefix) : wide.data();
    active.gather(tile, channels, coder.activeByDepth(), rgba);
    const auto planeOf = [&](std::size_t c) {
        return c == Color ? reinterpret_cast<const std::byte*>(rgba) : active.plane(c);
    };

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
    const std::size_t spanBytes = sizeof(Span) * active.spans.size();
    const std::size_t countBytes = sizeof(std::uint16_t) * active.rowCounts.size();
    if (active.pixels == 0) {
        h.encoding = FragmentEncoding::Empty;
    } else if (active.pixels == pixelCount) {
        bool constant = true;
        for (std::size_t c = 0; c < channelCount; ++c)
            constant = constant && (!hasChannel(channels, c) || isConstant(planeOf(c), c, pixelCount));
        h.encoding = constant ? FragmentEncoding::Constant : FragmentEncoding::Dense;
        stored = constant ? 1 : stored;
    } else {
        h.encoding = FragmentEncoding::Sparse;
        h.spanCount = static_cast<std::uint16_t>(active.spans.size()); // at most 128 a row, 256 rows
        tableBytes = alignedTo16(spanBytes + countBytes);
    }
    const auto count = static_cast<int>(stored);
    h.colorFormat = color != WireFormat::Float32 && coder.inRange(rgba, count) ? color : WireFormat::Float32;
    const std::size_t payload = tableBytes + planesBytes(h, stored);
    h.rawPayloadBytes = static_cast<std::uint32_t>(payload);
    faults.nonFinite += active.nanDepths();
    if (active.mayBeFaulty())
        active.forEachSpan(tile, [&](std::size_t first, int spanPixels) {
            const ConstPlanes& planes = tile.planes();
            countFaults(floatsOf(planes.at[Color]) + 4 * first,
                        hasChannel(channels, Depth) ? floatsOf(planes.at[Depth]) + first : nullptr, spanPixels, faults);
        });

    // A block that it would not fill is soon needed again.
    if (4 * (fragmentPrefix + payload) < 3 * message.size() || message.size() < fragmentPrefix + payload) {
        Buffer smaller = pool.acquire(fragmentPrefix + payload);
        if (h.colorFormat == WireFormat::Float32)
            std::memcpy(smaller.data() + fragmentPrefix, rgba, planeBytes(h, Color, stored));
        message = std::move(smaller);
    }
    message.shrink(fragmentPrefix + payload);
    MessageHeader m;
    m.kind = MessageKind::Fragment;
    m.receiver = receiver;
    m.number = tile.frame;
    std::byte* const out = message.data() + fragmentPrefix;
    std::byte* to = out;
    for (std::size_t c = 0; c < channelCount && stored > 0; ++c) {
        if (!hasChannel(channels, c))
            continue;
        const std::size_t bytes = planeBytes(h, c, stored);
        if (c == Color && h.colorFormat != WireFormat::Float32)
            coder.encodeColor(h.colorFormat, rgba, count, to);
        else if ((c == Normal || c == Albedo) && h.colorFormat != WireFormat::Float32)
            multiplyByRounded(coder, h.colorFormat, rgba, out, floatsOf(planeOf(c)), stored, floatsOf(to));
        else if (c != Color)
            std::memcpy(to, planeOf(c), bytes);
        to += bytes;
    }
    if (h.encoding == FragmentEncoding::Sparse) {
        std::memcpy(to, active.spans.data(), spanBytes);
        std::memcpy(to + spanBytes, active.rowCounts.data(), countBytes);
        std::memset(to + spanBytes + countBytes, 0, tableBytes - spanBytes - countBytes);
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

// Of a fragment message that encodeFragment() has made, what it had without a codec.
inline std::size_t rawFragmentBytes(const Buffer& message)
{
    return fragmentPrefix + loadAs<FragmentHeader>(message.data() + sizeof(MessageHeader)).rawPayloadBytes;
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

// A body with its planes as Float32. Throws Error (MalformedMessage) for a colour that no sender makes.
inline Buffer expanded(MemoryPool& pool, const FragmentHeader& h, std::size_t tableBytes, std::size_t pixels,
                       const std::byte* body, const WireCoder& coder)
{
    FragmentHeader wide = h;
    wide.colorFormat = WireFormat::Float32;
    Buffer floats = pool.acquire(tableBytes + planesBytes(wide, pixels));
    const std::byte* in = body;
    std::byte* out = floats.data();
    for (std::size_t c = 0; c < channelCount; ++c) {
        if (!hasChannel(h.channels, c))
            continue;
        if (c == Color && !coder.decodeColor(h.colorFormat, in, pixels, floatsOf(out)))
            failMalformed("a colour that is out of its format's range");
        if (c != Color)
            std::memcpy(out, in, planeBytes(h, c, pixels));
        in += planeBytes(h, c, pixels);
        out += planeBytes(wide, c, pixels);
    }
    std::memcpy(out, in, tableBytes);
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

    if (h.colorFormat > WireFormat::Unorm8)
        failMalformed("unknown format of colour", static_cast<std::int64_t>(WireFormat::Unorm8),
                      static_cast<std::int64_t>(h.colorFormat));

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

    if (h.colorFormat != WireFormat::Float32) {
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
        parts.spans = reinterpret_cast<const Span*>(body + pixelBytes * stored);
        parts.rowSpanCounts = reinterpret_cast<const std::uint16_t*>(parts.spans + h.spanCount);
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
    ConstPlanes planes = planesAt(body, h.channels, stored);
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
