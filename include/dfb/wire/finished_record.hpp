// FinishedRecord: a finished tile in a message to the display rank. Pixels that all have the same value, such as those
// of the background, are left out.
//
// The header is followed by one pixel, the filler, which fills the places of pixels that do not travel (Dense has
// none), and by a body as in sparse_planes.hpp: Empty, Sparse or Dense. The size of a record is a multiple of 16 bytes.
//
// FinishedBatch: the header of a message with such records. FinishedCount: how many records a rank has sent.
#pragma once

#include <dfb/comm/message.hpp>
#include <dfb/image.hpp>
#include <dfb/tile_layout.hpp>
#include <dfb/wire/sparse_planes.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

DFB_NAMESPACE_BEGIN
namespace detail {

// The planes of a finished tile or of an image: rows of `stride` pixels.
struct FinishedPlanes {
    Planes planes;
    std::size_t stride = 0;
};

// Makes and reads the records of finished tiles for one format and one set of channels.
class FinishedRecord : public PlaneFormat {
public:
    struct Header {
        std::int32_t tile = 0;
        SparseShape shape;
    };
    static_assert(sizeof(Header) == 16);

    // `channels`: those beside the colour.
    FinishedRecord(OutputFormat format, ChannelMask channels)
        : PlaneFormat(static_cast<ChannelMask>(channels | colorChannel), bytesPerPixel(format) / 4)
    {
    }

    // Where a region of an image lies. `width`: that of the image in pixels.
    FinishedPlanes inImage(const Planes& image, int width, const Region& region) const
    {
        FinishedPlanes its;
        its.stride = static_cast<std::size_t>(width);
        const std::size_t first =
            static_cast<std::size_t>(region.y0) * its.stride + static_cast<std::size_t>(region.x0);
        for (std::size_t c = 0; c < channelCount; ++c)
            if (image.at[c])
                its.planes.at[c] = image.at[c] + first * pixelBytes(c);
        return its;
    }

    // The largest size of a record with so many pixels.
    std::size_t mostBytes(std::size_t pixels) const { return alignedTo16(sizeof(Header) + pixelBytes() * pixels); }

    // The parts of a tile that are to be written, found by one pass over it. Reuse it from tile to tile, as it keeps
    // its memory.
    struct Plan {
        std::size_t bytes = 0; // of the record
        Header header;
        FinishedPlanes from;
        std::size_t filler = 0; // index of the filler pixel
        ActiveSpans active;     // the pixels that differ from the filler
        std::vector<std::byte> body;
    };

    void plan(int tile, const Region& region, const FinishedPlanes& from, bool splits, Plan& plan) const
    {
        plan.from = from;
        plan.filler = fillerOf(region, from);
        ActiveSpans& active = plan.active;
        active.clear();
        for (int y = 0; y < region.height(); ++y) {
            const std::size_t first = static_cast<std::size_t>(y) * from.stride;
            active.findRow(
                y, 0, region.width(),
                [&](int x, int count) {
                    return findDifferent(from, first + static_cast<std::size_t>(x), plan.filler, count);
                },
                [](Span) {});
        }
        active.endRows();
        SparseShape& shape = plan.header.shape;
        shape = shapeOf(active, region);
        if (const std::size_t dense = mostBytes(static_cast<std::size_t>(region.width() * region.height()));
            shape.encoding != FragmentEncoding::Dense && bytesOf(shape) >= dense) {
            active.setAll(region);
            shape = shapeOf(active, region);
        }
        shape.isSplit = splits;
        plan.header.tile = tile;
        plan.bytes = bytesOf(shape);
    }

