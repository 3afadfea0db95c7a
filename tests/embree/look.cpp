// How files are shown: transfer functions, ranges, isosurfaces, clip boxes, colour, opacity and placement.
#include "support.hpp"
#include "together.hpp"

#include <auto_look.hpp>
#include <generated.hpp>
#include <look_options.hpp>
#include <rank_scene.hpp>

#include <dfb/tile.hpp>

#include <cmath>
#include <cstring>
#include <memory>
#include <random>
#include <string>
#include <vector>

namespace look_cases {

using namespace example;
using test::errorOf;
using test::isLineWith;

namespace {

using Tile = dfb::Tile<dfb::allChannels & ~dfb::farChannel, 64>;

RenderSettings settingsFor(float azimuth = 30)
{
    RenderSettings settings;
    settings.width = settings.height = 64;
    settings.opacity = 1;
    settings.view.azimuth = azimuth;
    return settings;
}

std::unique_ptr<Tile> render(const Scene& scene, const Box& cell, const RenderSettings& settings)
{
    auto tile = std::make_unique<Tile>();
    tile->region = {0, 0, 64, 64};
    tile->clear();
    Renderer(loadBrick(scene, cell, ghostReach(SceneInfo(scene), settings)), SceneInfo(scene), settings)
        .renderTile(*tile, 0);
    return tile;
}

int coveredPixels(const Tile& tile)
{
    int count = 0;
    for (int i = 0; i < 64 * 64; ++i)
        count += tile.color[4 * i + 3] > 0;
    return count;
}

// Number of pixels at which not exactly one part of an opaque picture equals the whole picture, bit for bit, in all
// channels.
int wrongPixels(const Tile& whole, const std::vector<std::unique_ptr<Tile>>& parts)
{
    int wrong = 0;
    for (int i = 0; i < 64 * 64; ++i) {
        const Tile* front = nullptr;
        for (const auto& part : parts)
            if (part->color[4 * i + 3] > 0 && (!front || part->depth[i] < front->depth[i]))
                front = part.get();
        if (!front) {
            wrong += whole.color[4 * i + 3] > 0;
            continue;
        }
        wrong += std::memcmp(front->color + 4 * i, whole.color + 4 * i, 4 * sizeof(float)) != 0
                 || front->depth[i] != whole.depth[i]
                 || std::memcmp(front->normal + 3 * i, whole.normal + 3 * i, 3 * sizeof(float)) != 0
                 || front->primitiveId[i] != whole.primitiveId[i] || front->instanceId[i] != whole.instanceId[i];
    }
    return wrong;
}

// 33^3 voxels with 8 times the distance from the middle, up to 255. Isosurfaces are spheres.
VolumeSource ballVolume(const FileLook& choice)
{
    VolumeSource source = example::detail::generatedVolume({33, 33, 33}, [](int x, int y, int z) {
        const float r =
            length(Vec3{static_cast<float>(x - 16), static_cast<float>(y - 16), static_cast<float>(z - 16)});
        return std::min(1.0f, 8 * r / 255);
    });
    source.name = "ball";
    source.look = lookOf(source, choice, {});
    return source;
}

FileLook lookWith(const std::vector<std::pair<std::string, std::string>>& settings)
{
    FileLook look;
    for (const auto& [key, value] : settings)
        CHECK(setLook(look, key, value));
    return look;
}

Mesh square()
{
    Mesh mesh;
    mesh.positions = {{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}};
    mesh.triangles = {{0, 1, 2}, {0, 2, 3}};
    return mesh;
}

std::string bytesOf(const std::vector<std::uint16_t>& values)
{
    return std::string(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(std::uint16_t));
}

} // namespace

// ---- words of the command line --------------------------------------------------------------------------------------

TEST_CASE("What stands behind a file's name says how it is shown", "[look]")
{
    const std::vector<std::string> endings{".raw", ".ply"};
    const SceneFile file =
        parseSceneFile("a:b.ply:color=0.8,0.2,0.1:opacity=0.5:translate=0,0,-1:scale=2:rotate=0,90,0:"
                       "clip=0,0,0,1,1,.5",
                       endings);
    CHECK(file.path == "a:b.ply");
    REQUIRE(file.look.color);
    CHECK(file.look.color->x == Approx(0.6038f).epsilon(1e-3)); // linear
    CHECK(file.look.opacity == 0.5f);
    CHECK(file.look.translate.z == -1.0f);
    CHECK(file.look.scale == 2.0f);
    CHECK(file.look.rotate.y == 90.0f);
    REQUIRE(file.look.clip);
    CHECK(file.look.clip->hi.z == 0.5f);
    CHECK(parseSceneFile("v.raw:transfer=viridis:range=1%,200:isovalue=3,-1,3", endings).look.isovalues
          == std::vector<float>{-1, 3});
    CHECK(parseSceneFile("a.ply:color=#ff8000", endings).look.color->x == 1.0f);
    // Paths with colons, some of which look like settings.
    for (const char* path : {"a.ply", "c:/d.ply", "a.ply:opacity=0.5.ply", "x:color=1,1,1.raw", "a=b.ply", "a.ply:b"}) {
        CHECK(parseSceneFile(path, endings).path == path);
        CHECK_FALSE(parseSceneFile(path, endings).look.color);
    }
    CHECK(parseSceneFile("a:opacity=0.1.ply:opacity=0.5", endings).path == "a:opacity=0.1.ply");
}

TEST_CASE("Wrong settings of a file are refused in one line that names them", "[look]")
{
    for (const char* wrong : {"colour=1,1,1",      "color=1,1",    "color=1,1,2",    "color=#12345",
                              "color=#12345g",     "color=",       "opacity=2",      "opacity=nan",
                              "opacity=",          "scale=0",      "scale=-1",       "translate=1,1",
                              "translate=1,1,inf", "rotate=x",     "clip=0,0,0,1,1", "clip=0,0,0,1,1,0",
                              "range=1",           "range=2,1",    "range=1,1",      "range=1%,101%",
                              "range=50%,1%",      "isovalue=",    "isovalue=1,,2",  "isovalue=nan",
                              "transfer=",         "opacity=0.5x", "opacity= 0.5",   "=1",
                              "translate=0,0,2e15"}) {
        const std::string error = errorOf([&] { parseSceneFile(std::string("v.raw:") + wrong, {".raw"}); });
        INFO(wrong << ": " << error);
        CHECK(isLineWith(error, wrong));
    }
}

TEST_CASE("A run's look holds where a file says nothing", "[look]")
{
    const FileLook run = lookWith({{"transfer", "grey"}, {"range", "1,2"}, {"clip", "0,0,0,1,1,1"}});
    CHECK(merged({}, run).transfer == "grey");
    CHECK(merged(lookWith({{"transfer", "bone"}}), run).transfer == "bone");
    CHECK(merged(lookWith({{"transfer", "auto"}}), run).transfer == "auto");
    CHECK(merged(lookWith({{"range", "3,4"}}), run).range->front().value == 3.0f);
    CHECK(merged({}, run).clip);
}

// ---- transfer functions ---------------------------------------------------------------------------------------------

TEST_CASE("Colour maps are those of their names", "[look][transfer]")
{
    // Published values at a quarter, a half and three quarters. Between control points they are within 7 of 255.
    struct Known {
        const char* name;
        float at;
        std::uint32_t color;
    };
    for (const Known& known : {Known{"viridis", 0, 0x440154},
                               {"viridis", 0.5f, 0x21918c},
                               {"viridis", 1, 0xfde725},
                               {"viridis", 0.1f, 0x482475},
                               {"inferno", 0.5f, 0xbc3754},
                               {"inferno", 0.9f, 0xf6d746},
                               {"cool-warm", 0, 0x3b4cc0},
                               {"cool-warm", 0.5f, 0xdddddd},
                               {"cool-warm", 1, 0xb40426},
                               {"grey", 1, 0xffffff}}) {
        INFO(known.name << " at " << known.at);
        const auto& maps = colorMaps();
        const auto map = std::find_if(maps.begin(), maps.end(),
                                      [&](const ColorMap& m) { return std::string(m.name) == known.name; });
        REQUIRE(map != maps.end());
        const TransferPoint p = at(example::detail::pointsOf(*map, 1, 1), known.at);
        const Vec3 shown = example::detail::displayOf({p.r, p.g, p.b}),
                   expected = example::detail::colorOf(known.color);
        for (int c = 0; c < 3; ++c)
            CHECK(std::fabs(component(shown, c) - component(expected, c)) < 7.5f / 255);
    }
}

TEST_CASE("The opacity of a transfer function is that of a length, whatever the step", "[look][transfer]")
{
    const TransferPoints points{{0, 1, 1, 1, 0.3f}, {1, 1, 1, 1, 0.3f}};
    for (const float step : {0.25f, 0.5f, 1.0f, 2.0f}) {
        const float alpha = TransferFunction(step, points)(0.5f).alpha;
        CHECK(std::pow(1 - alpha, 1 / step) == Approx(0.7f).epsilon(1e-4));
    }
}

TEST_CASE("A transfer function shows a peak as narrow as one value of 16 bits", "[look][transfer]")
{
    const auto at = [](float value) { return value / 65535; };
    const TransferFunction narrow(1, {{0, 1, 1, 1, 0},
                                      {at(30044), 1, 1, 1, 0},
                                      {at(30045), 1, 1, 1, 0.5f},
                                      {at(30046), 1, 1, 1, 0},
                                      {1, 1, 1, 1, 0}});
    CHECK(narrow(at(30045)).alpha
          == Approx(0.5f).epsilon(0.15)); // 4 entries from 0 to 0.5: the peak may be between two
    CHECK(narrow(at(30040)).alpha == 0.0f);
    CHECK_FALSE(narrow.isTransparent(at(30045), at(30045)));
    CHECK(narrow.isTransparent(at(30000), at(30040)));
}

TEST_CASE("A transfer function is read from JSON", "[look][transfer]")
{
    const TransferFile data = parseTransfer(
        R"({"points": [{"value": -10, "color": "#ff0000", "opacity": 0}, {"value": 30, "color": [0, 1, 0.5], "opacity": 0.25}]})",
        "t.json");
    CHECK(data.range == std::vector<float>{-10, 30});
    CHECK(data.points[0].value == 0.0f);
    CHECK(data.points[1].value == 1.0f);
    CHECK(data.points[1].b == Approx(0.5f).margin(1e-4));
    CHECK(data.points[1].opacity == 0.25f);
    const std::string two = R"("points": [{"value": 0, "color": [0, 0, 0], "opacity": 0},
                                          {"value": 1, "color": [1, 1, 1], "opacity": 1}])";
    CHECK(parseTransfer("{\"range\": [5, 9], " + two + "}", "t.json").range == std::vector<float>{5, 9});
    CHECK(parseTransfer("{\"range\": \"auto\", " + two + "}", "t.json").range.empty());
    for (
        const std::string& wrong : std::vector<std::string>{
            "", "{", "[]", "{}", R"({"points": []})", R"({"points": [1, 2]})", "{\"colour\": 1, " + two + "}",
            "{\"range\": [9, 5], " + two + "}",
            R"({"range": [0, 9], "points": [{"value": 0, "color": [0,0,0], "opacity": 0}, {"value": 9, "color": [0,0,0], "opacity": 1}]})",
            "{\"range\": 5, " + two + "}",
            R"({"points": [{"value": 1, "color": [0,0,0], "opacity": 0}, {"value": 1, "color": [0,0,0], "opacity": 0}]})",
            R"({"points": [{"value": -3e38, "color": [0,0,0], "opacity": 0}, {"value": 3e38, "color": [0,0,0], "opacity": 0}]})",
            R"({"points": [{"value": 0, "color": [0,0,0], "opacity": 0}, {"value": 1, "color": [0,0,2], "opacity": 0}]})",
            R"({"points": [{"value": 0, "color": [0,0,0], "opacity": 0}, {"value": 1, "color": [0,0,1], "opacity": 2}]})",
            R"({"points": [{"value": 0, "color": [0,0,0], "opacity": 0}, {"value": 1, "color": "red", "opacity": 1}]})",
            R"({"points": [{"value": 0, "color": [0,0,0], "opacity": 0}, {"color": [0,0,0], "opacity": 1}]})",
            R"({"points": [{"value": 0, "color": [0,0,0], "opacity": 0, "alpha": 1}, {"value": 1, "color": [0,0,0], "opacity": 1}]})"}) {
        INFO(wrong);
        CHECK(isLineWith(errorOf([&] { parseTransfer(wrong, "t.json"); }), "t.json: "));
    }
}

