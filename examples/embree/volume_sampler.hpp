// VolumeSampler: what a ray asks of a brick's part of a volume: value, gradient, opacity, and how far there is
// nothing. All coordinates are voxel indices in the whole volume, so that neighbouring bricks compute the same bits.
#pragma once

#include "bricks.hpp"
#include "shading.hpp"

namespace example {

// A point of a volume, premultiplied: its colour in the light, and its own colour.
struct Shaded {
    Vec3 color, albedo;
    float alpha = 0;
};

class VolumeSampler {
    const VolumeInfo& info() const { return volume_.block.info(); }

    // Calls the function with the voxels as a pointer to their type.
    template <class Function>
    auto dispatch(Function&& function) const
    {
        return withVoxelType(info().type, [&](auto voxel) { return function(volume_.block.data<decltype(voxel)>()); });
    }

public:
    // `step`: distance between samples in world space.
    VolumeSampler(BrickVolume volume, float step)
        : volume_(std::move(volume)), inverseScale_{1 / volume_.placement.scale.x, 1 / volume_.placement.scale.y,
                                                    1 / volume_.placement.scale.z},
          shift_{-volume_.placement.offset.x * inverseScale_.x, -volume_.placement.offset.y * inverseScale_.y,
                 -volume_.placement.offset.z * inverseScale_.z},
          transferFunction_(stepIn256ths(step), volume_.look.points), valueScale_(volume_.look.scale())
    {
        if (!volume_.rotation.isNone())
            turnAxes();
        for (int i = 0; i < 3; ++i)
            component(slopeScale_, i) = std::copysign(
                0.5f * valueScale_ * (volume_.placement.size() / std::fabs(component(volume_.placement.scale, i))),
                component(inverseScale_, i));
        dispatch([this](const auto* voxels) { buildSkipGrid(voxels); });
    }

    // Converts a point to voxel indices; for a rotated volume only to a quarter of a voxel, because floats are rounded.
    Vec3 toVoxel(const Vec3& world) const
    {
        if (!volume_.rotation.isNone()) {
            const auto along = [&](const Vec3& axis, float shift) {
                return mulAdd(world.x, axis.x, mulAdd(world.y, axis.y, mulAdd(world.z, axis.z, shift)));
            };
            return {along(axes_[0], shift_.x), along(axes_[1], shift_.y), along(axes_[2], shift_.z)};
        }
        return {mulAdd(world.x, inverseScale_.x, shift_.x), mulAdd(world.y, inverseScale_.y, shift_.y),
                mulAdd(world.z, inverseScale_.z, shift_.z)};
    }
    // One over the voxels that a ray advances along each axis in one step.
    Vec3 inverseAdvance(const Vec3& direction, float step) const
    {
        const Vec3& scale = volume_.placement.scale;
        const Vec3 along =
            volume_.rotation.isNone() ? direction : toFloat(volume_.rotation.directionBack(toDouble(direction)));
        return {1 / along.x * scale.x / step, 1 / along.y * scale.y / step, 1 / along.z * scale.z / step};
    }

    // The domain in world space, for clipping rays with some slack; inDomain() decides which points are inside.
    Box bounds() const
    {
        Box box;
        box.grow(volume_.placement.toWorld(volume_.shown.lo));
        box.grow(volume_.placement.toWorld(volume_.shown.hi));
        return volume_.rotation.box(box);
    }
    // Whether a point is in the part of the domain that a clip box has left.
    bool inDomain(const Vec3& v) const
    {
        const Vec3 &lo = volume_.shown.lo, &hi = volume_.shown.hi;
        return v.x >= lo.x && v.y >= lo.y && v.z >= lo.z && v.x <= hi.x && v.y <= hi.y && v.z <= hi.z;
    }

    const VolumeLook& look() const { return volume_.look; }
    std::uint32_t geometry() const { return volume_.geometry; }

