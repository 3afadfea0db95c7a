// Mesh: triangles with shared vertices.
#pragma once

#include "vec.hpp"

#include <array>
#include <cstdint>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace example {

using Triangle = std::array<std::uint32_t, 3>;

struct Mesh {
    std::vector<Vec3> positions;
    std::vector<Triangle> triangles;
};

// For Loaders::fromFirst(): all that a mesh is made of. Does not compile if there is anything else in it.
template <class Function>
void arraysOf(Mesh& mesh, const Function& function)
{
    auto& [positions, triangles] = mesh;
    function(positions, triangles);
}

// The whole file. Throws std::runtime_error if it cannot be read or is empty.
inline std::string readFile(const std::string& path)
{
    std::ifstream stream(path, std::ios::binary);
    if (!stream)
        throw std::runtime_error(path + ": cannot be opened");
    std::string bytes;
    std::vector<char> chunk(1 << 16);
    while (stream.read(chunk.data(), static_cast<std::streamsize>(chunk.size())), stream.gcount() > 0)
        bytes.append(chunk.data(), static_cast<std::size_t>(stream.gcount()));
    if (stream.bad() || bytes.empty())
        throw std::runtime_error(path + ": is empty or cannot be read");
    return bytes;
}

namespace detail {

// Fans a polygon; throws on an index that is no vertex.
inline void addPolygon(Mesh& mesh, const std::vector<std::int64_t>& polygon, const std::string& where)
{
    if (polygon.size() < 3)
        throw std::runtime_error(where + ": a face of " + std::to_string(polygon.size())
                                 + " vertices, expected 3 or more");
    for (const std::int64_t index : polygon)
        if (index < 0 || index >= static_cast<std::int64_t>(mesh.positions.size()))
            throw std::runtime_error(where + ": a face with vertex " + std::to_string(index) + ", expected 0 to "
                                     + std::to_string(static_cast<std::int64_t>(mesh.positions.size()) - 1));
    for (std::size_t i = 2; i < polygon.size(); ++i)
        mesh.triangles.push_back({static_cast<std::uint32_t>(polygon[0]), static_cast<std::uint32_t>(polygon[i - 1]),
                                  static_cast<std::uint32_t>(polygon[i])});
}

inline void addVertex(Mesh& mesh, const Vec3& p, const std::string& where)
{
    if (!isUsable(p))
        throw std::runtime_error(where + ": vertex " + std::to_string(mesh.positions.size())
                                 + ": expected finite coordinates below 1e15");
    mesh.positions.push_back(p);
}

} // namespace detail

// Unit vertex normals, the mean of the triangles around weighted by their area; zero where there are none.
inline std::vector<Vec3> vertexNormals(const Mesh& mesh)
{
    std::vector<Vec3d> sums(mesh.positions.size());
    for (const Triangle& t : mesh.triangles) {
        const Vec3d a(mesh.positions[t[0]]), b(mesh.positions[t[1]]), c(mesh.positions[t[2]]);
        const Vec3d normal = cross(b - a, c - a);
        for (const std::uint32_t i : t)
            sums[i] = sums[i] + normal;
    }
    std::vector<Vec3> normals;
    normals.reserve(sums.size());
    for (const Vec3d& sum : sums)
        normals.push_back(Vec3(normalize(sum)));
    return normals;
}

} // namespace example
