// Image: the picture that the display rank gets, in one of the output formats; and the exact conversion of linear
// pixels to those formats.
#pragma once

#include <dfb/buffer.hpp>
#include <dfb/channels.hpp>
#include <dfb/compiled.hpp>
#include <dfb/error.hpp>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <new>
#include <numeric>
#include <string>
#include <vector>

DFB_NAMESPACE_BEGIN

// A half-open rectangle of pixels, [x0, x1) x [y0, y1), row 0 on top.
struct Region {
    int x0 = 0, y0 = 0, x1 = 0, y1 = 0;

    int width() const noexcept { return x1 - x0; }
    int height() const noexcept { return y1 - y0; }
    bool empty() const noexcept { return x1 <= x0 || y1 <= y0; }
    bool contains(int x, int y) const noexcept { return x >= x0 && x < x1 && y >= y0 && y < y1; }
};

inline bool operator==(const Region& a, const Region& b) noexcept
{
    return a.x0 == b.x0 && a.y0 == b.y0 && a.x1 == b.x1 && a.y1 == b.y1;
}
inline bool operator!=(const Region& a, const Region& b) noexcept { return !(a == b); }

inline Region intersection(const Region& a, const Region& b) noexcept
{
    return {std::max(a.x0, b.x0), std::max(a.y0, b.y0), std::min(a.x1, b.x1), std::min(a.y1, b.y1)};
}

// Pixels are premultiplied RGBA, 4 channels interleaved.
enum class OutputFormat : std::uint32_t {
    None,   // nothing travels to the display rank and nothing is stored there
    RGBA8,  // 8 bits a channel, linear: 255 * value, rounded to nearest, ties to even
    SRGBA8, // 8 bits a channel, colour through the sRGB curve (IEC 61966-2-1), alpha linear
    RGBA32F // 32-bit float, linear
};

inline const char* nameOf(OutputFormat format) noexcept
{
    switch (format) {
    case OutputFormat::None: return "None";
    case OutputFormat::RGBA8: return "RGBA8";
    case OutputFormat::SRGBA8: return "SRGBA8";
    case OutputFormat::RGBA32F: return "RGBA32F";
    }
    return "unknown";
}

inline std::size_t bytesPerPixel(OutputFormat format) noexcept
{
    return format == OutputFormat::None ? 0 : format == OutputFormat::RGBA32F ? 16 : 4;
}

// Converts `count` linear premultiplied RGBA pixels, double or float, to `format`, and writes bytesPerPixel(format)
// bytes each to `out`, rounded to nearest. `out` must have room for them and not overlap `rgba`; for RGBA32F it is
// aligned to floats. Any thread. Returns the largest distance of a value from its level, in levels: 0 to 1/2 (a tie).
// The distance may be up to 2^-15 too large. sRGB colours count only next to a boundary between levels, and then as a
// tie. 0 for RGBA32F and None.
template <class Real>
double convertPixels(const Real* rgba, int count, OutputFormat format, std::byte* out);

// convertPixels() with dithered colour, if the format has 8 bits; (x, y) is the place of the first pixel in the image.
// Alpha is rounded, not dithered. A colour that is at most alpha gets at most the level that alpha would get as a
// colour (ties go down). So in RGBA8 it stays at most alpha. This limit lowers a colour by half a level at most.
// Returns the largest rounding distance of alpha, as convertPixels() does.
template <class Real>
double ditherPixels(const Real* rgba, int count, OutputFormat format, int x, int y, std::byte* out);

// A whole image, row-major, without padding. Row 0 is the top row, or the lowest one after
// ImageCompositor::setBottomUp(true). Several threads may call const members at once. Without pixels it is empty(), as
// image() is on ranks other than the display rank and with OutputFormat::None.
class Image {
public:
    Image() = default;
    // `channels`: those beside the colour. Throws OutOfMemory, which has the bytes of the whole image.
    Image(MemoryPool& pool, int width, int height, OutputFormat format, ChannelMask channels)
        : width_(width), height_(height), format_(format)
    {
        if (format == OutputFormat::None)
            return;
        std::array<std::size_t, detail::channelCount> bytes{}; // of a pixel
        for (std::size_t c = 0; c < detail::channelCount; ++c)
            bytes[c] = detail::hasChannel(channels | colorChannel, c) ? pixelBytes(c) : 0;
        try {
            for (std::size_t c = 0; c < detail::channelCount; ++c)
                if (bytes[c] > 0)
                    planes_[c] = pool.acquire(pixelCount() * bytes[c]);
        } catch (const std::bad_alloc&) {
            const std::size_t pixelBytes = std::accumulate(bytes.begin(), bytes.end(), std::size_t{0});
            char text[150];
            std::snprintf(text, sizeof text, "an image of %dx%d pixels of %zu bytes (%s%s)", width, height, pixelBytes,
                          nameOf(format), pixelBytes > bytes[detail::Color] ? " and more channels" : "");
            throw OutOfMemory(pixelCount() * pixelBytes, text);
        }
    }

