// Active pixels: finds which pixels of a row travel (those with any colour channel that is not 0, or those with a
// depth), copies and checks them, and reads an input where it lies, row by row.
#pragma once

#include <dfb/base/cpu.hpp>
#include <dfb/channels.hpp>
#include <dfb/image.hpp>
#include <dfb/wire/wire_format.hpp>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

DFB_NAMESPACE_BEGIN

// A run of active pixels in a row, counted from the region's left border.
struct Span {
    std::uint16_t x = 0;
    std::uint16_t count = 0;
};

namespace detail {

// Prefetches a piece of a row into the second-level cache, as no processor predicts where the next row begins. The
// first-level cache is too small: rows of an image are often a multiple of 4 KiB apart, so that rows of several inputs
// evict each other. Always inlined, as GCC removes calls of functions that do nothing else.
DFB_INLINE void prefetch(const std::byte* from, std::size_t bytes)
{
#if defined(__GNUC__)
    for (std::size_t i = 0; i < bytes; i += 64)
        __builtin_prefetch(from + i, 0, 2);
#else
    (void)from, (void)bytes;
#endif
}
// The row to prefetch while row y is read. For the last rows before `yEnd` it is y itself. Prefetching 4 KiB of colours
// ahead was fastest where it was measured. Prefetch the row in pieces, between the work on row y: all at once takes up
// to a quarter longer.
inline int rowAhead(int y, int yEnd, int width)
{
    const int ahead = y + (width < 64 ? 1 : std::max(1, 256 / width));
    return ahead < yEnd ? ahead : y;
}

// Returns a bit for each of up to 64 pixels, set if any of its colour channels is not 0.
DFB_INLINE std::uint64_t findActivePixels(const float* rgba, int count)
{
    std::uint64_t bits = 0;
    for (int i = 0; i < count; ++i) { // all bits but the signs
        std::uint64_t halves[2];
        std::memcpy(halves, rgba + 4 * i, sizeof halves);
        bits |= std::uint64_t{((halves[0] | halves[1]) & 0x7fffffff7fffffffu) != 0} << i;
    }
    return bits;
}

// Copies colours. Returns false if one is not finite, or an alpha is not within [0, 1]. There are no branches, so that
// it can be vectorized.
inline bool copyAndCheckColors(const float* rgba, int count, float* out)
{
    constexpr float most = std::numeric_limits<float>::max();
    constexpr float low[4] = {-most, -most, -most, 0}, high[4] = {most, most, most, 1};
    int bad[4] = {};
    for (int i = 0; i < 4 * count; i += 4)
        for (int c = 0; c < 4; ++c) {
            const float value = rgba[i + c];
            out[i + c] = value;
            bad[c] |= static_cast<int>(!(value >= low[c])) | static_cast<int>(!(value <= high[c]));
        }
    return (bad[0] | bad[1] | bad[2] | bad[3]) == 0;
}

#if defined(DFB_HAS_AVX2_CLONES)
// Checks colours as copyAndCheckColors() does.
struct Avx2ColorCheck {
    __m256 areInside;

