// The partial images that compositing starts from: each rank has one brick of a cube, seen from obliquely above, as a
// ray marcher would have rendered it; and what they make together, exactly.
#pragma once

#include "baselines.hpp"

#include <dfb/testing/reference.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <numeric>
#include <vector>

namespace bench {

struct BrickImage {
    int width = 0, height = 0;
    std::array<int, 4> viewport{}; // x, y, width, height of what is not empty
    std::vector<float> rgba;       // premultiplied, of the whole image; 4 a pixel
    std::vector<float> depth;      // infinite where there is nothing
};

class BrickScene {
public:
    BrickScene(int ranks, int width, int height) : width_(width), height_(height)
    {
        for (int left = ranks, axis = 0; left > 1; axis = (axis + 1) % 3) { // 2: 2x1x1, 4: 2x2x1, 8: 2x2x2, 16: 4x2x2
            int factor = 2;
            while (left % factor != 0)
                ++factor;
            cells_[static_cast<std::size_t>(axis)] *= factor;
            left /= factor;
        }
        // Front to back: in a grid of equal bricks that is the order of their centres along the view.
        order_.resize(static_cast<std::size_t>(ranks));
        std::iota(order_.begin(), order_.end(), 0);
        std::sort(order_.begin(), order_.end(), [this](int a, int b) { return centreDepth(a) < centreDepth(b); });
        place_.resize(order_.size());
        for (std::size_t i = 0; i < order_.size(); ++i)
            place_[static_cast<std::size_t>(order_[i])] = static_cast<int>(i);
    }

    const std::vector<int>& order() const { return order_; }

    BrickImage render(int rank) const
    {
        BrickImage image;
        image.width = width_;
        image.height = height_;
        const std::size_t pixels = static_cast<std::size_t>(width_) * static_cast<std::size_t>(height_);
        image.rgba.assign(4 * pixels, 0.0f);
        image.depth.assign(pixels, std::numeric_limits<float>::infinity());
        int x0 = width_, y0 = height_, x1 = 0, y1 = 0;
        for (int y = 0; y < height_; ++y)
            for (int x = 0; x < width_; ++x) {
                const std::size_t i =
                    static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(x);
                if (!shade(rank, x, y, &image.rgba[4 * i], image.depth[i]))
                    continue;
                x0 = std::min(x0, x), x1 = std::max(x1, x + 1);
                y0 = std::min(y0, y), y1 = std::max(y1, y + 1);
            }
        if (x1 > x0)
            image.viewport = {x0, y0, x1 - x0, y1 - y0};
        return image;
    }

    // What the images of all ranks make together; slow.
    std::vector<dfb::testing::Pixel> exact() const
    {
        std::vector<dfb::testing::Pixel> result;
        std::vector<BrickImage> all;
        for (const int other : order_)
            all.push_back(render(other));
        std::vector<dfb::testing::Sample> samples;
        for (std::size_t i = 0; i < all.front().depth.size(); ++i) {
            samples.clear();
            for (const BrickImage& image : all) {
                const float* p = &image.rgba[4 * i];
                if (p[0] != 0 || p[1] != 0 || p[2] != 0 || p[3] != 0)
                    samples.push_back({{p[0], p[1], p[2], p[3]}, image.depth[i], 0, 0});
            }
            result.push_back(dfb::testing::compositeInOrder(samples, {}));
        }
        return result;
    }

private:
    using Vec = std::array<double, 3>;

    static constexpr double azimuth = 0.6, elevation = 0.4;
    static Vec forward()
    {
        return {-std::cos(azimuth) * std::cos(elevation), -std::sin(azimuth) * std::cos(elevation),
                -std::sin(elevation)};
    }
    static Vec right() { return {-std::sin(azimuth), std::cos(azimuth), 0}; }
    static Vec up()
    {
        return {-std::cos(azimuth) * std::sin(elevation), -std::sin(azimuth) * std::sin(elevation),
                std::cos(elevation)};
    }

    // The lower corner of a brick of the cube [-1, 1]^3, and its size along an axis.
    double lower(int rank, std::size_t axis) const
    {
        const int stride = axis == 0 ? 1 : axis == 1 ? cells_[0] : cells_[0] * cells_[1];
        return -1 + 2.0 * (rank / stride % cells_[axis]) / cells_[axis];
    }
    double centreDepth(int rank) const
    {
        double depth = 0;
        for (std::size_t a = 0; a < 3; ++a)
            depth += forward()[a] * (lower(rank, a) + 1.0 / cells_[a]);
        return depth;
    }

    // The part of the ray within the brick absorbs and glows; false if there is none.
    bool shade(int rank, int x, int y, float* rgba, float& depth) const
    {
        const double u = 3.4 * (x + 0.5 - 0.5 * width_) / height_, v = 3.4 * (0.5 * height_ - y - 0.5) / height_;
        double enter = -10, leave = 10;
        for (std::size_t a = 0; a < 3; ++a) {
            const double origin = u * right()[a] + v * up()[a], to = forward()[a];
            const double t0 = (lower(rank, a) - origin) / to, t1 = (lower(rank, a) + 2.0 / cells_[a] - origin) / to;
            enter = std::max(enter, std::min(t0, t1));
            leave = std::min(leave, std::max(t0, t1));
        }
        if (!(leave > enter))
            return false;
        const double density = 0.8 + 0.7 * std::sin(9 * u + rank) * std::sin(11 * v);
        const double alpha = 1 - std::exp(-density * (leave - enter));
        for (int c = 0; c < 3; ++c)
            rgba[c] = static_cast<float>(alpha * (0.5 + 0.5 * std::sin(4 * u + 3 * v + 2 * c + rank)));
        rgba[3] = static_cast<float>(alpha);
        for (int c = 0; c < 3; ++c)
            rgba[c] = std::min(rgba[c], rgba[3]);
        // Grows from brick to brick, also where a ray meets two faces at once.
        depth = static_cast<float>(place_[static_cast<std::size_t>(rank)] + (enter + 10) / 20);
        return true;
    }

    int width_, height_;
    std::array<int, 3> cells_{1, 1, 1};
    std::vector<int> order_, place_; // front to back; and where each rank is in that
};

} // namespace bench
