// The kernels for rows in place: if all inputs of a tile have the same bounds, they are blended as they are read. All
// exist for AVX2; that for full rows also for AVX-512. Without AVX2 such rows are searched, copied and blended like
// others, with the same bits as the result.
#pragma once

#include <dfb/base/cpu.hpp>
#include <dfb/blend/blend_kernels.hpp>
#include <dfb/blend/sort_kernels.hpp>
#include <dfb/wire/active_pixels.hpp>
#include <dfb/wire/wire_kernels.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>

DFB_NAMESPACE_BEGIN
namespace detail {

inline constexpr int mostInPlace = 32; // the most inputs in place that are blended as they are read
inline constexpr int rowsAtOnce = 4;   // rows of them that are read at once: memory serves more streams badly

#if defined(DFB_HAS_AVX2_CLONES)
// Reads four pixels of a row in place, each value once, and adds them to `check`. Returns false if all are 0.
DFB_AVX2 DFB_INLINE bool read(const RowInPlace& row, std::ptrdiff_t pixel, Avx2Colors& colors, Avx2ColorCheck& check)
{
    prefetch(reinterpret_cast<const std::byte*>(floatsOf(row.ahead.color) + 4 * pixel), 64);
    const float* const color = floatsOf(row.first.color);
    const __m256 ab = _mm256_loadu_ps(color + 4 * pixel), cd = _mm256_loadu_ps(color + 4 * pixel + 8);
    check.add(ab), check.add(cd);
    colors.a = _mm256_castps256_ps128(ab), colors.b = _mm256_extractf128_ps(ab, 1);
    colors.c = _mm256_castps256_ps128(cd), colors.d = _mm256_extractf128_ps(cd, 1);
    const __m256i withoutSign = _mm256_set1_epi32(0x7fffffff);
    return _mm256_testz_si256(_mm256_castps_si256(_mm256_or_ps(ab, cd)), withoutSign) == 0;
}

// Calls blend(pixel, first, last) to blend rows [first, last) at four pixels, under the rows before, until all rows are
// blended at all pixels of a row of 4 or more.
template <class Blend>
DFB_INLINE void forEachFour(std::ptrdiff_t width, int layers, const Blend& blend)
{
    const std::ptrdiff_t inFours = width - width % 4;
    for (std::ptrdiff_t begin = 0; begin < inFours; begin += 256)
        for (int first = 0; first < layers; first += rowsAtOnce)
            for (std::ptrdiff_t i = begin; i < std::min(begin + 256, inFours); i += 4)
                blend(i, first, std::min(first + rowsAtOnce, layers));
    if (inFours < width)
        blend(width - 4, 0, layers); // overlaps those before
}

// Blends rows of 4 pixels or more, the front one first, with the same result as blendGroup(). Returns false if the
// result is not to be used: a value is not finite, an alpha is not within [0, 1], or four neighbours are empty in all
// rows.
template <bool HasLeast>
DFB_AVX2 bool blendFullRowsAvx2(const RowInPlace* rows, int layers, double minTransmittance, double* rgba,
                                double* transmittance)
{
    Avx2ColorCheck check;
    check.clear();
    bool hasGap = false;
    forEachFour(rows->span.count, layers, [&](std::ptrdiff_t pixel, int first, int last) DFB_AVX2 {
        Avx2Colors colors;
        Avx2Block<HasLeast> block;
        if (first == 0) {
            read(rows[first++], pixel, colors, check);
            block.take(colors, minTransmittance);
        } else {
            block.load(rgba + 4 * pixel, transmittance + pixel);
        }
        for (int k = first; k < last; ++k) {
            read(rows[k], pixel, colors, check);
            block.add(colors, minTransmittance);
        }
        block.store(rgba + 4 * pixel, transmittance + pixel);
        hasGap |= last == layers && block.isEmpty();
    });
    return !hasGap && check.isGood();
}

// Two pixels in a register, and the transmittance of each, four times, in another. The instructions have a mask that
// leaves out nothing: for those without a mask GCC 12 warns of uninitialized values.
template <bool HasLeast>
struct Avx512Pair {
    __m512d sum, through;

