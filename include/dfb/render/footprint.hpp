// Footprint: the convex part of an image that a convex thing may cover.
#pragma once

#include <dfb/image.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <utility>
#include <vector>

namespace dfb {

// In pixels; pixel (x, y) is the square from there to (x + 1, y + 1).
struct PixelPoint {
    double x = 0, y = 0;
};

class Footprint {
public:
    Footprint() = default; // nothing

    // The hull of these points, widened by `margin` pixels, within an image of this size.
    Footprint(std::vector<PixelPoint> points, double margin, int width, int height) : margin_(margin)
    {
        if (points.empty())
            return;
        hull_ = hullOf(std::move(points));
        double x0 = hull_[0].x, y0 = hull_[0].y, x1 = x0, y1 = y0;
        for (const PixelPoint& p : hull_) {
            x0 = std::min(x0, p.x), x1 = std::max(x1, p.x);
            y0 = std::min(y0, p.y), y1 = std::max(y1, p.y);
        }
        const auto pixel = [](double v) { return static_cast<int>(std::floor(std::clamp(v, -1e6, 1e6))); };
        const Region region{pixel(x0 - margin), pixel(y0 - margin), pixel(x1 + margin) + 1, pixel(y1 + margin) + 1};
        region_ = intersection({0, 0, width, height}, region);
        if (region_.empty())
            region_ = {};
    }

    static Footprint whole(int width, int height)
    {
        const double w = width, h = height;
        return Footprint({{0, 0}, {w, 0}, {w, h}, {0, h}}, 0, width, height);
    }

    // The smallest rectangle of pixels around it.
    const Region& region() const noexcept { return region_; }

    // Whether it meets a rectangle of pixels, borders and margin included.
    bool meets(const Region& r) const
    {
        if (intersection(region_, r).empty())
            return false;
        // Two convex sets are apart if and only if a line along an edge of one of them parts them. The rectangle's own
        // edges are the test above.
        const double xs[2] = {static_cast<double>(r.x0), static_cast<double>(r.x1)},
                     ys[2] = {static_cast<double>(r.y0), static_cast<double>(r.y1)};
        for (std::size_t i = 0; i < hull_.size(); ++i) {
            const PixelPoint &a = hull_[i], &b = hull_[(i + 1) % hull_.size()];
            const double nx = b.y - a.y, ny = a.x - b.x, length = std::hypot(nx, ny); // outwards
            if (length == 0)
                continue;
            double nearest = 1e300;
            for (const double x : xs)
                for (const double y : ys)
                    nearest = std::min(nearest, ((x - a.x) * nx + (y - a.y) * ny) / length);
            if (nearest > margin_)
                return false;
        }
        return true;
    }

private:
    // Andrew's monotone chain, such that the outside is to the right of each edge (y grows downwards).
    static std::vector<PixelPoint> hullOf(std::vector<PixelPoint> points)
    {
        std::sort(points.begin(), points.end(),
                  [](const PixelPoint& a, const PixelPoint& b) { return a.x != b.x ? a.x < b.x : a.y < b.y; });
        const auto turnsRight = [](const PixelPoint& o, const PixelPoint& a, const PixelPoint& b) {
            return (a.x - o.x) * (b.y - o.y) - (a.y - o.y) * (b.x - o.x) <= 0;
        };
        std::vector<PixelPoint> hull;
        for (int pass = 0; pass < 2; ++pass) {
            const std::size_t first = hull.size();
            for (const PixelPoint& p : points) {
                while (hull.size() >= first + 2 && turnsRight(hull[hull.size() - 2], hull.back(), p))
                    hull.pop_back();
                hull.push_back(p);
            }
            hull.pop_back();
            std::reverse(points.begin(), points.end());
        }
        return hull.empty() ? std::vector<PixelPoint>{points.front()} : hull;
    }

    std::vector<PixelPoint> hull_;
    double margin_ = 0;
    Region region_;
};

} // namespace dfb