TEST_CASE("The background of a histogram ends behind its peak", "[look][transfer]")
{
    std::mt19937 random(1);
    std::normal_distribution<float> noise(100, 10), tissue(1060, 25), bright(1800, 200);
    Histogram scan(0, 2, 2048);
    for (int i = 0; i < 100000; ++i)
        scan.add(i % 10 < 6 ? noise(random) : i % 10 < 9 ? tissue(random) : bright(random));
    const float end = scan.lowerEdge(scan.endOfBackground());
    CHECK(end > 115.0f); // of the noise 93 % is below that
    CHECK(end < 400.0f); // and nothing of the tissue
    CHECK(scan.quantile(0.5) == Approx(110).margin(10));
    CHECK(scan.quantile(0.998, scan.endOfBackground()) > 1900.0f);
    Histogram flat(0, 1, 256);
    for (int i = 0; i < 25600; ++i)
        flat.add(static_cast<float>(i % 256));
    CHECK(flat.endOfBackground() == 0);
    CHECK(flat.quantile(0.25) == Approx(64));
}

TEST_CASE("The default look is the same on any number of ranks, and hides the noise", "[look][transfer]")
{
    const test::TemporaryFolder folder;
    std::mt19937 random(2);
    std::normal_distribution<double> noise(30, 8);
    std::vector<std::uint16_t> voxels;
    for (int z = 0; z < 40; ++z)
        for (int y = 0; y < 70; ++y)
            for (int x = 0; x < 50; ++x) {
                const bool inside = std::hypot(x - 25, y - 35, z - 20) < 15;
                voxels.push_back(
                    static_cast<std::uint16_t>(std::max(0.0, noise(random) + (inside ? 1000 + 10 * x : 0))));
            }
    const std::string file = folder.write("scan_50x70x40_uint16.raw", bytesOf(voxels));
    for (const char* name : {"", "viridis", "cool-warm", "bone", "soft-tissue"}) {
        FileLook choice;
        choice.transfer = name;
        const auto describe = [&](const Loaders& loaders) {
            const VolumeLook look =
                openVolume(file, loaders, {}, [&](const VolumeSource& s) { return lookOf(s, choice, loaders); }).look;
            std::string text = std::to_string(look.lo) + ' ' + std::to_string(look.hi);
            for (const TransferPoint& p : look.points)
                text += ' ' + std::to_string(p.opacity) + ' ' + std::to_string(p.r);
            return text;
        };
        const std::string alone = describe({});
        INFO(name << ": " << alone.substr(0, 200));
        for (const int ranks : {2, 3})
            for (const std::string& text : test::ofRanks<std::string>(ranks, describe))
                CHECK(text == alone);
    }
    const VolumeSource source = openVolume(file);
    const VolumeLook look = lookOf(source, {}, {});
    CHECK(look.lo > 45.0f);
    CHECK(look.lo < 300.0f);
    CHECK(look.hi > 1200.0f);
    CHECK(at(look.points, 0).opacity == 0.0f);
    CHECK(at(look.points, 1).opacity > 0.01f);
    const VolumeLook set = lookOf(source, lookWith({{"range", "500,50%"}}), {});
    CHECK(set.lo == 500.0f);
    const VolumeLook percent = lookOf(source, lookWith({{"range", "50%,2000"}}), {});
    CHECK(percent.lo == Approx(31).margin(4));
    CHECK(percent.hi == 2000.0f);
    // Hounsfield units: an unsigned file has values that are 1024 higher.
    CHECK(lookOf(source, lookWith({{"transfer", "bone"}}), {}).lo == 0.0f);
    CHECK(lookOf(source, lookWith({{"transfer", "bone"}, {"range", "7,9"}}), {}).lo == 7.0f);
}

