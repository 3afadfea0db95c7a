// STL and glTF files, which Assimp reads. Each error is a single line.
#include "support.hpp"
#include "together.hpp"

#include <scene_files.hpp>

#include <cstdint>
#include <cstring>
#include <string>
#include <vector>

namespace assimp_cases {

using namespace example;
using test::errorOf;
using test::isLineWith;
using test::ofRanks;

TEST_CASE("Assimp reads what there is no other reader for", "[assimp]")
{
    for (const char* ending : {".stl", ".gltf", ".glb"})
        CHECK(isAssimpEnding(ending));
    for (const char* ending : {".ply", ".obj", ".xyz", ".raw", ""})
        CHECK(!isAssimpEnding(ending));
}

#if defined(DFB_RENDER_HAS_ASSIMP)

namespace {

const std::vector<std::array<Vec3, 3>> tetrahedron = {{{{0, 0, 0}, {0, 1, 0}, {1, 0, 0}}},
                                                      {{{0, 0, 0}, {1, 0, 0}, {0, 0, 1}}},
                                                      {{{0, 0, 0}, {0, 0, 1}, {0, 1, 0}}},
                                                      {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}}};

template <class T>
void append(std::string& bytes, const T& value)
{
    bytes.append(reinterpret_cast<const char*>(&value), sizeof value);
}

std::string textStl()
{
    std::string text = "solid made up\n";
    for (const auto& triangle : tetrahedron) {
        text += "facet normal 0 0 0\nouter loop\n";
        for (const Vec3& p : triangle)
            text += "vertex " + std::to_string(p.x) + ' ' + std::to_string(p.y) + ' ' + std::to_string(p.z) + '\n';
        text += "endloop\nendfacet\n";
    }
    return text + "endsolid made up\n";
}

std::string binaryStl(std::uint32_t count = 4)
{
    std::string bytes(80, ' ');
    append(bytes, count);
    for (const auto& triangle : tetrahedron) {
        append(bytes, Vec3());
        for (const Vec3& p : triangle)
            append(bytes, p);
        append(bytes, std::uint16_t{0});
    }
    return bytes;
}

// One triangle, scaled by 2 and moved, with a colour.
std::string gltfJson(const std::string& buffer)
{
    return "{\"asset\":{\"version\":\"2.0\"},\"scene\":0,\"scenes\":[{\"nodes\":[0]}],"
           "\"nodes\":[{\"mesh\":0,\"translation\":[1,2,3],\"scale\":[2,2,2]}],"
           "\"meshes\":[{\"primitives\":[{\"attributes\":{\"POSITION\":0},\"indices\":1,\"material\":0}]}],"
           "\"materials\":[{\"pbrMetallicRoughness\":{\"baseColorFactor\":[0.25,0.5,1,1]}}],"
           "\"buffers\":[{"
           + buffer
           + "\"byteLength\":44}],"
             "\"bufferViews\":[{\"buffer\":0,\"byteOffset\":0,\"byteLength\":36},"
             "{\"buffer\":0,\"byteOffset\":36,\"byteLength\":6}],"
             "\"accessors\":[{\"bufferView\":0,\"componentType\":5126,\"count\":3,\"type\":\"VEC3\","
             "\"min\":[0,0,0],\"max\":[1,1,0]},"
             "{\"bufferView\":1,\"componentType\":5123,\"count\":3,\"type\":\"SCALAR\"}]}";
}

std::string gltfBuffer(std::uint16_t lastIndex = 2, float lastX = 0)
{
    std::string bytes;
    for (const Vec3& p : {Vec3{0, 0, 0}, Vec3{1, 0, 0}, Vec3{lastX, 1, 0}})
        append(bytes, p);
    for (const std::uint16_t index : {std::uint16_t{0}, std::uint16_t{1}, lastIndex, std::uint16_t{0}})
        append(bytes, index);
    return bytes;
}

std::string glb(std::string json, const std::string& buffer)
{
    json.resize((json.size() + 3) / 4 * 4, ' ');
    std::string bytes = "glTF";
    append(bytes, std::uint32_t{2});
    append(bytes, static_cast<std::uint32_t>(12 + 8 + json.size() + 8 + buffer.size()));
    append(bytes, static_cast<std::uint32_t>(json.size()));
    bytes += "JSON" + json;
    append(bytes, static_cast<std::uint32_t>(buffer.size()));
    return bytes + std::string("BIN\0", 4) + buffer;
}

void checkTetrahedron(const Mesh& mesh)
{
    REQUIRE(mesh.triangles.size() == tetrahedron.size());
    for (std::size_t t = 0; t < tetrahedron.size(); ++t)
        for (std::size_t k = 0; k < 3; ++k)
            CHECK(length(mesh.positions.at(mesh.triangles[t][k]) - tetrahedron[t][k]) == 0);
    CHECK(mesh.colors.empty());
}

void checkMoved(const Mesh& mesh)
{
    REQUIRE(mesh.triangles.size() == 1);
    const Vec3 expected[] = {{1, 2, 3}, {3, 2, 3}, {1, 4, 3}};
    for (std::size_t k = 0; k < 3; ++k) {
        CHECK(length(mesh.positions.at(mesh.triangles[0][k]) - expected[k]) < 1e-6f);
        CHECK(length(mesh.colors.at(mesh.triangles[0][k]) - Vec3{0.25f, 0.5f, 1}) < 1e-6f);
    }
}

} // namespace

