// Scene: what there is to render, and the bricks that it is cut into.
//
// World space: each file is scaled and centred to fill the unit cube, unless told not to. A brick is a half-open
// cell of the scene's bounds with all that can be seen in it: the voxels (with ghosts), and each primitive that
// touches it, under its index in the whole scene. Cells are a pure function of the bounds and their number, so every
// rank knows all of them, and two cells that share a face have the same number for it.
#pragma once

#include "loaders.hpp"
#include "obj.hpp"
#include "ply.hpp"
#include "shading.hpp"
#include "spheres.hpp"
#include "voxel_block.hpp"

#include <cstdint>
#include <cstdio>
#include <string>
#include <utility>
#include <vector>

namespace example {

// From the coordinates of a file to the world.
struct Placement {
    Vec3 scale{1, 1, 1}; // of volumes: the sides of a voxel; else the same along all axes but for the sign
    Vec3 offset;

    // The least and the greatest scale.
    float size() const { return std::min({std::fabs(scale.x), std::fabs(scale.y), std::fabs(scale.z)}); }
    float largest() const { return std::max({std::fabs(scale.x), std::fabs(scale.y), std::fabs(scale.z)}); }
    Vec3 toWorld(const Vec3& p) const
    {
        return {p.x * scale.x + offset.x, p.y * scale.y + offset.y, p.z * scale.z + offset.z};
    }
};

// Centres the box in [0, 1]^3 with its largest extent 1; the identity if `fit` is false, or the box has no extent or
// one that is lost beside its distance from 0.
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

// Scanners store the rows of an image from the top, so a volume stands with y down and, to stay no mirror image of
// itself, with z backwards.
struct VolumeObject {
    VolumeSource source;
    Placement placement; // of voxels by their index

    // Throws std::runtime_error if floats have too few digits to tell the volume's voxels apart.
    VolumeObject(VolumeSource volume, bool fit) : source(std::move(volume))
    {
        placement.scale = source.info.spacing;
        placement.offset = fit ? Vec3() : source.info.origin; // it is centred
        const Placement fitted = fitToUnitCube(bounds(), fit);
        placement.offset = fitted.toWorld(placement.offset);
        placement.scale = placement.scale * fitted.size();
        const Vec3 sum = bounds().lo + bounds().hi;
        placement.scale = {placement.scale.x, -placement.scale.y, -placement.scale.z};
        placement.offset = {placement.offset.x, sum.y - placement.offset.y, sum.z - placement.offset.z};
        for (int axis = 0; axis < 3; ++axis)
            if (!(std::max(std::fabs(component(bounds().lo, axis)), std::fabs(component(bounds().hi, axis)))
                  <= 131072 * std::fabs(component(placement.scale, axis)))) // what addVolume() allows for rounding
                throw std::runtime_error(source.name + ": its voxels are too small beside "
                                         + (fit ? "its extent" : "the distance from 0 to its end")
                                         + ", which can be 131072 of their sides at most");
    }

    // The domain, between the centres of the outer voxels.
    Box bounds() const
    {
        const Index3& d = source.info.dims;
        Box box;
        box.grow(placement.toWorld({0, 0, 0}));
        box.grow(placement.toWorld(
            {static_cast<float>(d[0] - 1), static_cast<float>(d[1] - 1), static_cast<float>(d[2] - 1)}));
        return box;
    }
};

struct MeshObject {
    std::uint32_t geometry = 0; // number among the meshes and sphere sets of the scene
    Mesh mesh;                  // in world space
    std::vector<Vec3> normals;
    Vec3 color; // where vertices have none of their own
};

struct SphereObject {
    std::uint32_t geometry = 0;
    std::vector<Sphere> spheres; // in world space
};

struct Scene {
    std::vector<VolumeObject> volumes;
    std::vector<MeshObject> meshes;
    std::vector<SphereObject> spheres;
    Box bounds;
    Index3 grid{0, 0, 0}; // of the cells, x fastest; zero: by bisection
    Notes notes;          // for the user