    DFB_AVX512 DFB_INLINE void clear() { sum = _mm512_setzero_pd(), through = _mm512_set1_pd(1.0); }
    DFB_AVX512 DFB_INLINE void load(const double* rgba, const double* transmittance)
    {
        const double a = transmittance[0], b = transmittance[1];
        sum = _mm512_loadu_pd(rgba);
        through = _mm512_setr_pd(a, a, a, a, b, b, b, b);
    }
    DFB_AVX512 DFB_INLINE void add(__m128 first, __m128 second, double minTransmittance)
    {
        constexpr int nearest = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC; // no compiler fuses such a product
        const __m512d v = _mm512_maskz_cvtps_pd(0xff, _mm256_set_m128(second, first));
        const __m512d alphas = _mm512_maskz_permutex_pd(0xff, v, 0xff);
        sum = _mm512_add_pd(sum, _mm512_maskz_mul_round_pd(0xff, through, v, nearest));
        through = _mm512_mul_pd(through, _mm512_sub_pd(_mm512_set1_pd(1.0), alphas));
        if constexpr (HasLeast) { // values below it become 0, a NaN stays
            const __mmask8 stays = _mm512_cmp_pd_mask(through, _mm512_set1_pd(minTransmittance), _CMP_NLT_UQ);
            through = _mm512_maskz_mov_pd(stays, through);
        }
    }
    DFB_AVX512 DFB_INLINE void store(double* rgba, double* transmittance) const
    {
        _mm512_storeu_pd(rgba, sum);
        transmittance[0] = through[0], transmittance[1] = through[4];
    }
    DFB_AVX512 DFB_INLINE bool isEmpty() const // -0 counts as 0
    {
        return _mm512_test_epi64_mask(_mm512_castpd_si512(sum), _mm512_set1_epi64(0x7fffffffffffffff)) == 0;
    }
};

// As blendFullRowsAvx2(), with the same bits. The two share no template, as that could not be inlined into functions
// that allow different instructions.
template <bool HasLeast>
DFB_AVX512 bool blendFullRowsAvx512(const RowInPlace* rows, int layers, double minTransmittance, double* rgba,
                                    double* transmittance)
{
    Avx2ColorCheck check;
    check.clear();
    bool hasGap = false;
    forEachFour(rows->span.count, layers, [&](std::ptrdiff_t pixel, int first, int last) DFB_AVX512 {
        Avx512Pair<HasLeast> ab, cd;
        if (first == 0) {
            ab.clear(), cd.clear();
        } else {
            ab.load(rgba + 4 * pixel, transmittance + pixel);
            cd.load(rgba + 4 * pixel + 8, transmittance + pixel + 2);
        }
        for (int k = first; k < last; ++k) {
            Avx2Colors colors;
            read(rows[k], pixel, colors, check);
            ab.add(colors.a, colors.b, minTransmittance), cd.add(colors.c, colors.d, minTransmittance);
        }
        ab.store(rgba + 4 * pixel, transmittance + pixel);
        cd.store(rgba + 4 * pixel + 8, transmittance + pixel + 2);
        hasGap |= last == layers && ab.isEmpty() && cd.isEmpty();
    });
    return !hasGap && check.isGood();
}

// Blends rows [first, last) at four pixels, under the rows before. Returns whether any has anything there.
template <bool HasLeast>
DFB_AVX2 DFB_INLINE bool blendFour(const RowInPlace* rows, int first, int last, std::ptrdiff_t pixel,
                                   double minTransmittance, double* rgba, double* transmittance, Avx2ColorCheck& check)
{
    Avx2Block<HasLeast> block;
    if (first == 0)
        block.clear();
    else
        block.load(rgba + 4 * pixel, transmittance + pixel);
    bool isActive = false;
    for (int k = first; k < last; ++k) {
        Avx2Colors colors;
        if (!read(rows[k], pixel, colors, check))
            continue;
        block.add(colors, minTransmittance);
        isActive = true;
    }
    block.store(rgba + 4 * pixel, transmittance + pixel);
    return isActive;
}

// Blends pixels [begin, begin + 256) of rows that may have gaps, the front row first. Returns a bit for each four
// pixels, set if they have anything in any row. Sets `isGood` to false if a value is not finite, or an alpha is not
// within [0, 1].
template <bool HasLeast>
DFB_AVX2 std::uint64_t blendSparseRowsAvx2(const RowInPlace* rows, int layers, int begin, double minTransmittance,
                                           double* rgba, double* transmittance, bool& isGood)
{
    const std::ptrdiff_t width = rows->span.count, end = std::min<std::ptrdiff_t>(begin + 256, width);
    Avx2ColorCheck check;
    check.clear();
    std::uint64_t active = 0;
    const auto blend = [&](int first, int last, std::ptrdiff_t at, std::ptrdiff_t pixel) DFB_AVX2 {
        const bool is = blendFour<HasLeast>(rows, first, last, pixel, minTransmittance, rgba, transmittance, check);
        active |= std::uint64_t{is} << (at - begin) / 4;
    };
    std::ptrdiff_t i = begin;
    for (int first = 0; first < layers; first += rowsAtOnce)
        for (i = begin; i + 4 <= end; i += 4)
            blend(first, std::min(first + rowsAtOnce, layers), i, i);
    if (i < end) // the last four pixels of the row overlap those before
        blend(0, layers, i, width - 4);
    isGood = isGood && check.isGood();
    return active;
}

// Four pixels of each row that is active there, to be sorted.
struct SparseFour {
    alignas(16) float colors[mostInPlace][16];
    alignas(16) float depths[mostInPlace][4];
    int layers = 0;