TEST_CASE("An STL file has the same triangles as text and as bytes", "[assimp]")
{
    checkTetrahedron(parseWithAssimp(textStl(), "a.stl"));
    checkTetrahedron(parseWithAssimp(binaryStl(), "a.stl"));
}

TEST_CASE("The objects of a glTF file are where its nodes place them, in the colours of their materials", "[assimp]")
{
    checkMoved(parseWithAssimp(glb(gltfJson(""), gltfBuffer()), "a.glb"));
    const test::TemporaryFolder folder;
    folder.write("pixels.bin", gltfBuffer());
    const std::string json = gltfJson("\"uri\":\"pixels.bin\","), file = folder.write("a.gltf", json);
    checkMoved(parseWithAssimp(json, file));
}

TEST_CASE("A wrong file of another kind is one line", "[assimp]")
{
    const test::TemporaryFolder folder;
    const std::string good = glb(gltfJson(""), gltfBuffer()), stl = binaryStl();
    const float nan = std::numeric_limits<float>::quiet_NaN();
    std::string withNan = stl;
    std::memcpy(withNan.data() + 84 + 12, &nan, sizeof nan);
    std::string tooFar = stl;
    const float far = 1e15f;
    std::memcpy(tooFar.data() + 84 + 12, &far, sizeof far);
    const std::pair<std::string, std::string> wrong[] = {
        {"short.stl", stl.substr(0, stl.size() - 30)},
        {"more.stl", binaryStl(1000000)},
        {"nan.stl", withNan},
        {"far.stl", tooFar},
        {"none.stl", "solid nothing\nendsolid nothing\n"},
        {"text.stl", "no triangles at all"},
        {"short.glb", good.substr(0, good.size() - 30)},
        {"head.glb", good.substr(0, 20)},
        {"index.glb", glb(gltfJson(""), gltfBuffer(7))},
        {"nan.glb", glb(gltfJson(""), gltfBuffer(2, nan))},
        {"far.glb", glb(gltfJson(""), gltfBuffer(2, 0.6e15f))}, // its node doubles it
        {"json.gltf", gltfJson("\"uri\":\"pixels.bin\",").substr(0, 200)},
        {"missing.gltf", gltfJson("\"uri\":\"nowhere.bin\",")},
        {"empty.gltf", "{\"asset\":{\"version\":\"2.0\"}}"},
    };
    for (const auto& [name, bytes] : wrong) {
        const std::string file = folder.write(name, bytes);
        for (const int ranks : {1, 3}) {
            INFO(name << " on " << ranks << " ranks");
            for (const std::string& error : ofRanks<std::string>(ranks, [&, &path = file](const Loaders& loaders) {
                     return errorOf([&] {
                         Scene scene;
                         addFile(scene, path, true, 0, loaders);
                     });
                 }))
                CHECK(isLineWith(error, file + ": "));
        }
    }
}

TEST_CASE("What Assimp has read is dealt out to the ranks", "[assimp]")
{
    const test::TemporaryFolder folder;
    const std::string file = folder.write("a.stl", binaryStl());
    std::size_t triangles = 0;
    for (const std::size_t own : ofRanks<std::size_t>(3, [&](const Loaders& loaders) {
             Scene scene;
             addFile(scene, file, true, 0, loaders);
             return scene.meshes.at(0).mesh.triangles.size();
         })) {
        CHECK(own > 0);
        triangles += own;
    }
    CHECK(triangles == tetrahedron.size());
}

#endif

} // namespace assimp_cases
