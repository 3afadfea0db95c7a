// FileLook: how and where one file is shown: its clip box, colour, opacity and placement, and for a volume its transfer
// function, range and isosurfaces. On the command line it follows the file's name:
// mesh.ply:color=0.8,0.2,0.1:opacity=0.5:translate=0,0,1
#pragma once

#include "mesh.hpp"
#include "text.hpp"

#include <array>
#include <cstddef>
#include <cstdlib>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace example {

// A value of the data, given directly or as the percentage of voxels that are smaller.
struct RangeEnd {
    float value = 0;
    bool isPercent = false;
};

struct FileLook {
    std::optional<Vec3> color;    // linear RGB
    std::optional<float> opacity; // of surfaces; for a volume a factor
    Vec3 translate;               // in the world, after the next two, which are about the centre of its box
    float scale = 1;
    Vec3 rotate;             // degrees about x, then y, then z
    std::optional<Box> clip; // in the file's own coordinates; what is outside is not shown
    std::string transfer;    // a name or a file; empty: from the histogram
    std::optional<std::array<RangeEnd, 2>> range;
    std::vector<float> isovalues; // if there are any and no `transfer`, they are all that is shown of a volume

    bool isPlaced() const { return scale != 1 || !isZero(translate) || !isZero(rotate); }
};

struct SceneFile {
    SceneFile(std::string itsPath = {}, FileLook itsLook = {}) : path(std::move(itsPath)), look(std::move(itsLook)) {}

    std::string path;
    FileLook look;
};

namespace detail {

// The finite number that the whole text is; none if it is not one.
inline std::optional<float> numberOf(const std::string& text)
{
    char* end = nullptr;
    const float value = std::strtof(text.c_str(), &end);
    const bool isNumber = !text.empty() && text.find_first_of(" \t") == std::string::npos && *end == '\0';
    return isNumber && std::isfinite(value) ? std::optional<float>(value) : std::nullopt;
}

inline std::vector<std::string> splitAt(const std::string& text, char separator)
{
    std::vector<std::string> parts(1);
    for (const char c : text)
        if (c == separator)
            parts.emplace_back();
        else
            parts.back() += c;
    return parts;
}

// The numbers of a comma-separated list; none if there are not `count` of them, unless that is 0.
inline std::vector<float> numbersOf(const std::string& text, std::size_t count)
{
    std::vector<float> numbers;
    for (const std::string& part : splitAt(text, ',')) {
        const std::optional<float> number = numberOf(part);
        if (!number)
            return {};
        numbers.push_back(*number);
    }
    return count == 0 || numbers.size() == count ? numbers : std::vector<float>();
}

// Returns an empty string if the path ends in one of `endings`, otherwise what is wrong with it, as CLI11 wants it.
inline std::string checkEnding(const std::string& path, const std::vector<std::string>& endings)
{
    std::string all;
    for (const std::string& ending : endings) {
        if (endingOf(path) == ending && path.size() > ending.size())
            return {};
        all += (all.empty() ? "" : ", ") + ending;
    }
    return "'" + path + "' has an unknown ending, expected " + all;
}

} // namespace detail

// The linear RGB of an sRGB colour, given as three numbers from 0 to 1 or as #rrggbb; none if it is no colour.
inline std::optional<Vec3> displayColor(const std::string& text)
{
    if (text.size() == 7 && text[0] == '#' && text.find_first_not_of("0123456789abcdefABCDEF", 1) == std::string::npos)
        return detail::linearOf(
            detail::colorOf(static_cast<std::uint32_t>(std::strtoul(text.c_str() + 1, nullptr, 16))));
    const std::vector<float> c = detail::numbersOf(text, 3);
    if (c.empty() || !detail::isColor({c[0], c[1], c[2]}))
        return std::nullopt;
    return detail::linearOf({c[0], c[1], c[2]});
}

