#include "image.hpp"

#include "errors.hpp"

#include <algorithm>
#include <cstring>

namespace dfb_icet {

std::size_t colorBytes(IceTEnum format)
{
    switch (format) {
    case ICET_IMAGE_COLOR_NONE: return 0;
    case ICET_IMAGE_COLOR_RGBA_UBYTE: return 4;
    case ICET_IMAGE_COLOR_RGBA_FLOAT: return 4 * sizeof(float);
#if defined(ICET_IMAGE_COLOR_RGB_FLOAT)
    case ICET_IMAGE_COLOR_RGB_FLOAT: return 3 * sizeof(float);
#endif
    default: throw Error(ICET_INVALID_ENUM, "a color format that is not known");
    }
}

std::byte* Image::ownColor(std::size_t bytes)
{
    owned.resize(bytes);
    color = owned.data();
    return owned.data();
}

void* Image::writableColor()
{
    const void* from = color;
    if (from && from != shared.data() && from != owned.data()) {
        const std::size_t bytes = pixelCount() * colorBytes(colorFormat);
        std::memcpy(ownColor(bytes), from, bytes);
    }
    return const_cast<void*>(color);
}

const float* addAlpha(const float* rgb, const dfb::Region& part, int width, int height, std::vector<float>& memory)
{
    memory.resize(4 * static_cast<std::size_t>(width) * static_cast<std::size_t>(height));
    for (int y = part.y0; y < part.y1; ++y) {
        const std::size_t at =
            static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(part.x0);
        addAlpha(rgb + 3 * at, static_cast<std::size_t>(part.width()), memory.data() + 4 * at);
    }
    return memory.data();
}

void addAlpha(const float* rgb, std::size_t pixels, float* out)
{
    for (std::size_t i = 0; i < pixels; ++i) {
        std::copy_n(rgb + 3 * i, 3, out + 4 * i);
        out[4 * i + 3] = 1;
    }
}

void dropAlpha(const float* rgba, std::size_t pixels, float* out)
{
    for (std::size_t i = 0; i < pixels; ++i)
        std::copy_n(rgba + 4 * i, 3, out + 3 * i);
}

namespace {

Image* imageOf(IceTImage image) { return static_cast<Image*>(image.opaque_internals); }

bool isFloat(IceTEnum format)
{
#if defined(ICET_IMAGE_COLOR_RGB_FLOAT)
    if (format == ICET_IMAGE_COLOR_RGB_FLOAT)
        return true;
#endif
    return format == ICET_IMAGE_COLOR_RGBA_FLOAT;
}

Image& withColor(IceTImage image, bool isRight, const char* type)
{
    if (!isRight)
        throw Error(ICET_INVALID_OPERATION, std::string("the image's colors are not of type ") + type);
    return *imageOf(image);
}
Image& withBytes(IceTImage image)
{
    return withColor(image, icetImageGetColorFormat(image) == ICET_IMAGE_COLOR_RGBA_UBYTE, "ubyte");
}
Image& withFloats(IceTImage image) { return withColor(image, isFloat(icetImageGetColorFormat(image)), "float"); }

Image& withDepth(IceTImage image)
{
    if (icetImageGetDepthFormat(image) != ICET_IMAGE_DEPTH_FLOAT)
        throw Error(ICET_INVALID_OPERATION, "the image has no depth");
    return *imageOf(image);
}

void copyBytes(const IceTImage image, IceTUByte* out, IceTEnum format)
{
    if (format != ICET_IMAGE_COLOR_RGBA_UBYTE)
        throw Error(ICET_INVALID_ENUM, "the color format is not of type ubyte");
    const IceTEnum own = icetImageGetColorFormat(image);
    if (!isFloat(own)) {
        const Image& from = withBytes(image);
        std::memcpy(out, from.color, 4 * from.pixelCount());
        return;
    }
    const Image& from = withFloats(image);
    const auto* values = static_cast<const float*>(from.color);
    const std::size_t channels = colorBytes(own) / sizeof(float);
    for (std::size_t i = 0; i < from.pixelCount(); ++i)
        for (std::size_t c = 0; c < 4; ++c)
            out[4 * i + c] = c < channels ? levelOf(values[channels * i + c]) : 255;
}

void copyFloats(const IceTImage image, IceTFloat* out, IceTEnum format)
{
    const IceTEnum own = icetImageGetColorFormat(image);
    if (!isFloat(format))
        throw Error(ICET_INVALID_ENUM, "the color format is not of type float");
    if (own == format) {
        const Image& from = withFloats(image);
        std::memcpy(out, from.color, colorBytes(own) * from.pixelCount());
        return;
    }
    const std::size_t channels = colorBytes(format) / sizeof(float);
    if (isFloat(own)) {
        const Image& from = withFloats(image);
        const auto* values = static_cast<const float*>(from.color);
        if (channels == 4)
            addAlpha(values, from.pixelCount(), out);
        else
            dropAlpha(values, from.pixelCount(), out);
        return;
    }
    const Image& from = withBytes(image);
    const auto* levels = static_cast<const IceTUByte*>(from.color);
    for (std::size_t i = 0; i < from.pixelCount(); ++i)
        for (std::size_t c = 0; c < channels; ++c)
            out[channels * i + c] = static_cast<float>(levels[4 * i + c]) / 255.0f;
}

} // namespace

extern "C" {

IceTImage icetImageNull() { return {nullptr}; }
IceTBoolean icetImageIsNull(const IceTImage image) { return imageOf(image) ? ICET_FALSE : ICET_TRUE; }

IceTEnum icetImageGetColorFormat(const IceTImage image)
{
    return imageOf(image) ? imageOf(image)->colorFormat : ICET_IMAGE_COLOR_NONE;
}
IceTEnum icetImageGetDepthFormat(const IceTImage image)
{
    return imageOf(image) ? imageOf(image)->depthFormat : ICET_IMAGE_DEPTH_NONE;
}
IceTSizeType icetImageGetWidth(const IceTImage image) { return imageOf(image) ? imageOf(image)->width : 0; }
IceTSizeType icetImageGetHeight(const IceTImage image) { return imageOf(image) ? imageOf(image)->height : 0; }
IceTSizeType icetImageGetNumPixels(const IceTImage image)
{
    return icetImageGetWidth(image) * icetImageGetHeight(image);
}

IceTUByte* icetImageGetColorub(IceTImage image)
{
    return guarded("icetImageGetColorub", [&] { return static_cast<IceTUByte*>(withBytes(image).writableColor()); });
}
IceTUInt* icetImageGetColorui(IceTImage image)
{
    return guarded("icetImageGetColorui", [&] { return static_cast<IceTUInt*>(withBytes(image).writableColor()); });
}
IceTFloat* icetImageGetColorf(IceTImage image)
{
    return guarded("icetImageGetColorf", [&] { return static_cast<IceTFloat*>(withFloats(image).writableColor()); });
}
IceTFloat* icetImageGetDepthf(IceTImage image)
{
    return guarded("icetImageGetDepthf", [&] { return const_cast<IceTFloat*>(withDepth(image).depth); });
}

const IceTUByte* icetImageGetColorcub(const IceTImage image)
{
    return guarded("icetImageGetColorcub", [&] { return static_cast<const IceTUByte*>(withBytes(image).color); });
}
const IceTUInt* icetImageGetColorcui(const IceTImage image)
{
    return guarded("icetImageGetColorcui", [&] { return static_cast<const IceTUInt*>(withBytes(image).color); });
}
const IceTFloat* icetImageGetColorcf(const IceTImage image)
{
    return guarded("icetImageGetColorcf", [&] { return static_cast<const IceTFloat*>(withFloats(image).color); });
}
const IceTFloat* icetImageGetDepthcf(const IceTImage image)
{
    return guarded("icetImageGetDepthcf", [&] { return withDepth(image).depth; });
}

void icetImageCopyColorub(const IceTImage image, IceTUByte* out, IceTEnum format)
{
    guarded("icetImageCopyColorub", [&] { copyBytes(image, out, format); });
}
void icetImageCopyColorf(const IceTImage image, IceTFloat* out, IceTEnum format)
{
    guarded("icetImageCopyColorf", [&] { copyFloats(image, out, format); });
}
void icetImageCopyDepthf(const IceTImage image, IceTFloat* out, IceTEnum format)
{
    guarded("icetImageCopyDepthf", [&] {
        if (format != ICET_IMAGE_DEPTH_FLOAT)
            throw Error(ICET_INVALID_ENUM, "the depth format is not of type float");
        const Image& from = withDepth(image);
        std::memcpy(out, from.depth, sizeof(float) * from.pixelCount());
    });
}
}

} // namespace dfb_icet
