// Progressive: accumulates the pixels of another operation over the passes of many frames, and estimates the error of
// the mean (section 4.1.1 of the paper).
#pragma once

#include <dfb/ops/sort_last.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <type_traits>
#include <vector>

DFB_NAMESPACE_BEGIN

namespace detail {

// Returns by how much M2 (the sum over 4 channels of squared deviations from the mean) grows when `sample` joins `n`
// samples that have this sum. The pairwise formula of Chan, Golub and LeVeque (1979): it has no cancellation, even if
// the mean is large beside the spread.
inline double growthOfM2(std::int64_t n, const double* sum, const double* sample) noexcept
{
    if (n == 0)
        return 0;
    const auto count = static_cast<double>(n);
    double squares = 0;
    for (std::size_t c = 0; c < 4; ++c) {
        const double difference = sample[c] - sum[c] / count;
        squares += difference * difference;
    }
    return squares * (count / (count + 1));
}

} // namespace detail

// `Base`: AlphaBlend, OrderedBlend, DepthComposite or ImageParallel, also those with other sizes and channels. The
// image is the mean of all samples since FrameConfig::accumulationId changed, a frame failed, or a tile began with
// sample 0. "4 more samples a frame until the camera moves":
//
//   params.passes = 4;
//   for (;;) {
//       params.accumulationId += camera.hasMoved();
//       loop.render(renderTile, params); // any loop; tile.sample is 0, 1, 2 and so on
//   }
//
// With FrameConfig::samples, TileSamples::first of a tile must be the number of samples that it has already, or 0,
// which begins again. A tile without samples in a frame costs nothing and keeps its pixels. TileReport::error is the
// standard error of the mean of a finished tile: the root mean square over pixels and RGBA in the worst of its blocks
// of 8x8 pixels. So a bright corner counts even in a dark tile. The error is infinite before the second sample. Memory:
// 45 bytes for each pixel of a tile that this rank owns and that had an input; 56 more with normals and albedo.
template <class Base>
class Progressive {
public:
    static constexpr int tileSize = detail::tile_size_v<Base>;
    static constexpr ChannelMask channels = Base::channels;
    static constexpr ChannelMask neededChannels = detail::needed_channels_v<Base>;
    static constexpr bool activeByDepth = detail::active_by_depth_v<Base>;
    static constexpr bool keepsState = true;
    static_assert(std::is_base_of_v<detail::FragmentStore, Base>,
                  "dfb: Progressive works with AlphaBlend, OrderedBlend, DepthComposite and ImageParallel");

    void newFrame(const TileInfo& info)
    {
        base_.newFrame(info);
        info_ = info;
        if (info.accumulationId != accumulationId_ || (info.passes > 0 && info.firstSample == 0)
            || info.emptySamples > 0) {
            const std::size_t pixels =
                static_cast<std::size_t>(info.region.width()) * static_cast<std::size_t>(info.region.height());
            accumulationId_ = info.accumulationId;
            samples_ = info.emptySamples;
            sums_.reset(pixels, info.wanted);
            sums_.addBackground(info.emptySamples, info.background);
            m2_.assign(pixels, 0.0); // right for the empty samples too, as they are all alike
        }
        if (info.passes > 0 && info.firstSample != samples_)
            detail::failArgument("the tile has accumulated %lld samples, the frame gives it those from %d on",
                                 static_cast<long long>(samples_), info.firstSample);
    }

    void add(Fragment&& fragment) { base_.add(std::move(fragment)); }

    void finish(FinishedTile& out)
    {
        const auto width = static_cast<std::size_t>(out.width());
        const auto passDone = [&](int y, int pass, const CompositeRow& row) {
            const std::size_t first = static_cast<std::size_t>(y) * width;
            for (std::size_t x = 0; x < width; ++x)
                m2_[first + x] += detail::growthOfM2(samples_ + pass, sums_.rgba(first + x), row.rgba.data() + 4 * x);
            sums_.add(first, row);
        };
        base_.compositePasses(passDone);
        samples_ += info_.passes;
        for (int y = 0; y < out.height(); ++y)
            sums_.write(out, y, static_cast<std::size_t>(y) * width, std::max<std::int64_t>(1, samples_));
    }

    void report(TileReport& report) const
    {
        base_.report(report);
        report.error =
            samples_ > 1
                ? std::sqrt(worstBlock() / (4 * static_cast<double>(samples_ - 1) * static_cast<double>(samples_)))
                : std::numeric_limits<double>::infinity();
    }

private:
    // The largest mean of M2 over the pixels of a block. Values that are not finite count as 0: with them, the tile
    // would get samples for ever.
    double worstBlock() const
    {
        constexpr int side = 8;
        const int width = info_.region.width(), height = info_.region.height();
        double worst = 0;
        for (int y0 = 0; y0 < height; y0 += side)
            for (int x0 = 0; x0 < width; x0 += side) {
                double sum = 0;
                int count = 0;
                for (int y = y0; y < std::min(height, y0 + side); ++y)
                    for (int x = x0; x < std::min(width, x0 + side); ++x, ++count) {
                        const double m2 = m2_[static_cast<std::size_t>(y) * static_cast<std::size_t>(width)
                                              + static_cast<std::size_t>(x)];
                        sum += std::isfinite(m2) ? m2 : 0;
                    }
                worst = std::max(worst, sum / count);
            }
        return worst;
    }

    Base base_;
    TileInfo info_;
    std::optional<std::uint64_t> accumulationId_; // empty until the first frame
    std::int64_t samples_ = 0;
    detail::PixelSums sums_;
    std::vector<double> m2_; // per pixel, see growthOfM2()
};

static_assert(is_tile_op_v<Progressive<AlphaBlend>>);

DFB_NAMESPACE_END
