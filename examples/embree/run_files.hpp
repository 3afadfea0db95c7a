// RunFiles: the files that a run writes. Finds their names, checks whether they can be written, and writes them.
#pragma once

#include "cinema.hpp"
#include "exr.hpp"
#include "frame_pattern.hpp"
#include "options.hpp"
#include "output.hpp"

#include <dfb/display_wall.hpp>
#include <dfb/image.hpp>

#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <filesystem>
#include <stdexcept>
#include <string>
#include <system_error>
#include <vector>

namespace example {

class RunFiles {
public:
    // `options` must outlive it.
    explicit RunFiles(const Options& options) : o_(options) {}

    // Throws std::runtime_error. Makes the folder of a Cinema database.
    void requireWritable() const
    {
        if (o_.isExr() && !hasOpenExr)
            throw std::runtime_error("this dfb_render was built without OpenEXR: install libopenexr-dev, or write "
                                     "another kind of file");
        std::error_code ignored; // an error shows when the files are opened
        if (!o_.cinema.empty())
            std::filesystem::create_directories(o_.cinema, ignored);
        for (const bool areNumbered : {false, true})
            for (const std::string& path : paths(0, areNumbered))
                example::requireWritable(path);
    }

    // Writes the files of a frame, or none if only the last one's are written. Throws std::runtime_error.
    void write(int frame, const dfb::Image& image) const
    {
        const bool isOpaque = o_.background.has_value();
        const int width = o_.width, height = o_.height;
        const std::string output = pathOf(o_.output, frame), alpha = pathOf(o_.alpha, frame),
                          depth = pathOf(o_.depth, frame), aux = pathOf(o_.aux, frame);
        if (!output.empty() && o_.isExr())
            writeExr(output, image, o_.layers, optionsText(o_.scene, o_.given));
        else if (!output.empty() && o_.pngBits == 16)
            writePng16(output, width, height, image.rgba32f(), !isOpaque);
        else if (!output.empty())
            writeImage(output, image, isOpaque, o_.dither);
        if (!alpha.empty())
            writeGreyPfm(alpha, width, height, image.rgba32f() + 3, 4);
        if (!depth.empty())
            writeGreyPfm(depth, width, height, image.depth(), 1);
        if (!aux.empty()) {
            writeVectorPfm(aux + ".normal.pfm", width, height, image.normal());
            writeVectorPfm(aux + ".albedo.pfm", width, height, image.albedo());
            writeVectorPfm(aux + ".position.pfm", width, height, image.position());
            writeIdPng(aux + ".primitive.png", width, height, image.primitiveId());
            writeIdPng(aux + ".instance.png", width, height, image.instanceId());
        }
    }
    // Writes the files of the displays that `rank` drives.
    void write(int frame, const dfb::DisplayWall& wall, int rank) const
    {
        const std::string output = pathOf(o_.output, frame);
        for (int d = 0; !output.empty() && d < wall.layout().displayCount(); ++d)
            if (wall.layout().ranks[static_cast<std::size_t>(d)] == rank)
                writeImage(numbered(output, d), wall.image(d), o_.background.has_value(), false);
    }

    // Writes the files of the run as a whole. Throws std::runtime_error.
    void write(const RunStats& stats) const
    {
        if (!o_.stats.empty())
            writeStats(o_.stats, stats);
        if (!o_.saveOptions.empty())
            writeText(o_.saveOptions, optionsText(o_.scene, o_.given));
        if (!o_.cinema.empty())
            writeCinema(cinemaTable(), o_.view, framesOfCinema());
    }

