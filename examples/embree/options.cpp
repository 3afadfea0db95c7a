// Reading the command line of dfb_render.
#include "options.hpp"

#include "config_file.hpp"
#include "hdf5_path.hpp"
#include "look_options.hpp"
#include "option_values.hpp"
#include "output_options.hpp"
#include "volume_file.hpp"

#include <dfb/version.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <cstdlib>
#include <map>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace example {

namespace {

bool isVolumePath(const std::string& path) { return isHdf5(path) || isVolumeEnding(endingOf(path)); }

// The arguments in the order that CLI11 takes: the last one first. A --live without a number gets the port -1, because
// CLI11 would take a scene that follows for the port.
std::vector<std::string> withPort(int argc, const char* const* argv)
{
    std::vector<std::string> words;
    for (int i = argc - 1; i > 0; --i) {
        const std::string next = i + 1 < argc ? argv[i + 1] : "";
        const bool isNumber = !next.empty() && next.find_first_not_of("0123456789") == std::string::npos;
        words.push_back(argv[i]);
        if (words.back() == "--live" && !isNumber)
            words.back() = "--live=-1";
    }
    return words;
}

// The options are in groups, as --help shows them.
class CommandLine {
public:
    CommandLine()
    {
        app_.set_help_flag("-h,--help", "Print this and exit");
        app_.set_version_flag("--version", "dfb_render " DFB_VERSION, "Print the version and exit");
        app_.get_formatter()->column_width(36);
        addScene();
        looks_.emplace(app_);
        addFileOptions();
        addDistribution();
        addPicture();
        addCamera();
        outputs_.emplace(app_, options_);
        app_.config_formatter(std::make_shared<OptionsFile>());
        app_.allow_config_extras(CLI::config_extras_mode::error);
        app_.set_config("--config", "",
                        "Read options, and the scene, from a file: JSON as --save-options writes it, or TOML. The "
                        "command line overrides it")
            ->option_text("FILE");
        for (CLI::Option* option : app_.get_options()) {
            option->capture_default_str();
            option->description(detail::wrapped(option->get_description()));
        }
        app_.footer(
            "Examples:\n"
            "  dfb_render demo --ranks 4 --output demo.png\n"
            "  mpiexec -n 8 dfb_render synthetic --size 2048x2048 --frames 8 --stats stats.json\n"
            "  mpiexec -n 4 dfb_render bunny.ply neghip_64x64x64_uint8.raw --spp 4 --output both.png\n"
            "  mpiexec -n 4 dfb_render demo --frames 36 --output turn_%02d.png\n"
            "Exit code: 0: done, 1: the run failed, 2: the command line is wrong. If an option is given twice, the "
            "last one counts.");
    }

    ParsedOptions parse(int argc, const char* const* argv)
    {
        try {
            app_.parse(withPort(argc, argv));
            if (options_.scene.empty())
                throw CLI::RequiredError("scene"); // not by CLI11, which would say so before it names a wrong option
            readValues();
            refuseContradictions();
            refuseForFiles();
            readScene();
            app_.get_option("--ao")->default_str(std::to_string(options_.aoRays));
            app_.get_option("--deep")->default_str(std::to_string(options_.deep));
            options_.values = values(false);
            options_.given = values(true);
        } catch (const CLI::CallForHelp&) {
            return {std::nullopt, 0, app_.help()};
        } catch (const CLI::CallForVersion& version) {
            return {std::nullopt, 0, version.what()};
        } catch (const CLI::ParseError& error) {
            std::string message = error.what();
            const std::string unknown = "INI was not able to parse "; // CLI11 says so of JSON and TOML, too
            if (message.rfind(unknown, 0) == 0)
                message = "--config: there is no option --" + message.substr(unknown.size());
            std::replace(message.begin(), message.end(), '\n', ' ');
            return {std::nullopt, exitUsage, "dfb_render: " + message + " (see --help)"};
        }
        return {options_, 0, {}};
    }

private:
    static constexpr int most = 1 << 20; // for options that have no limit of their own

    // ---- adding an option to the group