TEST_CASE("A volume of which nothing is known looks as a generated one does", "[look][transfer]")
{
    const test::TemporaryFolder folder;
    const VolumeSource blank = openVolume(folder.write("blank_8x8x8_uint8.raw", std::string(512, '\x09')));
    const VolumeLook look = lookOf(blank, {}, {});
    CHECK(look.lo == 0.0f);
    CHECK(look.hi == 255.0f);
    CHECK(at(look.points, 9.0f / 255).opacity == 0.0f);
    CHECK(look.points.size() == emberPoints().size());
}

TEST_CASE("What looks like a body in a scanner is shown as one", "[look][transfer]")
{
    const test::TemporaryFolder folder;
    const auto lookFor = [&](const std::string& name, int air, int tissue, int bone, const FileLook& choice = {}) {
        std::vector<std::uint16_t> voxels;
        for (int i = 0; i < 32 * 32 * 32; ++i) {
            const double r = std::hypot(i % 32 - 16, i / 32 % 32 - 16, i / 1024 - 16);
            voxels.push_back(static_cast<std::uint16_t>((r < 5 ? bone : r < 13 ? tissue : air) + i % 7));
        }
        return lookOf(openVolume(folder.write(name + "_32x32x32_uint16.raw", bytesOf(voxels))), choice, {});
    };
    const VolumeLook head = lookFor("head", 10, 1060, 1900);
    CHECK(head.lo == 0.0f);
    CHECK(head.hi == 4095.0f);
    CHECK(head.isTomography);
    CHECK(lookFor("bone", 10, 1060, 1900, lookWith({{"transfer", "bone"}})).isTomography);
    CHECK(lookFor("dim", 10, 500, 1900).hi < 2000.0f); // has no water
    CHECK_FALSE(lookFor("dim", 10, 500, 1900).isTomography);
    CHECK(lookFor("bright", 10, 1060, 60000).lo > 10.0f);
    CHECK(lookFor("set", 10, 1060, 1900, lookWith({{"transfer", "viridis"}})).hi < 2000.0f);
    CHECK(lookFor("range", 10, 1060, 1900, lookWith({{"range", "5,6"}})).hi == 6.0f);
}