    // Tells the user what has been written.
    void say() const
    {
        const std::vector<std::string> first = paths(0, true), last = paths(o_.frames - 1, true);
        for (std::size_t i = 0; i < first.size(); ++i) {
            if (o_.frames > 1)
                std::printf("wrote %s to %s\n", first[i].c_str(), last[i].c_str());
            else
                std::printf("wrote %s\n", first[i].c_str());
        }
        for (const std::string& path : paths(0, false)) {
            const bool isOfRun =
                path == o_.stats || path == o_.trace || path == o_.saveOptions || path == cinemaTable();
            if (o_.frames > 1 && !isOfRun)
                std::printf("wrote %s, the last of %d frames; %%04d in the name gives a file for each\n", path.c_str(),
                            o_.frames);
            else
                std::printf("wrote %s\n", path.c_str());
        }
        if (o_.writesNothing())
            std::fprintf(stderr, "dfb_render: nothing was written: there is no --output, --alpha, --depth, --aux, "
                                 "--stats, --trace, --cinema or --save-options\n");
    }

private:
    // The files of a frame whose names have its number, or else those that are written once.
    std::vector<std::string> paths(int frame, bool areNumbered) const
    {
        std::vector<std::string> all;
        const auto isOne = [&](const FramePattern& name) {
            return name.isPattern() == areNumbered && !name.path(frame).empty();
        };
        const FramePattern output(o_.output), aux(o_.aux);
        const int displays = o_.wallColumns * o_.wallRows;
        if (isOne(output) && displays == 0)
            all.push_back(output.path(frame));
        for (int d = 0; isOne(output) && d < displays; ++d)
            all.push_back(numbered(output.path(frame), d));
        for (const std::string* text : {&o_.alpha, &o_.depth})
            if (const FramePattern name(*text); isOne(name))
                all.push_back(name.path(frame));
        if (isOne(aux))
            for (const char* ending :
                 {".normal.pfm", ".albedo.pfm", ".position.pfm", ".primitive.png", ".instance.png"})
                all.push_back(aux.path(frame) + ending);
        for (const std::string& path : {o_.stats, o_.trace, o_.saveOptions, cinemaTable()})
            if (!areNumbered && !path.empty())
                all.push_back(path);
        return all;
    }

    // The path that a file of this frame has; empty if there is none.
    std::string pathOf(const std::string& text, int frame) const
    {
        const FramePattern name(text);
        return name.isPattern() || frame == o_.frames - 1 ? name.path(frame) : std::string();
    }

    // Empty: none.
    std::string cinemaTable() const { return o_.cinema.empty() ? "" : o_.cinema + "/data.csv"; }
    // The pictures of a Cinema database, relative to its folder.
    std::vector<std::string> framesOfCinema() const
    {
        std::vector<std::string> files;
        for (int frame = 0; frame < o_.frames; ++frame)
            files.push_back(FramePattern("frame_%04d.png").path(frame));
        return files;
    }

    // image.png -> image.3.png
    static std::string numbered(const std::string& path, int number)
    {
        const std::size_t dot = path.rfind('.');
        return path.substr(0, dot) + '.' + std::to_string(number) + path.substr(dot);
    }

    // Writes a .pfm, or a .png that has alpha unless the image is opaque.
    static void writeImage(const std::string& path, const dfb::Image& image, bool isOpaque, bool dither)
    {
        const int width = image.width(), height = image.height();
        if (image.format() != dfb::OutputFormat::RGBA32F) {
            writePng(path, width, height, image.rgba8(), false);
        } else if (endingOf(path) == ".pfm") {
            writePfm(path, width, height, image.rgba32f());
        } else if (!isOpaque) {
            writePng(path, width, height, straightPixels(width, height, image.rgba32f(), dither).data(), true);
        } else {
            std::vector<std::byte> srgb(4 * image.pixelCount());
            for (int y = 0; y < height; ++y) {
                const std::size_t first = 4 * static_cast<std::size_t>(y) * static_cast<std::size_t>(width);
                if (dither)
                    dfb::ditherPixels(image.rgba32f() + first, width, dfb::OutputFormat::SRGBA8, 0, y,
                                      srgb.data() + first);
                else
                    dfb::convertPixels(image.rgba32f() + first, width, dfb::OutputFormat::SRGBA8, srgb.data() + first);
            }
            writePng(path, width, height, reinterpret_cast<const std::uint8_t*>(srgb.data()), false);
        }
    }

    const Options& o_;
};

} // namespace example