    template <class T>
    void number(const char* name, T& value, double lo, double hi, const char* form, const char* what)
    {
        app_.add_option(name, value, what)->transform(detail::number(lo, hi))->option_text(form)->group(group_);
    }
    void text(const char* name, std::string& value, const char* form, const char* what)
    {
        app_.add_option(name, value, what)->option_text(form)->group(group_);
    }
    void flag(const char* name, bool& value, const char* what) { app_.add_flag(name, value, what)->group(group_); }
    // Its value is one of some words; word number i becomes enumerator number i.
    template <class Enum>
    void words(const char* name, Enum& value, const std::vector<std::string>& all, const char* what)
    {
        std::string form;
        for (const std::string& word : all)
            form += (form.empty() ? "" : "|") + word;
        CLI::Option* option = app_.add_option(name, value, what)->transform(detail::choice(all));
        option->option_text(form)->group(group_);
        wordsOf_[option] = all;
    }

    // ---- the groups

    void addScene()
    {
        app_.add_option("scene", options_.scene,
                        "'synthetic' (one generated 64^3 volume per brick), 'demo' (a generated volume, mesh and "
                        "spheres together), or one or more files. Volumes: .nrrd, .nhdr, .mha, .mhd, a data set of an "
                        "HDF5 file, FILE.h5:/PATH, or name_XxYxZ_TYPE.raw with uint8, int8, uint16, int16, uint32, "
                        "int32, float32 or float64, followed by 'be' if big-endian; meshes: .ply, .obj, .stl, .gltf, "
                        ".glb; atoms: .xyz. Settings for one file follow its name, as in "
                        "a.ply:color=0.8,0.2,0.1:opacity=0.5:translate=0,0,1. They are color, opacity, scale, rotate, "
                        "translate, and, as the options of the same name, clip, transfer, range and isovalue")
            ->option_text("SCENE...");
        app_.option_defaults()->take_last(); // if an option is given twice, the last one counts
    }

    void addFileOptions()
    {
        flag("--no-fit", noFit_,
             "Leave files in their own coordinates; default: each is scaled and centred to fill the unit cube");
        number("--xyz-frame", options_.xyzFrame, 1, 2147483646, "N",
               "Which frame of an .xyz file that has several, from 1; default 1");
        text("--spacing", spacing_, "X,Y,Z",
             "Distances between the voxels of volumes along their three axes, as in 1,1,2 for slices that are twice as "
             "thick as their pixels are wide; default: as the header says, or 1,1,1");
        text("--origin", origin_, "X,Y,Z",
             "Where the first voxel of volumes is, with --no-fit or for --clip; default: as the header says, or 0,0,0");
    }

    void addDistribution()
    {
        group_ = "Distribution";
        words("--mode", options_.mode, {"data", "image", "mixed"},
              "data: each rank holds some bricks of the scene; image: each rank holds all and renders some tiles; "
              "mixed: several ranks hold each brick and share its tiles; default data");
        number("--replicate", options_.replicate, 1, most, "K",
               "Ranks that hold each brick, with --mode mixed; default 2");
        words("--cut", options_.cut, {"auto", "volume", "content"},
              "How space is cut into bricks: volume: bricks of equal size; content: bricks that take about equally "
              "long to render, by a coarse estimate, so that some ranks read and hold more than others; auto: content, "
              "except for surfaces without --ao or --shadows, where it is no better, and for synthetic, which has a "
              "grid of its own; default auto");
        words("--balance", options_.balance, {"cost", "round-robin"},
              "How the ranks that hold a brick share its tiles: by what they cost in the last frame, or in turn; "
              "default cost");
        words(
            "--blend", options_.blend, {"sort", "order", "nearest"},
            "How the bricks at a pixel are combined: sorted by depth; in the order of the bricks from the eye, without "
            "sorting or depth; or only the nearest one, for opaque scenes; default sort");
        words("--distribution", options_.distribution, {"owned", "linear", "round-robin", "dynamic"},
              "Who renders which tile with --mode image: its owner, equal shares in order, one by one, or on demand; "
              "default owned");
        number("--interleave", options_.interleave, 1, 4096, "C",
               "Cells that each brick consists of, dealt out so that bricks interleave; default 1");
        number("--deep", options_.deep, 0, 65535, "K",
               "Deep fragments: the most segments per pixel and brick. With fewer than --interleave the order may be "
               "undefined at some pixels, which are counted; default: as --interleave, and without it 0: no deep "
               "fragments");
        number("--ranks", options_.ranks, 1, 4096, "N",
               "Run N ranks as threads of one process; default: the ranks of MPI");
        number("--bricks", options_.bricks, 0, most, "N", "Bricks in all; default 0: one per rank");
        number("--threads", options_.threads, 0, 4096, "N",
               "Threads per rank; default 0: the rank's share of the processors that it may run on");
        flag("--no-shared-memory", noSharedMemory_,
             "Send all messages through MPI, also those between ranks of one node");
        number("--peer-timeout", options_.peerTimeout, 0, most, "SECONDS",
               "Seconds without a sign of life after which a rank counts as lost, and the job is aborted; 0: never, as "
               "for a debugger; default 300");
        words("--compression", options_.compression, {"none", "snappy", "auto"},
              "Compression of messages; auto: snappy between nodes, in frames in which trials have shown that it is "
              "faster; default none");
        words("--wire", options_.wire, {"float32", "float16", "unorm16", "unorm8"},
              "Format in which the colour of tiles is sent; the less exact ones are for colours from 0 to alpha; other "
              "tiles are sent as float32, as are depth and what --aux writes; default float32");
        number("--error-budget", options_.errorBudget, 0, 1, "E",
               "Use the cheapest format of --wire that changes colour and alpha of no pixel by more than E, before "
               "conversion to the output; default 0: use --wire");
        number("--min-transmittance", options_.minTransmittance, 0, 0.99, "T",
               "Leave out what is behind bricks that let less than this fraction of the light through; default 0");
        flag("--verify", options_.verify,
             "Check each finished tile, also its depth and what --aux writes, against an exact reference; slow");
        words("--owner-map", options_.ownerMap, {"auto", "lattice", "linear", "hash"},
              "Which rank owns which tile; default auto: lattice on one node; on several, a rank near those that have "
              "the tile's pixels");
        number("--in-flight", options_.inFlight, 1, 64, "N",
               "Frames under way at once: a rank that has rendered its part of one begins the next while others still "
               "render; default 1");
    }

