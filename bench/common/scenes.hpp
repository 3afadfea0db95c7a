// Scenes beside that of bricks, which differ in how much of the image each rank has.
#pragma once

#include "brick_images.hpp"

#include <array>
#include <cmath>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

namespace bench {

// Each rank has discs all over the image, together between a fifth and a quarter of its pixels. A renderer knows no
// bounds except the whole image.
class OverlapScene : public Scene {
public:
    // `turn`: moves the discs.
    OverlapScene(int ranks, int width, int height, double turn = 0)
        : Scene(ranks, width, height), cell_(std::max(4, height / 11)), turn_(turn)
    {
        std::vector<int> mixed = order();
        std::sort(mixed.begin(), mixed.end(), [](int a, int b) { return numbersOf(a, 0, 0) < numbersOf(b, 0, 0); });
        setOrder(std::move(mixed));
    }

private:
    // Random ones from 0 to 1, the same in every run.
    static std::array<double, 4> numbersOf(int rank, int column, int row)
    {
        std::array<double, 4> numbers{};
        auto h = static_cast<std::uint64_t>(((rank + std::int64_t{1}) * 4099 + column) * 4099 + row);
        for (double& number : numbers) {
            h += 0x9e3779b97f4a7c15u;
            std::uint64_t mixed = (h ^ h >> 30) * 0xbf58476d1ce4e5b9u;
            mixed = (mixed ^ mixed >> 27) * 0x94d049bb133111ebu;
            number = static_cast<double>((mixed ^ mixed >> 31) >> 11) * 0x1p-53;
        }
        return numbers;
    }

    // There is a disc in most cells of a grid. Each rank has a different grid.
    bool shade(int rank, int x, int y, float* rgba, float& depth) const override
    {
        const std::array<double, 4> shift = numbersOf(rank, -1, -1);
        const double column = (x + 0.5) / cell_ + shift[0] + turn_, row = (y + 0.5) / cell_ + shift[1];
        const auto [chance, size, left, above] = numbersOf(rank, static_cast<int>(column), static_cast<int>(row));
        const double radius = 0.2 + 0.25 * size, room = 1 - 2 * radius;
        const double dx = column - std::floor(column) - radius - left * room;
        const double dy = row - std::floor(row) - radius - above * room;
        const double inside = 1 - (dx * dx + dy * dy) / (radius * radius);
        if (chance > 0.65 || inside <= 0)
            return false;
        const auto [u, v] = positionOf(x, y);
        paint(rank, u, v, 0.2 + 0.6 * inside, rgba);
        depth = static_cast<float>(placeOf(rank) + 0.5 - 0.4 * inside);
        return true;
    }
    std::array<int, 4> viewportOf(const std::array<int, 4>&) const override { return {0, 0, width(), height()}; }

    int cell_;
    double turn_;
};

// Some ranks have all pixels of the image, all of them translucent; the others have none.
class DenseScene : public Scene {
public:
    // `turn`: moves what is seen.
    DenseScene(int ranks, int width, int height, std::vector<bool> has, double turn = 0)
        : Scene(ranks, width, height), has_(std::move(has)), turn_(turn)
    {
    }

private:
    bool shade(int rank, int x, int y, float* rgba, float& depth) const override
    {
        if (!has_[static_cast<std::size_t>(rank)])
            return false;
        const auto [u, v] = positionOf(x, y);
        paint(rank, u + turn_, v, 0.35 + 0.25 * std::sin(9 * (u + turn_) + rank) * std::sin(11 * v), rgba);
        depth = static_cast<float>(placeOf(rank) + 0.5 + 0.4 * std::sin(5 * u + 2 * v));
        return true;
    }

    std::vector<bool> has_;
    double turn_;
};

inline const std::vector<std::string>& sceneNames()
{
    static const std::vector<std::string> names{"bricks", "overlap", "dense", "one", "empty"};
    return names;
}

// `turn`: how far the camera has moved, in radians.
inline std::unique_ptr<Scene> makeScene(const std::string& name, int ranks, int width, int height, double turn = 0)
{
    const auto count = static_cast<std::size_t>(ranks);
    if (name == "bricks")
        return std::make_unique<BrickScene>(ranks, width, height, turn);
    if (name == "overlap")
        return std::make_unique<OverlapScene>(ranks, width, height, turn);
    if (name == "dense")
        return std::make_unique<DenseScene>(ranks, width, height, std::vector<bool>(count, true), turn);
    std::vector<bool> has(count, false);
    if (name == "empty")
        return std::make_unique<DenseScene>(ranks, width, height, has, turn);
    if (name != "one")
        throw std::invalid_argument("there is no scene " + name);
    has.back() = true; // not rank 0, which gets the image
    return std::make_unique<DenseScene>(ranks, width, height, has, turn);
}

} // namespace bench
