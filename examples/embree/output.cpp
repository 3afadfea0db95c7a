// Writing images and statistics.
#include "output.hpp"

#include <png.h>
#define XXH_INLINE_ALL
#include <xxhash.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <csetjmp>
#include <cstddef>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <stdexcept>
#include <system_error>

namespace example {

namespace {

// Writes an image as a PFM: rows from the lowest to the highest, little-endian. Each pixel has `planes` floats; pixels
// are `stride` floats apart.
void writeFloats(const std::string& path, int width, int height, const float* values, int stride, int planes)
{
    errno = 0;
    std::ofstream stream(path, std::ios::binary | std::ios::trunc);
    stream << (planes == 3 ? "PF\n" : "Pf\n") << width << ' ' << height << "\n-1.0\n";
    std::vector<float> row(static_cast<std::size_t>(width) * static_cast<std::size_t>(planes));
    for (int y = height - 1; y >= 0; --y) {
        std::size_t at = 0;
        for (int x = 0; x < width; ++x) {
            const float* pixel =
                values + (static_cast<std::ptrdiff_t>(y) * width + x) * static_cast<std::ptrdiff_t>(stride);
            for (int c = 0; c < planes; ++c)
                row[at++] = pixel[c];
        }
        stream.write(reinterpret_cast<const char*>(row.data()), static_cast<std::streamsize>(4 * row.size()));
    }
    stream.close();
    if (!stream)
        detail::failToWrite(path, std::strerror(errno));
}

// Writes a PNG in sRGB of rows that `rowOf(y)` returns, RGBA with this many bits each, 8 or 16 (big-endian). Returns
// false if libpng fails. It reports that by longjmp, so nothing here may have a destructor.
template <class RowOf>
bool writePngRows(std::FILE* file, int width, int height, int bits, bool hasAlpha, const RowOf& rowOf)
{
    png_structp png = png_create_write_struct(
        PNG_LIBPNG_VER_STRING, nullptr, [](png_structp p, png_const_charp) { png_longjmp(p, 1); },
        [](png_structp, png_const_charp) {});
    png_infop info = png == nullptr ? nullptr : png_create_info_struct(png);
    if (info == nullptr || setjmp(png_jmpbuf(png)) != 0) {
        png_destroy_write_struct(&png, &info);
        return false;
    }
    png_init_io(png, file);
    png_set_IHDR(png, info, static_cast<png_uint_32>(width), static_cast<png_uint_32>(height), bits,
                 hasAlpha ? PNG_COLOR_TYPE_RGB_ALPHA : PNG_COLOR_TYPE_RGB, PNG_INTERLACE_NONE,
                 PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
    png_set_sRGB(png, info, PNG_sRGB_INTENT_PERCEPTUAL);
    png_write_info(png, info);
    if (!hasAlpha)
        png_set_filler(png, 0, PNG_FILLER_AFTER); // leaves alpha out
    for (int y = 0; y < height; ++y)
        png_write_row(png, rowOf(static_cast<std::size_t>(y)));
    png_write_end(png, info);
    png_destroy_write_struct(&png, &info);
    return true;
}

template <class RowOf>
void writePngFile(const std::string& path, int width, int height, int bits, bool hasAlpha, const RowOf& rowOf)
{
    errno = 0;
    std::FILE* file = std::fopen(path.c_str(), "wb");
    if (file == nullptr)
        detail::failToWrite(path, std::strerror(errno));
    const bool written = writePngRows(file, width, height, bits, hasAlpha, rowOf);
    const bool closed = std::fclose(file) == 0;
    if (!written || !closed)
        detail::failToWrite(path, errno != 0 ? std::strerror(errno) : "libpng cannot");
}

} // namespace

[[noreturn]] void detail::failToWrite(const std::string& path, const std::string& why)
{
    throw std::runtime_error(path + ": cannot be written: " + why);
}

void requireWritable(const std::string& path)
{
    std::error_code ignored;
    const auto kind = std::filesystem::symlink_status(path, ignored).type();
    const bool existed = kind != std::filesystem::file_type::not_found;
    if (existed && !std::filesystem::is_regular_file(path, ignored) && kind != std::filesystem::file_type::directory)
        return; // the reader of a pipe would take it for the end; a link may lead to nothing yet
    errno = 0;
    if (!std::ofstream(path, std::ios::binary | std::ios::app))
        detail::failToWrite(path, std::strerror(errno));
    if (!existed)
        std::filesystem::remove(path, ignored);
}

void writePng(const std::string& path, int width, int height, const std::uint8_t* srgba, bool hasAlpha)
{
    writePngFile(path, width, height, 8, hasAlpha,
                 [&](std::size_t y) { return srgba + 4 * y * static_cast<std::size_t>(width); });
}

void writePng16(const std::string& path, int width, int height, const float* rgba, bool hasAlpha)
{
    const std::size_t rowSize = 4 * static_cast<std::size_t>(width);
    std::vector<std::uint8_t> row(2 * rowSize);
    const auto encoded = [](double linear) {
        const double v = linear > 0 ? std::min(linear, 1.0) : 0.0; // also of NaN
        return v <= 0.0031308 ? 12.92 * v : 1.055 * std::pow(v, 1 / 2.4) - 0.055;
    };
    writePngFile(path, width, height, 16, hasAlpha, [&](std::size_t y) {
        std::size_t at = 0;
        for (const float *pixel = rgba + y * rowSize, *end = pixel + rowSize; pixel != end; pixel += 4) {
            const double alpha = !hasAlpha ? 1.0 : pixel[3] > 0 ? std::min(static_cast<double>(pixel[3]), 1.0) : 0.0;
            for (std::size_t c = 0; c < 4; ++c) {
                const double v = c == 3 ? alpha : alpha > 0 ? encoded(static_cast<double>(pixel[c]) / alpha) : 0.0;
                const unsigned level = static_cast<unsigned>(v * 65535 + 0.5);
                row[at++] = static_cast<std::uint8_t>(level >> 8);
                row[at++] = static_cast<std::uint8_t>(level & 255);
            }
        }
        return row.data();
    });
}

std::vector<std::uint8_t> straightPixels(int width, int height, const float* rgba, bool dither)
{
    const std::size_t rowSize = 4 * static_cast<std::size_t>(width);
    std::vector<std::uint8_t> pixels(rowSize * static_cast<std::size_t>(height)), alphas(rowSize);
    std::vector<double> row(rowSize);
    for (int y = 0; y < height; ++y, rgba += rowSize) {
        for (std::size_t i = 0; i < rowSize; i += 4) {
            const double alpha = std::min(static_cast<double>(rgba[i + 3]), 1.0);
            for (std::size_t c = i; c < i + 3; ++c)
                row[c] = alpha > 0 ? static_cast<double>(rgba[c]) / alpha : 0.0;
            row[i + 3] = 1; // because dithering limits colours to alpha, as is right for premultiplied ones
        }
        std::uint8_t* out = pixels.data() + static_cast<std::size_t>(y) * rowSize;
        if (dither)
            dfb::ditherPixels(row.data(), width, dfb::OutputFormat::SRGBA8, 0, y, reinterpret_cast<std::byte*>(out));
        else
            dfb::convertPixels(row.data(), width, dfb::OutputFormat::SRGBA8, reinterpret_cast<std::byte*>(out));
        dfb::convertPixels(rgba, width, dfb::OutputFormat::RGBA8, reinterpret_cast<std::byte*>(alphas.data()));
        for (std::size_t i = 3; i < rowSize; i += 4)
            out[i] = alphas[i];
    }
    return pixels;
}

void writePfm(const std::string& path, int width, int height, const float* rgba)
{
    writeFloats(path, width, height, rgba, 4, 3);
}

void writeGreyPfm(const std::string& path, int width, int height, const float* values, int stride)
{
    writeFloats(path, width, height, values, stride, 1);
}

void writeVectorPfm(const std::string& path, int width, int height, const float* values)
{
    writeFloats(path, width, height, values, 3, 3);
}

void writeIdPng(const std::string& path, int width, int height, const std::uint32_t* ids)
{
    const std::size_t pixels = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
    std::vector<std::uint8_t> rgba(4 * pixels, 0);
    for (std::size_t i = 0; i < pixels; ++i) {
        const std::uint64_t hash = XXH3_64bits(ids + i, sizeof *ids);
        for (std::size_t c = 0; c < 3 && ids[i] != 0xffffffffu; ++c)
            rgba[4 * i + c] = static_cast<std::uint8_t>(64 + (hash >> (8 * c)) % 192);
    }
    writePng(path, width, height, rgba.data(), false);
}

std::string hashPixels(const float* rgba, std::size_t pixelCount)
{
    char text[17];
    std::snprintf(text, sizeof text, "%016llx",
                  static_cast<unsigned long long>(XXH3_64bits(rgba, pixelCount * 4 * sizeof(float))));
    return text;
}

double meanAlpha(const float* rgba, std::size_t pixelCount)
{
    double sum = 0;
    for (std::size_t i = 0; i < pixelCount; ++i)
        sum += static_cast<double>(rgba[4 * i + 3]);
    return pixelCount > 0 ? sum / static_cast<double>(pixelCount) : 0;
}

void writeText(const std::string& path, const std::string& text)
{
    errno = 0;
    std::ofstream stream(path, std::ios::trunc);
    stream << text;
    stream.close();
    if (!stream)
        detail::failToWrite(path, std::strerror(errno));
}

} // namespace example
