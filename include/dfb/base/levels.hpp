// Levels: converts rows of linear values to 8-bit levels, linear or sRGB, correctly rounded or dithered, or to floats.
// Also returns how near the values are to ties, so that the caller can round again with more digits.
#pragma once

#include <dfb/base/cpu.hpp>
#include <dfb/base/double_double.hpp>

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <cstdint>
#include <cstring>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

DFB_NAMESPACE_BEGIN
namespace detail {

// Rounds 255 * value to the nearest integer, ties to even, for a value in [0, 1]. Values outside are clamped, and NaN
// gives 0. The product is rounded to double first, so that values that should be ties, such as a mean of 1/6, become
// ties again.
inline std::uint8_t toUnorm8(double value) noexcept
{
    // No branches, so that it can be vectorized. The order of the comparisons makes NaN 0.
    const double notBelow = value > 0.0 ? value : 0.0, clamped = notBelow < 1.0 ? notBelow : 1.0;
    // A double of 2^52 or more has no bits below one, so the addition rounds to an integer in the default mode: ties to
    // even.
    const double shift = 4503599627370496.0;
    return static_cast<std::uint8_t>(static_cast<int>((clamped * 255.0 + shift) - shift));
}

// Rounds a value that is known to about 100 bits. A value that may be a tie counts as one.
inline std::uint8_t toUnorm8(const DoubleDouble& value) noexcept
{
    if (!(value.high > 0.0))
        return 0;
    if (value.high >= 1.0 && value.high + value.low >= 1.0)
        return 255;
    const DoubleDouble scaled = DoubleDouble::product(value.high, 255.0f);
    const int below = static_cast<int>(scaled.high);
    const double overTie = (scaled.high - (below + 0.5)) + (scaled.low + 255.0 * value.low);
    if (std::abs(overTie) <= 0x1p-90)
        return static_cast<std::uint8_t>(below + below % 2);
    return static_cast<std::uint8_t>(below + (overTie > 0 ? 1 : 0));
}

// The linear value at which sRGB reaches so many half levels, to about 100 bits.
inline DoubleDouble srgbInverse(int halves) noexcept
{
    const DoubleDouble s = DoubleDouble{static_cast<double>(halves), 0} / 510;
    if (s.high < 0.04045)
        return s * DoubleDouble{100, 0} / 1292;
    const DoubleDouble base = (s * DoubleDouble{1000, 0} + DoubleDouble{55, 0}) / 1055;
    const DoubleDouble base3 = base * base * base, base12 = base3 * base3 * base3 * base3;
    // Solves t^5 = base^12: one step of Newton's method, from a double, doubles the number of digits.
    const DoubleDouble t{std::pow(base.high, 2.4), 0}, t2 = t * t, t4 = t2 * t2, t5 = t4 * t;
    const DoubleDouble excess = t5 + DoubleDouble{-base12.high, -base12.low};
    return t + DoubleDouble{-(excess.high / (5 * t4.high)), 0};
}

// The linear value where level k ends and the next begins.
inline DoubleDouble srgbBoundary(int k) noexcept { return srgbInverse(2 * k + 1); }

// A table of the thresholds, indexed by the upper bits of a float. The exponent from 2^-13 on and 7 bits of the
// mantissa select one of 13 * 128 + 1 cells. No cell has more than one threshold, and none is near a cell's edge. So
// one comparison decides, and a value can only be near to the threshold of its own cell.
class SrgbCells {
public:
    static constexpr std::uint32_t first = 114u << 7;  // the upper 16 bits of 2^-13, below the first threshold
    static constexpr std::size_t count = 13 * 128 + 1; // the last cell is that of the value 1

    // A cell is one word, so that vector code can gather it. It is the sum of two numbers: the level at the cell's
    // start, plus 1, times 2^17; and the lower 16 bits of the least float of the next level, or `none` if that level
    // begins in a later cell.
    static constexpr std::uint32_t none = 0x18000;