    // Writes plan.bytes bytes.
    void write(Plan& plan, std::byte* out) const
    {
        std::memset(out + plan.bytes - 16, 0, 16); // padding
        const Header& h = plan.header;
        std::memcpy(out, &h, sizeof h);
        out += sizeof h;
        if (fillerBytes(h.shape) > 0)
            out += forEachPlane(1, [&](std::size_t c, std::size_t at, std::size_t bytes) {
                std::memcpy(out + at, plan.from.planes.at[c] + bytes * plan.filler, bytes);
            });
        if (h.shape.isSplit)
            plan.body.resize(std::max(plan.body.size(), bodyBytes(h.shape)));
        std::byte* const body = h.shape.isSplit ? plan.body.data() : out;
        encodeSparse(*this, h.shape, plan.active, body, [&](std::size_t c, std::byte* to, std::size_t) {
            const std::size_t each = pixelBytes(c);
            const auto stride = static_cast<std::ptrdiff_t>(plan.from.stride);
            plan.active.forEachSpan(stride, [&](std::ptrdiff_t first, int count) {
                const std::size_t bytes = each * static_cast<std::size_t>(count);
                std::memcpy(to, plan.from.planes.at[c] + each * static_cast<std::size_t>(first), bytes);
                to += bytes;
            });
        });
        if (h.shape.isSplit)
            split(h.shape, body, out);
    }

    // Checks the record that begins at `in` and has at most `left` bytes. Then calls `place(tile, region)`, which
    // returns the FinishedPlanes where the pixels go, and writes them there. Returns the size of the record in bytes.
    // Throws Error (MalformedMessage).
    template <class PlaceOf>
    std::size_t read(const std::byte* in, std::size_t left, const TileLayout& layout, const PlaceOf& place) const
    {
        if (left < sizeof(Header))
            failMalformed("a finished tile is too short");
        const auto h = loadAs<Header>(in);
        const SparseShape& shape = h.shape;
        if (h.tile < 0 || h.tile >= layout.tileCount())
            failMalformed("a finished tile outside the image", layout.tileCount() - 1, h.tile);
        const Region region = layout.region(h.tile);
        shape.check(region);
        if (shape.encoding == FragmentEncoding::Constant)
            failMalformed("unknown encoding of a finished tile", -1, static_cast<std::int64_t>(shape.encoding));
        const std::size_t bytes = bytesOf(shape);
        if (left < bytes)
            failMalformed("a finished tile is too short", static_cast<std::int64_t>(bytes),
                          static_cast<std::int64_t>(left));
        const ConstPlanes filler = planesAt(in + sizeof h, 1);
        const std::byte* from = in + sizeof h + fillerBytes(shape);
        static thread_local std::vector<std::byte> joined;
        if (shape.isSplit) {
            joined.resize(std::max(joined.size(), bodyBytes(shape)));
            join(shape, from, joined.data());
            from = joined.data();
        }
        const SparseBody body = decodeSparse(*this, shape, region.width(), from);
        const FinishedPlanes to = place(h.tile, region);
        for (std::size_t c = 0; c < channelCount; ++c)
            if (pixelBytes(c) > 0)
                unpack(c, region, shape, body, filler.at[c], to);
        return bytes;
    }

private:
    std::size_t fillerBytes(const SparseShape& shape) const
    {
        return shape.encoding == FragmentEncoding::Dense ? 0 : pixelBytes();
    }
    std::size_t bytesOf(const SparseShape& shape) const
    {
        return alignedTo16(sizeof(Header) + fillerBytes(shape) + bodyBytes(shape));
    }

    // The corner pixel that equals most other corners. Background, if there is any, is usually found in the corners.
    std::size_t fillerOf(const Region& region, const FinishedPlanes& planes) const
    {
        const auto right = static_cast<std::size_t>(region.width() - 1);
        const std::size_t bottom = planes.stride * static_cast<std::size_t>(region.height() - 1);
        const std::array<std::size_t, 4> corners{0, right, bottom, bottom + right};
        const auto likes = [&](std::size_t corner) {
            return std::count_if(corners.begin(), corners.end(),
                                 [&](std::size_t other) { return findDifferent(planes, other, corner, 1) == 0; });
        };
        return *std::max_element(corners.begin(), corners.end(),
                                 [&](std::size_t a, std::size_t b) { return likes(a) < likes(b); });
    }

