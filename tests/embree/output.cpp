// The files that the bundled renderer writes, read back.
#include "support.hpp"

#include <output.hpp>

#include <nlohmann/json.hpp>
#include <png.h>
#include <sys/stat.h>

#include <dfb/image.hpp>

#include <cmath>
#include <cstdint>
#include <filesystem>
#include <limits>
#include <random>
#include <sstream>
#include <string>
#include <vector>

namespace output_cases {

using namespace example;
using test::errorOf;
using test::isLineWith;

namespace {

// Premultiplied RGBA with values that 8 bits cannot distinguish, values above 1, and the smallest positive one.
std::vector<float> pixels(int width, int height)
{
    std::mt19937 random(7);
    std::vector<float> rgba(static_cast<std::size_t>(4 * width * height));
    for (float& value : rgba)
        value = static_cast<float>(random() >> 8) * 0x1.0p-24f;
    rgba[0] = std::numeric_limits<float>::denorm_min();
    rgba[1] = 1.5f;
    rgba[2] = 0.0f;
    return rgba;
}

struct Pfm {
    std::string kind;
    int width = 0, height = 0;
    double scale = 0;
    std::vector<float> values; // row 0 on top
};

Pfm readPfm(const std::string& path)
{
    std::ifstream stream(path, std::ios::binary);
    Pfm pfm;
    stream >> pfm.kind >> pfm.width >> pfm.height >> pfm.scale;
    REQUIRE(stream);
    REQUIRE(stream.get() == '\n');
    const std::size_t row = static_cast<std::size_t>((pfm.kind == "PF" ? 3 : 1) * pfm.width);
    pfm.values.resize(row * static_cast<std::size_t>(pfm.height));
    for (int y = pfm.height - 1; y >= 0; --y)
        stream.read(reinterpret_cast<char*>(pfm.values.data() + row * static_cast<std::size_t>(y)),
                    static_cast<std::streamsize>(4 * row));
    REQUIRE(stream);
    CHECK(stream.get() == std::ifstream::traits_type::eof());
    return pfm;
}

// The bytes of the file, converted to this format.
std::vector<std::uint8_t> readPng(const std::string& path, int& width, int& height, png_uint_32 format = PNG_FORMAT_RGB)
{
    png_image image{};
    image.version = PNG_IMAGE_VERSION;
    REQUIRE(png_image_begin_read_from_file(&image, path.c_str()) != 0);
    CHECK(image.format == format);
    std::vector<std::uint8_t> bytes(PNG_IMAGE_SIZE(image));
    REQUIRE(png_image_finish_read(&image, nullptr, bytes.data(), 0, nullptr) != 0);
    width = static_cast<int>(image.width);
    height = static_cast<int>(image.height);
    return bytes;
}

// Uses the formula of the curve, not the thresholds that the library compares with.
double srgbOf(double linear)
{
    return linear <= 0.0031308 ? 12.92 * linear : 1.055 * std::pow(linear, 1 / 2.4) - 0.055;
}
double linearOf(double srgb) { return srgb <= 0.04045 ? srgb / 12.92 : std::pow((srgb + 0.055) / 1.055, 2.4); }

RunStats someStats()
{
    RunStats stats;
    stats.scene = {"a.ply", "b.xyz"};
    stats.options = {{"spp", "4"}, {"mode", "data"}, {"opacity", "0.6"}, {"dither", "true"}, {"size", "640x480"}};
    stats.version = "1.2.3";
    // Rank 1 waits least.
    stats.ranks = {{{10, 20, 60, 5}, 95, 2, 100}, {{30, 50.5, 14.5, 0}, 95, 3, 5000000000u}, {{1, 2, 92, 0}, 95, 2, 0}};
    stats.transport = "inproc";
    stats.mode = "data";
    stats.width = 640;
    stats.height = 480;
    stats.imageHash = "00ff00ff00ff00ff";
    stats.meanAlpha = 0.25;
    stats.frames.resize(2);
    stats.frames[0].ranks.resize(3);
    stats.frames[1].ranks = {{{0, 10.25, 1.125, 2}, 5, 600}, {{0, 1, 10.5, 0}, 7, 800}, {{0, 2, 9.25, 0}, 0, 0}};
    stats.frames[1].report.bytesSent = 5000000000;
    stats.frames[1].report.messagesSent = 77;
    stats.frames[1].report.tilesTotal = 80;
    stats.frames[1].report.tilesTouched = 70;
    stats.frames[1].report.peakMemoryBytes = 6000000000;
    return stats;
}

} // namespace

TEST_CASE("A PFM is read back equal", "[output]")
{
    const test::TemporaryFolder folder;
    for (const auto& [width, height] : {std::pair{7, 5}, std::pair{1, 1}, std::pair{300, 2}}) {
        const std::vector<float> rgba = pixels(width, height);
        writePfm(folder / "color.pfm", width, height, rgba.data());
        writeGreyPfm(folder / "alpha.pfm", width, height, rgba.data() + 3, 4);
        const Pfm color = readPfm(folder / "color.pfm"), alpha = readPfm(folder / "alpha.pfm");
        CHECK(color.kind == "PF");
        CHECK(alpha.kind == "Pf");
        CHECK(color.scale == -1.0); // little-endian
        CHECK(alpha.scale == -1.0);
        for (const Pfm* pfm : {&color, &alpha}) {
            CHECK(pfm->width == width);
            CHECK(pfm->height == height);
        }
        std::vector<float> expectedColor, expectedAlpha;
        for (std::size_t i = 0; i < rgba.size(); ++i)
            (i % 4 == 3 ? expectedAlpha : expectedColor).push_back(rgba[i]);
        CHECK(color.values == expectedColor);
        CHECK(alpha.values == expectedAlpha);
    }
    const std::vector<float> depth{1, 2, std::numeric_limits<float>::infinity(), 4, 5, 6};
    writeGreyPfm(folder / "depth.pfm", 3, 2, depth.data(), 1);
    CHECK(readPfm(folder / "depth.pfm").values == depth);
}

TEST_CASE("A PNG holds the pixels that the library converts to sRGB", "[output]")
{
    const test::TemporaryFolder folder;
    const int width = 61, height = 33;
    const std::vector<float> rgba = pixels(width, height);
    std::vector<std::uint8_t> srgba(rgba.size());
    dfb::convertPixels(rgba.data(), width * height, dfb::OutputFormat::SRGBA8,
                       reinterpret_cast<std::byte*>(srgba.data()));
    writePng(folder / "image.png", width, height, srgba.data(), false);

    int gotWidth = 0, gotHeight = 0;
    const std::vector<std::uint8_t> rgb = readPng(folder / "image.png", gotWidth, gotHeight);
    CHECK(gotWidth == width);
    CHECK(gotHeight == height);
    std::vector<std::uint8_t> expected;
    for (std::size_t i = 0; i < srgba.size(); ++i)
        if (i % 4 != 3)
            expected.push_back(srgba[i]);
    CHECK(rgb == expected);
}

TEST_CASE("A PNG with alpha has straight colours, each the nearest level", "[output]")
{
    const test::TemporaryFolder folder;
    const int width = 256, height = 40;
    std::vector<float> rgba = pixels(width, height);
    for (std::size_t i = 0; i < rgba.size(); i += 4) // most colours are at most alpha, the others are unchanged
        for (std::size_t c = i; c < i + 3; ++c)
            rgba[c] *= i % 16 != 0 ? rgba[i + 3] : 1;
    const float nan = std::numeric_limits<float>::quiet_NaN();
    const std::vector<float> special{1,    0.5f, 0,   0,     -1, 0.5f,  2,     0.5f, 0.25f, 0.5f, 1,
                                     1,    0.5f, 1,   2,     2,  1e-9f, 2e-9f, 0,    1e-8f, 0.5f, 0.5f,
                                     0.5f, -1,   nan, 0.25f, 0,  0.5f,  1,     1,    1,     nan};
    std::copy(special.begin(), special.end(), rgba.begin());
    const auto straight = straightPixels(width, height, rgba.data(), false);
    writePng(folder / "image.png", width, height, straight.data(), true);
    int gotWidth = 0, gotHeight = 0;
    CHECK(readPng(folder / "image.png", gotWidth, gotHeight, PNG_FORMAT_RGBA) == straight);
    CHECK(gotWidth == width);
    CHECK(gotHeight == height);

    const std::vector<int> expected{0,  0,   0, 0, 0, 255, 255, 128, 137, 188, 255, 255, 188, 255, 255, 255,
                                    89, 124, 0, 0, 0, 0,   0,   0,   0,   188, 0,   128, 0,   0,   0,   0};
    CHECK(std::vector<int>(straight.begin(), straight.begin() + 32) == expected);

    std::size_t wrong = 0;
    for (std::size_t i = 32; i < rgba.size(); i += 4) {
        const double alpha = static_cast<double>(rgba[i + 3]);
        wrong += std::abs(straight[i + 3] - 255 * alpha) > 0.5 + 1e-9;
        for (std::size_t c = i; c < i + 3; ++c) {
            const double color = std::min(static_cast<double>(rgba[c]) / alpha, 1.0);
            // The nearest level. The curve above is exact to 1e-9 levels, except for a kink of 1e-6 at its foot.
            wrong += std::abs(straight[c] - 255 * srgbOf(color)) > 0.5 + 1e-5;
        }
    }
    CHECK(wrong == 0);
}

TEST_CASE("Dithered colours with alpha keep their mean, also below alpha", "[output]")
{
    // Each block of 8x8 pixels has one colour. Its mean, in linear light, is within 1/64 of a level.
    const int width = 64, height = 8;
    for (const float alpha : {1.0f, 0.7f, 0.25f}) {
        std::vector<float> rgba;
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x)
                for (const float color : {0.3f, 0.01f * static_cast<float>(x / 8), 0.9f, 1.0f})
                    rgba.push_back(alpha * color);
        const auto straight = straightPixels(width, height, rgba.data(), true);
        for (int block = 0; block < 8; ++block)
            for (std::size_t c = 0; c < 3; ++c) {
                double mean = 0;
                int least = 255, most = 0;
                for (int y = 0; y < 8; ++y)
                    for (int x = 0; x < 8; ++x) {
                        const int level = straight[4 * static_cast<std::size_t>(y * width + 8 * block + x) + c];
                        mean += linearOf(level / 255.0) / 64;
                        least = std::min(least, level);
                        most = std::max(most, level);
                    }
                const std::size_t first = 4 * static_cast<std::size_t>(8 * block);
                CHECK(straight[first + 3] == static_cast<int>(std::lround(255 * static_cast<double>(alpha))));
                const double color = static_cast<double>(rgba[first + c]) / static_cast<double>(rgba[first + 3]);
                const double step = linearOf(most / 255.0) - linearOf(least / 255.0);
                CHECK(most - least <= 1);
                CHECK(std::abs(mean - color) <= step / 64 + 1e-6);
            }
    }
}

