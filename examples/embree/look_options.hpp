// LookOptions: the options for the camera's place and for the look of files.
#pragma once

#include "camera.hpp"
#include "color_maps.hpp"
#include "file_look.hpp"
#include "option_values.hpp"

#include <CLI/CLI.hpp>

#include <stdexcept>
#include <string>

namespace example {

// Adds the options to a command line, for as long as that lives.
class LookOptions {
public:
    explicit LookOptions(CLI::App& app) : app_(app)
    {
        const char* camera = "Camera";
        add("--eye", eye_, "X,Y,Z",
            "Where the camera is, in place of --azimuth, --elevation and --camera-distance. In the coordinates of the "
            "scene: files fill the cube from 0 to 1, or with --no-fit have their own",
            camera);
        add("--target", target_, "X,Y,Z", "The point that it looks at; default: the centre of the visible scene",
            camera);
        add("--up", up_, "X,Y,Z|x|y|z|-x|-y|-z",
            "Direction that is up in the image, and the axis of the orbit. In volume files y and z run downwards, "
            "except with --no-fit; default y, and -z (with --no-fit z) for data that look like computed tomography, so "
            "that the body stands upright if its "
            "slices go from the feet to the head",
            camera);
        const char* look = "Look";
        std::string names = "auto";
        for (const std::string& name : transferNames())
            names += ", " + name;
        add("--transfer", transfer_, "NAME|FILE.json",
            "Colours and opacity of volumes: " + names
                + ", or a file (docs/rendering.md has the format). auto and the colour maps choose an opacity at which "
                  "the whole can be seen; bone and soft-tissue are for Hounsfield units, and auto is soft-tissue if "
                  "values look like these; default auto",
            look);
        add("--range", range_, "LO,HI",
            "Values of volumes that get the first and the last colour: of the data, or percentages of the voxels such "
            "as 1%,99.9%; default: from the end of the background to 99.8 % of what is above it",
            look);
        add("--isovalue", isovalue_, "V[,V...]",
            "Show the surfaces where volumes have these values; with --transfer also the volumes themselves", look);
        add("--clip", clip_, "X0,Y0,Z0,X1,Y1,Z1",
            "Show only what is inside this box. It is in each file's own coordinates: voxels, or the unit of the "
            "spacing, for a volume; those of the vertices for a mesh",
            look);
    }

    // Call it after the command line has been parsed. Throws CLI::ValidationError.
    void apply(View& view, FileLook& look) const
    {
        const auto point = [](const char* name, const std::string& text) {
            const std::vector<float> v = detail::numbersOf(text, 3);
            if (v.empty() || !isUsable({v[0], v[1], v[2]}))
                throw CLI::ValidationError(name, "'" + text + "' is not X,Y,Z with three numbers below 1e15");
            return Vec3{v[0], v[1], v[2]};
        };
        if (app_.count("--eye") > 0)
            view.eye = point("--eye", eye_);
        if (app_.count("--target") > 0)
            view.target = point("--target", target_);
        if (app_.count("--up") > 0) {
            const bool isDown = up_.size() == 2 && up_[0] == '-';
            const std::size_t axis = std::string("xyz").find(isDown ? up_.substr(1) : up_);
            if (up_.size() == (isDown ? 2u : 1u) && axis != std::string::npos) {
                view.up = {0, 0, 0};
                component(view.up, axis) = isDown ? -1.0f : 1.0f;
            } else {
                view.up = point("--up", up_);
            }
            if (isZero(view.up))
                throw CLI::ValidationError("--up", "'" + up_ + "' is no direction");
            view.isUpGiven = true;
        }
        if (view.eye && view.target && isZero(*view.eye - *view.target))
            throw CLI::ValidationError("--eye", "is where --target is");
        for (const char* other : {"--azimuth", "--elevation", "--camera-distance"})
            if (view.eye && app_.count(other) > 0)
                throw CLI::ValidationError(other, "does not go with --eye");
        for (const auto& [key, text] : {std::pair{"transfer", &transfer_}, std::pair{"range", &range_},
                                        std::pair{"isovalue", &isovalue_}, std::pair{"clip", &clip_}}) {
            try {
                if (app_.count(std::string("--") + key) > 0)
                    setLook(look, key, *text);
            } catch (const std::invalid_argument& wrong) {
                throw CLI::ValidationError(std::string("--") + key, wrong.what());
            }
        }
        requireTransfer(look.transfer, "--transfer");
    }

    // Throws CLI::ValidationError if it is neither a name nor a .json file.
    static void requireTransfer(const std::string& transfer, const std::string& option, const std::string& where = {})
    {
        const std::vector<std::string> names = transferNames();
        if (transfer.empty() || transfer == "auto" || std::find(names.begin(), names.end(), transfer) != names.end()
            || detail::checkEnding(transfer, {".json"}).empty())
            return;
        std::string all = "auto";
        for (const std::string& name : names)
            all += ", " + name;
        throw CLI::ValidationError(option, where + "'" + transfer + "' is not " + all + " or a .json file");
    }

private:
    void add(const char* name, std::string& text, const char* form, const std::string& what, const char* group)
    {
        app_.add_option(name, text, what)->option_text(form)->group(group);
    }

    CLI::App& app_;
    std::string eye_, target_, up_, transfer_, range_, isovalue_, clip_;
};

// Completes the look of a file: what it leaves open comes from the look of the run.
inline FileLook merged(FileLook own, const FileLook& run)
{
    if (!own.clip)
        own.clip = run.clip;
    if (own.transfer.empty() && own.isovalues.empty())
        own.isovalues = run.isovalues;
    if (own.transfer.empty())
        own.transfer = run.transfer;
    if (!own.range)
        own.range = run.range;
    return own;
}

} // namespace example
