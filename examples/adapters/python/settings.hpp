// Settings: the arguments of a constructor. If they are wrong on one rank, all ranks throw.
#pragma once

#include "errors.hpp"

#include <dfb/exec.hpp>
#include <dfb/frame.hpp>
#include <dfb/image_compositor.hpp>
#include <dfb/render/world.hpp>

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <array>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <exception>
#include <memory>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>

namespace dfb_python {

// Returns an argument as text for an error.
inline std::string shown(const py::handle& value) { return py::repr(value); }
inline std::string typeOf(const py::handle& value) { return Py_TYPE(value.ptr())->tp_name; }

// Three numbers. Throws InvalidArgument for anything else.
inline dfb::Vec3 pointOf(const py::object& value, const std::string& name)
{
    try {
        const auto p = value.cast<std::array<float, 3>>();
        return {p[0], p[1], p[2]};
    } catch (const py::cast_error&) {
        throw dfb::InvalidArgument(name + " is " + shown(value) + ": it must be three floats");
    }
}

// Sets `to` and returns true if `from` is an integer that fits. pybind11 alone would cut the fraction of some numbers
// of numpy.
template <class Integer>
bool toInteger(const py::handle& from, Integer& to)
{
    const auto whole = py::reinterpret_steal<py::object>(PyNumber_Index(from.ptr()));
    if (!whole)
        PyErr_Clear();
    py::detail::make_caster<Integer> caster;
    const bool fits = whole && caster.load(whole, false);
    if (fits)
        to = py::detail::cast_op<Integer>(caster);
    return fits;
}

// Two integers: (x, y), or a width and a height.
inline bool toIntegers(const py::handle& from, std::array<int, 2>& to)
{
    if (!py::isinstance<py::sequence>(from) || py::len(from) != 2)
        return false;
    const auto both = py::reinterpret_borrow<py::sequence>(from);
    return toInteger(both[0], to[0]) && toInteger(both[1], to[1]);
}

// The value of an argument. Throws InvalidArgument if it has another type.
template <class Value>
Value argument(const py::dict& from, const char* name, const char* kind)
{
    const py::object value = from[name];
    Value result{};
    bool fits = false;
    if constexpr (std::is_same_v<Value, int>) {
        fits = toInteger(value, result);
    } else if constexpr (std::is_same_v<Value, std::array<int, 2>>) {
        fits = toIntegers(value, result);
    } else {
        py::detail::make_caster<Value> caster;
        fits = caster.load(value, !std::is_same_v<Value, bool>); // anything would convert to bool
        if (fits)
            result = py::detail::cast_op<Value>(std::move(caster));
    }
    if (!fits)
        throw dfb::InvalidArgument(std::string(name) + " is " + shown(value) + ": it must be " + kind);
    return result;
}

inline dfb::OutputFormat outputOf(const std::string& name)
{
    if (name == "rgba8")
        return dfb::OutputFormat::RGBA8;
    if (name == "srgb8")
        return dfb::OutputFormat::SRGBA8;
    if (name == "rgba32f")
        return dfb::OutputFormat::RGBA32F;
    throw dfb::InvalidArgument("output is '" + name + "': it must be 'rgba8', 'srgb8' or 'rgba32f'");
}

struct Settings {
    dfb::FrameBufferConfig config;
    dfb::FrameConfig frame;

    // With the GIL. Throws nothing: if arguments are wrong, the collective construction with `config` does so, on all
    // ranks.
    explicit Settings(const py::dict& from)
    {
        attempt([&] { read(from); });
    }

    // Calls body(), with the GIL, unless arguments are wrong already. They are wrong if it throws.
    template <class Body>
    void attempt(const Body& body)
    {
        if (isRefused_)
            return;
        const auto cause = Cause::make();
        try {
            if (const std::exception_ptr thrown = caught(*cause, body))
                std::rethrow_exception(thrown);
        } catch (const dfb::Error& e) {
            refuse(e.info().message);
        } catch (const std::exception& e) {
            refuse(e.what());
        }
    }

private:
    void refuse(const std::string& why)
    {
        // If an owner map throws on one rank, the library reports this on all ranks. There is none otherwise, so that
        // the library may choose owners near the pixels.
        config = dfb::FrameBufferConfig(1, 1);
        config.image.ownerMap = [why](int, const dfb::TileLayout&, int) -> int { throw std::invalid_argument(why); };
        isRefused_ = true;
    }

    void read(const py::dict& from)
    {
        config.image.width = argument<int>(from, "width", "an int of 32 bits, in pixels");
        config.image.height = argument<int>(from, "height", "an int of 32 bits, in pixels");
        config.image.format = outputOf(argument<std::string>(from, "output", "a str"));
        config.image.depth = argument<bool>(from, "depth", "a bool");
        config.image.displayRank = argument<int>(from, "display_rank", "an int");
        frame.background = argument<std::array<float, 4>>(from, "background", "four floats");
        if (!from["threads"].is_none()) {
            const int threads = argument<int>(from, "threads", "an int or None");
            if (threads < 1 || threads > 4096)
                throw dfb::InvalidArgument("threads is " + std::to_string(threads) + ": it must be 1 to 4096, or None");
            config.executor = std::make_shared<dfb::ThreadExecutor>(threads);
        }
        if (!from["timeout"].is_none()) {
            const double seconds = argument<double>(from, "timeout", "a float, in seconds, or None");
            if (!(seconds > 0 && seconds <= 2e6))
                throw dfb::InvalidArgument("timeout is " + std::to_string(seconds)
                                           + ": it must be above 0 and at most 2e6 seconds, or None");
            frame.timeout = std::chrono::milliseconds(static_cast<std::int64_t>(std::ceil(1000 * seconds)));
        }
    }

    bool isRefused_ = false;
};

} // namespace dfb_python
