// Settings: the arguments of a constructor. If they are wrong on one rank, all ranks throw.
#pragma once

#include "errors.hpp"

#include <dfb/exec.hpp>
#include <dfb/frame.hpp>
#include <dfb/image_compositor.hpp>

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <array>
#include <chrono>
#include <cmath>
#include <memory>
#include <string>
#include <type_traits>
#include <utility>

namespace dfb_python {

// A reason of this rank against the next collective construction or resize(), which then throws on all ranks with this
// text. Both call the owner map; it throws the reason, and the library tells all ranks.
class Veto {
public:
    dfb::OwnerMap ownerMap() const
    {
        return [why = why_](int tile, const dfb::TileLayout& layout, int rankCount) {
            if (!why->empty())
                throw std::runtime_error(*why);
            return dfb::latticeOwner(tile, layout, rankCount);
        };
    }
    void set(std::string why) { *why_ = std::move(why); }
    void clear() { why_->clear(); }
    bool isSet() const noexcept { return !why_->empty(); }
    const std::string& text() const noexcept { return *why_; }

private:
    std::shared_ptr<std::string> why_ = std::make_shared<std::string>();
};

// Returns an argument as text for an error.
inline std::string shown(const py::handle& value) { return py::repr(value); }

// The value of an argument. Throws InvalidArgument if it has another type.
template <class Value>
Value argument(const py::dict& from, const char* name, const char* kind)
{
    const py::object value = from[name];
    py::detail::make_caster<Value> caster;
    // No conversion to bool, because anything would convert.
    if (!caster.load(value, !std::is_same_v<Value, bool>))
        throw dfb::InvalidArgument(std::string(name) + " is " + shown(value) + ": it must be " + kind);
    return py::detail::cast_op<Value>(std::move(caster));
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
    Veto veto;

    // With the GIL. Throws nothing: if arguments are wrong, the reason becomes a veto.
    explicit Settings(const py::dict& from)
    {
        config.image.ownerMap = veto.ownerMap();
        attempt([&] { read(from); });
    }

    // Calls body(), with the GIL, and makes its exception a veto.
    template <class Body>
    void attempt(const Body& body)
    {
        if (veto.isSet())
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
        config = dfb::FrameBufferConfig(1, 1); // this is valid, so all ranks get the veto
        config.image.ownerMap = veto.ownerMap();
        veto.set(why);
    }

    void read(const py::dict& from)
    {
        config.image.width = argument<int>(from, "width", "an int, in pixels");
        config.image.height = argument<int>(from, "height", "an int, in pixels");
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
};

} // namespace dfb_python
