// PythonTile: a tile for a renderer in Python; and pixels as numpy arrays.
#pragma once

#include "arrays.hpp"
#include "errors.hpp"

#include <dfb/render/visibility.hpp>
#include <dfb/tile.hpp>

#include <pybind11/numpy.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

namespace dfb_python {

using RenderTile = dfb::Tile<dfb::colorChannel | dfb::depthChannel, 64>;

// Cleared arrays: colours are 0, depths +infinity.
inline py::array_t<float> emptyColors(int width, int height)
{
    py::array_t<float> array({height, width, 4});
    std::fill_n(array.mutable_data(), array.size(), 0.0f);
    return array;
}
inline py::array_t<float> emptyDepths(int width, int height)
{
    py::array_t<float> array({height, width});
    std::fill_n(array.mutable_data(), array.size(), std::numeric_limits<float>::infinity());
    return array;
}

// Converts `object` to a contiguous array of this type. Throws InvalidArgument unless it has `channels` numbers for
// each pixel of a region. 0 channels: one number, without an axis for channels. Colours of uint8 are levels.
template <class Number>
using PixelArray = py::array_t<Number, py::array::c_style | py::array::forcecast>;
template <class Number>
PixelArray<Number> pixelsOf(const py::object& object, const dfb::Region& region, int channels, const char* name)
{
    refuseMask(object, name);
    auto array = PixelArray<Number>::ensure(object);
    const bool isArray = array && !object.is_none(); // numpy makes a NaN of None
    std::vector<py::ssize_t> shape{region.height(), region.width()};
    if (channels > 0)
        shape.push_back(channels);
    const bool fits = isArray && array.ndim() == static_cast<py::ssize_t>(shape.size())
                      && std::equal(shape.begin(), shape.end(), array.shape());
    if (!fits) {
        const bool isShort = object.is_none() || py::isinstance<py::str>(object);
        const std::string what = isArray ? shapeOf(array) : isShort ? shown(object) : "a " + typeOf(object);
        throw dfb::InvalidArgument(std::string(name) + " is " + what + ": it must be an array "
                                   + std::string(py::str(py::tuple(py::cast(shape)))));
    }
    if (channels == 4 && py::isinstance<py::array_t<std::uint8_t>>(object)) {
        Number* const levels = array.mutable_data(); // of a copy, as it had another type
        std::transform(levels, levels + array.size(), levels, [](Number level) { return level / 255; });
    }
    return array;
}

// The attributes of a tile. `rgba` and `depth` are arrays of its own, which the renderer fills or replaces.
struct PythonTile {
    py::object rgba, depth;
    int x0, y0, width, height, index, imageWidth, imageHeight;

    PythonTile(const RenderTile& tile, int pictureWidth, int pictureHeight)
        : rgba(emptyColors(tile.region.width(), tile.region.height())),
          depth(emptyDepths(tile.region.width(), tile.region.height())), x0(tile.region.x0), y0(tile.region.y0),
          width(tile.region.width()), height(tile.region.height()), index(tile.tile), imageWidth(pictureWidth),
          imageHeight(pictureHeight)
    {
    }

    // Copies what the renderer has made. Throws InvalidArgument if it has replaced the arrays by wrong ones.
    void copyTo(RenderTile& tile) const
    {
        const auto colors = pixelsOf<float>(rgba, tile.region, 4, "tile.rgba");
        const auto depths = pixelsOf<float>(depth, tile.region, 0, "tile.depth");
        for (int y = 0; y < height; ++y) {
            std::copy_n(colors.data() + 4 * y * width, 4 * width, tile.color + 4 * y * RenderTile::size);
            std::copy_n(depths.data() + y * width, width, tile.depth + y * RenderTile::size);
        }
    }
};

// The rays through the middles of a tile's pixels: origins and directions of length 1, each (height, width, 3) floats.
template <class Camera>
py::tuple raysOf(const Camera& camera, const PythonTile& tile)
{
    py::array_t<float> origins({tile.height, tile.width, 3}), directions({tile.height, tile.width, 3});
    float *origin = origins.mutable_data(), *direction = directions.mutable_data();
    for (int y = 0; y < tile.height; ++y)
        for (int x = 0; x < tile.width; ++x, origin += 3, direction += 3) {
            const dfb::Ray ray = camera.ray(tile.x0 + x + 0.5, tile.y0 + y + 0.5, tile.imageWidth, tile.imageHeight);
            origin[0] = ray.origin.x, origin[1] = ray.origin.y, origin[2] = ray.origin.z;
            direction[0] = ray.direction.x, direction[1] = ray.direction.y, direction[2] = ray.direction.z;
        }
    return py::make_tuple(origins, directions);
}

} // namespace dfb_python
