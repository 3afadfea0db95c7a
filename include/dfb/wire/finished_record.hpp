// FinishedRecord: a finished tile in a message to the display rank, without the pixels that are all alike, as those of
// the background are.
//
// After the header come, with Form::Runs, one pixel, which fills what has no other, and then in both forms the planes,
// in the order of their channels, each from a multiple of 4 bytes on. Form::Runs goes on with the runs of pixels that
// the planes have, Span by Span, and how many of them each row has, as uint16. What is `split` has its planes as
// PlaneFilter leaves them. A record has a multiple of 16 bytes.
#pragma once

#include <dfb/image.hpp>
#include <dfb/tile_layout.hpp>
#include <dfb/wire/fragment_message.hpp>
#include <dfb/wire/plane_filter.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

namespace dfb::detail {

// The planes of a finished tile or of an image: rows of `stride` pixels.
struct FinishedPlanes {
    Planes planes;
    std::size_t stride = 0;
};

// What it makes and reads records of: the format and the channels of an image.
class FinishedRecord {
public:
    enum class Form : std::uint8_t { Dense, Runs };

    struct Header {
        std::int32_t tile = 0;
        std::uint32_t pixels = 0; // in the planes
        std::uint16_t spans = 0;
        Form form = Form::Dense;
        std::uint8_t isSplit = 0;
        std::uint32_t bytes = 0; // of the record
    };
    static_assert(sizeof(Header) == 16);

    // `channels`: beside the colour.
    FinishedRecord(OutputFormat format, ChannelMask channels)
    {
        for (std::size_t c = 0; c < channelCount; ++c)
            if (c == Color || hasChannel(channels, c)) {
                const std::size_t words = static_cast<std::size_t>(channelWords[c]);
                pixelBytes_[c] = c == Color ? bytesPerPixel(format) : 4 * words;
                wordBytes_[c] = pixelBytes_[c] / words;
            }
    }

    // Of a pixel in a channel; 0 if the image does not have it.
    std::size_t pixelBytes(std::size_t channel) const noexcept { return pixelBytes_[channel]; }
    // In all channels; a multiple of 4, as all are.
    std::size_t pixelBytes() const noexcept
    {
        std::size_t bytes = 0;
        for (const std::size_t each : pixelBytes_)
            bytes += each;
        return bytes;
    }
    // Of a record with so many pixels, the most.
    std::size_t mostBytes(std::size_t pixels) const { return alignedTo16(sizeof(Header) + planesBytes(pixels)); }

    // What is to be written of a tile, found by one pass over it; kept from tile to tile, as it has memory.
    class Plan {
    public:
        std::size_t bytes() const noexcept { return header_.bytes; }

    private:
        friend class FinishedRecord;
        Header header_;
        FinishedPlanes from_;
        Region region_;
        std::size_t filler_ = 0; // place of the pixel
        std::vector<Span> spans_;
        std::vector<std::uint16_t> rowCounts_;
        std::vector<std::byte> packed_;
    };

    void plan(int tile, const Region& region, const FinishedPlanes& from, bool splits, Plan& plan) const
    {
        plan.from_ = from;
        plan.region_ = region;
        plan.filler_ = fillerOf(region, from);
        plan.spans_.clear();
        plan.rowCounts_.clear();
        const auto pixels = static_cast<std::size_t>(region.width()) * static_cast<std::size_t>(region.height());
        Header& h = plan.header_;
        h = Header();
        h.tile = tile;
        h.isSplit = splits;
        h.bytes = static_cast<std::uint32_t>(mostBytes(pixels));
        std::size_t stored = 0;
        for (int y = 0; y < region.height(); ++y) {
            const std::size_t before = plan.spans_.size();
            stored += findRuns(plan, y);
            plan.rowCounts_.push_back(static_cast<std::uint16_t>(plan.spans_.size() - before));
        }
        const std::size_t bytes = alignedTo16(sizeof(Header) + pixelBytes() + planesBytes(stored)
                                              + tableBytes(plan.spans_.size(), plan.rowCounts_.size()));
        if (bytes < h.bytes && plan.spans_.size() <= 0xffff) {
            h.form = Form::Runs;
            h.bytes = static_cast<std::uint32_t>(bytes);
            h.pixels = static_cast<std::uint32_t>(stored);
            h.spans = static_cast<std::uint16_t>(plan.spans_.size());
        } else {
            h.pixels = static_cast<std::uint32_t>(pixels);
            plan.spans_.assign(plan.rowCounts_.size(), {0, static_cast<std::uint16_t>(region.width())});
            plan.rowCounts_.assign(plan.rowCounts_.size(), 1);
        }
    }