    DFB_AVX2 DFB_INLINE void add(const Avx2Colors& four, __m128 depth)
    {
        float* const to = colors[layers];
        _mm_store_ps(to, four.a), _mm_store_ps(to + 4, four.b);
        _mm_store_ps(to + 8, four.c), _mm_store_ps(to + 12, four.d);
        _mm_store_ps(depths[layers++], depth);
    }
    // Whether the layers are in order at all four pixels: none is behind the next.
    DFB_AVX2 DFB_INLINE bool areSorted() const
    {
        __m128 wrong = _mm_setzero_ps();
        for (int k = 0; k + 1 < layers; ++k)
            wrong = _mm_or_ps(wrong, _mm_cmpnle_ps(_mm_load_ps(depths[k]), _mm_load_ps(depths[k + 1])));
        return _mm_movemask_ps(wrong) == 0;
    }
    template <bool HasLeast>
    DFB_AVX2 DFB_INLINE void blendInOrder(double* rgba, double* transmittance, double minTransmittance) const
    {
        Avx2Block<HasLeast> block;
        block.clear();
        for (int k = 0; k < layers; ++k) {
            Avx2Colors four;
            four.take(colors[k]);
            block.add(four, minTransmittance);
        }
        block.store(rgba, transmittance);
    }
    template <bool HasLeast>
    DFB_AVX2 void blendSorted(double* rgba, double* transmittance, double minTransmittance) const
    {
        const float *colorsOf[mostInPlace], *depthsOf[mostInPlace];
        for (int k = 0; k < layers; ++k)
            colorsOf[k] = colors[k], depthsOf[k] = depths[k];
        FourOrders orders;
        sortFourAvx2(depthsOf, SortNetwork::of(layers), orders);
        blendFourAvx2<HasLeast>(rgba, transmittance, colorsOf, orders, layers, minTransmittance);
    }
};

// As blendSparseRowsAvx2(), but each pixel's layers are sorted by (depth, row). Also sets `isGood` to false if a depth
// is NaN where the row has anything in the four pixels. AtOnce: how many fours are read, rowsAtOnce rows at a time,
// before they are blended. 1: all rows at a time, which is faster for few rows.
template <bool HasLeast, int AtOnce>
DFB_AVX2 std::uint64_t sortSparseRowsAvx2(const RowInPlace* rows, int layers, int begin, double minTransmittance,
                                          double* rgba, double* transmittance, bool& isGood)
{
    const std::ptrdiff_t width = rows->span.count, end = std::min<std::ptrdiff_t>(begin + 256, width);
    Avx2ColorCheck check;
    check.clear();
    __m128 nan = _mm_setzero_ps();
    std::uint64_t active = 0, bit = 1;
    const int step = AtOnce > 1 ? rowsAtOnce : layers;
    SparseFour fours[static_cast<std::size_t>(AtOnce)];
    for (std::ptrdiff_t from = begin; from < end; from += 4 * AtOnce) {
        const int count = static_cast<int>(std::min<std::ptrdiff_t>(AtOnce, (end - from + 3) / 4));
        const auto pixel = [&](int four) { return std::min(from + 4 * four, width - 4); };
        for (int four = 0; four < count; ++four)
            fours[four].layers = 0;
        for (int first = 0; first < layers; first += step)
            for (int four = 0; four < count; ++four)
                for (int k = first; k < std::min(first + step, layers); ++k) {
                    const std::ptrdiff_t i = pixel(four);
                    Avx2Colors colors;
                    if (!read(rows[k], i, colors, check))
                        continue;
                    prefetch(reinterpret_cast<const std::byte*>(rows[k].ahead.depth + i), 64);
                    const __m128 depth = _mm_loadu_ps(rows[k].first.depth + i);
                    nan = _mm_or_ps(nan, _mm_cmpunord_ps(depth, depth));
                    fours[four].add(colors, depth);
                }
        for (int four = 0; four < count; ++four, bit <<= 1) {
            const SparseFour& some = fours[four];
            const std::ptrdiff_t i = pixel(four);
            active |= some.layers > 0 ? bit : 0;
            if (some.areSorted())
                some.blendInOrder<HasLeast>(rgba + 4 * i, transmittance + i, minTransmittance);
            else
                some.blendSorted<HasLeast>(rgba + 4 * i, transmittance + i, minTransmittance);
        }
    }
    isGood = isGood && check.isGood() && _mm_movemask_ps(nan) == 0;
    return active;
}
#endif

} // namespace detail

DFB_NAMESPACE_END
