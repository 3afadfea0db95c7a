// Sparse planes: which pixels of a region are active, as spans, and their values, as planes. The pixels of inputs and
// of finished tiles travel in this form. The two differ in which pixels are active, and in the bytes of a pixel.
//
// The header of the message has a SparseShape, and the body has:
//   Sparse:    planes | spans | uint16 span counts of the rows [rowBegin, rowEnd)
//   Dense:     planes: all pixels of the region row by row
//   Constant:  planes: one pixel
//   Empty:     nothing
// There is a plane for each channel, in the order of the channels' bits: the colour of all pixels, then the depth of
// all pixels, and so on. Each begins at a multiple of 4 bytes. In a split body, the planes are as splitPlane() leaves
// them.
#pragma once

#include <dfb/base/cpu.hpp>
#include <dfb/comm/message.hpp>
#include <dfb/compiled.hpp>
#include <dfb/fragment.hpp>
#include <dfb/wire/active_pixels.hpp>
#include <dfb/wire/wire_kernels.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

inline std::size_t alignedTo16(std::size_t byteCount) { return (byteCount + 15) / 16 * 16; }

struct SparseShape {
    std::uint32_t pixels = 0;                          // the active ones
    std::uint16_t spans = 0, rowBegin = 0, rowEnd = 0; // only for Sparse
    FragmentEncoding encoding = FragmentEncoding::Empty;
    std::uint8_t isSplit = 0;

    std::size_t stored() const noexcept { return encoding == FragmentEncoding::Constant ? 1 : pixels; }
    std::size_t tableBytes() const noexcept
    {
        return encoding == FragmentEncoding::Sparse
                   ? sizeof(Span) * spans + sizeof(std::uint16_t) * static_cast<std::size_t>(rowEnd - rowBegin)
                   : 0;
    }
    // Throws Error (MalformedMessage) unless a region of this size may have this shape.
    void check(const Region& region) const
    {
        const auto all = static_cast<std::uint32_t>(region.width() * region.height());
        if (encoding > FragmentEncoding::Constant)
            failMalformed("unknown encoding", -1, static_cast<std::int64_t>(encoding));
        const std::uint32_t wanted = encoding == FragmentEncoding::Empty ? 0 : all;
        const bool isSparse = encoding == FragmentEncoding::Sparse;
        if (isSparse ? pixels > all : pixels != wanted)
            failMalformed("wrong number of pixels", wanted, pixels);
        if (isSparse && (rowBegin >= rowEnd || rowEnd > region.height()))
            failMalformed("rows outside the tile", region.height(), rowEnd);
        if (isSparse && spans > pixels)
            failMalformed("more spans than pixels", pixels, spans);
    }
};
static_assert(sizeof(SparseShape) == 12 && std::is_trivially_copyable_v<SparseShape>);