    void addPicture()
    {
        group_ = "Picture";
        text("--size", size_, "WxH", "Size of the image in pixels, each side 1 to 65536; default 1024x1024");
        number("--frames", options_.frames, 1, most, "N", "Frames of one turn around the scene; default 1");
        number("--spp", options_.passes, 1, 65536, "N",
               "Samples per pixel, one pass each; default 1, in the pixel's centre; with --live 16");
        number("--adaptive", options_.adaptive, 0, 1, "ERR",
               "Render a tile until the standard error of its pixels is at most this, from 8 to --spp samples; default "
               "0: all have --spp");
        number("--ao", options_.aoRays, 0, 4096, "N",
               "Ambient occlusion of surfaces and spheres, with N rays per hit; default 16, with --live 4, for files "
               "that are "
               "not volumes, without --path; otherwise 0: none. Bricks then also hold the geometry within "
               "--ao-distance of "
               "them");
        number("--ao-distance", options_.aoDistance, 1e-6, 10, "D",
               "Length of the rays of --ao, and reach of --shadows, in units of the scene's largest extent; default "
               "0.1");
        flag("--shadows", options_.shadows, "Shadows of surfaces and spheres on each other, as far as --ao-distance");
        number("--path", options_.pathBounces, 0, 1000, "N",
               "Path-trace opaque surfaces and spheres under a bright sky, N bounces at most; volumes are left out; "
               "needs --mode image; default 0: off");
        text("--wall", wall_, "CxR",
             "Display wall of COLUMNSxROWS displays, which ranks drive in turn; the image size is that of all, and "
             "each display's picture is written to the output file with its number before the ending");
        number("--bezel", options_.bezel, 0, 10000, "N",
               "Pixels that are hidden between two displays of a wall; default 0");
        number("--seed", options_.seed, 0, 9007199254740992.0, "N",
               "Seed of generated scenes and sample positions; default 1");
        number("--opacity", options_.opacity, 0, 1, "A",
               "Opacity of surfaces, isosurfaces and spheres, 0 to 1; default 1");
        number(
            "--early-termination", options_.earlyTermination, 0, 1, "T",
            "End a ray within a brick when less than this fraction of the light gets through, 0 to 1. The image then "
            "depends on the bricks, and no pixel is off by more than this fraction of the brightest colour; default "
            "0: when nothing gets through");
        text("--background", background_, "R,G,B",
             "Opaque colour behind the scene, linear, each 0 to 1; default: none, the image stays transparent, and a "
             ".png has alpha");
        number("--exposure", options_.exposure, 0, 1e6, "E", "Tone-map with this factor, above 0; default 0: off");
        flag("--dither", options_.dither, "Dither the colour of a .png, so that gradients have no bands");
        number("--live", options_.live, -1, 65535, "[PORT]",
               "Show the scene in a browser on this machine, where you can turn it: prints the address; port 0: any "
               "free port; default, without PORT: 8080, or any free port if that is taken");
    }

