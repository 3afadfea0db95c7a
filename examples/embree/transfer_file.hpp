// Transfer functions from JSON files:
//
//     {"range": [0, 300], "points": [{"value": 0, "color": [0.2, 0.2, 0.3], "opacity": 0},
//                                    {"value": 1, "color": "#ffddaa", "opacity": 0.4}]}
//
// The values ascend. Without "range" they are values of the data. With "range", 0 and 1 stand for its two ends; with
// "range": "auto", for the ends of the range that is shown by default. Colours are sRGB. The opacity is that of a slab
// as thick as 1/256 of the volume's largest extent. Colour and opacity are linear between points.
#pragma once

#include "color_maps.hpp"
#include "file_look.hpp"

#include <nlohmann/json.hpp>

#include <set>
#include <stdexcept>
#include <string>
#include <vector>

namespace example {

struct TransferFile {
    TransferPoints points;    // in sRGB; value 0 stands for the start of the range, 1 for its end
    std::vector<float> range; // start and end, in values of the data; empty: "auto"
};

// Throws std::runtime_error that names the file and what is wrong.
inline TransferFile parseTransfer(const std::string& text, const std::string& path)
{
    using nlohmann::json;
    const auto require = [&path](bool ok, const std::string& what) {
        if (!ok)
            throw std::runtime_error(path + ": " + what);
    };
    const auto onlyKeys = [&](const json& object, const std::set<std::string>& known, const std::string& where) {
        require(object.is_object(), where + " is no object");
        for (const auto& item : object.items())
            require(known.count(item.key()) != 0, where + " has an unknown member '" + item.key() + "'");
    };
    const json all = json::parse(text, nullptr, false);
    require(!all.is_discarded(), "is not JSON");
    onlyKeys(all, {"range", "points"}, "the transfer function");
    require(all.contains("points") && all["points"].is_array() && all["points"].size() >= 2,
            "expected 'points', an array of two or more");
    TransferFile file;
    for (const json& point : all["points"]) {
        const std::string where = "point " + std::to_string(file.points.size());
        onlyKeys(point, {"value", "color", "opacity"}, where);
        const auto number = [&](const char* name) {
            require(point.contains(name) && point[name].is_number() && std::isfinite(point[name].get<float>()),
                    where + " has no finite number '" + name + "'");
            return point[name].get<float>();
        };
        TransferPoint p;
        p.value = number("value");
        p.opacity = number("opacity");
        require(p.opacity >= 0 && p.opacity <= 1, where + ": the opacity is not from 0 to 1");
        require(file.points.empty() || p.value > file.points.back().value,
                where + ": its value is not greater than the one before");
        const json color = point.contains("color") ? point["color"] : json();
        std::optional<Vec3> c;
        if (color.is_string())
            c = displayColor(color.get<std::string>());
        else if (color.is_array() && color.size() == 3 && color[0].is_number() && color[1].is_number()
                 && color[2].is_number())
            c = displayColor(color[0].dump() + ',' + color[1].dump() + ',' + color[2].dump());
        require(c.has_value(), where + ": 'color' is not [R, G, B] with numbers from 0 to 1, or \"#rrggbb\"");
        const Vec3 srgb = detail::displayOf(*c);
        p.r = srgb.x;
        p.g = srgb.y;
        p.b = srgb.z;
        file.points.push_back(p);
    }
    const json range = all.contains("range") ? all["range"] : json();
    if (range.is_null()) {
        file.range = {file.points.front().value, file.points.back().value};
        for (TransferPoint& p : file.points)
            p.value = (p.value - file.range[0]) / (file.range[1] - file.range[0]);
    } else if (range != "auto") {
        require(range.is_array() && range.size() == 2 && range[0].is_number() && range[1].is_number(),
                "'range' is not [LO, HI] or \"auto\"");
        file.range = {range[0].get<float>(), range[1].get<float>()};
        require(file.range[0] < file.range[1] && std::isfinite(file.range[1] - file.range[0]),
                "'range' is not [LO, HI] with the first less than the second");
    }
    return file;
}

} // namespace example