// Makes a plane of pixels, of `words` words each, easier to compress. Neighbouring pixels often have equal upper bits
// in each word, and rarely equal lower ones. Each word becomes its difference to the word of the pixel before, coded so
// that small differences of either sign have zeros at the top. Then all first bytes are stored, then all second bytes,
// and so on. So a codec that looks for repetitions finds more of them.
//
// Works on blocks of pixels, with loops that compilers vectorize.
template <class Word, std::size_t words>
DFB_INLINE void splitPlane(const std::byte* in, std::size_t pixels, std::byte* out)
{
    constexpr std::size_t size = sizeof(Word), block = 128;
    Word values[words * (1 + block)] = {}; // begins with the last pixel of the block before
    for (std::size_t first = 0; first < pixels; first += block) {
        const std::size_t count = std::min(block, pixels - first);
        std::copy_n(values + words * block, words, values);
        std::memcpy(values + words, in + first * words * size, count * words * size);
        Word folded[words * block];
        for (std::size_t i = 0; i < words * block; ++i) {
            const auto difference = static_cast<Word>(values[i + words] - values[i]);
            const auto sign = static_cast<Word>(difference >> (8 * size - 1));
            folded[i] = static_cast<Word>(static_cast<Word>(difference << 1) ^ static_cast<Word>(0 - sign));
        }
        for (std::size_t b = 0; b < size; ++b) {
            std::uint8_t bytes[words][block];
            for (std::size_t i = 0; i < block; ++i)
                for (std::size_t w = 0; w < words; ++w)
                    bytes[w][i] = static_cast<std::uint8_t>(folded[i * words + w] >> (8 * b));
            for (std::size_t w = 0; w < words; ++w)
                std::memcpy(out + (b * words + w) * pixels + first, bytes[w], count);
        }
    }
}
// The inverse of splitPlane().
template <class Word, std::size_t words>
DFB_INLINE void joinPlane(const std::byte* in, std::size_t pixels, std::byte* out)
{
    constexpr std::size_t size = sizeof(Word), block = 128;
    Word before[words] = {};
    for (std::size_t first = 0; first < pixels; first += block) {
        const std::size_t count = std::min(block, pixels - first);
        Word differences[words][block];
        for (std::size_t w = 0; w < words; ++w) {
            std::uint8_t bytes[size][block] = {};
            for (std::size_t b = 0; b < size; ++b)
                std::memcpy(bytes[b], in + (b * words + w) * pixels + first, count);
            for (std::size_t i = 0; i < block; ++i) {
                Word folded = 0;
                for (std::size_t b = 0; b < size; ++b)
                    folded = static_cast<Word>(folded | static_cast<Word>(Word{bytes[b][i]} << (8 * b)));
                const auto sign = static_cast<Word>(0 - (folded & 1));
                differences[w][i] = static_cast<Word>(static_cast<Word>(folded >> 1) ^ sign);
            }
        }
        Word values[words * block];
        for (std::size_t i = 0; i < block; ++i)
            for (std::size_t w = 0; w < words; ++w)
                values[i * words + w] = before[w] = static_cast<Word>(before[w] + differences[w][i]);
        std::memcpy(out + first * words * size, values, count * words * size);
    }
}

// The bytes of a pixel in each channel; 0 in channels that do not travel.
class PlaneFormat {
public:
    PlaneFormat(ChannelMask channels, std::size_t colorWordBytes)
    {
        for (std::size_t c = 0; c < channelCount; ++c)
            if (hasChannel(channels, c)) {
                wordBytes_[c] = c == Color ? colorWordBytes : 4;
                pixelBytes_ += pixelBytes(c);
            }
    }
    std::size_t pixelBytes() const noexcept { return pixelBytes_; } // a multiple of 4, as in each channel
    std::size_t pixelBytes(std::size_t channel) const noexcept { return wordBytes_[channel] * channelWords[channel]; }
    std::size_t bodyBytes(const SparseShape& shape) const noexcept
    {
        return pixelBytes_ * shape.stored() + shape.tableBytes();
    }

    // Calls f(channel, offset, bytes) for the plane of each channel, with `pixels` pixels. Returns the offset of the
    // end.
    template <class F>
    std::size_t forEachPlane(std::size_t pixels, const F& f) const
    {
        std::size_t at = 0;
        for (std::size_t c = 0; c < channelCount; ++c)
            if (const std::size_t bytes = pixelBytes(c) * pixels; wordBytes_[c] > 0) {
                f(c, at, bytes);
                at += bytes;
            }
        return at;
    }
    // The planes of a body with `pixels` pixels. `Byte` may be const.
    template <class Byte>
    BasicPlanes<Byte> planesAt(Byte* body, std::size_t pixels) const
    {
        BasicPlanes<Byte> planes;
        forEachPlane(pixels, [&](std::size_t c, std::size_t at, std::size_t) { planes.at[c] = body + at; });
        return planes;
    }

    // Does splitPlane() or joinPlane() for each plane of a body. The table of spans is copied as it is.
    void split(const SparseShape& shape, const std::byte* in, std::byte* out) const
    {
        transform(shape, in, out, false);
    }
    void join(const SparseShape& shape, const std::byte* in, std::byte* out) const { transform(shape, in, out, true); }

private:
    void transform(const SparseShape& shape, const std::byte* in, std::byte* out, bool joins) const;

    std::array<std::size_t, channelCount> wordBytes_{};
    std::size_t pixelBytes_ = 0;
};

