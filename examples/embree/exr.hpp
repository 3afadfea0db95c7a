// EXR: an image and its layers in one file, if OpenEXR is available (DFB_EXAMPLE_HAS_OPENEXR).
#pragma once

#include <dfb/image.hpp>

#include <string>

namespace example {

#if defined(DFB_EXAMPLE_HAS_OPENEXR)
inline constexpr bool hasOpenExr = true;
#else
inline constexpr bool hasOpenExr = false;
#endif

// Writes linear, premultiplied R, G, B, A as 32-bit floats; and those of `layers`, which the image must have: Z, the
// distance along the ray, infinite where there is nothing; N.X, N.Y, N.Z; albedo.R, .G, .B; P.X, P.Y, P.Z; and as
// integers id.primitive and id.instance, 4294967295 where there is none. `comment` goes into the header. Throws
// std::runtime_error with the file's name.
void writeExr(const std::string& path, const dfb::Image& image, dfb::ChannelMask layers, const std::string& comment);

} // namespace example
