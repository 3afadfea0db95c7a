// isRight: compares a picture that dfb has composited with what VTK alone renders.
#pragma once

#include "slab_renderer.hpp"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <vector>

namespace example {

// The largest difference, in levels of 255, of a picture, whose top row is first, from `expected`, whose lowest is.
inline double largestDifference(const dfb::Image& picture, const std::vector<double>& expected)
{
    double largest = 0;
    for (std::size_t i = 0; i < 4 * pixelCount; ++i) {
        const std::size_t row = i / (4 * width), column = i % (4 * width);
        largest = std::max(largest, std::abs(picture.rgba8()[i] - expected[(height - 1 - row) * 4 * width + column]));
    }
    return largest;
}

// Blends the images of slabs, given from front to back, as plainly as it can be done.
inline std::vector<double> blend(const std::vector<Pixels>& images, bool isVolume)
{
    std::vector<double> seen(4 * pixelCount);
    for (std::size_t i = 0; i < pixelCount; ++i) {
        const auto isNearer = [&](const Pixels& a, const Pixels& b) { return a.depths[i] < b.depths[i]; };
        const Pixels& nearest = *std::min_element(images.begin(), images.end(), isNearer);
        if (!isVolume && nearest.depths[i] < 1)
            std::copy_n(&nearest.colors[4 * i], 4, &seen[4 * i]);
        double through = 1;
        for (const Pixels& image : images) {
            for (std::size_t c = 4 * i; isVolume && c < 4 * i + 4; ++c)
                seen[c] += through * image.colors[c];
            through *= 1 - image.colors[4 * i + 3] / 255.0;
        }
    }
    return seen;
}

// Returns whether the picture is right: what plain blending of VTK's own images of the slabs gives, to half a level;
// and VTK's own picture of the whole, exactly for surfaces. VTK's rays start anew in each slab of a volume, with
// samples elsewhere, which moves steps in the data by some levels; a wrong order makes tens.
inline bool isRight(const dfb::Image& picture, Data& data, Renderer& renderer, const std::vector<int>& order,
                    bool isVolume)
{
    std::vector<Pixels> slabs;
    for (const int slab : order)
        slabs.push_back(renderer.render(data.slab(slab, static_cast<int>(order.size()))));
    const double blended = largestDifference(picture, blend(slabs, isVolume));
    const Pixels all = renderer.render(data.slab(0, 1));
    const double whole = largestDifference(picture, {all.colors.begin(), all.colors.end()});
    const bool isEmpty =
        std::all_of(all.colors.begin(), all.colors.end(), [](std::uint8_t level) { return level == 0; });
    const bool holds = !isEmpty && blended <= (isVolume ? 0.5 + 1e-9 : 0) && whole <= (isVolume ? 16 : 0);
    std::printf("vtk_parts: %s on %zu ranks: off by %.2f levels from plain blending, by %.0f from VTK's own picture of "
                "the whole: %s\n",
                isVolume ? "volume" : "surfaces", order.size(), blended, whole, holds ? "right" : "WRONG");
    return holds;
}

} // namespace example
