// Cameras beyond the pinhole: matrices, depth of field, stereo, domes, motion blur (section 4.2 of the paper). ray() is
// the ray through a point of the image; for some cameras it depends on sample numbers for lens and time. project() says
// which pixels a box may cover. Compute the sample numbers from pixel, sample and seed alone: then all bricks are seen
// along one ray. Each sample is a pass. Any thread may call any member, several at once.
//
// Points of the image are in pixels, pixel centres at .5; sample numbers are in [0, 1); angles in degrees.
#pragma once

#include <dfb/render/visibility.hpp>

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

DFB_NAMESPACE_BEGIN

// A camera as most toolkits have it, from a view matrix and a projection matrix: perspective, off-axis or orthographic.
//
// Matrices are 4x4, column by column, as OpenGL takes them: row r of column c is at [4 * c + r]. VTK's vtkMatrix4x4
// lies row by row: transpose it. Clip coordinates are as in OpenGL: -w to w is the image from left to right in x, and
// from its lowest row to its uppermost in y. The far plane cuts nothing off. The near plane cuts off orthographic rays
// only, which begin there.
class MatrixCamera {
public:
    // Each has 16 numbers. Throws InvalidArgument if one is not finite or the matrices make no image.
    MatrixCamera(const float* view, const float* projection)
    {
        for (int r = 0; r < 4; ++r) {
            double row[4] = {};
            for (int c = 0; c < 4; ++c)
                for (int k = 0; k < 4; ++k)
                    row[c] += static_cast<double>(projection[4 * k + r]) * static_cast<double>(view[4 * c + k]);
            rows_[r] = {{row[0], row[1], row[2]}, row[3]};
            if (!std::isfinite(row[0] + row[1] + row[2] + row[3]))
                detail::failArgument("the camera's matrices have numbers that are not finite");
        }
        isOrthographic_ = !(detail::length(rows_[3].normal) > 0);
        if (isOrthographic_ && rows_[3].offset < 0)
            for (Plane& row : rows_)
                row = {-1 * row.normal, -row.offset};
        const Plane &x = rows_[0], &y = rows_[1], &last = isOrthographic_ ? rows_[2] : rows_[3];
        const double volume = dot(cross(x.normal, y.normal), last.normal),
                     size = detail::length(x.normal) * detail::length(y.normal) * detail::length(last.normal);
        if (!(std::fabs(volume) > 1e-12 * size) || (isOrthographic_ && !(rows_[3].offset > 0)))
            detail::failArgument("the camera's matrices are singular: they make no image");
        if (!isOrthographic_)
            eye_ = meetingPoint(x, y, last);
        // An orthographic camera looks along -z of its view.
        const Vec3d ahead = isOrthographic_ ? Vec3d{-view[2], -view[6], -view[10]} : last.normal;
        side_ = dot(cross(x.normal, y.normal), ahead) < 0 ? -1 : 1;
    }

    // Whether all rays have one direction.
    bool isOrthographic() const noexcept { return isOrthographic_; }

    // The point where all rays begin. It has no meaning for an orthographic camera.
    Vec3 eye() const noexcept { return toFloat(eye_); }
    // See dfb/render/visibility.hpp.
    std::optional<Vec3> commonEye() const
    {
        if (!isOrthographic_)
            return eye();
        const auto from = [](float direction) {
            using Limits = std::numeric_limits<float>;
            return direction == 0 ? Limits::quiet_NaN() : std::copysign(Limits::infinity(), -direction);
        };
        const Vec3 d = ray(0, 0, 1, 1).direction;
        return Vec3{from(d.x), from(d.y), from(d.z)};
    }

    // The ray through a point of the image. It begins at the eye, or for an orthographic camera at the near plane.
    Ray ray(double x, double y, int width, int height, const LensSample& = {}) const
    {
        const Plane column = through(rows_[0], 2 * x / width - 1), row = through(rows_[1], 1 - 2 * y / height);
        const Vec3d direction = side_ * normalize(cross(column.normal, row.normal));
        if (!isOrthographic_)
            return {eye(), toFloat(direction)};
        return {toFloat(meetingPoint(column, row, nearPlane())), toFloat(direction)};
    }

