// Image: what an IceTImage points to. Rows count upwards.
#pragma once

#include <IceT.h>
#include <dfb/image.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace dfb_icet {

// Bytes of a pixel. Throws Error if there is no such format.
std::size_t colorBytes(IceTEnum format);

// Rounds down to a level, as IceT does. A value that is not a number is 0.
inline std::uint8_t levelOf(float value)
{
    return static_cast<std::uint8_t>(255 * std::min(std::max(0.0f, value), 1.0f));
}

struct Image {
    IceTEnum colorFormat = ICET_IMAGE_COLOR_NONE, depthFormat = ICET_IMAGE_DEPTH_NONE;
    int width = 0, height = 0;
    const void* color = nullptr; // in `shared` or `owned`, or in a picture of the library
    const float* depth = nullptr;
    dfb::Buffer shared;           // the draw callback renders into it; ranks of the node read it there
    std::vector<std::byte> owned; // copies of the library's pixels
    std::vector<float> ownedDepth;

    std::size_t pixelCount() const noexcept
    {
        return static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
    }
    // Colours that a client may change. Those in a picture of the library are copied first, because its pictures keep
    // their background from frame to frame.
    void* writableColor();
    // Makes `owned`, with `bytes` bytes, the memory of the colours, and returns it.
    std::byte* ownColor(std::size_t bytes);
};

// Returns the part of an image of RGB floats as RGBA with alpha 1, in `memory`, which gets the size of the image.
const float* addAlpha(const float* rgb, const dfb::Region& part, int width, int height, std::vector<float>& memory);
// Here alpha is 1, too.
void addAlpha(const float* rgb, std::size_t pixels, float* out);
// `out` may be the same memory as `rgba`.
void dropAlpha(const float* rgba, std::size_t pixels, float* out);

} // namespace dfb_icet