TEST_CASE("The middle of a diverging map, where the noise is, is transparent", "[look][transfer]")
{
    std::mt19937 random(3);
    std::normal_distribution<float> noise(0, 1);
    const test::TemporaryFolder folder;
    std::vector<float> voxels;
    for (int i = 0; i < 32 * 32 * 32; ++i) {
        const int x = i % 32, y = i / 32 % 32, z = i / 1024;
        voxels.push_back(noise(random)
                         + (std::hypot(x - 8, y - 16, z - 16) < 6    ? 40.0f
                            : std::hypot(x - 24, y - 16, z - 16) < 6 ? -40.0f
                                                                     : 0.0f));
    }
    const std::string file = folder.write("two_32x32x32_float32.raw",
                                          std::string(reinterpret_cast<const char*>(voxels.data()), 4 * voxels.size()));
    const VolumeLook look = lookOf(openVolume(file), lookWith({{"transfer", "cool-warm"}}), {});
    CHECK(look.lo == -look.hi);
    CHECK(look.hi == Approx(41).margin(3));
    const auto opacity = [&](float value) { return at(look.points, (value - look.lo) * look.scale()).opacity; };
    CHECK(opacity(0) == 0.0f);
    CHECK(opacity(2) == 0.0f);
    CHECK(opacity(-2) == 0.0f);
    CHECK(opacity(38) > 0.01f);
    CHECK(opacity(-38) == Approx(opacity(38)).epsilon(0.05));
}