    // Returns the pixels that the box may cover: all if it reaches behind the eye, none if all of it is behind.
    Footprint project(const Box3& bounds, int width, int height) const
    {
        const Plane& w = rows_[3];
        const double pixels = 0.5
                              * std::max(detail::length(rows_[0].normal) * width,
                                         detail::length(rows_[1].normal) * height); // per unit, times w
        const double unit = detail::length(w.normal); // w at distance 1; 0 if orthographic
        return detail::footprintOf(bounds, width, height, [&](const Vec3d& p) {
            const Vec3d d = p - eye_;
            const double depth = w.at(p);
            const double way = isOrthographic_ ? std::fabs(nearPlane().at(p)) / detail::length(nearPlane().normal) : 0;
            const double largest = detail::length(p) + detail::length(eye_) + 2 * way;
            return detail::SeenCorner{
                depth,
                unit * (1e-6 * (std::fabs(d.x) + std::fabs(d.y) + std::fabs(d.z)) + 1e-7 * largest),
                {0.5 * width * (1 + rows_[0].at(p) / depth), 0.5 * height * (1 - rows_[1].at(p) / depth)},
                (5e-7 * largest + 2e-7 * unit * dot(d, d) / depth) * pixels / depth};
        });
    }

private:
    // The points p with dot(normal, p) + offset == 0; also a row of a matrix.
    struct Plane {
        Vec3d normal;
        double offset = 0;

        double at(const Vec3d& p) const { return dot(normal, p) + offset; }
    };

    // The plane where `row` is `k` times w.
    Plane through(const Plane& row, double k) const
    {
        return {row.normal - k * rows_[3].normal, row.offset - k * rows_[3].offset};
    }
    Plane nearPlane() const { return through(rows_[2], -1); }

    static Vec3d meetingPoint(const Plane& a, const Plane& b, const Plane& c)
    {
        const Vec3d ab = cross(a.normal, b.normal), bc = cross(b.normal, c.normal), ca = cross(c.normal, a.normal);
        return (-1 / dot(a.normal, bc)) * (a.offset * bc + b.offset * ca + c.offset * ab);
    }

    Plane rows_[4]; // of the product of both matrices: x, y, z, w
    Vec3d eye_;
    double side_ = 1;
    bool isOrthographic_ = false;
};

// Depth of field. Points at `focusDistance` along the view are sharp; `apertureRadius` is the radius of the lens. Both
// are in units of the world.
class ThinLensCamera {
public:
    // As PerspectiveCamera::along(). The distance may be infinite. Also throws InvalidArgument if the radius is below 0
    // or the distance is not above 0.
    ThinLensCamera(const Vec3& eye, const Vec3& view, const Vec3& up, float fovY, float apertureRadius,
                   float focusDistance)
        : pose_(detail::poseOf(eye, view, up, fovY)), radius_(static_cast<double>(apertureRadius)),
          focus_(static_cast<double>(focusDistance))
    {
        if (!(radius_ >= 0) || !std::isfinite(radius_) || !(focus_ > 0))
            detail::failArgument("a lens has a radius of 0 or more and is focused at a distance above 0");
    }

    Ray ray(double x, double y, int width, int height, const LensSample& sample) const
    {
        const double r = radius_ * std::sqrt(sample.lensU), angle = 2 * detail::pi * sample.lensV;
        const Vec3d onLens = r * std::cos(angle) * pose_.right + r * std::sin(angle) * pose_.up;
        const Vec3d direction = pose_.through(x, y, width, height) - (1 / focus_) * onLens;
        return {toFloat(pose_.eye + onLens), toFloat(normalize(direction))};
    }

    Footprint project(const Box3& bounds, int width, int height) const
    {
        return detail::projectBox(bounds, pose_, width, height, 0, radius_, focus_);
    }

private:
    detail::Pose pose_;
    double radius_, focus_;
};

