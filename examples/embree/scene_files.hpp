// The files of a scene: how they are read and added to it.
#pragma once

#include "assimp_mesh.hpp"
#include "hdf5_volume.hpp"
#include "obj.hpp"
#include "ply_share.hpp"
#include "scene.hpp"
#include "xyz_share.hpp"

#include <string>
#include <utility>

namespace example {

namespace detail {

// The two ways to read a kind of mesh file.
struct MeshReader {
    Mesh (*parse)(std::string_view bytes, const std::string& name, Notes* notes);
    std::optional<MeshShare> (*readShare)(const std::string& path, const Loaders& loaders, Notes* notes);
};

// For files that cannot be shared out.
inline std::optional<MeshShare> noShare(const std::string&, const Loaders&, Notes*) { return std::nullopt; }

inline std::string readCounted(const std::string& path, const Loaders& loaders)
{
    std::string bytes = readFile(path);
    *loaders.readCounter() += bytes.size();
    return bytes;
}

inline void addMesh(Scene& scene, const SceneFile& file, bool fit, const MeshReader& reader, const Loaders& loaders,
                    Notes& notes)
{
    const std::string& path = file.path;
    if (loaders.size() == 1)
        return scene.add(reader.parse(readCounted(path, loaders), path, &notes), fit, file.look, path);
    std::optional<MeshShare> share = reader.readShare(path, loaders, &notes);
    if (!share) {
        Mesh whole;
        loaders.gatherOf<char>([&] {
            if (loaders.rank() == 0)
                whole = reader.parse(readCounted(path, loaders), path, &notes);
            return std::vector<char>();
        });
        share = dealMesh(std::move(whole), loaders);
    }
    scene.add(std::move(*share), fit, loaders, file.look, path);
}

inline void addSpheres(Scene& scene, const SceneFile& file, bool fit, int frame, const Loaders& loaders, Notes& notes)
{
    const std::string& path = file.path;
    if (loaders.size() == 1)
        return scene.add(parseXyz(readCounted(path, loaders), path, frame, &notes), fit, file.look, path);
    std::optional<SphereShare> share = readXyzShare(path, frame, loaders, &notes);
    if (!share) { // rank 0 has all of them
        share.emplace();
        loaders.gatherOf<char>([&] {
            if (loaders.rank() == 0)
                share->spheres = parseXyz(readCounted(path, loaders), path, frame, &notes);
            return std::vector<char>();
        });
        share->first = loaders.beginsOf(share->spheres.size())[static_cast<std::size_t>(loaders.rank())];
    }
    scene.add(std::move(*share), fit, loaders, file.look, path);
}

} // namespace detail

// Collective: adds a file, whose ending tells its kind. Each rank reads a share of it. From a volume, it reads here
// what all ranks must know, and its own bricks later, in loadBrick(). From a mesh or spheres, it reads a run of the
// primitives, which exchangeBricks() sends to the bricks. If a file of primitives cannot be shared out, because its
// rows differ in form or it is wrong, rank 0 reads it alone. `xyzFrame` as for parseXyz(), `grid` and `lookOf` for
// volumes. Throws std::runtime_error that names the file, the same on all ranks.
inline void addFile(Scene& scene, const SceneFile& file, bool fit, int xyzFrame = 0, const Loaders& loaders = {},
                    const VoxelGrid& grid = {}, const LookOf& lookOf = {})
{
    const std::string& path = file.path;
    const std::string ending = endingOf(path);
    Notes notes;
    if (isHdf5(path))
        scene.add(openHdf5(path, loaders, grid, lookOf), fit, file.look);
    else if (isVolumeEnding(ending))
        scene.add(openVolume(path, loaders, grid, lookOf), fit, file.look);
    else if (ending == ".ply")
        detail::addMesh(scene, file, fit, {parsePly, readPlyShare}, loaders, notes);
    else if (ending == ".obj")
        detail::addMesh(scene, file, fit, {parseObj, readObjShare}, loaders, notes);
    else if (isAssimpEnding(ending))
        detail::addMesh(scene, file, fit, {parseWithAssimp, detail::noShare}, loaders, notes);
    else if (ending == ".xyz")
        detail::addSpheres(scene, file, fit, xyzFrame, loaders, notes);
    else
        throw std::runtime_error(
            path + ": unknown type '" + ending
            + "', expected .raw, .nrrd, .nhdr, .mha, .mhd, .h5:/dataset, .ply, .obj, .stl, .gltf, .glb "
              "or .xyz");
    for (std::string& note : loaders.linesOfFirst(notes))
        scene.notes.push_back(std::move(note));
}

} // namespace example
