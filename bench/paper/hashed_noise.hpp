// HashedNoise: gradient noise (Perlin 2002) whose gradients come from a hash, so that any rank can evaluate any point
// of a field of any size, and all get the same value.
#pragma once

#include <dfb/render/world.hpp>

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace bench {

// The hash of a lattice point; well mixed (the end is that of MurmurHash3).
inline std::uint32_t hashOf(std::uint32_t seed, int x, int y, int z)
{
    std::uint32_t h = seed * 0x9e3779b9u;
    for (const int v : {x, y, z}) {
        h ^= static_cast<std::uint32_t>(v);
        h = (h ^ h >> 16) * 0x85ebca6bu;
        h = (h ^ h >> 13) * 0xc2b2ae35u;
        h ^= h >> 16;
    }
    return h;
}

// In [0, 1).
inline float unitOf(std::uint32_t hash) { return static_cast<float>(hash >> 8) * 0x1p-24f; }

// A sequence of numbers in [0, 1) that follows from a hash.
class HashedNumbers {
public:
    explicit HashedNumbers(std::uint32_t hash) : state_(hash) {}
    float next()
    {
        state_ = state_ * 747796405u + 2891336453u; // PCG (O'Neill 2014)
        const std::uint32_t word = ((state_ >> ((state_ >> 28) + 4)) ^ state_) * 277803737u;
        return unitOf(word >> 22 ^ word);
    }

private:
    std::uint32_t state_;
};

class HashedNoise {
public:
    explicit HashedNoise(std::uint32_t seed) : seed_(seed) {}

    // Octaves of `frequency` and up, each about twice as fine and `gain` times as strong as the one before: turbulence.
    float turbulence(const dfb::Vec3& p, float frequency, int octaves, float gain = 0.5f) const
    {
        float sum = 0, weight = 1;
        for (int i = 0; i < octaves; ++i, weight *= gain, frequency *= 2.03f)
            sum += weight * octave(frequency * p, seed_ + 101u * static_cast<std::uint32_t>(i));
        return sum;
    }

private:
    static float octave(const dfb::Vec3& p, std::uint32_t seed)
    {
        const float fx = std::floor(p.x), fy = std::floor(p.y), fz = std::floor(p.z);
        const auto x = static_cast<int>(fx), y = static_cast<int>(fy), z = static_cast<int>(fz);
        const float u = p.x - fx, v = p.y - fy, w = p.z - fz;
        std::array<float, 8> corner{};
        for (std::size_t c = 0; c < 8; ++c) {
            const int i = static_cast<int>(c & 1), j = static_cast<int>(c >> 1 & 1), k = static_cast<int>(c >> 2);
            corner[c] = slope(hashOf(seed, x + i, y + j, z + k), u - static_cast<float>(i), v - static_cast<float>(j),
                              w - static_cast<float>(k));
        }
        const auto mix = [](float a, float b, float t) { return a + t * (b - a); };
        const auto fade = [](float t) { return t * t * t * (t * (6 * t - 15) + 10); };
        const float s = fade(u), t = fade(v), r = fade(w);
        return mix(mix(mix(corner[0], corner[1], s), mix(corner[2], corner[3], s), t),
                   mix(mix(corner[4], corner[5], s), mix(corner[6], corner[7], s), t), r);
    }

    // Along one of the twelve directions to the edges of a cube.
    static float slope(std::uint32_t hash, float x, float y, float z)
    {
        const std::uint32_t h = hash & 15;
        const float a = h < 8 ? x : y, b = h < 4 ? y : h == 12 || h == 14 ? x : z;
        return (h & 1 ? -a : a) + (h & 2 ? -b : b);
    }

    std::uint32_t seed_;
};

} // namespace bench
