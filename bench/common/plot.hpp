// A picture of some lines over a common axis, as SVG.
#pragma once

#include "figures.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <fstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace bench {

struct PlotLine {
    std::string name;
    std::vector<std::pair<double, double>> points;
    std::size_t colour = 0;
    bool isDashed = false;
};

class PlotAxis {
public:
    // Linear from 0 on, or logarithmic.
    explicit PlotAxis(bool isLogarithmic) : isLogarithmic_(isLogarithmic), low_(isLogarithmic ? 1e300 : 0) {}

    void include(double v)
    {
        low_ = std::min(low_, scaled(v));
        high_ = std::max(high_, scaled(v));
    }
    void widenToDecades()
    {
        low_ = std::floor(low_);
        high_ = std::ceil(high_);
    }

    // From 0 to 1.
    double placeOf(double v) const { return (scaled(v) - low_) / std::max(high_ - low_, 1e-9); }

    // Powers of `base`, or tenths of a linear axis.
    std::vector<double> marks(double base) const
    {
        std::vector<double> at;
        if (!isLogarithmic_)
            for (int i = 0; i <= 10; ++i)
                at.push_back(low_ + std::max(high_ - low_, 1e-9) * i / 10);
        else
            for (double e = std::ceil(low_ / std::log10(base) - 1e-3); e <= high_ / std::log10(base) + 1e-3; ++e)
                at.push_back(std::pow(base, e));
        return at;
    }

private:
    double scaled(double v) const { return isLogarithmic_ ? std::log10(v) : v; }

    bool isLogarithmic_;
    double low_, high_ = -1e300; // scaled
};

// Both axes logarithmic, or both linear.
inline void writePlot(const std::string& path, const std::string& title, const std::string& xLabel,
                      const std::string& yLabel, const std::vector<PlotLine>& lines, bool isLogarithmic)
{
    constexpr double left = 80, top = 60, plotWidth = 620, plotHeight = 440;
    PlotAxis xAxis(isLogarithmic), yAxis(isLogarithmic);
    for (const PlotLine& line : lines)
        for (const auto& [x, y] : line.points) {
            xAxis.include(x);
            yAxis.include(y);
        }
    if (isLogarithmic)
        yAxis.widenToDecades();
    const auto px = [&](double x) { return left + plotWidth * xAxis.placeOf(x); };
    const auto py = [&](double y) { return top + plotHeight * (1 - yAxis.placeOf(y)); };

    std::ofstream svg(path);
    svg << R"(<svg xmlns="http://www.w3.org/2000/svg" width="980" height="560" font-family="sans-serif" font-size="12">)"
        << "\n<rect width=\"980\" height=\"560\" fill=\"white\"/>\n<text x=\"" << left
        << "\" y=\"28\" font-size=\"16\">" << title << "</text>\n";
    const auto label = [&](double x, double y, const std::string& text, const char* style) {
        svg << "<text x=\"" << x << "\" y=\"" << y << "\" " << style << ">" << text << "</text>\n";
    };
    const auto rule = [&](double ax, double ay, double bx, double by) {
        svg << "<line x1=\"" << ax << "\" y1=\"" << ay << "\" x2=\"" << bx << "\" y2=\"" << by
            << "\" stroke=\"#ddd\"/>\n";
    };
    const auto number = [](double v) { return text("%.6g", v); };
    for (const double v : xAxis.marks(2)) {
        rule(px(v), top, px(v), top + plotHeight);
        label(px(v), top + plotHeight + 18, number(v), "text-anchor=\"middle\"");
    }
    for (const double v : yAxis.marks(10)) {
        rule(left, py(v), left + plotWidth, py(v));
        label(left - 8, py(v) + 4, number(v), "text-anchor=\"end\"");
    }
    label(left + plotWidth / 2, top + plotHeight + 42, xLabel, "text-anchor=\"middle\"");
    label(20, top - 10, yLabel, "");
    static const char* const colours[] = {"#0a58a8", "#c03020", "#2a8a30", "#8040a0", "#b07000", "#555555"};
    for (std::size_t i = 0; i < lines.size(); ++i) {
        const char* colour = colours[lines[i].colour % (sizeof colours / sizeof *colours)];
        svg << "<polyline fill=\"none\" stroke=\"" << colour << "\" stroke-width=\"2\""
            << (lines[i].isDashed ? " stroke-dasharray=\"6 4\"" : "") << " points=\"";
        for (const auto& [x, y] : lines[i].points)
            svg << px(x) << ',' << py(y) << ' ';
        svg << "\"/>\n";
        for (const auto& [x, y] : lines[i].points)
            svg << "<circle cx=\"" << px(x) << "\" cy=\"" << py(y) << "\" r=\"3\" fill=\"" << colour << "\"/>\n";
        const double row = top + 16 + 20 * static_cast<double>(i);
        svg << "<line x1=\"" << left + plotWidth + 20 << "\" y1=\"" << row - 4 << "\" x2=\"" << left + plotWidth + 50
            << "\" y2=\"" << row - 4 << "\" stroke=\"" << colour << "\" stroke-width=\"2\""
            << (lines[i].isDashed ? " stroke-dasharray=\"6 4\"" : "") << "/>\n";
        label(left + plotWidth + 58, row, lines[i].name, "");
    }
    svg << "</svg>\n";
    if (!svg.flush())
        throw std::runtime_error("cannot write " + path);
}

} // namespace bench
