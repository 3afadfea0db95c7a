// The kernels of blending: layers under pixels, in double, and two layers of 8-bit levels, in integers. Each kernel
// exists in plain C++ and for AVX2, mostly written by hand. Both give the same bits, as they round the same products
// and sums.
//
// If a whole block of pixels is opaque, the layers behind are left out. This is checked after the first layer and then
// after every fourth. Opaque pixels of other blocks are blended like the rest. So an infinity or a NaN of a layer
// behind may or may not show in an opaque pixel. A finite value never does.
#pragma once

#include <dfb/base/cpu.hpp>
#include <dfb/base/double_double.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>

#if defined(DFB_HAS_AVX2_CLONES)
#include <immintrin.h>
#endif

DFB_NAMESPACE_BEGIN
namespace detail {

// Layers to be composited together under a run of pixels, front to back. A group has few layers, as a processor reads
// only few streams of memory well. Each group is read for the whole run before the next one.
struct BlendGroup {
    static constexpr int mostLayers = 8;

    const float* colors[mostLayers]; // RGBA of the run's first pixel
    int layers = 0;
    bool isFirst = true;         // these layers, at least one, are the front ones: old pixel values are ignored
    double minTransmittance = 0; // a pixel that lets less through counts as opaque
};

// When k of `layers` layers are blended: the layer at which to check again whether the pixels are opaque.
constexpr int nextLook(int k, int layers) noexcept { return std::min(layers, k == 0 ? 1 : k + 4); }

// ---- plain

// Takes the values of a single layer, in double.
inline void takeLayerPlain(double* rgba, double* transmittance, int count, const float* color, double minTransmittance)
{
    for (int i = 0; i < 4 * count; ++i)
        rgba[i] = 0.0 + static_cast<double>(color[i]); // -0 becomes 0
    for (int i = 0; i < count; ++i) {
        const double t = 1.0 - static_cast<double>(color[4 * i + 3]);
        transmittance[i] = minTransmittance > 0 && t < minTransmittance ? 0.0 : t;
    }
}

// Composites the k-th layer, for k in [first, last), under one pixel. Where the pixel was 0, -0 becomes 0.
template <bool HasLeast, class ColorOf>
void blendPixel(double* rgba, double& transmittance, double minTransmittance, int first, int last,
                const ColorOf& colorOf)
{
    double red = rgba[0], green = rgba[1], blue = rgba[2], alpha = rgba[3], t = transmittance;
    for (int k = first; k < last; ++k) {
        const float* color = colorOf(k);
        red += t * static_cast<double>(color[0]);
        green += t * static_cast<double>(color[1]);
        blue += t * static_cast<double>(color[2]);
        alpha += t * static_cast<double>(color[3]);
        t *= 1.0 - static_cast<double>(color[3]);
        if constexpr (HasLeast)
            t = t < minTransmittance ? 0.0 : t;
    }
    rgba[0] = red, rgba[1] = green, rgba[2] = blue, rgba[3] = alpha, transmittance = t;
}

inline bool isOpaque(const double* transmittance, int count)
{
    return std::all_of(transmittance, transmittance + count, [](double t) { return t == 0.0; });
}

// Composites layers under `count` pixels, which are a block. colorOf(k, p) is the colour of the k-th layer at pixel p.
// Returns false if all pixels are opaque, so that nothing behind them can be seen, as do the functions below.
template <bool HasLeast, class ColorOf>
bool blendBlock(double* rgba, double* transmittance, int count, bool isFirst, int layers, double minTransmittance,
                const ColorOf& colorOf)
{
    if (isFirst) {
        std::fill_n(rgba, 4 * count, 0.0);
        std::fill_n(transmittance, count, 1.0);
    }
    for (int k = 0; k < layers && !isOpaque(transmittance, count);) {
        const int end = nextLook(k, layers);
        for (int p = 0; p < count; ++p)
            blendPixel<HasLeast>(rgba + 4 * p, transmittance[p], minTransmittance, k, end,
                                 [&](int layer) { return colorOf(layer, p); });
        k = end;
    }
    return !isOpaque(transmittance, count);
}

// Blends a group, from `pixel` on. `rgba` and `transmittance` are those of the group's first pixel.
template <bool HasLeast>
bool blendBlock(double* rgba, double* transmittance, std::ptrdiff_t pixel, int count, const BlendGroup& group)
{
    return blendBlock<HasLeast>(rgba + 4 * pixel, transmittance + pixel, count, group.isFirst, group.layers,
                                group.minTransmittance,
                                [&](int k, int p) { return group.colors[k] + 4 * (pixel + p); });
}

template <bool HasLeast>
inline bool blendGroupPlain(double* rgba, double* transmittance, int count, const BlendGroup& group)
{
    bool isSeen = false;
    const std::ptrdiff_t inBlocks = count - count % 4;
    for (std::ptrdiff_t i = 0; i < inBlocks; i += 4)
        isSeen |= blendBlock<HasLeast>(rgba, transmittance, i, 4, group);
    for (std::ptrdiff_t i = inBlocks; i < count; ++i)
        isSeen |= blendBlock<HasLeast>(rgba, transmittance, i, 1, group);
    return isSeen;
}

// Composites layers under four pixels, each with an order of its own. `colors`: those of the first pixel, by layer.
// `orders[k][p]`: which layer is the k-th from the front at pixel p.
template <bool HasLeast>
void blendFourPlain(double* rgba, double* transmittance, const float* const* colors, const std::uint32_t (*orders)[4],
                    int layers, double minTransmittance)
{
    blendBlock<HasLeast>(rgba, transmittance, 4, true, layers, minTransmittance,
                         [&](int k, int p) { return colors[orders[k][p]] + 4 * p; });
}

// Composites one colour under all pixels. Nothing may follow behind it, as transmittances stay as they are.
inline void blendConstantPlain(double* rgba, const double* transmittance, int count, const float* color)
{
    for (int i = 0; i < count; ++i)
        for (int c = 0; c < 4; ++c)
            rgba[4 * i + c] += transmittance[i] * static_cast<double>(color[c]);
}

// Takes the depths of a layer where they are nearer and its alpha is above 0.
DFB_INLINE void takeNearestPlain(float* nearest, int count, const float* color, const float* depth)
{
    for (int i = 0; i < count; ++i) {
        const bool isNearer = color[4 * i + 3] > 0.0f && depth[i] < nearest[i];
        nearest[i] = isNearer ? depth[i] : nearest[i];
    }
}

// Composites a layer under `levels`, both with 8 bits a channel. The result is rounded to the nearest level, at most
// 255. That is exact if `levels` holds one layer or none; another layer behind would need the fractions that are
// rounded away.
inline void blendLevelsPlain(std::uint8_t* levels, int count, const std::uint8_t* layer)
{
    for (int i = 0; i < 4 * count; i += 4) {
        const int through = 255 - levels[i + 3];
        for (int c = i; c < i + 4; ++c) {
            const int product = through * layer[c] + 128;
            levels[c] = static_cast<std::uint8_t>(std::min(255, levels[c] + (product + product / 256) / 256));
        }
    }
}

// ---- AVX2

#if defined(DFB_HAS_AVX2_CLONES)

DFB_AVX2 inline void takeLayerAvx2(double* rgba, double* transmittance, int count, const float* color,
                                   double minTransmittance)
{
    const __m256d zero = _mm256_setzero_pd(), one = _mm256_set1_pd(1.0), least = _mm256_set1_pd(minTransmittance);
    const std::ptrdiff_t inBlocks = count - count % 4;
    for (std::ptrdiff_t i = 0; i < inBlocks; i += 4) {
        const __m256d a = _mm256_cvtps_pd(_mm_loadu_ps(color + 4 * i));
        const __m256d b = _mm256_cvtps_pd(_mm_loadu_ps(color + 4 * i + 4));
        const __m256d c = _mm256_cvtps_pd(_mm_loadu_ps(color + 4 * i + 8));
        const __m256d d = _mm256_cvtps_pd(_mm_loadu_ps(color + 4 * i + 12));
        _mm256_storeu_pd(rgba + 4 * i, _mm256_add_pd(zero, a));
        _mm256_storeu_pd(rgba + 4 * i + 4, _mm256_add_pd(zero, b));
        _mm256_storeu_pd(rgba + 4 * i + 8, _mm256_add_pd(zero, c));
        _mm256_storeu_pd(rgba + 4 * i + 12, _mm256_add_pd(zero, d));
        const __m256d alpha = _mm256_permute2f128_pd(_mm256_unpackhi_pd(a, b), _mm256_unpackhi_pd(c, d), 0x31);
        __m256d t = _mm256_sub_pd(one, alpha);
        if (minTransmittance > 0)
            t = _mm256_and_pd(t, _mm256_cmp_pd(t, least, _CMP_NLT_UQ));
        _mm256_storeu_pd(transmittance + i, t);
    }
    takeLayerPlain(rgba + 4 * inBlocks, transmittance + inBlocks, count % 4, color + 4 * inBlocks, minTransmittance);
}

DFB_AVX2 inline void blendConstantAvx2(double* rgba, const double* transmittance, int count, const float* color)
{
    const __m256d c = _mm256_cvtps_pd(_mm_loadu_ps(color));
    for (std::ptrdiff_t i = 0; i < count; ++i) {
        const __m256d added = _mm256_mul_pd(_mm256_broadcast_sd(transmittance + i), c);
        _mm256_storeu_pd(rgba + 4 * i, _mm256_add_pd(_mm256_loadu_pd(rgba + 4 * i), added));
    }
}

// A pixel in one register, and its transmittance, four times, in another.
template <bool HasLeast>
struct Avx2Pixel {
    __m256d sum, through;