    void add(VolumeSource source, bool fit)
    {
        VolumeObject object(std::move(source), fit);
        grow(object.bounds());
        const VisibleVoxels visible = object.source.visible ? *object.source.visible : visibleVoxels(object.source);
        const float slack = static_cast<float>(visible.slack) * object.placement.largest();
        lookAt([&](const auto& take) {
            for (const Vec3& p : visible.points)
                take(object.placement.toWorld(p), slack);
            if (visible.points.empty()) // the whole
                for (int i = 0; i < 8; ++i)
                    take({i & 1 ? object.bounds().hi.x : object.bounds().lo.x,
                          i & 2 ? object.bounds().hi.y : object.bounds().lo.y,
                          i & 4 ? object.bounds().hi.z : object.bounds().lo.z},
                         0);
        });
        noteOn(object.source, visible.points.empty());
        volumes.push_back(std::move(object));
    }
    void add(Mesh mesh, bool fit)
    {
        Box box;
        for (const Triangle& triangle : mesh.triangles) // a file may hold vertices that nothing uses
            for (const std::uint32_t index : triangle)
                box.grow(mesh.positions[index]);
        const Placement placement = fitToUnitCube(box, fit);
        for (Vec3& p : mesh.positions)
            p = placement.toWorld(p);
        static const Vec3 palette[] = {
            {0.72f, 0.50f, 0.22f}, {0.16f, 0.42f, 0.62f}, {0.26f, 0.52f, 0.22f}, {0.62f, 0.20f, 0.18f}};
        MeshObject object{nextGeometry_++, std::move(mesh), {}, palette[meshes.size() % 4]};
        object.normals = vertexNormals(object.mesh);
        grow(lookAt([&](const auto& take) {
            for (const Triangle& triangle : object.mesh.triangles)
                for (const std::uint32_t index : triangle)
                    take(object.mesh.positions[index], 0);
        }));
        meshes.push_back(std::move(object));
    }
    void add(std::vector<Sphere> set, bool fit)
    {
        Box box;
        for (const Sphere& sphere : set)
            box.grow(sphere.center, sphere.radius);
        const Placement placement = fitToUnitCube(box, fit);
        for (Sphere& sphere : set) {
            sphere.center = placement.toWorld(sphere.center);
            sphere.radius *= placement.size();
        }
        grow(lookAt([&](const auto& take) {
            for (const Sphere& sphere : set)
                take(sphere.center, sphere.radius);
        }));
        spheres.push_back({nextGeometry_++, std::move(set)});
    }

    // The visible part of the scene, for the camera.
    Focus focus() const
    {
        Focus all{seen_, 0};
        for (const auto& [center, radius] : balls_)
            all.radius = std::max(all.radius, length(center - seen_.center()) + radius);
        return all;
    }

private:
    // `mayBeEmpty`: nothing was seen at a glance.
    void noteOn(const VolumeSource& source, bool mayBeEmpty)
    {
        const VolumeInfo& info = source.info;
        notes.insert(notes.end(), source.notes.begin(), source.notes.end());
        if (info.notFinite > 0)
            notes.push_back(source.name + ": voxels that are not finite: " + std::to_string(info.notFinite)
                            + "; they count as " + textOf(info.minimum));
        if (!mayBeEmpty)
            return;
        const auto [lo, hi] = source.range ? *source.range : rangeOf(source);
        const auto value = [&info](float v) { return (v - info.minimum) / (info.maximum - info.minimum); };
        if (!TransferFunction(1).isTransparent(value(lo), value(hi)))
            return;
        notes.push_back(source.name + ": there is nothing to see: "
                        + (lo == hi ? "all voxels are " + textOf(lo)
                                    : "all voxels, from " + textOf(lo) + " to " + textOf(hi) + ", are transparent"));
    }
    static std::string textOf(float value)
    {
        char text[32];
        std::snprintf(text, sizeof text, "%g", static_cast<double>(value));
        return text;
    }

    // `forEach` calls its argument with the centre and radius of all spheres of one object. Returns the box of these.
    template <class ForEach>
    Box lookAt(const ForEach& forEach)
    {
        Box box;
        forEach([&](const Vec3& center, float radius) { box.grow(center, radius); });
        const Vec3 middle = box.center();
        float reach = 0;
        forEach([&](const Vec3& center, float radius) { reach = std::max(reach, length(center - middle) + radius); });
        if (!box.empty()) {
            seen_.grow(box);
            balls_.emplace_back(middle, reach);
        }
        return box;
    }

    // The bounds are a little larger than what they hold, so that nothing lies on the outer faces, of which the
    // upper ones belong to no cell.
    void grow(const Box& box)
    {
        tight_.grow(box);
        const float far = std::max({std::fabs(tight_.lo.x), std::fabs(tight_.lo.y), std::fabs(tight_.lo.z),
                                    std::fabs(tight_.hi.x), std::fabs(tight_.hi.y), std::fabs(tight_.hi.z)});
        bounds = tight_.padded(1e-5f * std::max({tight_.largestExtent(), far, 1e-6f}));
    }

