// The readers of the bundled renderer: which files they accept, and that they refuse all others with a single line that
// names the file.
#include "support.hpp"

#include <obj.hpp>
#include <ply.hpp>
#include <scene_files.hpp>
#include <voxel_block.hpp>
#include <xyz.hpp>

#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <random>
#include <sstream>
#include <string>
#include <vector>

namespace readers_cases {

using namespace example;
using test::errorOf;
using test::isLineWith;

namespace {

// ---- volumes ---------------------------------------------------------------------------------------------------

template <class T>
std::string bytesOf(const std::vector<T>& values)
{
    return std::string(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(T));
}

VolumeInfo describe(const std::string& name, const std::string& bytes)
{
    VolumeFile file = parseVolumeName(name);
    return describeVolume(std::make_shared<std::istringstream>(bytes), file);
}

VolumeSource sourceOf(const std::string& name, const std::string& bytes)
{
    VolumeSource source;
    VolumeFile file = parseVolumeName(name);
    source.info = describeVolume(std::make_shared<std::istringstream>(bytes), file);
    source.open = [bytes, file, info = source.info] {
        return boxReader(std::make_shared<std::istringstream>(bytes), file, info);
    };
    return source;
}

// Whether the block [lo, hi) of a volume with these voxels equals them. Outside the volume, the nearest voxel is
// repeated.
template <class T>
bool blockIsPartOf(const std::vector<T>& voxels, const VolumeSource& source, const Index3& lo, const Index3& hi)
{
    const VoxelBlock block(source, lo, hi);
    const Index3& d = source.info.dims;
    for (int z = lo[2]; z < hi[2]; ++z)
        for (int y = lo[1]; y < hi[1]; ++y)
            for (int x = lo[0]; x < hi[0]; ++x) {
                const auto inside = [](int i, int n) { return i < 0 ? 0 : i >= n ? n - 1 : i; };
                const int at = (inside(z, d[2]) * d[1] + inside(y, d[1])) * d[0] + inside(x, d[0]);
                if (block.data<T>()[block.index(x, y, z)] != voxels[static_cast<std::size_t>(at)])
                    return false;
            }
    return true;
}

template <class T>
void checkBlocks(const std::string& type)
{
    const Index3 dims{7, 5, 6};
    std::mt19937 random(5);
    std::vector<T> voxels(7 * 5 * 6);
    for (T& v : voxels)
        v = static_cast<T>(random() % 60000);
    const VolumeSource source = sourceOf("v_7x5x6_" + type + ".raw", bytesOf(voxels));
    CHECK(source.info.dims == dims);
    CHECK(blockIsPartOf(voxels, source, {0, 0, 0}, dims));
    CHECK(blockIsPartOf(voxels, source, {-1, -1, -1}, {9, 7, 8})); // ghosts on all sides
    for (int i = 0; i < 200; ++i) {
        Index3 lo, hi;
        for (std::size_t axis = 0; axis < 3; ++axis) {
            lo[axis] = static_cast<int>(random() % static_cast<unsigned>(dims[axis] + 1)) - 1;
            hi[axis] = std::max(lo[axis], 0) + 1;
            hi[axis] += static_cast<int>(random() % static_cast<unsigned>(dims[axis] + 3 - hi[axis]));
        }
        INFO(lo[0] << ' ' << lo[1] << ' ' << lo[2] << " to " << hi[0] << ' ' << hi[1] << ' ' << hi[2]);
        REQUIRE(blockIsPartOf(voxels, source, lo, hi));
    }
}

// ---- meshes ----------------------------------------------------------------------------------------------------

bool same(const Vec3& a, const Vec3& b) { return a.x == b.x && a.y == b.y && a.z == b.z; }

// Four corners of a square and a point above it. The faces are the square and a triangle.
const std::vector<Vec3> points{{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}, {0.5f, 0.25f, -2}};

void checkPoints(const Mesh& mesh)
{
    REQUIRE(mesh.positions.size() == points.size());
    for (std::size_t i = 0; i < points.size(); ++i)
        CHECK(same(mesh.positions[i], points[i]));
}

void checkMesh(const Mesh& mesh)
{
    checkPoints(mesh);
    const std::vector<Triangle> expected{{0, 1, 2}, {0, 2, 3}, {4, 1, 0}};
    CHECK(mesh.triangles == expected);
}

std::string plyHeader(const std::string& format, const std::string& elements)
{
    return "ply\nformat " + format + " 1.0\ncomment element vertex 99\nobj_info none\n" + elements + "end_header\n";
}

const std::string plainElements = "element vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
                                  "element face 2\nproperty list uchar int vertex_indices\n";
const std::string asciiBody = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n0.5 0.25 -2\n4 0 1 2 3\n3 4 1 0\n";

// Elements and properties of all types that a reader of meshes has to skip.
const std::string mixedElements =
    "element camera 2\nproperty double focus\nproperty list ushort short marks\nelement nothing 3\n"
    "element vertex 5\nproperty uchar red\nproperty double z\nproperty float32 x\nproperty list uint8 float64 w\n"
    "property int16 id\nproperty float y\n"
    "element edge 1\nproperty uint a\nproperty uint b\n"
    "element face 2\nproperty char flag\nproperty list uint ushort vertex_index\n"
    "property list uchar float texcoord\nelement tail 2\nproperty int8 t\n";

class Bytes {
public:
    explicit Bytes(bool bigEndian) : bigEndian_(bigEndian) {}

