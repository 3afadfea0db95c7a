// Volumes with two transparent isosurfaces: stand-ins for the Richtmyer-Meshkov and the DNS data of the paper, of any
// size, of which each rank makes its brick by itself.
#pragma once

#include "hashed_noise.hpp"
#include "paper_brick.hpp"

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

namespace bench {

struct Isosurface {
    float value = 0, opacity = 0;
    dfb::Vec3 color;
};

struct VolumeLook {
    std::array<Isosurface, 2> surfaces;
    // Extinction of the volume itself, per value above `threshold` and length; 0: only the surfaces are seen.
    float extinction = 0, threshold = 0;
    int occlusionRays = 0; // for ambient occlusion; they see only what the brick has
    float occlusionReach = 0;
};

// Samples are at multiples of a step along each ray, whatever the bounds. What lies between two samples, such as the
// crossing of a surface, belongs to the brick that has the first of them.
class VolumeBrick : public PaperBrick {
public:
    using Field = std::function<float(const dfb::Vec3&)>;

    // A unit cube has `voxels` along each side.
    VolumeBrick(const dfb::Box3& bounds, int voxels, const Field& field, const VolumeLook& look,
                dfb::Executor& executor)
        : bounds_(bounds), look_(look), scale_(static_cast<float>(voxels)), step_(0.5f / scale_)
    {
        const float lower[3] = {bounds.lower.x, bounds.lower.y, bounds.lower.z},
                    upper[3] = {bounds.upper.x, bounds.upper.y, bounds.upper.z};
        for (std::size_t axis = 0; axis < 3; ++axis) {
            first_[axis] = static_cast<int>(std::floor(lower[axis] * scale_)) - ghosts;
            count_[axis] = static_cast<int>(std::ceil(upper[axis] * scale_)) + ghosts + 1 - first_[axis];
            cells_[axis] = (count_[axis] + cellWidth - 1) / cellWidth;
        }
        values_.resize(size(0) * size(1) * size(2));
        executor.parallelFor(size(2), [&](std::size_t z) {
            std::size_t at = z * size(1) * size(0);
            for (std::size_t y = 0; y < size(1); ++y)
                for (std::size_t x = 0; x < size(0); ++x) {
                    const auto place = [&](std::size_t axis, std::size_t i) {
                        return static_cast<float>(first_[axis] + static_cast<int>(i)) / scale_;
                    };
                    values_[at++] = field({place(0, x), place(1, y), place(2, z)});
                }
        });
        findEmptyCells();
    }

    void render(const dfb::PerspectiveCamera& camera, const Pixels& to) const override
    {
        tracePixels(camera, to, [&](const dfb::Vec3& direction, int x, int y) {
            return trace(camera.eye(), direction, hashOf(7, x, y, 0));
        });
    }

private:
    // A crossing is up to a step beyond the bounds, its gradient needs one voxel more, and interpolation the next.
    static constexpr int ghosts = 3;
    static constexpr int cellWidth = 8; // of cells that rays pass in one step if there is nothing in them

    std::size_t size(std::size_t axis) const { return static_cast<std::size_t>(count_[axis]); }

    // A sample in an empty cell shows nothing, nor is a surface crossed on the way to the next sample.
    void findEmptyCells()
    {
        const auto cells = [this](std::size_t axis) { return static_cast<std::size_t>(cells_[axis]); };
        isEmpty_.assign(cells(0) * cells(1) * cells(2), 0);
        std::size_t cell = 0;
        for (int cz = 0; cz < cells_[2]; ++cz)
            for (int cy = 0; cy < cells_[1]; ++cy)
                for (int cx = 0; cx < cells_[0]; ++cx) {
                    float least = std::numeric_limits<float>::max(), most = -least;
                    const auto range = [this](int c, std::size_t axis) {
                        return std::array<int, 2>{std::max(0, c * cellWidth - 1),
                                                  std::min(count_[axis], (c + 1) * cellWidth + 2)};
                    };
                    const auto xs = range(cx, 0), ys = range(cy, 1), zs = range(cz, 2);
                    for (int z = zs[0]; z < zs[1]; ++z)
                        for (int y = ys[0]; y < ys[1]; ++y)
                            for (int x = xs[0]; x < xs[1]; ++x) {
                                const float value = values_[indexOf(x, y, z)];
                                least = std::min(least, value);
                                most = std::max(most, value);
                            }
                    bool empty = !(look_.extinction > 0 && most > look_.threshold);
                    for (const Isosurface& s : look_.surfaces)
                        empty = empty && (most < s.value || least >= s.value);
                    isEmpty_[cell++] = empty;
                }
    }

    std::size_t indexOf(int x, int y, int z) const
    {
        return (static_cast<std::size_t>(z) * size(1) + static_cast<std::size_t>(y)) * size(0)
               + static_cast<std::size_t>(x);
    }

    dfb::Vec3 toVoxel(const dfb::Vec3& p) const { return scale_ * p; } // counted from the unit cube's corner

