// Scene: what there is to render, and the bricks that it is cut into.
//
// World space: each file is scaled and centred to fill the unit cube, unless told not to. A brick is a half-open
// cell of the scene's bounds with all that can be seen in it: the voxels (with ghosts), and each primitive that
// touches it, under its index in the whole scene. Cells are a pure function of the bounds and their number, so every
// rank knows all of them, and two cells that share a face have the same number for it.
#pragma once

#include "clip.hpp"
#include "file_look.hpp"
#include "loaders.hpp"
#include "obj.hpp"
#include "ply.hpp"
#include "spheres.hpp"
#include "volume.hpp"

#include <cstdint>
#include <cstdio>
#include <string>
#include <utility>
#include <vector>

namespace example {

// Scanners store the rows of an image from the top, so a volume stands with y down and, to stay no mirror image of
// itself, with z backwards.
struct VolumeObject {
    VolumeSource source;
    Placement placement;
    Box shown;                  // in voxels; what is outside is clipped away
    std::uint32_t geometry = 0; // if it has isosurfaces

    // Throws std::runtime_error, which names the file, if nothing of it is left. It cannot be rotated.
    VolumeObject(VolumeSource volume, bool fit, const FileLook& look = {}) : source(std::move(volume))
    {
        const Index3& d = source.info.dims;
        const Vec3 last{static_cast<float>(d[0] - 1), static_cast<float>(d[1] - 1), static_cast<float>(d[2] - 1)};
        shown.lo = {0, 0, 0};
        shown.hi = last;
        placement = fitToUnitCube(bounds(), fit);
        const Vec3 sum = bounds().lo + bounds().hi;
        placement.scale = {placement.scale.x, -placement.scale.y, -placement.scale.z};
        placement.offset = {placement.offset.x, sum.y - placement.offset.y, sum.z - placement.offset.z};
        if (look.isPlaced()) {
            const Vec3 center = bounds().center();
            placement.scale = placement.scale * look.scale;
            placement.offset = center + (placement.offset - center) * look.scale + look.translate;
        }
        if (look.clip) {
            shown = intersection(shown, *look.clip);
            if (!(shown.lo.x < shown.hi.x && shown.lo.y < shown.hi.y && shown.lo.z < shown.hi.z))
                throw std::runtime_error(source.name + ": the clip box leaves nothing of it; it goes from 0,0,0 to "
                                         + textOf(last));
        }
    }

    // What is shown of the domain, which is between the centres of the outer voxels.
    Box bounds() const
    {
        Box box;
        box.grow(placement.toWorld(shown.lo));
        box.grow(placement.toWorld(shown.hi));
        return box;
    }
};

struct MeshObject {
    std::uint32_t geometry = 0; // number among the meshes and sphere sets of the scene
    Mesh mesh;                  // in world space
    std::vector<Vec3> normals;
    Vec3 color;                   // where vertices have none of their own
    std::optional<float> opacity; // none: that of the run
    std::optional<Clip> clip;
};

struct SphereObject {
    std::uint32_t geometry = 0;
    std::vector<Sphere> spheres; // in world space
    std::optional<float> opacity;
    std::optional<Clip> clip;
};

struct Scene {
    std::vector<VolumeObject> volumes;
    std::vector<MeshObject> meshes;
    std::vector<SphereObject> spheres;
    Box bounds;
    Index3 grid{0, 0, 0}; // of the cells, x fastest; zero: by bisection
    Notes notes;          // for the user

