// CompositeRow: a row of pixels that is being composited, with all of its channels; and the layers that go into it.
#pragma once

#include <dfb/channels.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

DFB_NAMESPACE_BEGIN

// How the inputs of a pixel become one.
enum class BlendRule {
    SortByDepth, // sortAndBlend
    InOrder,     // over, in the order of the fragments
    Nearest      // keepNearest
};

// An id, and the depth of the layer that it comes from. The depth is 0 if layers have none.
struct FrontId {
    std::uint32_t id = noId;
    float depth = 0;

    bool isThere() const noexcept { return id != noId; }
};

// The position of the nearest layer, and its depth. The depth is NaN until there is a layer; no layer has a depth of
// NaN.
struct FrontPosition {
    float at[3] = {0, 0, 0};
    float depth = std::numeric_limits<float>::quiet_NaN();

    bool isThere() const noexcept { return depth == depth; }
};

// The auxiliary channels of a row or a tile of pixels. Those that are not wanted are empty. See channels.hpp.
struct AuxPixels {
    std::vector<double> normal, albedo; // 3 a pixel, premultiplied
    std::vector<double> weight;         // of normal and albedo: the alpha without the background
    std::vector<FrontPosition> position;
    std::vector<FrontId> primitiveId, instanceId;

    void reset(std::size_t pixels, ChannelMask wanted)
    {
        const auto count = [&](ChannelMask channel, std::size_t each) { return wanted & channel ? each * pixels : 0; };
        normal.assign(count(normalChannel, 3), 0.0);
        albedo.assign(count(albedoChannel, 3), 0.0);
        weight.assign(count(normalChannel | albedoChannel, 1), 0.0);
        position.assign(count(positionChannel, 1), {});
        primitiveId.assign(count(primitiveIdChannel, 1), {});
        instanceId.assign(count(instanceIdChannel, 1), {});
    }
};

struct CompositeRow {
    std::vector<double> rgba;          // 4 * width, premultiplied
    std::vector<double> transmittance; // width
    std::vector<float> depth;          // width: that of the nearest layer with alpha > 0, or +infinity
    // The low words of `rgba` and `transmittance`, for sums in double-double. They have the same sizes, or are empty if
    // not computed.
    std::vector<double> rgbaLow, transmittanceLow;
    AuxPixels aux;
    // For layers that have a far depth: how far back those with alpha > 0 reach so far, and whether any layer overlaps
    // one in front of it.
    std::vector<float> reach;              // width, or empty
    std::vector<std::uint8_t> isUndefined; // width, or empty
    double minTransmittance = 0;           // a pixel that lets less through counts as opaque
    bool wantsDepth = true;                // if false, `depth` is empty
    bool wantsGaps = true;                 // if false, pixels that no layer covers need not be cleared
    bool wantsSingles = true;              // if false, pixels that one layer covers need not be set

    // Sizes it for `width` pixels, whose colour, transmittance and depth are undefined afterwards. `wanted`: auxiliary
    // channels. `exactly`: compute in twice the precision of double.
    void resize(int width, ChannelMask wanted = 0, bool exactly = false)
    {
        const auto pixels = static_cast<std::size_t>(width);
        rgba.resize(4 * pixels);
        transmittance.resize(pixels);
        rgbaLow.assign(exactly ? 4 * pixels : 0, 0.0);
        transmittanceLow.assign(exactly ? pixels : 0, 0.0);
        depth.resize(wantsDepth ? pixels : 0);
        aux.reset(pixels, wanted);
        reach.assign(wanted & farChannel ? pixels : 0, -std::numeric_limits<float>::infinity());
        isUndefined.assign(wanted & farChannel ? pixels : 0, 0);
    }

    // Resets pixels [x, x + count) to no layers.
    void clear(int x, int count)
    {
        const auto first = static_cast<std::ptrdiff_t>(x);
        std::fill_n(rgba.begin() + 4 * first, 4 * count, 0.0);
        std::fill_n(transmittance.begin() + first, count, 1.0);
        if (wantsDepth)
            std::fill_n(depth.begin() + first, count, std::numeric_limits<float>::infinity());
    }
};

// A run of pixels of one layer. If depth is null, all pixels count as equally deep.
struct Layer {
    const float* color = nullptr;
    const float* depth = nullptr;
    const detail::ConstPlanes* aux = nullptr; // null: no auxiliary channels, or not wanted

    Layer from(int pixel) const
    {
        return {color + 4 * static_cast<std::ptrdiff_t>(pixel), depth ? depth + pixel : nullptr, aux};
    }
};

DFB_NAMESPACE_END
