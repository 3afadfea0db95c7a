// Mesh: triangles with shared vertices.
#pragma once

#include "text.hpp"
#include "vec.hpp"

#include <algorithm>
#include <array>
#include <cmath>
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
    std::vector<Vec3> colors{}; // of each vertex, linear RGB; or none
};

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

// Adds a polygon as a fan of triangles. Throws if an index is not from 0 to vertexCount - 1. `where()` returns the
// beginning of the error's text, also below.
template <class Where>
void addPolygon(Mesh& mesh, const std::vector<std::int64_t>& polygon, std::uint64_t vertexCount, const Where& where)
{
    if (polygon.size() < 3)
        throw std::runtime_error(where() + ": a face of " + std::to_string(polygon.size())
                                 + " vertices, expected 3 or more");
    for (const std::int64_t index : polygon)
        if (index < 0 || index >= static_cast<std::int64_t>(vertexCount))
            throw std::runtime_error(where() + ": a face with vertex " + std::to_string(index) + ", expected 0 to "
                                     + std::to_string(static_cast<std::int64_t>(vertexCount) - 1));
    for (std::size_t i = 2; i < polygon.size(); ++i)
        mesh.triangles.push_back({static_cast<std::uint32_t>(polygon[0]), static_cast<std::uint32_t>(polygon[i - 1]),
                                  static_cast<std::uint32_t>(polygon[i])});
}

template <class Where>
void addVertex(Mesh& mesh, const Vec3& p, const Where& where)
{
    if (!isUsable(p))
        throw std::runtime_error(where() + ": expected finite coordinates below 1e15");
    mesh.positions.push_back(p);
}

// The channels of 0xRRGGBB, each in [0, 1].
inline Vec3 colorOf(std::uint32_t rgb)
{
    const auto channel = [rgb](int shift) { return static_cast<float>(rgb >> shift & 255) / 255; };
    return {channel(16), channel(8), channel(0)};
}

// Converts a colour from sRGB, each channel in [0, 1].
inline Vec3 linearOf(const Vec3& srgb)
{
    const auto linear = [](float v) { return v <= 0.04045f ? v / 12.92f : std::pow((v + 0.055f) / 1.055f, 2.4f); };
    return {linear(srgb.x), linear(srgb.y), linear(srgb.z)};
}

inline bool isColor(const Vec3& c) { return c.x >= 0 && c.y >= 0 && c.z >= 0 && c.x <= 1 && c.y <= 1 && c.z <= 1; }

// Converts the vertex colours of a mesh from sRGB, as they are in a file. If some are missing or are no colours, all
// are left out.
inline void finishColors(Mesh& mesh, const std::string& name, Notes* notes)
{
    if (mesh.colors.empty())
        return;
    if (mesh.colors.size() == mesh.positions.size() && std::all_of(mesh.colors.begin(), mesh.colors.end(), isColor)) {
        for (Vec3& color : mesh.colors)
            color = linearOf(color);
        return;
    }
    mesh.colors.clear();
    if (notes)
        notes->push_back(name + ": the colours of vertices are left out: not all vertices have one from 0 to 1");
}

} // namespace detail

// The normal of a triangle; its length is twice the area.
inline Vec3d weightedNormal(const Mesh& mesh, const Triangle& t)
{
    const Vec3d a = toDouble(mesh.positions[t[0]]), b = toDouble(mesh.positions[t[1]]),
                c = toDouble(mesh.positions[t[2]]);
    return cross(b - a, c - a);
}

// The normal of a vertex: the mean of those of its triangles, weighted by area.
class NormalSum {
public:
    void add(const Vec3d& weighted)
    {
        sum_ = sum_ + weighted;
        size_ += length(weighted);
    }
    // Zero if there are no triangles, or if they cancel out up to rounding, as those of a two-sided sheet do.
    Vec3 unit() const { return length(sum_) > 1e-9 * size_ ? toFloat(example::unit(sum_)) : Vec3(); }

private:
    Vec3d sum_{};
    double size_ = 0;
};

// The unit normals of all vertices.
inline std::vector<Vec3> vertexNormals(const Mesh& mesh)
{
    std::vector<NormalSum> sums(mesh.positions.size());
    for (const Triangle& t : mesh.triangles) {
        const Vec3d normal = weightedNormal(mesh, t);
        for (const std::uint32_t i : t)
            sums[i].add(normal);
    }
    std::vector<Vec3> normals;
    normals.reserve(sums.size());
    for (const NormalSum& sum : sums)
        normals.push_back(sum.unit());
    return normals;
}

} // namespace example
