// Placement: from the coordinates of a file to the world. Clip: the part of a mesh or of spheres that is shown.
#pragma once

#include "file_look.hpp"
#include "text.hpp"
#include "vec.hpp"

#include <cmath>
#include <optional>
#include <string>

namespace example {

// From the coordinates of a file to the world.
struct Placement {
    Vec3 scale{1, 1, 1}; // of volumes: the sides of a voxel; else equal along all axes, except for the sign
    Vec3 offset;

    // The least and the greatest scale.
    float size() const { return std::min({std::fabs(scale.x), std::fabs(scale.y), std::fabs(scale.z)}); }
    float largest() const { return std::max({std::fabs(scale.x), std::fabs(scale.y), std::fabs(scale.z)}); }
    Vec3 toWorld(const Vec3& p) const
    {
        return {p.x * scale.x + offset.x, p.y * scale.y + offset.y, p.z * scale.z + offset.z};
    }
};

// Centres the box in [0, 1]^3 with its largest extent 1; the identity if `fit` is false, or if the extent of the box is
// 0 or too small for floats at its distance from 0.
inline Placement fitToUnitCube(const Box& box, bool fit)
{
    Placement placement;
    const float extent = box.largestExtent(), scale = 1 / extent;
    if (fit && extent > 0 && isUsable(box.lo * scale) && isUsable(box.hi * scale)) {
        placement.scale = {scale, scale, scale};
        placement.offset = Vec3{0.5f, 0.5f, 0.5f} - box.center() * scale;
    }
    return placement;
}

// A rotation about a point: by degrees about x, then y, then z.
class Rotation {
public:
    Rotation() = default; // none
    Rotation(const Vec3& degrees, const Vec3d& center) : isNone_(isZero(degrees)), center_(center)
    {
        for (int axis = 0; axis < 3 && !isNone_; ++axis) {
            const double angle = static_cast<double>(component(degrees, axis)) * (3.14159265358979323846 / 180.0);
            const int b = (axis + 1) % 3, c = (axis + 2) % 3;
            for (Vec3d& column : columns_) {
                const double u = component(column, b), v = component(column, c);
                component(column, b) = std::cos(angle) * u - std::sin(angle) * v;
                component(column, c) = std::sin(angle) * u + std::cos(angle) * v;
            }
        }
    }

    bool isNone() const { return isNone_; }
    Vec3d direction(const Vec3d& d) const { return columns_[0] * d.x + columns_[1] * d.y + columns_[2] * d.z; }
    Vec3d directionBack(const Vec3d& d) const
    {
        return {dot(columns_[0], d), dot(columns_[1], d), dot(columns_[2], d)};
    }
    Vec3d point(const Vec3d& p) const { return isNone_ ? p : center_ + direction(p - center_); }
    Vec3d pointBack(const Vec3d& p) const { return isNone_ ? p : center_ + directionBack(p - center_); }
    // The box around a box that has been rotated.
    Box box(const Box& b) const
    {
        return around(b, [this](const Vec3d& p) { return point(p); });
    }
    Box boxBack(const Box& b) const
    {
        return around(b, [this](const Vec3d& p) { return pointBack(p); });
    }

private:
    template <class Move>
    Box around(const Box& b, const Move& move) const
    {
        if (isNone_ || b.empty())
            return b;
        Box all;
        for (int i = 0; i < 8; ++i)
            all.grow(toFloat(move(toDouble(b.corner(i)))));
        return all;
    }

    bool isNone_ = true;
    Vec3d center_;
    Vec3d columns_[3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
};

// A placement, followed by what a FileLook adds: scale and rotation about the box's centre, then a translation.
class FileToWorld {
public:
    // `box`: of the file, in its own coordinates.
    FileToWorld(const Placement& fit, const Box& box, const FileLook& look)
        : fit_(fit), isPlaced_(look.isPlaced() && !box.empty()), scale_(static_cast<double>(look.scale)),
          translate_(toDouble(look.translate))
    {
        if (!isPlaced_)
            return;
        center_ = toDouble(fit.toWorld(box.center()));
        rotation_ = Rotation(look.rotate, center_);
    }

    float size() const { return fit_.size() * static_cast<float>(scale_); }
    Vec3 toWorld(const Vec3& p) const
    {
        const Vec3 world = fit_.toWorld(p);
        if (!isPlaced_)
            return world;
        return toFloat(rotation_.point(center_ + (toDouble(world) - center_) * scale_) + translate_);
    }
    // Depends on the point only.
    Vec3d toFile(const Vec3& world) const
    {
        Vec3d p = toDouble(world);
        if (isPlaced_)
            p = center_ + (rotation_.pointBack(p - translate_) - center_) * (1 / scale_);
        return (p - toDouble(fit_.offset)) * (1 / static_cast<double>(fit_.scale.x));
    }

private:
    Placement fit_; // of a mesh or spheres: the same along all axes
    bool isPlaced_;
    double scale_;
    Vec3d center_, translate_;
    Rotation rotation_;
};

// The part of an object that is shown: the points that lie in a box of its file's coordinates.
struct Clip {
    Box box;
    FileToWorld place;

    bool contains(const Vec3& world) const
    {
        const Vec3 p = toFloat(place.toFile(world));
        return p.x >= box.lo.x && p.x <= box.hi.x && p.y >= box.lo.y && p.y <= box.hi.y && p.z >= box.lo.z
               && p.z <= box.hi.z;
    }
};

inline std::optional<Clip> clipOf(const FileLook& look, const FileToWorld& place)
{
    return look.clip ? std::optional<Clip>(Clip{*look.clip, place}) : std::nullopt;
}

inline Vec3 clamped(const Vec3& p, const Box& box)
{
    return {std::clamp(p.x, box.lo.x, box.hi.x), std::clamp(p.y, box.lo.y, box.hi.y),
            std::clamp(p.z, box.lo.z, box.hi.z)};
}

inline std::string textOf(const Vec3& v) { return textOf(v.x) + ',' + textOf(v.y) + ',' + textOf(v.z); }

} // namespace example
