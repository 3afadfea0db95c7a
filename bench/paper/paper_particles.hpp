// Clustered particles as transparent spheres: a stand-in for the Cosmic Web of the paper, of any size. The particles of
// a cell follow from a hash of the cell, so a rank makes its own particles, and those of neighbours that reach into its
// brick.
#pragma once

#include "hashed_noise.hpp"
#include "paper_brick.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

namespace bench {

struct Particle {
    dfb::Vec3 center;
    float radius = 0, density = 0; // density: 0 to 1, of the web at its place
    std::uint64_t id = 0;
};

// Dense where two fields of noise are both near 0: along filaments, with knots where they stay near 0.
class ParticleWeb {
public:
    ParticleWeb(int cells, std::uint32_t seed) : cells_(cells), seed_(seed), first_(seed), second_(seed + 7919u) {}

    int cells() const { return cells_; } // along each side of the unit cube
    float cellSize() const { return 1.0f / static_cast<float>(cells_); }
    float largestRadius() const { return 0.3f * cellSize(); }

    // Calls found(particle) for those of a cell, each of which is within the unit cube.
    template <class Found>
    void forEach(int x, int y, int z, const Found& found) const
    {
        constexpr int candidates = 24;
        HashedNumbers numbers(hashOf(seed_, x, y, z));
        for (int i = 0; i < candidates; ++i) {
            Particle p;
            const float u = numbers.next(), v = numbers.next(), w = numbers.next(), chance = numbers.next();
            p.center =
                cellSize() * dfb::Vec3{static_cast<float>(x) + u, static_cast<float>(y) + v, static_cast<float>(z) + w};
            p.radius = largestRadius() * (0.35f + 0.65f * numbers.next());
            const auto inside = [&](float c) { return c >= p.radius && c < 1 - p.radius; };
            if (!inside(p.center.x) || !inside(p.center.y) || !inside(p.center.z))
                continue;
            p.density = densityAt(p.center);
            if (chance >= p.density)
                continue;
            p.id = ((static_cast<std::uint64_t>(z) * static_cast<std::uint64_t>(cells_) + static_cast<std::uint64_t>(y))
                        * static_cast<std::uint64_t>(cells_)
                    + static_cast<std::uint64_t>(x))
                       * candidates
                   + static_cast<std::uint64_t>(i);
            found(p);
        }
    }

private:
    float densityAt(const dfb::Vec3& p) const
    {
        const float a = first_.turbulence(p, 3, 3), b = second_.turbulence(p, 3, 3);
        return 0.004f + 0.996f * std::exp(-150 * (a * a + b * b));
    }

    int cells_;
    std::uint32_t seed_;
    HashedNoise first_, second_;
};

// A hit belongs to the brick that it lies in, so that a sphere on a face is seen in part by each neighbour. Rays go
// through a grid of the web's cells.
class ParticleBrick : public PaperBrick {
public:
    ParticleBrick(const dfb::Box3& bounds, const ParticleWeb& web, dfb::Executor& executor)
        : bounds_(bounds), cellSize_(web.cellSize())
    {
        const float lower[3] = {bounds.lower.x, bounds.lower.y, bounds.lower.z},
                    upper[3] = {bounds.upper.x, bounds.upper.y, bounds.upper.z};
        std::array<int, 3> from{}, to{}; // of the cells whose particles may reach into the brick
        for (std::size_t axis = 0; axis < 3; ++axis) {
            const auto cellOf = [&](float at) {
                return std::clamp(static_cast<int>(std::floor(at / cellSize_)), 0, web.cells() - 1);
            };
            first_[axis] = cellOf(lower[axis]);
            count_[axis] = cellOf(upper[axis]) + 1 - first_[axis];
            from[axis] = cellOf(lower[axis] - web.largestRadius() - slack());
            to[axis] = cellOf(upper[axis] + web.largestRadius() + slack());
        }
        std::vector<std::vector<Particle>> slices(static_cast<std::size_t>(to[2] - from[2] + 1));
        executor.parallelFor(slices.size(), [&](std::size_t slice) {
            for (int y = from[1]; y <= to[1]; ++y)
                for (int x = from[0]; x <= to[0]; ++x)
                    web.forEach(x, y, from[2] + static_cast<int>(slice),
                                [&](const Particle& p) { slices[slice].push_back(p); });
        });
        for (const std::vector<Particle>& slice : slices)
            particles_.insert(particles_.end(), slice.begin(), slice.end());
        fillGrid();
    }

    void render(const dfb::PerspectiveCamera& camera, const Pixels& to) const override
    {
        std::vector<Hit> hits;
        tracePixels(camera, to,
                    [&](const dfb::Vec3& direction, int, int) { return trace(camera.eye(), direction, hits); });
    }

private:
    static constexpr float opacity = 0.25f;

    struct Hit {
        float t = 0;
        std::uint32_t particle = 0;
    };

    // So that a ray with rounding errors still finds what it touches.
    float slack() const { return 1e-3f * cellSize_; }

    // Calls visit(cell) for the cells of the grid that a particle may reach into.
    template <class Visit>
    void forEachCell(const Particle& p, const Visit& visit) const
    {
        const float center[3] = {p.center.x, p.center.y, p.center.z}, reach = p.radius + slack();
        std::array<int, 3> from{}, to{};
        for (std::size_t axis = 0; axis < 3; ++axis) {
            const auto cellOf = [&](float at) { return static_cast<int>(std::floor(at / cellSize_)) - first_[axis]; };
            from[axis] = std::max(0, cellOf(center[axis] - reach));
            to[axis] = std::min(count_[axis] - 1, cellOf(center[axis] + reach));
        }
        for (int z = from[2]; z <= to[2]; ++z)
            for (int y = from[1]; y <= to[1]; ++y)
                for (int x = from[0]; x <= to[0]; ++x)
                    visit(indexOf(x, y, z));
    }