    // The value of the data at a point, or NaN outside of the volume. The brick has it in its cell and up to half a
    // voxel around.
    float valueAt(const Vec3& v) const
    {
        const auto has = [this](float at, std::size_t axis) {
            return at >= static_cast<float>(std::max(volume_.block.lo()[axis], 0)) && at <= last(axis)
                   && at < static_cast<float>(volume_.block.hi()[axis] - 1);
        };
        if (!has(v.x, 0) || !has(v.y, 1) || !has(v.z, 2))
            return std::numeric_limits<float>::quiet_NaN();
        return dispatch([&](const auto* voxels) {
            const auto at = cornerOf(voxels, v);
            return lerp(at.before(), at.behind(), at.fz);
        });
    }
    // The direction in the world in which the values rise; of length 1 or 0. For a point in the cell.
    Vec3 directionAt(const Vec3& v) const
    {
        return dispatch([&](const auto* voxels) {
            const auto at = cornerOf(voxels, v);
            return inWorld(unit(gradientOf(at, at.before(), at.behind())));
        });
    }

    // How many steps ahead the next sample is that may have an opacity above 0; 0 if that may be this one.
    // `inverseStep` is from inverseAdvance().
    int emptySteps(const Vec3& v, const Vec3& inverseStep) const
    {
        const int cx = static_cast<int>(v.x) >> cellShift, cy = static_cast<int>(v.y) >> cellShift,
                  cz = static_cast<int>(v.z) >> cellShift;
        const int distance = distances_[cellIndex(cx - cells0_[0], cy - cells0_[1], cz - cells0_[2])];
        if (distance == 0)
            return 0;
        float steps = 1e6f;
        const int cell[3] = {cx, cy, cz};
        for (int i = 0; i < 3; ++i) {
            const float inverse = component(inverseStep, i);
            const int wall = (inverse > 0 ? cell[i] + distance : cell[i] - distance + 1) * cellWidth;
            const float s = (static_cast<float>(wall) - component(v, i)) * inverse;
            steps = s < steps ? s : steps; // false for 0 * infinity, which is not a number
        }
        return static_cast<int>(std::max(0.0f, steps - 0.05f)) + 1; // 0.05 for rounding
    }

    // Returns alpha 0 where there is nothing.
    Shaded shade(const Vec3& v, const Vec3& view, const Light& light) const
    {
        return dispatch([&](const auto* voxels) { return shade(voxels, v, view, light); });
    }

private:
    static constexpr int cellShift = 3, cellWidth = 1 << cellShift; // of the skip grid, in voxels
    static_assert(cellWidth == skipWidth);

    // Prepares toVoxel() for a rotated volume.
    void turnAxes()
    {
        for (int i = 0; i < 3; ++i) {
            Vec3d one;
            component(one, i) = 1;
            const double inverse = 1 / static_cast<double>(component(volume_.placement.scale, i));
            axes_[i] = toFloat(volume_.rotation.direction(one) * inverse);
            Vec3d origin = volume_.rotation.pointBack({0, 0, 0}) - toDouble(volume_.placement.offset);
            component(shift_, i) = static_cast<float>(component(origin, i) * inverse);
        }
    }
    Vec3 inWorld(const Vec3& direction) const
    {
        return volume_.rotation.isNone() ? direction : toFloat(volume_.rotation.direction(toDouble(direction)));
    }

    float last(std::size_t axis) const { return static_cast<float>(info().dims[axis] - 1); }
    // Converts a step to units of 1/256 of the volume's largest extent.
    float stepIn256ths(float step) const
    {
        std::size_t largest = 0;
        const auto side = [this](std::size_t axis) { return std::fabs(component(volume_.placement.scale, axis)); };
        for (const std::size_t axis : {1, 2})
            largest = last(axis) * side(axis) > last(largest) * side(largest) ? axis : largest;
        return 256 * step / side(largest) / last(largest);
    }

    static float lerp(float a, float b, float f) { return mulAdd(f, b - a, a); }