// ---- isosurfaces ----------------------------------------------------------------------------------------------------

TEST_CASE("An isosurface is where the values are, whole or in bricks, bit for bit", "[look][iso]")
{
    Scene scene;
    scene.add(ballVolume(lookWith({{"isovalue", "80"}})), true);
    for (const float azimuth : {0.0f, 30.0f, 215.0f}) {
        const RenderSettings settings = settingsFor(azimuth);
        const auto whole = render(scene, scene.bounds, settings);
        CHECK(coveredPixels(*whole) > 300);
        int wrong = 0;
        for (int i = 0; i < 64 * 64; ++i) {
            if (!(whole->color[4 * i + 3] > 0))
                continue;
            // The value 80 is 10 voxels from the centre. Interpolation between voxels changes that by less than 0.1.
            const Vec3 p{whole->position[3 * i], whole->position[3 * i + 1], whole->position[3 * i + 2]};
            const Vec3 arm = (p - Vec3{0.5f, 0.5f, 0.5f}) * 32;
            const Vec3 n{whole->normal[3 * i], whole->normal[3 * i + 1], whole->normal[3 * i + 2]};
            wrong += !(std::fabs(length(arm) - 10) < 0.1f) || !(std::fabs(dot(unit(arm), n)) > 0.98f)
                     || whole->primitiveId[i] != 0 || whole->instanceId[i] != 0;
        }
        CHECK(wrong == 0);
        for (const int bricks : {2, 5, 8, 27}) {
            std::vector<std::unique_ptr<Tile>> parts;
            for (const Box& cell : cutScene(scene, bricks))
                parts.push_back(render(scene, cell, settings));
            INFO(bricks << " bricks");
            CHECK(wrongPixels(*whole, parts) == 0);
        }
    }
}

