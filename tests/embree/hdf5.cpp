// Volumes in HDF5 files: all types and layouts are read, each rank reads its part, and each error is a single line.
#include "support.hpp"
#include "together.hpp"

#include <scene_files.hpp>
#include <voxel_block.hpp>

#include <algorithm>
#include <cstring>
#include <iterator>
#include <string>
#include <vector>

namespace hdf5_cases {

using namespace example;
using test::contains;
using test::errorOf;
using test::isLineWith;
using test::ofRanks;

TEST_CASE("The name of a data set is behind that of the file", "[hdf5]")
{
    using Parts = std::pair<std::string, std::string>;
    CHECK(splitHdf5Path("a.h5:/b/c") == Parts("a.h5", "/b/c"));
    CHECK(splitHdf5Path("a.h5:b") == Parts("a.h5", "/b"));
    CHECK(splitHdf5Path("x/a.hdf5:/b.h5") == Parts("x/a.hdf5", "/b.h5"));
    CHECK(splitHdf5Path("a.h5") == Parts("a.h5", "/"));
    for (const std::string no : {"a.ply", ".h5", "h5:/a", "a.h5x", "a.h5/b_2x2x2_uint8.raw", ""}) {
        INFO(no);
        CHECK_FALSE(isHdf5(no));
    }
}

#if defined(DFB_RENDER_HAS_HDF5)

namespace {

const Index3 dims{6, 5, 40};

std::vector<double> valuesOf(bool hasSign)
{
    std::vector<double> values;
    for (int i = 0; i < 6 * 5 * 40; ++i)
        values.push_back(i * 37 % 101 - (hasSign ? 60 : 0));
    return values;
}

struct Layout {
    std::vector<hsize_t> extent, chunk; // no chunk: contiguous
    bool isPacked = false;
    H5Z_filter_t filter = 0; // of the test's own
};

void write(const std::string& file, const std::string& name, const std::vector<double>& values, hid_t type,
           const Layout& layout)
{
    const hid_t f = H5Fcreate(file.c_str(), H5F_ACC_TRUNC, H5P_DEFAULT, H5P_DEFAULT),
                space = H5Screate_simple(static_cast<int>(layout.extent.size()), layout.extent.data(), nullptr),
                links = H5Pcreate(H5P_LINK_CREATE), made = H5Pcreate(H5P_DATASET_CREATE);
    H5Pset_create_intermediate_group(links, 1);
    if (!layout.chunk.empty())
        H5Pset_chunk(made, static_cast<int>(layout.chunk.size()), layout.chunk.data());
    if (layout.isPacked)
        H5Pset_deflate(made, 4);
    if (layout.filter != 0)
        H5Pset_filter(made, layout.filter, H5Z_FLAG_MANDATORY, 0, nullptr);
    const hid_t data = H5Dcreate2(f, name.c_str(), type, space, links, made, H5P_DEFAULT);
    REQUIRE(data >= 0);
    CHECK(H5Dwrite(data, H5T_NATIVE_DOUBLE, H5S_ALL, H5S_ALL, H5P_DEFAULT, values.data()) >= 0);
    H5Dclose(data);
    H5Pclose(made);
    H5Pclose(links);
    H5Sclose(space);
    H5Fclose(f);
}

bool hasValues(const VolumeSource& source, const std::vector<double>& values)
{
    const VoxelBlock block(source, {0, 0, 0}, source.info.dims);
    return withVoxelType(source.info.type, [&](auto voxel) {
        const auto* voxels = block.data<decltype(voxel)>();
        return std::equal(values.begin(), values.end(), voxels,
                          [](double a, auto b) { return a == static_cast<double>(b); });
    });
}

} // namespace

TEST_CASE("Data sets of all types and layouts are read, each rank its part", "[hdf5]")
{
    const test::TemporaryFolder folder;
    const std::string file = folder / "a.h5";
    struct Type {
        hid_t id;
        bool hasSign, isFloat;
    };
    for (const Type& type :
         {Type{H5T_STD_U8LE, false, false}, Type{H5T_STD_I8BE, true, false}, Type{H5T_STD_U16BE, false, false},
          Type{H5T_STD_I16LE, true, false}, Type{H5T_STD_U32LE, false, false}, Type{H5T_STD_I64BE, true, false},
          Type{H5T_IEEE_F32BE, true, true}, Type{H5T_IEEE_F64LE, true, true}})
        for (const Layout& layout :
             {Layout{{40, 5, 6}, {}}, Layout{{1, 40, 5, 1, 6}, {}}, Layout{{40, 5, 6}, {7, 2, 6}, true}}) {
            const std::vector<double> values = valuesOf(type.hasSign);
            write(file, "/step/7/density", values, type.id, layout);
            const std::size_t bytes = H5Tget_size(type.id), rows = bytes * values.size();
            for (const int ranks : {1, 3}) {
                const auto results = ofRanks<std::string>(ranks, [&](const Loaders& loaders) -> std::string {
                    const VolumeSource source = openHdf5(file + ":/step/7/density", loaders);
                    const std::uint64_t read = loaders.bytesRead();
                    if (source.info.dims != dims || !hasValues(source, values))
                        return "other voxels";
                    if (bytes > 1 && source.info.minimum != (type.hasSign && !type.isFloat ? -60.0f : 0.0f))
                        return "another range";
                    // Allowed are a share of the voxels for the range and the look, and a few rows.
                    return read > 2 * rows / static_cast<std::size_t>(ranks) + 100 * bytes ? "read too much" : "";
                });
                for (const std::string& result : results)
                    CHECK(result.empty());
            }
        }
}

TEST_CASE("A data set is the volume that a raw file with its voxels is", "[hdf5]")
{
    const test::TemporaryFolder folder;
    const std::vector<double> values = valuesOf(true);
    write(folder / "a.h5", "d", values, H5T_IEEE_F32LE, {{40, 5, 6}, {16, 5, 6}, true});
    const std::vector<float> floats(values.begin(), values.end());
    const std::string raw =
        folder.write("a_6x5x40_float32.raw",
                     std::string(reinterpret_cast<const char*>(floats.data()), floats.size() * sizeof(float)));
    VoxelGrid grid;
    grid.spacing = Vec3{1, 1, 2};
    Scene a, b;
    addFile(a, raw, true, 0, {}, grid);
    addFile(b, folder / "a.h5:d", true, 0, {}, grid);
    CHECK(a.bounds == b.bounds);
    CHECK(a.focus().box == b.focus().box);
    const VolumeInfo &one = a.volumes[0].source.info, &other = b.volumes[0].source.info;
    CHECK(one.minimum == other.minimum);
    CHECK(one.maximum == other.maximum);
    CHECK(a.volumes[0].source.visible->isSeen == b.volumes[0].source.visible->isSeen);
}

TEST_CASE("What is wrong with an HDF5 file is one line, the same on all ranks", "[hdf5]")
{
    const test::TemporaryFolder folder;
    const std::vector<double> values(24, 1);
    write(folder / "good.h5", "/a/b", values, H5T_STD_U8LE, {{2, 3, 4}, {}});
    write(folder / "flat.h5", "d", values, H5T_STD_U8LE, {{24}, {}});
    write(folder / "two.h5", "d", values, H5T_STD_U8LE, {{4, 6}, {}});
    write(folder / "four.h5", "d", std::vector<double>(16, 1), H5T_STD_U8LE, {{2, 2, 2, 2}, {}});
    const std::string good = [&] {
        std::ifstream stream(folder / "good.h5", std::ios::binary);
        return std::string(std::istreambuf_iterator<char>(stream), {});
    }();
    const auto asItIs = [](unsigned, std::size_t, const unsigned*, std::size_t bytes, std::size_t*, void**) {
        return bytes;
    };
    const H5Z_class2_t filter{H5Z_CLASS_T_VERS, 300, 1, 1, "ours", nullptr, nullptr, asItIs};
    H5Zregister(&filter);
    write(folder / "filtered.h5", "d", values, H5T_IEEE_F32LE, {{2, 3, 4}, {2, 3, 4}, false, filter.id});
    H5Zunregister(filter.id); // those who read it do not have it
    folder.write("text.h5", "no HDF5 file\n");
    folder.write("empty.h5", "");
    folder.write("cut.h5", good.substr(0, good.size() / 2));
    std::filesystem::create_directory(folder / "folder.h5");
    for (const auto& [name, expected] : std::vector<std::pair<std::string, std::string>>{
             {"good.h5", "expected a data set, as in file.h5:/path; there are /a/b"},
             {"good.h5:/", "expected a data set"},
             {"good.h5:/a", "expected a data set"},
             {"good.h5:/a/c", "expected a data set"},
             {"good.h5:", "expected a data set"},
             {"flat.h5:d", "expected a data set with three axes of 2 to 65536 values, got 24"},
             {"two.h5:/d", "got 4x6"},
             {"four.h5:/d", "got 2x2x2x2"},
             {"filtered.h5:/d", "this HDF5 library lacks the filter ours (300)"},
             {"text.h5:/d", "cannot be opened as an HDF5 file"},
             {"empty.h5:/d", "cannot be opened"},
             {"cut.h5:/a/b", ": "},
             {"folder.h5:/d", "cannot be opened"},
             {"none.h5:/d", "cannot be opened"}})
        for (const int ranks : {1, 3}) {
            INFO(name);
            for (const std::string& error : ofRanks<std::string>(ranks, [&](const Loaders& loaders) {
                     return errorOf([&] {
                         Scene scene;
                         addFile(scene, folder / name, true, 0, loaders);
                     });
                 })) {
                CHECK(isLineWith(error, expected));
                CHECK(error.compare(0, (folder / name).size() + 2, folder / name + ": ") == 0);
            }
        }
}

#endif

} // namespace hdf5_cases