    // Writes plan.bytes() bytes.
    void write(Plan& plan, std::byte* out) const
    {
        std::byte* const end = out + plan.bytes();
        std::memset(end - 16, 0, 16); // what fills it up
        const Header& h = plan.header_;
        std::memcpy(out, &h, sizeof h);
        out += sizeof h;
        for (std::size_t c = 0; c < channelCount && h.form == Form::Runs; ++c)
            if (pixelBytes_[c] > 0) {
                std::memcpy(out, plan.from_.planes.at[c] + pixelBytes_[c] * plan.filler_, pixelBytes_[c]);
                out += pixelBytes_[c];
            }
        for (std::size_t c = 0; c < channelCount; ++c)
            if (pixelBytes_[c] > 0) {
                const std::size_t bytes = pixelBytes_[c] * h.pixels;
                if (h.isSplit) {
                    plan.packed_.resize(std::max(plan.packed_.size(), bytes));
                    pack(plan, c, plan.packed_.data());
                    PlaneFilter::split(plan.packed_.data(), bytes, wordBytes_[c], wordsOf(c), out);
                } else {
                    pack(plan, c, out);
                }
                out += bytes;
            }
        if (h.form == Form::Runs) {
            auto* spans = reinterpret_cast<Span*>(out);
            auto* counts = reinterpret_cast<std::uint16_t*>(std::copy(plan.spans_.begin(), plan.spans_.end(), spans));
            std::copy(plan.rowCounts_.begin(), plan.rowCounts_.end(), counts);
        }
    }

    // Checks the record that begins at `in`, of which there are `left` bytes at most, calls `place(tile, region)` for
    // where the pixels go to, a FinishedPlanes, and puts them there. Returns its bytes. Throws Error
    // (MalformedMessage).
    template <class PlaceOf>
    std::size_t read(const std::byte* in, std::size_t left, const TileLayout& layout, const PlaceOf& place) const
    {
        if (left < sizeof(Header))
            failMalformed("a finished tile is too short");
        const auto h = loadAs<Header>(in);
        if (h.tile < 0 || h.tile >= layout.tileCount())
            failMalformed("a finished tile outside the image", layout.tileCount() - 1, h.tile);
        const Region region = layout.region(h.tile);
        const auto rows = static_cast<std::size_t>(region.height());
        const std::size_t pixels = static_cast<std::size_t>(region.width()) * rows;
        const bool hasRuns = h.form == Form::Runs;
        if (h.form > Form::Runs || h.pixels > pixels || (!hasRuns && h.pixels != pixels))
            failMalformed("a finished tile with more or fewer pixels than it has", static_cast<std::int64_t>(pixels),
                          h.pixels);
        const std::size_t bytes =
            alignedTo16(sizeof h + planesBytes(h.pixels) + (hasRuns ? pixelBytes() + tableBytes(h.spans, rows) : 0));
        if (h.bytes != bytes || left < bytes)
            failMalformed("a finished tile is too short", static_cast<std::int64_t>(bytes),
                          static_cast<std::int64_t>(std::min<std::size_t>(h.bytes, left)));
        const std::byte* filler = in + sizeof h;
        const std::byte* plane = filler + (hasRuns ? pixelBytes() : 0);
        const auto* spans = reinterpret_cast<const Span*>(plane + planesBytes(h.pixels));
        const auto* counts = reinterpret_cast<const std::uint16_t*>(spans + h.spans);
        if (hasRuns)
            checkRuns(h, region, spans, counts);
        const FinishedPlanes to = place(h.tile, region);
        static thread_local std::vector<std::byte> joined;
        for (std::size_t c = 0; c < channelCount; ++c) {
            if (pixelBytes_[c] == 0)
                continue;
            const std::size_t planeBytes = pixelBytes_[c] * h.pixels;
            const std::byte* from = plane;
            if (h.isSplit) {
                joined.resize(std::max(joined.size(), planeBytes));
                PlaneFilter::join(plane, planeBytes, wordBytes_[c], wordsOf(c), joined.data());
                from = joined.data();
            }
            if (hasRuns)
                unpackRuns(c, region, spans, counts, filler, from, to);
            else
                unpackRows(c, region, from, to);
            filler += hasRuns ? pixelBytes_[c] : 0;
            plane += planeBytes;
        }
        return bytes;
    }

private:
    static std::size_t wordsOf(std::size_t channel) { return static_cast<std::size_t>(channelWords[channel]); }
    std::size_t planesBytes(std::size_t pixels) const { return pixelBytes() * pixels; }
    static std::size_t tableBytes(std::size_t spans, std::size_t rows)
    {
        return sizeof(Span) * spans + sizeof(std::uint16_t) * rows;
    }

    bool areAlike(const FinishedPlanes& planes, std::size_t a, std::size_t b) const
    {
        for (std::size_t c = 0; c < channelCount; ++c)
            if (const std::size_t bytes = pixelBytes_[c];
                bytes > 0 && std::memcmp(planes.planes.at[c] + bytes * a, planes.planes.at[c] + bytes * b, bytes) != 0)
                return false;
        return true;
    }

    // The corner that is like most others: where the background begins, if there is any.
    std::size_t fillerOf(const Region& region, const FinishedPlanes& planes) const
    {
        const auto right = static_cast<std::size_t>(region.width() - 1);
        const std::size_t bottom = planes.stride * static_cast<std::size_t>(region.height() - 1);
        const std::array<std::size_t, 4> corners{0, right, bottom, bottom + right};
        const auto likes = [&](std::size_t corner) {
            return std::count_if(corners.begin(), corners.end(),
                                 [&](std::size_t other) { return areAlike(planes, corner, other); });
        };
        return *std::max_element(corners.begin(), corners.end(),
                                 [&](std::size_t a, std::size_t b) { return likes(a) < likes(b); });
    }

