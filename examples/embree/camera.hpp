// Camera: a view that orbits around the scene, with one position per frame. It may have a lens, motion blur, two eyes
// or a dome.
#pragma once

#include "vec.hpp"

#include <dfb/render/cameras.hpp>

#include <cstdint>
#include <optional>
#include <variant>
#include <vector>

namespace example {

enum class CameraKind { Perspective, DepthOfField, MotionBlur, Stereo, Dome };

// The user's choice of view. Angles are in degrees, lengths in units of the largest extent of the visible scene, points
// in the coordinates of the world.
struct View {
    float azimuth = 30;            // around the axis `up`: with y up from +z towards +x, with z up from -y towards +x,
                                   // with -z up from +y towards +x
    float elevation = 20;          // above the plane at right angles to `up`
    float fieldOfView = 35;        // full vertical angle, before `zoom`
    float zoom = 1;                // magnification of the image, from the same place
    Vec3 up{0, 1, 0};              // of any length except 0
    bool isUpGiven = false;        // if false, the scene may decide
    std::optional<Vec3> eye;       // none: from azimuth, elevation and distance
    std::optional<Vec3> target;    // none: the centre of all that is visible
    std::optional<float> distance; // from the target; none: so that all that is visible is in the image
    CameraKind kind = CameraKind::Perspective;
    float aperture = 0.05f;  // radius of the lens
    float focus = 0;         // distance of what is sharp; 0: that of the target
    float shutter = 8;       // degrees of its orbit that the camera moves on while the shutter is open
    float separation = 0.1f; // of the eyes
    float domeAngle = 180;
};

struct RenderSettings {
    int width = 1024, height = 1024; // of the image, in pixels
    int frames = 1;                  // of one turn of the camera
    int passes = 1;                  // samples per pixel
    std::uint64_t seed = 1;
    int aoRays = 0;             // for ambient occlusion, per hit of a surface or sphere; 0: none
    float aoDistance = 0.1f;    // how far they look, in units of the scene's largest extent
    bool shadows = false;       // of the light, also up to aoDistance
    int pathBounces = 0;        // above 0: surfaces and spheres are opaque and lit by the sky, over this many bounces
    float opacity = 1;          // of a surface or sphere
    float earlyTermination = 0; // a ray ends when less than this passes through it; 0: when nothing does
    View view;
};

namespace detail {
inline constexpr double degree = 3.14159265358979323846 / 180.0;

// The axes of the orbit: up, and at right angles to it the directions of azimuth 0 (front) and azimuth 90 (side).
struct OrbitAxes {
    Vec3d up, front, side;

    explicit OrbitAxes(const View& view) : up(unit(toDouble(view.up)))
    {
        const Vec3d towards = std::fabs(up.z) > 0.9 ? Vec3d{0, up.z > 0 ? -1.0 : 1.0, 0} : Vec3d{0, 0, 1};
        front = unit(towards - up * dot(towards, up));
        side = cross(up, front);
    }
};
} // namespace detail

// The full vertical angle of the image, in degrees.
inline float shownAngle(const View& view)
{
    if (view.zoom == 1)
        return view.fieldOfView;
    const double half =
        std::tan(0.5 * static_cast<double>(view.fieldOfView) * detail::degree) / static_cast<double>(view.zoom);
    return static_cast<float>(2 * std::atan(half) / detail::degree);
}

// Returns the point that the camera looks at.
inline Vec3 targetOf(const Focus& focus, const View& view) { return view.target ? *view.target : focus.box.center(); }

// The distance from the target to the camera, in world space.
inline double cameraDistance(const Focus& focus, const View& view, int width, int height)
{
    const Vec3 target = targetOf(focus, view);
    if (view.eye)
        return length(toDouble(*view.eye) - toDouble(target));
    const double unit = static_cast<double>(focus.box.largestExtent());
    if (view.distance)
        return static_cast<double>(*view.distance) * unit;
    // The ball around all that is visible touches the sides of the smaller angle of view, except for a margin.
    double angle = 0.5 * static_cast<double>(view.fieldOfView) * detail::degree;
    double radius = static_cast<double>(focus.radius) + static_cast<double>(length(target - focus.box.center()));
    const auto narrowTo = [&](double aspect) { angle = std::atan(std::tan(angle) * std::min(1.0, aspect)); };
    const double aspect = static_cast<double>(width) / height;
    switch (view.kind) {
    case CameraKind::Perspective:
    case CameraKind::MotionBlur: narrowTo(aspect); break;
    case CameraKind::DepthOfField: // leaves room for the view from the rim of the lens
        narrowTo(aspect);
        radius += static_cast<double>(view.aperture) * unit;
        break;
    case CameraKind::Stereo: // likewise from each eye, which has half of the image
        narrowTo(0.5 * aspect);
        radius += 0.5 * static_cast<double>(view.separation) * unit;
        break;
    case CameraKind::Dome: // its circle is as wide as it is high
        angle = std::min(angle, 0.5 * static_cast<double>(view.domeAngle) * detail::degree);
        break;
    }
    return std::min(1.02 * radius / std::sin(angle), 1000 * unit); // farther away, floats have too few digits
}

// Returns the view with azimuth, elevation and distance instead of the eye.
inline View withoutEye(const Focus& focus, View view)
{
    if (!view.eye)
        return view;
    const detail::OrbitAxes axes(view);
    const Vec3d arm = toDouble(*view.eye) - toDouble(targetOf(focus, view));
    const double far = length(arm);
    if (far > 0) {
        view.elevation = static_cast<float>(std::asin(std::clamp(dot(arm, axes.up) / far, -1.0, 1.0)) / detail::degree);
        view.azimuth = static_cast<float>(std::atan2(dot(arm, axes.side), dot(arm, axes.front)) / detail::degree);
    }
    view.distance = static_cast<float>(far / static_cast<double>(focus.box.largestExtent()));
    view.eye.reset();
    return view;
}

// A camera of any kind at one frame: its rays, and for the library, the part of the image that a box covers.
class FrameCamera {
public:
    // Frame `frame` of `frameCount` frames, which make a full turn around the target. Throws dfb::InvalidArgument if
    // the eye is where the target is.
    FrameCamera(const Focus& focus, const View& view, int frame, int frameCount, int width, int height)
        : FrameCamera(focus, view, orbit(focus, view, frame, frameCount, width, height), width, height)
    {
    }