TEST_CASE("Several isosurfaces lie in each other, and opacity lets the inner ones show", "[look][iso]")
{
    Scene opaque, glassy;
    opaque.add(ballVolume(lookWith({{"isovalue", "40,80"}, {"transfer", "viridis"}, {"opacity", "1"}})), true);
    const FileLook look = lookWith({{"isovalue", "40,80"}, {"opacity", "0.5"}});
    glassy.add(ballVolume(look), true);
    const auto front = render(opaque, opaque.bounds, settingsFor());
    const auto both = render(glassy, glassy.bounds, settingsFor());
    const int middle = 64 * 32 + 32;
    CHECK(front->primitiveId[middle] == 1); // 80 is outside
    CHECK(front->color[4 * middle + 3] == 1.0f);
    CHECK(both->color[4 * middle + 3] == Approx(1 - 0.0625).epsilon(1e-5)); // four surfaces
    CHECK(VolumeLook().isovalues.empty());
    CHECK(ballVolume(look).look.hasIsovalueIn(41, 90));
    CHECK_FALSE(ballVolume(look).look.hasIsovalueIn(41, 79));
}

// ---- clip boxes -----------------------------------------------------------------------------------------------------

TEST_CASE("A clip box cuts volumes, meshes and spheres alike", "[look][clip]")
{
    // Half of each scene is left: seen along x, it is half as wide.
    struct Case {
        const char* name;
        Scene whole, half;
    };
    std::vector<Case> cases(4);
    const auto clip = [](float lo, float middle, float hi) {
        FileLook look;
        look.clip.emplace();
        look.clip->lo = {lo, lo, lo};
        look.clip->hi = {hi, hi, middle};
        return look;
    };
    cases[0].name = "volume";
    cases[1].name = "isosurface";
    for (const int i : {0, 1}) {
        FileLook look = lookWith({{"range", "40,200"}});
        FileLook cut = clip(-1, 16, 99);
        if (i == 1)
            look.isovalues = {80};
        cut.isovalues = look.isovalues;
        cut.range = look.range;
        cases[static_cast<std::size_t>(i)].whole.add(ballVolume(look), true, look);
        cases[static_cast<std::size_t>(i)].half.add(ballVolume(cut), true, cut);
    }
    cases[2].name = "mesh";
    Mesh wall = square();
    for (Vec3& p : wall.positions)
        p = {0, p.y, p.x}; // across x
    cases[2].whole.add(wall, true);
    cases[2].half.add(wall, true, clip(-1, 0.5f, 2));
    cases[3].name = "spheres";
    const std::vector<Sphere> ball(1, {{3, 3, 3}, 2, {1, 1, 1}});
    cases[3].whole.add(ball, true);
    cases[3].half.add(ball, true, clip(0, 3, 9));
    for (const Case& c : cases) {
        INFO(c.name);
        RenderSettings settings = settingsFor(90);
        settings.view.elevation = 0;
        settings.view.target = Vec3{0.5f, 0.5f, 0.5f};
        settings.view.eye = Vec3{4, 0.5f, 0.5f};
        const auto whole = render(c.whole, c.whole.bounds, settings), half = render(c.half, c.half.bounds, settings);
        CHECK(coveredPixels(*whole) > 200);
        CHECK(coveredPixels(*half) == Approx(0.5 * coveredPixels(*whole)).epsilon(0.12));
        std::vector<std::unique_ptr<Tile>> parts;
        for (const Box& cell : cutScene(c.half, 5))
            parts.push_back(render(c.half, cell, settings));
        if (std::string(c.name) != "volume") // the volume is not opaque
            CHECK(wrongPixels(*half, parts) == 0);
        // The clipped scene's bounds are smaller, so that the camera sees it larger by default.
        CHECK(c.half.bounds.extent().z < 0.6f * c.whole.bounds.extent().z);
    }
    Scene scene;
    CHECK(isLineWith(errorOf([&] { scene.add(wall, true, clip(5, 6, 7), "wall.ply"); }), "wall.ply: the clip box"));
    CHECK(isLineWith(errorOf([&] { scene.add(ball, true, clip(6, 7, 8), "b.xyz"); }), "from 1,1,1 to 5,5,5"));
    const FileLook far = clip(40, 50, 60);
    CHECK(isLineWith(errorOf([&] { scene.add(ballVolume({}), true, far); }), "ball: the clip box"));
}

