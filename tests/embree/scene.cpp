// What a rank holds of a scene, and which notes it gives the user. Ranks are threads.
#include "support.hpp"
#include "together.hpp"

#include <generated.hpp>
#include <rank_scene.hpp>

#include <dfb/tile.hpp>

#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

namespace scene_cases {

using namespace example;

namespace {

Options optionsFor(const std::vector<std::string>& words)
{
    std::vector<const char*> arguments{"dfb_render"};
    for (const std::string& word : words)
        arguments.push_back(word.c_str());
    const ParsedOptions parsed = parseOptions(static_cast<int>(arguments.size()), arguments.data());
    if (!parsed.options) // no macro of Catch2: ranks are threads, and it is for one
        throw std::runtime_error(parsed.message);
    return *parsed.options;
}

const std::string tetrahedron = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n";

} // namespace

TEST_CASE("All ranks have the same notes for the user", "[scene]")
{
    const test::TemporaryFolder folder;
    const std::string blank = folder.write("blank_4x4x4_uint8.raw", std::string(64, '\0')),
                      atoms = folder.write("atoms.xyz", "2\n\nXx 0 0 0\nXx 9 9 9\n");
    const Options both = optionsFor({blank, atoms});
    for (const int ranks : {1, 3})
        for (const Notes& notes :
             test::ofRanks<Notes>(ranks, [&](const Loaders& loaders) { return loadRankScene(both, loaders).notes; })) {
            REQUIRE(notes.size() == 2);
            CHECK(test::contains(notes[0], "blank_4x4x4_uint8.raw: there is nothing to see"));
            CHECK(test::contains(notes[1], "Xx (2)"));
        }
    CHECK(loadRankScene(optionsFor({"demo"}), {}).notes.empty());
    CHECK(loadRankScene(optionsFor({"synthetic"}), {}).notes.empty());
    const std::string some = folder.write("some_4x4x4_uint8.raw", std::string(63, '\1') + '\7');
    for (const char* isovalue : {"0", "8"}) // all voxels are within the surface, or all are outside
        CHECK(test::contains(loadRankScene(optionsFor({some, "--isovalue", isovalue}), {}).notes.at(0),
                             "nothing to see"));
    CHECK(loadRankScene(optionsFor({some, "--isovalue", "5"}), {}).notes.empty());
}

TEST_CASE("Coordinates far from 0 are noted where float32 rounds them visibly", "[scene]")
{
    const test::TemporaryFolder folder;
    const std::string mesh = folder.write("far.obj", "v 5000000 0 0\nv 5000200 0 0\nv 5000000 200 0\nf 1 2 3\n"),
                      atoms = folder.write("far.xyz", "2\n\nC 0 0 -5000000\nC 9 9 -5000000\n"),
                      fine = folder.write("fine.obj", "v 50000 0 0\nv 50200 0 0\nv 50000 200 0\nf 1 2 3\n");
    for (const int ranks : {1, 3})
        for (const Notes& notes : test::ofRanks<Notes>(ranks, [&](const Loaders& loaders) {
                 return loadRankScene(optionsFor({mesh, atoms}), loaders).notes;
             })) {
            REQUIRE(notes.size() == 2);
            CHECK(test::contains(notes[0], "far.obj: its coordinates, from 5e+06,0,0 to "));
            CHECK(test::contains(notes[0], " to steps of 0.5"));
            CHECK(test::contains(notes[1], "far.xyz: "));
        }
    CHECK(loadRankScene(optionsFor({fine}), {}).notes.empty());
    const std::string point = folder.write("point.obj", "v 5000000 0 0\nf 1 1 1\n");
    CHECK(loadRankScene(optionsFor({point}), {}).notes.empty());
}

TEST_CASE("Path tracing says that it leaves volumes out", "[scene]")
{
    const test::TemporaryFolder folder;
    const std::string volume = folder.write("v_4x4x4_uint8.raw", std::string(64, 'v')),
                      mesh = folder.write("mesh.obj", tetrahedron);
    const auto notesOf = [](std::vector<std::string> words) {
        words.insert(words.end(), {"--mode", "image"});
        return loadRankScene(optionsFor(words), {}).notes;
    };
    REQUIRE(notesOf({volume, "--path", "2"}).size() == 1);
    CHECK(test::contains(notesOf({volume, "--path", "2"})[0], "nothing to see"));
    CHECK(test::contains(notesOf({volume, "--path", "2"})[0], "--path"));
    REQUIRE(notesOf({volume, mesh, "--path", "2"}).size() == 1);
    CHECK(test::contains(notesOf({volume, mesh, "--path", "2"})[0], "--path leaves volumes out"));
    CHECK(notesOf({mesh, "--path", "2"}).empty());
    CHECK(notesOf({volume}).empty());
}

TEST_CASE("A generated volume that is too large is named", "[scene]")
{
    CHECK(test::isLineWith(test::errorOf([] { syntheticScene(2053, 1); }), "synthetic: its voxels are too small"));
}

TEST_CASE("A range that a float cannot divide by is named", "[scene]")
{
    const test::TemporaryFolder folder;
    const std::string volume = folder.write("v_4x4x4_uint8.raw", std::string(64, 'v')),
                      transfer = folder.write(
                          "t.json", R"({"range": [0, 1e-45], "points": [{"value": 0, "opacity": 0, "color": [0, 0, 0]},
                          {"value": 1, "opacity": 1, "color": [1, 1, 1]}]})");
    for (const std::string& look :
         {std::string("range=0,1e-45"), std::string("range=-3e38,3e38"), std::string("range=-1.6e38,1.6e38"),
          "transfer=" + transfer, std::string("range=0,1e-45:isovalue=0")})
        for (const std::string& error : test::ofRanks<std::string>(2, [&](const Loaders& loaders) {
                 return test::errorOf([&] { loadRankScene(optionsFor({volume + ':' + look}), loaders); });
             }))
            CHECK(test::isLineWith(error, "v_4x4x4_uint8.raw: the range from "));
}

