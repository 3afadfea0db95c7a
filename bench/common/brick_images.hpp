// Scene: the partial images that compositing starts from, and the exact image that they make together. BrickScene: each
// rank has one brick of a cube, seen obliquely from above, as a ray marcher would render it.
#pragma once

#include "brick_grid.hpp"

#include <dfb/testing/reference.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <numeric>
#include <utility>
#include <vector>

namespace bench {

struct PartialImage {
    int width = 0, height = 0;     // of the pixels that are stored
    int left = 0, top = 0;         // where they are in the image
    std::array<int, 4> viewport{}; // x, y, width, height of the part that may have pixels
    std::vector<float> rgba;       // premultiplied, 4 a pixel
    std::vector<float> depth;      // infinite where there is nothing

    // Makes all pixels that are stored empty.
    void clear()
    {
        const std::size_t pixels = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
        rgba.assign(4 * pixels, 0.0f);
        depth.assign(pixels, std::numeric_limits<float>::infinity());
    }
    // The index of a pixel of the image, which must be stored.
    std::size_t indexOf(int x, int y) const
    {
        return static_cast<std::size_t>(y - top) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x - left);
    }
};

// The exact image, in every rowStep-th row from the first on.
struct ExactImage {
    int width = 0, rowStep = 1;
    std::vector<dfb::testing::Pixel> pixels{};
    std::vector<std::uint8_t> levels{}; // the same in 8 bits, 4 a pixel

    void add(const dfb::testing::Pixel& pixel)
    {
        pixels.push_back(pixel);
        for (const dfb::testing::Exact value : pixel.rgba)
            levels.push_back(dfb::testing::toUnorm8(value));
    }
};

// The part of an image that each rank has. The ranks are in the same order of depth in each pixel.
class Scene {
public:
    Scene(const Scene&) = delete;
    Scene& operator=(const Scene&) = delete;
    virtual ~Scene() = default;

    int width() const { return width_; }
    int height() const { return height_; }
    // The ranks, front to back.
    const std::vector<int>& order() const { return order_; }

    PartialImage render(int rank) const
    {
        PartialImage image;
        image.width = width_;
        image.height = height_;
        image.clear();
        const auto [left, top, columns, rows] = boundsOf(rank);
        int x0 = width_, y0 = height_, x1 = 0, y1 = 0;
        for (int y = top; y < top + rows; ++y)
            for (int x = left; x < left + columns; ++x) {
                const std::size_t i = image.indexOf(x, y);
                if (!shade(rank, x, y, &image.rgba[4 * i], image.depth[i]))
                    continue;
                x0 = std::min(x0, x), x1 = std::max(x1, x + 1);
                y0 = std::min(y0, y), y1 = std::max(y1, y + 1);
            }
        if (x1 > x0)
            image.viewport = viewportOf({x0, y0, x1 - x0, y1 - y0});
        return image;
    }

    // The same, but stores only the pixels in tiles of this size that the viewport meets, outside of which the rank has
    // no pixels. For many ranks at once, or for one after the other in the same memory.
    void renderPart(int rank, int tileSize, PartialImage& image) const
    {
        image.viewport = viewportOf(boundsOf(rank));
        const auto [x0, y0, columns, rows] = image.viewport;
        image.left = x0 / tileSize * tileSize;
        image.top = y0 / tileSize * tileSize;
        image.width = std::min((x0 + columns + tileSize - 1) / tileSize * tileSize, width_) - image.left;
        image.height = std::min((y0 + rows + tileSize - 1) / tileSize * tileSize, height_) - image.top;
        image.clear();
        for (int y = y0; y < y0 + rows; ++y)
            for (int x = x0; x < x0 + columns; ++x) {
                const std::size_t i = image.indexOf(x, y);
                shade(rank, x, y, &image.rgba[4 * i], image.depth[i]);
            }
    }

    // The exact image that the images of all ranks make together; slow. It stores none of these images, only the rows
    // that are asked for.
    ExactImage exact(int rowStep = 1) const
    {
        ExactImage result{width_, rowStep};
        std::vector<dfb::testing::Sample> samples;
        for (int y = 0; y < height_; y += rowStep)
            for (int x = 0; x < width_; ++x) {
                samples.clear();
                for (const int rank : order_)
                    if (dfb::testing::Sample s; shade(rank, x, y, s.rgba.data(), s.depth))
                        samples.push_back(s);
                result.add(dfb::testing::compositeInOrder(samples, {}));
            }
        return result;
    }

protected:
    // The order is that of the ranks, until it is set.
    Scene(int ranks, int width, int height) : width_(width), height_(height)
    {
        std::vector<int> order(static_cast<std::size_t>(ranks));
        std::iota(order.begin(), order.end(), 0);
        setOrder(std::move(order));
    }
    void setOrder(std::vector<int> order)
    {
        order_ = std::move(order);
        place_.resize(order_.size());
        for (std::size_t i = 0; i < order_.size(); ++i)
            place_[static_cast<std::size_t>(order_[i])] = static_cast<int>(i);
    }
    // The place of a rank in the order. Depths that grow with it keep the order.
    int placeOf(int rank) const { return place_[static_cast<std::size_t>(rank)]; }

