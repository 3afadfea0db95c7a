// Random settings of a client, and the images of its ranks.
#pragma once

#include "api.hpp"

#include <algorithm>
#include <array>
#include <cstdint>
#include <numeric>
#include <random>
#include <set>
#include <vector>

namespace icet_test {

using Random = std::mt19937_64;

inline int pick(Random& random, int least, int most) { return std::uniform_int_distribution<int>(least, most)(random); }
inline bool chance(Random& random, double part) { return std::uniform_real_distribution<double>()(random) < part; }
inline double real(Random& random, double least, double most)
{
    return std::uniform_real_distribution<double>(least, most)(random);
}

struct Rect {
    int x = 0, y = 0, width = 0, height = 0;
    bool contains(int px, int py) const { return px >= x && px < x + width && py >= y && py < y + height; }
    std::array<int, 4> values() const { return {x, y, width, height}; }
};

struct Tile {
    Rect place;
    int displayRank = 0;
};

enum class Kind { NearestBytes, NearestFloats, NearestRgb, NearestDepth, BlendBytes, BlendFloats };

inline bool isBlend(Kind kind) { return kind == Kind::BlendBytes || kind == Kind::BlendFloats; }
inline bool isBytes(Kind kind) { return kind == Kind::NearestBytes || kind == Kind::BlendBytes; }
inline int channelsOf(Kind kind) { return kind == Kind::NearestDepth ? 0 : kind == Kind::NearestRgb ? 3 : 4; }

// The settings of a context. Those that are drawn anew are given to both libraries, the others stay as they are.
struct Setup {
    std::vector<Tile> tiles;
    Kind kind = Kind::NearestBytes;
    std::vector<IceTInt> order; // front to back
    bool ordered = false, corrects = false, oneBuffer = true, floats = true, rendersEmpty = false, draws = false;
    int extraWidth = 0, extraHeight = 0;      // of the rendered size
    std::vector<std::array<double, 6>> boxes; // of the ranks: x, x, y, y, z, z; none: no bounds
    std::vector<int> groups;                  // of the ranks, by data: each its own, or some the same

    Rect wall() const
    {
        Rect all = tiles.front().place;
        int right = all.x + all.width, top = all.y + all.height;
        for (const auto& [place, rank] : tiles) {
            all.x = std::min(all.x, place.x), all.y = std::min(all.y, place.y);
            right = std::max(right, place.x + place.width), top = std::max(top, place.y + place.height);
        }
        return {all.x, all.y, right - all.x, top - all.y};
    }
    bool replicates() const { return std::set<int>(groups.begin(), groups.end()).size() < groups.size(); }
};

// Gives each tile a rank of its own.
inline void drawDisplays(Random& random, int ranks, std::vector<Tile>& tiles)
{
    std::vector<int> displays(static_cast<std::size_t>(ranks));
    std::iota(displays.begin(), displays.end(), 0);
    std::shuffle(displays.begin(), displays.end(), random);
    for (std::size_t i = 0; i < tiles.size(); ++i)
        tiles[i].displayRank = displays[i];
}

// Tiles side by side, apart or over each other; at most one a rank.
inline std::vector<Tile> drawTiles(Random& random, int ranks)
{
    const int count = chance(random, 0.4) ? 1 : pick(random, 1, std::min(ranks, 4));
    const int most = chance(random, 0.2) ? 200 : 70, farthest = chance(random, 0.5) ? 120 : 40;
    std::vector<Tile> tiles;
    for (int i = 0; i < count; ++i)
        tiles.push_back({{i == 0 ? 0 : pick(random, 0, farthest), i == 0 ? 0 : pick(random, 0, farthest),
                          pick(random, 1, most), pick(random, 1, most)},
                         0});
    drawDisplays(random, ranks, tiles);
    return tiles;
}

// The image of one rank: a colour, and a depth below 1 where there is anything, all from hashes of the place.
class Picture {
public:
    Picture(std::uint64_t seed, Kind kind) : seed_(seed), kind_(kind)
    {
        cover_ = hash(1, 2, 3) % 4 == 0 ? 1.0 : static_cast<double>(hash(3, 2, 1) % 1000) / 1000;
        levels_ = hash(5, 5, 5) % 3 == 0 ? 3 : 1 << 24; // few depths make ties
    }

    bool isThere(int x, int y) const
    {
        const double block = part(hash(x / 16, y / 4, 7)), pixel = part(hash(x, y, 8));
        return block < cover_ && pixel < 0.9;
    }
    float depth(int x, int y) const
    {
        return isThere(x, y) ? static_cast<float>(hash(x, y, 9) % levels_) / static_cast<float>(levels_) : 1.0f;
    }
    std::array<std::uint8_t, 4> bytes(int x, int y) const
    {
        const std::uint64_t h = hash(x, y, 10);
        std::array<std::uint8_t, 4> rgba{};
        if (!isThere(x, y))
            return rgba;
        if (!isBlend(kind_)) { // any word, also 0
            for (std::size_t c = 0; c < 4; ++c)
                rgba[c] = h % 8 == 0 ? std::uint8_t{0} : static_cast<std::uint8_t>(h >> (8 * c));
            return rgba;
        }
        rgba[3] = h % 5 == 0 ? std::uint8_t{255} : static_cast<std::uint8_t>(h >> 24);
        for (std::size_t c = 0; c < 3; ++c)
            rgba[c] = static_cast<std::uint8_t>((h >> (8 * c + 32)) % (rgba[3] + 1u));
        if (isEmissive(x, y))
            rgba = {200, 100, 50, 0};
        return rgba;
    }
    std::array<float, 4> floats(int x, int y) const
    {
        std::array<float, 4> rgba{};
        if (!isThere(x, y))
            return rgba;
        const auto value = [&](int c) { return static_cast<float>(part(hash(x, y, 11 + c))); };
        if (!isBlend(kind_)) { // any value, as of a field
            for (int c = 0; c < 4; ++c)
                rgba[static_cast<std::size_t>(c)] = 2000 * value(c) - 1000;
            return rgba;
        }
        rgba[3] = hash(x, y, 10) % 5 == 0 ? 1.0f : value(3);
        for (int c = 0; c < 3; ++c)
            rgba[static_cast<std::size_t>(c)] = rgba[3] * value(c);
        if (isEmissive(x, y))
            rgba = {0.5f, 0.25f, 0.125f, 0};
        return rgba;
    }
    // Light without opacity, which IceT drops.
    bool isEmissive(int x, int y) const { return isBlend(kind_) && isThere(x, y) && hash(x, y, 12) % 100 == 0; }

private:
    std::uint64_t hash(int x, int y, int what) const
    {
        std::uint64_t h = seed_;
        for (const int value : {x, y, what}) {
            h = (h ^ static_cast<std::uint64_t>(value)) * 0x9e3779b97f4a7c15u;
            h ^= h >> 29;
            h *= 0xbf58476d1ce4e5b9u;
            h ^= h >> 32;
        }
        return h;
    }
    static double part(std::uint64_t h) { return static_cast<double>(h >> 11) * 0x1p-53; }

    std::uint64_t seed_, levels_ = 1;
    Kind kind_;
    double cover_ = 1;
};

} // namespace icet_test