    DFB_AVX2 DFB_INLINE void clear() { areInside = _mm256_castsi256_ps(_mm256_set1_epi32(-1)); }
    DFB_AVX2 DFB_INLINE void add(__m256 two)
    {
        constexpr float most = std::numeric_limits<float>::max();
        const __m256 low = _mm256_setr_ps(-most, -most, -most, 0, -most, -most, -most, 0);
        const __m256 high = _mm256_setr_ps(most, most, most, 1, most, most, most, 1);
        areInside = _mm256_and_ps(
            areInside, _mm256_and_ps(_mm256_cmp_ps(two, low, _CMP_GE_OQ), _mm256_cmp_ps(two, high, _CMP_LE_OQ)));
    }
    DFB_AVX2 DFB_INLINE bool isGood() const { return _mm256_movemask_ps(areInside) == 255; }
};

// With `Copies`, also does what copyAndCheckColors() does, and sets `isGood` to false where that would return false.
template <bool Copies>
DFB_AVX2 std::uint64_t findActivePixelsAvx2(const float* rgba, const float* ahead, int count, float* out, bool& isGood)
{
    const __m256i zero = _mm256_setzero_si256(), allButSign = _mm256_set1_epi32(0x7fffffff);
    Avx2ColorCheck check;
    check.clear();
    std::uint64_t bits = 0;
    int i = 0;
    for (; i + 8 <= count; i += 8) {
        prefetch(reinterpret_cast<const std::byte*>(ahead + 4 * i), 128);
        __m256i isZero[4]; // of 2 pixels each
        for (int k = 0; k < 4; ++k) {
            const __m256 two = _mm256_loadu_ps(rgba + 4 * i + 8 * k);
            if constexpr (Copies) {
                _mm256_storeu_ps(out + 4 * i + 8 * k, two);
                check.add(two);
            }
            isZero[k] = _mm256_cmpeq_epi32(_mm256_and_si256(_mm256_castps_si256(two), allButSign), zero);
        }
        // A byte for each value, 4 for each pixel. The pixels are in the order 0 2 4 6 1 3 5 7.
        __m256i bytes =
            _mm256_packs_epi16(_mm256_packs_epi32(isZero[0], isZero[1]), _mm256_packs_epi32(isZero[2], isZero[3]));
        bytes = _mm256_permutevar8x32_epi32(bytes, _mm256_setr_epi32(0, 4, 1, 5, 2, 6, 3, 7));
        const int none = _mm256_movemask_ps(_mm256_castsi256_ps(_mm256_cmpeq_epi32(bytes, _mm256_set1_epi32(-1))));
        bits |= static_cast<std::uint64_t>(~none & 255) << i;
    }
    if (Copies && !check.isGood())
        isGood = false;
    if (i == count)
        return bits;
    if (Copies && !copyAndCheckColors(rgba + 4 * i, count - i, out + 4 * i))
        isGood = false;
    return bits | findActivePixels(rgba + 4 * i, count - i) << i;
}
#endif

template <bool Copies>
std::uint64_t findActivePixelsPlain(const float* rgba, const float* ahead, int count, float* out, bool& isGood)
{
    prefetch(reinterpret_cast<const std::byte*>(ahead), 4 * sizeof(float) * static_cast<std::size_t>(count));
    if (Copies && !copyAndCheckColors(rgba, count, out))
        isGood = false;
    return findActivePixels(Copies ? out : rgba, count);
}

// Calls findActivePixels() in its fastest version. `ahead`: as many pixels there are prefetched meanwhile.
inline std::uint64_t activePixelBits(const float* rgba, const float* ahead, int count)
{
    bool isGood = true;
    return DFB_FASTEST(findActivePixelsPlain<false>, findActivePixelsAvx2<false>, rgba, ahead, count, nullptr, isGood);
}

// Does the same and copies all pixels, in one pass. Sets `isGood` to false if copyAndCheckColors() would return false.
inline std::uint64_t copyAndFindActivePixels(const float* rgba, const float* ahead, int count, float* out, bool& isGood)
{
    return DFB_FASTEST(findActivePixelsPlain<true>, findActivePixelsAvx2<true>, rgba, ahead, count, out, isGood);
}

// Like findActivePixels(), for pixels with 8 bits a channel.
DFB_INLINE std::uint64_t findActiveBytes(const std::byte* rgba, int count)
{
    std::uint64_t bits = 0;
    for (int i = 0; i < count; ++i) {
        std::uint32_t pixel = 0;
        std::memcpy(&pixel, rgba + 4 * i, sizeof pixel);
        bits |= std::uint64_t{pixel != 0} << i;
    }
    return bits;
}

#if defined(DFB_HAS_AVX2_CLONES)
DFB_AVX2 inline std::uint64_t findActiveBytesAvx2(const std::byte* rgba, int count)
{
    const __m256i zero = _mm256_setzero_si256();
    std::uint64_t bits = 0;
    int i = 0;
    for (; i + 8 <= count; i += 8) {
        const __m256i pixels = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(rgba + 4 * i));
        const int none = _mm256_movemask_ps(_mm256_castsi256_ps(_mm256_cmpeq_epi32(pixels, zero)));
        bits |= static_cast<std::uint64_t>(~none & 255) << i;
    }
    return i < count ? bits | findActiveBytes(rgba + 4 * i, count - i) << i : bits;
}
#endif