#if DFB_HAS_BODIES
// Splits or joins a plane of pixels of `words` words each.
template <class Word, std::size_t words>
void transformPlane(const std::byte* in, std::size_t pixels, std::byte* out, bool joins)
{
    joins ? fastest<joinPlane<Word, words>>(in, pixels, out) : fastest<splitPlane<Word, words>>(in, pixels, out);
}

DFB_COMPILED_ONCE void PlaneFormat::transform(const SparseShape& shape, const std::byte* in, std::byte* out,
                                              bool joins) const
{
    const std::size_t pixels = shape.stored();
    const std::size_t end = forEachPlane(pixels, [&](std::size_t c, std::size_t at, std::size_t) {
        // Colour has 4 words of 1, 2 or 4 bytes; other channels have 1 or 3 words of 4 bytes.
        const auto ofChannel = channelWords[c] == 1   ? transformPlane<std::uint32_t, 1>
                               : channelWords[c] == 3 ? transformPlane<std::uint32_t, 3>
                               : wordBytes_[c] == 4   ? transformPlane<std::uint32_t, 4>
                               : wordBytes_[c] == 2   ? transformPlane<std::uint16_t, 4>
                                                      : transformPlane<std::uint8_t, 4>;
        ofChannel(in + at, pixels, out + at, joins);
    });
    std::copy_n(in + end, shape.tableBytes(), out + end); // an empty body may have no bytes at all
}
#endif

// Returns the shape of the body of a region with these active pixels.
inline SparseShape shapeOf(const ActiveSpans& active, const Region& region)
{
    SparseShape shape;
    shape.pixels = active.pixels;
    if (active.pixels == static_cast<std::uint32_t>(region.width() * region.height())) {
        shape.encoding = FragmentEncoding::Dense;
    } else if (active.pixels > 0) {
        shape.encoding = FragmentEncoding::Sparse;
        shape.spans = static_cast<std::uint16_t>(active.spans.size()); // at most 2^15: a tile has at most 2^16 pixels
        shape.rowBegin = static_cast<std::uint16_t>(active.rowBegin);
        shape.rowEnd = static_cast<std::uint16_t>(active.rowEnd);
    }
    return shape;
}

// Writes a body that is not split. `write(channel, out, bytes)` writes a plane.
template <class Write>
void encodeSparse(const PlaneFormat& format, const SparseShape& shape, const ActiveSpans& active, std::byte* out,
                  const Write& write)
{
    out += format.forEachPlane(shape.stored(), [&](std::size_t c, std::size_t at, std::size_t bytes) {
        if (bytes > 0)
            write(c, out + at, bytes);
    });
    if (shape.encoding != FragmentEncoding::Sparse)
        return;
    auto* counts = std::copy(active.spans.begin(), active.spans.end(), reinterpret_cast<Span*>(out));
    std::copy(active.rowCounts.begin(), active.rowCounts.end(), reinterpret_cast<std::uint16_t*>(counts));
}

// The contents of a body.
struct SparseBody {
    ConstPlanes planes;
    const Span* spans = nullptr;              // Sparse
    const std::uint16_t* rowCounts = nullptr; // Sparse
};

// Reads a body in place. The body must not be split and must have all its bytes, and its shape must have been checked.
// Throws Error (MalformedMessage).
inline SparseBody decodeSparse(const PlaneFormat& format, const SparseShape& shape, int width, const std::byte* in)
{
    SparseBody body;
    body.planes = format.planesAt(in, shape.stored());
    if (shape.encoding != FragmentEncoding::Sparse)
        return body;
    body.spans = reinterpret_cast<const Span*>(in + format.pixelBytes() * shape.stored());
    body.rowCounts = reinterpret_cast<const std::uint16_t*>(body.spans + shape.spans);
    const Span* span = body.spans;
    std::uint32_t spans = 0, pixels = 0;
    for (int row = 0; row < shape.rowEnd - shape.rowBegin; ++row) {
        int x = 0;
        if ((spans += body.rowCounts[row]) > shape.spans)
            failMalformed("more spans in the rows than in all", shape.spans, spans);
        for (int i = 0; i < body.rowCounts[row]; ++i, ++span) {
            if (span->x < x || span->count == 0 || span->x + span->count > width)
                failMalformed("a span outside its row", width, span->x + span->count);
            x = span->x + span->count;
            pixels += span->count;
        }
    }
    if (spans != shape.spans || pixels != shape.pixels)
        failMalformed("the spans do not add up to the active pixels", shape.pixels, pixels);
    return body;
}

