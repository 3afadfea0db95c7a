// Image: what the display rank gets, in one of the output formats; and the exact conversion of linear pixels
// to those formats.
#pragma once

#include <dfb/buffer.hpp>
#include <dfb/channels.hpp>
#include <dfb/cpu.hpp>
#include <dfb/double_double.hpp>
#include <dfb/error.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <string>
#include <type_traits>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace dfb {

// A half-open rectangle of pixels, [x0, x1) x [y0, y1), row 0 on top.
struct Region {
    int x0 = 0, y0 = 0, x1 = 0, y1 = 0;

    int width() const noexcept { return x1 - x0; }
    int height() const noexcept { return y1 - y0; }
    bool empty() const noexcept { return x1 <= x0 || y1 <= y0; }
    bool contains(int x, int y) const noexcept { return x >= x0 && x < x1 && y >= y0 && y < y1; }
};

inline bool operator==(const Region& a, const Region& b) noexcept
{
    return a.x0 == b.x0 && a.y0 == b.y0 && a.x1 == b.x1 && a.y1 == b.y1;
}
inline bool operator!=(const Region& a, const Region& b) noexcept { return !(a == b); }

inline Region intersection(const Region& a, const Region& b) noexcept
{
    return {std::max(a.x0, b.x0), std::max(a.y0, b.y0), std::min(a.x1, b.x1), std::min(a.y1, b.y1)};
}

// Pixels are premultiplied RGBA, 4 channels interleaved.
enum class OutputFormat : std::uint32_t {
    None,   // nothing travels to the display rank and nothing is stored there
    RGBA8,  // 8 bits a channel, linear: 255 * value, rounded to nearest, ties to even
    SRGBA8, // 8 bits a channel, colour through the sRGB curve (IEC 61966-2-1), alpha linear
    RGBA32F // 32-bit float, linear
};

inline std::size_t bytesPerPixel(OutputFormat format) noexcept
{
    return format == OutputFormat::None ? 0 : format == OutputFormat::RGBA32F ? 16 : 4;
}

