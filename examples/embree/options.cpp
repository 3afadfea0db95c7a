// Reading the command line of dfb_render.
#include "options.hpp"

#include "config_file.hpp"
#include "hdf5_path.hpp"
#include "look_options.hpp"
#include "option_values.hpp"
#include "output_options.hpp"
#include "volume_file.hpp"

#include <CLI/CLI.hpp>

#include <algorithm>
#include <cstdlib>
#include <map>
#include <stdexcept>

namespace example {

namespace {

// The arguments in the order that CLI11 takes, from the last on. --live gets its port: what follows it may be a scene.
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

// All options as they count, for the record; without those that have no value.
std::vector<std::pair<std::string, std::string>>
valuesOf(const CLI::App& app, const std::map<const CLI::Option*, std::vector<std::string>>& wordsOf, bool areGiven)
{
    std::vector<std::pair<std::string, std::string>> values;
    for (const CLI::Option* option : app.get_options()) {
        if (option->get_positional() || option == app.get_help_ptr() || option == app.get_config_ptr()
            || option->get_name() == "--save-options" || (areGiven && option->count() == 0))
            continue;
        std::string text = option->count() > 0 ? option->results().back() : option->get_default_str();
        if (option->get_expected_max() == 0) // a flag
            text = option->count() > 0 ? "true" : "false";
        if (const auto words = wordsOf.find(option); words != wordsOf.end())
            text = words->second.at(static_cast<std::size_t>(std::atoi(text.c_str())));
        if (!text.empty())
            values.emplace_back(option->get_name().substr(2), text);
    }
    return values;
}

} // namespace

ParsedOptions parseOptions(int argc, const char* const* argv)
{
    Options options;
    std::string size = std::to_string(options.width) + 'x' + std::to_string(options.height), wall, background, spacing,
                origin;
    CLI::App app("Renders volumes, meshes and spheres over several ranks into one image.\n", "dfb_render");
    app.set_help_flag("-h,--help", "Print this and exit");
    app.get_formatter()->column_width(36);
    const int most = 1 << 20;

    app.add_option(
           "scene", options.scene,
           "'synthetic' (one generated 64^3 volume per brick), 'demo' (a generated volume, mesh and spheres "
           "together), or one or more files. Volumes: .nrrd, .nhdr, .mha, .mhd, a data set of an HDF5 file, "
           "FILE.h5:/PATH, or name_XxYxZ_TYPE.raw with uint8, int8, uint16, int16, uint32, int32, float32 or float64, "
           "and 'be' behind it where it is big-endian; meshes: .ply, .obj, .stl, .gltf, .glb; atoms: .xyz. Behind a "
           "file's name may stand "
           "how it is shown, as in a.ply:color=0.8,0.2,0.1:opacity=0.5:translate=0,0,1; there are color, opacity, "
           "scale, rotate, translate, and as the options of that name clip, transfer, range, isovalue")
        ->required()
        ->option_text("SCENE...");
    app.option_defaults()->take_last(); // of an option that is given twice the last counts
    std::map<const CLI::Option*, std::vector<std::string>> wordsOf;
    // An option whose value is one of some words, which becomes the enumerator of that place.
    const auto words = [&](const char* name, auto& value, const std::vector<std::string>& all, const char* what) {
        CLI::Option* option = app.add_option(name, value, what)->transform(detail::choice(all));
        std::string text;
        for (const std::string& word : all)
            text += (text.empty() ? "" : "|") + word;
        wordsOf[option] = all;
        return option->option_text(text);
    };
    LookOptions lookOptions(app);
    bool noFit = false;
    app.add_flag("--no-fit", noFit,
                 "Leave files in their own coordinates; default: each is scaled and centred to fill the unit cube");

    app.add_option("--xyz-frame", options.xyzFrame, "Which frame of an .xyz file that has several, from 1; default 1")
        ->check(detail::number(1, 2147483647))
        ->option_text("N");

    app.add_option("--spacing", spacing,
                   "Distances between the voxels of volumes along their three axes, as in 1,1,2 for slices that are "
                   "twice as thick as their pixels are wide; default: as the header says, or 1,1,1")
        ->option_text("X,Y,Z");
    app.add_option("--origin", origin,
                   "Where the first voxel of volumes is, with --no-fit; default: as the header says, or 0,0,0")
        ->option_text("X,Y,Z");

    const char* how = "Distribution";
    words("--mode", options.mode, {"data", "image", "mixed"},
          "data: each rank holds some bricks of the scene; image: each rank holds all and renders some "
          "tiles; mixed: several ranks hold each brick and share its tiles; default data")
        ->group(how);
    app.add_option("--replicate", options.replicate, "Ranks that hold each brick, with --mode mixed; default 2")
        ->check(detail::number(1, most))
        ->option_text("K")
        ->group(how);
    words("--cut", options.cut, {"auto", "volume", "content"},
          "How space is cut into bricks: volume: all are equally large; content: all take about as long to render, as "
          "far as a coarse look shows, so that some ranks read and hold more than others; auto: by content, but for "
          "surfaces without --ao or --shadows, where it is no better, and for synthetic, which has a grid of its own; "
          "default auto")
        ->group(how);
    words("--balance", options.balance, {"cost", "round-robin"},
          "How the ranks that hold a brick share its tiles: by what they cost in the last frame, or in turn; "
          "default cost")
        ->group(how);
    words("--blend", options.blend, {"sort", "order", "nearest"},
          "How the bricks of a pixel become one: sorted by depth; in the order of the bricks from the eye, "
          "without sorting or depth; or the nearest alone, for opaque scenes; default sort")
        ->group(how);
    words("--distribution", options.distribution, {"owned", "linear", "round-robin", "dynamic"},
          "Who renders which tile with --mode image: its owner, equal shares in order, one by one, or on "
          "demand; default owned")
        ->group(how);
    app.add_option("--interleave", options.interleave,
                   "Cells of each brick, dealt out so that bricks lie in and behind each other; default 1")
        ->check(detail::number(1, 4096))
        ->option_text("C")
        ->group(how);
    app.add_option("--deep", options.deep,
                   "Deep fragments: the most segments per pixel and brick. With fewer than --interleave the order may "
                   "be undefined at some pixels, which are counted; default: that many; 0 without: a single fragment")
        ->check(detail::number(0, 65535))
        ->option_text("K")
        ->group(how);
    app.add_option("--ranks", options.ranks, "Run N ranks as threads of one process; default: the ranks of MPI")
        ->check(detail::number(1, 4096))
        ->option_text("N")
        ->group(how);
    app.add_option("--bricks", options.bricks, "Bricks in all; default 0: one per rank")
        ->check(detail::number(0, most))
        ->option_text("N")
        ->group(how);
    app.add_option(
           "--threads", options.threads,
           "Threads per rank; default 0: the processors that it may run on, divided among the ranks that may, too")
        ->check(detail::number(0, 4096))
        ->option_text("N")
        ->group(how);
    bool noSharedMemory = false;
    app.add_flag("--no-shared-memory", noSharedMemory,
                 "Send all messages through MPI, also those between ranks of one node")
        ->group(how);
    app.add_option(
           "--peer-timeout", options.peerTimeout,
           "Seconds without a sign of life after which a rank counts as lost, and the job is aborted; 0: never, "
           "as for a debugger; default 300")
        ->check(detail::number(0, most))
        ->option_text("SECONDS")
        ->group(how);
    words("--compression", options.compression, {"none", "snappy", "auto"},
          "Of messages between ranks; auto: snappy, between nodes, in frames in which trying has shown that it is "
          "faster; default none")
        ->group(how);
    words("--wire", options.wire, {"float32", "float16", "unorm16", "unorm8"},
          "Format of the colour of tiles on their way; less exact ones are for colours from 0 to alpha, other "
          "tiles stay float32, as do depth and what --aux writes; default float32")
        ->group(how);
    app.add_option(
           "--error-budget", options.errorBudget,
           "Take the cheapest of these formats that is sure to change colour and alpha of no pixel by more than "
           "this, before it is converted for output; default 0: --wire says")
        ->check(detail::number(0, 1))
        ->option_text("E")
        ->group(how);
    app.add_option("--min-transmittance", options.minTransmittance,
                   "Leave out what is behind bricks that let less than this part of the light through; default 0")
        ->check(detail::number(0, 0.99))
        ->option_text("T")
        ->group(how);
    app.add_flag(
           "--verify", options.verify,
           "Check each finished tile, also its depth and what --aux writes, against an exact reference of what it "
           "was made of; slow")
        ->group(how);
    words("--owner-map", options.ownerMap, {"lattice", "linear", "hash"}, "Which rank owns which tile; default lattice")
        ->group(how);
    app.add_option("--in-flight", options.inFlight,
                   "Frames under way at once: a rank that has rendered its part of one begins the next while others "
                   "still render; default 1")
        ->check(detail::number(1, 64))
        ->option_text("N")
        ->group(how);

    const char* picture = "Picture";
    app.add_option("--size", size, "Of the image in pixels, each side 1 to 65536; default 1024x1024")
        ->option_text("WxH")
        ->group(picture);
    app.add_option("--frames", options.frames, "Frames of one turn around the scene; default 1")
        ->check(detail::number(1, most))
        ->option_text("N")
        ->group(picture);
    app.add_option("--spp", options.spp, "Samples per pixel, one pass each; default 1, in the pixel's centre")
        ->check(detail::number(1, 65536))
        ->option_text("N")
        ->group(picture);
    app.add_option("--adaptive", options.adaptive,
                   "Render a tile until the standard error of its pixels is at most this, from 8 to --spp samples; "
                   "default 0: all have --spp")
        ->check(detail::number(0, 1))
        ->option_text("ERR")
        ->group(picture);
    app.add_option(
           "--ao", options.ao,
           "Ambient occlusion of surfaces and spheres, with N rays per hit; default 16 for files that are no volumes, "
           "without --path; else 0: none. Bricks then hold what is within --ao-distance of them as ghosts")
        ->check(detail::number(0, 4096))
        ->option_text("N")
        ->group(picture);
    app.add_option("--ao-distance", options.aoDistance,
                   "How far these rays look and shadows are cast, in units of the scene's largest extent; default 0.1")
        ->check(detail::number(1e-6, 10))
        ->option_text("D")
        ->group(picture);
    app.add_flag("--shadows", options.shadows, "Shadows of surfaces and spheres on each other, as far as --ao-distance")
        ->group(picture);
    app.add_option(
           "--path", options.path,
           "Path-trace opaque surfaces and spheres under a bright sky, N bounces at most; volumes are left out; "
           "needs --mode image; default 0: off")
        ->check(detail::number(0, 1000))
        ->option_text("N")
        ->group(picture);
    words("--camera", options.view.kind, {"perspective", "dof", "motion", "stereo", "dome"},
          "dof: depth of field; motion: the camera goes on along its orbit while the shutter is open; stereo: the "
          "left eye's view in the left half, the right eye's in the right; dome: a fisheye; default perspective. "
          "dof and motion want --spp 16 or more")
        ->group("Camera");
    app.add_option("--aperture", options.view.aperture,
                   "Radius of the lens of dof, in units of the largest extent of what there is to see; default 0.05")
        ->check(detail::number(0, 10))
        ->option_text("R")
        ->group("Camera");
    app.add_option("--focus", options.view.focus,
                   "Distance of what is sharp with dof and at the screen with stereo, in the same units; default: the "
                   "centre's")
        ->check(detail::number(1e-6, 1e6))
        ->option_text("D")
        ->group("Camera");
    app.add_option("--shutter", options.view.shutter, "Degrees of the orbit that motion blurs, up to 360; default 8")
        ->check(detail::number(-360, 360))
        ->option_text("DEG")
        ->group("Camera");
    app.add_option("--eyes", options.view.separation, "Distance of the eyes of stereo, in the same units; default 0.1")
        ->check(detail::number(0, 10))
        ->option_text("D")
        ->group("Camera");
    app.add_option("--dome-angle", options.view.domeAngle, "Degrees that dome covers, up to 360; default 180")
        ->check(detail::number(1, 360))
        ->option_text("DEG")
        ->group("Camera");
    app.add_option(
           "--wall", wall,
           "Display wall of COLUMNSxROWS displays, which ranks drive in turn; the image size is that of all, and "
           "each display's picture is written to the output file with its number before the ending")
        ->option_text("CxR")
        ->group(picture);
    app.add_option("--bezel", options.bezel, "Pixels that are hidden between two displays of a wall; default 0")
        ->check(detail::number(0, 10000))
        ->option_text("N")
        ->group(picture);
    app.add_option("--seed", options.seed, "Of generated scenes and sample positions; default 1")
        ->check(detail::number(0, 9007199254740992.0))
        ->option_text("N")
        ->group(picture);
    app.add_option("--azimuth", options.view.azimuth, "Of the camera around the axis --up, in degrees; default 30")
        ->check(detail::number(-36000, 36000))
        ->option_text("DEG")
        ->group("Camera");
    app.add_option("--elevation", options.view.elevation, "Of the camera in degrees, -90 to 90; default 20")
        ->check(detail::number(-90, 90))
        ->option_text("DEG")
        ->group("Camera");
    app.add_option("--fov", options.view.fieldOfView, "Vertical field of view in degrees, 1 to 170; default 35")
        ->check(detail::number(1, 170))
        ->option_text("DEG")
        ->group("Camera");
    app.add_option("--zoom", options.view.zoom, "How many times as large the scene is in the image; default 1")
        ->check(detail::number(1e-3, 1e4))
        ->option_text("Z")
        ->group("Camera");
    app.add_option("--camera-distance", options.view.distance,
                   "From the target, in units of its largest extent; default: so far that all "
                   "of it is in the image, from every side")
        ->check(detail::number(0, 1000))
        ->option_text("D")
        ->group("Camera");
    app.add_option("--opacity", options.opacity, "Of surfaces, isosurfaces and spheres, 0 to 1; default 1")
        ->check(detail::number(0, 1))
        ->option_text("A")
        ->group(picture);
    app.add_option(
           "--early-termination", options.earlyTermination,
           "End a ray within a brick when less than this part of the light gets through, 0 to 1. The image then "
           "depends on the bricks, and no pixel is off by more than this part of the brightest colour; default "
           "0: when nothing does")
        ->check(detail::number(0, 1))
        ->option_text("T")
        ->group(picture);
    app.add_option("--background", background,
                   "Opaque colour behind the scene, linear, each 0 to 1; default: none, "
                   "the image stays transparent, and a .png has alpha")
        ->option_text("R,G,B")
        ->group(picture);
    app.add_option("--exposure", options.exposure, "Tone-map with this factor, above 0; default 0: off")
        ->check(detail::number(0, 1e6))
        ->option_text("E")
        ->group(picture);
    app.add_flag("--dither", options.dither, "Dither the colour of a .png, so that gradients have no bands")
        ->group(picture);

    app.add_option(
           "--live", options.live,
           "Show it in a browser on this machine, where it can be turned: prints the address; port 0: any that is "
           "free; default, without PORT: 8080, or any if that is taken")
        ->check(detail::number(-1, 65535))
        ->option_text("[PORT]")
        ->group(picture);

    OutputOptions outputOptions(app, options);
    app.config_formatter(std::make_shared<OptionsFile>());
    app.allow_config_extras(CLI::config_extras_mode::error);
    app.set_config(
           "--config", "",
           "Read options, and the scene, from a file: JSON as --save-options writes it, or TOML. The command line "
           "counts more")
        ->option_text("FILE");

    for (CLI::Option* option : app.get_options()) {
        option->capture_default_str();
        option->description(detail::wrapped(option->get_description()));
    }
    app.footer("Examples:\n"
               "  dfb_render demo --ranks 4 --output demo.png\n"
               "  mpiexec -n 8 dfb_render synthetic --size 2048x2048 --frames 8 --stats stats.json\n"
               "  mpiexec -n 4 dfb_render bunny.ply neghip_64x64x64_uint8.raw --spp 4 --output both.png\n"
               "  mpiexec -n 4 dfb_render demo --frames 36 --output turn_%02d.png\n"
               "Exit code: 0: done, 1: the run failed, 2: the command line is wrong. Of an option that is given twice "
               "the last counts.");
    try {
        app.parse(withPort(argc, argv));
        options.fit = !noFit;
        if (options.interleave > 1 && app.count("--deep") == 0)
            options.deep = options.interleave; // as many pieces as a brick can have on a ray
        options.sharedMemory = !noSharedMemory;
        if (app.count("--size") > 0)
            detail::parseSize("--size", size, 65536, options.width, options.height);
        if (app.count("--wall") > 0)
            detail::parseSize("--wall", wall, 64, options.wallColumns, options.wallRows);
        outputOptions.apply(options);
        lookOptions.apply(options.view, options.look);
        if (app.count("--background") > 0)
            options.background =
                detail::parseThree("--background", background, 0, 1, "R,G,B with three numbers from 0 to 1");
        if (app.count("--spacing") > 0)
            options.spacing =
                detail::parseThree("--spacing", spacing, 1e-15, 1e9, "X,Y,Z with three distances from 1e-15 to 1e9");
        if (app.count("--origin") > 0)
            options.origin =
                detail::parseThree("--origin", origin, -1e12, 1e12, "X,Y,Z with three numbers of at most 1e12");
        if (options.live && app.count("--spp") == 0)
            options.spp = 16; // while the camera rests
        const auto refuse = [&app](bool wrong, const char* option, const char* why) {
            if (wrong && app.count(option) > 0)
                throw CLI::ValidationError(option, why);
        };
        for (const char* other :
             {"--frames", "--output", "--png-bits", "--layers", "--cinema", "--alpha", "--depth", "--aux", "--stats",
              "--trace", "--wall", "--exposure", "--adaptive", "--interleave", "--deep", "--verify", "--in-flight"})
            refuse(options.live.has_value(), other, "does not go with --live");
        refuse(options.live && options.blend != Blending::Sort, "--blend", "order or nearest does not go with --live");
        const bool isData = options.mode == Mode::Data;
        refuse(options.mode == Mode::Image, "--blend", "does not go with --mode image");
        for (const char* other : {"--adaptive", "--interleave", "--deep", "--wall", "--exposure"})
            refuse(options.blend != Blending::Sort, other, "does not go with --blend order or nearest");
        refuse(options.mode == Mode::Image, "--cut", "does not go with --mode image: it has no bricks");
        refuse(options.blend == Blending::Order && options.view.kind != CameraKind::Perspective, "--camera",
               "does not go with --blend order: one order is not right for all its rays");
        refuse(options.mode != Mode::Mixed, "--replicate", "needs --mode mixed");
        refuse(options.mode != Mode::Mixed, "--balance", "needs --mode mixed");
        refuse(options.mode != Mode::Image, "--distribution", "needs --mode image");
        refuse(options.mode != Mode::Image, "--path", "needs --mode image: paths go through the whole scene");
        refuse(!isData, "--interleave", "needs --mode data");
        refuse(!isData, "--deep", "needs --mode data");
        refuse(options.interleave > 1 || options.deep > 0, "--adaptive", "does not go with --interleave or --deep");
        refuse(options.interleave > 1 || options.deep > 0, "--aux", "does not go with --interleave or --deep");
        refuse(options.interleave > 1 || options.deep > 0, "--wall", "does not go with --interleave or --deep");
        refuse(options.interleave > 1 || options.deep > 0, "--exposure", "does not go with --interleave or --deep");
        refuse(options.adaptive > 0, "--wall", "does not go with --adaptive");
        refuse(options.adaptive > 0, "--exposure", "does not go with --adaptive");
        refuse(options.adaptive > 0 && options.spp < 8, "--adaptive",
               "needs --spp 8 or more: the most samples per pixel");
        refuse(options.errorBudget > 0, "--wire", "does not go with --error-budget");
        if (options.isExr() && options.wallColumns > 0)
            throw CLI::ValidationError("--output", "an .exr is not written for a wall");
        if (options.isExr() && app.count("--layers") == 0 && (options.interleave > 1 || options.deep > 0))
            options.layers &= dfb::depthChannel;
        if (options.isExr() && (options.layers & dfb::imageAuxChannels) && (options.interleave > 1 || options.deep > 0))
            throw CLI::ValidationError("--layers", "other than depth do not go with --interleave or --deep");
        refuse(options.pngBits == 16, "--dither", "does not go with --png-bits 16");
        refuse(options.wallColumns > 0, "--png-bits", "does not go with --wall");
        refuse(options.wallColumns > 0, "--dither", "does not go with --wall");
        refuse(endingOf(options.output) != ".png", "--dither", "needs --output FILE.png");
        for (const char* other :
             {"--adaptive", "--interleave", "--deep", "--exposure", "--blend", "--wall", "--dither"})
            refuse(options.verify, other, "does not go with --verify");
        for (const char* other : {"--adaptive", "--wall"})
            refuse(options.inFlight > 1, other, "does not go with --in-flight");
        for (const char* file : {"--alpha", "--depth", "--aux"})
            refuse(options.wallColumns > 0, file, "is not written for a wall");
        if (options.wallColumns > 0) {
            const int shownX = options.width - (options.wallColumns - 1) * options.bezel,
                      shownY = options.height - (options.wallRows - 1) * options.bezel;
            if (shownX < options.wallColumns || shownY < options.wallRows || shownX % options.wallColumns != 0
                || shownY % options.wallRows != 0)
                throw CLI::ValidationError("--wall", "an image of " + size + " pixels cannot be shared by " + wall
                                                         + " equal displays with bezels of "
                                                         + std::to_string(options.bezel));
        }
        outputOptions.checkPatterns(options);
        const std::vector<std::string> endings{".raw", ".nrrd", ".nhdr", ".mha", ".mhd", ".ply",
                                               ".obj", ".stl",  ".gltf", ".glb", ".xyz"};
        for (const std::string& word : options.scene) {
            const bool generated = word == "synthetic" || word == "demo";
            if (generated && options.scene.size() > 1)
                throw CLI::ValidationError("scene", "'" + word + "' stands alone, not beside other scenes");
            if (generated && options.look.clip)
                throw CLI::ValidationError("--clip", "is for files, not for '" + word + "'");
            if (generated)
                continue;
            SceneFile file;
            try {
                file = parseSceneFile(word, endings);
            } catch (const std::invalid_argument& wrong) {
                throw CLI::ValidationError("scene", wrong.what());
            }
            const bool isInHdf5 = isHdf5(file.path);
            if (const std::string wrong = detail::checkEnding(file.path, endings); !wrong.empty() && !isInHdf5)
                throw CLI::ValidationError("scene", wrong + ", or the word synthetic or demo");
            const bool isVolume = isInHdf5 || isVolumeEnding(endingOf(file.path));
            if (!isVolume && (!file.look.transfer.empty() || file.look.range || !file.look.isovalues.empty()))
                throw CLI::ValidationError("scene", "'" + word + "': transfer, range and isovalue are for volumes");
            if (isVolume && !isZero(file.look.rotate))
                throw CLI::ValidationError("scene", "'" + word
                                                        + "': a volume cannot be rotated; the camera can, with "
                                                          "--up");
            LookOptions::requireTransfer(file.look.transfer, "scene", "'" + word + "': transfer: ");
            file.look = merged(file.look, options.look);
            options.files.push_back(file);
            if (app.count("--ao") == 0 && !isVolume && options.path == 0)
                options.ao = options.live ? 4 : 16; // samples accumulate in a live view
        }
        app.get_option("--ao")->default_str(std::to_string(options.ao));
        options.values = valuesOf(app, wordsOf, false);
        options.given = valuesOf(app, wordsOf, true);
    } catch (const CLI::CallForHelp&) {
        return {std::nullopt, 0, app.help()};
    } catch (const CLI::ParseError& error) {
        std::string message = error.what();
        std::replace(message.begin(), message.end(), '\n', ' ');
        return {std::nullopt, exitUsage, "dfb_render: " + message + " (see --help)"};
    }
    return {options, 0, {}};
}

std::string optionsText(const std::vector<std::string>& scene,
                        const std::vector<std::pair<std::string, std::string>>& given)
{
    nlohmann::ordered_json json;
    json["scene"] = scene;
    for (const auto& [name, text] : given)
        json[name] = detail::valueOf(text);
    return json.dump(2) + '\n';
}

} // namespace example
