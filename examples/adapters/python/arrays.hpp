// InputArrays: an InputImage on the memory of numpy arrays, without a copy.
#pragma once

#include "errors.hpp"
#include "settings.hpp"

#include <dfb/image_compositor.hpp>

#include <pybind11/numpy.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <string>
#include <vector>

namespace dfb_python {

inline std::string shapeOf(const py::array& array) { return py::str(array.attr("shape")); }

// Throws InvalidArgument for a masked array, whose mask would be ignored.
inline void refuseMask(const py::object& array, const char* name)
{
    if (py::hasattr(array, "mask"))
        throw dfb::InvalidArgument(std::string(name) + " is a masked array: give its filled(0)");
}

// Where the pixels of an array are: rows in which the pixels are contiguous.
struct ArrayRows {
    const void* first = nullptr; // the lowest address
    std::ptrdiff_t rowPixels = 0;
    bool isFlipped = false; // the array's first row is the last in memory, as of array[::-1]

    // `channels`: those of a pixel. Throws InvalidArgument if the array has another layout.
    ArrayRows(const py::array& array, int channels, const std::string& name)
    {
        const py::ssize_t height = array.shape(0), width = array.shape(1), pixel = channels * array.itemsize();
        const auto isDense = [&](int axis, py::ssize_t stride) {
            return array.shape(axis) <= 1 || array.strides(axis) == stride;
        };
        const py::ssize_t stride = height > 1 ? array.strides(0) : width * pixel;
        const bool isInRows = isDense(1, pixel) && (channels == 1 || isDense(2, array.itemsize()));
        const bool areApart = stride % pixel == 0 && std::abs(stride) >= width * pixel;
        if (!isInRows || !areApart)
            throw dfb::InvalidArgument((isInRows ? "the rows of " + name + " overlap"
                                                 : "the pixels of a row of " + name + " do not lie one after another")
                                       + ": give numpy.ascontiguousarray(" + name + ")");
        isFlipped = stride < 0;
        first = static_cast<const std::byte*>(array.data()) + (isFlipped ? (height - 1) * stride : 0);
        if (reinterpret_cast<std::uintptr_t>(first) % static_cast<std::uintptr_t>(array.itemsize()) != 0)
            throw dfb::InvalidArgument(name + " is not aligned: give " + name + ".copy()");
        rowPixels = std::abs(stride) / pixel;
    }
};

// The arguments of a call of composite(), as the library takes them. The arrays must outlive it.
class InputArrays {
public:
    // With the GIL. Throws InvalidArgument for wrong arrays, and exceptions of Python.
    void read(const py::object& rgba, const py::object& depth, const py::dict& options, const dfb::ImageConfig& picture)
    {
        image.bottomUp = argument<bool>(options, "bottom_up", "a bool");
        image.isBgra = argument<bool>(options, "bgra", "a bool");
        image.hasStraightAlpha = argument<bool>(options, "straight_alpha", "a bool");
        if (!options["far_depth"].is_none())
            image.farDepth = argument<float>(options, "far_depth", "a float or None");
        if (std::isnan(image.farDepth))
            throw dfb::InvalidArgument("far_depth is not a number");
        if (rgba.is_none()) {
            if (!depth.is_none())
                throw dfb::InvalidArgument("depth without rgba");
            return;
        }
        const py::array colors = arrayOf(rgba, "rgba", 3);
        const bool isFloat = isOf<float>(colors);
        if (colors.shape(2) != 4 || !(isFloat || isOf<std::uint8_t>(colors)))
            throw dfb::InvalidArgument("rgba is " + shapeOf(colors) + " of " + shown(colors.dtype())
                                       + ": it must be (height, width, 4) of uint8 or float32, in native byte order");
        const auto height = static_cast<int>(colors.shape(0)), width = static_cast<int>(colors.shape(1));
        place(width, height, options, picture);
        if (width == 0 || height == 0)
            return;
        const ArrayRows rows(colors, 4, "rgba");
        if (isFloat)
            image.rgba32f = static_cast<const float*>(rows.first);
        else
            image.rgba8 = static_cast<const std::uint8_t*>(rows.first);
        image.rowPixels = rows.rowPixels;
        if (rows.isFlipped) {
            image.bottomUp = !image.bottomUp;
            image.region = {image.region.x0, picture.height - image.region.y1, image.region.x1,
                            picture.height - image.region.y0};
        }
        if (!depth.is_none())
            readDepth(depth, colors, rows);
    }

    dfb::InputImage image;

private:
    static py::array arrayOf(const py::object& object, const char* name, int dimensions)
    {
        if (!py::isinstance<py::array>(object))
            throw dfb::InvalidArgument(std::string(name) + " is a " + typeOf(object)
                                       + ": it must be an array of numpy");
        refuseMask(object, name);
        const auto array = py::reinterpret_borrow<py::array>(object);
        if (array.ndim() != dimensions)
            throw dfb::InvalidArgument(std::string(name) + " has the shape " + shapeOf(array) + ": it must have "
                                       + std::to_string(dimensions) + " dimensions");
        return array;
    }

    template <class Element>
    static bool isOf(const py::array& array)
    {
        return py::dtype::of<Element>().is(array.dtype()) || py::dtype::of<Element>().equal(array.dtype());
    }

    // Where the array is in the picture.
    void place(int width, int height, const py::dict& options, const dfb::ImageConfig& picture)
    {
        std::array<int, 2> origin{0, 0};
        if (!options["origin"].is_none())
            origin = argument<std::array<int, 2>>(options, "origin", "two ints of 32 bits (x, y), or None");
        else if (width != picture.width || height != picture.height)
            throw dfb::InvalidArgument("rgba has " + std::to_string(width) + "x" + std::to_string(height)
                                       + " pixels, the picture " + std::to_string(picture.width) + "x"
                                       + std::to_string(picture.height) + ": give origin=(x, y) for a part of it");
        // So near to the picture that no sum overflows.
        const int most = 1 << 24;
        if (std::max(std::abs(origin[0]), std::abs(origin[1])) > most || std::max(width, height) > most)
            throw dfb::InvalidArgument("rgba is farther outside of the picture than can be");
        image.region = {origin[0], origin[1], origin[0] + width, origin[1] + height};
    }

    void readDepth(const py::object& depth, const py::array& colors, const ArrayRows& rows)
    {
        const py::array depths = arrayOf(depth, "depth", 2);
        if (!isOf<float>(depths) || depths.shape(0) != colors.shape(0) || depths.shape(1) != colors.shape(1))
            throw dfb::InvalidArgument("depth is " + shapeOf(depths) + " of " + shown(depths.dtype()) + " for rgba of "
                                       + shapeOf(colors)
                                       + ": it must be (height, width) of float32, in native byte order");
        const ArrayRows own(depths, 1, "depth");
        image.depth = static_cast<const float*>(own.first);
        const std::ptrdiff_t height = depths.shape(0), width = depths.shape(1);
        if (height == 1 || (own.rowPixels == rows.rowPixels && own.isFlipped == rows.isFlipped))
            return;
        // The library uses one row distance for colour and depth.
        copiedDepth_.resize(static_cast<std::size_t>(rows.rowPixels * (height - 1) + width));
        for (std::ptrdiff_t y = 0; y < height; ++y) {
            const std::ptrdiff_t from = own.isFlipped == rows.isFlipped ? y : height - 1 - y;
            std::copy_n(image.depth + from * own.rowPixels, width, copiedDepth_.data() + y * rows.rowPixels);
        }
        image.depth = copiedDepth_.data();
    }

    std::vector<float> copiedDepth_;
};

} // namespace dfb_python