    // Each throws std::runtime_error, which names the file, if a clip box leaves nothing of it.
    void add(VolumeSource source, bool fit, const FileLook& look = {})
    {
        VolumeObject object(std::move(source), fit, look);
        if (!object.source.look.isovalues.empty())
            object.geometry = nextGeometry_++;
        grow(object.bounds());
        const VisibleVoxels visible = object.source.visible ? *object.source.visible : visibleVoxels(object.source);
        const float slack = static_cast<float>(visible.slack) * object.placement.size();
        lookAt([&](const auto& take) {
            bool isEmpty = true;
            for (const Vec3& p : visible.points)
                if (const float s = static_cast<float>(visible.slack); object.shown.padded(s).overlaps({p, p})) {
                    take(object.placement.toWorld(clamped(p, object.shown)), slack);
                    isEmpty = false;
                }
            if (isEmpty) // the whole
                for (int i = 0; i < 8; ++i)
                    take({i & 1 ? object.bounds().hi.x : object.bounds().lo.x,
                          i & 2 ? object.bounds().hi.y : object.bounds().lo.y,
                          i & 4 ? object.bounds().hi.z : object.bounds().lo.z},
                         0);
        });
        noteOn(object.source, visible.points.empty());
        volumes.push_back(std::move(object));
    }
    void add(Mesh mesh, bool fit, const FileLook& look = {}, const std::string& name = {})
    {
        Box box;
        for (const Triangle& triangle : mesh.triangles) // a file may hold vertices that nothing uses
            for (const std::uint32_t index : triangle)
                box.grow(mesh.positions[index]);
        const FileToWorld place(fitToUnitCube(box, fit), box, look);
        static const Vec3 palette[] = {
            {0.72f, 0.50f, 0.22f}, {0.16f, 0.42f, 0.62f}, {0.26f, 0.52f, 0.22f}, {0.62f, 0.20f, 0.18f}};
        MeshObject object;
        object.geometry = nextGeometry_++;
        object.color = look.color.value_or(palette[meshes.size() % 4]);
        object.opacity = look.opacity;
        object.clip = clipOf(look, place);
        if (look.color)
            mesh.colors.clear();
        const Box seen = lookAt([&](const auto& take) {
            for (const Triangle& triangle : mesh.triangles)
                if (!look.clip) {
                    for (const std::uint32_t index : triangle)
                        take(place.toWorld(mesh.positions[index]), 0);
                } else {
                    Box part;
                    for (const std::uint32_t index : triangle)
                        part.grow(mesh.positions[index]);
                    takeCorners(intersection(part, *look.clip), place, take);
                }
        });
        requireAnyOf(seen, name, box);
        for (Vec3& p : mesh.positions)
            p = place.toWorld(p);
        object.mesh = std::move(mesh);
        object.normals = vertexNormals(object.mesh);
        grow(seen);
        meshes.push_back(std::move(object));
    }
    void add(std::vector<Sphere> set, bool fit, const FileLook& look = {}, const std::string& name = {})
    {
        Box box;
        for (const Sphere& sphere : set)
            box.grow(sphere.center, sphere.radius);
        const FileToWorld place(fitToUnitCube(box, fit), box, look);
        const Box seen = lookAt([&](const auto& take) {
            for (const Sphere& sphere : set)
                if (!look.clip) {
                    take(place.toWorld(sphere.center), sphere.radius * place.size());
                } else {
                    Box part;
                    part.grow(sphere.center, sphere.radius);
                    takeCorners(intersection(part, *look.clip), place, take);
                }
        });
        requireAnyOf(seen, name, box);
        for (Sphere& sphere : set) {
            sphere.center = place.toWorld(sphere.center);
            sphere.radius *= place.size();
            if (look.color)
                sphere.color = *look.color;
        }
        grow(seen);
        spheres.push_back({nextGeometry_++, std::move(set), look.opacity, clipOf(look, place)});
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
        if (info.notFinite > 0)
            notes.push_back(source.name + ": voxels that are not finite: " + std::to_string(info.notFinite)
                            + "; they count as " + textOf(info.minimum));
        if (!mayBeEmpty)
            return;
        const auto [lo, hi] = source.range ? *source.range : rangeOf(source);
        const VolumeLook& look = source.look;
        const auto value = [&look](float v) { return (v - look.lo) * look.scale(); };
        if (look.hasIsovalueIn(lo, hi) || !TransferFunction(1, look.points).isTransparent(value(lo), value(hi)))
            return;
        notes.push_back(source.name + ": there is nothing to see: "
                        + (lo == hi ? "all voxels are " + textOf(lo)
                                    : "all voxels, from " + textOf(lo) + " to " + textOf(hi) + ", are transparent"));
    }
    // Of a file of which something is seen in the world; `box` is in its own coordinates.
    static void requireAnyOf(const Box& seen, const std::string& name, const Box& box)
    {
        if (seen.empty() && !box.empty())
            throw std::runtime_error(name + ": the clip box leaves nothing of it; it goes from " + textOf(box.lo)
                                     + " to " + textOf(box.hi));
    }
    template <class Take>
    static void takeCorners(const Box& part, const FileToWorld& place, const Take& take)
    {
        for (int i = 0; i < 8 && !part.empty(); ++i)
            take(place.toWorld(
                     {i & 1 ? part.hi.x : part.lo.x, i & 2 ? part.hi.y : part.lo.y, i & 4 ? part.hi.z : part.lo.z}),
                 0);
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
// whole of it until its bricks are loaded. `xyzFrame` as for parseXyz(), `lookOf` as for openVolume(). Throws
// std::runtime_error that names the file, the same on all ranks.
inline void addFile(Scene& scene, const std::string& path, bool fit, int xyzFrame = 0, const Loaders& loaders = {},
                    const FileLook& look = {}, const LookOf& lookOf = {})
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
    if (ending == ".raw")
        scene.add(openVolume(path, loaders, lookOf), fit, look);
    else if (ending == ".ply")
        scene.add(parsed(Mesh(), [&](Notes* notes) { return parsePly(bytes(), path, notes); }), fit, look, path);
    else if (ending == ".obj")
        scene.add(parsed(Mesh(), [&](Notes* notes) { return parseObj(bytes(), path, notes); }), fit, look, path);
    else if (ending == ".xyz")
        scene.add(parsed(std::vector<Sphere>(), [&](Notes* notes) { return parseXyz(bytes(), path, xyzFrame, notes); }),
                  fit, look, path);
    else
        throw std::runtime_error(path + ": unknown type '" + ending + "', expected .raw, .ply, .obj or .xyz");
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
    VolumeLook look;
    Box shown; // in voxels
    std::uint32_t geometry = 0;
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
    brick.volumes.push_back(
        {VoxelBlock(object.source, lo, hi), object.placement, object.source.look, object.shown, object.geometry});
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
    part.opacity = object.opacity;
    part.clip = object.clip;
    if (!part.primitives.empty())
        brick.meshes.push_back(std::move(part));
}

inline void addSpheres(Brick& brick, const SphereObject& object, const Box& reach)
{
    BrickSpheres part;
    part.geometry = object.geometry;
    part.opacity = object.opacity;
    part.clip = object.clip;
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