    // The voxel before a point along each axis, and how far behind it the point is.
    template <class T>
    struct Corner {
        const T* p;
        std::ptrdiff_t dx, dy, dz;
        float fx, fy, fz;

        // Interpolates in the plane through q that the axes a and b span.
        static float plane(const T* q, std::ptrdiff_t a, std::ptrdiff_t b, float fa, float fb)
        {
            const auto at = [](T value) { return static_cast<float>(value); };
            return lerp(lerp(at(q[0]), at(q[a]), fa), lerp(at(q[b]), at(q[a + b]), fa), fb);
        }
        // In the planes of voxels before and behind the point along z.
        float before() const { return plane(p, dx, dy, fx, fy); }
        float behind() const { return plane(p + dz, dx, dy, fx, fy); }
    };
    template <class T>
    Corner<T> cornerOf(const T* voxels, const Vec3& v) const
    {
        const int x = static_cast<int>(v.x), y = static_cast<int>(v.y), z = static_cast<int>(v.z);
        return {voxels + volume_.block.index(x, y, z),
                1,
                static_cast<std::ptrdiff_t>(volume_.block.rowStride()),
                static_cast<std::ptrdiff_t>(volume_.block.sliceStride()),
                v.x - static_cast<float>(x),
                v.y - static_cast<float>(y),
                v.z - static_cast<float>(z)};
    }

    // Central differences at distance one voxel. `z0` and `z1`: at.before() and at.behind().
    template <class T>
    Vec3 gradientOf(const Corner<T>& at, float z0, float z1) const
    {
        const auto& [p, dx, dy, dz, fx, fy, fz] = at;
        const auto slope = [&p = at.p](std::ptrdiff_t along, std::ptrdiff_t a, std::ptrdiff_t b, float f, float fa,
                                       float fb) {
            const auto plane = Corner<T>::plane;
            const float before = plane(p - along, a, b, fa, fb), here = plane(p, a, b, fa, fb),
                        next = plane(p + along, a, b, fa, fb), behind = plane(p + 2 * along, a, b, fa, fb);
            return lerp(next - before, behind - here, f);
        };
        const Vec3 rise{slope(dx, dy, dz, fx, fy, fz), slope(dy, dx, dz, fy, fx, fz),
                        lerp(z1 - at.plane(p - dz, dx, dy, fx, fy), at.plane(p + 2 * dz, dx, dy, fx, fy) - z0, fz)};
        return {rise.x * slopeScale_.x, rise.y * slopeScale_.y, rise.z * slopeScale_.z};
    }

    template <class T>
    Shaded shade(const T* voxels, const Vec3& v, const Vec3& view, const Light& light) const
    {
        const Corner<T> at = cornerOf(voxels, v);
        const float z0 = at.before(), z1 = at.behind();
        const TransferFunction::Entry entry = transferFunction_((lerp(z0, z1, at.fz) - look().lo) * valueScale_);
        if (!(entry.alpha > 0))
            return {};
        const Vec3 albedo = Vec3{entry.r, entry.g, entry.b} * entry.alpha;
        Shaded shaded{albedo, albedo, entry.alpha};
        const Vec3 gradient = gradientOf(at, z0, z1);
        const float steepness = length(gradient);
        if (steepness > 0) {
            // Where the value hardly changes, the direction of the gradient is noise, so the colour is left as it is.
            const Vec3 normal = inWorld(gradient * (1 / steepness));
            const float weight = std::min(1.0f, 25.0f * steepness);
            const float lit = 1 + weight * (light.diffuse(normal) - 1);
            const float highlight = weight * light.specular(normal, view);
            shaded.color =
                (Vec3{entry.r, entry.g, entry.b} * lit + Vec3{highlight, highlight, highlight}) * entry.alpha;
        }
        return shaded;
    }