    int width() const noexcept { return width_; }
    int height() const noexcept { return height_; }
    OutputFormat format() const noexcept { return format_; }
    std::size_t pixelCount() const noexcept
    {
        return static_cast<std::size_t>(width_) * static_cast<std::size_t>(height_);
    }
    bool empty() const noexcept { return planes_[detail::Color].empty(); }
    bool hasDepth() const noexcept { return !planes_[detail::Depth].empty(); }

    std::byte* bytes() noexcept { return planes_[detail::Color].data(); }
    const std::byte* bytes() const noexcept { return planes_[detail::Color].data(); }

    // 4 bytes a pixel. Throws InvalidArgument unless the format is RGBA8 or SRGBA8.
    const std::uint8_t* rgba8() const
    {
        require(format_ == OutputFormat::RGBA8 || format_ == OutputFormat::SRGBA8, "8-bit pixels");
        return reinterpret_cast<const std::uint8_t*>(bytes());
    }
    // 4 floats a pixel. Throws InvalidArgument unless the format is RGBA32F.
    const float* rgba32f() const
    {
        require(format_ == OutputFormat::RGBA32F, "float pixels");
        return reinterpret_cast<const float*>(bytes());
    }
    // One float a pixel, +infinity where nothing was hit. This and the following members throw InvalidArgument if the
    // channel was not asked for. channels.hpp says what the values mean where inputs were blended.
    const float* depth() const { return detail::floatsOf(plane(detail::Depth, "depth")); }
    const float* normal() const { return detail::floatsOf(plane(detail::Normal, "normals")); }       // 3 a pixel
    const float* albedo() const { return detail::floatsOf(plane(detail::Albedo, "albedo")); }        // 3 a pixel
    const float* position() const { return detail::floatsOf(plane(detail::Position, "positions")); } // 3 a pixel
    // noId where there is none.
    const std::uint32_t* primitiveId() const { return detail::idsOf(plane(detail::PrimitiveId, "primitive ids")); }
    const std::uint32_t* instanceId() const { return detail::idsOf(plane(detail::InstanceId, "instance ids")); }

    // Calls use(bytes, byteCount) for each plane that the image has: colour, then depth, then the auxiliary channels.
    template <class Use>
    void forEachPlane(const Use& use) const
    {
        for (std::size_t c = 0; c < detail::channelCount; ++c)
            if (!planes_[c].empty())
                use(planes_[c].data(), pixelCount() * pixelBytes(c));
    }
    template <class Use>
    void forEachPlane(const Use& use)
    {
        for (std::size_t c = 0; c < detail::channelCount; ++c)
            if (!planes_[c].empty())
                use(planes_[c].data(), pixelCount() * pixelBytes(c));
    }

    // Hands over the memory of the planes. The image is empty afterwards.
    std::array<Buffer, detail::channelCount> release() noexcept { return std::move(planes_); }

    // The address of each plane; null where there is none.
    detail::Planes planes() noexcept
    {
        detail::Planes planes;
        for (std::size_t c = 0; c < detail::channelCount; ++c)
            planes.at[c] = planes_[c].data();
        return planes;
    }

private:
    void require(bool condition, const char* what) const
    {
        if (!condition || empty())
            throw InvalidArgument(std::string("this image has no ") + what
                                  + " (only the display rank has an image, in the format it was configured for, and "
                                    "after a frame that ended well)");
    }

    std::size_t pixelBytes(std::size_t c) const noexcept
    {
        return c == detail::Color ? bytesPerPixel(format_) : 4 * detail::channelWords[c];
    }

    const std::byte* plane(detail::Channel channel, const char* what) const
    {
        require(!planes_[channel].empty(), what);
        return planes_[channel].data();
    }

    int width_ = 0, height_ = 0;
    OutputFormat format_ = OutputFormat::None;
    std::array<Buffer, detail::channelCount> planes_;
};

