// Plans of samples: samplesIn(), for a part of the image; and AdaptiveSampler, which gives each tile samples by its
// error (section 4.1.1 of the paper).
#pragma once

#include <dfb/frame.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <memory>
#include <vector>

DFB_NAMESPACE_BEGIN

// For FrameConfig::samples: a plan by which only the tiles that meet `region` (pixels of the image) are rendered, with
// `passes` samples a pixel. The image keeps the other tiles. All ranks must give the same arguments. Any thread. Waits
// for nothing. Throws InvalidArgument for less than 1 pass.
inline SamplePlan samplesIn(const TileLayout& layout, const Region& region, int passes = 1)
{
    if (passes < 1)
        detail::failArgument("a region with %d passes", passes);
    std::vector<TileSamples> plan;
    for (int tile = 0; tile < layout.tileCount(); ++tile)
        plan.push_back({0, !intersection(region, layout.region(tile)).empty() ? passes : 0});
    return std::make_shared<const std::vector<TileSamples>>(std::move(plan));
}

// The parameters of AdaptiveSampler.
struct SamplingConfig {
    // A tile is done when its TileReport::error, a standard error in units of colour, is at most this. 0: when it
    // has maxSamples.
    double maxError = 0;
    int firstSamples = 8;  // of each tile, before its error is believed; at least 2
    int maxSamples = 1024; // of each tile, in all
    int frameSamples = 64; // the most that a tile gets in one frame; memory grows with it
};

// Make the same calls on all ranks. The decisions depend only on the frames' reports, which are equal on all ranks. If
// a rank decides otherwise, the frame fails (Disagreement). The tile operation must be a Progressive one:
//
//   dfb::ImageParallelLoop loop(fb);
//   dfb::AdaptiveSampler sampler(fb.layout(), {0.01});
//   while (!sampler.done())
//       sampler.update(loop.render(renderTile, sampler.next()));
//
// Call reset(), not update(), after a frame that throws FrameError or is partial (FrameReport::failure): the
// accumulated samples are lost. After resize() make a new sampler. One thread at a time may use it. Its members send
// nothing and wait for nothing.
class AdaptiveSampler {
public:
    // Throws InvalidArgument unless firstSamples is 2 or more, maxSamples at least firstSamples, frameSamples 1 or
    // more, and maxError 0 or more.
    AdaptiveSampler(const TileLayout& layout, const SamplingConfig& config) : layout_(layout), config_(config)
    {
        if (config.firstSamples < 2 || config.maxSamples < config.firstSamples || config.frameSamples < 1
            || !(config.maxError >= 0))
            detail::failArgument("SamplingConfig: firstSamples must be 2 or more, maxSamples at least firstSamples, "
                                 "frameSamples 1 or more, and maxError 0 or more");
        reset();
    }

    // Begins again; on all ranks.
    void reset()
    {
        ++accumulationId_;
        taken_.assign(static_cast<std::size_t>(layout_.tileCount()), 0);
        error_.assign(taken_.size(), std::numeric_limits<double>::infinity());
        decide();
    }

    // True if no tile needs another sample.
    bool done() const
    {
        return std::all_of(plan_.begin(), plan_.end(), [](const TileSamples& t) { return t.count == 0; });
    }

    // Returns `params` with the samples and the accumulationId of the next frame.
    FrameConfig next(FrameConfig params = {}) const
    {
        params.samples = std::make_shared<const std::vector<TileSamples>>(plan_);
        params.accumulationId = accumulationId_;
        return params;
    }

    // Plans the next frame by the report of the last one, which was begun with next(). Call it after each frame, on
    // all ranks. Nobody checks that the report is of this layout.
    void update(const FrameReport& report)
    {
        for (std::size_t t = 0; t < plan_.size(); ++t)
            if (taken_[t] == 0)
                error_[t] = untouched; // unless the report has an error for it
        for (const TileError& e : report.tileErrors) {
            const auto t = static_cast<std::size_t>(e.tile);
            taken_[t] += plan_[t].count;
            error_[t] = e.error;
        }
        decide();
    }

    // samplesTaken(): the samples of all pixels so far. samplesSaved(): how many more they would be if each tile had as
    // many samples as the tile with the most.
    std::int64_t samplesTaken() const
    {
        std::int64_t sum = 0;
        for (std::size_t t = 0; t < taken_.size(); ++t) {
            const Region r = layout_.region(static_cast<int>(t));
            sum += std::int64_t{taken_[t]} * r.width() * r.height();
        }
        return sum;
    }
    std::int64_t samplesSaved() const
    {
        const std::int64_t most = *std::max_element(taken_.begin(), taken_.end());
        return most * layout_.width() * layout_.height() - samplesTaken();
    }

private:
    static constexpr double untouched = -1; // nothing projects to the tile

    void decide()
    {
        plan_.resize(taken_.size());
        for (std::size_t t = 0; t < taken_.size(); ++t)
            plan_[t] = {taken_[t], std::min(wanted(t), config_.maxSamples) - taken_[t]};
        // Few samples may miss something small, such as an edge that only just reaches into the tile. So a tile gets at
        // least a quarter of its neighbours' samples.
        for (int row = 0; row < layout_.tilesY(); ++row)
            for (int column = 0; column < layout_.tilesX(); ++column) {
                const auto tile = static_cast<std::size_t>(layout_.tileAt(column, row));
                int most = 0;
                for (int y = std::max(0, row - 1); y <= std::min(layout_.tilesY() - 1, row + 1); ++y)
                    for (int x = std::max(0, column - 1); x <= std::min(layout_.tilesX() - 1, column + 1); ++x)
                        most = std::max(most, taken_[static_cast<std::size_t>(layout_.tileAt(x, y))]);
                const int count = std::max(plan_[tile].count, most / 4 - taken_[tile]);
                plan_[tile].count = error_[tile] == untouched ? 0 : std::clamp(count, 0, config_.frameSamples);
            }
    }

    // An estimate of how many samples the tile needs in all: the error falls with the root of their number. At most
    // twice the number it has, as an error from few samples is itself uncertain.
    int wanted(std::size_t t) const
    {
        if (taken_[t] < config_.firstSamples)
            return config_.firstSamples;
        if (config_.maxError == 0)
            return config_.maxSamples;
        if (error_[t] <= config_.maxError)
            return taken_[t];
        const double ratio = error_[t] / config_.maxError;
        const double needed = static_cast<double>(taken_[t]) * std::min(2.0, ratio * ratio);
        return static_cast<int>(std::min(std::ceil(needed), 2e9));
    }

    TileLayout layout_;
    SamplingConfig config_;
    std::uint64_t accumulationId_ = 0;
    std::vector<int> taken_;    // per tile
    std::vector<double> error_; // per tile
    std::vector<TileSamples> plan_;
};

DFB_NAMESPACE_END
