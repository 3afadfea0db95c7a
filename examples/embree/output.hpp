// Output: images and statistics as files. Every function that writes throws std::runtime_error with the file's name.
#pragma once

#include <dfb/frame.hpp>
#include <dfb/image.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

namespace example {

namespace detail {

// Throws std::runtime_error.
[[noreturn]] void failToWrite(const std::string& path, const std::string& why);

} // namespace detail

// Throws if the file cannot be opened for writing. Its content stays; if there was no file, none is left behind.
void requireWritable(const std::string& path);

// An 8-bit PNG of RGBA pixels whose colour is sRGB-encoded, row 0 on top. With `hasAlpha` the colours must be straight,
// as PNG has them, and alpha is written. Otherwise alpha is left out: premultiplied colours are the image over black.
void writePng(const std::string& path, int width, int height, const std::uint8_t* srgba, bool hasAlpha);

// The same with 16 bits a channel, from linear premultiplied RGBA. Colours become sRGB: with `hasAlpha` straight, as in
// straightPixels(), otherwise over black.
void writePng16(const std::string& path, int width, int height, const float* rgba, bool hasAlpha);

// Pixels of a PNG from linear premultiplied RGBA of an image, row 0 on top: sRGB-encoded colour with straight alpha.
// Alpha is round(255 * alpha). The colour is that of colour / alpha, divided in double and clamped to 1, at the nearest
// sRGB level or dithered; it is 0 where alpha is 0 or less, which loses colour that has no alpha. Over black the
// picture is the premultiplied image again, except for the rounding of both to 8 bits.
std::vector<std::uint8_t> straightPixels(int width, int height, const float* rgba, bool dither);

// Linear RGB as a colour PFM, from RGBA pixels, row 0 on top.
void writePfm(const std::string& path, int width, int height, const float* rgba);

// One value per pixel as a greyscale PFM; the values are `stride` floats apart (4 and rgba + 3: the alpha of RGBA).
void writeGreyPfm(const std::string& path, int width, int height, const float* values, int stride);

// Three floats per pixel as a colour PFM.
void writeVectorPfm(const std::string& path, int width, int height, const float* values);

// A colour for each id, black where there is none (all bits set).
void writeIdPng(const std::string& path, int width, int height, const std::uint32_t* ids);

// XXH3 of the pixels as they are in memory, 16 hexadecimal digits.
std::string hashPixels(const float* rgba, std::size_t pixelCount);

double meanAlpha(const float* rgba, std::size_t pixelCount);

// How a rank has spent its time. Times are this rank's own; waiting for slower ranks counts as compositing.
struct Times {
    double loadMs = 0;        // setting up, reading and preparing its part of the scene
    double renderMs = 0;      // rendering, and compositing of what arrived meanwhile
    double compositingMs = 0; // from the end of its rendering to the finished image
    double writeMs = 0;       // writing files, except for the statistics

    double totalMs() const { return loadMs + renderMs + compositingMs + writeMs; }
};

// Statistics of a rank in one frame; loadMs is 0.
struct RankFrameStats {
    Times times;
    // Tiles rendered (of a brick, and of each sample) and work, counted in samples of volumes and rays.
    std::uint64_t tilesRendered = 0, work = 0;
};

struct FrameStats {
    std::vector<RankFrameStats> ranks;
    dfb::FrameReport report;
};

// Statistics of a rank in the whole run.
struct RankStats {
    Times times;
    double totalMs = 0; // by the clock, from its start to when all files but the statistics were written
    int threads = 1;
    std::uint64_t bytesRead = 0; // of files
};

struct RunStats {
    std::vector<RankStats> ranks;
    std::vector<std::string> scene;
    std::vector<std::pair<std::string, std::string>> options; // name and value, as on the command line
    std::string version, transport, mode;
    int width = 0, height = 0;
    std::string imageHash; // of the last frame
    double meanAlpha = 0;
    double runMs = 0;                                 // from the start of the first frame to the end of the last
    std::uint64_t samplesTaken = 0, samplesSaved = 0; // of pixels, in the last frame
    std::vector<FrameStats> frames;
};

// The rank that finished rendering last, and so waited least for others. (No clocks of different ranks are compared.)
template <class Rank>
std::size_t slowestOf(const std::vector<Rank>& ranks)
{
    const auto least = std::min_element(ranks.begin(), ranks.end(), [](const Rank& a, const Rank& b) {
        return a.times.compositingMs < b.times.compositingMs;
    });
    return static_cast<std::size_t>(least - ranks.begin());
}

void writeText(const std::string& path, const std::string& text);

void writeStats(const std::string& path, const RunStats& run);

} // namespace example