TEST_CASE("The hash is that of the floats", "[output]")
{
    // Values of XXH3 with 64 bits, from its specification and from xxhsum.
    CHECK(hashPixels(nullptr, 0) == "2d06800538d394c2");
    const std::vector<float> one{0.25f, 0.5f, 0.75f, 1.0f};
    CHECK(hashPixels(one.data(), 1) == "4de916efb99ec738");
    std::vector<float> many(4 * 1000);
    for (std::size_t i = 0; i < many.size(); ++i)
        many[i] = static_cast<float>(i) / 4096.0f;
    const std::string hash = hashPixels(many.data(), 1000);
    CHECK(hash == "84a6bbf09ce29fc9");

    // Every bit of every channel counts, and so does the order.
    for (const std::size_t i : {0, 1, 2, 3, 1999, 3999}) {
        std::vector<float> other = many;
        other[i] = std::nextafter(other[i], 2.0f);
        CHECK(hashPixels(other.data(), 1000) != hash);
    }
    std::swap(many[40], many[44]);
    CHECK(hashPixels(many.data(), 1000) != hash);
    CHECK(hashPixels(many.data(), 999) != hash);
}

TEST_CASE("The mean of alpha", "[output]")
{
    const std::vector<float> rgba{9, 9, 9, 0.25f, 9, 9, 9, 0.75f, 0, 0, 0, 0.5f, 9, 9, 9, 0};
    CHECK(meanAlpha(rgba.data(), 4) == 0.375);
    CHECK(meanAlpha(nullptr, 0) == 0.0);
}

