// Accumulation: which samples a frame takes, and whether they continue those of the last frame.
#pragma once

#include <dfb/frame.hpp>
#include <dfb/frame/operations.hpp>

#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>

DFB_NAMESPACE_BEGIN
namespace detail {

class Accumulation {
public:
    struct Start {
        bool keeps = false;  // whether the image has samples or pixels of the last frame
        int firstSample = 0; // of each tile in a frame without a plan of samples
    };

    // Throws InvalidArgument for samples that this framebuffer cannot take. `lastFailed`: whether the last frame has
    // failed.
    Start begin(const FrameConfig& params, const OperationTraits& traits, int tileCount, int framesInFlight,
                bool lastFailed) const
    {
        const bool goesOn = traits.keepsState && !lastFailed && params.accumulationId == lastId_;
        if (!params.samples) {
            const int first = goesOn ? next_ : 0;
            if (params.passes > std::numeric_limits<int>::max() - first)
                failArgument("a tile cannot have %d samples from %d on: take another accumulationId", params.passes,
                             first);
            return {goesOn, first};
        }
        if (params.samples->size() != static_cast<std::size_t>(tileCount))
            failArgument("a plan of the samples of %zu tiles for an image of %d", params.samples->size(), tileCount);
        bool keeps = goesOn;
        for (const TileSamples& t : *params.samples) {
            keeps = keeps || t.count == 0;
            if (t.first < 0 || t.count < 0 || t.count > std::numeric_limits<int>::max() - t.first)
                failArgument("a tile cannot have %d samples from %d on", t.count, t.first);
            if (traits.keepsState) {
                if ((t.first > 0 || t.count == 0) && !goesOn)
                    failArgument(
                        "tile %td has %d samples from %d on, but what was accumulated is of no use, as the last "
                        "frame failed or had another accumulationId: give each tile samples, from 0 on",
                        &t - params.samples->data(), t.count, t.first);
                continue;
            }
            if (t.first > 0)
                failArgument("this tile operation keeps nothing over frames: samples of a tile begin with 0");
            if (t.count > 0)
                continue;
            if (lastFailed)
                failArgument("a tile without samples keeps its pixels, but the last frame failed: render all tiles");
            if (framesInFlight > 1)
                failArgument("a tile without samples keeps its pixels: this needs framesInFlight = 1");
            if (!traits.pixelOpIsPointwise)
                failArgument("a tile without samples keeps its pixels, but the pixel operation wants all tiles");
        }
        return {keeps, 0};
    }

    // Called when a frame has ended without an error. `firstSample`: the sample that it began with.
    void ended(const FrameConfig& params, int firstSample)
    {
        lastId_ = params.accumulationId;
        next_ = params.samples ? 0 : firstSample + params.passes;
    }

private:
    std::optional<std::uint64_t> lastId_; // null before the first frame that has ended without an error
    int next_ = 0;                        // the first sample of each tile, if the next frame has no plan and goes on
};

} // namespace detail
DFB_NAMESPACE_END