TEST_CASE("The frame of an XYZ file is that of the option", "[scene]")
{
    const test::TemporaryFolder folder;
    const std::string file = folder.write("a.xyz", "1\n\nC 0 0 0\n1\n\nC 7 0 0\n");
    const auto centerOf = [&](std::vector<std::string> words) {
        words.insert(words.end(), {file, "--no-fit"});
        return loadRankScene(optionsFor(words), {}).info.bounds.center().x;
    };
    CHECK(centerOf({}) == 0.0f);
    CHECK(centerOf({"--xyz-frame", "1"}) == 0.0f);
    CHECK(centerOf({"--xyz-frame", "2"}) == 7.0f);
    CHECK(test::isLineWith(test::errorOf([&] { centerOf({"--xyz-frame", "3"}); }), "expected a frame 3"));
}

TEST_CASE("The colours of vertices are in the image, cut or whole", "[scene]")
{
    // Red on the left, blue on the right, and a vertex that no triangle uses.
    Mesh mesh;
    mesh.positions = {{9, 9, 9}, {0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}};
    mesh.colors = {{0, 1, 0}, {1, 0, 0}, {0, 0, 1}, {0, 0, 1}, {1, 0, 0}};
    mesh.triangles = {{1, 2, 3}, {1, 3, 4}};
    Scene scene;
    scene.add(mesh, false);
    RenderSettings settings;
    settings.width = settings.height = 64;
    settings.opacity = 1;
    settings.view.azimuth = settings.view.elevation = 0;
    const SceneInfo info(scene);
    using Tile = dfb::Tile<dfb::allChannels & ~dfb::farChannel, 64>;
    const auto render = [&](const Box& cell) {
        auto tile = std::make_unique<Tile>();
        tile->region = {0, 0, 64, 64};
        tile->clear();
        Renderer(loadBrick(scene, cell), info, settings).renderTile(*tile, 0);
        return tile;
    };
    const auto whole = render(scene.bounds);
    std::vector<std::unique_ptr<Tile>> parts;
    for (const Box& cell : cutScene(scene, 4))
        parts.push_back(render(cell));
    int seen = 0, wrong = 0;
    float before = 1;
    for (int x = 0; x < 64; ++x) {
        const int at = 64 * 32 + x;
        if (!(whole->color[4 * at + 3] > 0))
            continue;
        ++seen;
        const float* albedo = whole->albedo + 3 * at;
        wrong += !(albedo[0] < before && albedo[1] < 1e-6f && std::fabs(albedo[0] + albedo[2] - 1) < 1e-5f);
        before = albedo[0];
        int same = 0;
        for (const auto& part : parts)
            same += part->albedo[3 * at] == albedo[0] && part->albedo[3 * at + 2] == albedo[2];
        wrong += same != 1;
    }
    CHECK(seen > 20);
    CHECK(before < 0.1f);
    CHECK(wrong == 0);
}

} // namespace scene_cases
