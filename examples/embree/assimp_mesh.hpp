// Meshes in STL and glTF files, which Assimp reads. PLY and OBJ have readers of our own: docs/rendering.md says why.
#pragma once

#include "mesh.hpp"

#if defined(DFB_RENDER_HAS_ASSIMP)
#include <assimp/Importer.hpp>
#include <assimp/material.h>
#include <assimp/postprocess.h>
#include <assimp/scene.h>
#endif

#include <algorithm>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace example {

inline bool isAssimpEnding(const std::string& ending)
{
    return ending == ".stl" || ending == ".gltf" || ending == ".glb";
}

#if defined(DFB_RENDER_HAS_ASSIMP)

namespace detail {

inline void requireUsable(const aiMesh& part, const std::string& name)
{
    for (unsigned i = 0; i < part.mNumVertices; ++i) {
        const aiVector3D& p = part.mVertices[i];
        if (!isUsable({p.x, p.y, p.z}))
            throw std::runtime_error(name + ": vertex " + std::to_string(i)
                                     + ": expected finite coordinates below 1e15");
    }
}

// Adds the triangles of a node and of those below it, where their transformations place them. Points and lines are left
// out. Throws std::runtime_error that begins with `name`.
inline void addNode(Mesh& mesh, const aiScene& scene, const aiNode& node, const aiMatrix4x4& above,
                    const std::string& name)
{
    const aiMatrix4x4 place = above * node.mTransformation;
    for (unsigned m = 0; m < node.mNumMeshes; ++m) {
        const aiMesh& part = *scene.mMeshes[node.mMeshes[m]];
        const std::size_t first = mesh.positions.size();
        if (first + part.mNumVertices > 0xffffffffu)
            throw std::runtime_error(name + ": more than 4294967295 vertices");
        aiColor4D base(1, 1, 1, 1);
        if (part.mMaterialIndex < scene.mNumMaterials)
            scene.mMaterials[part.mMaterialIndex]->Get(AI_MATKEY_COLOR_DIFFUSE, base);
        for (unsigned i = 0; i < part.mNumVertices; ++i) {
            const aiVector3D p = place * part.mVertices[i];
            const aiColor4D own = part.HasVertexColors(0) ? part.mColors[0][i] : aiColor4D(1, 1, 1, 1);
            const auto channel = [](float v) { return v > 0 ? std::min(v, 1.0f) : 0.0f; };
            addVertex(mesh, {p.x, p.y, p.z}, [&name] { return name + ": where a node moves a vertex"; });
            mesh.colors.push_back({channel(own.r * base.r), channel(own.g * base.g), channel(own.b * base.b)});
        }
        std::vector<std::int64_t> polygon;
        for (unsigned f = 0; f < part.mNumFaces; ++f) {
            const aiFace& face = part.mFaces[f];
            if (face.mNumIndices < 3)
                continue;
            polygon.clear();
            for (unsigned k = 0; k < face.mNumIndices; ++k)
                polygon.push_back(static_cast<std::int64_t>(first) + face.mIndices[k]);
            addPolygon(mesh, polygon, mesh.positions.size(), [&name] { return name; });
        }
    }
    for (unsigned c = 0; c < node.mNumChildren; ++c)
        addNode(mesh, scene, *node.mChildren[c], place, name);
}

} // namespace detail

// The triangles of all of a file's objects, with the colours of vertices and materials, if any is not white. Texture is
// not read. A .gltf is read with what it needs beside it. Throws std::runtime_error, one line that begins with `name`.
inline Mesh parseWithAssimp(std::string_view bytes, const std::string& name, Notes* = nullptr)
{
    const std::string ending = endingOf(name);
    Assimp::Importer importer;
    const aiScene* scene = ending == ".gltf"
                               ? importer.ReadFile(name, 0)
                               : importer.ReadFileFromMemory(bytes.data(), bytes.size(), 0, ending.c_str() + 1);
    // Before vertices are joined: one that is no number counts as equal to others there.
    for (unsigned m = 0; scene && m < scene->mNumMeshes; ++m)
        detail::requireUsable(*scene->mMeshes[m], name);
    if (scene && scene->mRootNode)
        scene = importer.ApplyPostProcessing(aiProcess_Triangulate | aiProcess_JoinIdenticalVertices
                                             | aiProcess_SortByPType);
    if (!scene || !scene->mRootNode) {
        std::string why = importer.GetErrorString();
        std::replace(why.begin(), why.end(), '\n', ' ');
        throw std::runtime_error(name + ": Assimp: " + why);
    }
    Mesh mesh;
    detail::addNode(mesh, *scene, *scene->mRootNode, aiMatrix4x4(), name);
    if (mesh.triangles.empty())
        throw std::runtime_error(name + ": there are no triangles");
    const bool isWhite = std::all_of(mesh.colors.begin(), mesh.colors.end(),
                                     [](const Vec3& c) { return c.x == 1 && c.y == 1 && c.z == 1; });
    if (isWhite)
        mesh.colors.clear();
    return mesh;
}

#else

inline Mesh parseWithAssimp(std::string_view, const std::string& name, Notes* = nullptr)
{
    throw std::runtime_error(name + ": this dfb_render was built without Assimp (Debian and Ubuntu: libassimp-dev)");
}

#endif

} // namespace example
