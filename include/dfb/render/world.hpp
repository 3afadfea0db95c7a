// World: the bricks of data that this rank holds, each with an id and its bounds in space (section 5 of the
// paper).
#pragma once

#include <dfb/error.hpp>

#include <cmath>
#include <cstdint>
#include <unordered_set>
#include <vector>

DFB_NAMESPACE_BEGIN

struct Vec3 {
    float x = 0, y = 0, z = 0;
};

inline Vec3 operator+(const Vec3& a, const Vec3& b) noexcept { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(const Vec3& a, const Vec3& b) noexcept { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator*(float s, const Vec3& a) noexcept { return {s * a.x, s * a.y, s * a.z}; }
inline Vec3 operator*(const Vec3& a, float s) noexcept { return s * a; }
inline float dot(const Vec3& a, const Vec3& b) noexcept { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(const Vec3& a, const Vec3& b) noexcept
{
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline Vec3 normalize(const Vec3& a) noexcept { return (1.0f / std::sqrt(dot(a, a))) * a; }

// An axis-aligned box, in the user's unit of length. Renderers treat it as half-open, [lower, upper), so that two
// bricks that share a face share no point.
struct Box3 {
    Vec3 lower, upper;
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

// A convex region of space that overlaps no other brick, with what it holds. Camera rays see it within `bounds` only:
// renderers clip them to it. Its data may reach farther: ghost voxels, or geometry for shadows and ambient occlusion,
// which secondary rays see beyond the bounds as well.
struct Brick {
    std::uint32_t id = 0; // the same number: the same brick on any rank, with equal bounds in a SharedWorld
    Box3 bounds;
};

// The bricks of this rank; there may be none. While bricks are added, no other thread may use it.
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
