// Plots in the shape of the paper's: scaling over ranks with bars and an ideal line, bars of local rendering and
// compositing overhead, time per view; several side by side in one SVG.
#pragma once

#include "figures.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <fstream>
#include <set>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace bench {

struct PlotPoint {
    double x = 0, y = 0, low = 0, high = 0; // y may lie between low and high
};

struct PlotLine {
    std::string name;
    std::vector<PlotPoint> points;
    bool dashed = false;
    int colour = 0;
};

struct PlotBar {
    std::string name;                           // below it
    double lower = 0, upper = 0, deviation = 0; // rendering and overhead; of their sum
    int colour = 0;
};

class PaperPlots {
public:
    PaperPlots(std::string title, std::size_t columns) : title_(std::move(title)), columns_(columns) {}

    // Both axes logarithmic, x with a mark at each point's.
    void addScaling(const std::string& title, const std::string& yTitle, const std::vector<PlotLine>& lines)
    {
        double left = 1e300, right = 0, least = 1e300, most = 0;
        std::set<double> marks;
        for (const PlotLine& line : lines)
            for (const PlotPoint& p : line.points) {
                marks.insert(p.x);
                left = std::min(left, p.x), right = std::max(right, p.x);
                least = std::min(least, p.low > 0 ? p.low : p.y), most = std::max(most, std::max(p.high, p.y));
            }
        if (!(right > 0) || !(most > 0))
            return;
        left /= 1.15, right *= 1.15, least /= 1.2, most *= 1.2;
        const auto x = [&](double v) { return plotWidth * std::log(v / left) / std::log(right / left); };
        const auto y = [&](double v) { return plotHeight * (1 - std::log(v / least) / std::log(most / least)); };
        begin(title, "ranks", yTitle);
        for (const double mark : marks)
            tickX(x(mark), number(mark));
        const std::vector<double> digits =
            most < 8 * least ? std::vector<double>{1, 1.5, 2, 3, 4, 5, 7} : std::vector<double>{1, 2, 5};
        for (double base = 1e-4; base < most; base *= 10)
            for (const double digit : digits)
                if (const double v = digit * base; v >= least && v <= most)
                    tickY(y(v), number(v));
        drawLines(lines, x, y);
        end();
    }

    // Over the number of the view; both axes linear, y from 0.
    void addCurves(const std::string& title, const std::string& yTitle, const std::vector<PlotLine>& lines)
    {
        double right = 1, most = 0;
        for (const PlotLine& line : lines)
            for (const PlotPoint& p : line.points)
                right = std::max(right, p.x), most = std::max(most, std::max(p.high, p.y));
        if (!(most > 0))
            return;
        most *= 1.05;
        const auto x = [&](double v) { return plotWidth * v / right; };
        const auto y = [&](double v) { return plotHeight * (1 - v / most); };
        begin(title, "view", yTitle);
        for (double v = 0; v <= right; v += std::max(1.0, stepOf(right)))
            tickX(x(v), number(v));
        for (double v = 0; v <= most; v += stepOf(most))
            tickY(y(v), number(v));
        drawLines(lines, x, y);
        end();
    }

    // Groups of bars, each with a name below.
    void addBars(const std::string& title, const std::vector<std::pair<std::string, std::vector<PlotBar>>>& groups)
    {
        double most = 0, places = 0;
        for (const auto& [name, bars] : groups) {
            places += static_cast<double>(bars.size()) + 0.6;
            for (const PlotBar& bar : bars)
                most = std::max(most, bar.lower + bar.upper + bar.deviation);
        }
        if (!(most > 0))
            return;
        most *= 1.05;
        const auto y = [&](double v) { return plotHeight * (1 - v / most); };
        begin(title, "", "time of a frame [ms]");
        for (double v = 0; v <= most; v += stepOf(most))
            tickY(y(v), number(v));
        const double place = plotWidth / places;
        double at = 0.3 * place;
        for (const auto& [name, bars] : groups) {
            const double width = place * static_cast<double>(bars.size());
            text(at + width / 2, plotHeight + 34, name, "text-anchor=\"middle\"");
            for (const PlotBar& bar : bars) {
                const double sum = bar.lower + bar.upper, middle = at + place / 2;
                box(at + 0.06 * place, y(bar.lower), 0.88 * place, plotHeight - y(bar.lower), colours(bar.colour), 1);
                box(at + 0.06 * place, y(sum), 0.88 * place, y(bar.lower) - y(sum), colours(bar.colour), 0.4);
                line(middle, y(sum - bar.deviation), middle, y(sum + bar.deviation), "stroke=\"#333\"");
                text(middle, plotHeight + 17, bar.name, "text-anchor=\"middle\" font-size=\"9\"");
                at += place;
            }
            at += 0.6 * place;
        }
        box(plotWidth - 150, -50, 10, 10, "#555", 1);
        text(plotWidth - 135, -41, "local rendering", "");
        box(plotWidth - 150, -34, 10, 10, "#555", 0.4);
        text(plotWidth - 135, -25, "compositing overhead", "");
        end();
    }

