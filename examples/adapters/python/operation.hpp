// NumpyOperation: a tile operation that a function of Python computes. For prototypes: one tile at a time, under the
// GIL.
#pragma once

#include "errors.hpp"
#include "tiles.hpp"

#include <dfb/tile_op.hpp>

#include <pybind11/numpy.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

namespace dfb_python {

// An input of a tile: the pixels of one brick.
struct OperationInput {
    py::object rgba, depth;
    std::uint32_t source;
};

class NumpyOperation {
public:
    static constexpr dfb::ChannelMask channels = dfb::colorChannel | dfb::depthChannel;
    static constexpr bool emptyIsBackground = true;

    // The function, which any thread calls, and the place for its exceptions.
    struct FrameData {
        std::shared_ptr<py::object> function;
        std::shared_ptr<Cause> cause;
    };

    void newFrame(const dfb::TileInfo& info, const FrameData& data)
    {
        info_ = info;
        data_ = data;
        inputs_.clear();
    }

    void add(dfb::Fragment&& fragment)
    {
        if (!fragment.empty())
            inputs_.push_back(std::move(fragment));
    }

    void finish(dfb::FinishedTile& out)
    {
        const auto pixels = static_cast<std::size_t>(out.width()) * static_cast<std::size_t>(out.height());
        std::vector<double> colors(4 * pixels, 0.0);
        std::vector<float> depths;
        if (!inputs_.empty()) {
            std::sort(inputs_.begin(), inputs_.end(), [](const dfb::Fragment& a, const dfb::Fragment& b) {
                return a.header().source < b.header().source;
            });
            inTurn(*data_.cause, [&] { call(out.wantsDepth(), colors, depths); });
        }
        inputs_.clear();
        for (std::size_t i = 0; i < colors.size(); i += 4) {
            const double light = 1 - colors[i + 3]; // that comes from behind
            for (std::size_t c = 0; c < 4; ++c)
                colors[i + c] += light * static_cast<double>(info_.background[c]);
        }
        const auto width = static_cast<std::size_t>(out.width());
        for (int y = 0; y < out.height(); ++y) {
            const std::size_t first = static_cast<std::size_t>(y) * width;
            out.setRow(y, colors.data() + 4 * first, depths.empty() ? nullptr : depths.data() + first);
        }
    }

private:
    void call(bool wantsDepth, std::vector<double>& colors, std::vector<float>& depths) const
    {
        const dfb::Region& region = info_.region;
        py::list inputs;
        for (const dfb::Fragment& fragment : inputs_) {
            auto rgba = emptyColors(region.width(), region.height());
            auto depth = emptyDepths(region.width(), region.height());
            float *const toColor = rgba.mutable_data(), *const toDepth = depth.mutable_data();
            fragment.forEachPixel([&](int x, int y, const float* color, float distance) {
                const int pixel = y * region.width() + x;
                std::copy_n(color, 4, toColor + 4 * pixel);
                toDepth[pixel] = distance;
            });
            inputs.append(OperationInput{rgba, depth, fragment.header().source});
        }
        py::object result = (*data_.function)(inputs), depth = py::none();
        if (py::isinstance<py::tuple>(result)) {
            const auto both = py::reinterpret_borrow<py::tuple>(result);
            if (both.size() != 2)
                throw dfb::InvalidArgument("the operation returned a tuple of " + std::to_string(both.size())
                                           + ": it must be rgba, or (rgba, depth)");
            result = both[0], depth = both[1];
        }
        const auto rgba = pixelsOf<double>(result, region, 4, "the operation's rgba");
        std::copy_n(rgba.data(), rgba.size(), colors.begin());
        if (wantsDepth && !depth.is_none()) {
            const auto distances = pixelsOf<float>(depth, region, 0, "the operation's depth");
            depths.assign(distances.data(), distances.data() + distances.size());
        }
    }

    dfb::TileInfo info_;
    FrameData data_;
    std::vector<dfb::Fragment> inputs_;
};
static_assert(dfb::is_tile_op_v<NumpyOperation>);

} // namespace dfb_python
