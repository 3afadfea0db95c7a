// World: the bricks of data that this rank holds, each with an id and its bounds in space (section 5 of the
// paper).
#pragma once

#include <dfb/error.hpp>

#include <cmath>
#include <cstdint>
#include <unordered_set>
#include <vector>

DFB_NAMESPACE_BEGIN

// Three coordinates. Real: float or double.
template <class Real>
struct Vector3 {
    Real x = 0, y = 0, z = 0;

    friend Vector3 operator+(const Vector3& a, const Vector3& b) noexcept { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
    friend Vector3 operator-(const Vector3& a, const Vector3& b) noexcept { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
    friend Vector3 operator*(Real s, const Vector3& a) noexcept { return {s * a.x, s * a.y, s * a.z}; }
    friend Vector3 operator*(const Vector3& a, Real s) noexcept { return s * a; }
    friend bool operator==(const Vector3& a, const Vector3& b) noexcept
    {
        return a.x == b.x && a.y == b.y && a.z == b.z;
    }
};
using Vec3 = Vector3<float>;
using Vec3d = Vector3<double>;

template <class Real>
Real dot(const Vector3<Real>& a, const Vector3<Real>& b) noexcept
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class Real>
Vector3<Real> cross(const Vector3<Real>& a, const Vector3<Real>& b) noexcept
{
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class Real>
Vector3<Real> normalize(const Vector3<Real>& a) noexcept
{
    return (1 / std::sqrt(dot(a, a))) * a;
}
inline Vec3d toDouble(const Vec3& v) noexcept { return {v.x, v.y, v.z}; }
inline Vec3 toFloat(const Vec3d& v) noexcept
{
    return {static_cast<float>(v.x), static_cast<float>(v.y), static_cast<float>(v.z)};
}

// An axis-aligned box, in the user's unit of length. Your renderer must treat it as half-open, [lower, upper), so
// that a point on a face that two bricks share is drawn once.
struct Box3 {
    Vec3 lower, upper;

    friend bool operator==(const Box3& a, const Box3& b) noexcept { return a.lower == b.lower && a.upper == b.upper; }
};

namespace detail {

// Finite, and lower <= upper.
inline bool isBox(const Box3& b) noexcept
{
    const auto ordered = [](float lower, float upper) {
        return std::isfinite(lower) && std::isfinite(upper) && lower <= upper;
    };
    return ordered(b.lower.x, b.upper.x) && ordered(b.lower.y, b.upper.y) && ordered(b.lower.z, b.upper.z);
}

} // namespace detail

// A region of space, with the data in it. It is convex and overlaps no other brick, except in a DeepParallelLoop.
// Renderers clip camera rays to `bounds`. Its data may reach farther: ghost voxels, or geometry for shadows and ambient
// occlusion, which secondary rays see beyond the bounds, too.
struct Brick {
    std::uint32_t id = 0; // equal on two ranks: the same brick, whose bounds must be equal in a SharedWorld
    Box3 bounds;
};

// The bricks of this rank; there may be none. Any thread may read it, but not while bricks are added.
class World {
public:
    World() = default;
    // Throws as add() does.
    explicit World(const std::vector<Brick>& bricks)
    {
        for (const Brick& brick : bricks)
            add(brick);
    }

    // Throws InvalidArgument for bounds that are not finite or have lower > upper, and an id that this rank has
    // already.
    void add(const Brick& brick)
    {
        if (!detail::isBox(brick.bounds))
            detail::failArgument("the bounds of brick %u are not a box", brick.id);
        if (!ids_.insert(brick.id).second)
            detail::failArgument("brick %u was added twice", brick.id);
        bricks_.push_back(brick);
    }

    const std::vector<Brick>& bricks() const noexcept { return bricks_; }

private:
    std::vector<Brick> bricks_;
    std::unordered_set<std::uint32_t> ids_;
};

DFB_NAMESPACE_END