    // Throws std::runtime_error.
    void write(const std::string& path) const
    {
        const std::size_t columns = std::min(columns_, panels_.size());
        if (columns == 0)
            return;
        const std::size_t rows = (panels_.size() + columns - 1) / columns;
        const double width = std::max(static_cast<double>(columns) * panelWidth,
                                      40 + 8 * static_cast<double>(title_.size())),
                     height = 44 + static_cast<double>(rows) * panelHeight;
        std::ofstream svg(path);
        svg << "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"" << width << "\" height=\"" << height
            << "\" font-family=\"sans-serif\" font-size=\"11\">\n<rect width=\"" << width << "\" height=\"" << height
            << "\" fill=\"white\"/>\n<text x=\"20\" y=\"28\" font-size=\"15\">" << title_ << "</text>\n";
        for (std::size_t i = 0; i < panels_.size(); ++i)
            svg << "<g transform=\"translate(" << 62 + panelWidth * static_cast<double>(i % columns) << ','
                << 122 + panelHeight * static_cast<double>(i / columns) << ")\">\n"
                << panels_[i] << "</g>\n";
        svg << "</svg>\n";
        if (!svg.flush())
            throw std::runtime_error("cannot write " + path);
    }

private:
    static constexpr double plotWidth = 340, plotHeight = 230, panelWidth = 430, panelHeight = 368;

    static const char* colours(int i)
    {
        static const char* const all[] = {"#0a58a8", "#c03020", "#2e8540", "#8a5a00", "#6a3d9a", "#607050"};
        return all[static_cast<std::size_t>(i) % 6];
    }
    static std::string number(double v) { return bench::text("%g", v); }
    // Of marks: 1, 2 or 5 times a power of 10, between 4 and 10 of them.
    static double stepOf(double range)
    {
        const double base = std::pow(10, std::floor(std::log10(range)));
        return range / base < 2 ? base / 5 : range / base < 5 ? base / 2 : base;
    }

    void put(const std::string& element) { panel_ += element + '\n'; }
    void line(double x0, double y0, double x1, double y1, const std::string& style)
    {
        put("<line x1=\"" + number(x0) + "\" y1=\"" + number(y0) + "\" x2=\"" + number(x1) + "\" y2=\"" + number(y1)
            + "\" " + style + "/>");
    }
    void text(double x, double y, const std::string& what, const std::string& style)
    {
        put("<text x=\"" + number(x) + "\" y=\"" + number(y) + "\" " + style + ">" + what + "</text>");
    }
    void box(double x, double y, double width, double height, const char* colour, double opacity)
    {
        put("<rect x=\"" + number(x) + "\" y=\"" + number(y) + "\" width=\"" + number(width) + "\" height=\""
            + number(std::max(0.0, height)) + "\" fill=\"" + colour + "\" fill-opacity=\"" + number(opacity) + "\"/>");
    }
    void tickX(double x, const std::string& name)
    {
        line(x, 0, x, plotHeight, "stroke=\"#ddd\"");
        text(x, plotHeight + 17, name, "text-anchor=\"middle\"");
    }
    void tickY(double y, const std::string& name)
    {
        line(0, y, plotWidth, y, "stroke=\"#ddd\"");
        text(-6, y + 4, name, "text-anchor=\"end\"");
    }

    void begin(const std::string& title, const std::string& xTitle, const std::string& yTitle)
    {
        panel_.clear();
        text(-46, -60, title, "font-size=\"12\" font-weight=\"bold\"");
        text(-46, -8, yTitle, "");
        text(plotWidth / 2, plotHeight + 36, xTitle, "text-anchor=\"middle\"");
        line(0, plotHeight, plotWidth, plotHeight, "stroke=\"#333\"");
        line(0, 0, 0, plotHeight, "stroke=\"#333\"");
    }
    void end() { panels_.push_back(panel_); }

    template <class X, class Y>
    void drawLines(const std::vector<PlotLine>& lines, const X& x, const Y& y)
    {
        int named = 0; // the legend has two columns
        for (const PlotLine& l : lines) {
            const std::string stroke = std::string("stroke=\"") + colours(l.colour) + "\" stroke-width=\"1.5\"",
                              style = stroke + (l.dashed ? " stroke-dasharray=\"5 4\" stroke-opacity=\"0.6\"" : "");
            std::string path;
            for (const PlotPoint& p : l.points) {
                path += number(x(p.x)) + ',' + number(y(p.y)) + ' ';
                if (l.dashed)
                    continue;
                if (p.high > p.low && p.low > 0)
                    line(x(p.x), y(p.low), x(p.x), y(p.high), stroke);
                put("<circle cx=\"" + number(x(p.x)) + "\" cy=\"" + number(y(p.y)) + "\" r=\"2.8\" fill=\""
                    + colours(l.colour) + "\"/>");
            }
            put("<polyline points=\"" + path + "\" fill=\"none\" " + style + "/>");
            if (l.name.empty())
                continue;
            const double x0 = named % 2 == 0 ? 0 : 185, y0 = named < 2 ? -44 : -28;
            ++named;
            line(x0, y0, x0 + 20, y0, style);
            text(x0 + 25, y0 + 4, l.name, "");
        }
    }

    std::string title_, panel_;
    std::size_t columns_; // at most
    std::vector<std::string> panels_;
};

} // namespace bench