    std::size_t cellIndex(int x, int y, int z) const
    {
        return (static_cast<std::size_t>(z) * static_cast<std::size_t>(cells_[1]) + static_cast<std::size_t>(y))
                   * static_cast<std::size_t>(cells_[0])
               + static_cast<std::size_t>(x);
    }

    // Fills distances_: for each cell the number of cells to the nearest visible one, with diagonals counting as one.
    // All cells closer than that can be skipped at once.
    template <class T>
    void buildSkipGrid(const T* voxels)
    {
        const Index3 &lo = volume_.block.lo(), &hi = volume_.block.hi();
        for (std::size_t i = 0; i < 3; ++i) {
            cells0_[i] = std::max(lo[i], 0) >> cellShift;
            cells_[i] = ((std::min(hi[i], info().dims[i]) - 1) >> cellShift) + 1 - cells0_[i];
        }
        distances_.resize(cellIndex(0, 0, cells_[2]));
        forEachCell(1, [&](int x, int y, int z) {
            Index3 from, to; // with the voxels of the upper neighbours' first layer, which interpolation uses
            const Index3 cell{x, y, z};
            for (std::size_t i = 0; i < 3; ++i) {
                from[i] = std::max((cells0_[i] + cell[i]) << cellShift, lo[i]);
                to[i] = std::min(((cells0_[i] + cell[i] + 1) << cellShift) + 1, hi[i]);
            }
            T least = voxels[volume_.block.index(from[0], from[1], from[2])], greatest = least;
            for (int k = from[2]; k < to[2]; ++k)
                for (int j = from[1]; j < to[1]; ++j) {
                    const T* row = voxels + volume_.block.index(from[0], j, k);
                    for (int i = 0; i < to[0] - from[0]; ++i) {
                        least = std::min(least, row[i]);
                        greatest = std::max(greatest, row[i]);
                    }
                }
            const auto value = [this](T v) { return (static_cast<float>(v) - look().lo) * valueScale_; };
            const bool isEmpty = transferFunction_.isTransparent(value(least), value(greatest))
                                 && !look().hasIsovalueIn(static_cast<float>(least), static_cast<float>(greatest));
            distances_[cellIndex(x, y, z)] = isEmpty ? 255 : 0;
        });
        // Two sweeps, each of which looks at the neighbours that it has visited already, give the exact distance.
        for (const int direction : {1, -1})
            forEachCell(direction, [&](int x, int y, int z) {
                int distance = distances_[cellIndex(x, y, z)];
                for (int n = 0; n < 13; ++n) {
                    const int i = x + direction * (n % 3 - 1), j = y + direction * (n / 3 % 3 - 1),
                              k = z + direction * (n / 9 - 1);
                    if (i >= 0 && i < cells_[0] && j >= 0 && j < cells_[1] && k >= 0 && k < cells_[2])
                        distance = std::min(distance, distances_[cellIndex(i, j, k)] + 1);
                }
                distances_[cellIndex(x, y, z)] = static_cast<std::uint8_t>(distance);
            });
    }

    template <class Function>
    void forEachCell(int direction, Function&& function) const
    {
        const auto at = [direction](int i, int n) { return direction > 0 ? i : n - 1 - i; };
        for (int z = 0; z < cells_[2]; ++z)
            for (int y = 0; y < cells_[1]; ++y)
                for (int x = 0; x < cells_[0]; ++x)
                    function(at(x, cells_[0]), at(y, cells_[1]), at(z, cells_[2]));
    }

    BrickVolume volume_;
    Vec3 inverseScale_;
    Vec3 shift_;
    Vec3 axes_[3]; // of a rotated volume: one voxel along each, in the world
    TransferFunction transferFunction_;
    float valueScale_;
    // From differences of voxels to a gradient along the world's axes, in values per least side of a voxel.
    Vec3 slopeScale_;
    Index3 cells0_{}, cells_{}; // first cell and number of cells
    std::vector<std::uint8_t> distances_;
};

} // namespace example
