// Results: what a benchmark has found, as JSON lines.
#pragma once

#include "figures.hpp"

#include <algorithm>
#include <cstdio>
#include <fstream>
#include <string>
#include <vector>

namespace bench {

// One line of JSON. The errors are of the image before output conversion where the system has one, the levels after it.
struct Result {
    std::string bench, system, config, scene;
    int ranks = 0, width = 0, height = 0;
    std::string commit{};
    Figure ms{}, cpuMs{}, yieldMs{}; // yieldMs: of the CPU time, what waiting ranks have given away
    double bytes = 0, messages = 0;  // of all ranks, a frame
    double maxError = 0, rmse = 0;
    int levels = 0;              // by which an 8-bit value is off at most
    double peakMemoryBytes = -1; // of the rank with the most; below 0: not known
    std::string more{};          // further keys: , "key": value

    // The CPU time that was not given away while waiting.
    double workMs() const { return cpuMs.median - yieldMs.median; }

    std::string json() const
    {
        char text[2048];
        std::snprintf(
            text, sizeof text,
            R"({"bench": "%s", "system": "%s", "config": "%s", "scene": "%s", "ranks": %d, "width": %d, )"
            R"("height": %d, "median_ms": %.4f, "mad_ms": %.4f, "low_ms": %.4f, "high_ms": %.4f, "cpu_ms": %.3f, "yield_ms": %.3f, "bytes": %.0f, )"
            R"("messages": %.0f, "max_err": %.6g, "rmse": %.6g, "lsb_max": %d, "peak_memory_bytes": %.0f, )"
            R"("commit": "%s"%s})",
            bench.c_str(), system.c_str(), config.c_str(), scene.c_str(), ranks, width, height, ms.median, ms.deviation,
            ms.low, ms.high, cpuMs.median, yieldMs.median, bytes, messages, maxError, rmse, levels, peakMemoryBytes,
            commit.c_str(), more.c_str());
        return text;
    }
};

// Does nothing if the path is empty.
inline void appendJson(const std::string& path, const std::vector<Result>& results)
{
    std::string lines;
    for (const Result& r : results)
        lines += r.json() + '\n';
    appendTo(path, lines);
}

// Whether a file has a table, to which lines can be added. False, too, if there is no file.
inline bool hasTable(const std::string& path)
{
    std::ifstream file(path);
    for (std::string line; std::getline(file, line);)
        if (line.rfind("| ", 0) == 0)
            return true;
    return false;
}

// Whether no other result is at least as fast and as exact, and better in one.
inline bool isOnFront(const Result& r, const std::vector<Result>& all)
{
    return std::none_of(all.begin(), all.end(), [&](const Result& o) {
        return o.ms.median <= r.ms.median && o.maxError <= r.maxError
               && (o.ms.median < r.ms.median || o.maxError < r.maxError);
    });
}

} // namespace bench
