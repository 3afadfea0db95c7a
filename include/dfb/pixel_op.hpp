// The contract of a pixel operation (PixelOp): it changes a finished tile on its owner, before it is converted to the
// output format (section 3.1.2 of the paper).
//
// A PixelOp is a copyable type. Each rank keeps one copy for each frame in flight, and calls process() for several
// tiles at once, on any thread. With frames in flight a tile of one frame may be processed after the same tile of the
// next. An exception makes the frame fail on all ranks; the error has its text.
//
//   void process(PixelTile&) const;              changes the pixels, sends them elsewhere, ...
//
// Optional:
//   static constexpr bool pointwise = true;      a pixel's result depends on that pixel's colour alone and there
//                                                are no side effects: then background tiles need not be processed
//                                                one by one nor travel. Default false.
//   using FrameData = ...;                       copyable per-frame data, given to the framebuffer's begin()
//   void newFrame(const FrameData&);             called in begin(), once a frame on every rank, if there is one;
//                                                without a FrameData it takes a const NoFrameData&
#pragma once

#include <dfb/base/detect.hpp>
#include <dfb/tile_op.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <type_traits>
#include <utility>

DFB_NAMESPACE_BEGIN

// A finished tile in float, row-major, region.width() pixels a row without padding.
struct PixelTile {
    int tile = 0;
    Region region;
    float* color = nullptr;       // 4 a pixel, premultiplied linear RGBA
    const float* depth = nullptr; // 1 a pixel; null unless the image has depth
    AuxRow aux{};                 // for all pixels; a channel is null if the image does not have it
    std::int64_t frame = 0;       // its number

    std::size_t pixelCount() const noexcept
    {
        return static_cast<std::size_t>(region.width()) * static_cast<std::size_t>(region.height());
    }
};

namespace detail {

DFB_DETECTS(has_process_v, std::declval<const T&>().process(std::declval<PixelTile&>()));
DFB_SETTING(bool, is_pointwise_v, false, pointwise);
DFB_DETECTS(has_pixel_new_frame_v, std::declval<T&>().newFrame(std::declval<const typename FrameDataOf<T>::type&>()));

template <class T>
constexpr bool checkPixelOp()
{
    static_assert(std::is_copy_constructible_v<T>, "dfb: PixelOp must provide a copy constructor");
    static_assert(has_process_v<T>, "dfb: PixelOp must provide void process(PixelTile&) const");
    static_assert(std::is_same_v<typename FrameDataOf<T>::type, NoFrameData> || has_pixel_new_frame_v<T>,
                  "dfb: a PixelOp with a FrameData must provide void newFrame(const FrameData&)");
    return true;
}

} // namespace detail

// Whether T has the members that a pixel operation needs; see the head of this file.
template <class T>
inline constexpr bool is_pixel_op_v = std::is_copy_constructible_v<T>&& detail::has_process_v<T>;

// Leaves the tile as it is. The tile is then rounded to the output format directly from double.
struct NoPixelOp {
    static constexpr bool pointwise = true;
    void process(PixelTile&) const noexcept {}
};
static_assert(is_pixel_op_v<NoPixelOp>);

// Exposure k, then Reinhard's global operator: c -> k c / (1 + k c), where c is colour / alpha (Reinhard et al.,
// "Photographic Tone Reproduction for Digital Images", 2002, equation 3). Alpha stays. Where alpha is 0, c is the
// colour itself, so that emission is kept.
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
                const float k = std::min(exposure_ * p[c], std::numeric_limits<float>::max()); // infinity becomes alpha
                p[c] = alpha * (k / (alpha + k));
            }
        }
    }

private:
    float exposure_ = 1.0f;
};

// Applies First, then Second.
template <class First, class Second>
struct PixelOpChain {
    static constexpr bool pointwise = detail::is_pointwise_v<First> && detail::is_pointwise_v<Second>;
    struct FrameData {
        typename detail::FrameDataOf<First>::type first{};
        typename detail::FrameDataOf<Second>::type second{};
    };

    void newFrame(const FrameData& data)
    {
        if constexpr (detail::has_pixel_new_frame_v<First>)
            first.newFrame(data.first);
        if constexpr (detail::has_pixel_new_frame_v<Second>)
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

DFB_NAMESPACE_END
