// The default view: everything visible is in the image, whatever the image's shape, and fills it.
#include "support.hpp"

#include <generated.hpp>
#include <renderer.hpp>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>
#include <utility>
#include <vector>

namespace framing_cases {

namespace {

using example::Box;
using example::CameraKind;
using example::Scene;
using example::Vec3;

const std::pair<int, int> sizes[] = {{300, 600}, {600, 300}, {512, 512}};

std::vector<example::Sphere> corners(const Vec3& lo, const Vec3& hi, float radius)
{
    std::vector<example::Sphere> spheres;
    for (int i = 0; i < 8; ++i)
        spheres.push_back(
            {{i & 1 ? hi.x : lo.x, i & 2 ? hi.y : lo.y, i & 4 ? hi.z : lo.z}, radius, {0.5f, 0.5f, 0.5f}});
    return spheres;
}

// Points of everything visible. Of a sphere, the farthest points in 26 directions.
std::vector<Vec3> pointsOf(const Scene& scene)
{
    std::vector<Vec3> points;
    for (const auto& object : scene.meshes)
        for (const example::Triangle& triangle : object.mesh.triangles)
            for (const std::uint32_t index : triangle)
                points.push_back(object.mesh.positions[index]);
    for (const auto& object : scene.spheres)
        for (const example::Sphere& sphere : object.spheres)
            for (int i = 0; i < 27; ++i)
                points.push_back(sphere.center
                                 + example::unit(Vec3{static_cast<float>(i % 3 - 1), static_cast<float>(i / 3 % 3 - 1),
                                                      static_cast<float>(i / 9 - 1)})
                                       * sphere.radius);
    for (const auto& object : scene.volumes)
        for (const example::Sphere& corner : corners(object.bounds().lo, object.bounds().hi, 0))
            points.push_back(corner.center);
    return points;
}

// The largest distance of the points from the image's centre: 1 is at the border, infinity is behind the camera.
float farthestOf(const std::vector<Vec3>& points, const dfb::PerspectiveCamera& camera,
                 const example::RenderSettings& image)
{
    const float tanHalf = std::tan(image.view.fieldOfView * 3.14159265f / 360),
                aspect = static_cast<float>(image.width) / static_cast<float>(image.height);
    float farthest = 0;
    for (const Vec3& p : points) {
        const Vec3 to = p - camera.eye();
        const float depth = dot(to, camera.forward());
        if (!(depth > 0))
            return std::numeric_limits<float>::infinity();
        const float y = std::fabs(dot(to, camera.up())) / (depth * tanHalf),
                    x = std::fabs(dot(to, camera.right())) / (depth * tanHalf * aspect);
        farthest = std::max({farthest, x, y});
    }
    return farthest;
}

std::vector<std::pair<std::string, Scene>> scenes()
{
    std::vector<std::pair<std::string, Scene>> all(8);
    all[0].first = "a cube";
    all[0].second.add(corners({0, 0, 0}, {9, 9, 9}, 1), true);
    all[1].first = "a pole";
    all[1].second.add(corners({-1, 50, -1}, {1, 90, 1}, 3), false);
    all[2].first = "a plate far from the origin";
    all[2].second.add(corners({1000, 50, -3000}, {1700, 50, -2500}, 90), false);
    all[3].first = "a knot";
    all[3].second.add(example::detail::torusKnot(100, 8), true);
    all[4].first = "a triangle";
    all[4].second.add(example::Mesh{{{0, 0, 0}, {1, 0, 0}, {0, 3, 1}, {99, 99, 99}}, {{0, 1, 2}}}, false);
    all[5].first = "a sphere";
    all[5].second.add(std::vector<example::Sphere>(1, {{1, 2, 3}, 4, {1, 1, 1}}), false);
    all[6].first = "a full volume";
    all[6].second.add(example::detail::generatedVolume({8, 12, 5}, [](int, int, int) { return 1.0f; }), true);
    all[7].first = "two objects side by side";
    all[7].second.add(corners({0, 0, 0}, {1, 1, 1}, 0.1f), false);
    all[7].second.add(example::Mesh{{{5, 0, 0}, {6, 0, 0}, {5, 3, 1}}, {{0, 1, 2}}}, false);
    return all;
}

// Points on the border of a camera's image: of the whole image, of each eye's half, or of the dome's circle.
std::vector<std::pair<double, double>> borderOf(CameraKind kind, int width, int height)
{
    std::vector<std::pair<double, double>> points;
    const double w = width, h = height, least = 1e-9 * w;
    for (int i = 0; i <= 100; ++i) {
        const double f = i / 100.0;
        if (kind == CameraKind::Dome) {
            const double radius = (0.5 - 1e-9) * std::min(w, h), angle = 2 * 3.14159265358979323846 * f;
            points.emplace_back(0.5 * w + radius * std::cos(angle), 0.5 * h + radius * std::sin(angle));
            continue;
        }
        points.insert(points.end(), {{0, f * h}, {w, f * h}, {f * w, 0}, {f * w, h}});
        if (kind == CameraKind::Stereo)
            points.insert(points.end(), {{0.5 * w - least, f * h}, {0.5 * w, f * h}});
    }
    return points;
}

} // namespace

TEST_CASE("Every point of a scene is in the default view", "[framing]")
{
    for (const auto& [name, scene] : scenes()) {
        const std::vector<Vec3> points = pointsOf(scene);
        const example::SceneInfo info(scene);
        for (const auto& [width, height] : sizes)
            for (const float fov : {35.0f, 5.0f, 120.0f}) {
                INFO(name << ", " << width << 'x' << height << ", " << fov << " degrees");
                example::RenderSettings settings;
                settings.width = width;
                settings.height = height;
                settings.frames = 8;
                settings.view.fieldOfView = fov;
                float farthest = 0;
                for (const float elevation : {20.0f, 90.0f, -35.0f})
                    for (int frame = 0; frame < settings.frames; ++frame) {
                        settings.view.elevation = elevation;
                        const example::FrameCamera camera = frameCamera(info, settings, frame);
                        farthest = std::max(farthest, farthestOf(points, camera.pinhole(), settings));
                    }
                CHECK(farthest < 1.0f);
                if (name == "a sphere") // it fills as much as possible
                    CHECK(farthest > 0.8f);
            }
    }
}

// A ball of voxels, which shows up to one voxel beyond them.
TEST_CASE("What a volume shows is in the default view, however small it is or where it is clipped", "[framing]")
{
    for (const float radius : {0.5f, 3.2f, 6.0f, 12.0f, 40.0f})
        for (const bool isClipped : {false, true}) {
            const int side = radius > 12 ? 100 : 32;
            const float middle = 0.5f * static_cast<float>(side);
            const auto isInside = [=](int x, int y, int z) {
                const Vec3 p{static_cast<float>(x), static_cast<float>(y), static_cast<float>(z)};
                return example::length(p - Vec3{middle, middle, middle}) < radius;
            };
            example::FileLook look;
            if (isClipped)
                look.clip = example::Box{{middle, 0, 0}, {100, 100, 100}};
            Scene scene;
            scene.add(example::detail::generatedVolume(
                          {side, side, side}, [=](int x, int y, int z) { return isInside(x, y, z) ? 1.0f : 0.0f; }),
                      true, look);
            const example::VolumeObject& object = scene.volumes.front();
            std::vector<Vec3> points;
            for (int z = 0; z < side; ++z)
                for (int y = 0; y < side; ++y)
                    for (int x = 0; x < side; ++x)
                        if (isInside(x, y, z))
                            for (const example::Sphere& corner : corners({0, 0, 0}, {1, 1, 1}, 0)) {
                                const Vec3 p =
                                    Vec3{static_cast<float>(x), static_cast<float>(y), static_cast<float>(z)}
                                    + (corner.center - Vec3{0.5f, 0.5f, 0.5f}) * 1.15f; // 1 in each direction
                                points.push_back(object.toWorld(clamped(p, object.shown)));
                            }
            INFO("radius " << radius << (isClipped ? ", clipped" : ""));
            for (const float elevation : {20.0f, 90.0f, -35.0f}) {
                example::RenderSettings settings;
                settings.width = settings.height = 240;
                settings.view.elevation = elevation;
                const auto camera = frameCamera(example::SceneInfo(scene), settings, 0);
                CHECK(farthestOf(points, camera.pinhole(), settings) < 1.0f);
            }
        }
}

TEST_CASE("No kind of camera cuts off a scene by default", "[framing]")
{
    for (const auto& [name, scene] : scenes()) {
        if (!scene.volumes.empty())
            continue; // a volume has no surface that a ray would hit
        const example::SceneInfo info(scene);
        example::Brick brick = loadBrick(scene, scene.bounds);
        const example::Surfaces surfaces(scene.bounds, std::move(brick.meshes), std::move(brick.spheres));
        std::vector<example::Hit> hits;
        for (const auto& [width, height] : sizes)
            for (const auto kind : {CameraKind::Perspective, CameraKind::DepthOfField, CameraKind::MotionBlur,
                                    CameraKind::Stereo, CameraKind::Dome}) {
                INFO(name << ", " << width << 'x' << height << ", camera " << static_cast<int>(kind));
                example::RenderSettings settings;
                settings.width = width;
                settings.height = height;
                settings.view.kind = kind;
                settings.view.aperture = settings.view.separation = 0.5f;
                settings.view.shutter = 45;
                settings.view.domeAngle = 20;
                const example::FrameCamera camera = frameCamera(info, settings, 0);
                const auto meets = [&](double x, double y, const dfb::LensSample& lens) {
                    const auto [origin, direction] = camera.ray(x, y, lens);
                    if (!(dot(direction, direction) > 0))
                        return false;
                    surfaces.intersect(origin, direction, hits, 1);
                    return !hits.empty();
                };
                int outside = 0, inside = 0;
                for (const auto& [x, y] : borderOf(kind, width, height))
                    for (int i = 0; i < 9; ++i) // all around the lens
                        outside += meets(x, y, {1, i / 8.0, i / 8.0});
                const double w = kind == CameraKind::Stereo ? 0.5 * width : width; // of an eye's half
                for (int i = -50; i <= 50; ++i)
                    for (int k = -50; k <= 50; ++k)
                        inside += meets((0.5 + i / 101.0) * w, (0.5 + k / 101.0) * height, {});
                CHECK(outside == 0);
                CHECK(inside > 10);
            }
    }
}

TEST_CASE("An eye in the middle of the scene needs a target", "[framing]")
{
    Scene scene;
    scene.add(corners({0, 0, 0}, {9, 9, 9}, 1), false);
    example::View view;
    view.eye = scene.focus().box.center();
    const auto outcome = [&] {
        try {
            example::FrameCamera(scene.focus(), view, 0, 1, 64, 64);
            return std::string("fine");
        } catch (const dfb::InvalidArgument& e) {
            return std::string(e.what());
        }
    };
    CHECK(outcome().find("--eye is where the camera looks") != std::string::npos);
    view.target = Vec3{0, 0, 0};
    CHECK(outcome() == "fine");
}

TEST_CASE("A very narrow image has a camera at a distance that can be reckoned with", "[framing]")
{
    Scene scene;
    scene.add(corners({0, 0, 0}, {9, 9, 9}, 1), true);
    example::RenderSettings settings;
    settings.width = 1;
    settings.height = 65536;
    const example::SceneInfo info(scene);
    const float distance = example::length(frameCamera(info, settings, 0).pinhole().eye() - info.focus.box.center());
    CHECK(distance > 100.0f);
    CHECK(distance < 1001.0f);
}

} // namespace framing_cases
