// Active pixels: finds which pixels of a row travel (those with any colour channel that is not 0, or those with a
// depth), copies and checks them, and reads an input where it lies, row by row.
#pragma once

#include <dfb/base/cpu.hpp>
#include <dfb/channels.hpp>
#include <dfb/compiled.hpp>
#include <dfb/image.hpp>
#include <dfb/wire/wire_format.hpp>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

DFB_NAMESPACE_BEGIN

// A run of active pixels in a row, counted from the region's left border.
struct Span {
    std::uint16_t x = 0;
    std::uint16_t count = 0;
};

namespace detail {

// The row to prefetch while row y is read. For the last rows before `yEnd` it is y itself. Prefetching 4 KiB of colours
// ahead was measured to be fastest. Prefetch the row in pieces, between the work on row y: all at once takes up to a
// quarter longer.
inline int rowAhead(int y, int yEnd, int width)
{
    const int ahead = y + (width < 64 ? 1 : std::max(1, 256 / width));
    return ahead < yEnd ? ahead : y;
}

// Where pixels of a row lie. `depth` may be null.
struct RowPlace {
    const std::byte* color = nullptr;
    const float* depth = nullptr;

    DFB_INLINE void prefetchDepth(int count) const
    {
        if (depth)
            prefetch(reinterpret_cast<const std::byte*>(depth), sizeof(float) * static_cast<std::size_t>(count));
    }
    DFB_INLINE void prefetchAll(int count, std::ptrdiff_t colorBytes) const
    {
        prefetch(color, static_cast<std::size_t>(colorBytes * count));
        prefetchDepth(count);
    }
};

// A row of pixels in place. The renderer may still change them.
struct RowInPlace {
    Span span;
    RowPlace first; // of its pixels
    RowPlace ahead; // the first pixel of a later row, to be prefetched meanwhile
};

// The rule by which pixels are active.
struct Activity {
    bool byDepth = false; // pixels with a depth are active; else those with a colour
    bool hasBytes = false;
    float depthLimit = std::numeric_limits<float>::infinity(); // at this depth or beyond a pixel is empty

    std::ptrdiff_t colorBytes() const noexcept { return hasBytes ? 4 : 4 * sizeof(float); } // of a pixel
    // Whether float colours alone decide.
    bool byColorAlone() const noexcept
    {
        return !byDepth && !hasBytes && depthLimit == std::numeric_limits<float>::infinity();
    }

    // Returns a bit for each of up to 64 pixels, set if it is active. The depth may be null unless byDepth. Prefetches
    // as many pixels at `ahead` for a later call. Adds to `nanDepths` the pixels that are not active because their
    // depth is NaN.
    std::uint64_t bits(const RowPlace& pixels, const RowPlace& ahead, int count, std::uint64_t& nanDepths) const;
};

// Faults in the pixels of an input.
struct InputFaults {
    std::uint64_t nonFinite = 0;    // pixels with an infinity or a NaN in the colour, or a NaN for a depth
    std::uint64_t alphaOutside = 0; // of the others, those whose alpha is not within [0, 1]
};

// The faults of all inputs of a rank in a frame. Any thread may add to them.
struct FaultCounts {
    std::atomic<std::int64_t> nonFinite{0}, alphaOutside{0};

    void add(const InputFaults& faults)
    {
        if (faults.nonFinite)
            nonFinite += static_cast<std::int64_t>(faults.nonFinite);
        if (faults.alphaOutside)
            alphaOutside += static_cast<std::int64_t>(faults.alphaOutside);
    }
    void reset() { nonFinite = alphaOutside = 0; }
};

// Adds the faults of `count` pixels. `rgba` and `depth` may be null.
inline void countFaults(const float* rgba, const float* depth, int count, InputFaults& faults)
{
    for (int i = 0; i < count; ++i) {
        bool isFinite = !(depth && depth[i] != depth[i]);
        for (int c = 0; rgba && c < 4; ++c)
            isFinite = isFinite && std::isfinite(rgba[4 * i + c]);
        faults.nonFinite += isFinite ? 0 : 1;
        faults.alphaOutside += isFinite && rgba && !(rgba[4 * i + 3] >= 0.0f && rgba[4 * i + 3] <= 1.0f) ? 1 : 0;
    }
}

// Where the active pixels of a region are. Reuse it from tile to tile, as it keeps its memory.
struct ActiveSpans {
    std::vector<std::uint16_t> rowCounts; // the number of spans in each of the rows [rowBegin, rowEnd)
    std::vector<Span> spans;
    int rowBegin = 0, rowEnd = 0;
    std::uint32_t pixels = 0;

