// Camera: a perspective view that orbits around the scene, one position per frame.
#pragma once

#include "vec.hpp"

namespace example {

// What the user chooses about the view; angles in degrees.
struct View {
    float azimuth = 30;     // around the y axis, from +z towards +x
    float elevation = 20;   // above the xz plane
    float fieldOfView = 35; // full vertical angle
    float distance = 2.3f;  // from the centre of what there is to see, in units of its largest extent
};

struct Camera {
    Vec3 origin;
    Vec3 forward, right, up; // orthonormal
    float tanHalfFov = 0;    // of the vertical angle
    float aspect = 1;        // width / height

    // Unit direction through the point (x, y) of an image of the given size, in pixels from the upper left corner.
    Vec3 direction(double x, double y, int width, int height) const
    {
        const double sx = (2.0 * x / width - 1.0) * static_cast<double>(tanHalfFov) * static_cast<double>(aspect);
        const double sy = (1.0 - 2.0 * y / height) * static_cast<double>(tanHalfFov);
        return Vec3(normalize(Vec3d(forward) + Vec3d(right) * sx + Vec3d(up) * sy));
    }
};

// The camera of frame `frame` of `frameCount`: a full turn around the centre of `focus` in `frameCount` frames.
// y is up.
inline Camera orbitCamera(const Box& focus, const View& view, int frame, int frameCount, int width, int height)
{
    const double degree = 3.14159265358979323846 / 180.0;
    const double azimuth = (static_cast<double>(view.azimuth) + 360.0 * frame / std::max(1, frameCount)) * degree;
    const double elevation = std::clamp(static_cast<double>(view.elevation), -89.9, 89.9) * degree;
    const Vec3d outward(std::cos(elevation) * std::sin(azimuth), std::sin(elevation),
                        std::cos(elevation) * std::cos(azimuth));
    const Vec3d forward = outward * -1.0;
    const Vec3d right = normalize(cross(forward, Vec3d(0, 1, 0)));
    Camera camera;
    camera.origin = Vec3(Vec3d(focus.center()) + outward * static_cast<double>(view.distance * focus.largestExtent()));
    camera.forward = Vec3(forward);
    camera.right = Vec3(right);
    camera.up = Vec3(cross(right, forward));
    camera.tanHalfFov = static_cast<float>(std::tan(0.5 * static_cast<double>(view.fieldOfView) * degree));
    camera.aspect = static_cast<float>(width) / static_cast<float>(height);
    return camera;
}

} // namespace example
