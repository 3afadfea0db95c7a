// The kernels for rows in place: if all inputs of a tile have the same bounds, they are blended as they are read. They
// exist for AVX2 alone. Without it, such rows are searched, copied and blended like others, with the same bits as the
// result.
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

#if defined(DFB_HAS_AVX2_CLONES)
// Reads four pixels of a row in place, each value once, and adds them to `check`. Returns false if all are 0.
DFB_AVX2 DFB_INLINE bool read(const RowInPlace& row, std::ptrdiff_t pixel, Avx2Colors& colors, Avx2ColorCheck& check)
{
    prefetch(reinterpret_cast<const std::byte*>(row.colorAhead + 4 * pixel), 64);
    const __m256 ab = _mm256_loadu_ps(row.color + 4 * pixel), cd = _mm256_loadu_ps(row.color + 4 * pixel + 8);
    check.add(ab), check.add(cd);
    colors.a = _mm256_castps256_ps128(ab), colors.b = _mm256_extractf128_ps(ab, 1);
    colors.c = _mm256_castps256_ps128(cd), colors.d = _mm256_extractf128_ps(cd, 1);
    const __m256i withoutSign = _mm256_set1_epi32(0x7fffffff);
    return _mm256_testz_si256(_mm256_castps_si256(_mm256_or_ps(ab, cd)), withoutSign) == 0;
}

// Blends rows of 4 pixels or more, the front one first, with the same result as blendGroup(). Returns false if the
// result is not to be used: a value is not finite, an alpha is not within [0, 1], or four neighbours are empty in all
// rows.
template <bool HasLeast>
DFB_AVX2 bool blendFullRowsAvx2(const RowInPlace* rows, int layers, double minTransmittance, double* rgba,
                                double* transmittance)
{
    const std::ptrdiff_t count = rows->span.count;
    Avx2ColorCheck check;
    check.clear();
    bool hasGap = false;
    for (std::ptrdiff_t begin = 0; begin < count; begin += 4) {
        const std::ptrdiff_t i = std::min(begin, count - 4); // the last four may overlap those before
        Avx2Colors colors;
        Avx2Block<HasLeast> block;
        read(rows[0], i, colors, check);
        block.take(colors, minTransmittance);
        for (int k = 1; k < layers; ++k) {
            read(rows[k], i, colors, check);
            block.add(colors, minTransmittance);
        }
        block.store(rgba + 4 * i, transmittance + i);
        hasGap |= block.isEmpty();
    }
    return !hasGap && check.isGood();
}

// Four pixels of each row that has anything in them, to be sorted.
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

// Blends pixels [begin, begin + 256) of rows that may have gaps. Returns a bit for each four pixels, set if they have
// anything in any row. With `Sorts`, each pixel's layers are sorted by (depth, row); else the front row comes first.
// Sets `isGood` to false if a value is not finite, an alpha is not within [0, 1], or a depth is NaN where the row has
// anything in the four pixels.
template <bool HasLeast, bool Sorts>
DFB_AVX2 std::uint64_t blendSparseRowsAvx2(const RowInPlace* rows, int layers, int begin, double minTransmittance,
                                           double* rgba, double* transmittance, bool& isGood)
{
    const std::ptrdiff_t width = rows->span.count, end = std::min<std::ptrdiff_t>(begin + 256, width);
    Avx2ColorCheck check;
    check.clear();
    __m128 nan = _mm_setzero_ps();
    std::uint64_t active = 0, bit = 1;
    SparseFour some;
    for (std::ptrdiff_t four = begin; four < end; four += 4, bit <<= 1) {
        const std::ptrdiff_t i = std::min(four, width - 4);
        Avx2Block<HasLeast> block;
        block.clear();
        some.layers = 0;
        for (int k = 0; k < layers; ++k) {
            Avx2Colors colors;
            if (!read(rows[k], i, colors, check))
                continue;
            active |= bit;
            if constexpr (Sorts) {
                prefetch(reinterpret_cast<const std::byte*>(rows[k].depthAhead + i), 64);
                const __m128 depth = _mm_loadu_ps(rows[k].depth + i);
                nan = _mm_or_ps(nan, _mm_cmpunord_ps(depth, depth));
                some.add(colors, depth);
            } else {
                block.add(colors, minTransmittance);
            }
        }
        if (Sorts && !some.areSorted()) {
            some.blendSorted<HasLeast>(rgba + 4 * i, transmittance + i, minTransmittance);
            continue;
        }
        for (int k = 0; k < some.layers; ++k) {
            Avx2Colors colors;
            colors.take(some.colors[k]);
            block.add(colors, minTransmittance);
        }
        block.store(rgba + 4 * i, transmittance + i);
    }
    isGood = isGood && check.isGood() && _mm_movemask_ps(nan) == 0;
    return active;
}
#endif

} // namespace detail

DFB_NAMESPACE_END