TEST_CASE("The statistics have every field that a reader of them looks for", "[output]")
{
    const test::TemporaryFolder folder;
    writeStats(folder / "stats.json", someStats());
    std::ifstream stream(folder / "stats.json");
    const nlohmann::json json = nlohmann::json::parse(stream);
    CHECK(json.at("ranks") == 3);
    CHECK(json.at("transport") == "inproc");
    CHECK(json.at("mode") == "data");
    CHECK(json.at("width") == 640);
    CHECK(json.at("height") == 480);
    CHECK(json.at("image_hash") == "00ff00ff00ff00ff");
    CHECK(json.at("mean_alpha") == 0.25);
    CHECK(json.at("version") == "1.2.3");
    CHECK(json.at("scene") == nlohmann::json{"a.ply", "b.xyz"});
    CHECK(json.at("options").at("spp") == 4);
    CHECK(json.at("options").at("mode") == "data");
    CHECK(json.at("options").at("opacity") == 0.6);
    CHECK(json.at("options").at("dither") == true);
    CHECK(json.at("options").at("size") == "640x480");
    CHECK(json.at("threads_of_ranks") == nlohmann::json{2, 3, 2});
    CHECK(json.at("bytes_read_of_ranks") == nlohmann::json{100, 5000000000u, 0});
    CHECK(json.at("slowest_rank") == 1);
    CHECK(json.at("total_ms") == 95);
    CHECK(json.at("load_ms") == 30);
    CHECK(json.at("render_ms") == 50.5);
    CHECK(json.at("compositing_ms") == 14.5);
    CHECK(json.at("write_ms") == 0);
    CHECK(json.at("total_ms_of_ranks") == nlohmann::json{95, 95, 95});
    CHECK(json.at("load_ms_of_ranks") == nlohmann::json{10, 30, 1});
    CHECK(json.at("render_ms_of_ranks") == nlohmann::json{20, 50.5, 2});
    CHECK(json.at("compositing_ms_of_ranks") == nlohmann::json{60, 14.5, 92});
    CHECK(json.at("write_ms_of_ranks") == nlohmann::json{5, 0, 0});
    REQUIRE(json.at("frames").is_array());
    REQUIRE(json.at("frames").size() == 2);
    for (const auto& frame : json.at("frames"))
        for (const char* name : {"total_ms", "render_ms", "compositing_ms", "write_ms", "bytes_sent", "messages_sent",
                                 "tiles_total", "tiles_touched", "peak_memory_bytes"})
            CHECK(frame.at(name).is_number());
    const auto& frame = json.at("frames").at(1);
    CHECK(frame.at("slowest_rank") == 0);
    CHECK(frame.at("total_ms") == 13.375);
    CHECK(frame.at("render_ms") == 10.25);
    CHECK(frame.at("compositing_ms") == 1.125);
    CHECK(frame.at("write_ms") == 2);
    CHECK(frame.at("total_ms_of_ranks") == nlohmann::json{13.375, 11.5, 11.25});
    CHECK(frame.at("render_ms_of_ranks") == nlohmann::json{10.25, 1, 2});
    CHECK(frame.at("compositing_ms_of_ranks") == nlohmann::json{1.125, 10.5, 9.25});
    CHECK(frame.at("tiles_rendered") == nlohmann::json{5, 7, 0});
    CHECK(frame.at("work_of_ranks") == nlohmann::json{600, 800, 0});
    CHECK(frame.at("bytes_sent") == 5000000000u);
    CHECK(frame.at("messages_sent") == 77);
    CHECK(frame.at("tiles_total") == 80);
    CHECK(frame.at("tiles_touched") == 70);
    CHECK(frame.at("peak_memory_bytes") == 6000000000u);
}

