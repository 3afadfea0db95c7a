// Scene: what there is to render, and the bricks that it is cut into.
//
// World space: each file is scaled and centred to fill the unit cube, unless told not to. Cells are a pure function of
// the bounds and their number, so every rank knows all of them, and two cells that share a face have exactly the same
// coordinate for it.
#pragma once

#include "clip.hpp"
#include "file_look.hpp"
#include "loaders.hpp"
#include "mesh_share.hpp"
#include "spheres.hpp"
#include "volume.hpp"

#include <cstdint>
#include <limits>
#include <string>
#include <utility>
#include <vector>

namespace example {

// Scanners store the rows of an image from the top, so a volume that is fitted is placed with y down and also with z
// backwards; otherwise it would be its own mirror image.
struct VolumeObject {
    VolumeSource source;
    Placement placement;        // of voxels by their index, before the rotation
    Rotation rotation;          // in the world
    Box shown;                  // in voxels; what is outside is clipped away
    std::uint32_t geometry = 0; // if it has isosurfaces

    // Throws std::runtime_error, which names the file, if floats have too few digits to tell the volume's voxels apart,
    // or if the clip box leaves nothing of it.
    VolumeObject(VolumeSource volume, bool fit, const FileLook& look = {}) : source(std::move(volume))
    {
        const Index3& d = source.info.dims;
        const Vec3 &origin = source.info.origin, &spacing = source.info.spacing;
        const Vec3 last{static_cast<float>(d[0] - 1), static_cast<float>(d[1] - 1), static_cast<float>(d[2] - 1)};
        shown.lo = {0, 0, 0};
        shown.hi = last;
        placement.scale = spacing;
        placement.offset = fit ? Vec3() : origin; // fitting centres it
        const Placement fitted = fitToUnitCube(upright(), fit);
        placement.offset = fitted.toWorld(placement.offset);
        placement.scale = placement.scale * fitted.size();
        if (fit) {
            const Vec3 sum = upright().lo + upright().hi;
            placement.scale = {placement.scale.x, -placement.scale.y, -placement.scale.z};
            placement.offset = {placement.offset.x, sum.y - placement.offset.y, sum.z - placement.offset.z};
        }
        if (look.isPlaced()) {
            const Vec3 center = upright().center();
            placement.scale = placement.scale * look.scale;
            placement.offset = center + (placement.offset - center) * look.scale + look.translate;
            rotation = Rotation(look.rotate, toDouble(upright().center()));
        }
        for (int axis = 0; axis < 3; ++axis)
            if (!(std::max(std::fabs(component(upright().lo, axis)), std::fabs(component(upright().hi, axis)))
                  <= 131072 * std::fabs(component(placement.scale, axis)))) // as far as addVolume() allows for rounding
                throw std::runtime_error(source.name + ": its voxels are too small beside "
                                         + (fit ? "its extent" : "the distance from 0 to its end")
                                         + ", which can be 131072 of their sides at most");
        if (!look.clip)
            return;
        const Placement inFile{spacing, origin};
        Box part;
        for (int axis = 0; axis < 3; ++axis) {
            const auto voxel = [&](const Vec3& p) {
                return (component(p, axis) - component(origin, axis)) / component(spacing, axis);
            };
            component(part.lo, axis) = voxel(look.clip->lo);
            component(part.hi, axis) = voxel(look.clip->hi);
        }
        shown = intersection(shown, part);
        if (!(shown.lo.x < shown.hi.x && shown.lo.y < shown.hi.y && shown.lo.z < shown.hi.z))
            throw std::runtime_error(source.name + ": the clip box leaves nothing of it; it goes from "
                                     + textOf(inFile.toWorld({0, 0, 0})) + " to " + textOf(inFile.toWorld(last)));
    }