inline std::uint64_t activeByteBits(const std::byte* rgba, int count)
{
    return DFB_FASTEST(findActiveBytes, findActiveBytesAvx2, rgba, count);
}

// A bit for each of up to 64 pixels.
struct DepthBits {
    std::uint64_t active = 0; // the depth is below the limit
    std::uint64_t nan = 0;
};

DFB_INLINE DepthBits findDepths(const float* depth, int count, float limit)
{
    DepthBits bits;
    for (int i = 0; i < count; ++i) {
        bits.active |= std::uint64_t{depth[i] < limit} << i;
        bits.nan |= std::uint64_t{depth[i] != depth[i]} << i;
    }
    return bits;
}

#if defined(DFB_HAS_AVX2_CLONES)
DFB_AVX2 inline DepthBits findDepthsAvx2(const float* depth, int count, float limit)
{
    const __m256 most = _mm256_set1_ps(limit);
    const auto bitsOf8 = [](int mask) { return static_cast<std::uint64_t>(mask & 255); };
    DepthBits bits;
    int i = 0;
    for (; i + 8 <= count; i += 8) {
        const __m256 d = _mm256_loadu_ps(depth + i);
        bits.active |= bitsOf8(_mm256_movemask_ps(_mm256_cmp_ps(d, most, _CMP_LT_OQ))) << i;
        bits.nan |= bitsOf8(_mm256_movemask_ps(_mm256_cmp_ps(d, d, _CMP_UNORD_Q))) << i;
    }
    if (i == count)
        return bits;
    const DepthBits rest = findDepths(depth + i, count - i, limit);
    return {bits.active | rest.active << i, bits.nan | rest.nan << i};
}
#endif

inline DepthBits depthBits(const float* depth, int count, float limit)
{
    return DFB_FASTEST(findDepths, findDepthsAvx2, depth, count, limit);
}

