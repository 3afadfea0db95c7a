// OBJ: the reader that makes a mesh from an OBJ file, by tinyobjloader.
#pragma once

#include "mesh.hpp"

#include <tiny_obj_loader.h>

#include <charconv>
#include <sstream>
#include <string_view>

namespace example {

namespace detail {

// tinyobjloader takes what is no number, or is not there, for 0; so the vertices are looked at first.
inline void checkObjVertices(std::string_view bytes, const std::string& name)
{
    std::size_t lineNumber = 0;
    while (!bytes.empty()) {
        const std::size_t end = std::min(bytes.find('\n'), bytes.size());
        std::string_view line = bytes.substr(0, end);
        bytes.remove_prefix(std::min(end + 1, bytes.size()));
        ++lineNumber;
        const char* space = " \t\r";
        const auto skipSpace = [&] { line.remove_prefix(std::min(line.find_first_not_of(space), line.size())); };
        skipSpace();
        if (line.size() < 2 || line[0] != 'v' || (line[1] != ' ' && line[1] != '\t'))
            continue;
        line.remove_prefix(1);
        for (int i = 0; i < 3; ++i) {
            skipSpace();
            line.remove_prefix(!line.empty() && line[0] == '+');
            double value = 0;
            const std::string_view word = line.substr(0, line.find_first_of(space));
            const auto result = std::from_chars(word.data(), word.data() + word.size(), value);
            if (word.empty() || result.ec != std::errc() || result.ptr != word.data() + word.size()
                || !std::isfinite(value))
                throw std::runtime_error(name + ": line " + std::to_string(lineNumber)
                                         + ": expected 'v x y z' with finite numbers");
            line.remove_prefix(word.size());
        }
    }
}

} // namespace detail

// The lines v and f; all else is skipped, polygons become fans. Throws std::runtime_error
// with `name`, what was expected and what was found.
inline Mesh parseObj(const std::string& bytes, const std::string& name)
{
    detail::checkObjVertices(bytes, name);
    struct State {
        Mesh mesh;
        std::string name;
        std::vector<std::int64_t> polygon;
    } state;
    state.name = name;

    tinyobj::callback_t callback;
    callback.vertex_cb = [](void* user, float x, float y, float z, float) {
        State& s = *static_cast<State*>(user);
        detail::addVertex(s.mesh, {x, y, z}, s.name);
    };
    callback.index_cb = [](void* user, tinyobj::index_t* indices, int count) {
        State& s = *static_cast<State*>(user);
        s.polygon.clear();
        for (int i = 0; i < count; ++i) { // from 1, or backwards from -1
            const std::int64_t index = indices[i].vertex_index;
            s.polygon.push_back(index > 0   ? index - 1
                                : index < 0 ? static_cast<std::int64_t>(s.mesh.positions.size()) + index
                                            : -1);
        }
        detail::addPolygon(s.mesh, s.polygon, s.name + ": after triangle " + std::to_string(s.mesh.triangles.size()));
    };
    std::istringstream stream(bytes);
    std::string warning, error;
    if (!tinyobj::LoadObjWithCallback(stream, callback, &state, nullptr, &warning, &error))
        throw std::runtime_error(name + ": " + (error.empty() ? "not an OBJ file" : error));
    if (state.mesh.triangles.empty())
        throw std::runtime_error(name + ": expected vertices and faces, got "
                                 + std::to_string(state.mesh.positions.size()) + " vertices and no faces");
    return std::move(state.mesh);
}

} // namespace example
