// Surfaces: the meshes and spheres of a brick in an Embree scene, and all points where a ray meets them.
//
// Embree finds the primitives that a ray meets. The distance along the ray is computed here, in double and from the
// primitive alone, so that it does not depend on what else is in the brick.
#pragma once

#include "bricks.hpp"
#include "shading.hpp"

#if __has_include(<embree4/rtcore.h>)
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <tuple>
#include <type_traits>

namespace example {

struct Hit {
    float t = 0;
    std::uint32_t geometry = 0, primitive = 0; // in the whole scene
    Vec3 normal;                               // unit; which side it points to is open
    Vec3 color;
    std::optional<float> opacity; // none: that of the run

    // Front to back; at one point by their numbers.
    friend bool operator<(const Hit& a, const Hit& b)
    {
        return std::tie(a.t, a.geometry, a.primitive) < std::tie(b.t, b.geometry, b.primitive);
    }
};

// One device for all bricks of the process, for as long as there are any: Embree cannot make thousands.
inline std::shared_ptr<std::remove_pointer_t<RTCDevice>> sharedDevice()
{
    static std::mutex mutex;
    static std::weak_ptr<std::remove_pointer_t<RTCDevice>> current;
    const std::lock_guard<std::mutex> lock(mutex);
    auto device = current.lock();
    if (!device) {
        const RTCDevice made = rtcNewDevice(nullptr);
        if (!made)
            throw std::runtime_error("Embree cannot create a device, error "
                                     + std::to_string(rtcGetDeviceError(nullptr)));
        device.reset(made, rtcReleaseDevice);
        current = device;
    }
    return device;
}

class Surfaces {
public:
    Surfaces(const Box& cell, std::vector<BrickMesh> meshes, std::vector<BrickSpheres> spheres)
        : cell_(cell), meshes_(std::move(meshes)), spheres_(std::move(spheres))
    {
        if (meshes_.empty() && spheres_.empty())
            return;
        device_ = sharedDevice();
        scene_.reset(rtcNewScene(device_.get()));
        // Robust: a ray through a shared edge does not slip between the triangles.
        rtcSetSceneFlags(scene_.get(), RTC_SCENE_FLAG_ROBUST);
        for (BrickMesh& part : meshes_)
            attach(part);
        for (BrickSpheres& part : spheres_)
            attach(part);
        rtcCommitScene(scene_.get());
        const RTCError error = rtcGetDeviceError(device_.get());
        if (error != RTC_ERROR_NONE)
            throw std::runtime_error("Embree cannot build its scene, error " + std::to_string(error));
    }

    bool empty() const { return scene_ == nullptr; }

    // The first `most` hits of the ray whose point is in the brick's cell, front to back; by default all. From any
    // thread.
    void intersect(const Vec3& origin, const Vec3& direction, std::vector<Hit>& hits,
                   std::size_t most = std::numeric_limits<std::size_t>::max()) const
    {
        Query query;
        query.cell = &cell_;
        query.farthest = std::numeric_limits<float>::infinity();
        find(query, origin, direction, hits, most);
    }

    // Whether a ray meets `most` surfaces, 1 or more, before a distance, in the cell or not. `hits` is for its own use.
    // From any thread.
    bool blocks(const Vec3& origin, const Vec3& direction, float before, std::size_t most, std::vector<Hit>& hits) const
    {
        Query query;
        query.farthest = before;
        find(query, origin, direction, hits, most);
        return hits.size() == most;
    }
    // Whether anything is on the ray between two distances, in the cell or not. From any thread.
    bool occluded(const Vec3& origin, const Vec3& direction, float from, float to) const
    {
        if (empty())
            return false;
        Query query;
        query.origin = origin;
        query.direction = direction;
        query.from = static_cast<double>(from);
        query.to = static_cast<double>(to);
        RTCRay ray = rayOf(origin, direction, 1.001f * to); // it is our own distance that decides
#if RTC_VERSION_MAJOR >= 4
        rtcInitRayQueryContext(&query.context);
        RTCOccludedArguments arguments;
        rtcInitOccludedArguments(&arguments);
        arguments.context = &query.context;
        rtcOccluded1(scene_.get(), &ray, &arguments);
#else
        rtcInitIntersectContext(&query.context);
        rtcOccluded1(scene_.get(), &query.context, &ray);
#endif
        return ray.tfar < 0;
    }

private:
    struct Query;