    // Whether the value there follows from voxels that are stored.
    bool has(const dfb::Vec3& v) const
    {
        const auto within = [&](float at, std::size_t axis) {
            const float from = static_cast<float>(first_[axis]),
                        to = static_cast<float>(first_[axis] + count_[axis] - 1);
            return at >= from && at < to;
        };
        return within(v.x, 0) && within(v.y, 1) && within(v.z, 2);
    }

    float at(const dfb::Vec3& v) const
    {
        const float fx = std::floor(v.x), fy = std::floor(v.y), fz = std::floor(v.z);
        const float u = v.x - fx, w = v.y - fy, t = v.z - fz;
        const float* c = &values_[indexOf(static_cast<int>(fx) - first_[0], static_cast<int>(fy) - first_[1],
                                          static_cast<int>(fz) - first_[2])];
        const std::size_t row = size(0), slice = size(0) * size(1);
        const auto mix = [](float a, float b, float s) { return a + s * (b - a); };
        return mix(mix(mix(c[0], c[1], u), mix(c[row], c[row + 1], u), w),
                   mix(mix(c[slice], c[slice + 1], u), mix(c[slice + row], c[slice + row + 1], u), w), t);
    }

    dfb::Vec3 gradient(const dfb::Vec3& v) const
    {
        return {at({v.x + 1, v.y, v.z}) - at({v.x - 1, v.y, v.z}), at({v.x, v.y + 1, v.z}) - at({v.x, v.y - 1, v.z}),
                at({v.x, v.y, v.z + 1}) - at({v.x, v.y, v.z - 1})};
    }

    // How many samples ahead the next one is that may show something; 0: this one.
    int emptySteps(const dfb::Vec3& v, const dfb::Vec3& advance) const
    {
        const float at[3] = {v.x - static_cast<float>(first_[0]), v.y - static_cast<float>(first_[1]),
                             v.z - static_cast<float>(first_[2])},
                    by[3] = {advance.x, advance.y, advance.z};
        const int cell[3] = {static_cast<int>(at[0]) / cellWidth, static_cast<int>(at[1]) / cellWidth,
                             static_cast<int>(at[2]) / cellWidth};
        if (!isEmpty_[(static_cast<std::size_t>(cell[2]) * static_cast<std::size_t>(cells_[1])
                       + static_cast<std::size_t>(cell[1]))
                          * static_cast<std::size_t>(cells_[0])
                      + static_cast<std::size_t>(cell[0])])
            return 0;
        float steps = 1e6f;
        for (int axis = 0; axis < 3; ++axis)
            if (by[axis] != 0) {
                const int wall = (cell[axis] + (by[axis] > 0)) * cellWidth;
                steps = std::min(steps, (static_cast<float>(wall) - at[axis]) / by[axis]);
            }
        return static_cast<int>(std::max(0.0f, steps - 0.02f)) + 1; // 0.02 for rounding
    }

    // Not inlined, so that all bricks run the same machine code.
#if defined(__GNUC__)
    __attribute__((noinline))
#endif
    Traced
    trace(const dfb::Vec3& origin, const dfb::Vec3& direction, std::uint32_t key) const
    {
        Traced sum;
        float enter = 0, leave = 0;
        if (!clip(bounds_, step_, origin, direction, enter, leave))
            return sum;
        const dfb::Vec3 advance = scale_ * step_ * direction;
        const auto pointOf = [&](int k) { return origin + static_cast<float>(k) * step_ * direction; };
        const int end = static_cast<int>(leave / step_) + 2;
        int known = -1; // the sample of which `next` is the value
        float next = 0;
        bool begun = false;
        for (int k = std::max(1, static_cast<int>(enter / step_) - 1); k < end; ++k) {
            const dfb::Vec3 p = pointOf(k);
            if (!contains(bounds_, p)) {
                if (begun)
                    break;
                continue;
            }
            begun = true;
            const dfb::Vec3 v = toVoxel(p);
            if (const int skip = emptySteps(v, advance); skip > 0) {
                k += skip - 1;
                continue;
            }
            const float value = known == k ? next : at(v);
            next = at(toVoxel(pointOf(k + 1)));
            known = k + 1;
            const float t = static_cast<float>(k) * step_;
            if (const float over = value - look_.threshold; look_.extinction > 0 && over > 0)
                sum.add(t, volumeColor(over), 1 - std::exp(-look_.extinction * over * step_));
            addCrossings(sum, value, next, t, origin, direction, key);
        }
        return sum;
    }

    // Blue where there is little, over green to yellow.
    static dfb::Vec3 volumeColor(float over)
    {
        const float s = std::min(1.0f, 2.5f * over);
        return {0.10f + 0.85f * s * s, 0.25f + 0.55f * s, 0.65f - 0.5f * s};
    }

