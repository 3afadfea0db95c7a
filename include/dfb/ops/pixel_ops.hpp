// The pixel operations that come with dfb: tone mapping, and a chain of two.
#pragma once

#include <dfb/pixel_op.hpp>

#include <cmath>
#include <cstddef>

namespace dfb {

// Exposure, then Reinhard's global operator on the colour divided by alpha: c -> k c / (1 + k c), c = colour / alpha
// (Reinhard et al., "Photographic Tone Reproduction for Digital Images", 2002, equation 3). Alpha stays. Pixels of
// alpha 0 are treated as if it were 1, so that emission is kept.
struct ToneMap {
    static constexpr bool pointwise = true;
    struct FrameData {
        float exposure = 1.0f; // factor on linear colour, > 0
    };

    void newFrame(const FrameData& data) { exposure_ = data.exposure; }

    void process(PixelTile& tile) const
    {
        for (std::size_t i = 0; i < tile.pixelCount(); ++i) {
            float* p = tile.color + 4 * i;
            const float alpha = p[3] > 0.0f ? p[3] : 1.0f;
            for (int c = 0; c < 3; ++c) {
                const float k = exposure_ * p[c];
                p[c] = alpha * (k / (alpha + k));
            }
        }
    }

private:
    float exposure_ = 1.0f;
};

// First, then Second.
template <class First, class Second>
struct PixelOpChain {
    static constexpr bool pointwise = detail::IsPointwise<First>::value && detail::IsPointwise<Second>::value;
    struct FrameData {
        typename detail::FrameDataOf<First>::type first{};
        typename detail::FrameDataOf<Second>::type second{};
    };

    void newFrame(const FrameData& data)
    {
        if constexpr (detail::HasPixelNewFrame<First>::value)
            first.newFrame(data.first);
        if constexpr (detail::HasPixelNewFrame<Second>::value)
            second.newFrame(data.second);
    }

    void process(PixelTile& tile) const
    {
        first.process(tile);
        second.process(tile);
    }

    First first{};
    Second second{};
};

static_assert(is_pixel_op_v<ToneMap> && is_pixel_op_v<PixelOpChain<ToneMap, ToneMap>>);

} // namespace dfb
