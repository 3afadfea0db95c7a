// Volumes with a header: what is read of .nrrd, .nhdr, .mha and .mhd files, and voxels that are not cubes. Each error
// is a single line that names the file and the line, and is the same on all ranks.
#include "support.hpp"
#include "together.hpp"

#include <scene_files.hpp>
#include <volume_sampler.hpp>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <string>
#include <vector>

namespace headers_cases {

using namespace example;
using test::contains;
using test::errorOf;
using test::isLineWith;
using test::ofRanks;

namespace {

// 3x2x4 values that all types can hold or, with `hasSign`, all signed types.
std::vector<double> valuesOf(bool hasSign)
{
    std::vector<double> values;
    for (int i = 0; i < 24; ++i)
        values.push_back(hasSign ? 5 * i - 60 : 5 * i);
    return values;
}

template <class T>
std::string bytesAs(const std::vector<double>& values, bool isBigEndian)
{
    std::string bytes;
    for (const double value : values) {
        const T typed = static_cast<T>(value);
        char one[sizeof(T)];
        std::memcpy(one, &typed, sizeof typed);
        if (isBigEndian)
            std::reverse(one, one + sizeof(T));
        bytes.append(one, sizeof(T));
    }
    return bytes;
}

struct TypeCase {
    std::string nrrd, meta, raw;
    bool hasSign;
    std::string (*bytes)(const std::vector<double>&, bool);
};
const std::vector<TypeCase> typeCases{{"uchar", "MET_UCHAR", "uint8", false, bytesAs<std::uint8_t>},
                                      {"signed char", "MET_CHAR", "int8", true, bytesAs<std::int8_t>},
                                      {"unsigned short", "MET_USHORT", "uint16", false, bytesAs<std::uint16_t>},
                                      {"short", "MET_SHORT", "int16", true, bytesAs<std::int16_t>},
                                      {"uint32_t", "MET_UINT", "uint32", false, bytesAs<std::uint32_t>},
                                      {"int", "MET_INT", "int32", true, bytesAs<std::int32_t>},
                                      {"float", "MET_FLOAT", "float32", true, bytesAs<float>},
                                      {"double", "MET_DOUBLE", "float64", true, bytesAs<double>}};

std::string nrrdOf(const std::string& type, bool isBigEndian, const std::string& more)
{
    return "NRRD0004\n# made by hand\ntype: " + type + "\ndimension: 3\nsizes: 3 2 4\nspacings: 1 1.5 2\n"
           + "axis mins: -3 4 5\nendian: " + (isBigEndian ? "big" : "little") + "\nencoding: raw\nkey:=value\n" + more;
}
std::string metaOf(const std::string& type, bool isBigEndian, const std::string& more)
{
    return std::string("ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = ")
           + (isBigEndian ? "True" : "False") + "\nOffset = -3 4 5\nElementSpacing = 1 1.5 2\nDimSize = 3 2 4\n"
           + "ElementType = " + type + '\n' + more;
}

// Whether the volume has these voxel values.
template <class T>
bool hasValues(const VolumeSource& source, const std::vector<double>& values)
{
    const VoxelBlock block(source, {0, 0, 0}, source.info.dims);
    for (std::size_t i = 0; i < values.size(); ++i)
        if (static_cast<double>(block.data<T>()[i]) != values[i])
            return false;
    return true;
}
bool hasValues(const VolumeSource& source, const std::vector<double>& values)
{
    return withVoxelType(source.info.type, [&](auto voxel) { return hasValues<decltype(voxel)>(source, values); });
}

bool same(const Vec3& a, const Vec3& b) { return a.x == b.x && a.y == b.y && a.z == b.z; }

const std::string goodNrrd = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 3 4\nencoding: raw\n",
                  goodMeta = "ObjectType = Image\nNDims = 3\nDimSize = 2 3 4\nElementType = MET_UCHAR\n";

struct Bad {
    std::string name, bytes, expected;
};

std::string with(std::string text, const std::string& from, const std::string& to)
{
    const std::size_t at = text.find(from);
    REQUIRE(at != std::string::npos);
    return text.replace(at, from.size(), to);
}

std::vector<Bad> badHeaders()
{
    const std::string data = std::string(24, 'v');
    const auto nrrd = [&](const std::string& from, const std::string& to) { // with voxels
        return with(goodNrrd + '\n' + data, from, to);
    };
    const auto meta = [&](const std::string& from, const std::string& to) {
        return with(goodMeta + "ElementDataFile = LOCAL\n" + data, from, to);
    };
    return {
        {"a.nrrd", "", "expected 'NRRD000'"},
        {"a.nrrd", "NRRD\n", "expected 'NRRD000'"},
        {"a.nrrd", std::string(5000, '\0'), "expected 'NRRD000'"},
        {"a.nrrd", nrrd("type: uchar\n", ""), "no line 'type'"},
        {"a.nrrd", nrrd("uchar", "uchars"), "line 2: the type 'uchars'"},
        {"a.nrrd", nrrd("uchar", "block"), "line 2: the type 'block'"},
        {"a.nrrd", nrrd("uchar", "long long"), "line 2: the type 'long long'"},
        {"a.nrrd", nrrd("uchar", "short"), "no line 'endian'"},
        {"a.nrrd", nrrd("dimension: 3\n", ""), "line 3: expected a line 'dimension'"},
        {"a.nrrd", nrrd("dimension: 3", "dimension: 4"), "line 3: expected dimension 3"},
        {"a.nrrd", nrrd("dimension: 3", "dimension: three"), "line 3: expected 1 number"},
        {"a.nrrd", nrrd("sizes: 2 3 4\n", ""), "no line 'sizes'"},
        {"a.nrrd", nrrd("2 3 4", "2 3"), "line 4: expected 3 numbers"},
        {"a.nrrd", nrrd("2 3 4", "2 3 4 5"), "line 4: expected 3 numbers"},
        {"a.nrrd", nrrd("2 3 4", "2 3 -4"), "line 4: expected dimensions from 2 to 65536, got -4"},
        {"a.nrrd", nrrd("2 3 4", "2 3 99999999999999999999"), "line 4: expected 3 numbers"},
        {"a.nrrd", nrrd("2 3 4", "1 3 8"), "line 4: expected dimensions"},
        {"a.nrrd", nrrd("encoding: raw\n", ""), "no line 'encoding'"},
        {"a.nrrd", nrrd("encoding: raw", "encoding: gzip"), "line 5: the encoding 'gzip' cannot be read in parts"},
        {"a.nrrd", nrrd("encoding: raw", "encoding raw"), "line 5: expected 'field: value'"},
        {"a.nrrd", nrrd("encoding: raw\n", "encoding: raw\nendian: middle\n"), "line 6: expected endian"},
        {"a.nrrd", nrrd("encoding: raw\n", "encoding: raw\nspacings: 1 0 1\n"), "line 6: expected a spacing"},
        {"a.nrrd", nrrd("encoding: raw\n", "encoding: raw\nspacings: 1 1\n"), "line 6: expected 3 numbers"},
        {"a.nrrd", nrrd("encoding: raw\n", "encoding: raw\nspacings: 1 1 inf\n"), "line 6: expected a spacing"},
        {"a.nrrd", nrrd("encoding: raw\n", "encoding: raw\nspace directions: (1,0,0) (0,1,0)\n"),
         "line 6: expected 3 vectors"},
        {"a.nrrd", nrrd("encoding: raw\n", "encoding: raw\nspace directions: (1,0,0) (0,1,0) none\n"),
         "line 6: expected 3 vectors"},
        {"a.nrrd", nrrd("encoding: raw\n", "encoding: raw\nspace directions: (1,0,0) (0,0,0) (0,0,1)\n"),
         "line 6: expected a spacing"},
        {"a.nrrd", nrrd("encoding: raw\n", "encoding: raw\nspace origin: (1,2,nan)\n"), "line 6: expected an origin"},
        {"a.nrrd", nrrd("encoding: raw\n", "encoding: raw\nspacings: 1 1 1e-9\n"), "too small beside its extent"},
        {"a.nrrd", goodNrrd, "expected a line 'data file'"},
        {"a.nrrd", nrrd("vvv", "vv"), "expected"},
        {"a.nrrd", nrrd("vvv", "vvvv"), "expected"},
        {"a.nrrd", nrrd("encoding: raw\n", "encoding: raw\nbyte skip: -2\n"), "line 6: expected a byte skip"},
        {"a.nrrd", nrrd("encoding: raw\n", "encoding: raw\nbyte skip: 9\n"), "expected"},
        {"a.nrrd", nrrd("encoding: raw\n", "encoding: raw\nline skip: 9\n"), "expected 9 lines before the voxels"},
        {"a.nhdr", goodNrrd + "data file: none.raw\n", "none.raw: cannot be opened"},
        {"a.nhdr", goodNrrd + "data file: .\n", "a.nhdr: "},
        {"a.nhdr", goodNrrd + "data file: LIST\n", "line 6: expected one data file"},
        {"a.nhdr", goodNrrd + "data file: slice%03d.raw 1 4 1\n", "line 6: expected one data file"},
        {"a.nhdr", goodNrrd + "data file:\n", "line 6: expected one data file"},
        {"a.nhdr", goodNrrd + std::string(2000000, 'x'), "the header does not end"},
        {"a.mhd", "", "no line 'DimSize"},
        {"a.mha", meta("Image", "Scene"), "line 1: expected ObjectType = Image"},
        {"a.mha", meta("NDims = 3", "NDims = 2"), "line 2: expected NDims = 3"},
        {"a.mha", meta("NDims = 3\n", ""), "line 2: expected NDims before"},
        {"a.mha", meta("2 3 4", "2 3"), "line 3: expected 3 numbers"},
        {"a.mha", meta("2 3 4", "2 3 65537"), "line 3: expected dimensions"},
        {"a.mha", meta("DimSize = 2 3 4\n", ""), "no line 'DimSize"},
        {"a.mha", meta("MET_UCHAR", "MET_LONG_LONG"), "line 4: the type 'MET_LONG_LONG'"},
        {"a.mha", meta("ElementType = MET_UCHAR\n", ""), "no line 'ElementType"},
        {"a.mha", meta("ElementType", "CompressedData = True\nElementType"), "line 4: compressed"},
        {"a.mha", meta("ElementType", "BinaryData = False\nElementType"), "line 4: voxels as text"},
        {"a.mha", meta("ElementType", "BinaryDataByteOrderMSB = perhaps\nElementType"), "line 4: expected True"},
        {"a.mha", meta("ElementType", "ElementSpacing = 1 -1 1\nElementType"), "line 4: expected a spacing"},
        {"a.mha", meta("ElementType", "Offset = 1 2 x\nElementType"), "line 4: expected 3 numbers"},
        {"a.mha", meta("ElementType", "ElementNumberOfChannels = 3\nElementType"), "line 4: expected one channel"},
        {"a.mha", meta("ElementType", "HeaderSize = -7\nElementType"), "line 4: expected a HeaderSize"},
        {"a.mha", meta("ElementType", "words\nElementType"), "line 4: expected 'Key = value'"},
        {"a.mha", meta("vvv", "vv"), "expected"},
        {"a.mhd", goodMeta, "no line 'ElementDataFile"},
        {"a.mhd", goodMeta + "ElementDataFile = LIST\n", "line 5: expected one ElementDataFile"},
        {"a.mhd", goodMeta + "ElementDataFile = none.raw\n", "none.raw: cannot be opened"}};
}

} // namespace

TEST_CASE("All types of voxels are read, of either byte order, with the header or beside it", "[headers]")
{
    const test::TemporaryFolder folder;
    for (const TypeCase& type : typeCases)
        for (const bool isBig : {false, true}) {
            INFO(type.raw << (isBig ? " big-endian" : ""));
            const std::vector<double> values = valuesOf(type.hasSign);
            const std::string bytes = type.bytes(values, isBig);
            folder.write("beside.bin", "xyz" + bytes);
            folder.write("lines.bin", "one\ntwo\n" + bytes);
            const std::vector<std::string> files{
                folder.write("a_3x2x4_" + type.raw + (isBig ? "be" : "") + ".raw", bytes),
                folder.write("a.nrrd", nrrdOf(type.nrrd, isBig, "\n") + bytes),
                folder.write("b.nhdr", nrrdOf(type.nrrd, isBig, "byteskip: 3\ndatafile: beside.bin\n")),
                folder.write("c.nhdr", nrrdOf(type.nrrd, isBig, "byte skip: -1\ndata file: beside.bin\n\n")),
                folder.write("d.nhdr", nrrdOf(type.nrrd, isBig, "line skip: 2\ndata file: lines.bin\n")),
                folder.write("a.mha", metaOf(type.meta, isBig, "ElementDataFile = LOCAL\n") + bytes),
                folder.write("b.mhd", metaOf(type.meta, isBig, "HeaderSize = 3\nElementDataFile = beside.bin\n")),
                folder.write("c.mhd", metaOf(type.meta, isBig,
                                             "HeaderSize = -1\nElementDataFile = " + folder / "beside.bin\n"))};
            for (const std::string& file : files) {
                INFO(file);
                for (const int ranks : {1, 3}) {
                    const auto right = ofRanks<int>(ranks, [&](const Loaders& loaders) {
                        const VolumeSource source = openVolume(file, loaders);
                        const bool hasHeader = !contains(file, ".raw");
                        return source.info.dims == Index3{3, 2, 4} && hasValues(source, values)
                               && same(source.info.spacing, hasHeader ? Vec3{1, 1.5f, 2} : Vec3{1, 1, 1})
                               && same(source.info.origin, hasHeader ? Vec3{-3, 4, 5} : Vec3{0, 0, 0})
                               && (type.raw == "uint8" || source.info.maximum == static_cast<float>(values.back()));
                    });
                    CHECK(std::count(right.begin(), right.end(), 1) == ranks);
                }
            }
        }
}

TEST_CASE("A range of integers with a sign is all of it, one of floats begins at zero", "[headers]")
{
    const test::TemporaryFolder folder;
    for (const TypeCase& type : typeCases)
        if (type.hasSign) {
            INFO(type.raw);
            const VolumeInfo info =
                openVolume(folder.write("a_3x2x4_" + type.raw + ".raw", type.bytes(valuesOf(true), false))).info;
            CHECK(info.minimum == (contains(type.raw, "float") ? 0.0f : -60.0f));
            CHECK(info.maximum == 55.0f);
        }
}

TEST_CASE("Directions of an NRRD are spacings, and a note if they are turned", "[headers]")
{
    const test::TemporaryFolder folder;
    const auto open = [&](const std::string& lines) {
        return openVolume(folder.write("a.nrrd", goodNrrd + lines + '\n' + std::string(24, 'v')));
    };
    const VolumeSource straight =
        open("space: left-posterior-superior\nspace directions: (.5,0,0) (0, 1 ,0) (0,0,2e0)\n"
             "space origin: (7,-8,9)\n");
    CHECK(same(straight.info.spacing, {0.5f, 1, 2}));
    CHECK(same(straight.info.origin, {7, -8, 9}));
    CHECK(straight.notes.empty());
    const VolumeSource turned = open("space directions: (0,3,0) (0,0,-4) (1,0,0)\n");
    CHECK(same(turned.info.spacing, {3, 4, 1}));
    REQUIRE(turned.notes.size() == 1);
    CHECK(contains(turned.notes[0], "a.nrrd: line 6: its axes are turned"));
    CHECK(same(open("spacings: 2 nan 3\n").info.spacing, {2, 1, 3}));
    const VolumeSource meta = openVolume(folder.write(
        "a.mha", goodMeta + "TransformMatrix = 1 0 0 0 0 1 0 -1 0\nElementSize = 1 2 3\nElementDataFile = LOCAL\n"
                     + std::string(24, 'v')));
    CHECK(same(meta.info.spacing, {1, 2, 3}));
    REQUIRE(meta.notes.size() == 1);
    CHECK(contains(meta.notes[0], "a.mha: line 5: its axes are turned"));
}

TEST_CASE("A bad header is one line with the file and the line, the same on all ranks", "[headers]")
{
    const test::TemporaryFolder folder;
    CHECK(openVolume(folder.write("good.nrrd", goodNrrd + '\n' + std::string(24, 'v'))).info.dims == Index3{2, 3, 4});
    CHECK(openVolume(folder.write("good.mha", goodMeta + "ElementDataFile = LOCAL\n" + std::string(24, 'v'))).info.dims
          == Index3{2, 3, 4});
    const std::vector<Bad> all = badHeaders();
    CHECK(all.size() >= 60);
    for (const Bad& bad : all) {
        const std::string file = folder.write(bad.name, bad.bytes);
        INFO(bad.bytes.substr(0, 200) << "\nexpected: " << bad.expected);
        for (const int ranks : {1, 3})
            for (const std::string& error : ofRanks<std::string>(ranks, [&](const Loaders& loaders) {
                     return errorOf([&] {
                         Scene scene;
                         addFile(scene, file, true, 0, loaders);
                     });
                 })) {
                CHECK(isLineWith(error, bad.expected));
                CHECK(error.compare(0, file.size() + 2, file + ": ") == 0);
            }
    }
    for (const char* name : {"none.nhdr", "none.mha"})
        CHECK(errorOf([&] { openVolume(folder / name); }) == folder / name + ": cannot be opened");
}

TEST_CASE("A volume is as large as its spacing says", "[headers]")
{
    const test::TemporaryFolder folder;
    const std::string file = folder.write("a_3x5x9_uint8.raw", std::string(135, 'v'));
    const auto boundsOf = [&](bool fit, const VoxelGrid& grid) {
        Scene scene;
        addFile(scene, file, fit, 0, {}, grid);
        return scene.volumes.front().bounds();
    };
    VoxelGrid grid;
    CHECK(same(boundsOf(true, grid).extent(), {0.25f, 0.5f, 1}));
    CHECK(same(boundsOf(false, grid).lo, {0, 0, 0}));
    grid.spacing = Vec3{16, 4, 1};
    CHECK(same(boundsOf(true, grid).extent(), {1, 0.5f, 0.25f}));
    CHECK(same(boundsOf(true, grid).center(), {0.5f, 0.5f, 0.5f}));
    grid.origin = Vec3{-10, 20, 30};
    CHECK(same(boundsOf(true, grid).center(), {0.5f, 0.5f, 0.5f}));
    CHECK(same(boundsOf(false, grid).lo, {-10, 20, 30}));
    CHECK(same(boundsOf(false, grid).hi, {22, 36, 38}));
    grid.origin = Vec3{1e9f, 0, 0};
    CHECK(boundsOf(true, grid).extent().x == 1);
    CHECK(isLineWith(errorOf([&] { boundsOf(false, grid); }), file + ": its voxels are too small beside the distance"));
}

TEST_CASE("Voxels that are no cubes have the light and opacity of cubes", "[headers]")
{
    // The same field on two grids. It is linear, so that leaving out slices loses nothing.
    const auto sampler = [](int slices, float thickness) {
        VolumeSource source;
        source.info.dims = {17, 17, slices}; // longest along the thick sides
        source.info.type = VoxelType::Float32;
        source.info.maximum = 80;
        source.info.spacing = {1, 1, thickness};
        source.open = [thickness] {
            return [thickness](const Index3& lo, const Index3& hi, std::byte* out) {
                for (int z = lo[2]; z < hi[2]; ++z)
                    for (int y = lo[1]; y < hi[1]; ++y)
                        for (int x = lo[0]; x < hi[0]; ++x, out += sizeof(float)) {
                            const float value = static_cast<float>(x) + 0.25f * static_cast<float>(y)
                                                + static_cast<float>(z) * thickness;
                            std::memcpy(out, &value, sizeof value);
                        }
            };
        };
        const VolumeObject object(source, true);
        return VolumeSampler({VoxelBlock(object.source, {0, 0, 0}, source.info.dims), object.placement,
                              object.source.look, object.shown, object.geometry},
                             0.01f);
    };
    const VolumeSampler cubes = sampler(33, 1), slabs = sampler(17, 2);
    Light light;
    light.direction = unit(Vec3{0.3f, 0.4f, 0.9f});
    const Vec3 view = unit(Vec3{-0.2f, -0.5f, -0.8f});
    int lit = 0;
    for (const Vec3& p : {Vec3{0.5f, 0.5f, 0.5f}, Vec3{0.65f, 0.35f, 0.4f}, Vec3{0.4f, 0.6f, 0.15f}}) {
        const auto a = cubes.shade(cubes.toVoxel(p), view, light), b = slabs.shade(slabs.toVoxel(p), view, light);
        CHECK(a.alpha > 0.0f);
        CHECK(std::fabs(a.alpha - b.alpha) < 1e-5f);
        CHECK(length(a.color - b.color) < 1e-5f);
        CHECK(length(a.albedo - b.albedo) < 1e-5f);
        CHECK(!(a.albedo == a.color)); // it has no light
        lit += a.color.x > 0;
        CHECK(std::fabs(cubes.toVoxel(p).z - 2 * slabs.toVoxel(p).z) < 1e-4f);
    }
    CHECK(lit == 3);
}

} // namespace headers_cases