    Vec3 toWorld(const Vec3& voxel) const { return toFloat(rotation.point(toDouble(placement.toWorld(voxel)))); }
    // The part of the domain that is shown. The domain is between the centres of the outer voxels.
    Box bounds() const { return rotation.box(upright()); }
    // The same before the rotation.
    Box upright() const
    {
        Box box;
        box.grow(placement.toWorld(shown.lo));
        box.grow(placement.toWorld(shown.hi));
        return box;
    }
};

// A mesh, or a run of its triangles if several ranks have loaded it together.
struct MeshObject {
    std::uint32_t geometry = 0; // number among the meshes and sphere sets of the scene
    Mesh mesh;                  // in world space
    std::vector<Vec3> normals;
    Vec3 color;                   // where vertices have none of their own
    std::optional<float> opacity; // none: that of the run
    std::optional<Clip> clip;
    std::uint32_t firstPrimitive = 0; // number of the first triangle in the whole mesh
    bool isPart = false;              // the other ranks have the rest
};

struct SphereObject {
    std::uint32_t geometry = 0;
    std::vector<Sphere> spheres; // in world space
    std::optional<float> opacity;
    std::optional<Clip> clip;
    std::uint32_t firstPrimitive = 0;
    bool isPart = false;
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
        if (!object.source.visible) // generated
            object.source.visible = visibleVoxels(object.source);
        const VisibleVoxels& visible = *object.source.visible;
        const float slack = static_cast<float>(visible.slack) * object.placement.largest();
        lookAt([&](const auto& take) {
            bool isEmpty = true;
            const Box reach = object.shown.padded(static_cast<float>(visible.slack));
            for (std::size_t i = 0; i + 1 < visible.points.size(); i += 2) { // the ends of a row
                const Box row{visible.points[i], visible.points[i + 1]};
                if (!reach.overlaps(row))
                    continue;
                for (const Vec3& end : {row.lo, row.hi})
                    take(object.toWorld(clamped(end, object.shown)), slack);
                isEmpty = false;
            }
            if (isEmpty) // the whole
                for (int i = 0; i < 8; ++i)
                    take(object.toWorld(object.shown.corner(i)), 0);
        });
        const std::vector<float>& isovalues = object.source.look.isovalues;
        noteOn(object.source,
               visible.points.empty() || (!isovalues.empty() && isovalues.back() <= object.source.info.least));
        volumes.push_back(std::move(object));
    }
    void add(Mesh mesh, bool fit, const FileLook& look = {}, const std::string& name = {})
    {
        MeshObject object = placed(mesh, fit, look, name);
        object.normals = vertexNormals(mesh);
        object.mesh = std::move(mesh);
        meshes.push_back(std::move(object));
    }
    void add(std::vector<Sphere> set, bool fit, const FileLook& look = {}, const std::string& name = {})
    {
        add(SphereShare{std::move(set), 0}, fit, {}, look, name);
    }

