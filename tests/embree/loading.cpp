// Loading a scene together: each rank reads a part of the files, and all get the same scene as a single rank. Ranks are
// threads.
#include "support.hpp"
#include "together.hpp"

#include <bricks.hpp>
#include <scene_files.hpp>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <random>
#include <string>
#include <vector>

namespace loading_cases {

using namespace example;
using test::contains;
using test::errorOf;
using test::ofRanks;

namespace {

template <class T>
std::string bytesOf(const std::vector<T>& values)
{
    return std::string(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(T));
}

std::string describe(const VolumeSource& source)
{
    std::string text = std::to_string(source.info.minimum) + " to " + std::to_string(source.info.maximum) + ", "
                       + std::to_string(source.info.notFinite) + " not finite, "
                       + std::to_string(source.visible.value().slack);
    for (const Vec3& p : source.visible->points)
        text += ", " + std::to_string(p.x) + ' ' + std::to_string(p.y) + ' ' + std::to_string(p.z);
    text += "; ";
    for (const std::uint8_t seen : source.visible->isSeen)
        text += seen != 0 ? '#' : '.';
    if (source.range)
        text += "; " + std::to_string((*source.range)[0]) + " to " + std::to_string((*source.range)[1]);
    return text;
}

} // namespace

TEST_CASE("Shares are equal runs that are all of it", "[loading]")
{
    for (const int size : {1, 2, 3, 7})
        for (const std::uint64_t count :
             {std::uint64_t{0}, std::uint64_t{1}, std::uint64_t{5}, std::uint64_t{7000}, std::uint64_t{1} << 60}) {
            std::uint64_t next = 0;
            for (int rank = 0; rank < size; ++rank) {
                const auto [begin, end] = Loaders::shareOf(count, rank, size);
                CHECK(begin == next);
                CHECK(end - begin >= count / static_cast<std::uint64_t>(size));
                CHECK(end - begin <= count / static_cast<std::uint64_t>(size) + 1);
                next = end;
            }
            CHECK(next == count);
        }
}

TEST_CASE("What ranks send each other travels in short rounds, and what stays does not travel", "[loading]")
{
    const int ranks = 3;
    const std::size_t forAll = 70000;
    const auto part = [](int from, int to) { // for all ranks if `to` is the number of ranks
        const std::size_t size = to == ranks ? forAll : from == to ? 3000000 : from == 1 && to == 2 ? 0 : 400000;
        return Loaders::Bytes(size + static_cast<std::size_t>(from), static_cast<std::byte>(1 + from * 16 + to));
    };
    test::Exchange way(ranks);
    struct Counts {
        bool areRight = true;
        std::size_t sent = 0, longest = 0;
    };
    const auto counts = ofRanks<Counts>(ranks, [&](const Loaders& loaders) {
        Counts mine;
        const auto gather = [&](const Loaders::Bytes& own) {
            mine.sent += own.size();
            mine.longest = std::max(mine.longest, own.size());
            return way.gather(loaders.rank(), own);
        };
        const Loaders counted(loaders.rank(), ranks, gather, nullptr);
        std::vector<Loaders::Bytes> parts;
        for (int to = 0; to <= ranks; ++to)
            parts.push_back(part(loaders.rank(), to));
        const std::vector<Loaders::Bytes> received = counted.exchange(std::move(parts));
        for (int from = 0; from < ranks; ++from) {
            Loaders::Bytes expected = part(from, loaders.rank());
            const Loaders::Bytes ofAll = part(from, ranks);
            expected.insert(expected.end(), ofAll.begin(), ofAll.end());
            mine.areRight = mine.areRight && received[static_cast<std::size_t>(from)] == expected;
        }
        return mine;
    });
    for (std::size_t rank = 0; rank < counts.size(); ++rank) {
        CHECK(counts[rank].areRight);
        CHECK(counts[rank].longest <= (std::size_t{1} << 20) / ranks);
        // Besides these: the sizes, and whether all is well.
        CHECK(counts[rank].sent <= (rank == 1 ? 1 : 2) * std::size_t{400000} + forAll + 1000);
    }
}

TEST_CASE("A volume is the same for any number of ranks, and none reads more than its part", "[loading]")
{
    const test::TemporaryFolder folder;
    std::mt19937 random(3);
    const Index3 d{20, 70, 130}; // a lattice of every 1st, 2nd and 3rd voxel
    const std::size_t count = 20 * 70 * 130;
    std::vector<std::uint8_t> bytes(count);
    std::vector<std::uint16_t> shorts(count);
    std::vector<float> floats(count);
    for (std::size_t i = 0; i < count; ++i) {
        const bool inside = i % 20 > 3 && i % 20 < 12 && i / 1400 > 30 && i / 1400 < 70;
        const unsigned noise = static_cast<unsigned>(random());
        bytes[i] = static_cast<std::uint8_t>(inside ? 40 + noise % 200 : noise % 20);
        shorts[i] = static_cast<std::uint16_t>(500 + bytes[i]);
        floats[i] = static_cast<float>(bytes[i]) - 10.5f;
    }
    shorts[count / 3] = 100; // the least and the greatest value are in parts of different ranks
    shorts[count - 1] = 1200;
    floats[7] = std::numeric_limits<float>::quiet_NaN();
    floats[count - 2] = 1e6f;
    floats[count / 2] = -1e6f;
    const std::vector<std::string> files{folder.write("b_20x70x130_uint8.raw", bytesOf(bytes)),
                                         folder.write("s_20x70x130_uint16.raw", bytesOf(shorts)),
                                         folder.write("f_20x70x130_float32.raw", bytesOf(floats))};
    for (const std::string& file : files) {
        INFO(file);
        const VolumeSource whole = openVolume(file);
        const std::string alone = describe(whole);
        const std::size_t size = std::filesystem::file_size(file), rows = size / (70 * 130);
        for (const int ranks : {1, 2, 3, 5}) {
            std::vector<std::uint64_t> read(static_cast<std::size_t>(ranks)), withBlocks = read;
            const auto texts = ofRanks<std::string>(ranks, [&](const Loaders& loaders) {
                const auto rank = static_cast<std::size_t>(loaders.rank());
                const VolumeSource source = openVolume(file, loaders);
                read[rank] = loaders.bytesRead();
                // The block of a brick, and one with ghost voxels outside the volume.
                const int z = d[2] * loaders.rank() / ranks, end = d[2] * (loaders.rank() + 1) / ranks;
                const VoxelBlock block(source, {2, 5, z}, {9, 50, end});
                const VoxelBlock ghosts(source, {-1, -1, -1}, {d[0] + 2, d[1] + 2, d[2] + 2});
                const std::size_t voxels = static_cast<std::size_t>(7 * 45 * (end - z)) + count;
                withBlocks[rank] = loaders.bytesRead() - voxels * voxelBytes(source.info.type);
                return describe(source);
            });
            const std::uint64_t lattice = 35 * 44 * rows,
                                all = lattice + (contains(file, "uint8") ? 0 : size) + (whole.range ? size : 0);
            std::uint64_t sum = 0;
            for (std::size_t rank = 0; rank < texts.size(); ++rank) {
                CHECK(texts[rank] == alone);
                CHECK(read[rank] == withBlocks[rank]);
                // Parts may differ by a row of the lattice, a voxel, and a row in which nothing is visible.
                CHECK(read[rank] <= all / static_cast<std::uint64_t>(ranks) + 2 * rows + 4);
                sum += read[rank];
            }
            CHECK(sum == all);
        }
    }
}

TEST_CASE("What one rank cannot read is the same error on all", "[loading]")
{
    const test::TemporaryFolder folder;
    const std::string good = folder.write("g_2x3x4_uint16.raw", std::string(48, 'g'));
    const std::string missing = folder / "m_2x3x4_uint16.raw";
    for (const int first : {0, 1, 2}) { // ranks from this one on
        const auto errors = ofRanks<std::string>(3, [&](const Loaders& loaders) {
            return errorOf([&] {
                Scene scene;
                addFile(scene, good, true, 0, loaders);
                addFile(scene, loaders.rank() >= first ? missing : good, true, 0, loaders);
                addFile(scene, good, true, 0, loaders);
            });
        });
        for (const std::string& error : errors)
            CHECK(error == missing + ": cannot be opened");
    }
    // The same for a file of primitives.
    const std::string mesh = folder.write("m.obj", "v 0 0 0\nf 1 2 3\n");
    for (const std::string& file : {mesh, folder / "none.ply", folder / "none.xyz"}) {
        const std::string alone = errorOf([&] {
            Scene scene;
            addFile(scene, file, true);
        });
        CHECK(contains(alone, file));
        for (const std::string& error : ofRanks<std::string>(2, [&](const Loaders& loaders) {
                 return errorOf([&] {
                     Scene scene;
                     addFile(scene, file, true, 0, loaders);
                 });
             }))
            CHECK(error == alone);
    }
    // If the other ranks have no such file, rank 0 reads it alone.
    const std::string tetrahedron = folder.write("t.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
    for (const std::string& error : ofRanks<std::string>(3, [&](const Loaders& loaders) {
             return errorOf([&] {
                 Scene scene;
                 addFile(scene, loaders.rank() == 0 ? tetrahedron : folder / "none.obj", true, 0, loaders);
                 if (scene.bounds.empty() || scene.bounds.extent().x < 1)
                     throw std::runtime_error("another scene");
             });
         }))
        CHECK(error.empty());
    // If no voxel is finite, every rank gets the error.
    const std::vector<float> nan(24, std::numeric_limits<float>::quiet_NaN());
    const std::string none = folder.write("n_2x3x4_float32.raw", bytesOf(nan));
    for (const std::string& error :
         ofRanks<std::string>(3, [&](const Loaders& loaders) { return errorOf([&] { openVolume(none, loaders); }); }))
        CHECK(contains(error, none + ": not one of its voxels is finite"));
    // Their extent is more than a float can hold, or so little that its reciprocal is: as of bytes in the wrong order.
    for (const std::vector<float>& ends : {std::vector<float>{-3e38f, 3e38f}, {0, 1e-40f}}) {
        std::vector<float> voxels(24, ends[0]);
        voxels.back() = ends[1];
        const std::string swapped = folder.write("s_2x3x4_float32.raw", bytesOf(voxels));
        for (const std::string& error : ofRanks<std::string>(
                 3, [&](const Loaders& loaders) { return errorOf([&] { openVolume(swapped, loaders); }); }))
            CHECK((contains(error, swapped + ": its values go from ") && contains(error, "byte order")));
    }
}

} // namespace loading_cases