    // The runs of a row that are not like the filler. Returns how many pixels they have.
    std::size_t findRuns(Plan& plan, int y) const
    {
        const std::size_t first = static_cast<std::size_t>(y) * plan.from_.stride;
        const auto width = static_cast<std::size_t>(plan.region_.width());
        static thread_local std::vector<std::uint8_t> scratch;
        scratch.assign(width, 0);
        std::uint8_t* differs = scratch.data();
        for (std::size_t c = 0; c < channelCount; ++c) {
            const std::byte* plane = plan.from_.planes.at[c];
            if (pixelBytes_[c] == 16)
                findDifferent<16>(plane, first, plan.filler_, width, differs);
            else if (pixelBytes_[c] == 12)
                findDifferent<12>(plane, first, plan.filler_, width, differs);
            else if (pixelBytes_[c] == 4)
                findDifferent<4>(plane, first, plan.filler_, width, differs);
        }
        std::size_t count = 0;
        for (std::size_t x = 0; x < width;) {
            if (!differs[x]) {
                ++x;
                continue;
            }
            std::size_t end = x + 1;
            while (end < width && differs[end])
                ++end;
            plan.spans_.push_back({static_cast<std::uint16_t>(x), static_cast<std::uint16_t>(end - x)});
            count += end - x;
            x = end;
        }
        return count;
    }

    template <std::size_t Bytes>
    static void findDifferent(const std::byte* plane, std::size_t first, std::size_t filler, std::size_t width,
                              std::uint8_t* differs)
    {
        constexpr std::size_t words = Bytes / 4;
        std::uint32_t wanted[words], word[words];
        std::memcpy(wanted, plane + Bytes * filler, Bytes);
        for (std::size_t x = 0; x < width; ++x) {
            std::memcpy(word, plane + Bytes * (first + x), Bytes);
            std::uint32_t different = 0;
            for (std::size_t w = 0; w < words; ++w)
                different |= word[w] ^ wanted[w];
            differs[x] = static_cast<std::uint8_t>(differs[x] | (different != 0));
        }
    }

    void pack(const Plan& plan, std::size_t channel, std::byte* out) const
    {
        const std::size_t bytes = pixelBytes_[channel];
        const Span* span = plan.spans_.data();
        for (std::size_t y = 0; y < plan.rowCounts_.size(); ++y) {
            const std::byte* row = plan.from_.planes.at[channel] + bytes * plan.from_.stride * y;
            for (int i = 0; i < plan.rowCounts_[y]; ++i, ++span) {
                std::memcpy(out, row + bytes * span->x, bytes * span->count);
                out += bytes * span->count;
            }
        }
    }

    static void checkRuns(const Header& h, const Region& region, const Span* span, const std::uint16_t* counts)
    {
        std::uint32_t spans = 0, pixels = 0;
        for (int y = 0; y < region.height(); ++y) {
            int x = 0;
            if ((spans += counts[y]) > h.spans)
                failMalformed("more runs in the rows of a finished tile than in all", h.spans, spans);
            for (int i = 0; i < counts[y]; ++i, ++span) {
                if (span->x < x || span->count == 0 || span->x + span->count > region.width())
                    failMalformed("a run of a finished tile outside its row", region.width(), span->x + span->count);
                x = span->x + span->count;
                pixels += span->count;
            }
        }
        if (spans != h.spans || pixels != h.pixels)
            failMalformed("the runs of a finished tile do not add up to its pixels", h.pixels, pixels);
    }

    void unpackRows(std::size_t channel, const Region& region, const std::byte* from, const FinishedPlanes& to) const
    {
        const std::size_t row = pixelBytes_[channel] * static_cast<std::size_t>(region.width());
        for (std::size_t y = 0; y < static_cast<std::size_t>(region.height()); ++y)
            std::memcpy(to.planes.at[channel] + pixelBytes_[channel] * to.stride * y, from + row * y, row);
    }

    void unpackRuns(std::size_t channel, const Region& region, const Span* span, const std::uint16_t* counts,
                    const std::byte* filler, const std::byte* from, const FinishedPlanes& to) const
    {
        const std::size_t bytes = pixelBytes_[channel];
        const auto fill = [&](std::byte* row, int begin, int end) {
            for (int x = begin; x < end; ++x)
                std::memcpy(row + bytes * static_cast<std::size_t>(x), filler, bytes);
        };
        for (int y = 0; y < region.height(); ++y) {
            std::byte* row = to.planes.at[channel] + bytes * to.stride * static_cast<std::size_t>(y);
            int x = 0;
            for (int i = 0; i < counts[y]; ++i, ++span) {
                fill(row, x, span->x);
                std::memcpy(row + bytes * span->x, from, bytes * span->count);
                from += bytes * span->count;
                x = span->x + span->count;
            }
            fill(row, x, region.width());
        }
    }

    std::array<std::size_t, channelCount> pixelBytes_{}, wordBytes_{};
};

} // namespace dfb::detail