    void find(Query& query, const Vec3& origin, const Vec3& direction, std::vector<Hit>& hits, std::size_t most) const
    {
        hits.clear();
        if (empty() || most == 0)
            return;
        query.origin = origin;
        query.direction = direction;
        query.hits = &hits;
        query.most = most;
        query.mayEnd = meshes_.empty();
        RTCRayHit ray{};
        ray.ray = rayOf(origin, direction, 1.001f * query.farthest); // it is our own distance that decides
        ray.hit.geomID = RTC_INVALID_GEOMETRY_ID;
#if RTC_VERSION_MAJOR >= 4
        rtcInitRayQueryContext(&query.context);
        RTCIntersectArguments arguments;
        rtcInitIntersectArguments(&arguments);
        arguments.context = &query.context;
        rtcIntersect1(scene_.get(), &ray, &arguments);
#else
        rtcInitIntersectContext(&query.context);
        rtcIntersect1(scene_.get(), &query.context, &ray);
#endif
    }

    static RTCRay rayOf(const Vec3& origin, const Vec3& direction, float farthest)
    {
        RTCRay ray{};
        ray.org_x = origin.x;
        ray.org_y = origin.y;
        ray.org_z = origin.z;
        ray.dir_x = direction.x;
        ray.dir_y = direction.y;
        ray.dir_z = direction.z;
        ray.tfar = farthest;
        ray.mask = ~0u;
        return ray;
    }

#if RTC_VERSION_MAJOR >= 4
    using Context = RTCRayQueryContext;
#else
    using Context = RTCIntersectContext;
#endif
    // The query that Embree hands to the callbacks. `context` is first, so that a pointer to it also points to the
    // query.
    struct Query {
        Context context;
        Vec3 origin, direction;
        const Box* cell = nullptr;        // hits outside of it do not count; null: all count
        float farthest = 0;               // hits from this distance on do not count
        std::vector<Hit>* hits = nullptr; // front to back
        std::size_t most = 0;
        // Whether Embree may end the search behind the last of `most` hits. Not if there are triangles: Embree would
        // compare its own distances, and those of triangles that are seen edge-on differ from ours.
        bool mayEnd = false;
        double from = 0, to = 0; // for occluded()

        // Takes the hit if it is in the cell and one of the first `most` so far.
        void keep(double distance, Hit hit, const std::optional<Clip>& clip) const
        {
            hit.t = static_cast<float>(distance);
            if (!(hit.t > 0 && hit.t < farthest) || (isFull() && hits->back().t < hit.t)
                || (cell && !cell->contains(pointAt(origin, direction, hit.t))) || !shows(clip, distance))
                return;
            // Embree goes roughly front to back, so the place is near the end.
            auto at = hits->end();
            while (at != hits->begin() && hit < at[-1])
                --at;
            // A point on an edge belongs to two triangles but is seen once, as a point of the first.
            if (at != hits->begin() && isSamePoint(hit, at[-1]))
                return;
            if (at != hits->end() && isSamePoint(hit, *at)) {
                *at = hit;
            } else if (!isFull()) {
                hits->insert(at, hit);
            } else if (at != hits->end()) {
                std::move_backward(at, hits->end() - 1, hits->end());
                *at = hit;
            }
        }
        bool isFull() const { return hits->size() == most; }
        // Whether the point at that distance is inside the clip box of its object, if there is one.
        bool shows(const std::optional<Clip>& clip, double distance) const
        {
            return !clip || clip->contains(pointAt(origin, direction, static_cast<float>(distance)));
        }

        static bool isSamePoint(const Hit& a, const Hit& b) { return a.t == b.t && a.geometry == b.geometry; }
    };

    struct Release {
        void operator()(RTCScene scene) const { rtcReleaseScene(scene); }
    };
    using EmbreeScene = std::unique_ptr<std::remove_pointer_t<RTCScene>, Release>;

