// The serial reference that results are compared with: it works pixel by pixel, with more than twice the precision of
// double (or in long double, if the compiler has no __float128), and without regard to speed. It shares no code with
// the library.
#pragma once

#include <algorithm>
#include <array>
#include <cfloat>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <tuple>
#include <vector>

namespace dfb::testing {

#if defined(__SIZEOF_FLOAT128__)
__extension__ typedef __float128 Exact;
inline constexpr int exactBits = 113;
#else
using Exact = long double; // on x86 64 bits, on aarch64 113
inline constexpr int exactBits = LDBL_MANT_DIG;
#endif

inline constexpr std::uint32_t noIdOfPixel = 0xffffffffu;

// Channels of an input's pixel beside colour and depth.
struct AuxSample {
    std::array<float, 3> normal{}, albedo{}; // premultiplied
    std::array<float, 3> position{};
    std::uint32_t primitiveId = noIdOfPixel, instanceId = noIdOfPixel;
};

// One input of a pixel.
struct Sample {
    std::array<float, 4> rgba{}; // premultiplied
    float depth = std::numeric_limits<float>::infinity();
    std::uint32_t source = 0;
    std::uint16_t part = 0;
    AuxSample aux{};
};

// The value taken from one input, and its depth.
template <class Value>
struct Taken {
    Value value{};
    float depth = 0;
    bool isTaken = false;