    SrgbCells()
    {
        for (int k = 0; k < 255; ++k) { // the least double of level k + 1, so that a comparison decides
            const DoubleDouble boundary = srgbBoundary(k);
            thresholds_[static_cast<std::size_t>(k)] =
                boundary.low > 0 ? std::nextafter(boundary.high, 2.0) : boundary.high;
        }
        thresholds_.back() = 2; // no value reaches it or comes near
        std::size_t level = 0;
        for (std::size_t cell = 0; cell < count; ++cell) {
            cells_[cell] = static_cast<std::uint32_t>(level + 1) << 17 | none;
            auto least = static_cast<float>(thresholds_[level]);
            if (static_cast<double>(least) < thresholds_[level])
                least = std::nextafter(least, 3.0f);
            std::uint32_t bits = 0;
            std::memcpy(&bits, &least, sizeof bits);
            assert(bits >> 16 >= first + cell); // the cell before has no second threshold
            if (bits >> 16 != first + cell)
                continue;
            assert((bits & 0xffff) >= edge && (bits & 0xffff) <= 0x10000 - edge);
            cells_[cell] = static_cast<std::uint32_t>(level + 1) << 17 | (bits & 0xffff);
            ++level;
        }
        assert(level == 255);
    }

    // Returns the level. Sets `isNear` to whether the level could be another one if the value has a relative error of
    // 2^-35.
    std::uint8_t levelOf(double linear, bool& isNear) const noexcept
    {
        // The order of the comparisons makes NaN 2^-13, whose level is 0.
        const double notBelow = linear > 0x1p-13 ? linear : 0x1p-13, clamped = notBelow < 1.0 ? notBelow : 1.0;
        std::uint64_t bits = 0;
        std::memcpy(&bits, &clamped, sizeof bits);
        const std::size_t start = (cells_[(bits >> 45) - (std::uint64_t{1023 - 13} << 7)] >> 17) - 1;
        const double threshold = thresholds_[start];
        isNear = std::abs(clamped - threshold) <= 0x1p-35 * std::max(clamped, threshold);
        return static_cast<std::uint8_t>(start + (clamped >= threshold ? 1 : 0));
    }

    const std::uint32_t* data() const noexcept { return cells_.data(); }

private:
    static constexpr std::uint32_t edge = 8; // floats; the threshold is nearer than 2