namespace detail {

// 255 * value to the nearest integer, ties to even, for value in [0, 1]; clamped outside; NaN gives 0. The product is
// rounded to double first, which brings values that should be ties, such as a mean of 1/6, back to them.
inline std::uint8_t toUnorm8(double value) noexcept
{
    // No branches, so that it can be vectorized. The order of the comparisons makes NaN 0.
    const double notBelow = value > 0.0 ? value : 0.0, clamped = notBelow < 1.0 ? notBelow : 1.0;
    // 2^52 leaves no bit below one, so the addition rounds as the default mode does: to even.
    const double shift = 4503599627370496.0;
    return static_cast<std::uint8_t>(static_cast<int>((clamped * 255.0 + shift) - shift));
}

// The same for a value that is known to about 100 bits. What is nearer to a tie than that is one.
inline std::uint8_t toUnorm8(const DoubleDouble& value) noexcept
{
    if (!(value.high > 0.0))
        return 0;
    if (value.high >= 1.0 && value.high + value.low >= 1.0)
        return 255;
    const DoubleDouble scaled = value * DoubleDouble{255.0, 0.0};
    const int below = static_cast<int>(scaled.high);
    const DoubleDouble overTie = scaled + DoubleDouble{-below - 0.5, 0.0};
    if (std::abs(overTie.high) <= 0x1p-90)
        return static_cast<std::uint8_t>(below + below % 2);
    return static_cast<std::uint8_t>(below + (overTie.high > 0 ? 1 : 0));
}

// thresholds()[k] is the least double whose sRGB level is k + 1: the decision is a comparison and so exact, where
// evaluating the curve would be off near every boundary.
inline const std::array<double, 255>& srgbThresholds()
{
    static const std::array<double, 255> table = [] {
        std::array<double, 255> t{};
        for (int k = 0; k < 255; ++k) {
            const long double s = (static_cast<long double>(k) + 0.5L) / 255.0L;
            const long double exact = s <= 0.04045L ? s / 12.92L : std::pow((s + 0.055L) / 1.055L, 2.4L);
            auto least = static_cast<double>(exact);
            if (static_cast<long double>(least) < exact)
                least = std::nextafter(least, 1.0);
            t[static_cast<std::size_t>(k)] = least;
        }
        return t;
    }();
    return table;
}

inline std::uint8_t toSrgb8(double linear) noexcept
{
    const auto& t = srgbThresholds();
    if (!(linear >= t.front()))
        return 0;
    return static_cast<std::uint8_t>(std::upper_bound(t.begin(), t.end(), linear) - t.begin());
}

// Whether a value with an error of 2^-35 of itself could have another level than toSrgb8() gave.
inline bool isNearSrgbThreshold(double linear, std::uint8_t level) noexcept
{
    const auto& t = srgbThresholds();
    return (level > 0 && linear - t[level - std::size_t{1}] <= 0x1p-35 * linear)
           || (level < 255 && t[level] - linear <= 0x1p-35 * t[level]);
}

// The linear value of so many half levels, to about 100 bits.
inline DoubleDouble srgbInverse(int halves) noexcept
{
    const DoubleDouble s = DoubleDouble{static_cast<double>(halves), 0} / 510;
    if (s.high < 0.04045)
        return s * DoubleDouble{100, 0} / 1292;
    const DoubleDouble base = (s * DoubleDouble{1000, 0} + DoubleDouble{55, 0}) / 1055;
    const DoubleDouble base3 = base * base * base, base12 = base3 * base3 * base3 * base3;
    // t^5 = base^12: one step of Newton's from a double doubles the digits.
    const DoubleDouble t{std::pow(base.high, 2.4), 0}, t2 = t * t, t4 = t2 * t2, t5 = t4 * t;
    const DoubleDouble excess = t5 + DoubleDouble{-base12.high, -base12.low};
    return t + DoubleDouble{-(excess.high / (5 * t4.high)), 0};
}

// Where level k ends and the next begins.
inline DoubleDouble srgbBoundary(int k) noexcept { return srgbInverse(2 * k + 1); }

// The same for a value that is known to about 100 bits.
inline std::uint8_t toSrgb8(const DoubleDouble& linear) noexcept
{
    int level = toSrgb8(linear.high);
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

} // namespace detail

namespace detail {

#if defined(__SSE2__)
// Of as many as there are whole eights, which it returns; the rest is for toUnorm8(). Compilers do not vectorize
// comparisons that could trap.
inline int toUnorm8Sse2(const double* values, int count, std::uint8_t* out, double& farthest) noexcept
{
    const double shift = 4503599627370496.0;
    int i = 0;
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
    return i;
}

// The same, four at a time.
DFB_AVX2 inline int toUnorm8Avx2(const double* values, int count, std::uint8_t* out, double& farthest) noexcept
{
#if defined(DFB_HAS_AVX2_CLONES)
    const __m256d zero = _mm256_setzero_pd(), one = _mm256_set1_pd(1.0), scale = _mm256_set1_pd(255.0);
    const __m256d shifts = _mm256_set1_pd(4503599627370496.0);
    const __m256d noSign = _mm256_castsi256_pd(_mm256_set1_epi64x(0x7fffffffffffffff));
    __m256d distance = zero;
    int i = 0;
    for (; i + 8 <= count; i += 8) {
        __m128i fours[2];
        for (int half = 0; half < 2; ++half) {
            const __m256d value = _mm256_loadu_pd(values + i + 4 * half);
            const __m256d scaled = _mm256_mul_pd(_mm256_min_pd(_mm256_max_pd(value, zero), one), scale);
            const __m256d rounded = _mm256_sub_pd(_mm256_add_pd(scaled, shifts), shifts);
            distance = _mm256_max_pd(distance, _mm256_and_pd(_mm256_sub_pd(scaled, rounded), noSign));
            fours[half] = _mm256_cvttpd_epi32(rounded);
        }
        const __m128i words = _mm_packs_epi32(fours[0], fours[1]);
        _mm_storel_epi64(reinterpret_cast<__m128i*>(out + i), _mm_packus_epi16(words, words));
    }
    const __m128d two = _mm_max_pd(_mm256_castpd256_pd128(distance), _mm256_extractf128_pd(distance, 1));
    farthest = std::max(_mm_cvtsd_f64(two), _mm_cvtsd_f64(_mm_unpackhi_pd(two, two)));
    return i;
#else
    return toUnorm8Sse2(values, count, out, farthest);
#endif
}
#endif

// toUnorm8() of `count` values. Returns how far the farthest of 255 * value was from an integer, up to 1/2, which is a
// tie.
inline double toUnorm8(const double* values, int count, std::uint8_t* out) noexcept
{
    const double shift = 4503599627370496.0; // as above
    double farthest = 0;
    int i = 0;
#if defined(__SSE2__)
    i = cpuHasAvx2() ? toUnorm8Avx2(values, count, out, farthest) : toUnorm8Sse2(values, count, out, farthest);
#endif
    for (; i < count; ++i) {
        out[i] = toUnorm8(values[i]);
        const double scaled = 255.0 * (values[i] > 0.0 ? std::min(values[i], 1.0) : 0.0);
        farthest = std::max(farthest, std::abs(scaled - ((scaled + shift) - shift)));
    }
    return farthest;
}

template <class Real>
DFB_INLINE void toFloats(const Real* values, int count, float* out) noexcept
{
    for (int i = 0; i < count; ++i)
        out[i] = static_cast<float>(values[i]);
}
template <class Real>
DFB_AVX2 inline void toFloatsAvx2(const Real* values, int count, float* out) noexcept
{
    toFloats(values, count, out);
}

} // namespace detail

// Converts `count` linear premultiplied RGBA pixels of type double or float into `out`, bytesPerPixel(format) each,
// rounded to nearest. Returns how far the farthest value was from an 8-bit level, up to 1/2, which is a tie between
// two; an sRGB colour next to where another level begins counts as one.
template <class Real>
double convertPixels(const Real* rgba, int count, OutputFormat format, std::byte* out)
{
    constexpr int block = 64;
    auto* bytes = reinterpret_cast<std::uint8_t*>(out);
    double farthest = 0;
    switch (format) {
    case OutputFormat::None: break;
    case OutputFormat::RGBA32F: {
        auto* floats = reinterpret_cast<float*>(out);
        if (detail::cpuHasAvx2())
            detail::toFloatsAvx2(rgba, 4 * count, floats);
        else
            detail::toFloats(rgba, 4 * count, floats);
        break;
    }
    case OutputFormat::RGBA8:
        for (int first = 0; first < 4 * count; first += block) {
            const int size = std::min(block, 4 * count - first);
            if constexpr (std::is_same_v<Real, double>) {
                farthest = std::max(farthest, detail::toUnorm8(rgba + first, size, bytes + first));
            } else {
                double values[block];
                std::copy_n(rgba + first, size, values);
                farthest = std::max(farthest, detail::toUnorm8(values, size, bytes + first));
            }
        }
        break;
    case OutputFormat::SRGBA8:
        for (int first = 0; first < count; first += block) {
            const int size = std::min(block, count - first);
            double alpha[block];
            std::uint8_t levels[block];
            for (int i = 0; i < size; ++i)
                alpha[i] = rgba[4 * (first + i) + 3];
            farthest = std::max(farthest, detail::toUnorm8(alpha, size, levels));
            for (int i = 0; i < size; ++i) {
                for (int c = 0; c < 3; ++c) {
                    const double value = rgba[4 * (first + i) + c];
                    const std::uint8_t level = detail::toSrgb8(value);
                    bytes[4 * (first + i) + c] = level;
                    farthest = detail::isNearSrgbThreshold(value, level) ? 0.5 : farthest;
                }
                bytes[4 * (first + i) + 3] = levels[i];
            }
        }
        break;
    }
    return farthest;
}

// A whole image, row-major, row 0 on top, no padding. Empty on ranks other than the display rank and with
// OutputFormat::None.
class Image {
public:
    Image() = default;
    // `channels`: beside the colour.
    Image(MemoryPool& pool, int width, int height, OutputFormat format, ChannelMask channels)
        : width_(width), height_(height), format_(format)
    {
        if (format == OutputFormat::None)
            return;
        planes_[detail::Color] = pool.acquire(pixelCount() * bytesPerPixel(format));
        for (std::size_t c = detail::Depth; c < detail::channelCount; ++c)
            if (detail::hasChannel(channels, c))
                planes_[c] = pool.acquire(pixelCount() * 4 * static_cast<std::size_t>(detail::channelWords[c]));
    }

