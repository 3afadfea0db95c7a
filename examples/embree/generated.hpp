// Generated scenes: data made from a seed, for when there are no files at hand or none large enough.
#pragma once

#include "scene.hpp"

#include <memory>

namespace example {
namespace detail {

constexpr double pi = 3.14159265358979323846;

// A scalar field on a grid of any size: sums of products of waves along the axes, of which only one table per axis is
// kept. It depends only on a voxel's index in the whole volume, so bricks agree on ghosts without communication.
class WaveField {
public:
    WaveField(const Index3& dims, std::uint64_t seed)
    {
        for (std::size_t term = 0; term < termCount; ++term)
            for (std::size_t axis = 0; axis < 3; ++axis) {
                const std::uint64_t key = hash64(seed, 8 * term + axis);
                // Wavelengths from 30 to 90 voxels: a brick of 64 holds about one of each.
                const double frequency = 2 * pi / (term < 3 ? 55 + 35 * unitReal(key) : 30 + 15 * unitReal(key));
                const double phase = 2 * pi * unitReal(hash64(key));
                for (int i = 0; i < dims[axis]; ++i)
                    tables_[term][axis].push_back(static_cast<float>(std::sin(frequency * i + phase)));
            }
    }
    // In [0, 1].
    float operator()(int x, int y, int z) const
    {
        const std::size_t i = static_cast<std::size_t>(x), j = static_cast<std::size_t>(y),
                          k = static_cast<std::size_t>(z);
        float sum = 0;
        for (std::size_t term = 0; term < termCount; ++term) {
            const auto& t = tables_[term];
            sum += (term < 3 ? 1.0f : 0.35f) * (t[0][i] * t[1][j] + t[1][j] * t[2][k] + t[2][k] * t[0][i]);
        }
        return std::clamp(0.17f * sum, 0.0f, 1.0f);
    }

private:
    static constexpr std::size_t termCount = 5;
    std::array<std::array<std::vector<float>, 3>, termCount> tables_;
};

// A volume of uint8 from a function of the voxel's index to [0, 1].
template <class Field>
VolumeSource generatedVolume(const Index3& dims, Field field)
{
    VolumeSource source;
    source.info.dims = dims;
    source.open = [field] {
        return [field](const Index3& lo, const Index3& hi, std::byte* out) {
            for (int z = lo[2]; z < hi[2]; ++z)
                for (int y = lo[1]; y < hi[1]; ++y)
                    for (int x = lo[0]; x < hi[0]; ++x)
                        *out++ = static_cast<std::byte>(static_cast<unsigned char>(field(x, y, z) * 255.0f + 0.5f));
        };
    };
    return source;
}

// A tube around a (2, 3) torus knot that fits into [0, 1]^3.
inline Mesh torusKnot(int along, int around)
{
    auto center = [](double s) {
        const double r = 0.29 + 0.11 * std::cos(3 * s);
        return Vec3d{0.5 + r * std::cos(2 * s), 0.5 + r * std::sin(2 * s), 0.5 + 0.2 * std::sin(3 * s)};
    };
    Mesh mesh;
    for (int i = 0; i < along; ++i) {
        const double s = 2 * pi * i / along;
        const Vec3d c = center(s), tangent = unit(center(s + 1e-4) - center(s - 1e-4));
        const Vec3d side = unit(cross(tangent, c - Vec3d{0.5, 0.5, 0.5})), other = cross(side, tangent);
        for (int k = 0; k < around; ++k) {
            const double angle = 2 * pi * k / around;
            const double radius = 0.042 * (1 + 0.12 * std::cos(18 * s + 2 * angle));
            mesh.positions.push_back(toFloat(c + (side * std::cos(angle) + other * std::sin(angle)) * radius));
        }
    }
    const auto vertex = [&](int i, int k) { return static_cast<std::uint32_t>((i % along) * around + k % around); };
    for (int i = 0; i < along; ++i)
        for (int k = 0; k < around; ++k) {
            mesh.triangles.push_back({vertex(i, k), vertex(i + 1, k), vertex(i + 1, k + 1)});
            mesh.triangles.push_back({vertex(i, k), vertex(i + 1, k + 1), vertex(i, k + 1)});
        }
    return mesh;
}

// A swarm on a ring around the vertical axis.
inline std::vector<Sphere> sphereRing(int count, std::uint64_t seed)
{
    static const Vec3 palette[] = {
        {0.75f, 0.13f, 0.06f}, {0.80f, 0.45f, 0.04f}, {0.10f, 0.40f, 0.55f}, {0.70f, 0.70f, 0.66f}};
    std::vector<Sphere> spheres;
    for (int i = 0; i < count; ++i) {
        std::uint64_t key = hash64(seed, static_cast<std::uint64_t>(i));
        auto next = [&key] { return unitReal(key = hash64(key)); };
        const double angle = 2 * pi * next();
        const double radius = 0.45 + 0.035 * (next() + next() - 1);
        const double height = 0.5 + 0.05 * (next() + next() - 1) + 0.06 * std::sin(2 * angle);
        Sphere sphere;
        sphere.center = {static_cast<float>(0.5 + radius * std::cos(angle)), static_cast<float>(height),
                         static_cast<float>(0.5 + radius * std::sin(angle))};
        sphere.radius = static_cast<float>(0.004 + 0.008 * next() * next());
        sphere.color = palette[static_cast<std::size_t>(4 * next())];
        spheres.push_back(sphere);
    }
    return spheres;
}

} // namespace detail

// One 64^3 brick of one large volume per brick, on a near-cubic grid. No rank ever holds more than its bricks.
// `lookOf`: how it is shown; empty: as embers in a haze. Likewise below.
inline Scene syntheticScene(int brickCount, std::uint64_t seed, const LookOf& lookOf = {})
{
    Scene scene;
    scene.grid = nearCubicGrid(brickCount);
    Index3 dims;
    for (std::size_t axis = 0; axis < 3; ++axis)
        dims[axis] = 64 * scene.grid[axis];
    auto field = std::make_shared<const detail::WaveField>(dims, seed);
    VolumeSource source = detail::generatedVolume(dims, [field](int x, int y, int z) { return (*field)(x, y, z); });
    source.name = "synthetic";
    if (lookOf)
        source.look = lookOf(source);
    scene.add(std::move(source), true);
    return scene;
}

// One of each kind in the unit cube: a cloud, a torus knot and a ring of spheres.
inline Scene demoScene(std::uint64_t seed, const LookOf& lookOf = {})
{
    Scene scene;
    const int size = 96;
    auto waves = std::make_shared<const detail::WaveField>(Index3{size, size, size}, seed);
    auto cloud = [waves](int x, int y, int z) {
        const float half = 0.5f * (size - 1);
        const Vec3 p =
            Vec3{static_cast<float>(x) - half, static_cast<float>(y) - half, static_cast<float>(z) - half} * (1 / half);
        const float inside = std::clamp(1.6f * (0.95f - length(p)), 0.0f, 1.0f);
        return inside == 0 ? 0.0f : std::min(1.0f, inside * (0.10f + 1.9f * (*waves)(x, y, z)));
    };
    VolumeSource source = detail::generatedVolume({size, size, size}, cloud);
    source.name = "demo";
    if (lookOf)
        source.look = lookOf(source);
    scene.add(std::move(source), true);
    scene.add(detail::torusKnot(800, 24), false);
    scene.add(detail::sphereRing(1200, seed), false);
    return scene;
}

} // namespace example