    // Returns a bit for each of up to 64 pixels, set if it differs from the filler.
    std::uint64_t findDifferent(const FinishedPlanes& from, std::size_t first, std::size_t filler, int count) const
    {
        std::uint8_t differs[64] = {};
        for (std::size_t c = 0; c < channelCount; ++c) {
            const std::byte* plane = from.planes.at[c];
            switch (pixelBytes(c)) {
            case 16: findDifferent<16>(plane, first, filler, count, differs); break;
            case 12: findDifferent<12>(plane, first, filler, count, differs); break;
            case 4: findDifferent<4>(plane, first, filler, count, differs); break;
            case 0: break;
            default: std::fill_n(differs, count, std::uint8_t{1}); // equal or not
            }
        }
        std::uint64_t bits = 0;
        for (int i = 0; i < count; ++i)
            bits |= std::uint64_t{differs[i]} << i;
        return bits;
    }

    template <std::size_t Bytes>
    static void findDifferent(const std::byte* plane, std::size_t first, std::size_t filler, int count,
                              std::uint8_t* differs)
    {
        constexpr std::size_t words = Bytes / 4;
        std::uint32_t wanted[words], word[words];
        std::memcpy(wanted, plane + Bytes * filler, Bytes);
        for (std::size_t x = 0; x < static_cast<std::size_t>(count); ++x) {
            std::memcpy(word, plane + Bytes * (first + x), Bytes);
            std::uint32_t different = 0;
            for (std::size_t w = 0; w < words; ++w)
                different |= word[w] ^ wanted[w];
            differs[x] = static_cast<std::uint8_t>(differs[x] | (different != 0));
        }
    }

    void unpack(std::size_t channel, const Region& region, const SparseShape& shape, const SparseBody& body,
                const std::byte* filler, const FinishedPlanes& to) const
    {
        const std::size_t bytes = pixelBytes(channel);
        const std::byte* from = body.planes.at[channel];
        const Span* span = body.spans;
        const Span whole{0, static_cast<std::uint16_t>(region.width())};
        const auto fill = [&](std::byte* row, int begin, int end) {
            std::byte* const first = row + bytes * static_cast<std::size_t>(begin);
            const std::size_t all = end > begin ? bytes * static_cast<std::size_t>(end - begin) : 0;
            for (std::size_t done = 0; done < all; done = std::max(bytes, 2 * done)) // twice as many each time
                std::memcpy(first + done, done > 0 ? first : filler, std::min(std::max(done, bytes), all - done));
        };
        const auto copy = [&](std::byte* row, Span its) {
            std::memcpy(row + bytes * its.x, from, bytes * its.count);
            from += bytes * its.count;
        };
        for (int y = 0; y < region.height(); ++y) {
            std::byte* row = to.planes.at[channel] + bytes * to.stride * static_cast<std::size_t>(y);
            if (shape.encoding == FragmentEncoding::Dense) {
                copy(row, whole);
                continue;
            }
            const bool hasSpans = body.rowCounts && y >= shape.rowBegin && y < shape.rowEnd;
            int x = 0;
            for (int i = hasSpans ? body.rowCounts[y - shape.rowBegin] : 0; i > 0; --i) {
                fill(row, x, span->x);
                copy(row, *span);
                x = span->x + span->count;
                ++span;
            }
            fill(row, x, region.width());
        }
    }
};

// Follows the MessageHeader of MessageKind::FinishedTiles, before the records.
struct FinishedBatch {
    std::uint64_t rawBytes = 0; // of the records, before the codec
    std::uint64_t codec = 0;    // 0: they are not compressed
};
inline constexpr std::size_t batchPrefix = sizeof(MessageHeader) + sizeof(FinishedBatch); // bytes before the records
inline constexpr std::size_t usualBatchBytes = std::size_t{256} << 10; // of a message, unless a tile needs more

// The most bytes of a message with tiles of so many pixels.
inline std::size_t largestBatch(const FinishedRecord& record, std::size_t tilePixels)
{
    return std::max(usualBatchBytes, batchPrefix + record.mostBytes(tilePixels));
}

// The content of MessageKind::TilesDone: a rank's counts of the frame. Tiles that it has put into the image itself
// count too, and their indices follow.
struct FinishedCount {
    std::int32_t tiles = 0, batches = 0;
};

} // namespace detail
DFB_NAMESPACE_END
