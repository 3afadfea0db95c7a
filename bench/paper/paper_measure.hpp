// Measurements for the paper's figures: ways to make an image, each of which has its turn from every view; and their
// results, as JSON lines and as a table.
#pragma once

#include "frame_times.hpp"
#include "results.hpp"

#include <dfb/frame.hpp>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdio>
#include <functional>
#include <string>
#include <vector>

namespace bench {

struct Measurement {
    int figure = 0, threads = 1;
    Result result;           // its time is that of a frame
    Figure render, overhead; // ms: until the slowest rank had rendered, and from then on
    Figure busiest;          // ms: CPU time of the rank with the most
    // From each view, the median over its repetitions, ms: of a frame; CPU time of the busiest rank.
    std::vector<double> views, busiestOfViews;

    std::string json() const
    {
        std::string text = result.json();
        text.pop_back(); // the brace
        char more[512];
        std::snprintf(more, sizeof more,
                      R"(, "figure": %d, "threads": %d, "views": %zu, "render_ms": %.4f, "render_mad_ms": %.4f, )"
                      R"("overhead_ms": %.4f, "overhead_mad_ms": %.4f, "busiest_cpu_ms": %.4f, "view_ms": [)",
                      figure, threads, views.size(), render.median, render.deviation, overhead.median,
                      overhead.deviation, busiest.median);
        text += more;
        const auto append = [&](const std::vector<double>& values) {
            for (std::size_t v = 0; v < values.size(); ++v)
                text += (v == 0 ? "" : ", ") + bench::text("%.3f", values[v]);
        };
        append(views);
        text += "], \"view_busiest_cpu_ms\": [";
        append(busiestOfViews);
        return text + "]}";
    }
};

// A way to make the image.
struct PaperWay {
    std::string system, config;
    std::function<double(int view)> frame{};     // collective; returns when this rank had rendered
    std::function<std::vector<float>()> image{}; // of the last frame, linear; on rank 0
    // Of the last frame, by all ranks: bytes and messages sent. Collective.
    std::function<std::array<double, 2>()> traffic{};
    std::function<dfb::FrameReport()> report{}; // of the last frame; may be null
    std::vector<std::vector<Times>> times{};    // of each view
    double maxError = -1;                       // found by a check
};

// Collective.
inline void measureWays(MPI_Comm comm, std::vector<PaperWay>& ways, int views, int repeats)
{
    FrameTimer timer(comm);
    for (PaperWay& way : ways)
        way.times.assign(static_cast<std::size_t>(views), {});
    std::size_t turn = 0;
    for (int repeat = -1; repeat < repeats; ++repeat)
        for (int v = 0; v < (repeat < 0 ? 1 : views); ++v, ++turn) // the first frame touches memory
            for (std::size_t i = 0; i < ways.size(); ++i) {
                PaperWay& way = ways[(i + turn) % ways.size()];
                const Times t = timer.time([&] { return way.frame(v); });
                if (repeat >= 0)
                    way.times[static_cast<std::size_t>(v)].push_back(t);
            }
}

// Collective.
inline Measurement measurementOf(const PaperWay& way)
{
    Measurement m;
    std::vector<double> image, render, overhead, cpu, busiest;
    for (const std::vector<Times>& view : way.times) {
        std::vector<double> ofView, busiestOfView;
        for (const Times& t : view) {
            ofView.push_back(t.image);
            busiestOfView.push_back(t.busiest);
            image.push_back(t.image);
            render.push_back(t.rendered);
            overhead.push_back(t.overhead());
            cpu.push_back(t.cpu);
            busiest.push_back(t.busiest);
        }
        m.views.push_back(medianOf(ofView));
        m.busiestOfViews.push_back(medianOf(busiestOfView));
    }
    m.result.bench = "bench_paper";
    m.result.system = way.system;
    m.result.config = way.config;
    m.result.ms = figureOf(image);
    m.result.cpuMs = figureOf(cpu);
    m.result.maxError = way.maxError;
    m.result.rmse = m.result.levels = -1; // not known
    m.render = figureOf(render);
    m.overhead = figureOf(overhead);
    m.busiest = figureOf(busiest);
    const std::array<double, 2> traffic = way.traffic();
    m.result.bytes = traffic[0];
    m.result.messages = traffic[1];
    if (way.report)
        m.result.peakMemoryBytes = static_cast<double>(way.report().peakMemoryBytes);
    return m;
}

inline std::string sizeText(const Measurement& m)
{
    return std::to_string(m.result.width) + 'x' + std::to_string(m.result.height);
}

// Appends to the files whose paths are not empty; throws std::runtime_error.
inline void writeMeasurements(const std::vector<Measurement>& all, const std::string& caption,
                              const std::string& jsonPath, const std::string& tablePath)
{
    // A speed is compared with that of the same way on the fewest ranks; in figures 9 and 10, which compare ways, with
    // that of the first way on as many ranks.
    const bool comparesWays = !all.empty() && all.front().figure >= 9;
    const auto isReference = [&](const Measurement& m, const Measurement& other) {
        return sizeText(other) == sizeText(m)
               && (comparesWays ? other.result.ranks == m.result.ranks
                                : other.result.config == m.result.config && other.result.system == m.result.system);
    };
    std::string table = "**" + caption + "**\n\n| size | ranks | | frame [ms] | local rendering [ms] | overhead [ms] | "
                        + (comparesWays ? "speed : the first's" : "speed-up")
                        + " | slowest view : fastest | CPU, all [ms] | CPU, busiest rank | MB sent |\n"
                          "|---|--:|---|--:|--:|--:|--:|--:|--:|--:|--:|\n";
    for (const Measurement& m : all) {
        const auto reference =
            std::find_if(all.begin(), all.end(), [&](const Measurement& o) { return isReference(m, o); });
        const auto [fastest, slowest] = std::minmax_element(m.views.begin(), m.views.end());
        table += "| " + sizeText(m) + " | " + std::to_string(m.result.ranks) + " | " + m.result.system + ": "
                 + m.result.config + " | " + text(m.result.ms) + " | " + text(m.render) + " | " + text(m.overhead)
                 + " | " + text(reference->result.ms.median / m.result.ms.median) + " | " + text(*slowest / *fastest)
                 + " | " + text(m.result.cpuMs) + " | " + text(m.busiest) + " | "
                 + (m.result.bytes > 0 ? text(1e-6 * m.result.bytes) : "-") + " |\n";
    }
    std::printf("\n%s\n", table.c_str());
    std::string lines;
    for (const Measurement& m : all)
        lines += m.json() + '\n';
    appendTo(jsonPath, lines);
    appendTo(tablePath, table + '\n');
}

} // namespace bench
