// Channels: the values that a pixel can have, how wide each is, and how it is blended.
#pragma once

#include <dfb/version.hpp>

#include <array>
#include <cstddef>
#include <cstdint>

DFB_NAMESPACE_BEGIN

// A set of channels, one bit each. Unless a tile operation says otherwise, the inputs of a pixel are blended front to
// back, channel by channel as said here. With several passes each is blended first, then colours are averaged.
//
// A pixel of an input is active if its colour or alpha is not 0. Only active pixels count, whatever the other channels
// hold. A pixel with colour but alpha 0 is emission: its colour is added; it hides nothing, and gives no depth,
// position or id.
//
// With DepthComposite, and any operation that says activeByDepth (tile_op.hpp), a pixel is active if its depth is below
// +infinity. With DepthComposite it then gives depth, position and ids whatever its colour and alpha.
using ChannelMask = std::uint16_t;
inline constexpr ChannelMask colorChannel = 1; // premultiplied linear RGBA, 4 floats: blended by the operator over
// 1 float: the distance along the ray, or any function that grows with it. The image gets the nearest of the inputs of
// all passes with alpha > 0.
inline constexpr ChannelMask depthChannel = 2;
// Auxiliary channels. Normals and albedo are blended, so they are premultiplied by the pixel's alpha, as colour is. The
// image gets their mean weighted by alpha, without the background, and 0 where alpha is 0.
//
// Position and ids are those of the front input: the first input with alpha > 0 in the order of blending, which is that
// of (depth, source, part), or the one given to OrderedBlend. An id comes from the first such input that has one. With
// several passes, they are those of the pass with the nearest front input; of equally near ones, or without depths,
// those of the first. To compare passes, depth is sent even if the image has none. With one pass it is sent only if the
// operation needs it or the image has it.
inline constexpr ChannelMask normalChannel =
    4; // 3 floats times alpha: over; comes out shorter than 1 where normals differ
inline constexpr ChannelMask albedoChannel = 8;       // 3 floats times alpha: over
inline constexpr ChannelMask positionChannel = 16;    // 3 floats, not premultiplied: of the front input; else 0
inline constexpr ChannelMask primitiveIdChannel = 32; // 1 unsigned: of the front input that has one; else noId
inline constexpr ChannelMask instanceIdChannel = 64;  // the same
// 1 float: how far back the input reaches, in the units of depth. All that was blended into the pixel is in [depth,
// far]. It is compared, never blended, and not part of an image.
inline constexpr ChannelMask farChannel = 128;

// The channels that an image can have beside colour and depth.
inline constexpr ChannelMask imageAuxChannels =
    normalChannel | albedoChannel | positionChannel | primitiveIdChannel | instanceIdChannel;
inline constexpr ChannelMask allChannels = colorChannel | depthChannel | imageAuxChannels | farChannel;

// The id of pixels where there is no primitive or instance.
inline constexpr std::uint32_t noId = 0xffffffffu;

namespace detail {

inline constexpr int channelCount = 8;
inline constexpr std::size_t channelWords[channelCount] = {4, 1, 3, 3, 3, 1, 1, 1}; // of 4 bytes
inline constexpr const char* channelNames[channelCount] = {"colour",   "depth",        "normal",      "albedo",
                                                           "position", "primitive id", "instance id", "far depth"};
enum Channel : std::size_t { Color, Depth, Normal, Albedo, Position, PrimitiveId, InstanceId, Far };

constexpr bool hasChannel(ChannelMask channels, std::size_t channel) noexcept { return (channels >> channel) & 1; }

// One pointer per channel; null where there is none.
template <class Byte>
struct BasicPlanes {
    std::array<Byte*, channelCount> at{};

    // Steps over so many pixels.
    void advance(std::size_t pixels) noexcept
    {
        for (std::size_t c = 0; c < channelCount; ++c)
            if (at[c])
                at[c] += 4 * pixels * channelWords[c];
    }
    BasicPlanes from(std::size_t pixels) const noexcept
    {
        BasicPlanes result = *this;
        result.advance(pixels);
        return result;
    }
};
using Planes = BasicPlanes<std::byte>;
using ConstPlanes = BasicPlanes<const std::byte>;

inline const float* floatsOf(const std::byte* plane) noexcept { return reinterpret_cast<const float*>(plane); }
inline float* floatsOf(std::byte* plane) noexcept { return reinterpret_cast<float*>(plane); }
inline const std::uint32_t* idsOf(const std::byte* plane) noexcept
{
    return reinterpret_cast<const std::uint32_t*>(plane);
}

// Whether alpha is 1 in all pixels of a colour plane, which has a byte a channel or floats; rows are `stride` pixels
// apart. Stops at the first pixel that is not opaque.
inline bool isOpaque(const std::byte* color, bool hasBytes, int width, int height, std::ptrdiff_t stride) noexcept
{
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            const std::ptrdiff_t alpha = 4 * (y * stride + x) + 3;
            if (hasBytes ? color[alpha] != std::byte{255} : floatsOf(color)[alpha] != 1.0f)
                return false;
        }
    return true;
}

} // namespace detail

DFB_NAMESPACE_END