TEST_CASE("What cannot be written is an error that names the file", "[output]")
{
    const test::TemporaryFolder folder;
    std::filesystem::create_directory(folder / "folder");
    const std::vector<float> rgba = pixels(64, 64);
    const std::vector<std::uint8_t> srgba(rgba.size());
    std::vector<std::string> paths{folder / "none/x", folder / "folder", ""};
    const std::string full = "/dev/full"; // opens, but fails when it is written to
    if (std::filesystem::exists(full))
        paths.push_back(full);
    for (const std::string& path : paths) {
        INFO(path);
        const std::string why = path + ": cannot be written: ";
        CHECK(isLineWith(errorOf([&] { writePfm(path, 64, 64, rgba.data()); }), why));
        CHECK(isLineWith(errorOf([&] { writeGreyPfm(path, 64, 64, rgba.data(), 4); }), why));
        CHECK(isLineWith(errorOf([&] { writePng(path, 64, 64, srgba.data(), true); }), why));
        CHECK(isLineWith(errorOf([&] { writePng16(path, 64, 64, rgba.data(), false); }), why));
        CHECK(isLineWith(errorOf([&] { writeStats(path, someStats()); }), why));
        if (path != full)
            CHECK(isLineWith(errorOf([&] { requireWritable(path); }), why));
    }
    CHECK(std::filesystem::is_directory(folder / "folder"));
    if (paths.back() == full)
        CHECK(std::filesystem::exists(full));
}

TEST_CASE("To ask whether a file can be written leaves all as it is", "[output]")
{
    const test::TemporaryFolder folder;
    requireWritable(folder / "new");
    CHECK_FALSE(std::filesystem::exists(folder / "new"));
    const std::string old = folder.write("old", "text");
    requireWritable(old);
    std::string text;
    std::ifstream(old) >> text;
    CHECK(text == "text");
    const std::filesystem::path link = folder / "link";
    std::filesystem::create_symlink("nothing", link);
    requireWritable(link.string());
    CHECK(std::filesystem::is_symlink(link));
    CHECK_FALSE(std::filesystem::exists(folder / "nothing"));
    const std::string pipe = folder / "pipe";
    REQUIRE(mkfifo(pipe.c_str(), 0600) == 0);
    requireWritable(pipe); // returns, though nobody reads
}

} // namespace output_cases