// Two eyes side by side: each half of the image shows the view of the eye on that side. The eyes are `separation`
// apart, in units of the world. A point at `convergence` along the view is at the same place in both halves.
class StereoCamera {
public:
    // As PerspectiveCamera::along(); `fovY` is that of each half. `convergence` may be infinite: the eyes then look in
    // parallel. Also throws InvalidArgument if `separation` is below 0 or `convergence` is not above 0.
    StereoCamera(const Vec3& eye, const Vec3& view, const Vec3& up, float fovY, float separation, float convergence)
        : pose_(detail::poseOf(eye, view, up, fovY)), separation_(static_cast<double>(separation)),
          convergence_(static_cast<double>(convergence))
    {
        if (!(separation_ >= 0) || !std::isfinite(separation_) || !(convergence_ > 0))
            detail::failArgument("eyes are 0 or more apart and converge at a distance above 0");
    }

    Ray ray(double x, double y, int width, int height, const LensSample& = {}) const
    {
        const bool right = x >= 0.5 * width;
        const double scale = 2 * pose_.tangent / height, offset = right ? 0.5 * separation_ : -0.5 * separation_;
        const double u = (x - (right ? 0.75 : 0.25) * width) * scale, v = (0.5 * height - y) * scale;
        const Vec3d aside = offset * pose_.right;
        const Vec3d to = pose_.forward + u * pose_.right + v * pose_.up;
        return {toFloat(pose_.eye + aside), toFloat(normalize(to - (1 / convergence_) * aside))};
    }

    // Returns a footprint for each eye, in its half of the image.
    std::vector<Footprint> project(const Box3& bounds, int width, int height) const
    {
        const double scale = 0.5 * height / pose_.tangent;
        std::vector<Footprint> both;
        for (const double side : {-1.0, 1.0}) {
            detail::Pose pose = pose_;
            const double offset = 0.5 * side * separation_;
            pose.eye = pose_.eye + offset * pose_.right;
            both.push_back(
                detail::projectBox(bounds, pose, width, height, side * 0.25 * width + scale * offset / convergence_));
            both.back().cut(side < 0 ? Region{0, 0, (width + 1) / 2, height} : Region{width / 2, 0, width, height});
        }
        return both;
    }

private:
    detail::Pose pose_;
    double separation_, convergence_;
};

// An equidistant fisheye for domes. It shows a circle as large as fits into the image. The centre of the circle is
// along the view, its border is `angle` / 2 off the view, and nothing is seen outside.
class DomeCamera {
public:
    // Throws InvalidArgument for an angle that is not in (0, 360] degrees, if `view` is 0 or `up` is 0 or along it, or
    // if a number is not finite.
    DomeCamera(const Vec3& eye, const Vec3& view, const Vec3& up, float angle = 180)
        : pose_(detail::poseOf(eye, view, up)), border_(0.5 * static_cast<double>(angle) * detail::pi / 180)
    {
        if (!(angle > 0 && angle <= 360))
            detail::failArgument("a dome covers an angle in (0, 360] degrees");
    }

    Ray ray(double x, double y, int width, int height, const LensSample& = {}) const
    {
        const double radius = 0.5 * std::min(width, height), px = (x - 0.5 * width) / radius,
                     py = (0.5 * height - y) / radius, r = std::hypot(px, py);
        if (r > 1)
            return {toFloat(pose_.eye), {0, 0, 0}};
        const double angle = r * border_, aside = r > 0 ? std::sin(angle) / r : 0;
        const Vec3d d = std::cos(angle) * pose_.forward + px * aside * pose_.right + py * aside * pose_.up;
        return {toFloat(pose_.eye), toFloat(normalize(d))};
    }

    std::optional<Vec3> commonEye() const { return toFloat(pose_.eye); }

