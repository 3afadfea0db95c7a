// OBJ: the reader that makes a mesh from an OBJ file, by tinyobjloader.
#pragma once

#include "mesh.hpp"

#include <tiny_obj_loader.h>

#include <charconv>
#include <sstream>
#include <string_view>

namespace example {

namespace detail {

// The next word of a line.
inline std::string_view nextObjWord(std::string_view& line)
{
    const char* space = " \t";
    line.remove_prefix(std::min(line.find_first_not_of(space), line.size()));
    const std::string_view word = line.substr(0, line.find_first_of(space));
    line.remove_prefix(word.size());
    return word;
}

// Takes a number, which may have a sign, from the front of a word. False if there is none or it is too large.
template <class Number>
bool takeObjNumber(std::string_view& word, Number& value)
{
    word.remove_prefix(word.size() > 1 && word[0] == '+' && word[1] != '-');
    const auto result = std::from_chars(word.data(), word.data() + word.size(), value);
    word.remove_prefix(static_cast<std::size_t>(result.ptr - word.data()));
    return result.ec == std::errc();
}

// tinyobjloader takes what is no number, or is not there, for 0, and cuts indices to 32 bits; so vertices and faces are
// looked at first. Lines end as they do there.
inline void checkObjLines(std::string_view bytes, const std::string& name)
{
    std::size_t lineNumber = 0;
    while (!bytes.empty()) {
        const std::size_t end = std::min(bytes.find_first_of("\r\n"), bytes.size());
        std::string_view line = bytes.substr(0, end);
        bytes.remove_prefix(std::min(end + (bytes.substr(end, 2) == "\r\n" ? 2 : 1), bytes.size()));
        ++lineNumber;
        const auto fail = [&](const char* expected) {
            throw std::runtime_error(name + ": line " + std::to_string(lineNumber) + ": expected " + expected);
        };
        const std::string_view kind = nextObjWord(line);
        if (kind == "v" && !line.empty()) {
            for (int i = 0; i < 3; ++i) {
                double value = 0;
                std::string_view word = nextObjWord(line);
                if (!takeObjNumber(word, value) || !word.empty() || !std::isfinite(value))
                    fail("'v x y z' with finite numbers");
            }
        } else if (kind == "f") {
            for (std::string_view word = nextObjWord(line); !word.empty(); word = nextObjWord(line)) {
                int index = 0;
                if (!takeObjNumber(word, index)
                    || !(word.empty() || (word[0] == '/' && word.find_first_not_of("/+-0123456789") == word.npos)))
                    fail("'f' with indices as in i, i/j, i//k or i/j/k");
            }
        }
    }
}

} // namespace detail

// The lines v and f; all else is skipped, polygons become fans. Throws std::runtime_error
// with `name`, what was expected and what was found.
inline Mesh parseObj(const std::string& bytes, const std::string& name)
{
    detail::checkObjLines(bytes, name);
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