// The pixels of a tile where they lie. `channels`: those of colour and depth that travel.
inline PixelsInPlace pixelsInPlace(const InputPixels& tile, ChannelMask channels, bool byDepth)
{
    PixelsInPlace p;
    p.color = tile.planes.at[Color];
    p.depth = hasChannel(channels, Depth) ? floatsOf(tile.planes.at[Depth]) : nullptr;
    p.stride = tile.stride;
    const int x0 = tile.region.x0, y0 = tile.region.y0;
    p.valid = {tile.valid.x0 - x0, tile.valid.y0 - y0, tile.valid.x1 - x0, tile.valid.y1 - y0};
    p.activity = {byDepth, tile.hasBytes, tile.depthLimit};
    return p;
}

// The active pixels of an input. Keep one per thread, and reuse it. A pixel of colour 0 and alpha 0 contributes
// nothing, whatever its depth. A pixel with a colour but alpha 0 is emission and contributes. By depth, a pixel
// contributes only if its depth is below InputPixels::depthLimit.
class ActivePixels : public ActiveSpans {
public:
    // `channels` must have colour, and depth if `byDepth`; the tile must have all of them. Copies the active pixels in
    // the form in which they travel: colours to `colors`, which has room for all pixels of the tile, depths to
    // `depths`, if that is not null, and the rest to memory of its own. Returns where they are. Each row is copied as
    // soon as its spans are found, so that it is read from memory only once. Adds to `faults`.
    ConstPlanes gather(const InputPixels& tile, ChannelMask channels, bool byDepth, std::byte* colors, float* depths,
                       InputFaults& faults)
    {
        const auto most =
            static_cast<std::size_t>(tile.region.width()) * static_cast<std::size_t>(tile.region.height());
        struct Target {
            std::size_t channel;
            std::byte* to;
        };
        ConstPlanes result;
        result.at[Color] = colors;
        std::array<Target, channelCount> targets{{{Color, colors}}};
        std::size_t targetCount = 1;
        for (std::size_t c = Depth; c < channelCount; ++c)
            if (hasChannel(channels, c)) {
                const bool isOwn = c != Depth || !depths;
                planes_[c].resize(std::max(planes_[c].size(), isOwn ? most * channelWords[c] : 0));
                auto* to = reinterpret_cast<std::byte*>(isOwn ? planes_[c].data() : depths);
                targets[targetCount++] = {c, to};
                result.at[c] = to;
            }
        clear();
        const PixelsInPlace its = pixelsInPlace(tile, depthChannel, byDepth);
        const Region& valid = its.valid;
        const int yEnd = its.color && valid.width() > 0 ? valid.y1 : 0;
        for (int y = valid.y0; y < yEnd; ++y) {
            const int ahead = rowAhead(y, yEnd, valid.width());
            const auto bitsOf = [&](int x, int count) {
                return its.activity.bits(its.at(x, y), its.at(x, ahead), count, faults.nonFinite);
            };
            findRow(y, valid.x0, valid.x1, bitsOf, [&](const Span& span) {
                const std::ptrdiff_t first = y * tile.stride + span.x;
                bool isClean = true;
                for (std::size_t i = 0; i < targetCount; ++i) {
                    const auto [channel, to] = targets[i];
                    const auto bytes = static_cast<std::ptrdiff_t>(tile.pixelBytes(channel));
                    isClean &= copyAndCheck(channel, bytes, tile.planes.at[channel] + bytes * first, span.count, to);
                    targets[i].to += bytes * span.count;
                }
                if (!isClean) {
                    const RowPlace from = its.at(span.x, y);
                    countFaults(tile.hasBytes ? nullptr : floatsOf(from.color),
                                hasChannel(channels, Depth) ? from.depth : nullptr, span.count, faults);
                }
            });
        }
        endRows();
        return result;
    }

private:
    std::array<std::vector<float>, channelCount> planes_; // words of 4 bytes; ids are copied bit for bit
};

} // namespace detail
DFB_NAMESPACE_END