    void takeFirst(const Value& its, float itsDepth)
    {
        if (!isTaken)
            *this = {its, itsDepth, true};
    }
    void takeNearest(const Taken& other)
    {
        if (other.isTaken && (!isTaken || other.depth < depth))
            *this = other;
    }
};

struct Pixel {
    std::array<Exact, 4> rgba{};
    float depth = std::numeric_limits<float>::infinity(); // of the nearest input with alpha > 0, or of nearest()
    // Sums over the inputs, weighted by the transmittance in front of each, without the background. `weight` is the sum
    // of alpha, `magnitude` that of each input's largest |component| of normal and albedo.
    std::array<Exact, 3> normal{}, albedo{};
    Exact weight = 0, magnitude = 0;
    Taken<std::array<float, 3>> position; // of the first input with alpha > 0, or of nearest()
    Taken<std::uint32_t> primitiveId{noIdOfPixel}, instanceId{noIdOfPixel}; // the same, of the first input that has one
};

using Color = std::array<float, 4>;

// The depth to compare by: NaN is farthest.
inline float comparable(float depth) { return std::isnan(depth) ? std::numeric_limits<float>::infinity() : depth; }

inline bool isInFront(const Sample& a, const Sample& b)
{
    return std::make_tuple(comparable(a.depth), a.source, a.part)
           < std::make_tuple(comparable(b.depth), b.source, b.part);
}

// OrderedBlend and ImageParallel: blends the samples in their order, front to back: A += T a, T *= 1 - a; the
// background last. `anyAlpha`: all samples give depth, position and ids, not only those with alpha > 0.
inline Pixel compositeInOrder(const std::vector<Sample>& samples, const Color& background, bool anyAlpha = false)
{
    Pixel result;
    Exact transmittance = 1;
    for (const Sample& s : samples) {
        for (std::size_t c = 0; c < 4; ++c)
            result.rgba[c] += transmittance * static_cast<Exact>(s.rgba[c]);
        float largest = 0;
        for (std::size_t c = 0; c < 3; ++c) {
            result.normal[c] += transmittance * static_cast<Exact>(s.aux.normal[c]);
            result.albedo[c] += transmittance * static_cast<Exact>(s.aux.albedo[c]);
            largest = std::max({largest, std::fabs(s.aux.normal[c]), std::fabs(s.aux.albedo[c])});
        }
        result.magnitude += transmittance * static_cast<Exact>(largest);
        transmittance *= 1 - static_cast<Exact>(s.rgba[3]);
        if (!anyAlpha && !(s.rgba[3] > 0.0f))
            continue;
        const float depth = comparable(s.depth);
        result.depth = std::min(result.depth, depth);
        result.position.takeFirst(s.aux.position, depth);
        if (s.aux.primitiveId != noIdOfPixel)
            result.primitiveId.takeFirst(s.aux.primitiveId, depth);
        if (s.aux.instanceId != noIdOfPixel)
            result.instanceId.takeFirst(s.aux.instanceId, depth);
    }
    result.weight = result.rgba[3];
    for (std::size_t c = 0; c < 4; ++c)
        result.rgba[c] += transmittance * static_cast<Exact>(background[c]);
    return result;
}

// AlphaBlend: the same, sorted by (depth, source, part).
inline Pixel composite(std::vector<Sample> samples, const Color& background)
{
    std::stable_sort(samples.begin(), samples.end(), isInFront);
    return compositeInOrder(samples, background);
}

// DepthComposite: the sample in front alone, if its depth is below +infinity, whatever its alpha.
inline Pixel nearest(const std::vector<Sample>& samples, const Color& background)
{
    const auto first = std::min_element(samples.begin(), samples.end(), isInFront);
    if (first == samples.end() || comparable(first->depth) == std::numeric_limits<float>::infinity())
        return compositeInOrder({}, background);
    return compositeInOrder({*first}, background, true);
}

// The mean of passes, each of which was composited by itself. Depth, position and ids are those of the nearest pass.
// Normal, albedo and their weights remain sums.
inline Pixel mean(const std::vector<Pixel>& passes)
{
    Pixel result;
    for (const Pixel& pass : passes) {
        for (std::size_t c = 0; c < 4; ++c)
            result.rgba[c] += pass.rgba[c];
        for (std::size_t c = 0; c < 3; ++c) {
            result.normal[c] += pass.normal[c];
            result.albedo[c] += pass.albedo[c];
        }
        result.weight += pass.weight;
        result.magnitude += pass.magnitude;
        result.depth = std::min(result.depth, pass.depth);
        result.position.takeNearest(pass.position);
        result.primitiveId.takeNearest(pass.primitiveId);
        result.instanceId.takeNearest(pass.instanceId);
    }
    for (Exact& value : result.rgba)
        value /= static_cast<Exact>(passes.size());
    return result;
}

// Whether a normal or albedo of the image is wrong. `sum`: the sum in `pixel` of which it is the mean. The terms have
// either sign. So the mean is off by the rounding of terms that may cancel, 2^-36 of them (see compositing.hpp), and is
// rounded to float at the end.
inline bool isWrongMean(float measured, Exact sum, const Pixel& pixel)
{
    if (!(pixel.weight > 0))
        return measured != 0.0f;
    const auto expected = static_cast<double>(sum / pixel.weight);
    if (!std::isfinite(expected)) // such a value is not checked
        return false;
    const auto spread = static_cast<double>(pixel.magnitude / pixel.weight);
    return !(std::fabs(static_cast<double>(measured) - expected)
             <= 0x1p-24 * std::fabs(expected) + 0x1p-36 * spread + 0x1p-150);
}

inline float toFloat(Exact value) { return static_cast<float>(value); }

// Rounds to the nearest of 0 to 255, ties to even, clamped; NaN gives 0. A value that differs from a tie by no more
// than the rounding of Exact counts as a tie: the mean of 3 passes can be 1/6, that is 42.5 / 255, which no binary
// number is.
inline std::uint8_t toUnorm8(Exact value)
{
    if (!(value > 0))
        return 0;
    if (value >= 1)
        return 255;
    const Exact scaled = value * 255;
    const int below = static_cast<int>(scaled);
    const Exact overTie = scaled - below - static_cast<Exact>(0.5);
    const Exact rounding = scaled * static_cast<Exact>(exactBits >= 113 ? 0x1p-108 : 0x1p-60);
    const bool isTie = overTie <= rounding && -overTie <= rounding;
    return static_cast<std::uint8_t>(below + (isTie ? below % 2 : overTie > 0 ? 1 : 0));
}

// Whether the sRGB level of a linear value is above `level`: value >= the inverse curve at (level + 1/2) / 255. Both
// sides are raised to the fifth power, so that no root is needed.
inline bool isAboveSrgbLevel(Exact value, int level)
{
    const Exact s = static_cast<Exact>(2 * level + 1) / 510;
    if (s * 100000 <= 4045)
        return value * 1292 >= s * 100;
    const Exact base = (s * 1000 + 55) / 1055;
    const Exact base4 = base * base * base * base;
    return value > 0 && value * value * value * value * value >= base4 * base4 * base4;
}

inline std::uint8_t toSrgb8(Exact value)
{
    int level = 0;
    for (int step = 128; step > 0; step /= 2)
        if (isAboveSrgbLevel(value, level + step - 1))
            level += step;
    return static_cast<std::uint8_t>(level);
}

// The distance of a and b in ulps: 0 for equal values (also 0 and -0) and for two NaNs.
inline std::int64_t ulpsBetween(float a, float b)
{
    if (std::isnan(a) || std::isnan(b))
        return std::isnan(a) && std::isnan(b) ? 0 : std::numeric_limits<std::int64_t>::max();
    const auto ordered = [](float value) {
        std::int32_t bits = 0;
        std::memcpy(&bits, &value, sizeof bits);
        return bits >= 0 ? std::int64_t{bits} : -std::int64_t{bits & 0x7fffffff};
    };
    const std::int64_t distance = ordered(a) - ordered(b);
    return distance < 0 ? -distance : distance;
}

// FNV-1a.
inline std::uint64_t hashOf(const void* data, std::size_t byteCount)
{
    const auto* bytes = static_cast<const unsigned char*>(data);
    std::uint64_t hash = 14695981039346656037u;
    for (std::size_t i = 0; i < byteCount; ++i)
        hash = (hash ^ bytes[i]) * 1099511628211u;
    return hash;
}

} // namespace dfb::testing