    // Takes the first layer. It is added to 0, so that -0 becomes 0.
    DFB_AVX2 DFB_INLINE void take(__m128 color, double minTransmittance)
    {
        const __m256d v = _mm256_cvtps_pd(color);
        sum = _mm256_add_pd(_mm256_setzero_pd(), v);
        through = _mm256_sub_pd(_mm256_set1_pd(1.0), _mm256_permute4x64_pd(v, 0xff));
        close(minTransmittance);
    }
    DFB_AVX2 DFB_INLINE void clear()
    {
        sum = _mm256_setzero_pd();
        through = _mm256_set1_pd(1.0);
    }
    DFB_AVX2 DFB_INLINE void load(const double* rgba, const double* transmittance)
    {
        sum = _mm256_loadu_pd(rgba);
        through = _mm256_broadcast_sd(transmittance);
    }
    DFB_AVX2 DFB_INLINE void store(double* rgba, double* transmittance) const
    {
        _mm256_storeu_pd(rgba, sum);
        _mm_store_sd(transmittance, _mm256_castpd256_pd128(through));
    }
    DFB_AVX2 DFB_INLINE void add(__m128 color, double minTransmittance)
    {
        const __m256d v = _mm256_cvtps_pd(color);
        sum = _mm256_add_pd(sum, _mm256_mul_pd(through, v));
        through = _mm256_mul_pd(through, _mm256_sub_pd(_mm256_set1_pd(1.0), _mm256_permute4x64_pd(v, 0xff)));
        close(minTransmittance);
    }
    DFB_AVX2 DFB_INLINE void close(double minTransmittance)
    {
        if constexpr (HasLeast) // values below it become 0, a NaN stays
            through = _mm256_and_pd(through, _mm256_cmp_pd(through, _mm256_set1_pd(minTransmittance), _CMP_NLT_UQ));
    }
};

// The colours of four pixels.
struct Avx2Colors {
    __m128 a, b, c, d;

