// Spheres: the atoms of a molecule, and the reader that makes them from XYZ files.
#pragma once

#include "vec.hpp"

#include <charconv>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace example {

struct Sphere {
    Vec3 center;
    float radius = 0;
    Vec3 color; // linear RGB
};

// For Loaders::fromFirst().
template <class Function>
void arraysOf(std::vector<Sphere>& spheres, const Function& function)
{
    function(spheres);
}

namespace detail {

// Radius by Bondi, in Angstrom; colour near the usual one (Corey, Pauling, Koltun).
inline Sphere atom(std::string_view element)
{
    struct Entry {
        const char* name;
        float radius;
        Vec3 color;
    };
    static const Entry entries[] = {{"H", 1.20f, {0.80f, 0.80f, 0.80f}}, {"C", 1.70f, {0.26f, 0.46f, 0.44f}},
                                    {"N", 1.55f, {0.10f, 0.24f, 0.62f}}, {"O", 1.52f, {0.72f, 0.24f, 0.14f}},
                                    {"S", 1.80f, {0.85f, 0.62f, 0.05f}}, {"P", 1.80f, {0.85f, 0.30f, 0.03f}}};
    Sphere sphere;
    sphere.radius = 1.7f;
    sphere.color = {0.55f, 0.20f, 0.50f};
    for (const Entry& entry : entries)
        if (element == entry.name) {
            sphere.radius = entry.radius;
            sphere.color = entry.color;
        }
    return sphere;
}

} // namespace detail

// A line with the count, a line of comment, then a line `element x y z` per sphere, in Angstrom. Throws
// std::runtime_error with `name`, what was expected and what was found.
inline std::vector<Sphere> parseXyz(std::string_view bytes, const std::string& name)
{
    std::size_t at = 0, lineNumber = 0;
    auto fail = [&](const std::string& why) {
        throw std::runtime_error(name + ": line " + std::to_string(lineNumber) + ": " + why);
    };
    auto nextLine = [&] {
        const std::size_t end = std::min(bytes.find('\n', at), bytes.size());
        const std::string_view line = bytes.substr(at, end - at);
        at = std::min(end + 1, bytes.size());
        ++lineNumber;
        return line;
    };
    auto nextWord = [](std::string_view& line) {
        const char* space = " \t\r\f\v";
        line.remove_prefix(std::min(line.find_first_not_of(space), line.size()));
        const std::string_view word = line.substr(0, line.find_first_of(space));
        line.remove_prefix(word.size());
        return word;
    };
    auto number = [](std::string_view word, auto& value) {
        const auto result = std::from_chars(word.data(), word.data() + word.size(), value);
        return !word.empty() && result.ec == std::errc() && result.ptr == word.data() + word.size();
    };

    std::string_view line = nextLine();
    std::uint64_t count = 0;
    if (!number(nextWord(line), count) || !nextWord(line).empty() || count == 0)
        fail("expected the number of atoms, 1 or more");
    if (count > bytes.size() / 8) // the shortest line is "C 0 0 0\n"
        fail("it says " + std::to_string(count) + " atoms, more than a file of " + std::to_string(bytes.size())
             + " bytes can hold");
    nextLine();

    std::vector<Sphere> spheres;
    spheres.reserve(static_cast<std::size_t>(count));
    while (spheres.size() < count) {
        if (at == bytes.size())
            fail("it ends early: expected " + std::to_string(count) + " atoms, got " + std::to_string(spheres.size()));
        line = nextLine();
        Sphere sphere = detail::atom(nextWord(line));
        const bool ok = number(nextWord(line), sphere.center.x) && number(nextWord(line), sphere.center.y)
                        && number(nextWord(line), sphere.center.z) && nextWord(line).empty() && isUsable(sphere.center);
        if (!ok)
            fail("expected 'element x y z' with finite numbers below 1e15");
        spheres.push_back(sphere);
    }
    while (at < bytes.size()) {
        line = nextLine();
        if (!nextWord(line).empty())
            fail("expected the end after " + std::to_string(count) + " atoms, got another line");
    }
    return spheres;
}

} // namespace example