    std::size_t indexOf(int x, int y, int z) const
    {
        return (static_cast<std::size_t>(z) * static_cast<std::size_t>(count_[1]) + static_cast<std::size_t>(y))
                   * static_cast<std::size_t>(count_[0])
               + static_cast<std::size_t>(x);
    }

    void fillGrid()
    {
        begin_.assign(indexOf(0, 0, count_[2]) + 1, 0);
        for (const Particle& p : particles_)
            forEachCell(p, [this](std::size_t cell) { ++begin_[cell + 1]; });
        for (std::size_t i = 1; i < begin_.size(); ++i)
            begin_[i] += begin_[i - 1];
        content_.resize(begin_.back());
        std::vector<std::uint32_t> next(begin_.begin(), begin_.end() - 1);
        for (std::size_t i = 0; i < particles_.size(); ++i)
            forEachCell(particles_[i],
                        [&](std::size_t cell) { content_[next[cell]++] = static_cast<std::uint32_t>(i); });
    }

    // Not inlined, so that all bricks run the same machine code.
#if defined(__GNUC__)
    __attribute__((noinline))
#endif
    Traced
    trace(const dfb::Vec3& origin, const dfb::Vec3& direction, std::vector<Hit>& hits) const
    {
        Traced sum;
        float enter = 0, leave = 0;
        if (!clip(bounds_, slack(), origin, direction, enter, leave))
            return sum;
        hits.clear();
        walk(origin, direction, enter, leave, hits);
        // Equal distances are sorted by id, as in any other brick. A sphere is found in several cells.
        std::sort(hits.begin(), hits.end(), [this](const Hit& a, const Hit& b) {
            return a.t != b.t ? a.t < b.t : particles_[a.particle].id < particles_[b.particle].id;
        });
        hits.erase(
            std::unique(hits.begin(), hits.end(), [](const Hit& a, const Hit& b) { return a.particle == b.particle; }),
            hits.end());
        for (const Hit& hit : hits) {
            const Particle& p = particles_[hit.particle];
            const dfb::Vec3 normal = (1 / p.radius) * (origin + hit.t * direction - p.center);
            sum.add(hit.t, lit(colorOf(p), normal, direction, 1), opacity);
        }
        return sum;
    }

    // From cell to cell (Amanatides and Woo 1987).
    void walk(const dfb::Vec3& origin, const dfb::Vec3& direction, float enter, float leave,
              std::vector<Hit>& hits) const
    {
        const dfb::Vec3 start = origin + enter * direction;
        const float from[3] = {start.x, start.y, start.z}, eye[3] = {origin.x, origin.y, origin.z},
                    to[3] = {direction.x, direction.y, direction.z};
        int cell[3], step[3];
        float next[3], apart[3]; // the distance of the next wall, and from one to the next
        for (std::size_t axis = 0; axis < 3; ++axis) {
            cell[axis] =
                std::clamp(static_cast<int>(std::floor(from[axis] / cellSize_)) - first_[axis], 0, count_[axis] - 1);
            step[axis] = to[axis] > 0 ? 1 : -1;
            const auto wall = static_cast<float>(first_[axis] + cell[axis] + (to[axis] > 0)) * cellSize_;
            next[axis] = to[axis] != 0 ? (wall - eye[axis]) / to[axis] : std::numeric_limits<float>::max();
            apart[axis] = to[axis] != 0 ? cellSize_ / std::abs(to[axis]) : 0;
        }
        for (;;) {
            const std::size_t at = indexOf(cell[0], cell[1], cell[2]);
            for (std::uint32_t i = begin_[at]; i < begin_[at + 1]; ++i)
                intersect(content_[i], origin, direction, hits);
            const int axis = next[0] < next[1] ? (next[0] < next[2] ? 0 : 2) : (next[1] < next[2] ? 1 : 2);
            if (next[axis] > leave)
                return;
            cell[axis] += step[axis];
            next[axis] += apart[axis];
            if (cell[axis] < 0 || cell[axis] >= count_[static_cast<std::size_t>(axis)])
                return;
        }
    }

    void intersect(std::uint32_t index, const dfb::Vec3& origin, const dfb::Vec3& direction,
                   std::vector<Hit>& hits) const
    {
        const Particle& p = particles_[index];
        const dfb::Vec3 to = p.center - origin;
        const float middle = dot(to, direction);
        const dfb::Vec3 aside = to - middle * direction;
        const float inside = p.radius * p.radius - dot(aside, aside);
        if (inside <= 0)
            return;
        const float t = middle - std::sqrt(inside);
        if (t > 0 && contains(bounds_, origin + t * direction))
            hits.push_back({t, index});
    }

    // From blue for single particles, over red, to yellow in knots.
    static dfb::Vec3 colorOf(const Particle& p)
    {
        const float s = p.density;
        return {0.15f + 0.8f * std::min(1.0f, 1.5f * s), 0.2f + 0.6f * s * s, 0.7f - 0.6f * s};
    }

    dfb::Box3 bounds_;
    float cellSize_;
    std::array<int, 3> first_{}, count_{}; // of the grid's cells
    std::vector<Particle> particles_;
    std::vector<std::uint32_t> begin_, content_; // where the particles of a cell begin; those of all cells
};

// Figure 5c.
inline PaperScene particleWeb(int cells, std::uint32_t seed)
{
    return {"particles in " + std::to_string(cells) + "^3 cells",
            [=](const dfb::Box3& bounds, dfb::Executor& executor) {
                return std::make_unique<ParticleBrick>(bounds, ParticleWeb(cells, seed), executor);
            }};
}

} // namespace bench