// Writes the colours of an image to a file that most image viewers open: a PPM file, 8 bits a channel, without alpha.
// RGBA32F becomes sRGB; 8-bit images are written as they are. Row 0 becomes the top row: after
// ImageCompositor::setBottomUp(true) the file is upside down. Replaces an existing file. Not collective: call it on a
// rank that has an image. Any thread. Throws InvalidArgument, with nothing written, if the image is empty; or if the
// file cannot be written, of which a part may be left.
DFB_COMPILED_ONCE void writePpm(const std::string& path, const Image& image);

DFB_NAMESPACE_END

#if DFB_HAS_BODIES
#include <dfb/base/levels.hpp>

DFB_NAMESPACE_BEGIN

template <class Real>
double convertPixels(const Real* rgba, int count, OutputFormat format, std::byte* out)
{
    auto* bytes = reinterpret_cast<std::uint8_t*>(out);
    switch (format) {
    case OutputFormat::None: break;
    case OutputFormat::RGBA8: return detail::pixelsToLevels<false>(rgba, count, bytes);
    case OutputFormat::SRGBA8: return detail::pixelsToLevels<true>(rgba, count, bytes);
    case OutputFormat::RGBA32F:
        detail::fastest<detail::toFloats<Real>>(rgba, 4 * count, reinterpret_cast<float*>(out));
        break;
    }
    return 0;
}

template <class Real>
double ditherPixels(const Real* rgba, int count, OutputFormat format, int x, int y, std::byte* out)
{
    if (format != OutputFormat::RGBA8 && format != OutputFormat::SRGBA8)
        return convertPixels(rgba, count, format, out);
    const bool isSrgb = format == OutputFormat::SRGBA8;
    auto* bytes = reinterpret_cast<std::uint8_t*>(out);
    double farthest = 0;
    for (int i = 0; i < count; ++i, rgba += 4, bytes += 4) {
        const double threshold = (detail::ditherRank(x + i, y) + 0.5) / 64, exactAlpha = rgba[3];
        farthest = std::max(farthest, detail::toUnorm8(&exactAlpha, 1, bytes + 3));
        const auto alpha = static_cast<float>(rgba[3]);
        // A tie in float may go either way in the exact alpha, which has more digits.
        const int most = isSrgb ? detail::toSrgb8(static_cast<double>(alpha)) : detail::ditherUnorm8(alpha, 0.5001);
        for (int c = 0; c < 3; ++c) {
            const auto value = static_cast<float>(rgba[c]);
            const int level = isSrgb ? detail::ditherSrgb8(value, threshold) : detail::ditherUnorm8(value, threshold);
            bytes[c] = static_cast<std::uint8_t>(value <= alpha ? std::min(level, most) : level);
        }
    }
    return farthest;
}

DFB_COMPILED_ONCE void writePpm(const std::string& path, const Image& image)
{
    if (image.empty())
        detail::failArgument("no image to write to %s: only the display rank has one, if the last frame did not fail "
                             "and the format is not None",
                             path.c_str());
    const auto width = static_cast<std::size_t>(image.width()), height = static_cast<std::size_t>(image.height());
    const bool isFloat = image.format() == OutputFormat::RGBA32F;
    std::vector<std::uint8_t> converted(isFloat ? 4 * width : 0), row(3 * width);
    errno = 0;
    std::FILE* file = std::fopen(path.c_str(), "wb");
    bool good = file && std::fprintf(file, "P6 %zu %zu 255\n", width, height) > 0;
    for (std::size_t y = 0; good && y < height; ++y) {
        if (isFloat)
            convertPixels(image.rgba32f() + 4 * width * y, image.width(), OutputFormat::SRGBA8,
                          reinterpret_cast<std::byte*>(converted.data()));
        const std::uint8_t* rgba = isFloat ? converted.data() : image.rgba8() + 4 * width * y;
        for (std::size_t x = 0; x < width; ++x)
            std::copy_n(rgba + 4 * x, 3, row.data() + 3 * x);
        good = std::fwrite(row.data(), 1, row.size(), file) == row.size();
    }
    if (file && std::fclose(file) != 0)
        good = false;
    if (!good)
        detail::failArgument("cannot write %s: %s", path.c_str(), std::strerror(errno));
}

DFB_NAMESPACE_END
#endif

DFB_NAMESPACE_BEGIN
DFB_COMPILED_TEMPLATE(double convertPixels(const float*, int, OutputFormat, std::byte*));
DFB_COMPILED_TEMPLATE(double convertPixels(const double*, int, OutputFormat, std::byte*));
DFB_COMPILED_TEMPLATE(double ditherPixels(const float*, int, OutputFormat, int, int, std::byte*));
DFB_COMPILED_TEMPLATE(double ditherPixels(const double*, int, OutputFormat, int, int, std::byte*));
DFB_NAMESPACE_END
