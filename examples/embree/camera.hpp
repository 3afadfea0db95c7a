// Camera: a view that orbits around the scene, one position per frame, with or without a lens, motion, two eyes, a
// dome.
#pragma once

#include "vec.hpp"

#include <dfb/render/cameras.hpp>

#include <optional>
#include <variant>
#include <vector>

namespace example {

enum class CameraKind { Perspective, DepthOfField, MotionBlur, Stereo, Dome };

// What the user chooses about the view; angles in degrees, lengths in units of the largest extent of what there is to
// see.
struct View {
    float azimuth = 30;            // around the y axis, from +z towards +x
    float elevation = 20;          // above the xz plane
    float fieldOfView = 35;        // full vertical angle
    std::optional<float> distance; // from the centre of what there is to see; none: so that all of it is in the image
    CameraKind kind = CameraKind::Perspective;
    float aperture = 0.05f;  // radius of the lens
    float focus = 0;         // distance of what is sharp; 0: the centre
    float shutter = 8;       // degrees that the camera goes on along its orbit while the shutter is open
    float separation = 0.1f; // of the eyes
    float domeAngle = 180;
};

// Where the camera is and what it sees, with rays in double.
struct Pose {
    Vec3 origin;
    Vec3 forward, right, up; // orthonormal
    float tanHalfFov = 0;    // of the vertical angle
    float aspect = 1;        // width / height

    // Unit direction through the point (x, y) of an image of the given size, in pixels from the upper left corner.
    Vec3 direction(double x, double y, int width, int height) const
    {
        const double sx = (2.0 * x / width - 1.0) * static_cast<double>(tanHalfFov) * static_cast<double>(aspect);
        const double sy = (1.0 - 2.0 * y / height) * static_cast<double>(tanHalfFov);
        return rounded(unit(Vec3d(forward) + Vec3d(right) * sx + Vec3d(up) * sy));
    }
};

namespace detail {
inline constexpr double degree = 3.14159265358979323846 / 180.0;
}

// From the centre of the focus to the camera, in world space.
inline double cameraDistance(const Focus& focus, const View& view, int width, int height)
{
    const double unit = static_cast<double>(focus.box.largestExtent());
    if (view.distance)
        return static_cast<double>(*view.distance) * unit;
    // The ball touches the sides of the smaller angle of view, but for a margin.
    double angle = 0.5 * static_cast<double>(view.fieldOfView) * detail::degree;
    double radius = static_cast<double>(focus.radius);
    const auto narrowTo = [&](double aspect) { angle = std::atan(std::tan(angle) * std::min(1.0, aspect)); };
    const double aspect = static_cast<double>(width) / height;
    switch (view.kind) {
    case CameraKind::Perspective:
    case CameraKind::MotionBlur: narrowTo(aspect); break;
    case CameraKind::DepthOfField: // seen from the lens's rim: room for how far that is from the middle
        narrowTo(aspect);
        radius += static_cast<double>(view.aperture) * unit;
        break;
    case CameraKind::Stereo: // likewise from an eye, which has half of the image
        narrowTo(0.5 * aspect);
        radius += 0.5 * static_cast<double>(view.separation) * unit;
        break;
    case CameraKind::Dome: // its circle is as wide as it is high
        angle = std::min(angle, 0.5 * static_cast<double>(view.domeAngle) * detail::degree);
        break;
    }
    return std::min(1.02 * radius / std::sin(angle), 1000 * unit); // farther away distances have too few digits
}

// The camera of frame `frame` of `frameCount`: a full turn around the centre of `focus` in `frameCount` frames.
// y is up.
inline Pose orbitPose(const Focus& focus, const View& view, int frame, int frameCount, int width, int height)
{
    using detail::degree;
    const double azimuth = (static_cast<double>(view.azimuth) + 360.0 * frame / std::max(1, frameCount)) * degree;
    const double elevation = std::clamp(static_cast<double>(view.elevation), -89.9, 89.9) * degree;
    const Vec3d outward(std::cos(elevation) * std::sin(azimuth), std::sin(elevation),
                        std::cos(elevation) * std::cos(azimuth));
    const Vec3d forward = outward * -1.0;
    const Vec3d right = unit(cross(forward, Vec3d(0, 1, 0)));
    Pose camera;
    camera.origin = rounded(Vec3d(focus.box.center()) + outward * cameraDistance(focus, view, width, height));
    camera.forward = rounded(forward);
    camera.right = rounded(right);
    camera.up = rounded(cross(right, forward));
    camera.tanHalfFov = static_cast<float>(std::tan(0.5 * static_cast<double>(view.fieldOfView) * degree));
    camera.aspect = static_cast<float>(width) / static_cast<float>(height);
    return camera;
}

// A camera of any kind at one frame: its rays, and for the library, where boxes project to.
class FrameCamera {
public:
    FrameCamera(const Focus& focus, const View& view, int frame, int frameCount, int width, int height)
        : pose_(orbitPose(focus, view, frame, frameCount, width, height)), width_(width), height_(height),
          pinhole_(dfb::PerspectiveCamera::along(pose_.origin, pose_.forward, pose_.up, view.fieldOfView))
    {
        const float unit = focus.box.largestExtent();
        const auto orOne = [](float v) { return v > 0 ? v : 1.0f; }; // of a scene without extent
        const float sharp =
            orOne(view.focus > 0 ? view.focus * unit : static_cast<float>(cameraDistance(focus, view, width, height)));
        const Vec3 eye = pose_.origin, forward = pose_.forward, up = pose_.up;
        switch (view.kind) {
        case CameraKind::Perspective: break;
        case CameraKind::DepthOfField:
            lens_ = dfb::ThinLensCamera(eye, forward, up, view.fieldOfView, view.aperture * unit, sharp);
            break;
        case CameraKind::MotionBlur:
            lens_ =
                dfb::OrbitBlurCamera(eye, forward, up, view.fieldOfView, focus.box.center(), {0, 1, 0}, view.shutter);
            break;
        case CameraKind::Stereo:
            lens_ = dfb::StereoCamera(eye, forward, up, view.fieldOfView, view.separation * unit, sharp);
            break;
        case CameraKind::Dome: lens_ = dfb::DomeCamera(eye, forward, up, view.domeAngle); break;
        }
    }