TEST_CASE("What a clip box opens shows its inner side, and lets light in", "[look][clip]")
{
    const std::vector<Sphere> ball(1, {{0, 0, 0}, 1, {1, 1, 1}});
    FileLook look;
    look.clip.emplace();
    look.clip->lo = {-2, -2, -2};
    look.clip->hi = {2, 2, 0};
    Scene scene;
    scene.add(ball, false, look);
    RenderSettings settings = settingsFor();
    settings.view.eye = Vec3{0, 0, 6};
    settings.view.target = Vec3{0, 0, 0};
    const auto tile = render(scene, scene.bounds, settings);
    CHECK(tile->position[3 * (64 * 32 + 32) + 2] == Approx(-1).margin(0.01)); // the back of it
    settings.aoRays = 16;
    settings.aoDistance = 0.01f;
    const auto lit = render(scene, scene.bounds, settings);
    CHECK(lit->color[4 * (64 * 32 + 32)] == tile->color[4 * (64 * 32 + 32)]);
    // Half of the light comes through the opening of the bowl. A whole ball would let none in.
    settings.aoDistance = 2;
    const auto bowl = render(scene, scene.bounds, settings);
    const float part = bowl->color[4 * (64 * 32 + 32)] / tile->color[4 * (64 * 32 + 32)];
    CHECK(part > 0.5f);
    CHECK(part < 0.9f);
}

// ---- colour, opacity, placement -------------------------------------------------------------------------------------

TEST_CASE("Each file has a colour and an opacity of its own", "[look]")
{
    Scene scene;
    Mesh front = square(), back = square();
    for (Vec3& p : front.positions)
        p.z = 1;
    scene.add(front, false, lookWith({{"color", "#ff0000"}, {"opacity", "0.25"}}));
    scene.add(back, false, lookWith({{"color", "#0000ff"}}));
    RenderSettings settings = settingsFor();
    settings.view.eye = Vec3{0.5f, 0.5f, 4};
    settings.view.target = Vec3{0.5f, 0.5f, 0};
    const auto tile = render(scene, scene.bounds, settings);
    const float* albedo = tile->albedo + 3 * (64 * 32 + 32);
    CHECK(albedo[0] == Approx(0.25));
    CHECK(albedo[2] == Approx(0.75));
    CHECK(tile->color[4 * (64 * 32 + 32) + 3] == 1.0f);
    settings.opacity = 0.5f; // the default for the other one
    const auto both = render(scene, scene.bounds, settings);
    CHECK(both->color[4 * (64 * 32 + 32) + 3] == Approx(1 - 0.75 * 0.5));
}

TEST_CASE("A placement scales and turns about the file's centre and then moves it", "[look]")
{
    Box box;
    box.grow(Vec3{0, 0, 0});
    box.grow(Vec3{4, 2, 2});
    const FileLook look = lookWith({{"scale", "2"}, {"rotate", "0,0,90"}, {"translate", "10,0,-1"}});
    const FileToWorld place({}, box, look);
    const auto near = [](const Vec3& a, const Vec3& b) { return length(a - b) < 1e-5f; };
    CHECK(near(place.toWorld({2, 1, 1}), {12, 1, 0}));
    CHECK(near(place.toWorld({4, 1, 1}), {12, 5, 0})); // x to y
    CHECK(place.size() == 2.0f);
    for (const Vec3& p : {Vec3{0, 0, 0}, Vec3{4, 1, 2}, Vec3{-1, 5, 7}})
        CHECK(near(toFloat(place.toFile(place.toWorld(p))), p));
    Scene scene;
    scene.add(square(), false, lookWith({{"rotate", "90,0,0"}}));
    CHECK(scene.bounds.extent().y < 1e-4f);
    CHECK(scene.bounds.extent().z == Approx(1).epsilon(1e-3));
    Scene volume;
    const FileLook moved = lookWith({{"scale", "0.5"}, {"translate", "3,0,0"}});
    volume.add(ballVolume(moved), true, moved);
    CHECK(near(volume.bounds.center(), {3.5f, 0.5f, 0.5f}));
    CHECK(volume.bounds.largestExtent() == Approx(0.5).epsilon(1e-3));
}