// Sets what `key` names. Returns false if there is no such key. Throws std::invalid_argument, whose text does not name
// the key, if the value is wrong for it.
inline bool setLook(FileLook& look, const std::string& key, const std::string& value)
{
    const auto wrong = [&value](const char* what) { throw std::invalid_argument("'" + value + "' is not " + what); };
    const auto vector = [&](const char* what) {
        const std::vector<float> v = detail::numbersOf(value, 3);
        if (v.empty() || !isUsable({v[0], v[1], v[2]}))
            wrong(what);
        return v.empty() ? Vec3{} : Vec3{v[0], v[1], v[2]};
    };
    const auto one = [&](float lo, float hi, const char* what) {
        const std::optional<float> number = detail::numberOf(value);
        if (!number || !(*number >= lo && *number <= hi))
            wrong(what);
        return number.value_or(0);
    };
    if (key == "color") {
        look.color = displayColor(value);
        if (!look.color)
            wrong("R,G,B with three numbers from 0 to 1, or #rrggbb");
    } else if (key == "opacity") {
        look.opacity = one(0, 1, "a number from 0 to 1");
    } else if (key == "translate") {
        look.translate = vector("X,Y,Z, each below 1e15");
    } else if (key == "scale") {
        look.scale = one(1e-6f, 1e6f, "a number from 1e-6 to 1e6");
    } else if (key == "rotate") {
        look.rotate = vector("X,Y,Z in degrees, each below 1e15");
    } else if (key == "clip") {
        const std::vector<float> v = detail::numbersOf(value, 6);
        if (v.empty() || !(v[0] < v[3] && v[1] < v[4] && v[2] < v[5]))
            wrong("X0,Y0,Z0,X1,Y1,Z1 with each first number less than the second");
        look.clip.emplace();
        look.clip->lo = {v[0], v[1], v[2]};
        look.clip->hi = {v[3], v[4], v[5]};
    } else if (key == "transfer") {
        if (value.empty())
            wrong("a name or a file");
        look.transfer = value;
    } else if (key == "range") {
        const std::vector<std::string> ends = detail::splitAt(value, ',');
        std::array<RangeEnd, 2> range;
        for (std::size_t i = 0; i < 2; ++i) {
            std::string text = ends.size() == 2 ? ends[i] : "";
            range[i].isPercent = !text.empty() && text.back() == '%';
            if (range[i].isPercent)
                text.pop_back();
            const std::optional<float> number = detail::numberOf(text);
            if (!number || (range[i].isPercent && !(*number >= 0 && *number <= 100)))
                wrong("LO,HI with two values of the data, or percentages such as 1%,99.9%");
            range[i].value = number.value_or(0);
        }
        if (range[0].isPercent == range[1].isPercent && !(range[0].value < range[1].value))
            wrong("LO,HI with the first less than the second");
        look.range = range;
    } else if (key == "isovalue") {
        look.isovalues = detail::numbersOf(value, 0);
        if (look.isovalues.empty())
            wrong("a value, or several with commas between them");
        std::sort(look.isovalues.begin(), look.isovalues.end());
        look.isovalues.erase(std::unique(look.isovalues.begin(), look.isovalues.end()), look.isovalues.end());
    } else {
        return false;
    }
    return true;
}

// Parses a word of the command line: a path, followed by any number of :key=value. If the whole word ends like a scene
// file, it is a path. Otherwise the path ends where the trailing parts of the form `:key=value` begin. So paths may
// have colons. Throws std::invalid_argument if a key is unknown or its value is wrong.
inline SceneFile parseSceneFile(const std::string& word, const std::vector<std::string>& endings)
{
    SceneFile file{word, {}};
    std::vector<std::pair<std::string, std::string>> settings; // from the last to the first
    while (!detail::checkEnding(file.path, endings).empty()) {
        const std::size_t colon = file.path.rfind(':'), equals = file.path.find('=', std::min(colon, file.path.size()));
        if (colon == std::string::npos || equals == std::string::npos)
            break;
        settings.emplace_back(file.path.substr(colon + 1, equals - colon - 1), file.path.substr(equals + 1));
        file.path.resize(colon);
    }
    for (auto setting = settings.rbegin(); setting != settings.rend(); ++setting) {
        const auto& [key, value] = *setting;
        bool isKnown = false;
        try {
            isKnown = setLook(file.look, key, value);
        } catch (const std::invalid_argument& e) {
            throw std::invalid_argument("'" + word + "': " + key + ": " + e.what());
        }
        if (!isKnown)
            throw std::invalid_argument("'" + word + "': unknown '" + key
                                        + "', expected color, opacity, translate, scale, rotate, clip, transfer, "
                                          "range or isovalue");
    }
    return file;
}

} // namespace example
