// The paper's figures, drawn from what was measured.
#pragma once

#include "paper_measure.hpp"
#include "paper_plots.hpp"

#include <algorithm>
#include <iterator>
#include <string>
#include <utility>
#include <vector>

namespace bench {

inline std::string ranksOf(const Measurement& m)
{
    return std::to_string(m.result.ranks) + (m.result.ranks == 1 ? " rank" : " ranks");
}
inline std::string titleOf(const Measurement& m) { return m.result.system + ", " + m.result.config; }

// In the order in which they were measured.
template <class Key>
std::vector<std::string> distinct(const std::vector<Measurement>& of, const Key& key)
{
    std::vector<std::string> names;
    for (const Measurement& m : of)
        if (std::find(names.begin(), names.end(), key(m)) == names.end())
            names.push_back(key(m));
    return names;
}

// Frames a second over the number of ranks, for each group of `of`; and the ideal, if each rank helped as much as the
// first.
template <class Key>
std::vector<PlotLine> scalingOf(const std::vector<Measurement>& of, const Key& key, bool hasIdeal)
{
    std::vector<PlotLine> lines;
    int colour = 0;
    for (const std::string& name : distinct(of, key)) {
        PlotLine line{name, {}, false, colour}, ideal{"", {}, true, colour};
        ++colour;
        for (const Measurement& m : of)
            if (key(m) == name) {
                const double ranks = m.result.ranks, ms = m.result.ms.median, mad = m.result.ms.deviation;
                line.points.push_back({ranks, 1e3 / ms, 1e3 / (ms + mad), 1e3 / std::max(0.01 * ms, ms - mad)});
                const PlotPoint first = line.points.front();
                const double y = first.y * ranks / first.x;
                ideal.points.push_back({ranks, y, y, y});
            }
        lines.push_back(std::move(line));
        if (hasIdeal && ideal.points.size() > 1)
            lines.push_back(std::move(ideal));
    }
    return lines;
}

inline PlotBar barOf(const Measurement& m, const std::string& name, int colour)
{
    return {name, m.render.median, m.overhead.median, m.result.ms.deviation, colour};
}

// Draws nothing if there are no measurements. Throws std::runtime_error.
inline void drawFigure(int figure, const std::string& caption, const std::vector<Measurement>& found,
                       const std::string& path)
{
    const std::vector<std::string> sizes = distinct(found, sizeText);
    const auto ofSize = [&found](const std::string& size) {
        std::vector<Measurement> some;
        std::copy_if(found.begin(), found.end(), std::back_inserter(some),
                     [&](const Measurement& m) { return sizeText(m) == size; });
        return some;
    };
    PaperPlots plots(caption, figure == 9 ? sizes.size() : 2);
    const char* const rate = "frames/s (dashed: ideal)";
    if (figure == 6)
        for (const std::string& size : sizes)
            plots.addScaling(size, rate, scalingOf(ofSize(size), titleOf, true));
    if (figure == 7 || figure == 8) {
        plots.addScaling("(a) scaling", rate, scalingOf(found, sizeText, true));
        std::vector<std::pair<std::string, std::vector<PlotBar>>> groups;
        for (const std::string& size : sizes) {
            groups.emplace_back(size, std::vector<PlotBar>());
            for (const Measurement& m : ofSize(size))
                groups.back().second.push_back(
                    barOf(m, std::to_string(m.result.ranks), static_cast<int>(groups.size()) - 1));
        }
        plots.addBars("(b) parts of the time, by ranks", groups);
    }
    if (figure == 9) {
        for (const std::string& size : sizes)
            plots.addScaling(size, "frames/s", scalingOf(ofSize(size), titleOf, false));
        for (const std::string& size : sizes) {
            const std::vector<Measurement> some = ofSize(size);
            const std::vector<std::string> names = distinct(some, titleOf);
            std::vector<std::pair<std::string, std::vector<PlotBar>>> groups;
            for (const Measurement& m : some) {
                const std::string group = ranksOf(m);
                if (groups.empty() || groups.back().first != group)
                    groups.emplace_back(group, std::vector<PlotBar>());
                const auto colour = std::find(names.begin(), names.end(), titleOf(m)) - names.begin();
                groups.back().second.push_back(barOf(m, m.result.system, static_cast<int>(colour)));
            }
            plots.addBars(size, groups);
        }
    }
    if (figure == 10)
        for (const std::string& size : sizes)
            for (const std::string& ranks : distinct(found, ranksOf)) {
                const auto draw = [&](const char* yTitle, const auto& valuesOf) {
                    std::vector<PlotLine> lines;
                    for (const Measurement& m : found)
                        if (ranksOf(m) == ranks && sizeText(m) == size) {
                            PlotLine line{m.result.config, {}, false, static_cast<int>(lines.size())};
                            for (const double value : valuesOf(m))
                                line.points.push_back({static_cast<double>(line.points.size()), value, value, value});
                            lines.push_back(std::move(line));
                        }
                    plots.addCurves(ranks + ", " + size, yTitle, lines);
                };
                draw("time of a frame [ms]", [](const Measurement& m) { return m.views; });
                draw("CPU time of the busiest rank [ms]", [](const Measurement& m) { return m.busiestOfViews; });
            }
    plots.write(path);
}

} // namespace bench
