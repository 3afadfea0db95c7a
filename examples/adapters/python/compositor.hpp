// Compositor: dfb::ImageCompositor for Python.
#pragma once

#include "arrays.hpp"
#include "collective.hpp"

#include <dfb/image_compositor.hpp>
#include <dfb/render/shared_world.hpp>

#include <algorithm>
#include <cstdint>
#include <memory>
#include <string>
#include <utility>

namespace dfb_python {

struct CompositorSettings : Settings {
    dfb::ImageBlend blend = dfb::ImageBlend::Nearest;

    explicit CompositorSettings(const py::dict& from) : Settings(from)
    {
        attempt([&] {
            const auto name = argument<std::string>(from, "blend", "a str");
            if (name == "depth")
                blend = dfb::ImageBlend::ByDepth;
            else if (name == "order")
                blend = dfb::ImageBlend::InOrder;
            else if (name != "nearest")
                throw dfb::InvalidArgument("blend is '" + name + "': it must be 'nearest', 'depth' or 'order'");
        });
    }
};

class Compositor : public Collective<dfb::ImageCompositor> {
public:
    Compositor(const py::object& comm, const CompositorSettings& settings)
        : Collective(comm, settings, [&](std::shared_ptr<dfb::Connection>&& connection) {
              return std::make_unique<dfb::ImageCompositor>(std::move(connection), settings.blend, settings.config);
          })
    {
    }

    // Wrong arguments on one rank are an error on all.
    dfb::FrameReport composite(const py::object& rgba, const py::object& depth, const py::dict& options)
    {
        const Use use(*this);
        const auto cause = Cause::make();
        InputArrays arrays;
        int place = -1;
        const std::exception_ptr wrong = caught(*cause, [&] {
            arrays.read(rgba, depth, options, object().config().image);
            if (!options["order"].is_none())
                place = argument<int>(options, "order", "an int of 32 bits or None");
            else if (object().blend() == dfb::ImageBlend::InOrder && !rgba.is_none())
                throw dfb::InvalidArgument("order is None: blend=\"order\" needs this rank's place, 0 in front");
        });
        return withoutGil(*cause, [&] {
            if (!wrong)
                return object().composite(arrays.image, place, frame());
            object().startFailed(wrong, frame());
            return object().end();
        });
    }

    // This rank's place from front to back, as seen from `eye`, if each rank has a box. Wrong arguments on one rank are
    // an error on all.
    int place(const py::object& lower, const py::object& upper, const py::object& eye)
    {
        const Use use(*this);
        std::string why;
        dfb::Brick own{static_cast<std::uint32_t>(object().rank()), {}};
        dfb::Vec3 from;
        try {
            own.bounds = {pointOf(lower, "lower"), pointOf(upper, "upper")};
            from = pointOf(eye, "eye");
            if (!dfb::detail::isBox(own.bounds))
                why = "lower and upper are not a box";
        } catch (const dfb::InvalidArgument& error) {
            why = error.info().message;
        }
        return withoutGil(*Cause::make(), [&] {
            refuseTogether(why, "place()");
            const auto order = dfb::visibilityOrder(dfb::SharedWorld(object(), dfb::World({own})), from);
            return static_cast<int>(std::find(order.begin(), order.end(), object().rank()) - order.begin());
        });
    }

    // Replaces composite() on a rank that cannot take part; throws on all ranks.
    void fail(const std::string& why)
    {
        const Use use(*this);
        withoutGil(*Cause::make(), [&] {
            object().startFailed(std::make_exception_ptr(std::runtime_error(why)), frame());
            object().end();
        });
    }
};

} // namespace dfb_python