    void attach(BrickMesh& part)
    {
        RTCGeometry geometry = rtcNewGeometry(device_.get(), RTC_GEOMETRY_TYPE_TRIANGLE);
        auto& positions = part.mesh.positions;
        const std::size_t count = positions.size();
        positions.emplace_back(); // Embree loads 16 bytes per vertex, so there must be some behind the last one
        rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, positions.data(), 0,
                                   sizeof(Vec3), count);
        rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, part.mesh.triangles.data(), 0,
                                   sizeof(Triangle), part.mesh.triangles.size());
        rtcSetGeometryIntersectFilterFunction(geometry, onTriangle);
        rtcSetGeometryOccludedFilterFunction(geometry, onOccludingTriangle);
        finish(geometry, &part);
    }

    void attach(BrickSpheres& part)
    {
        RTCGeometry geometry = rtcNewGeometry(device_.get(), RTC_GEOMETRY_TYPE_USER);
        rtcSetGeometryUserPrimitiveCount(geometry, static_cast<unsigned>(part.spheres.size()));
        rtcSetGeometryBoundsFunction(geometry, sphereBounds, nullptr);
        rtcSetGeometryIntersectFunction(geometry, onSphere);
        rtcSetGeometryOccludedFunction(geometry, onOccludingSphere);
        finish(geometry, &part);
    }

    void finish(RTCGeometry geometry, void* userData)
    {
        rtcSetGeometryUserData(geometry, userData);
        rtcCommitGeometry(geometry);
        rtcAttachGeometry(scene_.get(), geometry);
        rtcReleaseGeometry(geometry);
    }

    // Where the ray meets the triangle's plane, as a distance and as weights of the second and third vertex.
    static double distanceTo(const Query& query, const Mesh& mesh, const Triangle& triangle, double& u, double& v)
    {
        const Vec3d a = toDouble(mesh.positions[triangle[0]]);
        const Vec3d ab = toDouble(mesh.positions[triangle[1]]) - a, ac = toDouble(mesh.positions[triangle[2]]) - a;
        const Vec3d o = toDouble(query.origin), d = toDouble(query.direction);
        const Vec3d p = cross(d, ac), q = cross(o - a, ab);
        const double determinant = dot(ab, p);
        u = determinant != 0 ? dot(o - a, p) / determinant : 0;
        v = determinant != 0 ? dot(d, q) / determinant : 0;
        // If the triangle is seen edge-on, the point in its plane is inexact. It is kept in the triangle, and so in its
        // box.
        u = std::clamp(u, 0.0, 1.0);
        v = std::clamp(v, 0.0, 1.0 - u);
        return dot(a + ab * u + ac * v - o, d) / dot(d, d);
    }

    static Vec3 colorAt(const BrickMesh& part, const Triangle& triangle, double u, double v)
    {
        const std::vector<Vec3>& colors = part.mesh.colors;
        if (colors.empty())
            return part.color;
        return toFloat(toDouble(colors[triangle[0]]) * (1 - u - v) + toDouble(colors[triangle[1]]) * u
                       + toDouble(colors[triangle[2]]) * v);
    }

    // Records the hit and rejects it, so that Embree goes on to the next one.
    static void onTriangle(const RTCFilterFunctionNArguments* arguments)
    {
        if (arguments->valid[0] == 0)
            return;
        arguments->valid[0] = 0;
        const Query& query = *reinterpret_cast<const Query*>(arguments->context);
        const BrickMesh& part = *static_cast<const BrickMesh*>(arguments->geometryUserPtr);
        const std::uint32_t index = RTCHitN_primID(arguments->hit, arguments->N, 0);
        const Triangle& triangle = part.mesh.triangles[index];

        double u = 0, v = 0;
        const double distance = distanceTo(query, part.mesh, triangle, u, v);
        const Vec3d normal = toDouble(part.normals[triangle[0]]) * (1 - u - v) + toDouble(part.normals[triangle[1]]) * u
                             + toDouble(part.normals[triangle[2]]) * v;
        Hit hit;
        hit.geometry = part.geometry;
        hit.primitive = part.primitives[index];
        hit.normal = toFloat(unit(dot(normal, normal) > 0 ? normal : weightedNormal(part.mesh, triangle)));
        hit.color = colorAt(part, triangle, u, v);
        hit.opacity = part.opacity;
        query.keep(distance, hit, part.clip);
    }

    static void onOccludingTriangle(const RTCFilterFunctionNArguments* arguments)
    {
        if (arguments->valid[0] == 0)
            return;
        const Query& query = *reinterpret_cast<const Query*>(arguments->context);
        const BrickMesh& part = *static_cast<const BrickMesh*>(arguments->geometryUserPtr);
        double u = 0, v = 0;
        const double distance =
            distanceTo(query, part.mesh, part.mesh.triangles[RTCHitN_primID(arguments->hit, arguments->N, 0)], u, v);
        if (!(distance > query.from && distance < query.to) || !query.shows(part.clip, distance))
            arguments->valid[0] = 0;
    }

    static void onOccludingSphere(const RTCOccludedFunctionNArguments* arguments)
    {
        if (arguments->valid[0] == 0)
            return;
        const Query& query = *reinterpret_cast<const Query*>(arguments->context);
        const auto& part = *static_cast<const BrickSpheres*>(arguments->geometryUserPtr);
        const Sphere& sphere = part.spheres[arguments->primID];
        const Vec3d toCenter = toDouble(sphere.center) - toDouble(query.origin), d = toDouble(query.direction);
        const double radius = static_cast<double>(sphere.radius), dd = dot(d, d), along = dot(toCenter, d) / dd;
        const Vec3d off = toCenter - d * along;
        const double rest = radius * radius - dot(off, off);
        if (!(rest > 0))
            return;
        const double half = std::sqrt(rest / dd);
        for (const double t : {along - half, along + half})
            if (t > query.from && t < query.to && query.shows(part.clip, t))
                RTCRayN_tfar(arguments->ray, arguments->N, 0) = -std::numeric_limits<float>::infinity();
    }

    static void sphereBounds(const RTCBoundsFunctionArguments* arguments)
    {
        const auto& part = *static_cast<const BrickSpheres*>(arguments->geometryUserPtr);
        const Sphere& sphere = part.spheres[arguments->primID];
        // A little larger than the sphere, so that rounding in the box test never costs a hit.
        const float radius = sphere.radius + 1e-6f * (sphere.radius + length(sphere.center));
        RTCBounds& bounds = *arguments->bounds_o;
        bounds.lower_x = sphere.center.x - radius;
        bounds.lower_y = sphere.center.y - radius;
        bounds.lower_z = sphere.center.z - radius;
        bounds.upper_x = sphere.center.x + radius;
        bounds.upper_y = sphere.center.y + radius;
        bounds.upper_z = sphere.center.z + radius;
    }

    // Records where the ray enters the sphere, or where it leaves if it begins inside or the entry is clipped away.
    // Tells Embree of no hit, so that it goes on.
    static void onSphere(const RTCIntersectFunctionNArguments* arguments)
    {
        if (arguments->valid[0] == 0)
            return;
        const Query& query = *reinterpret_cast<const Query*>(arguments->context);
        const auto& part = *static_cast<const BrickSpheres*>(arguments->geometryUserPtr);
        const Sphere& sphere = part.spheres[arguments->primID];

        const Vec3d toCenter = toDouble(sphere.center) - toDouble(query.origin), d = toDouble(query.direction);
        const double radius = static_cast<double>(sphere.radius), dd = dot(d, d), along = dot(toCenter, d) / dd;
        const Vec3d off = toCenter - d * along; // from the point of closest approach to the centre
        const double rest = radius * radius - dot(off, off);
        if (!(rest > 0))
            return;
        const double half = std::sqrt(rest / dd);
        const bool enters = along > half && query.shows(part.clip, along - half);
        const double t = enters ? along - half : along + half;
        Hit hit;
        hit.geometry = part.geometry;
        hit.primitive = part.primitives[arguments->primID];
        hit.normal = toFloat(unit(d * t - toCenter));
        hit.color = sphere.color;
        hit.opacity = part.opacity;
        query.keep(t, hit, part.clip);
        if (query.mayEnd && query.isFull()) { // with room for the rounding of Embree's boxes
            float& farthest = RTCRayN_tfar(RTCRayHitN_RayN(arguments->rayhit, arguments->N), arguments->N, 0);
            farthest = std::min(farthest, 1.00001f * query.hits->back().t);
        }
    }

    Box cell_;
    // Embree points into these two, and so they outlive its scene. Moving the vectors moves no element.
    std::vector<BrickMesh> meshes_;
    std::vector<BrickSpheres> spheres_;
    std::shared_ptr<std::remove_pointer_t<RTCDevice>> device_;
    EmbreeScene scene_;
};

} // namespace example
