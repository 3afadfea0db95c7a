// Picture files with more than 8 bits, tables of pictures, and option files.
#include "support.hpp"

#include <cinema.hpp>
#include <exr.hpp>
#include <options.hpp>
#include <output.hpp>
#include <progress_line.hpp>

#include <png.h>
#if defined(DFB_EXAMPLE_HAS_OPENEXR)
#include <ImfChannelList.h>
#include <ImfFrameBuffer.h>
#include <ImfHeader.h>
#include <ImfInputFile.h>
#include <ImfStringAttribute.h>
#endif

#include <cmath>
#include <cstring>
#include <fstream>
#include <iterator>
#include <limits>
#include <memory>
#include <string>
#include <vector>

namespace picture_file_cases {

using namespace example;
using test::errorOf;
using test::isLineWith;

namespace {

std::string textOf(const std::string& path)
{
    std::ifstream stream(path);
    return {std::istreambuf_iterator<char>(stream), {}};
}

ParsedOptions parse(const std::vector<std::string>& words)
{
    std::vector<const char*> arguments{"dfb_render"};
    for (const std::string& word : words)
        arguments.push_back(word.c_str());
    return parseOptions(static_cast<int>(arguments.size()), arguments.data());
}

// Rows of 16-bit big-endian pixels; `channels` is set to their number of channels.
std::vector<std::vector<std::uint8_t>> readPng16(const std::string& path, int& channels)
{
    std::vector<std::vector<std::uint8_t>> rows;
    std::FILE* file = std::fopen(path.c_str(), "rb");
    REQUIRE(file != nullptr);
    png_structp png = png_create_read_struct(PNG_LIBPNG_VER_STRING, nullptr, nullptr, nullptr);
    png_infop info = png_create_info_struct(png);
    png_init_io(png, file);
    png_read_info(png, info);
    CHECK(png_get_bit_depth(png, info) == 16);
    int intent = -1;
    CHECK(png_get_sRGB(png, info, &intent) != 0);
    channels = png_get_channels(png, info);
    for (png_uint_32 y = 0; y < png_get_image_height(png, info); ++y) {
        rows.emplace_back(png_get_rowbytes(png, info));
        png_read_row(png, rows.back().data(), nullptr);
    }
    png_destroy_read_struct(&png, &info, nullptr);
    std::fclose(file);
    return rows;
}

} // namespace

TEST_CASE("A PNG of 16 bits has the curve of sRGB, and straight colours where it has alpha", "[output]")
{
    const test::TemporaryFolder folder;
    const float nan = std::numeric_limits<float>::quiet_NaN();
    const std::vector<float> rgba{0.5f, 0.25f, 0.001f, 1, 0.1f,  0.2f, 0, 0.4f, 0, 0, 0,    0,
                                  2,    -1,    nan,    1, 0.05f, 0,    0, 0.5f, 1, 1, 1.5f, 1.5f};
    const int width = 3, height = 2;
    for (const bool hasAlpha : {false, true}) {
        const std::string path = folder / "a.png";
        writePng16(path, width, height, rgba.data(), hasAlpha);
        int channels = 0;
        const auto rows = readPng16(path, channels);
        REQUIRE(channels == (hasAlpha ? 4 : 3));
        REQUIRE(rows.size() == 2);
        for (std::size_t i = 0; i < 6; ++i)
            for (std::size_t c = 0; c < static_cast<std::size_t>(channels); ++c) {
                const double alpha = hasAlpha ? std::min(1.0, static_cast<double>(rgba[4 * i + 3])) : 1;
                double v = static_cast<double>(rgba[4 * i + c]);
                v = c == 3 ? alpha : alpha > 0 ? v / alpha : 0;
                v = v > 0 ? std::min(v, 1.0) : 0;
                if (c < 3)
                    v = v <= 0.0031308 ? 12.92 * v : 1.055 * std::pow(v, 1 / 2.4) - 0.055;
                const std::size_t at = 2 * (static_cast<std::size_t>(channels) * (i % 3) + c);
                const int level = 256 * rows[i / 3][at] + rows[i / 3][at + 1];
                INFO("pixel " << i << " channel " << c);
                CHECK(std::abs(level - static_cast<int>(std::lround(65535 * v))) <= 1);
            }
    }
    CHECK(isLineWith(errorOf([&] { writePng16(folder / "none/a.png", 3, 2, rgba.data(), true); }), "none/a.png"));
}

#if defined(DFB_EXAMPLE_HAS_OPENEXR)
TEST_CASE("An EXR holds the image and its layers, bit for bit", "[output]")
{
    const test::TemporaryFolder folder;
    const auto pool = dfb::MemoryPool::create();
    dfb::Image image(*pool, 5, 3, dfb::OutputFormat::RGBA32F, dfb::allChannels & ~dfb::farChannel);
    float next = 0.1f;
    image.forEachPlane([&](std::byte* bytes, std::size_t count) {
        for (std::size_t i = 0; i < count; i += 4, next *= 1.01f)
            std::memcpy(bytes + i, &next, 4);
    });
    const std::string path = folder / "a.exr";
    writeExr(path, image, dfb::allChannels & ~dfb::farChannel, "{\"spp\": 4}");
    Imf::InputFile file(path.c_str());
    const Imf::ChannelList& channels = file.header().channels();
    int count = 0;
    for (auto channel = channels.begin(); channel != channels.end(); ++channel)
        ++count;
    CHECK(count == 16);
    const auto check = [&](const char* name, Imf::PixelType type, const void* expected, std::size_t words) {
        INFO(name);
        REQUIRE(channels.findChannel(name) != nullptr);
        CHECK(channels.findChannel(name)->type == type);
        std::vector<std::uint32_t> read(15);
        Imf::FrameBuffer to;
        to.insert(name, Imf::Slice(type, reinterpret_cast<char*>(read.data()), 4, 20));
        file.setFrameBuffer(to);
        file.readPixels(0, 2);
        int wrong = 0;
        for (std::size_t i = 0; i < 15; ++i)
            wrong += std::memcmp(&read[i], static_cast<const char*>(expected) + 4 * words * i, 4) != 0;
        CHECK(wrong == 0);
    };
    check("R", Imf::FLOAT, image.rgba32f(), 4);
    check("A", Imf::FLOAT, image.rgba32f() + 3, 4);
    check("Z", Imf::FLOAT, image.depth(), 1);
    check("N.Y", Imf::FLOAT, image.normal() + 1, 3);
    check("albedo.B", Imf::FLOAT, image.albedo() + 2, 3);
    check("P.X", Imf::FLOAT, image.position(), 3);
    check("id.primitive", Imf::UINT, image.primitiveId(), 1);
    check("id.instance", Imf::UINT, image.instanceId(), 1);
    writeExr(path, image, dfb::ChannelMask{0}, "");
    CHECK(Imf::InputFile(path.c_str()).header().channels().findChannel("Z") == nullptr);
    CHECK(isLineWith(errorOf([&] { writeExr(folder / "none/a.exr", image, dfb::ChannelMask{0}, ""); }), "none/a.exr"));
}
#endif

TEST_CASE("A Cinema table has the angles and the picture of each frame", "[output]")
{
    const test::TemporaryFolder folder;
    View view;
    view.azimuth = -90;
    view.elevation = 12.5f;
    writeCinema(folder / "data.csv", view, {"a_0.png", "a_1.png", "a_2.png", "a_3.png"});
    CHECK(textOf(folder / "data.csv")
          == "phi,theta,FILE\n270,12.5,a_0.png\n0,12.5,a_1.png\n90,12.5,a_2.png\n180,12.5,a_3.png\n");
}

TEST_CASE("Progress says how much there is in all, and for how long", "[output]")
{
    CHECK(progressText(1, 8, 130, 260, 12) == "frame 2 of 8, 130 of 260 tiles of this rank, 12 s, 52 s to go");
    CHECK(progressText(0, 1, 300, 260, 5) == "frame 1 of 1, 300 of 300 tiles of this rank, 5 s, 0 s to go");
    CHECK(progressText(0, 1, 0, 0, 5) == "frame 1 of 1, 0 of 1 tiles of this rank, 5 s");
}

TEST_CASE("The options of a run are read again as they were", "[options][config]")
{
    const test::TemporaryFolder folder;
    const std::vector<std::string> words{"a.ply:color=#ff8000:opacity=0.5",
                                         "b c_4x4x4_uint8.raw",
                                         "--size",
                                         "300x200",
                                         "--spp",
                                         "3",
                                         "--mode",
                                         "mixed",
                                         "--replicate",
                                         "3",
                                         "--shadows",
                                         "--background",
                                         "0,0.25,1",
                                         "--range",
                                         "1%,99.5%",
                                         "--up=-z",
                                         "--azimuth",
                                         "-33.25",
                                         "--output",
                                         "o \"x\" #1_%02d.png"};
    const ParsedOptions first = parse(words);
    INFO(first.message);
    REQUIRE(first.options);
    const std::string path = folder.write("run.json", optionsText(first.options->scene, first.options->given));
    const ParsedOptions again = parse({"--config", path});
    INFO(textOf(path) << again.message);
    REQUIRE(again.options);
    CHECK(again.options->values == first.options->values);
    CHECK(again.options->scene == first.options->scene);
    CHECK(again.options->shadows);
    CHECK(again.options->view.up.z == -1.0f);
    CHECK(optionsText(again.options->scene, again.options->given)
          == optionsText(first.options->scene, first.options->given));
    // Options of the command line take precedence. A TOML file works as well.
    const ParsedOptions other = parse({"--config", path, "--spp", "5"});
    REQUIRE(other.options);
    CHECK(other.options->passes == 5);
    const std::string toml =
        folder.write("run.toml", "scene = [\"a.ply\", \"b.xyz\"]\nspp = 4\nshadows = true\nsize = \"30x20\"\n");
    const ParsedOptions read = parse({"--config", toml});
    INFO(read.message);
    REQUIRE(read.options);
    CHECK(read.options->scene == std::vector<std::string>{"a.ply", "b.xyz"});
    CHECK(read.options->passes == 4);
    CHECK(read.options->shadows);
    CHECK(read.options->width == 30);
    // A flag that is false is as if it were not given.
    const ParsedOptions off =
        parse({"demo", "--config", folder.write("off", "{\"shadows\": false, \"dither\": false}")});
    INFO(off.message);
    REQUIRE(off.options);
    CHECK_FALSE(off.options->shadows);
    CHECK(test::contains(optionsText(off.options->scene, off.options->given), "\"shadows\": false"));
    // A name that reads like a number stays as it is written.
    CHECK(test::contains(optionsText({"demo"}, {{"aux", "1.10"}, {"spp", "4"}}), "\"aux\": \"1.10\""));
    for (const char* empty : {"{\"spp\": []}", "spp = []\n"}) {
        const ParsedOptions parsed = parse({"demo", "--config", folder.write("empty", empty)});
        INFO(parsed.message);
        CHECK(parsed.exitCode == 2);
        CHECK(test::contains(parsed.message, "--config: spp: the list is empty"));
    }
    const ParsedOptions named = parse({"c.ply", "--config", toml});
    REQUIRE(named.options);
    CHECK(named.options->scene == std::vector<std::string>{"c.ply"});
    for (const char* wrong : {"{", "{\"spp\": 0}", "{\"sppp\": 1}", "{\"spp\": null}", "{\"spp\": {}}",
                              "{\"scene\": [[]]}", "sppp = 1", "spp = many"}) {
        const ParsedOptions parsed = parse({"demo", "--config", folder.write("wrong", wrong)});
        INFO(wrong << ": " << parsed.message);
        CHECK_FALSE(parsed.options);
        CHECK(parsed.exitCode == 2);
        CHECK(isLineWith(parsed.message, "dfb_render: "));
    }
    CHECK(parse({"demo", "--config", folder / "missing"}).exitCode == 2);
}

} // namespace picture_file_cases