// In 33^3 voxels, a quarter turn about z moves the voxel (32 - y, x) to (x, y).
TEST_CASE("A turned volume looks as the volume of the turned voxels", "[look]")
{
    const example::detail::WaveField field({33, 33, 33}, 5);
    for (const std::string isovalue : {"", "100"}) {
        INFO("isovalue " << isovalue);
        FileLook look = lookWith({{"rotate", "0,0,90"}});
        if (!isovalue.empty())
            CHECK(setLook(look, "isovalue", isovalue));
        VolumeSource source = example::detail::generatedVolume({33, 33, 33}, field);
        VolumeSource voxels =
            example::detail::generatedVolume({33, 33, 33}, [&](int x, int y, int z) { return field(32 - y, x, z); });
        source.look = voxels.look = lookOf(source, look, {}); // a look of its own depends on which rows are looked at
        Scene turned, moved;
        turned.add(std::move(source), true, look);
        moved.add(std::move(voxels), true);
        const auto a = render(turned, turned.bounds, settingsFor()), b = render(moved, moved.bounds, settingsFor());
        CHECK(coveredPixels(*a) > 1000);
        int wrong = 0;
        for (int i = 0; i < 4 * 64 * 64; ++i) // rays may graze the outline
            wrong += !(std::fabs(a->color[i] - b->color[i]) < 1e-3f);
        CHECK(wrong <= 16);
    }
}

// ---- the camera -----------------------------------------------------------------------------------------------------

TEST_CASE("Without fitting, voxels are where their file says", "[look]")
{
    example::VolumeSource source = example::detail::generatedVolume({4, 5, 6}, [](int, int, int) { return 1.0f; });
    source.info.origin = {10, 20, 30};
    source.info.spacing = {1, 2, 3};
    const example::VolumeObject object(source, false);
    CHECK(object.toWorld({0, 0, 0}) == Vec3{10, 20, 30});
    CHECK(object.toWorld({3, 1, 2}) == Vec3{13, 22, 36});
}

TEST_CASE("The camera is where it is told to be", "[look][camera]")
{
    const Focus focus{Box{{0, 0, 0}, {1, 1, 1}}, 0.87f};
    const auto near = [](const Vec3& a, const Vec3& b) { return length(a - b) < 1e-5f; };
    View view;
    view.eye = Vec3{3, 0.5f, 0.5f};
    CHECK(near(FrameCamera(focus, view, 0, 4, 9, 9).pinhole().forward(), {-1, 0, 0}));
    CHECK(near(FrameCamera(focus, view, 1, 4, 9, 9).pinhole().eye(), {0.5f, 0.5f, -2})); // a quarter turn, towards -z
    view.target = Vec3{3, 0.5f, 7};
    CHECK(near(FrameCamera(focus, view, 0, 4, 9, 9).pinhole().forward(), {0, 0, 1}));
    view.up = {0, 0, 2}; // along the view, so another up vector is chosen
    CHECK(near(FrameCamera(focus, view, 0, 4, 9, 9).pinhole().forward(), {0, 0, 1}));
    View z;
    z.up = {0, 0, 1};
    z.azimuth = z.elevation = 0;
    CHECK(near(FrameCamera(focus, z, 0, 1, 9, 9).pinhole().forward(), {0, 1, 0})); // from -y
    CHECK(near(FrameCamera(focus, z, 0, 1, 9, 9).pinhole().right(), {1, 0, 0}));
    z.up = {0, 0, -1}; // upside down, in front of a scene that faces that way
    CHECK(near(FrameCamera(focus, z, 0, 1, 9, 9).pinhole().forward(), {0, -1, 0}));
    CHECK(near(FrameCamera(focus, z, 0, 1, 9, 9).pinhole().right(), {1, 0, 0}));
    z.up = {0, 0, 1};
    z.elevation = 90;
    CHECK(FrameCamera(focus, z, 0, 1, 9, 9).pinhole().forward().z < -0.999f);
    View same;
    same.eye = same.target = Vec3{1, 1, 1};
    CHECK_FALSE(errorOf([&] { FrameCamera(focus, same, 0, 1, 9, 9); }).empty());
    // Zoom keeps the position and magnifies.
    View plain, zoomed;
    zoomed.zoom = 2;
    const FrameCamera a(focus, plain, 0, 1, 100, 100), b(focus, zoomed, 0, 1, 100, 100);
    CHECK(near(a.pinhole().eye(), b.pinhole().eye()));
    CHECK(near(a.pinhole().direction(60, 45, 100, 100), b.pinhole().direction(70, 40, 100, 100)));
}

} // namespace look_cases