inline bool hasNan(const float* depth, std::size_t count)
{
    std::uint64_t nan = 0;
    for (std::size_t i = 0; i < count; i += 64)
        nan |= depthBits(depth + i, static_cast<int>(std::min<std::size_t>(64, count - i)), 0).nan;
    return nan != 0;
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

// A row of pixels in place, active where they have a colour. The renderer may still change them.
struct RowInPlace {
    Span span;
    const float* color = nullptr;
    const float* depth = nullptr; // null: not wanted
    // Colour and depth of a later row, to be prefetched meanwhile.
    const float *colorAhead = nullptr, *depthAhead = nullptr;
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
    std::uint64_t bits(const RowPlace& pixels, const RowPlace& ahead, int count, std::uint64_t& nanDepths) const
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
};

DFB_AVX2 inline bool copyAndCheckColorsAvx2(const float* rgba, int count, float* out)
{
    int i = 0;
    bool areGood = true;
#if defined(DFB_HAS_AVX2_CLONES)
    Avx2ColorCheck check;
    check.clear();
    for (; i + 2 <= count; i += 2) {
        const __m256 two = _mm256_loadu_ps(rgba + 4 * i);
        _mm256_storeu_ps(out + 4 * i, two);
        check.add(two);
    }
    areGood = check.isGood();
#endif
    const bool isRestGood = i == count || copyAndCheckColors(rgba + 4 * i, count - i, out + 4 * i);
    return isRestGood && areGood;
}

// A depth as it travels: NaN becomes +infinity, and -0 becomes 0, so that plain comparisons order depths.
inline float canonicalDepth(float depth)
{
    const std::uint32_t bits = bitsOf(depth), some = bits == 0x80000000u ? 0u : bits;
    return floatOf((bits & 0x7fffffffu) > 0x7f800000u ? 0x7f800000u : some); // integers, so that it can be vectorized
}

// Copies depths in the form in which they travel. Returns false if any is NaN.
DFB_INLINE bool copyAndCheckDepths(const float* depth, int count, float* out)
{
    int isNan = 0;
    for (int i = 0; i < count; ++i) {
        isNan |= static_cast<int>((bitsOf(depth[i]) & 0x7fffffffu) > 0x7f800000u);
        out[i] = canonicalDepth(depth[i]);
    }
    return isNan == 0;
}

// Copies `count` pixels of a channel, from pixel `first` of its plane on, in the form in which they travel. `hasBytes`:
// the colour has 8 bits a channel. Returns false if a colour is not finite, an alpha is not within [0, 1], or a depth
// is NaN.
inline bool copyAndCheck(const ConstPlanes& planes, bool hasBytes, std::size_t channel, std::ptrdiff_t first, int count,
                         std::byte* out)
{
    if (channel == Color && hasBytes) {
        std::memcpy(out, planes.at[Color] + 4 * first, 4 * static_cast<std::size_t>(count));
        return true;
    }
    if (channel == Color) {
        const float* rgba = floatsOf(planes.at[Color]) + 4 * first;
        return DFB_FASTEST(copyAndCheckColors, copyAndCheckColorsAvx2, rgba, count, floatsOf(out));
    }
    if (channel == Depth) {
        const float* depth = floatsOf(planes.at[Depth]) + first;
        return fastest<copyAndCheckDepths>(depth, count, floatsOf(out));
    }
    const auto bytes = static_cast<std::ptrdiff_t>(4 * channelWords[channel]);
    std::memcpy(out, planes.at[channel] + bytes * first, static_cast<std::size_t>(bytes * count));
    return true;
}

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
                else
                    spans.push_back({static_cast<std::uint16_t>(x), static_cast<std::uint16_t>(run)});
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

// The pixels of an input that are read where they lie. Another process may write to them at any time: each value is
// checked as it is copied, so that a program that breaks its promise spoils its own picture and nothing else.
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

inline void PixelsInPlace::readRow(int y, RowPixels& row, InputFaults& faults) const
{
    row.active.clear();
    if (y < valid.y0 || y >= valid.y1)
        return;
    const std::ptrdiff_t begin = y * stride;
    const int ahead = rowAhead(y, valid.y1, valid.width());
    const auto most = static_cast<std::size_t>(valid.width());
    row.color.resize(std::max(row.color.size(), 4 * most));
    row.depth.resize(std::max(row.depth.size(), depth ? most : 0));
    ConstPlanes planes;
    planes.at[Color] = color;
    planes.at[Depth] = reinterpret_cast<const std::byte*>(depth);
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
    row.active.findRow(y, valid.x0, valid.x1, bitsOf, [&](Span span) {
        const std::ptrdiff_t first = begin + span.x;
        float *toColor = row.color.data() + 4 * done, *toDepth = depth ? row.depth.data() + done : nullptr;
        row.isFull = span.count == valid.width();
        bool isClean = areAllClean;
        if (activity.hasBytes)
            bytesToFloats(color + 4 * first, span.count, toColor);
        else if (!copiesAll || !row.isFull)
            isClean = copyAndCheck(planes, false, Color, first, span.count, reinterpret_cast<std::byte*>(toColor));
        if (depth)
            isClean &= copyAndCheck(planes, false, Depth, first, span.count, reinterpret_cast<std::byte*>(toDepth));
        if (!isClean)
            countFaults(toColor, depth ? depth + first : nullptr, span.count, faults);
        done += span.count;
    });
}

} // namespace detail

DFB_NAMESPACE_END
