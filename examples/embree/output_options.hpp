// OutputOptions: the options of the files that a run writes.
#pragma once

#include "frame_pattern.hpp"
#include "option_values.hpp"
#include "options.hpp"

#include <CLI/CLI.hpp>

#include <filesystem>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace example {

// Adds the options to a command line, for as long as that and `files` live.
class OutputOptions {
public:
    OutputOptions(CLI::App& app, OutputFiles& files) : app_(app)
    {
        add("--output", files.output, "FILE", {".png", ".pfm", ".exr"},
            "The image: sRGB in a .png, with straight alpha unless --background is given; linear colour over black in "
            "a .pfm; linear colour, alpha and --layers in an .exr. %d, or %04d for 4 digits, in the name stands for "
            "the number of the frame, from 0 on; without it the last frame is written. Also in the next three; default "
            "none");
        app_.add_option("--png-bits", files.pngBits, "Bits of each channel of a .png: 8 or 16; default 8")
            ->check([](const std::string& text) {
                return text == "8" || text == "16" ? std::string() : "'" + text + "' is not 8 or 16";
            })
            ->option_text("8|16")
            ->group(group);
        add("--layers", layers_, "LAYER[,LAYER...]", {},
            "What an .exr has beside colour and alpha: none, all, or some of depth (channel Z), normal (N), albedo, "
            "position (P), ids (id.primitive, id.instance), with commas between; default depth");
        add("--cinema", files.cinema, "DIR.cdb", {},
            "Write the frames of a turn into this folder as a Cinema database, whose data.csv has phi, theta and the "
            "picture of each; default none");
        add("--alpha", files.alpha, "FILE", {".pfm"}, "The opacity, as a greyscale .pfm; default none");
        add("--depth", files.depth, "FILE", {".pfm"},
            "The distance from the camera along the ray, as a greyscale .pfm, infinite where there is nothing; default "
            "none");
        add("--aux", files.aux, "PREFIX", {},
            "Auxiliary channels of the picture: PREFIX.normal.pfm, .albedo.pfm, .position.pfm, and .primitive.png and "
            ".instance.png with a colour for each id; default none");
        add("--stats", files.stats, "FILE", {".json"},
            "Where the time went, in ms, on each rank and the slowest: total = load + render + compositing (with "
            "waiting for slower ranks) + write; bytes read and sent, messages, tiles, samples, a hash of the image, "
            "the options; default none");
        add("--trace", files.trace, "FILE", {".json"},
            "What each thread of each rank did for the frames, and when, for ui.perfetto.dev and speedscope; default "
            "none");
        add("--save-options", files.saveOptions, "FILE", {".json"},
            "The options of this run and its scene, for --config: {\"scene\": [\"a.ply\"], \"spp\": 4}; default "
            "none");
    }

    // Call it after the command line has been parsed. Throws CLI::ValidationError.
    void apply(OutputFiles& files) const
    {
        if (!files.cinema.empty()) {
            if (!detail::checkEnding(files.cinema, {".cdb"}).empty())
                throw CLI::ValidationError("--cinema", "'" + files.cinema + "' does not end in .cdb");
            for (const char* other : {"--output", "--eye", "--wall"})
                if (app_.count(other) > 0)
                    throw CLI::ValidationError("--cinema", std::string("does not go with ") + other);
            std::string folder;
            for (const char c : files.cinema)
                folder += c == '%' ? "%%" : std::string(1, c);
            files.output = folder + "/frame_%04d.png";
        }
        if (app_.count("--layers") > 0 && !files.isExr())
            throw CLI::ValidationError("--layers", "needs --output FILE.exr");
        if (app_.count("--png-bits") > 0 && endingOf(files.output) != ".png")
            throw CLI::ValidationError("--png-bits", "needs --output FILE.png");
        if (app_.count("--layers") > 0)
            files.layers = detail::parseLayers("--layers", layers_);
    }

    // The path of a file, or of the one for the first frame.
    static std::filesystem::path fullName(const std::string& name)
    {
        std::string first = name;
        try {
            first = FramePattern(name).path(0);
        } catch (const std::invalid_argument&) { // checkPatterns() says so
        }
        return std::filesystem::absolute(first).lexically_normal();
    }

    // Throws CLI::ValidationError if two of the files have one name.
    static void refuseEqualNames(const OutputFiles& files)
    {
        std::vector<std::pair<const char*, std::string>> all{
            {"--output", files.output}, {"--alpha", files.alpha}, {"--depth", files.depth},
            {"--stats", files.stats},   {"--trace", files.trace}, {"--save-options", files.saveOptions}};
        for (const char* ending : {".normal.pfm", ".albedo.pfm", ".position.pfm", ".primitive.png", ".instance.png"})
            all.emplace_back("--aux", files.aux.empty() ? "" : files.aux + ending);
        std::map<std::filesystem::path, const char*> options;
        for (const auto& [option, name] : all)
            if (!name.empty())
                if (const auto [other, isNew] = options.emplace(fullName(name), option); !isNew)
                    throw CLI::ValidationError(option, "'" + name + "' is also written by " + other->second);
    }

    // Throws CLI::ValidationError if a name is no pattern, or must not be one.
    void checkPatterns(const OutputFiles& files) const
    {
        for (const auto& [name, text] : {std::pair{"--output", &files.output}, std::pair{"--alpha", &files.alpha},
                                         std::pair{"--depth", &files.depth}, std::pair{"--aux", &files.aux}}) {
            try {
                FramePattern{*text};
            } catch (const std::invalid_argument& wrong) {
                throw CLI::ValidationError(name, wrong.what());
            }
        }
        for (const auto& [name, text] : {std::pair{"--stats", &files.stats}, std::pair{"--trace", &files.trace},
                                         std::pair{"--save-options", &files.saveOptions}})
            if (text->find('%') != std::string::npos)
                throw CLI::ValidationError(name, "'" + *text + "': one file for all frames, without %");
    }

private:
    static constexpr const char* group = "Files to write";

    // The text must end in one of `endings`, if there are any.
    void add(const char* name, std::string& text, const char* form, const std::vector<std::string>& endings,
             const char* what)
    {
        CLI::Option* option = app_.add_option(name, text, what)->option_text(form)->group(group);
        if (!endings.empty())
            option->check(detail::ending(endings));
    }

    CLI::App& app_;
    std::string layers_;
};

} // namespace example