    Box tight_, seen_;
    std::vector<std::pair<Vec3, float>> balls_; // of each object, around all there is to see of it
    std::uint32_t nextGeometry_ = 0;
};

// Collective: adds a file, by its ending. Of a volume a rank reads its bricks later, in loadBrick(), and here its share
// of what all must know. A mesh or a set of spheres is read and parsed by rank 0 alone, which sends it to the others:
// texts cannot be cut into parts, and many ranks that read one file at once slow each other down. Each rank has the
// whole of it until its bricks are loaded. `xyzFrame` as for parseXyz(), `grid` for volumes. Throws std::runtime_error
// that names the file, the same on all ranks.
inline void addFile(Scene& scene, const std::string& path, bool fit, int xyzFrame = 0, const Loaders& loaders = {},
                    const VoxelGrid& grid = {})
{
    const std::string ending = path.substr(std::min(path.rfind('.'), path.size()));
    const auto bytes = [&] {
        std::string all = readFile(path);
        *loaders.readCounter() += all.size();
        return all;
    };
    const auto parsed = [&](auto kind, const auto& parse) {
        Notes notes;
        auto object = loaders.fromFirst<decltype(kind)>([&] { return parse(&notes); });
        for (std::string& note : loaders.linesOfFirst(notes))
            scene.notes.push_back(std::move(note));
        return object;
    };
    if (isVolumeEnding(ending))
        scene.add(openVolume(path, loaders, grid), fit);
    else if (ending == ".ply")
        scene.add(parsed(Mesh(), [&](Notes* notes) { return parsePly(bytes(), path, notes); }), fit);
    else if (ending == ".obj")
        scene.add(parsed(Mesh(), [&](Notes* notes) { return parseObj(bytes(), path, notes); }), fit);
    else if (ending == ".xyz")
        scene.add(parsed(std::vector<Sphere>(), [&](Notes* notes) { return parseXyz(bytes(), path, xyzFrame, notes); }),
                  fit);
    else
        throw std::runtime_error(path + ": unknown type '" + ending
                                 + "', expected .raw, .nrrd, .nhdr, .mha, .mhd, .ply, .obj or .xyz");
}

// ---- cutting ---------------------------------------------------------------------------------------------------

namespace detail {

inline void bisect(const Box& box, int count, std::vector<Box>& cells)
{
    if (count == 1) {
        cells.push_back(box);
        return;
    }
    const Vec3 extent = box.extent();
    const int axis = extent.x >= extent.y && extent.x >= extent.z ? 0 : extent.y >= extent.z ? 1 : 2;
    const int lower = count / 2;
    const float plane = static_cast<float>(static_cast<double>(component(box.lo, axis))
                                           + static_cast<double>(component(extent, axis)) * static_cast<double>(lower)
                                                 / static_cast<double>(count));
    Box a = box, b = box;
    component(a.hi, axis) = plane;
    component(b.lo, axis) = plane;
    bisect(a, lower, cells);
    bisect(b, count - lower, cells);
}

} // namespace detail

// `count` as a product of three near-equal factors, the largest first.
inline Index3 nearCubicGrid(int count)
{
    Index3 best{count, 1, 1};
    for (int z = 1; z * z <= count / z; ++z)
        for (int y = z; y <= count / z / y; ++y)
            if (count % (z * y) == 0 && count / (z * y) + y + z < best[0] + best[1] + best[2])
                best = {count / (z * y), y, z};
    return best;
}

// The cells of `count` bricks, by brick id: the scene's own grid, or bisection of the longest axis over and over
// (in proportion where the number is odd).
inline std::vector<Box> cutScene(const Scene& scene, int count)
{
    std::vector<Box> cells;
    const Index3& grid = scene.grid;
    if (count < 1)
        throw std::invalid_argument("a scene is cut into 1 brick or more, not " + std::to_string(count));
    if (grid[0] == 0 || grid[0] * grid[1] * grid[2] != count) {
        detail::bisect(scene.bounds, count, cells);
        return cells;
    }
    auto plane = [&](int axis, int i) {
        const int n = grid[static_cast<std::size_t>(axis)];
        const float lo = component(scene.bounds.lo, axis), hi = component(scene.bounds.hi, axis);
        return i == n ? hi : lo + (hi - lo) * (static_cast<float>(i) / static_cast<float>(n));
    };
    for (int z = 0; z < grid[2]; ++z)
        for (int y = 0; y < grid[1]; ++y)
            for (int x = 0; x < grid[0]; ++x) {
                Box cell;
                cell.lo = {plane(0, x), plane(1, y), plane(2, z)};
                cell.hi = {plane(0, x + 1), plane(1, y + 1), plane(2, z + 1)};
                cells.push_back(cell);
            }
    return cells;
}

// Bricks are dealt out in runs of neighbours; with fewer bricks than ranks some ranks get none.
inline int rankOfBrick(int brick, int brickCount, int rankCount)
{
    return static_cast<int>(static_cast<std::int64_t>(brick) * rankCount / brickCount);
}

// ---- bricks ----------------------------------------------------------------------------------------------------

struct BrickVolume {
    VoxelBlock block;
    Placement placement;
};

struct BrickMesh {
    std::uint32_t geometry = 0;
    Mesh mesh;
    std::vector<Vec3> normals;
    std::vector<std::uint32_t> primitives; // index of each triangle in the whole mesh
    Vec3 color;
};

struct BrickSpheres {
    std::uint32_t geometry = 0;
    std::vector<Sphere> spheres;
    std::vector<std::uint32_t> primitives;
};

struct Brick {
    std::uint32_t id = 0;
    Box cell; // half-open
    std::vector<BrickVolume> volumes;
    std::vector<BrickMesh> meshes;
    std::vector<BrickSpheres> spheres;
};

namespace detail {

inline void addVolume(Brick& brick, const VolumeObject& object)
{
    const Box part = intersection(brick.cell, object.bounds().padded(1e-5f * object.bounds().largestExtent()));
    if (part.empty())
        return;
    Index3 lo, hi;
    for (int i = 0; i < 3; ++i) {
        const float offset = component(object.placement.offset, i), scale = component(object.placement.scale, i);
        const std::size_t axis = static_cast<std::size_t>(i);
        const float low = component(part.lo, i), high = component(part.hi, i);
        const float first = scale > 0 ? low : high, behind = scale > 0 ? high : low;
        const int last = object.source.info.dims[axis] - 1;
        // One voxel before and two behind the first of a cell are what its gradients use; 0.01 for rounding.
        const auto voxel = [&](float world, float slack) {
            return static_cast<int>(
                std::floor(std::clamp((world - offset) / scale + slack, -1.0f, static_cast<float>(last) + 1.0f)));
        };
        lo[axis] = std::max(voxel(first, -0.01f) - 1, -1);
        hi[axis] = std::min(voxel(behind, 0.01f) + 3, last + 3);
    }
    brick.volumes.push_back({VoxelBlock(object.source, lo, hi), object.placement});
}

inline void addMesh(Brick& brick, const MeshObject& object, const Box& reach)
{
    BrickMesh part;
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
        part.primitives.push_back(static_cast<std::uint32_t>(i));
    }
    part.geometry = object.geometry;
    part.color = object.color;
    if (!part.primitives.empty())
        brick.meshes.push_back(std::move(part));
}

inline void addSpheres(Brick& brick, const SphereObject& object, const Box& reach)
{
    BrickSpheres part;
    part.geometry = object.geometry;
    for (std::size_t i = 0; i < object.spheres.size(); ++i) {
        Box box;
        box.grow(object.spheres[i].center, object.spheres[i].radius);
        if (box.overlaps(reach)) {
            part.spheres.push_back(object.spheres[i]);
            part.primitives.push_back(static_cast<std::uint32_t>(i));
        }
    }
    if (!part.primitives.empty())
        brick.spheres.push_back(std::move(part));
}

} // namespace detail

// Loads a rank's part of the scene for one cell. Volumes are read from their source here, and only as far as needed;
// the scene itself can go when all bricks are loaded. Meshes and spheres are kept up to `ghosts` beyond the cell, for
// secondary rays.
inline Brick loadBrick(const Scene& scene, std::uint32_t id, const Box& cell, float ghosts = 0)
{
    Brick brick;
    brick.id = id;
    brick.cell = cell;
    // More than the rounding of a hit point, so that a hit in the cell has its primitive in the brick.
    const Box reach = cell.padded(
        ghosts
        + 1e-5f * std::max(scene.bounds.largestExtent(), std::max(length(scene.bounds.lo), length(scene.bounds.hi))));
    for (const VolumeObject& object : scene.volumes)
        detail::addVolume(brick, object);
    for (const MeshObject& object : scene.meshes)
        detail::addMesh(brick, object, reach);
    for (const SphereObject& object : scene.spheres)
        detail::addSpheres(brick, object, reach);
    return brick;
}

} // namespace example