    std::array<std::uint32_t, count> cells_{};
    std::array<double, 256> thresholds_{};
};

inline const SrgbCells& srgbCells()
{
    static const SrgbCells cells;
    return cells;
}

inline std::uint8_t toSrgb8(double linear) noexcept
{
    bool isNear = false;
    return srgbCells().levelOf(linear, isNear);
}

// The sRGB level of a value that is known to about 100 bits.
inline std::uint8_t toSrgb8(const DoubleDouble& linear) noexcept
{
    bool isNear = false;
    int level = srgbCells().levelOf(linear.high, isNear);
    if (!isNear)
        return static_cast<std::uint8_t>(level);
    const auto isAbove = [&](int k) { // the boundary after level k
        const DoubleDouble boundary = srgbBoundary(k);
        return (linear + DoubleDouble{-boundary.high, -boundary.low}).high >= 0;
    };
    if (level > 0 && !isAbove(level - 1))
        --level;
    else if (level < 255 && isAbove(level))
        ++level;
    return static_cast<std::uint8_t>(level);
}

// Does toUnorm8() for `count` values. Returns the largest distance of any 255 * value from an integer: at most 1/2,
// which is a tie.
inline double toUnorm8(const double* values, int count, std::uint8_t* out) noexcept
{
    const double shift = 4503599627370496.0; // 2^52, as above
    double farthest = 0;
    int i = 0;
#if defined(__SSE2__) // compilers do not vectorize comparisons that could trap
    const __m128d zero = _mm_setzero_pd(), one = _mm_set1_pd(1.0), scale = _mm_set1_pd(255.0);
    const __m128d shifts = _mm_set1_pd(shift), noSign = _mm_castsi128_pd(_mm_set1_epi64x(0x7fffffffffffffff));
    __m128d distance = zero;
    const auto pair = [&](int at) {
        // max and min give the second operand where the first is NaN.
        const __m128d scaled = _mm_mul_pd(_mm_min_pd(_mm_max_pd(_mm_loadu_pd(values + at), zero), one), scale);
        const __m128d shifted = _mm_add_pd(scaled, shifts);
        distance = _mm_max_pd(distance, _mm_and_pd(_mm_sub_pd(scaled, _mm_sub_pd(shifted, shifts)), noSign));
        return _mm_castpd_ps(shifted); // the integers are in the lower halves
    };
    const auto four = [&](int at) {
        return _mm_castps_si128(_mm_shuffle_ps(pair(at), pair(at + 2), _MM_SHUFFLE(2, 0, 2, 0)));
    };
    for (; i + 8 <= count; i += 8) {
        const __m128i words = _mm_packs_epi32(four(i), four(i + 4));
        _mm_storel_epi64(reinterpret_cast<__m128i*>(out + i), _mm_packus_epi16(words, words));
    }
    farthest = std::max(_mm_cvtsd_f64(distance), _mm_cvtsd_f64(_mm_unpackhi_pd(distance, distance)));
#endif
    for (; i < count; ++i) {
        out[i] = toUnorm8(values[i]);
        const double scaled = 255.0 * (values[i] > 0.0 ? std::min(values[i], 1.0) : 0.0);
        farthest = std::max(farthest, std::abs(scaled - ((scaled + shift) - shift)));
    }
    return farthest;
}

// Does the same for floats.
inline double toUnorm8(const float* values, int count, std::uint8_t* out) noexcept
{
    constexpr int block = 64;
    double farthest = 0;
    for (int first = 0; first < count; first += block) {
        const int size = std::min(block, count - first);
        double copy[block];
        std::copy_n(values + first, size, copy);
        farthest = std::max(farthest, toUnorm8(copy, size, out + first));
    }
    return farthest;
}

// Converts `count` pixels to linear levels; or their colours to sRGB levels, where a colour that is near a threshold
// counts as a tie, and their alpha to linear ones.
template <bool IsSrgb, class Real>
double toLevels(const Real* rgba, int count, std::uint8_t* out) noexcept
{
    if constexpr (!IsSrgb)
        return toUnorm8(rgba, 4 * count, out);
    constexpr int block = 64;
    const SrgbCells& cells = srgbCells();
    double farthest = 0;
    for (int first = 0; first < count; first += block) {
        const int size = std::min(block, count - first);
        double alpha[block];
        std::uint8_t levels[block];
        for (int i = 0; i < size; ++i)
            alpha[i] = rgba[4 * (first + i) + 3];
        farthest = std::max(farthest, toUnorm8(alpha, size, levels));
        bool anyNear = false;
        for (int i = 0; i < size; ++i) {
            for (int c = 0; c < 3; ++c) {
                bool isNear = false;
                out[4 * (first + i) + c] = cells.levelOf(rgba[4 * (first + i) + c], isNear);
                anyNear |= isNear;
            }
            out[4 * (first + i) + 3] = levels[i];
        }
        farthest = anyNear ? 0.5 : farthest;
    }
    return farthest;
}

#if defined(DFB_HAS_AVX2_CLONES)
DFB_AVX2 inline __m256 loadAsFloats(const float* values) noexcept { return _mm256_loadu_ps(values); }
DFB_AVX2 inline __m256 loadAsFloats(const double* values) noexcept
{
    return _mm256_set_m128(_mm256_cvtpd_ps(_mm256_loadu_pd(values + 4)), _mm256_cvtpd_ps(_mm256_loadu_pd(values)));
}

// toLevels() for eight pixels or more, in groups of eight; the last group may overlap the one before. This rounds in
// float: the value is off by half an ulp, and so is the product, together by 255 * 2^-25 + 2^-17 < 2^-16. If that could
// matter because a tie is near, or if a colour is within 2 floats of an sRGB threshold, all eight pixels go through
// toLevels(). The result is at least that of toLevels(), and is a tie for the same pixels. Otherwise it may be up to
// 2^-15 larger.
template <bool IsSrgb, class Real>
DFB_AVX2 inline double toLevelsAvx2(const Real* rgba, int count, std::uint8_t* out) noexcept
{
    const float off = 0x1p-16f;
    const __m256 zero = _mm256_setzero_ps(), one = _mm256_set1_ps(1.0f), scale = _mm256_set1_ps(255.0f);
    const __m256 limit = _mm256_set1_ps(0.5f - 2 * off), low = _mm256_set1_ps(0x1p-13f);
    // Keeps all bits but the sign; for sRGB only those of alpha, the only linear channel.
    const int noSign = 0x7fffffff, ofColor = IsSrgb ? 0 : noSign;
    const __m256 distanceBits =
        _mm256_castsi256_ps(_mm256_setr_epi32(ofColor, ofColor, ofColor, noSign, ofColor, ofColor, ofColor, noSign));
    const __m256i inOrder = _mm256_setr_epi32(0, 4, 1, 5, 2, 6, 3, 7);
    const int* cells = nullptr;
    if constexpr (IsSrgb)
        cells = reinterpret_cast<const int*>(srgbCells().data());
    __m256 all = zero;
    double farthest = 0;
    for (int next = 0; next < count; next += 8) {
        const int i = std::min(next, count - 8);
        __m256i levels[4], nearby = _mm256_setzero_si256();
        __m256 distance = zero;
        for (int part = 0; part < 4; ++part) {
            // max and min give the second operand where the first is NaN.
            const __m256 value = _mm256_min_ps(_mm256_max_ps(loadAsFloats(rgba + 4 * i + 8 * part), zero), one);
            const __m256 scaled = _mm256_mul_ps(value, scale);
            levels[part] = _mm256_cvtps_epi32(scaled);
            const __m256 rest = _mm256_sub_ps(scaled, _mm256_cvtepi32_ps(levels[part])); // exact
            distance = _mm256_max_ps(distance, _mm256_and_ps(rest, distanceBits));
            if constexpr (IsSrgb) {
                const __m256i bits = _mm256_castps_si256(_mm256_max_ps(value, low));
                const __m256i cell = _mm256_sub_epi32(_mm256_srli_epi32(bits, 16),
                                                      _mm256_set1_epi32(static_cast<int>(SrgbCells::first)));
                const __m256i entry = _mm256_i32gather_epi32(cells, cell, 4);
                const __m256i below = _mm256_sub_epi32(_mm256_and_si256(entry, _mm256_set1_epi32(0x1ffff)),
                                                       _mm256_and_si256(bits, _mm256_set1_epi32(0xffff)));
                const __m256i level =
                    _mm256_add_epi32(_mm256_srli_epi32(entry, 17), _mm256_cmpgt_epi32(below, _mm256_setzero_si256()));
                nearby = _mm256_or_si256(nearby, _mm256_cmpgt_epi32(_mm256_set1_epi32(2), _mm256_abs_epi32(below)));
                levels[part] = _mm256_blend_epi32(level, levels[part], 0x88);
            }
        }
        int unsure = _mm256_movemask_ps(_mm256_cmp_ps(distance, limit, _CMP_GT_OQ));
        if constexpr (IsSrgb)
            unsure |= _mm256_movemask_ps(_mm256_castsi256_ps(nearby)) & 0x77; // alpha has no such threshold
        if (unsure != 0) {
            farthest = std::max(farthest, toLevels<IsSrgb>(rgba + 4 * i, 8, out + 4 * i));
            continue;
        }
        all = _mm256_max_ps(all, distance);
        const __m256i bytes =
            _mm256_packus_epi16(_mm256_packs_epi32(levels[0], levels[1]), _mm256_packs_epi32(levels[2], levels[3]));
        _mm256_storeu_si256(reinterpret_cast<__m256i*>(out + 4 * i), _mm256_permutevar8x32_epi32(bytes, inOrder));
    }
    alignas(32) float most[8];
    _mm256_store_ps(most, all);
    return std::max(farthest, static_cast<double>(*std::max_element(most, most + 8) + off));
}
#endif

// Converts `count` premultiplied RGBA pixels to levels in the fastest way that the processor has. Returns the same as
// convertPixels().
template <bool IsSrgb, class Real>
double pixelsToLevels(const Real* rgba, int count, std::uint8_t* out) noexcept
{
#if defined(DFB_HAS_AVX2_CLONES)
    if (count >= 8 && cpuHasAvx2())
        return toLevelsAvx2<IsSrgb>(rgba, count, out);
#endif
    return toLevels<IsSrgb>(rgba, count, out);
}

template <class Real>
DFB_INLINE void toFloats(const Real* values, int count, float* out) noexcept
{
    for (int i = 0; i < count; ++i)
        out[i] = static_cast<float>(values[i]);
}

// A float -0 becomes 0.
DFB_INLINE void copyFloats(const float* values, int count, float* out) noexcept
{
    for (int i = 0; i < count; ++i)
        out[i] = values[i] + 0.0f;
}

// A pixel as four floats; a float -0 becomes 0.
#if defined(__SSE2__)
inline __m128 pixelOf(const double* rgba) noexcept
{
    return _mm_movelh_ps(_mm_cvtpd_ps(_mm_loadu_pd(rgba)), _mm_cvtpd_ps(_mm_loadu_pd(rgba + 2)));
}
inline __m128 pixelOf(const float* rgba) noexcept { return _mm_add_ps(_mm_loadu_ps(rgba), _mm_setzero_ps()); }
#endif

// Stores float pixels without going through the cache, in whole cache lines, as this thread does not read `out` soon.
// Call storesAreDone() before other threads learn of the pixels. Returns how many pixels were stored, from the first
// on. The caller must store the others.
template <class Real>
int streamPixels([[maybe_unused]] const Real* rgba, [[maybe_unused]] int count, [[maybe_unused]] float* out) noexcept
{
    int stored = 0;
#if defined(__SSE2__)
    constexpr std::uintptr_t line = 64;
    const auto address = reinterpret_cast<std::uintptr_t>(out);
    if (address % 16 != 0 || count < 16)
        return 0;
    for (; (address + 16 * static_cast<std::uintptr_t>(stored)) % line != 0; ++stored)
        _mm_store_ps(out + 4 * stored, pixelOf(rgba + 4 * stored));
    for (; stored + 4 <= count; stored += 4)
        for (int i = 4 * stored; i < 4 * stored + 16; i += 4)
            _mm_stream_ps(out + i, pixelOf(rgba + i));
#endif
    return stored;
}
inline void storesAreDone() noexcept
{
#if defined(__SSE2__)
    _mm_sfence();
#endif
}

// Dither: conversion to 8 bits without bands in gradients. Each pixel's place in the image gives a threshold in [0, 1].
// A value farther than this fraction of the way between two levels takes the upper one. So the mean over neighbours can
// lie between levels.
//
// The thresholds are those of B. E. Bayer, "An optimum method for two-level rendition of continuous-tone pictures",
// IEEE Intl. Conf. on Communications 1973: each of (rank + 1/2) / 64, for ranks 0 to 63, occurs once in any 8x8 pixels.
// Unlike noise, they keep the mean over every such block, and need only integers. Colours are rounded to float first,
// so that each step is exact, and an image of floats gets the same levels. All channels of a pixel have one threshold:
// grey stays grey, and a darker channel does not become lighter than a brighter one.

// Returns 0 to 63: the bits of x ^ y and of y in turn, the lowest bits of x and y becoming the highest.
constexpr int ditherRank(int x, int y) noexcept
{
    int rank = 0;
    for (int bit = 0; bit < 3; ++bit)
        rank = 4 * rank + 2 * (((x ^ y) >> bit) & 1) + ((y >> bit) & 1);
    return rank;
}

// The level at or below `value`, or the next one if `value` is more than the fraction `threshold` of the way to it.
// Clamped; NaN gives 0.
inline int ditherUnorm8(float value, double threshold) noexcept
{
    if (!(value > 0.0f))
        return 0;
    if (value >= 1.0f)
        return 255;
    const double scaled = 255.0 * static_cast<double>(value);
    const int below = static_cast<int>(scaled);
    return below + (scaled - below > threshold ? 1 : 0);
}

// The sRGB level at or below `value`, or the next one if `value` is more than the fraction `threshold` of the way to
// it. The fraction is measured in linear light, in which an eye that sees no single pixels averages them. In levels it
// differs by less than 1/128.
inline int ditherSrgb8(float value, double threshold)
{
    static const std::array<double, 256> light = [] {
        std::array<double, 256> levels{};
        for (int k = 0; k < 256; ++k)
            levels[static_cast<std::size_t>(k)] = srgbInverse(2 * k).high;
        return levels;
    }();
    if (!(value > 0.0f))
        return 0;
    if (value >= 1.0f)
        return 255;
    const auto linear = static_cast<double>(value);
    std::size_t below = toSrgb8(linear);
    if (linear < light[below])
        --below;
    const bool isAbove = linear - light[below] > threshold * (light[below + 1] - light[below]);
    return static_cast<int>(below) + (isAbove ? 1 : 0);
}

} // namespace detail
DFB_NAMESPACE_END