    void addCrossings(Traced& sum, float value, float next, float t, const dfb::Vec3& origin,
                      const dfb::Vec3& direction, std::uint32_t key) const
    {
        const auto [a, b] = look_.surfaces;
        const bool falling = next < value; // the one with the greater value comes first
        for (const Isosurface& s :
             (a.value < b.value) != falling ? std::array<Isosurface, 2>{a, b} : std::array<Isosurface, 2>{b, a}) {
            if ((value < s.value) == (next < s.value))
                continue;
            // Always nearer than the next sample, which may be another rank's.
            const float hit = t + std::min(0.999f, (s.value - value) / (next - value)) * step_;
            const dfb::Vec3 p = origin + hit * direction, v = toVoxel(p);
            const dfb::Vec3 slope = gradient(v);
            const float length = std::sqrt(dot(slope, slope));
            const dfb::Vec3 normal = length > 0 ? (1 / length) * slope : -1.0f * direction;
            sum.add(hit, lit(s.color, normal, direction, opennessOf(v, normal, direction, s.value, key)), s.opacity);
        }
    }

    // The part of the directions around the normal in which the surface is not crossed again soon.
    float opennessOf(const dfb::Vec3& v, dfb::Vec3 normal, const dfb::Vec3& direction, float surface,
                     std::uint32_t key) const
    {
        if (look_.occlusionRays == 0)
            return 1;
        if (dot(normal, direction) > 0)
            normal = -1.0f * normal;
        HashedNumbers numbers(key);
        const dfb::Vec3 start = v + 1.5f * normal;
        if (!has(start))
            return 1;
        const bool side = at(start) < surface;
        int open = 0;
        for (int i = 0; i < look_.occlusionRays; ++i) {
            // The normal and a point of the unit sphere: distributed by the cosine.
            const float z = 2 * numbers.next() - 1, angle = 6.2831853f * numbers.next(), r = std::sqrt(1 - z * z);
            const dfb::Vec3 to = normalize(1.001f * normal + dfb::Vec3{r * std::cos(angle), r * std::sin(angle), z});
            bool hit = false;
            for (float s = 2; s < look_.occlusionReach * scale_ && !hit; s += 2) {
                const dfb::Vec3 q = start + s * to;
                if (!has(q))
                    break;
                hit = (at(q) < surface) != side;
            }
            open += !hit;
        }
        return static_cast<float>(open) / static_cast<float>(look_.occlusionRays);
    }

    dfb::Box3 bounds_;
    VolumeLook look_;
    float scale_, step_;                             // voxels a length; between samples
    std::array<int, 3> first_{}, count_{}, cells_{}; // of the voxels that are stored; of cells
    std::vector<float> values_;
    std::vector<std::uint8_t> isEmpty_; // of each cell
};

// The paper's Figure 5a: two fluids mix, in bubbles and spikes; the surfaces are where either is nearly pure.
inline PaperScene mixingLayer(int voxels, std::uint32_t seed)
{
    VolumeLook look;
    look.surfaces = {{{0.3f, 0.35f, {0.85f, 0.35f, 0.12f}}, {0.7f, 0.45f, {0.25f, 0.5f, 0.8f}}}};
    look.occlusionRays = 6;
    look.occlusionReach = 0.08f;
    const auto field = [noise = HashedNoise(seed)](const dfb::Vec3& p) {
        const float large = noise.turbulence(p, 4, 1), fine = noise.turbulence(p, 9, 3, 0.55f);
        const float height = p.y - 0.5f + 0.2f * large + 0.09f * fine;
        return 0.5f + 0.5f * std::tanh(5.0f * height);
    };
    return {"mixing layer, 2 isosurfaces, " + std::to_string(voxels) + "^3",
            [=](const dfb::Box3& bounds, dfb::Executor& executor) {
                return std::make_unique<VolumeBrick>(bounds, voxels, field, look, executor);
            }};
}

// Figure 5b: turbulence in a channel, strongest near the walls (bottom and top), as a volume with two surfaces.
inline PaperScene channelFlow(int voxels, std::uint32_t seed)
{
    VolumeLook look;
    look.surfaces = {{{-0.32f, 0.4f, {0.2f, 0.45f, 0.75f}}, {0.36f, 0.5f, {0.9f, 0.45f, 0.1f}}}};
    look.extinction = 22;
    look.threshold = 0.12f;
    const auto field = [noise = HashedNoise(seed)](const dfb::Vec3& p) {
        const float wall = std::abs(2 * p.y - 1), envelope = 0.15f + 0.95f * wall * wall;
        return envelope * noise.turbulence({0.6f * p.x, p.y, p.z}, 6, 5, 0.6f); // streaks along the flow
    };
    return {"channel flow, volume and 2 isosurfaces, " + std::to_string(voxels) + "^3",
            [=](const dfb::Box3& bounds, dfb::Executor& executor) {
                return std::make_unique<VolumeBrick>(bounds, voxels, field, look, executor);
            }};
}

} // namespace bench
