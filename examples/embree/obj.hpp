// OBJ: the reader that makes a mesh from an OBJ file.
//
// It is our own: tinyobjloader 2.0 reads wrong and missing numbers as 0, cuts indices to 32 bits, and gives its caller
// neither the lines nor the vertex colours to check.
#pragma once

#include "file_share.hpp"
#include "mesh_share.hpp"
#include "text.hpp"

#include <optional>

namespace example {

namespace detail {

// Parses some lines of a file, before which there are `verticesBefore` vertices. Colours stay as in the file.
inline Mesh parseObjLines(std::string_view bytes, const std::string& name, std::uint64_t verticesBefore)
{
    Mesh mesh;
    std::vector<std::int64_t> polygon;
    TextLines lines(bytes);
    const auto where = [&] { return name + ": line " + std::to_string(lines.number()); };
    const auto fail = [&](const std::string& why) { throw std::runtime_error(where() + ": " + why); };
    while (!lines.atEnd()) {
        std::string_view line = lines.next();
        line = line.substr(0, line.find('#'));
        const std::string_view kind = nextWord(line);
        if (kind == "v") {
            double v[7] = {};
            int count = 0;
            for (; count < 7; ++count) { // up to one more than with a colour
                const std::string_view word = nextWord(line);
                const bool isNumber = parseNumber(word, v[count]);
                if (count < 3 && !(isNumber && std::isfinite(v[count])))
                    fail("expected 'v x y z' with finite numbers, got '" + std::string(word) + "'");
                if (!isNumber)
                    break;
            }
            const auto at = [&v](int i) { return static_cast<float>(v[i]); };
            addVertex(mesh, {at(0), at(1), at(2)}, where);
            if (count == 6)
                mesh.colors.push_back({at(3), at(4), at(5)});
        } else if (kind == "f") {
            const std::int64_t vertices = static_cast<std::int64_t>(verticesBefore + mesh.positions.size());
            polygon.clear();
            for (std::string_view word = nextWord(line); !word.empty(); word = nextWord(line)) {
                std::string_view rest = word;
                std::int64_t index = 0; // from 1, or backwards from -1
                if (!takeNumber(rest, index)
                    || !(rest.empty() || (rest[0] == '/' && rest.find_first_not_of("/+-0123456789") == rest.npos)))
                    fail("expected 'f' with indices as in i, i/j, i//k or i/j/k, got '" + std::string(word) + "'");
                if (index == 0 || index > vertices || index < -vertices)
                    fail("a face with vertex " + std::to_string(index) + ", expected 1 to " + std::to_string(vertices)
                         + ", or -1 to -" + std::to_string(vertices));
                polygon.push_back(index > 0 ? index - 1 : vertices + index);
            }
            addPolygon(mesh, polygon, static_cast<std::uint64_t>(vertices), where);
        }
    }
    return mesh;
}

inline std::uint64_t countObjVertices(std::string_view bytes)
{
    std::uint64_t count = 0;
    for (TextLines lines(bytes); !lines.atEnd();) {
        std::string_view line = lines.next();
        count += nextWord(line) == "v";
    }
    return count;
}

} // namespace detail

// Reads the lines v, with or without a colour, and f. All others are skipped; polygons become fans of triangles. Throws
// std::runtime_error with `name`, the line, what was expected and what was found. `notes` gets what was left out, if
// not null.
inline Mesh parseObj(std::string_view bytes, const std::string& name, Notes* notes = nullptr)
{
    Mesh mesh = detail::parseObjLines(bytes, name, 0);
    if (mesh.triangles.empty())
        throw std::runtime_error(name + ": expected vertices and faces, got " + std::to_string(mesh.positions.size())
                                 + " vertices and no faces");
    detail::finishColors(mesh, name, notes);
    return mesh;
}

// Collective: the same, but each rank reads a share of the lines. Returns nothing, on all ranks, if anything is wrong;
// parseObj() of the whole file then says what.
inline std::optional<MeshShare> readObjShare(const std::string& path, const Loaders& loaders, Notes* notes)
{
    std::string bytes;
    std::uint64_t vertices = 0;
    if (!loaders.isOnAll([&] {
            bytes = readLinesOfShare(path, 0, fileSize(path), loaders);
            vertices = detail::countObjVertices(bytes);
            return true;
        }))
        return std::nullopt;
    MeshShare share;
    share.vertexBegins = loaders.beginsOf(vertices);
    if (!loaders.isOnAll([&] {
            share.mesh =
                detail::parseObjLines(bytes, path, share.vertexBegins[static_cast<std::size_t>(loaders.rank())]);
            bytes = std::string();
            return share.mesh.positions.size() == vertices; // a comment may cut a 'v' short
        }))
        return std::nullopt;
    return finished(std::move(share), path, loaders, notes);
}

} // namespace example