    void clear()
    {
        rowCounts.clear();
        spans.clear();
        rowBegin = rowEnd = 0;
        pixels = 0;
    }

    // Adds the spans of active pixels among pixels [begin, end) of row y. `bitsOfSome(x, count)` returns a bit for each
    // of `count` pixels from x on, up to 64, set if it is active. Calls f(span) for each span found. Call it for rows
    // from top to bottom, then endRows().
    template <class BitsOfSome, class F>
    void findRow(int y, int begin, int end, const BitsOfSome& bitsOfSome, const F& f)
    {
        const std::size_t before = spans.size();
        for (int x0 = begin; x0 < end; x0 += 64) {
            const int count = std::min(64, end - x0);
            forEachRun(bitsOfSome(x0, count), [&](int at, int run) {
                const int x = x0 + at;
                if (spans.size() > before && spans.back().x + spans.back().count == x)
                    spans.back().count = static_cast<std::uint16_t>(spans.back().count + run); // goes on across x0
                else // not push_back(): copying values that were just written is slow
                    spans.emplace_back() = {static_cast<std::uint16_t>(x), static_cast<std::uint16_t>(run)};
            });
        }
        for (std::size_t i = before; i < spans.size(); ++i) {
            f(spans[i]);
            pixels += spans[i].count;
        }
        const auto count = static_cast<std::uint16_t>(spans.size() - before);
        if (count > 0 && rowEnd == 0)
            rowBegin = y;
        if (count > 0)
            rowEnd = y + 1;
        if (rowEnd > 0)
            rowCounts.push_back(count);
    }
    void endRows() { rowCounts.resize(static_cast<std::size_t>(rowEnd - rowBegin)); }

    void setAll(const Region& region)
    {
        rowBegin = 0;
        rowEnd = region.height();
        rowCounts.assign(static_cast<std::size_t>(rowEnd), 1);
        spans.assign(rowCounts.size(), {0, static_cast<std::uint16_t>(region.width())});
        pixels = static_cast<std::uint32_t>(region.width() * region.height());
    }

    // Calls f(first, count) for each span. `first` is the index of its first pixel in planes with this stride.
    template <class F>
    void forEachSpan(std::ptrdiff_t stride, const F& f) const
    {
        const Span* span = spans.data();
        for (std::size_t row = 0; row < rowCounts.size(); ++row) {
            const std::ptrdiff_t begin = (rowBegin + static_cast<std::ptrdiff_t>(row)) * stride;
            for (int i = 0; i < rowCounts[row]; ++i, ++span)
                f(begin + span->x, static_cast<int>(span->count));
        }
    }
};

// The active pixels of a row, as they would travel: those of all spans, left to right.
struct RowPixels {
    ActiveSpans active;
    std::vector<float> color, depth; // 4 and 1 a pixel
    bool isFull = false;             // all pixels that could be active are
};

// The pixels of an input that are read where they lie. Another process may write to them at any time. Each value is
// checked as it is copied, so a program that breaks its promise spoils only its own picture.
struct PixelsInPlace {
    const std::byte* color = nullptr; // of the first pixel of the tile's region
    const float* depth = nullptr;     // null: not wanted
    std::ptrdiff_t stride = 0;        // from a row to the next, in pixels
    Region valid{0, 0, 0, 0};         // counted from the region's first pixel
    Activity activity;

