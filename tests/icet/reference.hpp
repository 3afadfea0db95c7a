// The exact picture of a tile, in double.
#pragma once

#include "setup.hpp"

#include <cmath>
#include <cstring>

namespace icet_test {

// The pixels that a rank puts on the wall: its picture, within a part of it.
struct Layer {
    Picture picture;
    Rect part;
};

struct Pixel {
    std::array<double, 4> color{}; // bytes as levels
    float depth = 1;
    bool isTied = false; // several ranks have the least depth, or light without opacity: IceT's may differ
};

inline std::array<double, 4> colorOf(const Picture& picture, Kind kind, int x, int y)
{
    std::array<double, 4> color{};
    if (isBytes(kind)) {
        const auto bytes = picture.bytes(x, y);
        std::copy(bytes.begin(), bytes.end(), color.begin());
    } else {
        const auto floats = picture.floats(x, y);
        std::copy(floats.begin(), floats.end(), color.begin());
    }
    return color;
}

// The nearest; of equals that of the lowest rank. Where there is none, the background.
inline Pixel nearest(const std::vector<Layer>& layers, Kind kind, const std::array<double, 4>& background, int x, int y)
{
    Pixel pixel;
    pixel.color = background;
    for (const Layer& layer : layers) {
        const float depth = layer.part.contains(x, y) ? layer.picture.depth(x, y) : 1.0f;
        if (depth < 1 && depth == pixel.depth)
            pixel.isTied = true;
        if (depth >= pixel.depth)
            continue;
        pixel.color = colorOf(layer.picture, kind, x, y);
        pixel.depth = depth;
        pixel.isTied = false;
    }
    return pixel;
}

// Front to back, over the background. The library takes a level as the float next to level / 255.
inline Pixel blended(const std::vector<const Layer*>& frontToBack, Kind kind, const std::array<double, 4>& background,
                     int x, int y)
{
    Pixel pixel;
    const auto taken = [kind](std::array<double, 4> color) {
        for (double& value : color)
            value = isBytes(kind) ? static_cast<double>(static_cast<float>(value) / 255.0f) : value;
        return color;
    };
    double open = 1; // the part of the light that comes through
    for (const Layer* layer : frontToBack) {
        if (!layer->part.contains(x, y))
            continue;
        pixel.isTied = pixel.isTied || layer->picture.isEmissive(x, y);
        const auto color = taken(colorOf(layer->picture, kind, x, y));
        for (std::size_t c = 0; c < 4; ++c)
            pixel.color[c] += open * color[c];
        open *= 1 - color[3];
    }
    for (std::size_t c = 0; c < 4; ++c)
        pixel.color[c] = (pixel.color[c] + open * taken(background)[c]) * (isBytes(kind) ? 255 : 1);
    return pixel;
}

} // namespace icet_test
