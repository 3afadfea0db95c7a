// Vec3: the library's vectors, boxes, and the few pure functions on them that every rank must compute to the same bit.
#pragma once

#include <dfb/render/world.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>

namespace example {

using dfb::toDouble;
using dfb::toFloat;
using dfb::Vec3;
using dfb::Vec3d;

inline float& component(Vec3& v, std::size_t axis) { return axis == 0 ? v.x : axis == 1 ? v.y : v.z; }
inline float component(const Vec3& v, std::size_t axis) { return axis == 0 ? v.x : axis == 1 ? v.y : v.z; }
inline float length(const Vec3& a) { return std::sqrt(dot(a, a)); }

inline double length(const Vec3d& a) { return std::sqrt(dot(a, a)); }

inline double& component(Vec3d& v, std::size_t axis) { return axis == 0 ? v.x : axis == 1 ? v.y : v.z; }

// The zero vector stays the zero vector.
inline Vec3d unit(const Vec3d& a)
{
    const double l = length(a);
    return l > 0 ? a * (1 / l) : a;
}
inline Vec3 unit(const Vec3& a)
{
    const float l = length(a);
    return l > 0 ? a * (1 / l) : a;
}
inline bool isZero(const Vec3& a) { return a == Vec3(); }
// Finite, and small enough for squares and sums of such.
inline bool isUsable(const Vec3& a)
{
    return std::fabs(a.x) < 1e15f && std::fabs(a.y) < 1e15f && std::fabs(a.z) < 1e15f;
}

// a * b + c, rounded the same way wherever it is inlined: once where the target has the instruction (the compiler
// might otherwise contract in one place and not in another), twice where it has not and so cannot contract.
inline float mulAdd(float a, float b, float c)
{
#if defined(__FMA__) || defined(__FP_FAST_FMAF) || defined(__ARM_FEATURE_FMA)
    return std::fma(a, b, c);
#else
    return a * b + c;
#endif
}

// The point of a ray at distance t. Monotone in t along each axis, so that a ray is inside a cell for one unbroken
// range of t: bricks that own points by this function never interleave along a ray.
inline Vec3 pointAt(const Vec3& origin, const Vec3& direction, float t)
{
    return {mulAdd(t, direction.x, origin.x), mulAdd(t, direction.y, origin.y), mulAdd(t, direction.z, origin.z)};
}

struct Box {
    Vec3 lo{std::numeric_limits<float>::infinity(), std::numeric_limits<float>::infinity(),
            std::numeric_limits<float>::infinity()};
    Vec3 hi{-std::numeric_limits<float>::infinity(), -std::numeric_limits<float>::infinity(),
            -std::numeric_limits<float>::infinity()};

    bool empty() const { return !(lo.x <= hi.x && lo.y <= hi.y && lo.z <= hi.z); }
    Vec3 extent() const { return hi - lo; }
    Vec3 center() const { return (lo + hi) * 0.5f; }
    // Corner number `i` of 8.
    Vec3 corner(int i) const { return {i & 1 ? hi.x : lo.x, i & 2 ? hi.y : lo.y, i & 4 ? hi.z : lo.z}; }
    float largestExtent() const { return std::max({hi.x - lo.x, hi.y - lo.y, hi.z - lo.z}); }
    void grow(const Vec3& p, float radius = 0)
    {
        for (int i = 0; i < 3; ++i) {
            component(lo, i) = std::min(component(lo, i), component(p, i) - radius);
            component(hi, i) = std::max(component(hi, i), component(p, i) + radius);
        }
    }
    void grow(const Box& b)
    {
        if (!b.empty()) {
            grow(b.lo);
            grow(b.hi);
        }
    }
    // Half-open: of two cells that share a face, exactly one contains a point of it.
    bool contains(const Vec3& p) const
    {
        return p.x >= lo.x && p.x < hi.x && p.y >= lo.y && p.y < hi.y && p.z >= lo.z && p.z < hi.z;
    }
    bool overlaps(const Box& b) const
    {
        return lo.x <= b.hi.x && b.lo.x <= hi.x && lo.y <= b.hi.y && b.lo.y <= hi.y && lo.z <= b.hi.z && b.lo.z <= hi.z;
    }
    Box padded(float amount) const
    {
        const Vec3 pad{amount, amount, amount};
        Box box;
        box.lo = lo - pad;
        box.hi = hi + pad;
        return box;
    }
};

inline bool operator==(const Box& a, const Box& b) { return a.lo == b.lo && a.hi == b.hi; }

inline Box intersection(const Box& a, const Box& b)
{
    Box box;
    for (int i = 0; i < 3; ++i) {
        component(box.lo, i) = std::max(component(a.lo, i), component(b.lo, i));
        component(box.hi, i) = std::min(component(a.hi, i), component(b.hi, i));
    }
    return box;
}

// The part of the world that a camera looks at.
struct Focus {
    Box box;
    float radius = 0; // of the ball around the box's centre that holds all that is visible
};

// splitmix64: a hash of 64 bits to 64 bits.
inline std::uint64_t hash64(std::uint64_t x)
{
    x += 0x9e3779b97f4a7c15u;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return x ^ (x >> 31);
}
inline std::uint64_t hash64(std::uint64_t a, std::uint64_t b) { return hash64(hash64(a) ^ b); }

// Uniform in [0, 1).
inline double unitReal(std::uint64_t hash) { return static_cast<double>(hash >> 11) * 0x1.0p-53; }

} // namespace example