    // Reads row y into `row`, which may hold the row that was read before. Adds to `faults`.
    void readRow(int y, RowPixels& row, InputFaults& faults) const;

    // The place of pixel x of row y.
    RowPlace at(int x, int y) const noexcept
    {
        const std::ptrdiff_t pixel = y * stride + x;
        return {color + activity.colorBytes() * pixel, depth ? depth + pixel : nullptr};
    }

    // Whether alpha is 1 in all pixels of a region of this size.
    bool isOpaque(int width, int height) const noexcept
    {
        return valid == Region{0, 0, width, height} && !(activity.depthLimit < std::numeric_limits<float>::infinity())
               && detail::isOpaque(color, activity.hasBytes, width, height, stride);
    }
};

} // namespace detail

DFB_NAMESPACE_END

#if DFB_HAS_BODIES
#include <dfb/wire/wire_kernels.hpp>

DFB_NAMESPACE_BEGIN
namespace detail {

DFB_COMPILED_ONCE std::uint64_t Activity::bits(const RowPlace& pixels, const RowPlace& ahead, int count,
                                               std::uint64_t& nanDepths) const
{
    const bool hasLimit = pixels.depth && depthLimit < std::numeric_limits<float>::infinity();
    if (byDepth || hasBytes)
        ahead.prefetchAll(count, colorBytes());
    else
        ahead.prefetchDepth(count); // activePixelBits() loads the colours
    const DepthBits depths = byDepth || hasLimit ? depthBits(pixels.depth, count, depthLimit) : DepthBits();
    if (byDepth) {
        for (std::uint64_t nan = depths.nan; nan != 0; nan &= nan - 1)
            ++nanDepths;
        return depths.active;
    }
    const std::uint64_t colors = hasBytes ? activeByteBits(pixels.color, count)
                                          : activePixelBits(floatsOf(pixels.color), floatsOf(ahead.color), count);
    return hasLimit ? colors & (depths.active | depths.nan) : colors;
}

DFB_COMPILED_ONCE void PixelsInPlace::readRow(int y, RowPixels& row, InputFaults& faults) const
{
    row.active.clear();
    if (y < valid.y0 || y >= valid.y1)
        return;
    const int ahead = rowAhead(y, valid.y1, valid.width());
    const auto most = static_cast<std::size_t>(valid.width());
    row.color.resize(std::max(row.color.size(), 4 * most));
    row.depth.resize(std::max(row.depth.size(), depth ? most : 0));
    // A row below a full one is likely to be full, so its colours are copied while active ones are searched.
    const bool copiesAll = row.isFull && activity.byColorAlone();
    bool areAllClean = true;
    row.isFull = false;
    const auto bitsOf = [&](int x, int count) {
        if (!copiesAll)
            return activity.bits(at(x, y), at(x, ahead), count, faults.nonFinite);
        at(x, ahead).prefetchDepth(count);
        return copyAndFindActivePixels(floatsOf(at(x, y).color), floatsOf(at(x, ahead).color), count,
                                       row.color.data() + 4 * (x - valid.x0), areAllClean);
    };
    std::size_t done = 0;
    row.active.findRow(y, valid.x0, valid.x1, bitsOf, [&](const Span& span) {
        const RowPlace from = at(span.x, y);
        float *toColor = row.color.data() + 4 * done, *toDepth = depth ? row.depth.data() + done : nullptr;
        row.isFull = span.count == valid.width();
        bool isClean = areAllClean;
        if (activity.hasBytes)
            bytesToFloats(from.color, span.count, toColor);
        else if (!copiesAll || !row.isFull)
            isClean =
                DFB_FASTEST(copyAndCheckColors, copyAndCheckColorsAvx2, floatsOf(from.color), span.count, toColor);
        if (depth)
            isClean &= fastest<copyAndCheckDepths>(from.depth, static_cast<int>(span.count), toDepth);
        if (!isClean)
            countFaults(toColor, from.depth, span.count, faults);
        done += span.count;
    });
}

} // namespace detail
DFB_NAMESPACE_END
#endif
