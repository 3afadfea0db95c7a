// The files that are JSON, read and written. They are here together because the JSON library takes long to compile.
#include "options.hpp"
#include "output.hpp"
#include "transfer_file.hpp"

#include <nlohmann/json.hpp>

#include <cmath>
#include <set>
#include <stdexcept>
#include <utility>

namespace example {

namespace {

using Json = nlohmann::ordered_json;

std::string textOf(const Json& json)
{
    return json.dump(2, ' ', false, Json::error_handler_t::replace) + '\n'; // file names may have any bytes
}

// An option's value: a number, true or false if it is written like one, otherwise a text.
Json valueOf(const std::string& text)
{
    const Json value = Json::parse(text, nullptr, false);
    return (value.is_number() || value.is_boolean()) && value.dump() == text ? value : Json(text);
}

// The `value` of each rank.
template <class Rank, class Value>
Json ofRanks(const std::vector<Rank>& ranks, const Value& value)
{
    Json all = Json::array();
    for (const Rank& rank : ranks)
        all.push_back(value(rank));
    return all;
}

Json toJson(const RunStats& run)
{
    Json json;
    json["version"] = run.version;
    json["scene"] = run.scene;
    json["options"] = Json::object();
    for (const auto& [name, text] : run.options)
        json["options"][name] = valueOf(text);
    json["ranks"] = run.ranks.size();
    json["threads_of_ranks"] = ofRanks(run.ranks, [](const RankStats& r) { return r.threads; });
    json["transport"] = run.transport;
    json["mode"] = run.mode;
    json["width"] = run.width;
    json["height"] = run.height;
    json["image_hash"] = run.imageHash;
    json["mean_alpha"] = run.meanAlpha;
    const std::size_t slowest = slowestOf(run.ranks);
    json["slowest_rank"] = slowest;
    const auto add = [](auto& to, const auto& ranks, std::size_t which, const char* name, const auto& value) {
        to[name] = value(ranks[which]);
        to[std::string(name) + "_of_ranks"] = ofRanks(ranks, value);
    };
    add(json, run.ranks, slowest, "total_ms", [](const RankStats& r) { return r.totalMs; });
    add(json, run.ranks, slowest, "load_ms", [](const RankStats& r) { return r.times.loadMs; });
    add(json, run.ranks, slowest, "render_ms", [](const RankStats& r) { return r.times.renderMs; });
    add(json, run.ranks, slowest, "compositing_ms", [](const RankStats& r) { return r.times.compositingMs; });
    add(json, run.ranks, slowest, "write_ms", [](const RankStats& r) { return r.times.writeMs; });
    json["bytes_read_of_ranks"] = ofRanks(run.ranks, [](const RankStats& r) { return r.bytesRead; });
    json["run_ms"] = run.runMs;
    json["samples_taken"] = run.samplesTaken;
    json["samples_saved"] = run.samplesSaved;
    json["frames"] = Json::array();
    for (const FrameStats& frame : run.frames) {
        Json entry;
        using Rank = RankFrameStats;
        const std::size_t last = slowestOf(frame.ranks);
        entry["slowest_rank"] = last;
        add(entry, frame.ranks, last, "total_ms", [](const Rank& r) { return r.times.totalMs(); });
        add(entry, frame.ranks, last, "render_ms", [](const Rank& r) { return r.times.renderMs; });
        add(entry, frame.ranks, last, "compositing_ms", [](const Rank& r) { return r.times.compositingMs; });
        add(entry, frame.ranks, last, "write_ms", [](const Rank& r) { return r.times.writeMs; });
        entry["bytes_sent"] = frame.report.bytesSent;
        entry["messages_sent"] = frame.report.messagesSent;
        entry["tiles_total"] = frame.report.tilesTotal;
        entry["tiles_touched"] = frame.report.tilesTouched;
        entry["peak_memory_bytes"] = frame.report.peakMemoryBytes;
        entry["order_undefined_pixels"] = frame.report.orderUndefinedPixels;
        entry["merge_error_bound"] = frame.report.mergeErrorBound;
        entry["wire_color"] = dfb::nameOf(frame.report.wireColor);
        entry["wire_error_bound"] = frame.report.wireErrorBound;
        entry["compressed"] = frame.report.compressed;
        entry["compressed_links"] = frame.report.compressedLinks;
        entry["tiles_rendered"] = ofRanks(frame.ranks, [](const Rank& r) { return r.tilesRendered; });
        entry["work_of_ranks"] = ofRanks(frame.ranks, [](const Rank& r) { return r.work; });
        json["frames"].push_back(entry);
    }
    return json;
}

} // namespace

OptionsInFile parseJsonOptions(const std::string& text)
{
    const Json all = Json::parse(text, nullptr, false);
    if (!all.is_object())
        throw std::runtime_error("--config: the file is no JSON");
    OptionsInFile found;
    for (const auto& [name, value] : all.items()) {
        std::vector<std::string> words;
        for (const auto& word : value.is_array() ? value : Json::array({value})) {
            if (!word.is_string() && !word.is_number() && !word.is_boolean())
                throw std::runtime_error("--config: " + name + ": expected a text, a number, true or false");
            words.push_back(word.is_string() ? word.get<std::string>() : word.dump());
        }
        found.emplace_back(name, std::move(words));
    }
    return found;
}

std::string optionsText(const std::vector<std::string>& scene,
                        const std::vector<std::pair<std::string, std::string>>& given)
{
    Json json;
    json["scene"] = scene;
    for (const auto& [name, text] : given)
        json[name] = valueOf(text);
    return textOf(json);
}

TransferFile parseTransfer(const std::string& text, const std::string& path)
{
    const auto require = [&path](bool ok, const std::string& what) {
        if (!ok)
            throw std::runtime_error(path + ": " + what);
    };
    const auto onlyKeys = [&](const Json& object, const std::set<std::string>& known, const std::string& where) {
        require(object.is_object(), where + " is no object");
        for (const auto& item : object.items())
            require(known.count(item.key()) != 0, where + " has an unknown member '" + item.key() + "'");
    };
    const Json all = Json::parse(text, nullptr, false);
    require(!all.is_discarded(), "is not JSON");
    onlyKeys(all, {"range", "points"}, "the transfer function");
    require(all.contains("points") && all["points"].is_array() && all["points"].size() >= 2,
            "expected 'points', an array of two or more");
    TransferFile file;
    for (const Json& point : all["points"]) {
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
        const Json color = point.contains("color") ? point["color"] : Json();
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
    const Json range = all.contains("range") ? all["range"] : Json();
    require(range.is_null() || (file.points.front().value >= 0 && file.points.back().value <= 1),
            "with a 'range', values of points are from 0 to 1: 0 stands for its low end, 1 for its high end");
    if (range.is_null()) {
        file.range = {file.points.front().value, file.points.back().value};
        require(std::isnormal(1 / (file.range[1] - file.range[0])),
                "its values are too near or too far from each other");
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

void writeStats(const std::string& path, const RunStats& run) { writeText(path, textOf(toJson(run))); }

} // namespace example