    // Collective: add this rank's share of a mesh or of spheres. They throw the same on all ranks.
    void add(MeshShare share, bool fit, const Loaders& loaders, const FileLook& look = {}, const std::string& name = {})
    {
        const VertexSet vertices(share.mesh.triangles);
        const VertexLookup lookup(vertices.list(), share.vertexBegins, loaders);
        MeshPart part = partOf(share, lookup, vertices);
        MeshObject object = placed(part.mesh, fit, look, name, loaders);
        object.normals = normalsOf(part, share.vertexBegins, lookup, loaders);
        object.firstPrimitive = static_cast<std::uint32_t>(share.firstTriangle);
        object.isPart = loaders.size() > 1;
        object.mesh = std::move(part.mesh);
        meshes.push_back(std::move(object));
    }
    void add(SphereShare share, bool fit, const Loaders& loaders, const FileLook& look = {},
             const std::string& name = {})
    {
        Box box;
        for (const Sphere& sphere : share.spheres)
            box.grow(sphere.center, sphere.radius);
        box = unionOf(box, loaders);
        const FileToWorld place(fitToUnitCube(box, fit), box, look);
        const Box seen = lookAt(
            [&](const auto& take) {
                for (const Sphere& sphere : share.spheres)
                    if (!look.clip) {
                        take(place.toWorld(sphere.center), sphere.radius * place.size());
                    } else {
                        Box part;
                        part.grow(sphere.center, sphere.radius);
                        takeCorners(intersection(part, *look.clip), place, take);
                    }
            },
            loaders);
        accept(seen, name, box);
        for (Sphere& sphere : share.spheres) {
            sphere.center = place.toWorld(sphere.center);
            sphere.radius *= place.size();
            if (look.color)
                sphere.color = *look.color;
        }
        spheres.push_back({nextGeometry_++, std::move(share.spheres), look.opacity, clipOf(look, place),
                           static_cast<std::uint32_t>(share.first), loaders.size() > 1});
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
    // The box of the vertices that triangles use; a file may have others.
    static Box boxOf(const Mesh& mesh)
    {
        Box box;
        for (const Triangle& triangle : mesh.triangles)
            for (const std::uint32_t index : triangle)
                box.grow(mesh.positions[index]);
        return box;
    }
    // Collective.
    static Box unionOf(const Box& own, const Loaders& loaders)
    {
        Box all;
        for (const Box& box : loaders.gatherOf<Box>([&] { return std::vector<Box>{own}; }))
            all.grow(box);
        return all;
    }

    // Collective: moves a mesh, or this rank's part of one, from its file's coordinates to the world, and adds it to
    // what the camera shows. The result still lacks the mesh, its normals and firstPrimitive.
    MeshObject placed(Mesh& mesh, bool fit, const FileLook& look, const std::string& name, const Loaders& loaders = {})
    {
        static const Vec3 palette[] = {
            {0.72f, 0.50f, 0.22f}, {0.16f, 0.42f, 0.62f}, {0.26f, 0.52f, 0.22f}, {0.62f, 0.20f, 0.18f}};
        const Box box = unionOf(boxOf(mesh), loaders);
        const FileToWorld place(fitToUnitCube(box, fit), box, look);
        MeshObject object;
        object.geometry = nextGeometry_++;
        object.color = look.color.value_or(palette[meshes.size() % 4]);
        object.opacity = look.opacity;
        object.clip = clipOf(look, place);
        if (look.color)
            mesh.colors.clear();
        const Box seen = lookAt(
            [&](const auto& take) {
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
            },
            loaders);
        accept(seen, name, box);
        for (Vec3& p : mesh.positions)
            p = place.toWorld(p);
        return object;
    }

    // `mayBeEmpty`: the rows that were looked at show nothing.
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
        const VolumeLook& look = source.look;
        const auto value = [&look](float v) { return (v - look.lo) * look.scale(); };
        const bool isAtLeast = !look.isovalues.empty() && look.isovalues.back() <= lo; // nothing is below the surface
        if ((look.hasIsovalueIn(lo, hi) && !isAtLeast)
            || !TransferFunction(1, look.points).isTransparent(value(lo), value(hi)))
            return;
        notes.push_back(source.name + ": there is nothing to see: "
                        + (lo == hi ? "all voxels are " + textOf(lo)
                                    : "all voxels, from " + textOf(lo) + " to " + textOf(hi) + ", are transparent"));
    }
    // Adds what is seen of a file to the bounds; throws if that is nothing. `box`: the file's box in its own
    // coordinates. These are float32, whose steps grow with the distance from 0: adds a note if they can be seen.
    void accept(const Box& seen, const std::string& name, const Box& box)
    {
        if (seen.empty() && !box.empty())
            throw std::runtime_error(name + ": the clip box leaves nothing of it; it goes from " + textOf(box.lo)
                                     + " to " + textOf(box.hi));
        grow(seen);
        float step = 0;
        for (const Vec3& corner : {box.lo, box.hi})
            for (int axis = 0; axis < 3 && !box.empty(); ++axis) {
                const float far = std::fabs(component(corner, axis));
                step = std::max(step, std::nextafter(far, std::numeric_limits<float>::max()) - far);
            }
        const float extent = box.empty() ? 0 : box.largestExtent();
        if (extent > 0 && step > extent / 2048)
            notes.push_back(name + ": its coordinates, from " + textOf(box.lo) + " to " + textOf(box.hi)
                            + ", were rounded to steps of " + textOf(step)
                            + ", as float32 has them: subtract the position of its centre to see more");
    }
    template <class Take>
    static void takeCorners(const Box& part, const FileToWorld& place, const Take& take)
    {
        for (int i = 0; i < 8 && !part.empty(); ++i)
            take(place.toWorld(part.corner(i)), 0);
    }

    // `forEach` calls its argument with the centre and radius of each sphere around an object, on each rank for the
    // rank's part of it. Returns the box around all spheres. Collective over the loaders.
    template <class ForEach>
    Box lookAt(const ForEach& forEach, const Loaders& loaders = {})
    {
        Box box;
        forEach([&](const Vec3& center, float radius) { box.grow(center, radius); });
        box = unionOf(box, loaders);
        const Vec3 middle = box.center();
        float reach = 0;
        forEach([&](const Vec3& center, float radius) { reach = std::max(reach, length(center - middle) + radius); });
        for (const float other : loaders.gatherOf<float>([&] { return std::vector<float>{reach}; }))
            reach = std::max(reach, other);
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
    std::vector<std::pair<Vec3, float>> balls_; // around the visible part of each object
    std::uint32_t nextGeometry_ = 0;
};

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

// The cells of `count` bricks, by brick id: the scene's own grid, or repeated bisection of the longest axis (in
// proportion if the number is odd).
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
    auto plane = [&](std::size_t axis, int i) {
        const int n = grid[axis];
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

} // namespace example