    const Pose& pose() const { return pose_; }

    // The ray through a point of the image, in pixels; false where the camera sees nothing.
    bool ray(double x, double y, const dfb::LensSample& sample, Vec3& origin, Vec3& direction) const
    {
        return std::visit(
            [&](const auto& lens) {
                if constexpr (std::is_same_v<std::decay_t<decltype(lens)>, std::monostate>) {
                    origin = pose_.origin;
                    direction = pose_.direction(x, y, width_, height_);
                    return true;
                } else {
                    const dfb::Ray ray = lens.ray(x, y, width_, height_, sample);
                    origin = ray.origin;
                    direction = ray.direction;
                    return dot(direction, direction) > 0;
                }
            },
            lens_);
    }

    std::vector<dfb::Footprint> project(const dfb::Box3& bounds, int width, int height) const
    {
        return std::visit(
            [&](const auto& lens) {
                if constexpr (std::is_same_v<std::decay_t<decltype(lens)>, std::monostate>)
                    return std::vector<dfb::Footprint>{pinhole_.project(bounds, width, height)};
                else
                    return listOf(lens.project(bounds, width, height));
            },
            lens_);
    }

private:
    static std::vector<dfb::Footprint> listOf(std::vector<dfb::Footprint> all) { return all; }
    static std::vector<dfb::Footprint> listOf(dfb::Footprint one) { return {std::move(one)}; }

    Pose pose_;
    int width_, height_;
    dfb::PerspectiveCamera pinhole_;
    std::variant<std::monostate, dfb::ThinLensCamera, dfb::OrbitBlurCamera, dfb::StereoCamera, dfb::DomeCamera> lens_;
};

} // namespace example