    // The camera without its lens.
    const dfb::PerspectiveCamera& pinhole() const { return pinhole_; }

    // The point where all rays begin, if there is one.
    std::optional<Vec3> commonEye() const
    {
        const bool isOne =
            std::holds_alternative<dfb::PerspectiveCamera>(camera_) || std::holds_alternative<dfb::DomeCamera>(camera_);
        return isOne ? pinhole_.commonEye() : std::nullopt;
    }

    // The ray through a point of the image, in pixels; its direction is 0 where the camera sees nothing.
    dfb::Ray ray(double x, double y, const dfb::LensSample& sample) const
    {
        return std::visit([&](const auto& camera) { return camera.ray(x, y, width_, height_, sample); }, camera_);
    }

    std::vector<dfb::Footprint> project(const dfb::Box3& bounds, int width, int height) const
    {
        return std::visit([&](const auto& camera) { return listOf(camera.project(bounds, width, height)); }, camera_);
    }

private:
    using AnyCamera = std::variant<dfb::PerspectiveCamera, dfb::ThinLensCamera, dfb::OrbitBlurCamera, dfb::StereoCamera,
                                   dfb::DomeCamera>;

    FrameCamera(const Focus& focus, const View& view, const dfb::PerspectiveCamera& pinhole, int width, int height)
        : width_(width), height_(height), pinhole_(pinhole),
          camera_(cameraOf(focus, view, pinhole, cameraDistance(focus, view, width, height)))
    {
    }

    static dfb::PerspectiveCamera orbit(const Focus& focus, const View& view, int frame, int frameCount, int width,
                                        int height)
    {
        using detail::degree;
        const detail::OrbitAxes axes(view);
        const Vec3d target = toDouble(targetOf(focus, view));
        const double turn = 360.0 * frame / std::max(1, frameCount);
        const float angle = shownAngle(view);
        if (view.eye) {
            const Vec3d arm = toDouble(*view.eye) - target, along = axes.up * dot(arm, axes.up);
            if (length(arm) == 0)
                throw dfb::InvalidArgument("--eye is where the camera looks: give another --target");
            const Vec3d outward =
                along + (arm - along) * std::cos(turn * degree) + cross(axes.up, arm) * std::sin(turn * degree);
            const bool isAlongUp = length(cross(axes.up, arm)) <= 1e-4 * length(arm);
            return dfb::PerspectiveCamera::along(frame == 0 ? *view.eye : toFloat(target + outward),
                                                 toFloat(outward * -1.0), toFloat(isAlongUp ? axes.front : axes.up),
                                                 angle);
        }
        const double azimuth = (static_cast<double>(view.azimuth) + turn) * degree;
        const double elevation = std::clamp(static_cast<double>(view.elevation), -89.9, 89.9) * degree;
        const Vec3d outward = axes.side * (std::cos(elevation) * std::sin(azimuth)) + axes.up * std::sin(elevation)
                              + axes.front * (std::cos(elevation) * std::cos(azimuth));
        const Vec3 eye = toFloat(target + outward * cameraDistance(focus, view, width, height));
        return dfb::PerspectiveCamera::along(eye, toFloat(outward * -1.0), toFloat(axes.up), angle);
    }

    static AnyCamera cameraOf(const Focus& focus, const View& view, const dfb::PerspectiveCamera& pinhole,
                              double distance)
    {
        const float unit = focus.box.largestExtent();
        const auto orOne = [](float v) { return v > 0 ? v : 1.0f; }; // of a scene without extent
        const float sharp = orOne(view.focus > 0 ? view.focus * unit : static_cast<float>(distance));
        const Vec3 eye = pinhole.eye(), forward = pinhole.forward(), up = pinhole.up();
        const float angle = shownAngle(view);
        switch (view.kind) {
        case CameraKind::Perspective: break;
        case CameraKind::DepthOfField: return dfb::ThinLensCamera(eye, forward, up, angle, view.aperture * unit, sharp);
        case CameraKind::MotionBlur:
            return dfb::OrbitBlurCamera(eye, forward, up, angle, targetOf(focus, view), view.up, view.shutter);
        case CameraKind::Stereo: return dfb::StereoCamera(eye, forward, up, angle, view.separation * unit, sharp);
        case CameraKind::Dome: return dfb::DomeCamera(eye, forward, up, std::min(360.0f, view.domeAngle / view.zoom));
        }
        return pinhole;
    }

    static std::vector<dfb::Footprint> listOf(std::vector<dfb::Footprint> all) { return all; }
    static std::vector<dfb::Footprint> listOf(dfb::Footprint one) { return {std::move(one)}; }

    int width_, height_;
    dfb::PerspectiveCamera pinhole_;
    AnyCamera camera_;
};

} // namespace example