    // Loads four neighbouring pixels. Also prefetches the pixels 64 further on, the next row of a full tile 64 pixels
    // wide: processors do not predict reads that jump from layer to layer.
    DFB_AVX2 DFB_INLINE void load(const float* color)
    {
        _mm_prefetch(reinterpret_cast<const char*>(color + 256), _MM_HINT_T0);
        take(color);
    }
    DFB_AVX2 DFB_INLINE void take(const float* color)
    {
        a = _mm_loadu_ps(color), b = _mm_loadu_ps(color + 4), c = _mm_loadu_ps(color + 8), d = _mm_loadu_ps(color + 12);
    }
    // Loads each pixel from a layer of its own. `colors`: those of the first pixel, by layer.
    DFB_AVX2 DFB_INLINE void load(const float* const* colors, const std::uint32_t (&layers)[4])
    {
        a = _mm_loadu_ps(colors[layers[0]]), b = _mm_loadu_ps(colors[layers[1]] + 4);
        c = _mm_loadu_ps(colors[layers[2]] + 8), d = _mm_loadu_ps(colors[layers[3]] + 12);
    }
};

// Four pixels, each in registers of its own: as an array they would go through memory where loops are not unrolled.
template <bool HasLeast>
struct Avx2Block {
    Avx2Pixel<HasLeast> a, b, c, d;

