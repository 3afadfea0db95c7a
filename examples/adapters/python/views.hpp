// ImageViews: numpy arrays on the memory of an image, without a copy.
//
// The library keeps an image in the same blocks of its memory pool from frame to frame. They return to the pool when
// the framebuffer ends or is resized, and the pool frees its memory when its last handle is gone. So each array holds a
// handle of the pool, and its memory stays valid. Only resize() would reuse these blocks, so it is refused while there
// are arrays.
#pragma once

#include <dfb/buffer.hpp>
#include <dfb/image.hpp>

#include <pybind11/numpy.h>

#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

namespace dfb_python {

namespace py = pybind11;

inline py::array colorOf(const dfb::Image& image, const py::capsule& base)
{
    const bool isFloat = image.format() == dfb::OutputFormat::RGBA32F;
    return py::array(isFloat ? py::dtype::of<float>() : py::dtype::of<std::uint8_t>(),
                     std::vector<py::ssize_t>{image.height(), image.width(), 4}, image.bytes(), base);
}

inline py::array depthOf(const dfb::Image& image, const py::capsule& base)
{
    return py::array(py::dtype::of<float>(), std::vector<py::ssize_t>{image.height(), image.width()}, image.depth(),
                     base);
}

// Only with the GIL.
class ImageViews {
public:
    explicit ImageViews(std::shared_ptr<dfb::MemoryPool> pool)
        : pool_(std::make_shared<std::shared_ptr<dfb::MemoryPool>>(std::move(pool)))
    {
    }

    // Whether there are arrays. Arrays made from an array, such as slices, count.
    bool any() const noexcept { return pool_.use_count() > 1; }

    py::object color(const dfb::Image& image) const
    {
        return image.empty() ? py::object(py::none()) : readOnly(colorOf(image, base()));
    }
    py::object depth(const dfb::Image& image) const
    {
        return image.empty() || !image.hasDepth() ? py::object(py::none()) : readOnly(depthOf(image, base()));
    }

private:
    using Held = std::shared_ptr<std::shared_ptr<dfb::MemoryPool>>;

    // Read-only, because the library does not write pixels again that are background already.
    static py::object readOnly(const py::array& array)
    {
        array.attr("setflags")(py::arg("write") = false);
        return array;
    }

    py::capsule base() const
    {
        return py::capsule(new Held(pool_), [](void* held) { delete static_cast<Held*>(held); });
    }

    Held pool_;
};

// Arrays of the colour and depth of an image, which they own; None for what it does not have.
inline py::tuple ownArrays(dfb::Image image)
{
    if (image.empty())
        return py::make_tuple(py::none(), py::none());
    auto* kept = new dfb::Image(std::move(image));
    const py::capsule base(kept, [](void* held) { delete static_cast<dfb::Image*>(held); });
    const py::object depth = kept->hasDepth() ? py::object(depthOf(*kept, base)) : py::object(py::none());
    return py::make_tuple(colorOf(*kept, base), depth);
}

} // namespace dfb_python
