// Finds where this rank has pixels: where the matrices project its vertices on the wall, or its share of that if other
// ranks have the same data.
#include "context.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace dfb_icet {

namespace {

using Vector = std::array<double, 4>;

Vector times(const std::array<double, 16>& matrix, const Vector& v)
{
    Vector out{};
    for (std::size_t column = 0; column < 4; ++column)
        for (std::size_t row = 0; row < 4; ++row)
            out[row] += matrix[4 * column + row] * v[column];
    return out;
}

// A box around points on the wall. Points that are not numbers are left out.
struct Box {
    double left = std::numeric_limits<double>::infinity(), right = -left, bottom = left, top = -left;
    double nearest = 1, farthest = -1;

    void add(const Vector& clip, const Region& wall)
    {
        const double x = wall.x0 + wall.width() * (clip[0] / clip[3] + 1) / 2;
        const double y = wall.y0 + wall.height() * (clip[1] / clip[3] + 1) / 2, z = clip[2] / clip[3];
        left = std::fmin(left, x), right = std::fmax(right, x);
        bottom = std::fmin(bottom, y), top = std::fmax(top, y);
        nearest = std::fmin(nearest, z), farthest = std::fmax(farthest, z);
    }

    // The pixels of the wall that the box touches.
    Region pixels(const Region& wall) const
    {
        const auto pixel = [](double value, int first, int end) {
            return static_cast<int>(std::clamp(value, double(first), double(end)));
        };
        if (!(left <= right && bottom <= top))
            return {};
        return {pixel(std::floor(left), wall.x0, wall.x1), pixel(std::floor(bottom), wall.y0, wall.y1),
                pixel(std::ceil(right), wall.x0, wall.x1), pixel(std::ceil(top), wall.y0, wall.y1)};
    }
};

// Points nearer than the near plane are not visible. Where an edge crosses that plane, the crossing point counts.
Box project(const std::vector<Vector>& clip, const Region& wall)
{
    const auto before = [](const Vector& v) { return v[2] + v[3]; }; // 0 on the near plane
    Box box;
    for (const Vector& v : clip) {
        if (before(v) >= 0) {
            box.add(v, wall);
            continue;
        }
        for (const Vector& other : clip) {
            if (before(other) < 0)
                continue;
            const double t = before(other) / (before(other) - before(v));
            Vector on;
            for (std::size_t c = 0; c < 4; ++c)
                on[c] = other[c] + t * (v[c] - other[c]);
            box.add(on, wall);
        }
    }
    return box;
}

std::vector<int> tilesIn(const Region& part, const std::vector<Tile>& tiles)
{
    std::vector<int> found;
    for (std::size_t i = 0; i < tiles.size(); ++i)
        if (!intersection(part, tiles[i].viewport).empty())
            found.push_back(static_cast<int>(i));
    return found;
}

// The columns of share `index` of `count`.
Region strip(const Region& all, std::size_t index, std::size_t count)
{
    const auto edge = [&](std::size_t i) {
        return static_cast<int>(static_cast<std::size_t>(all.width()) * i / count);
    };
    return {all.x0 + edge(index), all.y0, all.x0 + edge(index + 1), all.y1};
}

// The tile that each rank renders, by rank. A rank that displays one of the tiles takes it; the others share the rest
// in turn. -1: none.
std::vector<int> tilesOfReplicas(const std::vector<int>& ranks, std::vector<int> tiles, const Settings& settings)
{
    std::vector<int> taken(ranks.size(), -1);
    for (std::size_t i = 0; i < ranks.size(); ++i) {
        const auto its = std::find(tiles.begin(), tiles.end(), settings.tileOf(ranks[i]));
        if (its == tiles.end())
            continue;
        taken[i] = *its;
        tiles.erase(its);
    }
    std::size_t turn = 0;
    for (int& tile : taken)
        if (tile < 0 && !tiles.empty())
            tile = tiles[turn++ % tiles.size()];
    return taken;
}

// Shares out a frame among the ranks that have the same data, and leaves this rank its part. No pixel of a tile comes
// from two of them.
void share(const IceTContextStruct& context, Frame& frame)
{
    const std::vector<int>& ranks = context.replicas;
    const auto me = static_cast<std::size_t>(std::find(ranks.begin(), ranks.end(), context.rank()) - ranks.begin());
    if (ranks.size() < frame.tiles.size()) {
        frame.contained = strip(frame.contained, me, ranks.size());
        frame.tiles = tilesIn(frame.contained, context.settings.tiles);
        return;
    }
    const auto taken = tilesOfReplicas(ranks, frame.tiles, context.settings);
    frame.tiles.clear();
    if (taken[me] >= 0) {
        const Tile& tile = context.settings.tiles[static_cast<std::size_t>(taken[me])];
        const auto before = std::count(taken.begin(), taken.begin() + static_cast<std::ptrdiff_t>(me), taken[me]);
        const auto all = std::count(taken.begin(), taken.end(), taken[me]);
        frame.contained = strip(intersection(frame.contained, tile.viewport), static_cast<std::size_t>(before),
                                static_cast<std::size_t>(all));
    }
    if (taken[me] >= 0 && !frame.contained.empty())
        frame.tiles = {taken[me]};
    else
        frame.contained = {};
}

} // namespace

void findContained(IceTContextStruct& context, const Region* limits)
{
    Frame& frame = context.frame;
    const Region wall = context.settings.wall();
    frame.contained = wall;
    frame.nearest = -1;
    frame.farthest = 1;
    if (!context.settings.vertices.empty()) {
        std::vector<Vector> clip;
        for (const auto& [x, y, z] : context.settings.vertices)
            clip.push_back(times(frame.projection, times(frame.modelview, {x, y, z, 1})));
        const Box box = project(clip, wall);
        frame.contained = box.pixels(wall);
        frame.nearest = std::max(-1.0, box.nearest);
        frame.farthest = std::min(1.0, box.farthest);
    }
    if (limits) {
        frame.contained = intersection(frame.contained, *limits);
        if (frame.contained.empty())
            frame.contained = {};
    }
    frame.tiles = tilesIn(frame.contained, context.settings.tiles);
    if (context.replicas.size() > 1)
        share(context, frame);
}

} // namespace dfb_icet