    template <class T>
    Bytes& put(T value)
    {
        char bytes[sizeof(T)];
        std::memcpy(bytes, &value, sizeof value);
        for (std::size_t i = 0; i < sizeof(T); ++i)
            text += bytes[bigEndian_ ? sizeof(T) - 1 - i : i]; // the tests run on little-endian machines
        return *this;
    }
    std::string text;

private:
    bool bigEndian_;
};

std::string binaryPlain(bool bigEndian)
{
    Bytes body(bigEndian);
    for (const Vec3& p : points)
        body.put(p.x).put(p.y).put(p.z);
    body.put(std::uint8_t{4}).put(0).put(1).put(2).put(3).put(std::uint8_t{3}).put(4).put(1).put(0);
    return plyHeader(bigEndian ? "binary_big_endian" : "binary_little_endian", plainElements) + body.text;
}

std::string binaryMixed(bool bigEndian)
{
    using std::uint16_t;
    using std::uint32_t;
    using std::uint8_t;
    Bytes b(bigEndian);
    b.put(35.5).put(uint16_t{2}).put(std::int16_t{-1}).put(std::int16_t{300}).put(50.0).put(uint16_t{0});
    for (std::size_t i = 0; i < points.size(); ++i) {
        b.put(uint8_t{255}).put(static_cast<double>(points[i].z)).put(points[i].x).put(static_cast<uint8_t>(i));
        for (std::size_t k = 0; k < i; ++k)
            b.put(1e300);
        b.put(std::int16_t{-7}).put(points[i].y);
    }
    b.put(uint32_t{4000000000u}).put(uint32_t{1});
    b.put(std::int8_t{-1}).put(uint32_t{4});
    for (uint16_t i = 0; i < 4; ++i)
        b.put(i);
    b.put(uint8_t{1}).put(0.5f).put(std::int8_t{0}).put(uint32_t{3});
    b.put(uint16_t{4}).put(uint16_t{1}).put(uint16_t{0}).put(uint8_t{0});
    b.put(std::int8_t{1}).put(std::int8_t{2});
    return plyHeader(bigEndian ? "binary_big_endian" : "binary_little_endian", mixedElements) + b.text;
}

std::string asciiMixed()
{
    std::string body = "35.5 2 -1 300\n50 0\n";
    const char* xyz[] = {"0 0", "1 0", "1 1", "0 1", "0.5 0.25"};
    for (int i = 0; i < 5; ++i) {
        const std::string p = xyz[i];
        body += "255 " + std::string(i == 4 ? "-2e0 " : "0 ") + p.substr(0, p.find(' ')) + ' ' + std::to_string(i);
        for (int k = 0; k < i; ++k)
            body += " 1e300";
        body += " -7" + p.substr(p.find(' ')) + '\n';
    }
    return plyHeader("ascii", mixedElements) + body + "4000000000 1\n-1 4 0 1 2 3 1 0.5\n0 3 4 1 0 0\n1 2\n";
}

const std::string plainObj = "# a comment\nmtllib none.mtl\no thing\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
                             "v 0.5 +0.25 -2e0 1.0\nvt 0.5 0.5\nvn 0 0 1\ng part\nusemtl red\ns off\n"
                             "f 1/1/1 2/1/1 3//1 4\nf -1 2 1\n";

template <class Parse>
std::string refusal(const Parse& parse, const std::string& bytes)
{
    return errorOf([&] { parse(bytes, "the.file"); });
}
std::string plyRefusal(const std::string& bytes)
{
    return refusal([](auto&&... a) { parsePly(a...); }, bytes);
}
std::string objRefusal(const std::string& bytes)
{
    return refusal([](auto&&... a) { parseObj(a...); }, bytes);
}
std::string xyzRefusal(const std::string& bytes)
{
    return refusal([](auto&&... a) { parseXyz(a...); }, bytes);
}

std::string replaced(std::string text, const std::string& from, const std::string& to)
{
    const std::size_t at = text.find(from);
    REQUIRE(at != std::string::npos);
    return text.replace(at, from.size(), to);
}

} // namespace

TEST_CASE("The name of a volume tells its dimensions and type", "[readers]")
{
    CHECK(parseVolumeName("a_2x3x4_uint8.raw").dims == Index3{2, 3, 4});
    for (const auto& [word, type] : fileTypes()) {
        CHECK(parseVolumeName("a_2x3x4_" + word + ".raw").format.type == type);
        CHECK_FALSE(parseVolumeName("a_2x3x4_" + word + ".raw").format.isBigEndian);
        CHECK(parseVolumeName("a_2x3x4_" + word + "be.raw").format.type == type);
        CHECK(parseVolumeName("a_2x3x4_" + word + "be.raw").format.isBigEndian);
    }
    CHECK(parseVolumeName("/some_where/9x9x9_x/two_words_65536x2x100_float32.raw").dims == Index3{65536, 2, 100});
    CHECK(parseVolumeName("_2x2x2_uint8.raw").dims == Index3{2, 2, 2});

    for (const std::string name : {"a.raw",
                                   ".raw",
                                   "raw",
                                   "a_2x3x4_uint8.ply",
                                   "a_2x3x4.raw",
                                   "a_uint8.raw",
                                   "2x3x4_uint8.raw",
                                   "a_2x3_uint8.raw",
                                   "a_2x3x4x5_uint8.raw",
                                   "a_0x3x4_uint8.raw",
                                   "a_2x1x4_uint8.raw",
                                   "a_-2x3x4_uint8.raw",
                                   "a_2x3x4 _uint8.raw",
                                   "a_2x3x65537_uint8.raw",
                                   "a_2x99999999999999999999x4_uint8.raw",
                                   "a_4294967298x2x2_uint8.raw",
                                   "a_2x3xfour_uint8.raw",
                                   "a_2X3X4_uint8.raw",
                                   "a_xx_uint8.raw",
                                   "a_2x3x_uint8.raw",
                                   "a_2.5x3x4_uint8.raw",
                                   "a_2x3x4_int64.raw",
                                   "a_2x3x4_float16.raw",
                                   "a_2x3x4_UINT8.raw",
                                   "a_2x3x4_be.raw",
                                   "a_2x3x4_.raw",
                                   "a_2x3x4_uint8_.raw"}) {
        INFO(name);
        CHECK(isLineWith(errorOf([&] { parseVolumeName(name); }), name + ": "));
    }
}

TEST_CASE("A volume has as many bytes as its name says", "[readers]")
{
    const std::string full(2 * 3 * 4, 'v');
    CHECK(describe("a_2x3x4_uint8.raw", full).dims == Index3{2, 3, 4});
    for (const std::string& bytes : {std::string(), full.substr(1), full + 'v', full + full}) {
        const std::string error = errorOf([&] { describe("a_2x3x4_uint8.raw", bytes); });
        CHECK(isLineWith(error, "a_2x3x4_uint8.raw: "));
        CHECK(test::contains(error, "24"));
        CHECK(test::contains(error, std::to_string(bytes.size())));
    }
    // The right number of bytes under a name with other dimensions or another type.
    CHECK(isLineWith(errorOf([&] { describe("a_2x3x5_uint8.raw", full); }), "30"));
    CHECK(isLineWith(errorOf([&] { describe("a_2x3x4_uint16.raw", full); }), "48"));
    CHECK(isLineWith(errorOf([&] { describe("a_2x3x4_float32.raw", full); }), "96"));
    // 2^50 bytes, which would be 0 in 32 bits.
    CHECK(isLineWith(errorOf([&] { describe("a_65536x65536x65536_float32.raw", {}); }), "1125899906842624"));

    const test::TemporaryFolder folder;
    const std::string good = folder.write("v_2x3x4_uint8.raw", full);
    CHECK(openVolume(good).info.dims == Index3{2, 3, 4});
    const std::string missing = folder / "w_2x3x4_uint8.raw";
    CHECK(isLineWith(errorOf([&] { openVolume(missing); }), missing));
    CHECK(isLineWith(errorOf([&] { openVolume(folder.write("s_2x3x4_uint8.raw", full.substr(1))); }), "24"));
    std::filesystem::create_directory(folder / "d_2x3x4_uint8.raw");
    CHECK(isLineWith(errorOf([&] { openVolume(folder / "d_2x3x4_uint8.raw"); }), "d_2x3x4_uint8.raw"));
}

TEST_CASE("The range of a volume is that of the whole file", "[readers]")
{
    CHECK(describe("a_2x2x2_uint8.raw", std::string(8, 'v')).maximum == 255.0f);
    const VolumeInfo shorts = describe("a_2x2x2_uint16.raw", bytesOf<std::uint16_t>({9, 7, 300, 40000, 7, 8, 9, 10}));
    CHECK(shorts.minimum == 7.0f);
    CHECK(shorts.maximum == 40000.0f);

    const float inf = std::numeric_limits<float>::infinity(), nan = std::numeric_limits<float>::quiet_NaN();
    const std::vector<float> mixed{-3, 0, nan, 5, inf, -inf, 2, 1};
    const VolumeSource density = sourceOf("a_2x2x2_float32.raw", bytesOf(mixed));
    CHECK(density.info.minimum == 0.0f);
    CHECK(density.info.maximum == 5.0f);
    const VoxelBlock block(density, {0, 0, 0}, {2, 2, 2});
    const std::vector<float> expected{-3, 0, 0, 5, 0, 0, 2, 1};
    CHECK(std::vector<float>(block.data<float>(), block.data<float>() + 8) == expected);

    const VolumeInfo positive = describe("a_2x2x2_float32.raw", bytesOf<float>({2, 3, 4, 5, 6, 7, 8, 9}));
    CHECK(positive.minimum == 2.0f);
    CHECK(positive.maximum == 9.0f);
    const VolumeInfo constant = describe("a_2x2x2_float32.raw", bytesOf(std::vector<float>(8, 2.0f)));
    CHECK(constant.maximum > constant.minimum);
    for (const float value : {1e30f, -1e30f, std::numeric_limits<float>::max()}) {
        const VolumeInfo large = describe("a_2x2x2_float32.raw", bytesOf(std::vector<float>(8, value)));
        CHECK((std::isfinite(large.maximum) && large.maximum > large.minimum));
    }
    CHECK(isLineWith(errorOf([&] { describe("a_2x2x2_float32.raw", bytesOf(std::vector<float>(8, nan))); }), "finite"));
}

TEST_CASE("A part of a volume equals that part of the whole", "[readers]")
{
    checkBlocks<std::uint8_t>("uint8");
    checkBlocks<std::uint16_t>("uint16");
    checkBlocks<float>("float32");
    checkBlocks<std::int16_t>("int16");
}

TEST_CASE("PLY: ASCII and binary, with all else in the file skipped", "[readers]")
{
    checkMesh(parsePly(plyHeader("ascii", plainElements) + asciiBody, "a.ply"));
    checkMesh(parsePly(binaryPlain(false), "a.ply"));
    checkMesh(parsePly(binaryPlain(true), "a.ply"));
    checkMesh(parsePly(asciiMixed(), "a.ply"));
    checkMesh(parsePly(binaryMixed(false), "a.ply"));
    checkMesh(parsePly(binaryMixed(true), "a.ply"));

    std::string crlf;
    for (const char c : plyHeader("ascii", plainElements) + asciiBody)
        crlf += c == '\n' ? std::string("\r\n") : std::string(1, c);
    checkMesh(parsePly(crlf, "a.ply"));

    const std::string hexagon = replaced(replaced(plainElements, "vertex 5", "vertex 6"), "face 2", "face 1");
    const Mesh fan =
        parsePly(plyHeader("ascii", hexagon) + "0 0 0 1 0 0 2 1 0 2 2 0 1 2 0 0 1 0 6 5 0 1 2 3 4", "a.ply");
    const std::vector<Triangle> expected{{5, 0, 1}, {5, 1, 2}, {5, 2, 3}, {5, 3, 4}};
    CHECK(fan.triangles == expected);
}

TEST_CASE("PLY: a file cut short anywhere, or with more behind its end, is refused", "[readers]")
{
    for (const std::string& file : {binaryPlain(false), binaryPlain(true), binaryMixed(false), binaryMixed(true)}) {
        for (std::size_t size = 0; size < file.size(); ++size) {
            INFO(size << " of " << file.size() << " bytes");
            REQUIRE(isLineWith(plyRefusal(file.substr(0, size)), "the.file: "));
        }
        CHECK(isLineWith(plyRefusal(file + '\0'), "the.file: "));
        CHECK(isLineWith(plyRefusal(file + '\n'), "the.file: "));
    }
    for (const std::string& file : {plyHeader("ascii", plainElements) + asciiBody, asciiMixed()}) {
        for (std::size_t size = 0; size + 1 < file.size(); ++size) { // the last line break may be missing
            INFO(size << " of " << file.size() << " bytes");
            REQUIRE(isLineWith(plyRefusal(file.substr(0, size)), "the.file: "));
        }
        CHECK(isLineWith(plyRefusal(file + "0"), "the.file: "));
        CHECK(plyRefusal(file + " \n\n").empty());
    }
}

TEST_CASE("PLY: bad headers, numbers, lists and indices", "[readers]")
{
    const std::string good = plyHeader("ascii", plainElements) + asciiBody;
    CHECK(plyRefusal(good).empty());
    const std::vector<std::pair<std::string, std::string>> changes{
        {"ply\n", "plx\n"},
        {"format ascii 1.0\n", ""},
        {"format ascii 1.0\n", "format ascii 2.0\n"},
        {"format ascii", "format binary_middle_endian"},
        {"vertex 5\nproperty float x", "vertex 5\nproperty float16 x"},
        {"vertex 5\n", "vertex -5\n"},
        {"vertex 5\n", "vertex 5.5\n"},
        {"vertex 5\n", "vertex 99999999999999999999999\n"},
        {"vertex 5\n", "vertex 18446744073709551615\n"},
        {"vertex 5\n", "vertex 4\n"},
        {"vertex 5\n", "vertex 6\n"},
        {"element vertex 5", "element vortex 5"},
        {"element face", "element fase"},
        {"vertex_indices", "indices"},
        {"property float z\n", ""},
        {"property float z\n", "property float z\nproperty float z\n"},
        {"property float z\n", "property list uchar float z\n"},
        {"element face 2\n",
         "element vertex 0\nproperty float x\nproperty float y\nproperty float z\nelement face 2\n"},
        {"element vertex 5\n", "element vertex\n"},
        {"obj_info none\n", "property float early\n"},
        {"obj_info none\n", "nonsense\n"},
        {"1 1 0\n", "1 one 0\n"},
        {"1 1 0\n", "1 1,0 0\n"},
        {"1 1 0\n", "1 nan 0\n"},
        {"1 1 0\n", "1 inf 0\n"},
        {"1 1 0\n", "1 1e30 0\n"},
        {"1 1 0\n", "1 1e999 0\n"},
        {"4 0 1 2 3", "4 0 1 2 5"},
        {"4 0 1 2 3", "4 0 1 2 -1"},
        {"4 0 1 2 3", "4 0 1 2 4294967296"},
        {"4 0 1 2 3", "4 0 1 2 nan"},
        {"4 0 1 2 3", "4 0 1 2 2.5"},
        {"4 0 1 2 3", "3.5 0 1 2"},
        {"4 0 1 2 3", "-4 0 1 2 3"},
        {"4 0 1 2 3", "1000000 0 1 2 3"},
        {"4 0 1 2 3", "2 0 1"},
        {"4 0 1 2 3", "0"}};
    for (const auto& [from, to] : changes) {
        INFO('\'' << from << "' becomes '" << to << '\'');
        CHECK(isLineWith(plyRefusal(replaced(good, from, to)), "the.file: "));
    }
    CHECK(isLineWith(plyRefusal(""), "the.file: "));
    CHECK(isLineWith(plyRefusal(plyHeader("ascii", "")), "the.file: "));
    // A file with vertices only is not a mesh.
    const std::string noFaces = replaced(plainElements, "face 2", "face 0");
    CHECK(
        isLineWith(plyRefusal(plyHeader("ascii", noFaces) + asciiBody.substr(0, asciiBody.find("4 0"))), "the.file: "));
    // In a binary file the counts of lists may be damaged as well.
    std::string list = binaryPlain(false);
    list[list.size() - 13] = '\xff';
    CHECK(isLineWith(plyRefusal(list), "the.file: "));
    // An element of 2^64 - 1 rows without properties must not take time.
    CHECK(plyRefusal(plyHeader("ascii", "element nothing 18446744073709551615\n" + plainElements) + asciiBody).empty());
}

TEST_CASE("OBJ: vertices and faces, with all else in the file skipped", "[readers]")
{
    checkMesh(parseObj(plainObj, "a.obj"));
    checkMesh(parseObj(plainObj.substr(0, plainObj.size() - 1), "a.obj"));
    std::string crlf;
    for (const char c : plainObj)
        crlf += c == '\n' ? std::string("\r\n") : std::string(1, c);
    checkMesh(parseObj(crlf, "a.obj"));
    // Negative indices count back from the vertices read so far.
    const Mesh mesh =
        parseObj("v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1\nv 0 1 0\nv 0.5 0.25 -2\nf 1 3 -2\nf 5 2 1\n", "a.obj");
    checkMesh(mesh);
}

TEST_CASE("OBJ: bad vertices and faces", "[readers]")
{
    const std::vector<std::pair<std::string, std::string>> changes{
        {"v 1 1 0\n", "v 1 1\n"},     {"v 1 1 0\n", "v 1 one 0\n"},  {"v 1 1 0\n", "v 1 nan 0\n"},
        {"v 1 1 0\n", "v 1 inf 0\n"}, {"v 1 1 0\n", "v 1 1e30 0\n"}, {"v 1 1 0\n", "v 1 1e999 0\n"},
        {"v 1 1 0\n", "v 1 1,0 0\n"}, {"v 1 1 0\n", "v\t1 x 0\n"},   {"f -1 2 1", "f -1 2 6"},
        {"f -1 2 1", "f -1 2 0"},     {"f -1 2 1", "f -6 2 1"},      {"f -1 2 1", "f 1 2"},
        {"f -1 2 1", "f 1"},          {"f -1 2 1", "f 1 2 three"},   {"f -1 2 1", "f 1 2 99999999999"},
        {"v 0 0 0\nv 1 0 0\n", ""}};
    for (const auto& [from, to] : changes) {
        INFO('\'' << from << "' becomes '" << to << '\'');
        CHECK(isLineWith(objRefusal(replaced(plainObj, from, to)), "the.file: "));
    }
    // Indices that exceed 32 bits or are not only digits, and lines that end with \r.
    for (const char* face : {"f 1 2 4294967299", "f 1 2 3x", "f 1 2 3/x"})
        CHECK(isLineWith(objRefusal(replaced(plainObj, "f -1 2 1", face)), "the.file: "));
    for (const char* lines : {"v 1 nan 0\r", "#\rv 1 nan 0\n"})
        CHECK(isLineWith(objRefusal(replaced(plainObj, "v 1 1 0\n", lines)), "the.file: "));
    CHECK(isLineWith(objRefusal(""), "the.file: "));
    CHECK(isLineWith(objRefusal("v 0 0 0\nv 1 0 0\nv 1 1 0\n"), "the.file: "));
    CHECK(isLineWith(objRefusal("f 1 2 3\n"), "the.file: "));
    CHECK(isLineWith(objRefusal(std::string(1000, '\0')), "the.file: "));
    // Files that end within a face or within a vertex.
    CHECK(isLineWith(objRefusal(plainObj.substr(0, plainObj.size() - 2)), "the.file: "));
    CHECK(isLineWith(objRefusal(plainObj.substr(0, plainObj.find("v 0.5") + 5)), "the.file: "));
}

TEST_CASE("XYZ: atoms with a radius and a colour by element", "[readers]")
{
    const std::vector<Sphere> atoms = parseXyz("3\nany text\nC 0 0.5 -1\nO\t1e1 2 3\r\nXx 4 5 6", "a.xyz");
    REQUIRE(atoms.size() == 3);
    CHECK(same(atoms[0].center, {0, 0.5f, -1}));
    CHECK(same(atoms[1].center, {10, 2, 3}));
    CHECK(same(atoms[2].center, {4, 5, 6}));
    CHECK(atoms[0].radius == 1.70f);
    CHECK(atoms[1].radius == 1.52f);
    CHECK(atoms[2].radius > 0.0f); // unknown elements are drawn as well
    CHECK_FALSE(same(atoms[0].color, atoms[1].color));
    CHECK(parseXyz("1\n\nC 1 2 3\n\n \n", "a.xyz").size() == 1);
}

TEST_CASE("XYZ: wrong counts and bad lines", "[readers]")
{
    const std::string good = "2\nwater in part\nO 0 0 0\nH 1 0 0\n";
    CHECK(xyzRefusal(good).empty());
    for (std::size_t size = 0; size + 1 < good.size(); ++size) {
        INFO(size << " bytes");
        CHECK(isLineWith(xyzRefusal(good.substr(0, size)), "the.file: "));
    }
    for (const std::string bytes : {"0\n\n",
                                    "-1\n\nC 0 0 0\n",
                                    "one\n\nC 0 0 0\n",
                                    "1 2\n\nC 0 0 0\n",
                                    "1.0\n\nC 0 0 0\n",
                                    "99999999999999999999999\n\nC 0 0 0\n",
                                    "4000000000\n\nC 0 0 0\n",
                                    "1\n\nC 0 0 0\nC 1 1 1\n",
                                    "2\n\nC 0 0 0\n",
                                    "1\n\nC 0 0\n",
                                    "1\n\nC 0 zero 0\n",
                                    "1\n\nC 0 nan 0\n",
                                    "1\n\nC 0 +-1 0\n",
                                    "1\n\nC 0 inf 0\n",
                                    "1\n\nC 0 1e30 0\n",
                                    "1\n\nC 0 1e99 0\n",
                                    "1\n\n\nC 0 0 0\n",
                                    "1\n\nC 0,0 0 0\n",
                                    "1\nProperties=pos:R:3\n0 0 0\n",
                                    "1\nProperties=species:S:1:pos:R\nC 0 0 0\n",
                                    "1\nProperties=species:S:1:pos:R:2\nC 0 0 0\n",
                                    "1\nProperties=id:I:1:species:S:1:pos:R:3\n7 C 0 0\n",
                                    "1\nProperties=species:S:1:pos:R:99999999999\nC 0 0 0\n"}) {
        INFO(bytes);
        CHECK(isLineWith(xyzRefusal(bytes), "the.file: "));
    }
}

TEST_CASE("XYZ: more columns, signs, elements in upper or lower case or by number", "[readers]")
{
    Notes notes;
    const std::string atoms = "Fe +0.5 -1 +2e0 0.1 extra 7\nfe 1 2 3\nFE 1 2 3\n26 1 2 3\nCL 1 2 3\nc 0 1e-50 0\n";
    const std::vector<Sphere> spheres = parseXyz("6\n\n" + atoms, "a.xyz", 0, &notes);
    REQUIRE(spheres.size() == 6);
    CHECK(same(spheres[0].center, {0.5f, -1, 2}));
    CHECK(same(spheres[5].center, {0, 0, 0}));
    const Sphere chlorine = parseXyz("1\n\nCl 0 0 0\n", "a.xyz").front();
    const Sphere carbon = parseXyz("1\n\nC 0 0 0\n", "a.xyz").front();
    for (std::size_t i = 1; i < 4; ++i) {
        CHECK(same(spheres[i].color, spheres[0].color));
        CHECK(spheres[i].radius == spheres[0].radius);
    }
    CHECK_FALSE(same(spheres[0].color, carbon.color));
    CHECK(same(spheres[4].color, chlorine.color));
    CHECK(spheres[4].radius == 1.75f);
    CHECK(same(spheres[5].color, carbon.color));
    CHECK(notes.empty());
}

TEST_CASE("XYZ: unknown elements are drawn and named", "[readers]")
{
    Notes notes;
    const auto spheres =
        parseXyz("6\n\nXx 0 0 0\nC 1 0 0\nC1 2 0 0\nXx 3 0 0\n119 4 0 0\n0 0 0 1\n", "a.xyz", 0, &notes);
    CHECK(spheres.size() == 6);
    REQUIRE(notes.size() == 1);
    CHECK(isLineWith(notes[0], "a.xyz: "));
    for (const char* part : {"Xx (2)", "C1 (1)", "119 (1)", "0 (1)"})
        CHECK(test::contains(notes[0], part));
    CHECK_FALSE(test::contains(notes[0], "C (")); // which is known
    std::string many = "50\n\n";
    for (int i = 0; i < 50; ++i)
        many += "Q" + std::to_string(i) + std::string(100, 'q') + " 0 0 0\n";
    notes.clear();
    parseXyz(many, "a.xyz", 0, &notes);
    REQUIRE(notes.size() == 1);
    CHECK(test::contains(notes[0], " and 44 more"));
    CHECK(notes[0].size() < 300);
}

TEST_CASE("XYZ: the comment of extended XYZ says what the columns are", "[readers]")
{
    for (const std::string properties :
         {"Properties=pos:R:3:mass:R:1:species:S:1:id:I:1",
          "Lattice=\"1 0 0\" Properties=\"pos:R:3:mass:R:1:species:S:1\" pbc=\"T T T\""}) {
        const auto spheres = parseXyz("1\n" + properties + "\n1 2 3 16 O 5\n", "a.xyz");
        REQUIRE(spheres.size() == 1);
        CHECK(same(spheres[0].center, {1, 2, 3}));
        CHECK(spheres[0].radius == 1.52f);
    }
    const auto usual = parseXyz("1\nProperties=species:S:1:pos:R:3:forces:R:3\nO 1 2 3 4 5 6\n", "a.xyz");
    CHECK(same(usual.at(0).center, {1, 2, 3}));
}

TEST_CASE("XYZ: of several frames the first, or the one that is asked for", "[readers]")
{
    const std::string bytes = "1\nfirst\nC 1 0 0\n2\nsecond\nC 2 0 0\nC 3 0 0\n\n1\nthird\nC 4 0 0\n \n";
    Notes notes;
    const auto first = parseXyz(bytes, "a.xyz", 0, &notes);
    REQUIRE(first.size() == 1);
    CHECK(first[0].center.x == 1.0f);
    REQUIRE(notes.size() == 1);
    CHECK(isLineWith(notes[0], "a.xyz: the first of several frames"));
    CHECK(test::contains(notes[0], "--xyz-frame"));
    notes.clear();
    CHECK(parseXyz(bytes, "a.xyz", 1, &notes).size() == 1);
    CHECK(parseXyz(bytes, "a.xyz", 2, &notes).at(1).center.x == 3.0f);
    CHECK(parseXyz(bytes, "a.xyz", 3, &notes).at(0).center.x == 4.0f);
    CHECK(parseXyz("1\n\nC 0 0 0\n\n", "a.xyz", 0, &notes).size() == 1);
    CHECK(notes.empty()); // a frame was given, or there is only one
    const std::string error = errorOf([&] { parseXyz(bytes, "a.xyz", 4); });
    CHECK(isLineWith(error, "a.xyz: "));
    CHECK(test::contains(error, "frame 4"));
    CHECK(test::contains(error, "3 frames"));
    // A preceding frame that is wrong, and a count that is too small.
    CHECK(isLineWith(errorOf([&] { parseXyz("1\n\nC 0 0 0\nC 1 1 1\n1\n\nC 0 0 0\n", "a.xyz", 2); }), "line 4"));
    CHECK(isLineWith(errorOf([&] { parseXyz("9\n\nC 0 0 0\n1\n\nC 0 0 0\n", "a.xyz", 2); }), "a.xyz: "));
}

TEST_CASE("OBJ: errors name the line, and the index as it is in the file", "[readers]")
{
    const std::string vertices = "# four\nv 0 0 0\nv 1 0 0 # a comment\nv 1 1 0\n\nv 0 1 0\n";
    const std::vector<std::pair<std::string, std::string>> wrong{
        {"f 1 2 99\n", "vertex 99"},      {"f 1 2 0\n", "vertex 0"},
        {"f 1/1 -7//2 3\n", "vertex -7"}, {"f 1 2 4294967299\n", "vertex 4294967299"},
        {"f 1 2 x3\n", "'x3'"},           {"f 1 2\n", "2 vertices"},
        {"v 1 nan 0\n", "'nan'"},         {"v 1 2\n", "x y z"},
        {"v 1 1e20 0\n", "1e15"}};
    for (const auto& [line, part] : wrong) {
        INFO(line);
        const std::string error = objRefusal(vertices + "f 1 2 3 4 # all\n" + line);
        CHECK(isLineWith(error, "the.file: line 8: "));
        CHECK(test::contains(error, part));
    }
}

TEST_CASE("The colours of vertices are taken as sRGB", "[readers]")
{
    const Vec3 black{0, 0, 0}, half{0.214f, 0.214f, 0.214f}, red{1, 0, 0};
    const auto check = [&](const Mesh& mesh) {
        REQUIRE(mesh.positions.size() == 3);
        REQUIRE(mesh.colors.size() == 3);
        CHECK(same(mesh.colors[0], black));
        CHECK(length(mesh.colors[1] - half) < 4e-3f); // 128 is not quite a half of 255
        CHECK(same(mesh.colors[2], red));
    };
    const auto ply = [](const std::string& type, const std::string& prefix) {
        return plyHeader("ascii", "element vertex 3\nproperty float x\nproperty float y\nproperty float z\nproperty "
                                      + type + " " + prefix + "red\nproperty " + type + " " + prefix
                                      + "green\nproperty " + type + " " + prefix
                                      + "blue\nproperty uchar alpha\nelement face 1\n"
                                        "property list uchar int vertex_indices\n");
    };
    Notes notes;
    check(parsePly(ply("uchar", "") + "0 0 0 0 0 0 9\n1 0 0 128 128 128 9\n0 1 0 255 0 0 9\n3 0 1 2\n", "a", &notes));
    check(parsePly(ply("uchar", "diffuse_") + "0 0 0 0 0 0 9\n1 0 0 128 128 128 9\n0 1 0 255 0 0 9\n3 0 1 2\n", "a"));
    check(parsePly(ply("ushort", "") + "0 0 0 0 0 0 9\n1 0 0 32768 32768 32768 9\n0 +1 0 65535 0 0 9\n3 0 1 2\n", "a"));
    check(parsePly(ply("float", "") + "0 0 0 0 0 0 9\n1 0 0 0.5 0.5 0.5 9\n0 1 0 1 0 0 9\n3 0 1 2\n", "a"));
    check(parseObj("v 0 0 0 0 0 0\nv 1 0 0 0.5 0.5 .5\nv 0 1 0 1 0 0\nf 1 2 3\n", "a", &notes));
    CHECK(notes.empty());
    // Colours that not all vertices have, that are out of range or NaN, and colours of faces.
    CHECK(parseObj("v 0 0 0\nv 1 0 0 0.5 0.5 .5\nv 0 1 0 1 0 0\nf 1 2 3\n", "a.obj", &notes).colors.empty());
    CHECK(parseObj("v 0 0 0 0 0 9\nv 1 0 0 0.5 0.5 .5\nv 0 1 0 1 0 0\nf 1 2 3\n", "b.obj", &notes).colors.empty());
    CHECK(parsePly(ply("float", "") + "0 0 0 0 0 0 9\n1 0 0 nan 0.5 0.5 9\n0 1 0 1 0 0 9\n3 0 1 2\n", "c.ply", &notes)
              .colors.empty());
    REQUIRE(notes.size() == 3);
    for (std::size_t i = 0; i < 3; ++i)
        CHECK(isLineWith(notes[i], std::vector<std::string>{"a.obj: ", "b.obj: ", "c.ply: "}[i]));
    notes.clear();
    parsePly(plyHeader("ascii", plainElements + "property uchar red\n")
                 + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n0.5 0.25 -2\n4 0 1 2 3 9\n3 4 1 0 9\n",
             "d.ply", &notes);
    REQUIRE(notes.size() == 1);
    CHECK(isLineWith(notes[0], "d.ply: the colours of faces"));
    notes.clear();
    parsePly(asciiMixed(), "a.ply", &notes); // red alone is not a colour
    parseObj(plainObj, "a.obj", &notes);     // nor is a weight
    CHECK(notes.empty());
}

TEST_CASE("A scene takes files by their ending and says which one is wrong", "[readers]")
{
    const test::TemporaryFolder folder;
    Scene scene;
    addFile(scene, folder.write("v_2x3x4_uint8.raw", std::string(24, 'v')), true);
    addFile(scene, folder.write("m.ply", binaryPlain(false)), true);
    addFile(scene, folder.write("m.obj", plainObj), true);
    addFile(scene, folder.write("m.xyz", "1\n\nC 100 200 300\n"), true);
    CHECK(scene.volumes.size() == 1);
    CHECK(scene.meshes.size() == 2);
    CHECK(scene.spheres.size() == 1);
    // Each file fills the unit cube, and the bounds are hardly larger.
    for (int axis = 0; axis < 3; ++axis) {
        CHECK(example::component(scene.bounds.lo, axis) < 0.0f);
        CHECK(example::component(scene.bounds.lo, axis) > -1e-3f);
        CHECK(example::component(scene.bounds.hi, axis) > 1.0f);
        CHECK(example::component(scene.bounds.hi, axis) < 1.001f);
    }
    Scene unfitted;
    addFile(unfitted, folder / "m.xyz", false);
    CHECK(length(unfitted.bounds.center() - Vec3{100, 200, 300}) < 1e-3f);

    for (const std::string name : {"x.ply", "x.obj", "x.xyz", "x_2x2x2_uint8.raw", "x.stl", "x", "m.PLY"}) {
        INFO(name); // none of these files exists
        CHECK(isLineWith(errorOf([&] { addFile(scene, folder / name, true); }), folder / name));
    }
    for (const std::string name : {"e.ply", "e.obj", "e.xyz", "e_2x2x2_uint8.raw"}) {
        INFO(name); // all empty
        folder.write(name, "");
        CHECK(isLineWith(errorOf([&] { addFile(scene, folder / name, true); }), folder / name));
        std::filesystem::create_directory(folder / ("d" + name)); // and folders
        CHECK(isLineWith(errorOf([&] { addFile(scene, folder / ("d" + name), true); }), folder / ("d" + name)));
    }
}

TEST_CASE("A scene says what is not as its files may have meant it", "[readers]")
{
    const test::TemporaryFolder folder;
    const auto notesOf = [&](const std::string& name, const std::string& bytes) {
        Scene scene;
        addFile(scene, folder.write(name, bytes), true);
        return scene.notes;
    };
    const auto checkNote = [](const Notes& notes, const std::string& name, const std::string& part) {
        REQUIRE(notes.size() == 1);
        CHECK(isLineWith(notes[0], name + ": "));
        CHECK(test::contains(notes[0], part));
    };
    const float nan = std::numeric_limits<float>::quiet_NaN(), inf = std::numeric_limits<float>::infinity();
    std::string sparse(100 * 100 * 100, '\0');
    for (const std::size_t at : {50u * 10000 + 51 * 100 + 51, 3u}) { // one bright voxel beside the lattice, or on it
        CHECK(notesOf("s_100x100x100_uint8.raw", std::string(sparse).replace(at, 1, "\xff")).empty());
    }
    CHECK(notesOf("a_2x3x4_uint8.raw", std::string(24, 'v')).empty());
    CHECK(notesOf("a_2x2x2_uint16.raw", bytesOf<std::uint16_t>({9, 7, 300, 40000, 7, 8, 9, 10})).empty());
    CHECK(notesOf("a_2x2x2_float32.raw", bytesOf<float>({0, 0, 0, 0, 0, 0, 0, 1e-9f})).empty());
    checkNote(notesOf("z_2x3x4_uint8.raw", std::string(24, '\0')), folder / "z_2x3x4_uint8.raw", "all voxels are 0");
    checkNote(notesOf("s_100x100x100_uint8.raw", sparse), folder / "s_100x100x100_uint8.raw", "all voxels are 0");
    checkNote(notesOf("d_2x3x4_uint8.raw", std::string(23, '\0') + '\x09'), folder / "d_2x3x4_uint8.raw",
              "from 0 to 9");
    checkNote(notesOf("z_2x2x2_uint16.raw", std::string(16, '\0')), folder / "z_2x2x2_uint16.raw", "all voxels are 0");
    checkNote(notesOf("z_2x2x2_float32.raw", bytesOf(std::vector<float>(8, 2.5f))), folder / "z_2x2x2_float32.raw",
              "all voxels are 2.5");
    checkNote(notesOf("n_2x2x2_float32.raw", bytesOf<float>({-3, 0, nan, 5, inf, -inf, 2, 1})),
              folder / "n_2x2x2_float32.raw", "not finite: 3; they count as 0");
    // Notes of readers are passed on as well.
    checkNote(notesOf("u.xyz", "1\n\nXx 0 0 0\n"), folder / "u.xyz", "Xx (1)");
    checkNote(notesOf("u.obj", "v 0 0 0\nv 1 0 0 0.5 0.5 .5\nv 0 1 0 1 0 0\nf 1 2 3\n"), folder / "u.obj", "colours");
    checkNote(notesOf("u.ply", plyHeader("ascii", plainElements + "property uchar red\n")
                                   + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n0.5 0.25 -2\n4 0 1 2 3 9\n3 4 1 0 9\n"),
              folder / "u.ply", "colours");
}

TEST_CASE("What is too small beside its place is left where it is", "[readers]")
{
    for (const float place : {1e14f, 0.0f})
        for (const float size : {1e-38f, 1e-42f, 0.0f}) {
            Scene scene;
            scene.add(Mesh{{{0, place, 0}, {size, place, 0}, {0, place, size}}, {{0, 1, 2}}}, true);
            for (const Vec3& p : scene.meshes.front().mesh.positions)
                CHECK((std::isfinite(p.x) && std::isfinite(p.y) && std::isfinite(p.z)));
        }
}

} // namespace readers_cases
