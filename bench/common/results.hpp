// Results: what a benchmark has found, as JSON lines, as a table, and as a picture of error over time.
#pragma once

#include "figures.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace bench {

// One line of JSON. The errors are of the image before output conversion where the system has one, the levels after it.
struct Result {
    std::string bench, system, config, scene;
    int ranks = 0, width = 0, height = 0;
    Figure ms, cpuMs, yieldMs;      // yieldMs: of the CPU time, what waiting ranks have given away
    double bytes = 0, messages = 0; // of all ranks, a frame
    double maxError = 0, rmse = 0;
    int levels = 0;              // by which an 8-bit value is off at most
    double peakMemoryBytes = -1; // of the rank with the most; below 0: not known
    std::string commit;
    std::string more{}; // further keys: , "key": value

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

inline void appendJson(const std::string& path, const std::vector<Result>& results)
{
    std::ofstream file(path, std::ios::app);
    for (const Result& r : results)
        file << r.json() << '\n';
    if (!file.flush())
        throw std::runtime_error("cannot write " + path);
}

// Whether no other result is at least as fast and as exact, and better in one.
inline bool isOnFront(const Result& r, const std::vector<Result>& all)
{
    return std::none_of(all.begin(), all.end(), [&](const Result& o) {
        return o.ms.median <= r.ms.median && o.maxError <= r.maxError
               && (o.ms.median < r.ms.median || o.maxError < r.maxError);
    });
}

// Both axes logarithmic; errors below 1e-9 are drawn there. Those on the Pareto front are joined by a line.
inline void writeSvg(const std::string& path, const std::string& title, std::vector<Result> results)
{
    if (results.empty())
        return;
    std::sort(results.begin(), results.end(),
              [](const Result& a, const Result& b) { return a.ms.median < b.ms.median; });
    constexpr double left = 80, top = 130, plotWidth = 700, plotHeight = 460, least = 1e-9;
    double slowest = 0, fastest = 1e300, worst = 1e-6;
    for (const Result& r : results) {
        slowest = std::max(slowest, r.ms.median);
        fastest = std::min(fastest, r.ms.median);
        worst = std::max(worst, r.maxError);
    }
    fastest /= 1.15, slowest *= 1.6, worst *= 3;
    const auto x = [&](double ms) { return left + plotWidth * std::log(ms / fastest) / std::log(slowest / fastest); };
    const auto y = [&](double error) {
        return top + plotHeight * (1 - std::log(std::max(error, least) / least) / std::log(worst / least));
    };
    std::ofstream svg(path);
    svg << R"(<svg xmlns="http://www.w3.org/2000/svg" width="1000" height="660" font-family="sans-serif" font-size="12">)"
        << "\n<rect width=\"1000\" height=\"660\" fill=\"white\"/>\n<text x=\"" << left
        << "\" y=\"28\" font-size=\"16\">" << title << "</text>\n";
    const auto line = [&](double x0, double y0, double x1, double y1, const char* style) {
        svg << "<line x1=\"" << x0 << "\" y1=\"" << y0 << "\" x2=\"" << x1 << "\" y2=\"" << y1 << "\" " << style
            << "/>\n";
    };
    const auto label = [&](double px, double py, const std::string& text, const char* style) {
        svg << "<text x=\"" << px << "\" y=\"" << py << "\" " << style << ">" << text << "</text>\n";
    };
    char text[64];
    for (double error = least; error <= worst; error *= 10) {
        line(left, y(error), left + plotWidth, y(error), "stroke=\"#ddd\"");
        std::snprintf(text, sizeof text, "%.0e", error);
        label(left - 8, y(error) + 4, error == least ? std::string("0") : text, "text-anchor=\"end\"");
    }
    for (const double base : {0.1, 1.0, 10.0, 100.0, 1000.0})
        for (const double step : {1.0, 1.5, 2.0, 3.0, 5.0, 7.0})
            if (const double ms = base * step; ms >= fastest && ms <= slowest) {
                line(x(ms), top, x(ms), top + plotHeight, "stroke=\"#ddd\"");
                std::snprintf(text, sizeof text, "%g", ms);
                label(x(ms), top + plotHeight + 18, text, "text-anchor=\"middle\"");
            }
    label(left + plotWidth / 2, top + plotHeight + 42, "time of a frame [ms], median", "text-anchor=\"middle\"");
    label(20, top - 8, "largest error", "");
    double lastX = -1, lastY = -1;
    for (const Result& r : results) {
        const bool front = isOnFront(r, results);
        const char* colour = r.system == "dfb" ? "#0a58a8" : r.system == "icet" ? "#c03020" : "#607050";
        const double px = x(r.ms.median), py = y(r.maxError);
        if (front && lastX >= 0)
            line(lastX, lastY, px, py, "stroke=\"#0a0\" stroke-width=\"1.5\" stroke-dasharray=\"4 3\"");
        if (front)
            lastX = px, lastY = py;
        line(x(std::max(fastest, r.ms.median - r.ms.deviation)), py, x(r.ms.median + r.ms.deviation), py,
             "stroke=\"#999\"");
        svg << "<circle cx=\"" << px << "\" cy=\"" << py << "\" r=\"" << (front ? 5 : 3.5) << "\" fill=\"" << colour
            << "\"/>\n<text transform=\"translate(" << px + 7 << "," << py - 3
            << ") rotate(-42)\" font-size=\"10\" fill=\"" << colour << "\">" << r.system << ' '
            << r.config.substr(0, r.config.rfind(", to ")) << (front ? " *" : "") << "</text>\n";
    }
    svg << "</svg>\n";
    if (!svg.flush())
        throw std::runtime_error("cannot write " + path);
}

} // namespace bench