    void addCamera()
    {
        group_ = "Camera";
        words("--camera", options_.view.kind, {"perspective", "dof", "motion", "stereo", "dome"},
              "dof: depth of field; motion: the camera goes on along its orbit while the shutter is open; stereo: the "
              "left eye's view in the left half, the right eye's in the right; dome: a fisheye; default perspective. "
              "dof and motion want --spp 16 or more");
        number("--aperture", options_.view.aperture, 0, 10, "R",
               "Radius of the lens of dof, in units of the visible scene's largest extent; default 0.05");
        number("--focus", options_.view.focus, 1e-6, 1e6, "D",
               "Distance that dof shows sharp and stereo shows at the screen, in units of the visible scene's largest "
               "extent; default: the distance of --target");
        number("--shutter", options_.view.shutter, -360, 360, "DEG",
               "Degrees of the orbit that motion blurs, up to 360; default 8");
        number("--eyes", options_.view.separation, 0, 10, "D",
               "Distance of the eyes of stereo, in units of the visible scene's largest extent; default 0.1");
        number("--dome-angle", options_.view.domeAngle, 1, 360, "DEG",
               "Degrees that dome covers, up to 360; default 180");
        number("--azimuth", options_.view.azimuth, -36000, 36000, "DEG",
               "Angle of the camera around the axis --up, in degrees; default 30");
        number("--elevation", options_.view.elevation, -90, 90, "DEG",
               "Elevation of the camera in degrees, -90 to 90; default 20");
        number("--fov", options_.view.fieldOfView, 1, 170, "DEG",
               "Vertical field of view in degrees, 1 to 170; default 35");
        number("--zoom", options_.view.zoom, 1e-3, 1e4, "Z",
               "How many times as large the scene is in the image; default 1");
        number("--camera-distance", options_.view.distance, 0, 1000, "D",
               "Distance from the target, in units of the visible scene's largest extent; default: far enough that all "
               "of it is in the image, from every side");
    }

    // ---- reading the values

    void readValues()
    {
        options_.fit = !noFit_;
        options_.sharedMemory = !noSharedMemory_;
        if (options_.interleave > 1 && app_.count("--deep") == 0)
            options_.deep = options_.interleave; // as many pieces as a brick can have on a ray
        if (options_.live && app_.count("--spp") == 0)
            options_.passes = 16; // while the camera rests
        if (app_.count("--size") > 0)
            detail::parseSize("--size", size_, 65536, options_.width, options_.height);
        if (app_.count("--wall") > 0)
            detail::parseSize("--wall", wall_, 64, options_.wallColumns, options_.wallRows);
        outputs_->apply(options_);
        looks_->apply(options_.view, options_.look);
        if (app_.count("--background") > 0)
            options_.background =
                detail::parseThree("--background", background_, 0, 1, "R,G,B with three numbers from 0 to 1");
        if (app_.count("--spacing") > 0)
            options_.spacing =
                detail::parseThree("--spacing", spacing_, 1e-15f, 1e9f, "X,Y,Z with three distances from 1e-15 to 1e9");
        if (app_.count("--origin") > 0)
            options_.origin =
                detail::parseThree("--origin", origin_, -1e12f, 1e12f, "X,Y,Z with three numbers of at most 1e12");
    }

    static bool isFlag(const CLI::Option& option) { return option.get_expected_max() == 0; }

    // Throws CLI::ValidationError if the option was given although that is wrong. A flag that is false counts as not
    // given.
    void refuse(bool wrong, const char* option, const char* why) const
    {
        if (wrong && app_.count(option) > 0 && (!isFlag(*app_[option]) || app_[option]->as<bool>()))
            throw CLI::ValidationError(option, why);
    }

