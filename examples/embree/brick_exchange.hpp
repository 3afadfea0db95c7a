// Sends primitives from the ranks that have read them to the ranks that render them.
#pragma once

#include "bricks.hpp"
#include "loaders.hpp"

#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

namespace example {

// The ranks that hold the brick of a cell: `count` consecutive ranks from `first` on, cyclically.
struct Holders {
    int first = 0, count = 1;
};

// The primitives of one cell.
struct CellSurfaces {
    std::vector<BrickMesh> meshes;
    std::vector<BrickSpheres> spheres;
};

namespace detail {

inline void pack(std::uint32_t cell, const BrickMesh& part, Loaders::Bytes& bytes)
{
    Loaders::pack(std::vector<std::uint32_t>{cell, 0, part.geometry}, bytes);
    Loaders::pack(part.mesh.positions, bytes);
    Loaders::pack(part.mesh.colors, bytes);
    Loaders::pack(part.normals, bytes);
    Loaders::pack(part.mesh.triangles, bytes);
    Loaders::pack(part.primitives, bytes);
}
inline void pack(std::uint32_t cell, const BrickSpheres& part, Loaders::Bytes& bytes)
{
    Loaders::pack(std::vector<std::uint32_t>{cell, 1, part.geometry}, bytes);
    Loaders::pack(part.spheres, bytes);
    Loaders::pack(part.primitives, bytes);
}

// Returns the part of the object with this geometry; adds one if there is none.
template <class Part, class Object>
Part& partWith(std::vector<Part>& parts, const std::vector<Object>& objects, std::uint32_t geometry)
{
    for (Part& part : parts)
        if (part.geometry == geometry)
            return part;
    for (const Object& object : objects)
        if (object.geometry == geometry)
            parts.push_back(emptyPartOf(object));
    return parts.back();
}

inline void unpackMesh(const std::byte*& at, BrickMesh& part)
{
    const std::size_t vertices = part.mesh.positions.size(), triangles = part.mesh.triangles.size();
    Loaders::unpack(at, part.mesh.positions);
    Loaders::unpack(at, part.mesh.colors);
    Loaders::unpack(at, part.normals);
    Loaders::unpack(at, part.mesh.triangles);
    Loaders::unpack(at, part.primitives);
    for (std::size_t i = triangles; i < part.mesh.triangles.size(); ++i)
        for (std::uint32_t& index : part.mesh.triangles[i])
            index += static_cast<std::uint32_t>(vertices);
}

} // namespace detail

// Collective: returns, for each cell by number, the primitives of those objects that the ranks have read in parts;
// nothing for cells that this rank does not hold. Primitives are in the order of the files. `reaches`: reachOf() of
// each cell. Removes the parts from `scene`.
inline std::vector<CellSurfaces> exchangeBricks(Scene& scene, const std::vector<Holders>& holders,
                                                const std::vector<Box>& reaches, const Loaders& loaders)
{
    std::vector<CellSurfaces> all(holders.size());
    const auto isPart = [](const auto& object) { return object.isPart; };
    if (std::none_of(scene.meshes.begin(), scene.meshes.end(), isPart)
        && std::none_of(scene.spheres.begin(), scene.spheres.end(), isPart))
        return all;
    const int ranks = loaders.size();
    std::vector<Loaders::Bytes> parts(static_cast<std::size_t>(ranks) + 1);
    const auto send = [&](const auto& object, const Box& box) { // which holds all of its primitives
        for (std::size_t cell = 0; cell < holders.size(); ++cell) {
            if (!box.overlaps(reaches[cell]))
                continue;
            const auto piece = detail::partIn(object, reaches[cell]);
            if (piece.primitives.empty())
                continue;
            const Holders& held = holders[cell];
            if (held.count >= ranks)
                detail::pack(static_cast<std::uint32_t>(cell), piece, parts.back());
            else
                for (int i = 0; i < held.count; ++i)
                    detail::pack(static_cast<std::uint32_t>(cell), piece,
                                 parts[static_cast<std::size_t>((held.first + i) % ranks)]);
        }
    };
    loaders.gatherOf<char>([&] { // object by object, to free each when it is packed
        for (MeshObject& object : scene.meshes)
            if (object.isPart) {
                Box box;
                for (const Vec3& p : object.mesh.positions)
                    box.grow(p);
                send(object, box);
                object.mesh = Mesh();
                object.normals = {};
            }
        for (SphereObject& object : scene.spheres)
            if (object.isPart) {
                Box box;
                for (const Sphere& sphere : object.spheres)
                    box.grow(sphere.center, sphere.radius);
                send(object, box);
                object.spheres = {};
            }
        return std::vector<char>();
    });
    std::vector<Loaders::Bytes> received = loaders.exchange(std::move(parts));
    for (Loaders::Bytes& bytes : received) { // by rank, and so in the order of the files
        for (const std::byte* at = bytes.data(); at != bytes.data() + bytes.size();) {
            std::vector<std::uint32_t> what;
            Loaders::unpack(at, what);
            CellSurfaces& cell = all[what[0]];
            if (what[1] == 0) {
                detail::unpackMesh(at, detail::partWith(cell.meshes, scene.meshes, what[2]));
            } else {
                BrickSpheres& part = detail::partWith(cell.spheres, scene.spheres, what[2]);
                Loaders::unpack(at, part.spheres);
                Loaders::unpack(at, part.primitives);
            }
        }
        bytes = Loaders::Bytes();
    }
    return all;
}

} // namespace example