    int width() const noexcept { return width_; }
    int height() const noexcept { return height_; }
    OutputFormat format() const noexcept { return format_; }
    std::size_t pixelCount() const noexcept
    {
        return static_cast<std::size_t>(width_) * static_cast<std::size_t>(height_);
    }
    bool empty() const noexcept { return planes_[detail::Color].empty(); }
    bool hasDepth() const noexcept { return !planes_[detail::Depth].empty(); }

    std::byte* bytes() noexcept { return planes_[detail::Color].data(); }
    const std::byte* bytes() const noexcept { return planes_[detail::Color].data(); }

    // 4 bytes a pixel. Throws InvalidArgument unless the format is RGBA8 or SRGBA8.
    const std::uint8_t* rgba8() const
    {
        require(format_ == OutputFormat::RGBA8 || format_ == OutputFormat::SRGBA8, "8-bit pixels");
        return reinterpret_cast<const std::uint8_t*>(bytes());
    }
    // 4 floats a pixel. Throws InvalidArgument unless the format is RGBA32F.
    const float* rgba32f() const
    {
        require(format_ == OutputFormat::RGBA32F, "float pixels");
        return reinterpret_cast<const float*>(bytes());
    }
    // One float a pixel, +infinity where nothing was hit. This and the next throw InvalidArgument if the channel was
    // not asked for. What they mean where inputs were blended: channels.hpp.
    const float* depth() const { return detail::floatsOf(plane(detail::Depth, "depth")); }
    const float* normal() const { return detail::floatsOf(plane(detail::Normal, "normals")); }       // 3 a pixel
    const float* albedo() const { return detail::floatsOf(plane(detail::Albedo, "albedo")); }        // 3 a pixel
    const float* position() const { return detail::floatsOf(plane(detail::Position, "positions")); } // 3 a pixel
    // noId where there is none.
    const std::uint32_t* primitiveId() const { return detail::idsOf(plane(detail::PrimitiveId, "primitive ids")); }
    const std::uint32_t* instanceId() const { return detail::idsOf(plane(detail::InstanceId, "instance ids")); }

    // Gives its memory away; there is nothing in it then.
    std::array<Buffer, detail::channelCount> release() noexcept { return std::move(planes_); }

    // Where pixel `first` of each plane is; null where there is none.
    detail::Planes planesAt(std::size_t first) noexcept
    {
        detail::Planes planes;
        for (std::size_t c = detail::Depth; c < detail::channelCount; ++c)
            if (!planes_[c].empty())
                planes.at[c] = planes_[c].data() + 4 * first * static_cast<std::size_t>(detail::channelWords[c]);
        if (!empty())
            planes.at[detail::Color] = bytes() + first * bytesPerPixel(format_);
        return planes;
    }

private:
    void require(bool condition, const char* what) const
    {
        if (!condition || empty())
            throw InvalidArgument(std::string("this image has no ") + what
                                  + " (only the display rank has an image, in the format it was configured for)");
    }

    const std::byte* plane(detail::Channel channel, const char* what) const
    {
        require(!planes_[channel].empty(), what);
        return planes_[channel].data();
    }

    int width_ = 0, height_ = 0;
    OutputFormat format_ = OutputFormat::None;
    std::array<Buffer, detail::channelCount> planes_;
};

} // namespace dfb
