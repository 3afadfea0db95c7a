// The command line of the bundled renderer.
#include "support.hpp"

#include <frame_pattern.hpp>
#include <options.hpp>

#include <algorithm>
#include <array>
#include <filesystem>
#include <map>
#include <string>
#include <utility>
#include <vector>

namespace options_cases {

using namespace example;

namespace {

ParsedOptions parse(const std::vector<std::string>& words)
{
    std::vector<const char*> arguments{"dfb_render"};
    for (const std::string& word : words)
        arguments.push_back(word.c_str());
    return parseOptions(static_cast<int>(arguments.size()), arguments.data());
}

Options options(const std::vector<std::string>& words)
{
    const ParsedOptions parsed = parse(words);
    INFO(parsed.message);
    REQUIRE(parsed.options);
    CHECK(parsed.exitCode == 0);
    return *parsed.options;
}

// Checks that the scene `demo` with these words behind it is refused.
void checkRefused(std::vector<std::string> words)
{
    words.insert(words.begin(), "demo");
    std::string line;
    for (const std::string& word : words)
        line += word + ' ';
    INFO(line);
    const ParsedOptions parsed = parse(words);
    CHECK_FALSE(parsed.options);
    CHECK(parsed.exitCode == 2);
    CHECK(test::isLineWith(parsed.message, "dfb_render: "));
    CHECK(test::contains(parsed.message, words[1].substr(0, words[1].find('=')))); // names the option
}

} // namespace

TEST_CASE("Without options they have the values that the help says", "[options]")
{
    const Options o = options({"demo"});
    CHECK(o.scene == std::vector<std::string>{"demo"});
    CHECK(o.fit);
    CHECK(o.mode == Mode::Data);
    CHECK(o.ranks == 0);
    CHECK(o.bricks == 0);
    CHECK(o.threads == 0);
    CHECK(o.compression == Compression::None);
    CHECK(o.sharedMemory);
    CHECK(o.peerTimeout == 300);
    CHECK(o.xyzFrame == 0);
    CHECK(o.deep == 0);
    CHECK(o.cut == CutBy::Auto);
    CHECK_FALSE(o.view.distance);
    CHECK(o.ownerMap == OwnerMap::Auto);
    CHECK(o.width == 1024);
    CHECK(o.height == 1024);
    CHECK(o.frames == 1);
    CHECK(o.passes == 1);
    CHECK(o.seed == 1);
    CHECK(o.earlyTermination == 0.0f);
    CHECK_FALSE(o.background);
    CHECK_FALSE(o.dither);
    CHECK(o.output.empty());
    CHECK(o.stats.empty());
}

TEST_CASE("Every option arrives", "[options]")
{
    const Options o = options({"a.ply",
                               "--mode",
                               "image",
                               "b_2x2x2_uint8.raw",
                               "--ranks",
                               "7",
                               "--bricks=9",
                               "--threads",
                               "3",
                               "--compression",
                               "snappy",
                               "--owner-map",
                               "hash",
                               "--size",
                               "1x65536",
                               "--frames",
                               "36",
                               "--spp",
                               "4",
                               "--seed",
                               "9007199254740991",
                               "--azimuth",
                               "-90",
                               "--elevation",
                               "45.5",
                               "--fov",
                               "60",
                               "--camera-distance",
                               "0.5",
                               "--opacity",
                               "1",
                               "--early-termination",
                               "0.01",
                               "--background",
                               "0,0.5,1",
                               "--exposure",
                               "2",
                               "--dither",
                               "--output",
                               "o.png",
                               "--alpha",
                               "a.pfm",
                               "--depth",
                               "d.pfm",
                               "--stats",
                               "s.json",
                               "--no-fit",
                               "--no-shared-memory",
                               "--peer-timeout",
                               "20",
                               "c.obj",
                               "d.xyz"});
    CHECK(o.scene == std::vector<std::string>{"a.ply", "b_2x2x2_uint8.raw", "c.obj", "d.xyz"});
    CHECK_FALSE(o.fit);
    CHECK_FALSE(o.sharedMemory);
    CHECK(o.peerTimeout == 20);
    CHECK(o.mode == Mode::Image);
    CHECK(o.ranks == 7);
    CHECK(o.bricks == 9);
    CHECK(o.threads == 3);
    CHECK(o.compression == Compression::Snappy);
    CHECK(o.ownerMap == OwnerMap::Hash);
    CHECK(o.width == 1);
    CHECK(o.height == 65536);
    CHECK(o.frames == 36);
    CHECK(o.passes == 4);
    CHECK(o.seed == 9007199254740991u);
    CHECK(o.view.azimuth == -90.0f);
    CHECK(o.view.elevation == 45.5f);
    CHECK(o.view.fieldOfView == 60.0f);
    CHECK(o.view.distance == 0.5f);
    CHECK(o.opacity == 1.0f);
    CHECK(o.earlyTermination == 0.01f);
    REQUIRE(o.background);
    CHECK((*o.background)[1] == 0.5f);
    CHECK(o.exposure == 2.0f);
    CHECK(o.dither);
    CHECK(o.output == "o.png");
    CHECK(o.alpha == "a.pfm");
    CHECK(o.depth == "d.pfm");
    CHECK(o.stats == "s.json");
    CHECK(options({"synthetic", "--cut", "volume"}).cut == CutBy::Volume);
    CHECK(options({"synthetic", "--cut", "content"}).cut == CutBy::Content);
    CHECK(options({"synthetic", "--owner-map", "linear"}).ownerMap == OwnerMap::Linear);
    CHECK(options({"synthetic", "--mode", "data", "--output", "dir.d/o.pfm"}).output == "dir.d/o.pfm");
}

TEST_CASE("What is wrong on the command line is refused in one line that names it", "[options]")
{
    for (const std::string size :
         {"0x5",   "5x0",  "0x0",     "65537x5", "5x65537", "-5x5", "5x-5",         "5",
          "x",     "5x",   "x5",      "5x5x5",   "5X5",     "5 x5", "4294967297x5", "99999999999999999999x5",
          "1.5x5", "wide", "nanxnan", ""})
        checkRefused({"--size", size});
    for (const std::string option : {"--ranks", "--frames", "--spp"})
        for (const std::string value :
             {"0", "-1", "nan", "inf", "1.5", "", " ", "two", "3x", "2147483648", "99999999999999999999"})
            checkRefused({option, value});
    for (const std::string option : {"--bricks", "--threads", "--seed", "--peer-timeout"})
        for (const std::string value : {"-1", "nan", "inf", "-inf", "1.5", "two", "99999999999999999999"})
            checkRefused({option, value});
    for (const std::string option :
         {"--azimuth", "--elevation", "--fov", "--camera-distance", "--opacity", "--early-termination", "--exposure"})
        for (const std::string value : {"nan", "inf", "-inf", "1e30", "much", "1,5", ""})
            checkRefused({option, value});
    checkRefused({"--fov", "0"});
    checkRefused({"--camera-distance", "-1"});
    for (const std::string value : {"0", "-1", "1.5", "last", "2147483647"})
        checkRefused({"--xyz-frame", value});
    checkRefused({"--interleave", "4096", "--bricks", "1048576"}); // more cells than an int can count
    checkRefused({"--interleave", "17", "--bricks", "1048576"});
    checkRefused({"--opacity", "1.01"});
    checkRefused({"--opacity", "-0.01"});
    checkRefused({"--background", "1,1"});
    checkRefused({"--background", "1,nan,1"});
    checkRefused({"--background", "1,1,2"});
    for (const std::string value : {"", ",", "1,1,", "1,1,1,1", "1,,1", "1 1 1", "1,1,1x", "-0.1,1,1"})
        checkRefused({"--background", value});
    for (const std::string option : {"--mode", "--compression", "--owner-map"})
        for (const std::string value : {"best", "0", "", "Data"})
            checkRefused({option, value});
    for (const std::string value : {"o.jpg", "o", ".png", "o.PNG", "o.png.txt", ""})
        checkRefused({"--output", value});
    checkRefused({"--alpha", "a.png"});
    checkRefused({"--depth", "d.png"});
    checkRefused({"--stats", "s.txt"});
    checkRefused({"--wall", "2x2", "--size", "91x70"}); // displays would not be equal
    checkRefused({"--wall", "2x2", "--size", "3x3", "--bezel", "2"});
    checkRefused({"--sizes", "5x5"});
    checkRefused({"--size"});
    checkRefused({"--stats"});
    checkRefused({"-q"});
}

TEST_CASE("The camera's place and the look arrive", "[options]")
{
    const Options o = options({"a.ply:opacity=0.5", "b_2x2x2_uint8.raw:transfer=bone", "--eye", "1,2,-3", "--target",
                               "0,0.5,0", "--up", "0,0,1", "--zoom", "2.5", "--transfer", "viridis", "--range",
                               "1%,200", "--isovalue", "7,3", "--clip", "0,0,0,1,1,1"});
    REQUIRE(o.view.eye);
    CHECK(o.view.eye->z == -3.0f);
    REQUIRE(o.view.target);
    CHECK(o.view.target->y == 0.5f);
    CHECK(o.view.up.z == 1.0f);
    CHECK(o.view.zoom == 2.5f);
    REQUIRE(o.files.size() == 2);
    CHECK(o.files[0].path == "a.ply");
    CHECK(o.files[0].look.opacity == 0.5f);
    CHECK(o.files[0].look.clip);
    CHECK(o.files[1].look.transfer == "bone");
    CHECK(o.files[1].look.isovalues.empty()); // the file has a look of its own
    CHECK(o.look.isovalues == std::vector<float>{3, 7});
    CHECK(options({"demo", "--up=-z"}).view.up.z == -1.0f);
    CHECK(options({"demo", "--transfer", "auto"}).look.transfer == "auto");
    CHECK(options({"demo", "--transfer", "a/b.json"}).look.transfer == "a/b.json");
    CHECK(options({"demo", "--output", "a.exr"}).layers == dfb::depthChannel);
    CHECK(options({"demo", "--output", "a.exr", "--layers", "none"}).layers == 0);
    CHECK(options({"demo", "--output", "a.exr", "--layers", "normal,ids"}).layers
          == (dfb::normalChannel | dfb::primitiveIdChannel | dfb::instanceIdChannel));
    CHECK(options({"demo", "--cinema", "50%.cdb"}).output == "50%%.cdb/frame_%04d.png");
    for (const std::string option : {"--eye", "--target", "--up"})
        for (const std::string value : {"1,2", "1,2,3,4", "1,2,nan", "1,2e15,3", "a", "1, 2,3", "w", ""})
            checkRefused({option + "=" + value});
    checkRefused({"--up", "0,0,0"});
    checkRefused({"--zoom", "0"});
    checkRefused({"--azimuth", "3", "--eye", "1,2,3"});
    checkRefused({"--eye", "1,2,3", "--target", "1,2,3"});
    for (const std::string value : {"rainbow", "a.toml", ""})
        checkRefused({"--transfer=" + value});
    for (const std::string value : {"1", "2,1", "1%,2%,3%", "120%,130%", ""})
        checkRefused({"--range=" + value});
    checkRefused({"--isovalue=1,"});
    checkRefused({"--clip", "0,0,0,1,1,1"}); // not for a generated scene
    checkRefused({"--png-bits", "12", "--output", "a.png"});
    checkRefused({"--png-bits", "16", "--output", "a.pfm"});
    checkRefused({"--png-bits", "16"});
    checkRefused({"--layers", "depth", "--output", "a.png"});
    checkRefused({"--layers", "colour", "--output", "a.exr"});
    checkRefused({"--layers", "normal", "--output", "a.exr", "--deep", "3"});
    checkRefused({"--output", "a.exr", "--wall", "1x1"});
    checkRefused({"--cinema", "folder"});
    checkRefused({"--cinema", "a.cdb", "--output", "a.png"});
    checkRefused({"--save-options", "a.toml"});
    checkRefused({"--save-options", "a_%d.json"});
    checkRefused({"--live", "--save-options", "a.json"});
    for (const std::string word : {"a.ply:isovalue=3", "a.obj:transfer=grey", "a.ply:opacity=2", "a.ply:gloss=2",
                                   "a_2x2x2_uint8.raw:transfer=rainbow"}) {
        const ParsedOptions parsed = parse({word});
        CHECK(parsed.exitCode == 2);
        CHECK(test::isLineWith(parsed.message, word));
    }
}

TEST_CASE("What would do nothing is refused", "[options]")
{
    checkRefused({"--balance", "cost", "--mode", "mixed", "--blend", "order"});
    checkRefused({"--balance", "cost", "--mode", "mixed", "--live"});
    checkRefused({"--distribution", "dynamic", "--mode", "image", "--live"});
    CHECK(parse({"demo", "--balance", "round-robin", "--mode", "mixed", "--blend", "order"}).options);
    CHECK(parse({"demo", "--distribution", "owned", "--mode", "image", "--live"}).options);
    checkRefused({"--spacing", "1,1,2"}); // a generated scene is no file
    checkRefused({"--origin", "1,1,2", "--no-fit"});
    checkRefused({"--xyz-frame", "2"});
    checkRefused({"--no-fit"});
    CHECK(parse({"demo", "--no-fit=false"}).options);
    const ParsedOptions parsed = parse({"a_2x2x2_uint8.raw", "--origin", "1,1,2"}); // is centred
    CHECK_FALSE(parsed.options);
    CHECK(test::contains(parsed.message, "--origin: needs --no-fit"));
    CHECK(parse({"a_2x2x2_uint8.raw:clip=0,0,0,1,1,1", "--origin", "1,1,2"}).options);
    CHECK(parse({"a_2x2x2_uint8.raw", "--origin", "1,1,2", "--no-fit"}).options);
    CHECK_FALSE(parse({"a.ply", "--spacing", "1,1,2"}).options);
    CHECK_FALSE(parse({"a.ply", "--xyz-frame", "2"}).options);
    CHECK(parse({"a.ply", "b.xyz", "--xyz-frame", "2"}).options);
    for (const std::vector<std::string>& other : std::vector<std::vector<std::string>>{
             {"--ao", "4"}, {"--ao-distance", "1"}, {"--shadows"}, {"--opacity", "0.5"}}) {
        std::vector<std::string> words = other;
        words.insert(words.end(), {"--mode", "image", "--path", "2"});
        checkRefused(words);
    }
    CHECK(parse({"a.ply", "--mode", "image", "--path", "2", "--ao", "0"}).options); // as the page of a live view says
    checkRefused({"--min-transmittance", "0.1", "--mode", "image"});
    checkRefused({"--min-transmittance", "0.1", "--blend", "nearest"});
}

TEST_CASE("Two files with one name are refused", "[options]")
{
    checkRefused({"--depth", "a.pfm", "--alpha", "a.pfm"});
    checkRefused({"--alpha", "./a.pfm", "--output", "a.pfm"});
    checkRefused({"--alpha", "a.normal.pfm", "--aux", "a"});
    checkRefused({"--output", "a.instance.png", "--aux", "a"});
    checkRefused({"--trace", "a.json", "--stats", "a.json"});
    checkRefused({"--save-options", "a.json", "--stats", "a.json"});
    checkRefused({"--save-options", "a.json", "--trace", "b/../a.json"});
    checkRefused({"--alpha", "a%d.pfm", "--depth", "a%01d.pfm", "--frames", "3"});
    checkRefused({"--depth", (std::filesystem::current_path() / "a.pfm").string(), "--alpha", "a.pfm"});
    CHECK(parse({"demo", "--output", "a.pfm", "--alpha", "b.pfm", "--depth", "b/a.pfm", "--aux", "a"}).options);
}

TEST_CASE("Of an option that is given twice the last counts", "[options]")
{
    CHECK(options({"demo", "--frames", "010"}).frames == 10); // not octal
    CHECK(options({"demo", "--frames", "08"}).frames == 8);
    const Options o =
        options({"demo",         "--spp",    "2",        "--size",   "5x5",         "--mode",  "image",  "--background",
                 "1,1,1",        "--output", "a.png",    "--dither", "--mode=data", "--spp=3", "--size", "7x6",
                 "--background", "0,0.5,0",  "--dither", "--output", "b_%03d.png"});
    CHECK(o.scene == std::vector<std::string>{"demo"});
    CHECK(o.passes == 3);
    CHECK(o.width == 7);
    CHECK(o.height == 6);
    CHECK(o.mode == Mode::Data);
    REQUIRE(o.background);
    CHECK(*o.background == std::array<float, 3>{0.0f, 0.5f, 0.0f});
    CHECK(o.output == "b_%03d.png");
    CHECK(options({"demo", "--size", "6x6", "--wall", "1x1", "--wall", "3x2"}).wallColumns == 3);
    // All options that take a value.
    const std::vector<std::pair<std::string, std::string>> values{{"--mode", "image"},
                                                                  {"--mode", "mixed"},
                                                                  {"--replicate", "2"},
                                                                  {"--balance", "cost"},
                                                                  {"--blend", "sort"},
                                                                  {"--cut", "content"},
                                                                  {"--bricks", "2"},
                                                                  {"--ranks", "2"},
                                                                  {"--threads", "2"},
                                                                  {"--peer-timeout", "9"},
                                                                  {"--compression", "none"},
                                                                  {"--wire", "float16"},
                                                                  {"--min-transmittance", "0.1"},
                                                                  {"--owner-map", "hash"},
                                                                  {"--in-flight", "2"},
                                                                  {"--size", "9x9"},
                                                                  {"--frames", "3"},
                                                                  {"--spp", "9"},
                                                                  {"--ao", "1"},
                                                                  {"--ao-distance", "1"},
                                                                  {"--camera", "dof"},
                                                                  {"--aperture", "1"},
                                                                  {"--focus", "1"},
                                                                  {"--seed", "2"},
                                                                  {"--azimuth", "2"},
                                                                  {"--elevation", "2"},
                                                                  {"--fov", "9"},
                                                                  {"--camera-distance", "2"},
                                                                  {"--target", "1,2,3"},
                                                                  {"--up", "z"},
                                                                  {"--zoom", "2"},
                                                                  {"--transfer", "viridis"},
                                                                  {"--range", "1%,9"},
                                                                  {"--isovalue", "3"},
                                                                  {"--png-bits", "8"},
                                                                  {"--save-options", "o.json"},
                                                                  {"--opacity", "1"},
                                                                  {"--early-termination", "0.1"},
                                                                  {"--background", "1,1,1"},
                                                                  {"--exposure", "1"},
                                                                  {"--output", "o.png"},
                                                                  {"--alpha", "a.pfm"},
                                                                  {"--depth", "d.pfm"},
                                                                  {"--aux", "a"},
                                                                  {"--stats", "s.json"}};
    std::vector<std::string> all{"demo"};
    for (int times = 0; times < 2; ++times)
        for (const auto& [name, value] : values)
            all.insert(all.end(), {name, value});
    options(all);
    for (const std::vector<std::string>& words :
         std::vector<std::vector<std::string>>{{"--camera", "motion", "--shutter", "1", "--shutter", "2"},
                                               {"--camera", "stereo", "--eyes", "1", "--eyes", "2"},
                                               {"--camera", "dome", "--dome-angle", "90", "--dome-angle", "91"},
                                               {"--wall", "2x1", "--bezel", "0", "--bezel", "2"}}) {
        std::vector<std::string> with{"demo"};
        with.insert(with.end(), words.begin(), words.end());
        options(with);
        // Without the option that they belong to they would do nothing, so they are refused.
        checkRefused({words[2], words[3]});
    }
}

TEST_CASE("The options are there as they count, for the record", "[options]")
{
    const Options o = options({"demo", "--spp", "2", "--mode", "image", "--spp", "3", "--dither", "--output", "a.png",
                               "--background=0,0.25,1"});
    std::map<std::string, std::string> values;
    for (const auto& [name, value] : o.values)
        CHECK(values.emplace(name, value).second);
    CHECK(values.at("spp") == "3");
    CHECK(values.at("mode") == "image"); // a word, as on the command line
    CHECK(values.at("blend") == "sort"); // defaults, too
    CHECK(values.at("size") == "1024x1024");
    CHECK(values.at("opacity") == "1");
    CHECK(values.at("ao") == "0");
    CHECK(values.at("dither") == "true");
    CHECK(values.at("shadows") == "false");
    CHECK(values.at("output") == "a.png");
    CHECK(values.at("background") == "0,0.25,1");
    CHECK(values.count("alpha") == 0); // no such file
    CHECK(values.count("help") == 0);
    CHECK(values.count("scene") == 0);
    const auto has = [](const Options& options, const char* name, const char* text) {
        return std::count(options.values.begin(), options.values.end(),
                          std::pair<std::string, std::string>(name, text));
    };
    CHECK(has(options({"demo", "--interleave", "4"}), "deep", "4") == 1);
    CHECK(has(options({"demo", "--shadows=false"}), "shadows", "false") == 1);
    CHECK(has(options({"demo", "--shadows=true"}), "shadows", "true") == 1);
}

TEST_CASE("Surfaces from files have ambient occlusion, unless the user says otherwise", "[options]")
{
    CHECK(options({"demo"}).aoRays == 0);
    CHECK(options({"v_2x2x2_uint8.raw"}).aoRays == 0);
    CHECK(options({"a.ply"}).aoRays == 16);
    CHECK(options({"v_2x2x2_uint8.raw", "a.xyz"}).aoRays == 16);
    CHECK(options({"a.ply", "--ao", "0"}).aoRays == 0);
    CHECK(options({"a.ply", "--mode", "image", "--path", "2"}).aoRays == 0);
    for (const auto& [name, value] : options({"a.ply"}).values)
        if (name == "ao")
            CHECK(value == "16");
}

TEST_CASE("A pattern numbers the files of the frames", "[options]")
{
    CHECK(FramePattern("a.png").isPattern() == false);
    CHECK(FramePattern("a.png").path(7) == "a.png");
    CHECK(FramePattern("").path(7).empty());
    CHECK(FramePattern("f_%d.png").isPattern());
    CHECK(FramePattern("f_%d.png").path(0) == "f_0.png");
    CHECK(FramePattern("f_%d.png").path(12345) == "f_12345.png");
    CHECK(FramePattern("d%%/f_%04d.png").path(12) == "d%/f_0012.png");
    CHECK(FramePattern("f_%04d.png").path(12345) == "f_12345.png");
    CHECK(FramePattern("50%%.png").path(3) == "50%.png");
    CHECK_FALSE(FramePattern("50%%.png").isPattern());
    for (const std::string option : {"--output", "--alpha", "--depth", "--aux"}) {
        const std::string ending = option == "--output" ? ".png" : option == "--aux" ? "" : ".pfm";
        for (const std::string bad :
             {"%s",   "%n",   "%",       "%%%",   "%5", "%x",  "%-4d", "%+d", "%ld",  "%*d",  "%.3d",
              "%1$d", "%d%d", "%04d_%d", "%100d", "%i", "% d", "%0d",  "%3d", "%00d", "%010d"})
            checkRefused({option, "f_" + bad + ending});
        CHECK(parse({"demo", "--frames", "3", option, "f_%d" + ending}).options);
        CHECK(parse({"demo", option, "f_%03d" + ending}).options); // a single frame, too
    }
    checkRefused({"--stats", "s_%d.json"}); // one file for all frames
}

TEST_CASE("Bricks that lie in each other have as many segments as they have cells", "[options]")
{
    CHECK(options({"demo", "--interleave", "5"}).deep == 5);
    CHECK(options({"demo", "--interleave", "1"}).deep == 0);
    CHECK(options({"demo", "--interleave", "5", "--deep", "2"}).deep == 2);
    CHECK(options({"demo", "--interleave", "5", "--deep", "0"}).deep == 0);
    CHECK(options({"demo", "--deep", "3"}).deep == 3);
}

TEST_CASE("A scene must be named", "[options]")
{
    for (const std::vector<std::string>& words : std::vector<std::vector<std::string>>{{},
                                                                                       {"--size", "5x5"},
                                                                                       {""},
                                                                                       {"demos"},
                                                                                       {"a.fbx"},
                                                                                       {"bunny"},
                                                                                       {"a.ply", "a.raw.gz"},
                                                                                       {".raw"},
                                                                                       {"a.ply", "synthetic"},
                                                                                       {"demo", "synthetic"},
                                                                                       {"demo", "a.ply"},
                                                                                       {"a.ply", "a.fbx"}}) {
        const ParsedOptions parsed = parse(words);
        INFO(parsed.message);
        CHECK_FALSE(parsed.options);
        CHECK(parsed.exitCode == 2);
        CHECK(test::isLineWith(parsed.message, "dfb_render: "));
    }
    CHECK(test::contains(parse({"--size", "5x5"}).message, "scene"));
    CHECK(test::contains(parse({"--nope"}).message, "--nope")); // found before the missing scene
}

TEST_CASE("The help says it all", "[options]")
{
    for (const char* flag : {"--help", "-h"}) {
        const ParsedOptions parsed = parse({flag});
        CHECK_FALSE(parsed.options);
        CHECK(parsed.exitCode == 0);
        for (const std::string word : {"--mode",
                                       "--ranks",
                                       "--size",
                                       "--frames",
                                       "--spp",
                                       "--bricks",
                                       "--seed",
                                       "--threads",
                                       "--output",
                                       "--stats",
                                       "--no-fit",
                                       "--compression",
                                       "--owner-map",
                                       "--early-termination",
                                       "--no-shared-memory",
                                       "--opacity",
                                       "--help",
                                       "synthetic",
                                       "demo",
                                       ".raw",
                                       "_XxYxZ_",
                                       "uint8",
                                       "uint16",
                                       "float32",
                                       ".ply",
                                       ".obj",
                                       ".xyz",
                                       ".png",
                                       ".pfm",
                                       "data",
                                       "image",
                                       "65536",
                                       "mpiexec"}) {
            INFO(word);
            CHECK(test::contains(parsed.message, word));
        }
    }
    CHECK(parse({"demo", "--size", "9x9", "--help"}).exitCode == 0);
}

} // namespace options_cases
