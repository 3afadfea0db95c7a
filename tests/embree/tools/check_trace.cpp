// check_trace TRACE STATS
// Succeeds if a trace of dfb_render agrees with the statistics of the same run in ranks, frames and bytes sent; if
// spans in a row are nested or disjoint; and if each arrow begins and ends in a span and goes forward in time.
#include <nlohmann/json.hpp>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <map>
#include <set>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace {

using nlohmann::json;

void require(bool condition, const std::string& what)
{
    if (!condition)
        throw std::runtime_error(what);
}

struct Span {
    double begin, end;
    std::string name;
    std::int64_t frame;
};
using Row = std::pair<int, int>; // process, thread

// Times in us have three digits: the end of one span and the begin of the next may differ by rounding.
constexpr double roundedUs = 1e-3;

void checkRow(std::vector<Span>& spans)
{
    std::stable_sort(spans.begin(), spans.end(), [](const Span& a, const Span& b) {
        return a.begin != b.begin ? a.begin < b.begin : a.end > b.end;
    });
    std::vector<Span> around;
    for (const Span& s : spans) {
        while (!around.empty() && around.back().end <= s.begin + roundedUs)
            around.pop_back();
        require(around.empty() || s.end <= around.back().end + roundedUs,
                s.name + " overlaps " + (around.empty() ? "" : around.back().name));
        around.push_back(s);
    }
}

void check(const json& trace, int ranks, std::int64_t frames, double bytes)
{
    require(trace.at("otherData").at("dropped") == 0, "events are missing");
    require(trace.at("otherData").at("clockErrorUs").size() == static_cast<std::size_t>(ranks), "clocks");
    std::map<Row, std::vector<Span>> rows;
    std::set<Row> named;
    std::set<int> processes;
    std::map<std::int64_t, std::pair<json, json>> arrows;
    std::map<std::string, std::map<std::int64_t, std::set<int>>> ranksOf; // by name and frame
    double sent = 0;
    for (const json& e : trace.at("traceEvents")) {
        const std::string phase = e.at("ph");
        const int pid = e.at("pid");
        if (phase == "M") {
            if (e.at("name") == "thread_name")
                named.insert({pid, e.at("tid")});
            else
                require(processes.insert(pid).second && e.at("args").at("name") == "rank " + std::to_string(pid),
                        "a rank that has another name");
            continue;
        }
        const double begin = e.at("ts");
        require(begin >= 0, "a time before the first");
        const Row row{pid, e.at("tid")};
        if (phase == "X") {
            const json& args = e.at("args");
            rows[row].push_back({begin, begin + e.at("dur").get<double>(), e.at("name"), args.at("frame")});
            ranksOf[e.at("name")][args.at("frame")].insert(pid);
            if (e.at("name") == "verdict")
                sent += args.value("bytes", 0.0);
        } else {
            require(phase == "s" || phase == "f", "an event that is not expected: " + phase);
            json& end = phase == "s" ? arrows[e.at("id")].first : arrows[e.at("id")].second;
            require(end.is_null(), "two arrows of a number");
            end = e;
        }
    }
    require(processes.size() == static_cast<std::size_t>(ranks), "ranks are missing");
    for (auto& [row, spans] : rows) {
        require(named.count(row) == 1, "a row without a name");
        checkRow(spans);
    }
    for (const char* name : {"frame", "render", "end", "verdict"})
        for (std::int64_t frame = 1; frame <= frames; ++frame)
            require(ranksOf[name][frame].size() == static_cast<std::size_t>(ranks),
                    std::string("not each rank has: ") + name);
    for (const char* name : {"tile", "setTile", "input", "finish", "wait"})
        require(!ranksOf[name].empty(), std::string("there is none: ") + name);
    for (const auto& [id, arrow] : arrows) {
        const auto& [from, to] = arrow;
        require(!from.is_null() && !to.is_null(), "an arrow with one end");
        require(from.at("name") == to.at("name") && from.at("pid") != to.at("pid"), "an arrow to itself");
        require(from.at("ts") <= to.at("ts"), "an arrow that goes back in time");
        for (const json* end : {&from, &to}) {
            const auto& spans = rows.at({end->at("pid"), end->at("tid")});
            const std::string name = (end == &from ? "send " : "receive ") + end->at("name").get<std::string>();
            require(std::any_of(spans.begin(), spans.end(),
                                [&](const Span& s) {
                                    return s.name == name
                                           && std::abs(s.begin - end->at("ts").get<double>()) < roundedUs;
                                }),
                    "an arrow to nowhere: " + name);
        }
    }
    require(ranks == 1 || arrows.size() >= static_cast<std::size_t>(ranks), "few arrows");
    require(std::abs(sent - bytes) <= 0.01 * bytes, std::to_string(sent) + " bytes, not " + std::to_string(bytes));
}

} // namespace

int main(int argc, char** argv)
{
    try {
        require(argc == 3, "usage: check_trace TRACE STATS");
        std::ifstream trace(argv[1]), file(argv[2]);
        const json stats = json::parse(file);
        double bytes = 0;
        for (const json& frame : stats.at("frames"))
            bytes += frame.at("bytes_sent").get<double>();
        check(json::parse(trace), stats.at("ranks"), static_cast<std::int64_t>(stats.at("frames").size()), bytes);
    } catch (const std::exception& e) {
        std::fprintf(stderr, "%s\n", e.what());
        return 1;
    }
    return 0;
}