    void refuseContradictions() const
    {
        for (const char* other : {"--frames", "--output", "--png-bits", "--layers", "--cinema", "--alpha", "--depth",
                                  "--aux", "--stats", "--trace", "--wall", "--exposure", "--adaptive", "--interleave",
                                  "--deep", "--verify", "--in-flight", "--save-options"})
            refuse(options_.live.has_value(), other, "does not go with --live");
        refuse(options_.live && options_.blend != Blending::Sort, "--blend",
               "order or nearest does not go with --live");
        refuse(options_.live && options_.balance == Balance::Cost, "--balance", "cost does not go with --live");
        refuse(options_.live && options_.distribution != Distribution::Owned, "--distribution",
               "other than owned does not go with --live");
        const bool isData = options_.mode == Mode::Data;
        for (const char* other : {"--blend", "--min-transmittance"})
            refuse(options_.mode == Mode::Image, other, "does not go with --mode image: nothing is blended");
        refuse(options_.blend == Blending::Nearest, "--min-transmittance", "does not go with --blend nearest");
        for (const char* other : {"--adaptive", "--interleave", "--deep", "--wall", "--exposure"})
            refuse(options_.blend != Blending::Sort, other, "does not go with --blend order or nearest");
        refuse(options_.mode == Mode::Image, "--cut", "does not go with --mode image: it has no bricks");
        const CameraKind kind = options_.view.kind;
        refuse(options_.blend == Blending::Order && kind != CameraKind::Perspective && kind != CameraKind::Dome,
               "--camera", "does not go with --blend order: one order is not right for all its rays");
        refuse(options_.mode != Mode::Mixed, "--replicate", "needs --mode mixed");
        refuse(options_.mode != Mode::Mixed, "--balance", "needs --mode mixed");
        refuse(options_.blend == Blending::Order && options_.balance == Balance::Cost, "--balance",
               "cost does not go with --blend order");
        refuse(options_.mode != Mode::Image, "--distribution", "needs --mode image");
        refuse(options_.mode != Mode::Image, "--path", "needs --mode image: paths go through the whole scene");
        refuse(options_.pathBounces > 0 && options_.aoRays > 0, "--ao", "does not go with --path");
        for (const char* other : {"--ao-distance", "--shadows", "--opacity"})
            refuse(options_.pathBounces > 0, other, "does not go with --path");
        refuse(!isData, "--interleave", "needs --mode data");
        refuse(!isData, "--deep", "needs --mode data");
        refuse(options_.bricks > mostCells / options_.interleave, "--interleave",
               "makes more than 16777216 cells of so many --bricks");
        for (const char* other : {"--adaptive", "--aux", "--wall", "--exposure"})
            refuse(options_.isDeep(), other, "does not go with --interleave or --deep");
        refuse(options_.adaptive > 0, "--wall", "does not go with --adaptive");
        refuse(options_.adaptive > 0, "--exposure", "does not go with --adaptive");
        refuse(options_.adaptive > 0 && options_.passes < 8, "--adaptive",
               "needs --spp 8 or more: the most samples per pixel");
        refuse(options_.errorBudget > 0, "--wire", "does not go with --error-budget");
        refuse(kind != CameraKind::DepthOfField, "--aperture", "needs --camera dof");
        refuse(kind != CameraKind::DepthOfField && kind != CameraKind::Stereo, "--focus",
               "needs --camera dof or stereo");
        refuse(kind != CameraKind::MotionBlur, "--shutter", "needs --camera motion");
        refuse(kind != CameraKind::Stereo, "--eyes", "needs --camera stereo");
        refuse(kind != CameraKind::Dome, "--dome-angle", "needs --camera dome");
        refuse(options_.wallColumns == 0, "--bezel", "needs --wall");
    }

    void refuseForFiles()
    {
        if (options_.isExr() && options_.wallColumns > 0)
            throw CLI::ValidationError("--output", "an .exr is not written for a wall");
        if (options_.isExr() && app_.count("--layers") == 0 && options_.isDeep())
            options_.layers &= dfb::depthChannel;
        if (options_.isExr() && (options_.layers & dfb::imageAuxChannels) && options_.isDeep())
            throw CLI::ValidationError("--layers", "other than depth do not go with --interleave or --deep");
        refuse(options_.pngBits == 16, "--dither", "does not go with --png-bits 16");
        refuse(options_.wallColumns > 0, "--png-bits", "does not go with --wall");
        refuse(options_.wallColumns > 0, "--dither", "does not go with --wall");
        refuse(endingOf(options_.output) != ".png", "--dither", "needs --output FILE.png");
        for (const char* other :
             {"--adaptive", "--interleave", "--deep", "--exposure", "--blend", "--wall", "--dither"})
            refuse(options_.verify, other, "does not go with --verify");
        for (const char* other : {"--adaptive", "--wall"})
            refuse(options_.inFlight > 1, other, "does not go with --in-flight");
        for (const char* file : {"--alpha", "--depth", "--aux"})
            refuse(options_.wallColumns > 0, file, "is not written for a wall");
        if (options_.wallColumns > 0) {
            const int shownX = options_.width - (options_.wallColumns - 1) * options_.bezel,
                      shownY = options_.height - (options_.wallRows - 1) * options_.bezel;
            if (shownX < options_.wallColumns || shownY < options_.wallRows || shownX % options_.wallColumns != 0
                || shownY % options_.wallRows != 0)
                throw CLI::ValidationError("--wall", "an image of " + size_ + " pixels cannot be shared by " + wall_
                                                         + " equal displays with bezels of "
                                                         + std::to_string(options_.bezel));
        }
        outputs_->checkPatterns(options_);
        OutputOptions::refuseEqualNames(options_);
    }