    // Returns an octagon around the image of a sphere around the box. Returns the whole image if the eye is in the
    // sphere or the box is near the point behind the eye, and nothing if the box is outside the dome. Distances along a
    // radius of the image are proportional to angles. Distances across the radius, at the angle theta off the view, are
    // stretched by theta / sin(theta).
    Footprint project(const Box3& bounds, int width, int height) const
    {
        const Vec3d lower = detail::cornerOf(bounds, 0), upper = detail::cornerOf(bounds, 7);
        const Vec3d to = 0.5 * (lower + upper) - pose_.eye;
        const double sphere = 0.5 * detail::length(upper - lower)
                              + 1e-6 * (detail::length(upper) + detail::length(pose_.eye)),
                     distance = detail::length(to);
        if (distance <= sphere)
            return Footprint::whole(width, height);
        const double half = std::asin(sphere / distance), x = dot(to, pose_.right), y = dot(to, pose_.up),
                     theta = std::atan2(std::hypot(x, y), dot(to, pose_.forward)), farthest = theta + half;
        if (theta - half > border_)
            return {};
        if (farthest > 2.6) // near the point behind the eye, which is stretched to a circle
            return Footprint::whole(width, height);
        const double scale = 0.5 * std::min(width, height) / border_, aside = std::hypot(x, y);
        const double cx = 0.5 * width + (aside > 0 ? scale * theta * x / aside : 0),
                     cy = 0.5 * height - (aside > 0 ? scale * theta * y / aside : 0);
        const double r = scale * half * std::max(1.0, farthest / std::sin(farthest));
        std::vector<PixelPoint> octagon;
        for (int i = 0; i < 8; ++i)
            octagon.push_back({cx + r / std::cos(detail::pi / 8) * std::cos((i + 0.5) * detail::pi / 4),
                               cy + r / std::cos(detail::pi / 8) * std::sin((i + 0.5) * detail::pi / 4)});
        return Footprint(std::move(octagon), 0.125, width, height);
    }

private:
    detail::Pose pose_;
    double border_;
};

// Motion blur of a camera that turns around an axis while the shutter is open: by `degrees` from sample time 0 to 1.
class OrbitBlurCamera {
public:
    // At time 0 it is as PerspectiveCamera::along(); the axis goes through `center`. Also throws InvalidArgument if the
    // axis has length 0 or `degrees` is not within +-360.
    OrbitBlurCamera(const Vec3& eye, const Vec3& view, const Vec3& up, float fovY, const Vec3& center, const Vec3& axis,
                    float degrees)
        : pose_(detail::poseOf(eye, view, up, fovY)), center_(toDouble(center)), axis_(toDouble(axis)),
          angle_(static_cast<double>(degrees) * detail::pi / 180)
    {
        const double length = detail::length(axis_);
        if (!(length > 0) || !std::isfinite(length + detail::length(center_)) || !(std::fabs(angle_) <= 2 * detail::pi))
            detail::failArgument("the camera turns around an axis, by a full turn at most");
        axis_ = normalize(axis_);
    }

    Ray ray(double x, double y, int width, int height, const LensSample& sample) const
    {
        const detail::Pose pose = at(sample.time);
        return {toFloat(pose.eye), toFloat(normalize(pose.through(x, y, width, height)))};
    }

    // Returns a footprint for each of some parts of the time that the shutter is open. If the camera turns, the image
    // moves as if the world turned the other way. So a point at distance rho from the axis is never farther from its
    // place in the middle of a part than rho times half the part's angle.
    std::vector<Footprint> project(const Box3& bounds, int width, int height) const
    {
        double rho = 0;
        for (int corner = 0; corner < 8; ++corner)
            rho = std::max(rho, detail::length(cross(detail::cornerOf(bounds, corner) - center_, axis_)));
        const int parts = 1 + static_cast<int>(std::fabs(angle_) * 32);
        const auto pad = static_cast<float>(rho * 0.5 * std::fabs(angle_) / parts * 1.000001);
        const Box3 padded{bounds.lower - Vec3{pad, pad, pad}, bounds.upper + Vec3{pad, pad, pad}};
        std::vector<Footprint> all;
        for (int i = 0; i < parts; ++i)
            all.push_back(detail::projectBox(padded, at((i + 0.5) / parts), width, height));
        return all;
    }

private:
    Vec3d turned(const Vec3d& v, double angle) const // Rodrigues
    {
        return std::cos(angle) * v + std::sin(angle) * cross(axis_, v) + (1 - std::cos(angle)) * dot(axis_, v) * axis_;
    }
    detail::Pose at(double time) const
    {
        const double angle = angle_ * time;
        return {center_ + turned(pose_.eye - center_, angle), turned(pose_.forward, angle), turned(pose_.right, angle),
                turned(pose_.up, angle), pose_.tangent};
    }

    detail::Pose pose_;
    Vec3d center_, axis_;
    double angle_;
};

DFB_NAMESPACE_END