    // The position of a pixel's centre; the image is 3.4 high, and 0 is in its middle.
    std::array<double, 2> positionOf(int x, int y) const
    {
        return {3.4 * (x + 0.5 - 0.5 * width_) / height_, 3.4 * (0.5 * height_ - y - 0.5) / height_};
    }
    // The pixel at such a position, or the nearest one if it is outside the image.
    std::array<int, 2> pixelAt(double u, double v) const
    {
        return {std::clamp(static_cast<int>(std::floor(u * height_ / 3.4 + 0.5 * width_)), 0, width_ - 1),
                std::clamp(static_cast<int>(std::floor(0.5 * height_ - v * height_ / 3.4)), 0, height_ - 1)};
    }
    // A rank's colour at a position, premultiplied.
    static void paint(int rank, double u, double v, double alpha, float* rgba)
    {
        rgba[3] = static_cast<float>(alpha);
        for (int c = 0; c < 3; ++c)
            rgba[c] =
                std::min(static_cast<float>(alpha * (0.5 + 0.5 * std::sin(4 * u + 3 * v + 2 * c + rank))), rgba[3]);
    }

private:
    // Stores a rank's premultiplied colour and depth in a pixel. Returns false, and stores nothing, if it has nothing
    // there.
    virtual bool shade(int rank, int x, int y, float* rgba, float& depth) const = 0;
    // The rectangle (x, y, width, height) outside of which a rank has nothing.
    virtual std::array<int, 4> boundsOf(int) const { return {0, 0, width_, height_}; }
    // The part of the image in which a renderer would look for pixels, given the part that has any.
    virtual std::array<int, 4> viewportOf(const std::array<int, 4>& used) const { return used; }

    int width_, height_;
    std::vector<int> order_, place_; // the ranks front to back; the place of each rank in that
};

class BrickScene : public Scene {
public:
    // `turn`: how far the camera has gone round the cube, in radians.
    BrickScene(int ranks, int width, int height, double turn = 0)
        : Scene(ranks, width, height), azimuth_(0.6 + turn), cells_(BrickGrid(ranks).cells)
    {
        // Front to back: in a grid of equal bricks that is the order of their centres along the view.
        std::vector<int> sorted = order();
        std::sort(sorted.begin(), sorted.end(), [this](int a, int b) { return centreDepth(a) < centreDepth(b); });
        setOrder(std::move(sorted));
    }

private:
    using Vec = std::array<double, 3>;

    static constexpr double elevation = 0.4;
    const Vec& forward() const { return axes_[0]; }
    const Vec& right() const { return axes_[1]; }
    const Vec& up() const { return axes_[2]; }

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

    // Around the brick's corners.
    std::array<int, 4> boundsOf(int rank) const override
    {
        int x0 = width(), y0 = height(), x1 = 0, y1 = 0;
        for (int corner = 0; corner < 8; ++corner) {
            double u = 0, v = 0;
            for (std::size_t a = 0; a < 3; ++a) {
                const double at = lower(rank, a) + (corner >> a & 1 ? 2.0 / cells_[a] : 0);
                u += at * right()[a];
                v += at * up()[a];
            }
            const auto [x, y] = pixelAt(u, v);
            x0 = std::min(x0, x), x1 = std::max(x1, x + 1);
            y0 = std::min(y0, y), y1 = std::max(y1, y + 1);
        }
        return {x0, y0, x1 - x0, y1 - y0};
    }

    // The part of the ray within the brick absorbs and glows; false if there is none.
    bool shade(int rank, int x, int y, float* rgba, float& depth) const override
    {
        const auto [u, v] = positionOf(x, y);
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
        paint(rank, u, v, alpha, rgba);
        // Grows from brick to brick, also where a ray meets two faces at once.
        depth = static_cast<float>(placeOf(rank) + (enter + 10) / 20);
        return true;
    }

    double azimuth_;
    std::array<Vec, 3> axes_{
        {{-std::cos(azimuth_) * std::cos(elevation), -std::sin(azimuth_) * std::cos(elevation), -std::sin(elevation)},
         {-std::sin(azimuth_), std::cos(azimuth_), 0},
         {-std::cos(azimuth_) * std::sin(elevation), -std::sin(azimuth_) * std::sin(elevation),
          std::cos(elevation)}}}; // of the camera: forward, right and up
    std::array<int, 3> cells_;
};

} // namespace bench