    DFB_AVX2 DFB_INLINE void take(const Avx2Colors& v, double minTransmittance)
    {
        a.take(v.a, minTransmittance), b.take(v.b, minTransmittance);
        c.take(v.c, minTransmittance), d.take(v.d, minTransmittance);
    }
    DFB_AVX2 DFB_INLINE void add(const Avx2Colors& v, double minTransmittance)
    {
        a.add(v.a, minTransmittance), b.add(v.b, minTransmittance);
        c.add(v.c, minTransmittance), d.add(v.d, minTransmittance);
    }
    DFB_AVX2 DFB_INLINE void clear() { a.clear(), b.clear(), c.clear(), d.clear(); }
    DFB_AVX2 DFB_INLINE void load(const double* rgba, const double* t)
    {
        a.load(rgba, t), b.load(rgba + 4, t + 1), c.load(rgba + 8, t + 2), d.load(rgba + 12, t + 3);
    }
    DFB_AVX2 DFB_INLINE void store(double* rgba, double* t) const
    {
        a.store(rgba, t), b.store(rgba + 4, t + 1), c.store(rgba + 8, t + 2), d.store(rgba + 12, t + 3);
    }
    DFB_AVX2 DFB_INLINE bool isOpaque() const { return areZero(a.through, b.through, c.through, d.through); }
    DFB_AVX2 DFB_INLINE bool isEmpty() const { return areZero(a.sum, b.sum, c.sum, d.sum); }

private:
    DFB_AVX2 DFB_INLINE static bool areZero(__m256d a, __m256d b, __m256d c, __m256d d)
    {
        const __m256d any = _mm256_or_pd(_mm256_or_pd(a, b), _mm256_or_pd(c, d));
        const __m256i withoutSign = _mm256_set1_epi64x(0x7fffffffffffffff);
        return _mm256_testz_si256(_mm256_castpd_si256(any), withoutSign) != 0;
    }
};

template <bool HasLeast>
DFB_AVX2 bool blendGroupAvx2(double* rgba, double* transmittance, int count, const BlendGroup& group)
{
    bool isSeen = false;
    const std::ptrdiff_t inBlocks = count - count % 4;
    for (std::ptrdiff_t i = 0; i < inBlocks; i += 4) {
        Avx2Block<HasLeast> block;
        Avx2Colors colors;
        int k = 0;
        if (group.isFirst) {
            colors.load(group.colors[k++] + 4 * i);
            block.take(colors, group.minTransmittance);
        } else {
            block.load(rgba + 4 * i, transmittance + i);
        }
        while (k < group.layers && !block.isOpaque())
            for (const int end = nextLook(k, group.layers); k < end; ++k) {
                colors.load(group.colors[k] + 4 * i);
                block.add(colors, group.minTransmittance);
            }
        block.store(rgba + 4 * i, transmittance + i);
        isSeen |= !block.isOpaque();
    }
    for (std::ptrdiff_t i = inBlocks; i < count; ++i)
        isSeen |= blendBlock<HasLeast>(rgba, transmittance, i, 1, group);
    return isSeen;
}

template <bool HasLeast>
DFB_AVX2 void blendFourAvx2(double* rgba, double* transmittance, const float* const* colors,
                            const std::uint32_t (*orders)[4], int layers, double minTransmittance)
{
    Avx2Block<HasLeast> block;
    Avx2Colors four;
    four.load(colors, orders[0]);
    block.take(four, minTransmittance);
    for (int k = 1; k < layers && !block.isOpaque();)
        for (const int end = nextLook(k, layers); k < end; ++k) {
            four.load(colors, orders[k]);
            block.add(four, minTransmittance);
        }
    block.store(rgba, transmittance);
}

DFB_AVX2 inline void blendLevelsAvx2(std::uint8_t* levels, int count, const std::uint8_t* layer)
{
    const __m256i zero = _mm256_setzero_si256(), half = _mm256_set1_epi16(128), all = _mm256_set1_epi8(-1);
    const __m256i alphas = _mm256_set_epi32(0x0f0f0f0f, 0x0b0b0b0b, 0x07070707, 0x03030303, 0x0f0f0f0f, 0x0b0b0b0b,
                                            0x07070707, 0x03030303);
    int i = 0;
    for (; i + 8 <= count; i += 8) {
        auto* to = reinterpret_cast<__m256i*>(levels + 4 * i);
        const __m256i front = _mm256_loadu_si256(to);
        const __m256i behind = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(layer + 4 * i));
        const __m256i through = _mm256_xor_si256(_mm256_shuffle_epi8(front, alphas), all);
        __m256i seen[2] = {_mm256_mullo_epi16(_mm256_unpacklo_epi8(through, zero), _mm256_unpacklo_epi8(behind, zero)),
                           _mm256_mullo_epi16(_mm256_unpackhi_epi8(through, zero), _mm256_unpackhi_epi8(behind, zero))};
        for (__m256i& product : seen) { // over 255
            product = _mm256_add_epi16(product, half);
            product = _mm256_srli_epi16(_mm256_add_epi16(product, _mm256_srli_epi16(product, 8)), 8);
        }
        _mm256_storeu_si256(to, _mm256_adds_epu8(front, _mm256_packus_epi16(seen[0], seen[1])));
    }
    blendLevelsPlain(levels + 4 * i, count - i, layer + 4 * i);
}