    void readScene()
    {
        const std::vector<std::string> endings{".raw", ".nrrd", ".nhdr", ".mha", ".mhd", ".ply",
                                               ".obj", ".stl",  ".gltf", ".glb", ".xyz"};
        for (const std::string& word : options_.scene) {
            const bool generated = word == "synthetic" || word == "demo";
            if (generated && options_.scene.size() > 1)
                throw CLI::ValidationError("scene", "'" + word + "' stands alone, not beside other scenes");
            for (const char* other : {"--clip", "--spacing", "--origin", "--xyz-frame", "--no-fit"})
                refuse(generated, other, ("is for files, not for '" + word + "'").c_str());
            if (generated)
                continue;
            SceneFile file;
            try {
                file = parseSceneFile(word, endings);
            } catch (const std::invalid_argument& wrong) {
                throw CLI::ValidationError("scene", wrong.what());
            }
            if (const std::string wrong = detail::checkEnding(file.path, endings); !wrong.empty() && !isHdf5(file.path))
                throw CLI::ValidationError("scene", wrong + ", or the word synthetic or demo");
            const bool isVolume = isVolumePath(file.path);
            if (!isVolume && (!file.look.transfer.empty() || file.look.range || !file.look.isovalues.empty()))
                throw CLI::ValidationError("scene", "'" + word + "': transfer, range and isovalue are for volumes");
            LookOptions::requireTransfer(file.look.transfer, "scene", "'" + word + "': transfer: ");
            file.look = merged(file.look, options_.look);
            options_.files.push_back(file);
            if (app_.count("--ao") == 0 && !isVolume && options_.pathBounces == 0)
                options_.aoRays = options_.live ? 4 : 16; // samples accumulate in a live view
        }
        const auto any = [this](bool (*is)(const SceneFile&)) {
            return options_.files.empty() || std::any_of(options_.files.begin(), options_.files.end(), is);
        };
        const bool clips = any([](const SceneFile& file) { return file.look.clip.has_value(); });
        const bool hasVolumes = any([](const SceneFile& file) { return isVolumePath(file.path); });
        const bool hasAtoms = any([](const SceneFile& file) { return endingOf(file.path) == ".xyz"; });
        for (const char* option : {"--spacing", "--origin"})
            refuse(!hasVolumes, option, "is for volumes, and there are none");
        refuse(!hasAtoms, "--xyz-frame", "is for .xyz files, and there are none");
        refuse(options_.fit && !clips, "--origin", "needs --no-fit or --clip: otherwise each file is centred");
    }

    // The names and effective values of all options, or of those that were given. Options without a value are left out.
    std::vector<std::pair<std::string, std::string>> values(bool areGiven) const
    {
        std::vector<std::pair<std::string, std::string>> all;
        for (const CLI::Option* option : app_.get_options()) {
            if (option->get_positional() || !option->get_configurable() || option->get_name() == "--save-options"
                || (areGiven && option->count() == 0))
                continue;
            std::string text = option->count() > 0 ? option->results().back() : option->get_default_str();
            if (isFlag(*option))
                text = option->count() > 0 && option->as<bool>() ? "true" : "false";
            if (const auto words = wordsOf_.find(option); words != wordsOf_.end())
                text = words->second.at(static_cast<std::size_t>(std::atoi(text.c_str())));
            if (!text.empty())
                all.emplace_back(option->get_name().substr(2), text);
        }
        return all;
    }

    CLI::App app_{"Renders volumes, meshes and spheres over several ranks into one image.\n", "dfb_render"};
    const char* group_ = "Options"; // of the options that are added
    std::map<const CLI::Option*, std::vector<std::string>> wordsOf_;
    Options options_;
    std::optional<LookOptions> looks_;
    std::optional<OutputOptions> outputs_;
    bool noFit_ = false, noSharedMemory_ = false;
    std::string size_ = std::to_string(options_.width) + 'x' + std::to_string(options_.height);
    std::string wall_, background_, spacing_, origin_;
};

} // namespace

ParsedOptions parseOptions(int argc, const char* const* argv) { return CommandLine().parse(argc, argv); }

} // namespace example
