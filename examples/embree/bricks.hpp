// Brick: a half-open cell of the scene's bounds with all that can be seen in it: the voxels (with ghosts), and each
// primitive that touches it, under its index in the whole scene.
#pragma once

#include "scene.hpp"
#include "voxel_block.hpp"

#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

namespace example {

struct BrickVolume {
    VoxelBlock block;
    Placement placement; // before the rotation
    VolumeLook look;
    Box shown; // in voxels
    std::uint32_t geometry = 0;
    Rotation rotation = {};
};

struct BrickMesh {
    std::uint32_t geometry = 0;
    Mesh mesh;
    std::vector<Vec3> normals;
    std::vector<std::uint32_t> primitives; // index of each triangle in the whole mesh
    Vec3 color;
    std::optional<float> opacity; // none: that of the run
    std::optional<Clip> clip;
};

struct BrickSpheres {
    std::uint32_t geometry = 0;
    std::vector<Sphere> spheres;
    std::vector<std::uint32_t> primitives;
    std::optional<float> opacity;
    std::optional<Clip> clip;
};

struct Brick {
    Box cell; // half-open
    std::vector<BrickVolume> volumes;
    std::vector<BrickMesh> meshes;
    std::vector<BrickSpheres> spheres;
};

namespace detail {

inline void addVolume(Brick& brick, const VolumeObject& object)
{
    const auto padded = [](const Box& box) { return box.padded(1e-5f * box.largestExtent()); };
    Box part = intersection(brick.cell, padded(object.bounds()));
    if (!object.rotation.isNone())
        part = intersection(object.rotation.boxBack(part), padded(object.upright()));
    if (part.empty())
        return;
    const float rounding = object.rotation.isNone() ? 0.01f : 0.25f; // in voxels; see VolumeSampler::toVoxel()
    Index3 lo, hi;
    for (std::size_t axis = 0; axis < 3; ++axis) {
        const float offset = component(object.placement.offset, axis), scale = component(object.placement.scale, axis);
        const float low = component(part.lo, axis), high = component(part.hi, axis);
        const float first = scale > 0 ? low : high, behind = scale > 0 ? high : low;
        const int last = object.source.info.dims[axis] - 1;
        // Gradients in a cell use one voxel before its first voxel, and two voxels behind.
        const auto voxel = [&](float world, float slack) {
            return static_cast<int>(
                std::floor(std::clamp((world - offset) / scale + slack, -1.0f, static_cast<float>(last) + 1.0f)));
        };
        lo[axis] = std::max(voxel(first, -rounding) - 1, -1);
        hi[axis] = std::min(voxel(behind, rounding) + 3, last + 3);
    }
    brick.volumes.push_back({VoxelBlock(object.source, lo, hi), object.placement, object.source.look, object.shown,
                             object.geometry, object.rotation});
}

// A part of an object without its primitives.
inline BrickMesh emptyPartOf(const MeshObject& object)
{
    BrickMesh part;
    part.geometry = object.geometry;
    part.color = object.color;
    part.opacity = object.opacity;
    part.clip = object.clip;
    return part;
}
inline BrickSpheres emptyPartOf(const SphereObject& object)
{
    BrickSpheres part;
    part.geometry = object.geometry;
    part.opacity = object.opacity;
    part.clip = object.clip;
    return part;
}

// The primitives of an object that touch a box; there may be none.
inline BrickMesh partIn(const MeshObject& object, const Box& reach)
{
    BrickMesh part = emptyPartOf(object);
    const std::uint32_t none = ~std::uint32_t{0};
    std::vector<std::uint32_t> newIndex(object.mesh.positions.size(), none);
    for (std::size_t i = 0; i < object.mesh.triangles.size(); ++i) {
        const Triangle& triangle = object.mesh.triangles[i];
        Box box;
        for (const std::uint32_t index : triangle)
            box.grow(object.mesh.positions[index]);
        if (!box.overlaps(reach))
            continue;
        Triangle renamed;
        for (std::size_t k = 0; k < 3; ++k) {
            std::uint32_t& index = newIndex[triangle[k]];
            if (index == none) {
                index = static_cast<std::uint32_t>(part.mesh.positions.size());
                part.mesh.positions.push_back(object.mesh.positions[triangle[k]]);
                part.normals.push_back(object.normals[triangle[k]]);
                if (!object.mesh.colors.empty())
                    part.mesh.colors.push_back(object.mesh.colors[triangle[k]]);
            }
            renamed[k] = index;
        }
        part.mesh.triangles.push_back(renamed);
        part.primitives.push_back(object.firstPrimitive + static_cast<std::uint32_t>(i));
    }
    return part;
}
inline BrickSpheres partIn(const SphereObject& object, const Box& reach)
{
    BrickSpheres part = emptyPartOf(object);
    for (std::size_t i = 0; i < object.spheres.size(); ++i) {
        Box box;
        box.grow(object.spheres[i].center, object.spheres[i].radius);
        if (box.overlaps(reach)) {
            part.spheres.push_back(object.spheres[i]);
            part.primitives.push_back(object.firstPrimitive + static_cast<std::uint32_t>(i));
        }
    }
    return part;
}

} // namespace detail

// The box in which a brick holds primitives: its cell, and `ghosts` beyond it for secondary rays.
inline Box reachOf(const Scene& scene, const Box& cell, float ghosts)
{
    // Also padded by more than the rounding of a hit point, so that the brick has the primitive of each hit in its
    // cell.
    return cell.padded(
        ghosts
        + 1e-5f * std::max(scene.bounds.largestExtent(), std::max(length(scene.bounds.lo), length(scene.bounds.hi))));
}

// Loads a rank's part of the scene for one cell. Volumes are read from their source here, and only as far as needed;
// the scene itself can go when all bricks are loaded. The parts of meshes and spheres that ranks have read together
// come by exchangeBricks().
inline Brick loadBrick(const Scene& scene, const Box& cell, float ghosts = 0)
{
    Brick brick;
    brick.cell = cell;
    const Box reach = reachOf(scene, cell, ghosts);
    for (const VolumeObject& object : scene.volumes)
        detail::addVolume(brick, object);
    const auto add = [&reach](const auto& objects, auto& parts) {
        for (const auto& object : objects)
            if (!object.isPart)
                if (auto part = detail::partIn(object, reach); !part.primitives.empty())
                    parts.push_back(std::move(part));
    };
    add(scene.meshes, brick.meshes);
    add(scene.spheres, brick.spheres);
    return brick;
}

} // namespace example