#endif

// ---- in twice the precision of double

// The pixels of a row, with the low words of all sums.
struct ExactPixels {
    double *rgba, *rgbaLow, *transmittance, *transmittanceLow;
};

// Blends pixels under those of `row`, and lowers the transmittance. The colours are `stride` floats apart: 4, or 0 for
// one colour everywhere.
DFB_INLINE void blendExactlyPlain(const ExactPixels& row, int count, const float* color, int stride)
{
    const auto add = [](double& high, double& low, double product, double rest) {
        const DoubleDouble sum = DoubleDouble::sum(high, product);
        const DoubleDouble result = DoubleDouble::sumOfOrdered(sum.high, sum.low + (low + rest));
        high = result.high;
        low = result.low;
    };
    for (int i = 0; i < count; ++i, color += stride) {
        double product[4], rest[4];
        for (int c = 0; c < 4; ++c) {
            const DoubleDouble p = DoubleDouble::product(row.transmittance[i], color[c]);
            product[c] = p.high;
            rest[c] = p.low + row.transmittanceLow[i] * static_cast<double>(color[c]);
        }
        for (int c = 0; c < 4; ++c)
            add(row.rgba[4 * i + c], row.rgbaLow[4 * i + c], product[c], rest[c]);
        // T (1 - a), where 1 - a is exact; elsewhere T - T a, which would cancel where a is nearly 1.
        const float through = 1.0f - color[3];
        const bool isExact = color[3] >= 0.5f && color[3] <= 2.0f;
        const DoubleDouble left = DoubleDouble::product(row.transmittance[i], through);
        const DoubleDouble closed =
            DoubleDouble::sumOfOrdered(left.high, left.low + row.transmittanceLow[i] * static_cast<double>(through));
        add(row.transmittance[i], row.transmittanceLow[i], -product[3], -rest[3]);
        row.transmittance[i] = isExact ? closed.high : row.transmittance[i];
        row.transmittanceLow[i] = isExact ? closed.low : row.transmittanceLow[i];
    }
}

// ---- the faster one

inline void takeLayer(double* rgba, double* transmittance, int count, const float* color, double minTransmittance)
{
    DFB_FASTEST(takeLayerPlain, takeLayerAvx2, rgba, transmittance, count, color, minTransmittance);
}

inline bool blendGroup(double* rgba, double* transmittance, int count, const BlendGroup& group)
{
    if (group.minTransmittance > 0)
        return DFB_FASTEST(blendGroupPlain<true>, blendGroupAvx2<true>, rgba, transmittance, count, group);
    return DFB_FASTEST(blendGroupPlain<false>, blendGroupAvx2<false>, rgba, transmittance, count, group);
}

inline void blendFour(double* rgba, double* transmittance, const float* const* colors, const std::uint32_t (*orders)[4],
                      int layers, double minTransmittance)
{
    if (minTransmittance > 0)
        DFB_FASTEST(blendFourPlain<true>, blendFourAvx2<true>, rgba, transmittance, colors, orders, layers,
                    minTransmittance);
    else
        DFB_FASTEST(blendFourPlain<false>, blendFourAvx2<false>, rgba, transmittance, colors, orders, layers,
                    minTransmittance);
}

inline void blendConstant(double* rgba, const double* transmittance, int count, const float* color)
{
    DFB_FASTEST(blendConstantPlain, blendConstantAvx2, rgba, transmittance, count, color);
}

inline void takeNearest(float* nearest, int count, const float* color, const float* depth)
{
    fastest<takeNearestPlain>(nearest, count, color, depth);
}

inline void blendExactly(const ExactPixels& row, int count, const float* color, int stride)
{
    fastest<blendExactlyPlain>(row, count, color, stride);
}

inline void blendLevels(std::uint8_t* levels, int count, const std::uint8_t* layer)
{
    DFB_FASTEST(blendLevelsPlain, blendLevelsAvx2, levels, count, layer);
}

} // namespace detail
DFB_NAMESPACE_END
