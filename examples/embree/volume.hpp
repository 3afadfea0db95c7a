// Volume: a regular grid of scalars in a file, of which each rank reads a part.
//
// Files are headerless, with a name that tells what is in them, or have a header: volume_file.hpp, nrrd.hpp,
// meta_image.hpp. Only the voxels that are asked for are read: a rank reads its bricks, and its share of what
// all ranks must know of the whole volume (least and greatest value, where there is something to see).
//
// Values are normalised to [0, 1] over a range that is a function of the whole file, and so the same on all ranks:
// 0..255 for uint8, the least and greatest value for all else. A file of floats with values on both sides
// of zero is taken for a density map: its range begins at zero, all below is background. Non-finite voxels count as
// the least value and have no part in the range.
#pragma once

#include "loaders.hpp"
#include "meta_image.hpp"
#include "nrrd.hpp"
#include "text.hpp"
#include "vec.hpp"
#include "volume_file.hpp"
#include "volume_look.hpp"
#include "voxels.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <functional>
#include <istream>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace example {

// The width in voxels of the blocks that a ray skips at once if nothing in them is visible.
inline constexpr int skipWidth = 8;

struct VolumeInfo {
    Index3 dims{};
    VoxelType type = VoxelType::UInt8;
    float minimum = 0, maximum = 255; // mapped to 0 and 1, unless there is another range to show
    float least = 0;                  // the least voxel; `minimum` may be greater
    std::uint64_t notFinite = 0;      // voxels, which count as the minimum
    Vec3 spacing{1, 1, 1};            // between voxels
    Vec3 origin;                      // of the centre of the first voxel
};

// Copies the voxels [lo, hi) to `out`, x fastest. Throws std::runtime_error. Called by one thread at a time.
using BoxReader = std::function<void(const Index3& lo, const Index3& hi, std::byte* out)>;

// Which voxels are visible, as far as some rows of the volume show, on a lattice of about 64^3 voxels.
struct VisibleVoxels {
    // For the camera: the first and last points of rows that stand out from the background, in voxels.
    std::vector<Vec3> points;
    int slack = 0; // what is visible ends before so many voxels beyond these

    // For the cost: blocks of `width` voxels, x fastest. Each is 1 if something in it has an opacity, otherwise 0.
    Index3 width{}, blocks{};
    std::vector<std::uint8_t> isSeen;
};

// The user's spacing and origin, which replace those of the file.
struct VoxelGrid {
    std::optional<Vec3> spacing, origin;
};

struct VolumeSource {
    VolumeInfo info;
    VolumeLook look;
    std::function<BoxReader()> open; // each call gives a reader of its own
    std::string name;                // of the file
    Notes notes;                     // for the user
    // If they are known; the second only if there are no visible points.
    std::optional<VisibleVoxels> visible;
    std::optional<std::array<float, 2>> range;
};

// ---- files -----------------------------------------------------------------------------------------------------

// Sets the range over which the values of a whole volume are normalised. Throws std::runtime_error that begins with
// `name`.
inline void setRange(VolumeInfo& info, const VoxelRange& range, bool isFloat, const std::string& name)
{
    const float lo = range.lo, hi = range.hi;
    info.least = lo;
    info.notFinite = range.notFinite;
    if (lo > hi)
        throw std::runtime_error(name + ": not one of its voxels is finite");
    info.minimum = lo < 0 && hi > 0 && isFloat ? 0 : lo;
    info.maximum = hi;
    if (hi == info.minimum) { // all are equal: take a value above, or else one below
        info.maximum = hi + std::max(1.0f, std::fabs(hi) / 1024);
        if (!std::isfinite(info.maximum)) {
            info.minimum = hi - hi / 8;
            info.maximum = hi;
        }
    }
    if (!std::isnormal(info.maximum - info.minimum) || !std::isnormal(1 / (info.maximum - info.minimum))
        || !std::isfinite(info.maximum - info.least))
        throw std::runtime_error(name + ": its values go from " + textOf(lo) + " to " + textOf(hi)
                                 + ", of which no image can be made; is the byte order right?");
}

inline std::size_t voxelsOfBox(const Index3& lo, const Index3& hi)
{
    const auto extent = [&](std::size_t axis) { return static_cast<std::size_t>(hi[axis] - lo[axis]); };
    return extent(0) * extent(1) * extent(2);
}

// Reads voxels as they are in the file, except for their type. `file` as findVoxels() left it. Adds what it reads to
// the counter, if there is one.
inline BoxReader rawReader(std::shared_ptr<std::istream> stream, const VolumeFile& file,
                           std::shared_ptr<std::uint64_t> bytesRead)
{
    return [stream, file, bytesRead, position = std::streamoff(-1),
            stored = std::vector<std::byte>()](const Index3& lo, const Index3& hi, std::byte* out) mutable {
        const VoxelFormat& format = file.format;
        const bool areWhole = lo[0] == 0 && hi[0] == file.dims[0]; // whole rows, which follow one another
        for (int z = lo[2]; z < hi[2]; ++z)
            for (int y = lo[1]; y < hi[1]; y = areWhole ? hi[1] : y + 1) {
                const std::size_t voxels = voxelsOfBox({lo[0], y, z}, {hi[0], areWhole ? hi[1] : y + 1, z + 1}),
                                  bytes = voxels * format.bytes();
                const std::streamoff row = static_cast<std::streamoff>(z) * file.dims[1] + y;
                const std::streamoff begin =
                    (row * file.dims[0] + lo[0]) * static_cast<std::streamoff>(format.bytes()) + file.begin;
                if (!format.isAsInMemory())
                    stored.resize(bytes);
                if (position != begin) // a seek throws the stream's buffer away
                    stream->seekg(begin);
                if (!stream->read(reinterpret_cast<char*>(format.isAsInMemory() ? out : stored.data()),
                                  static_cast<std::streamsize>(bytes)))
                    throw std::runtime_error(file.path + ": reading row y=" + std::to_string(y)
                                             + " z=" + std::to_string(z) + " failed");
                position = begin + static_cast<std::streamoff>(bytes);
                if (bytesRead)
                    *bytesRead += bytes;
                if (!format.isAsInMemory())
                    format.convert(stored.data(), voxels, out);
                out += voxels * voxelBytes(format.inMemory());
            }
    };
}

// Reads floats, with `minimum` in place of infinities and NaN.
inline BoxReader finiteReader(BoxReader read, float minimum)
{
    return [read = std::move(read), minimum](const Index3& lo, const Index3& hi, std::byte* out) {
        read(lo, hi, out);
        const std::size_t voxels = voxelsOfBox(lo, hi);
        for (std::size_t i = 0; i < voxels; ++i, out += sizeof(float)) {
            float value;
            std::memcpy(&value, out, sizeof value);
            if (!std::isfinite(value))
                std::memcpy(out, &minimum, sizeof value);
        }
    };
}

// Reads from a stream that describeVolume() has accepted. Adds what it reads to the counter, if there is one.
inline BoxReader boxReader(std::shared_ptr<std::istream> stream, const VolumeFile& file, const VolumeInfo& info,
                           std::shared_ptr<std::uint64_t> bytesRead = nullptr)
{
    const BoxReader read = rawReader(std::move(stream), file, std::move(bytesRead));
    return file.format.isFloat() ? finiteReader(read, info.minimum) : read;
}

// The range of this rank's share of the rows.
inline VoxelRange rangeOfShare(const Index3& dims, VoxelType type, const BoxReader& read, const Loaders& loaders)
{
    VoxelRange range;
    std::vector<std::byte> voxels;
    const int most = std::max(1, (1 << 18) / dims[0]); // rows at a time
    const auto rowsOfLayer = static_cast<std::uint64_t>(dims[1]);
    const auto [first, end] = loaders.shareOf(rowsOfLayer * static_cast<std::uint64_t>(dims[2]));
    for (std::uint64_t row = first; row < end;) { // each time rows of one layer, or some of them
        const int y = static_cast<int>(row % rowsOfLayer), z = static_cast<int>(row / rowsOfLayer);
        const int rows = static_cast<int>(
            std::min<std::uint64_t>(static_cast<std::uint64_t>(std::min(most, dims[1] - y)), end - row));
        const Index3 lo{0, y, z}, hi{dims[0], y + rows, z + 1};
        voxels.resize(voxelsOfBox(lo, hi) * voxelBytes(type));
        read(lo, hi, voxels.data());
        range.grow(type, voxels.data(), voxelsOfBox(lo, hi));
        row += static_cast<std::uint64_t>(rows);
    }
    return range;
}

// Collective: calls findVoxels() on this rank's own stream and finds the range, for which each rank reads a share of
// the voxels. Throws std::runtime_error, the same on all ranks.
inline VolumeInfo describeVolume(const std::shared_ptr<std::istream>& stream, VolumeFile& file,
                                 const Loaders& loaders = {})
{
    VolumeInfo info;
    const VoxelRange range = VoxelRange::of(loaders.gatherOf<VoxelRange>([&] {
        findVoxels(*stream, file);
        info.dims = file.dims;
        info.type = file.format.inMemory();
        if (info.type == VoxelType::UInt8)
            return std::vector<VoxelRange>{{0, 255, 0}};
        const BoxReader read = rawReader(stream, file, loaders.readCounter());
        return std::vector<VoxelRange>{rangeOfShare(info.dims, info.type, read, loaders)};
    }));
    info.spacing = file.spacing;
    info.origin = file.origin;
    setRange(info, range, file.format.isFloat(), file.path);
    return info;
}

// The value of a voxel.
inline float voxelValue(VoxelType type, const std::byte* voxel)
{
    return withVoxelType(type, [voxel](auto value) {
        std::memcpy(&value, voxel, sizeof value);
        return static_cast<float>(value);
    });
}

// The number of voxels along an axis from one row of the lattice that stands for a volume to the next.
inline int latticeStride(const VolumeInfo& info, std::size_t axis) { return 1 + (info.dims[axis] - 1) / 64; }

// Collective: each rank reads a share of the rows. Throws std::runtime_error, the same on all ranks.
inline VisibleVoxels visibleVoxels(const VolumeSource& source, const Loaders& loaders = {})
{
    const VolumeInfo& info = source.info;
    const VolumeLook& look = source.look;
    std::vector<std::byte> row(static_cast<std::size_t>(info.dims[0]) * voxelBytes(info.type));
    const auto value = [&](int x) {
        return voxelValue(info.type, row.data() + static_cast<std::size_t>(x) * voxelBytes(info.type));
    };
    const auto stride = [&info](std::size_t axis) { return latticeStride(info, axis); };
    const auto rows = [&](std::size_t axis) {
        return static_cast<std::uint64_t>(1 + (info.dims[axis] - 1) / stride(axis));
    };
    VisibleVoxels visible;
    visible.slack = std::max({stride(0), stride(1), stride(2)});
    for (std::size_t axis = 0; axis < 3; ++axis) {
        visible.width[axis] = std::max(skipWidth, stride(axis)); // so that each block has a row or more
        visible.blocks[axis] = 1 + (info.dims[axis] - 1) / visible.width[axis];
    }
    const TransferFunction transferFunction(1, look.points);
    std::vector<std::uint8_t> seenInRows; // for each block along a row
    visible.points = loaders.gatherOf<Vec3>([&] {
        const BoxReader read = source.open();
        std::vector<Vec3> points;
        const auto [begin, end] = loaders.shareOf(rows(1) * rows(2));
        for (std::uint64_t i = begin; i < end; ++i) {
            const int y = static_cast<int>(i % rows(1)) * stride(1), z = static_cast<int>(i / rows(1)) * stride(2);
            read({0, y, z}, {info.dims[0], y + 1, z + 1}, row.data());
            int first = -1, last = -1;
            for (int x = 0; x < info.dims[0]; x += stride(0))
                if (look.standsOut(value(x))) {
                    first = first < 0 ? x : first;
                    last = x;
                }
            for (const int x : {first, last})
                if (x >= 0)
                    points.push_back({static_cast<float>(x), static_cast<float>(y), static_cast<float>(z)});
            for (int x = 0; x < info.dims[0]; x += visible.width[0]) {
                float least = value(x), greatest = least;
                for (int k = x + 1; k <= std::min(x + visible.width[0], info.dims[0] - 1); ++k) {
                    least = std::min(least, value(k));
                    greatest = std::max(greatest, value(k));
                }
                seenInRows.push_back(look.hasIsovalueIn(least, greatest)
                                     || !transferFunction.isTransparent((least - look.lo) * look.scale(),
                                                                        (greatest - look.lo) * look.scale()));
            }
        }
        return points;
    });
    seenInRows = loaders.gatherOf<std::uint8_t>([&] { return seenInRows; });
    const auto size = [&](std::size_t axis) { return static_cast<std::size_t>(visible.blocks[axis]); };
    visible.isSeen.resize(size(0) * size(1) * size(2));
    // A row stands for the voxels between it and the row before.
    const auto blocksOf = [&](std::size_t axis, std::uint64_t number) {
        const int last = static_cast<int>(number) * stride(axis), first = std::max(0, last - stride(axis));
        return std::pair(static_cast<std::size_t>(first / visible.width[axis]),
                         static_cast<std::size_t>(last / visible.width[axis]));
    };
    for (std::size_t i = 0; i < seenInRows.size(); ++i) {
        const auto [y0, y1] = blocksOf(1, i / size(0) % rows(1));
        const auto [z0, z1] = blocksOf(2, i / size(0) / rows(1));
        for (std::size_t z = z0; z <= z1; ++z)
            for (std::size_t y = y0; y <= y1; ++y)
                visible.isSeen[(z * size(1) + y) * size(0) + i % size(0)] |= seenInRows[i];
    }
    return visible;
}

// Collective: the least and the greatest of all voxels, of which each rank reads a share. Throws std::runtime_error,
// the same on all ranks.
inline std::array<float, 2> rangeOf(const VolumeSource& source, const Loaders& loaders = {})
{
    const VoxelRange all = VoxelRange::of(loaders.gatherOf<VoxelRange>([&] {
        return std::vector<VoxelRange>{rangeOfShare(source.info.dims, source.info.type, source.open(), loaders)};
    }));
    return {all.lo, all.hi};
}

// Reads the name or the header of a file. `grid` takes the place of its spacing and origin. Throws std::runtime_error.
inline VolumeFile volumeFileOf(const std::string& path, const VoxelGrid& grid = {})
{
    const std::string ending = endingOf(path);
    std::ifstream header;
    if (ending != ".raw")
        header.open(path, std::ios::binary);
    VolumeFile file = ending == ".raw"                         ? parseVolumeName(path)
                      : ending == ".nrrd" || ending == ".nhdr" ? parseNrrd(header, path)
                                                               : parseMetaImage(header, path);
    file.spacing = grid.spacing.value_or(file.spacing);
    file.origin = grid.origin.value_or(file.origin);
    return file;
}

// Collective: chooses the look of a volume of which all else is known.
using LookOf = std::function<VolumeLook(const VolumeSource&)>;

// Collective: finds the look of a volume whose voxels can be read, and which voxels are visible.
inline void lookInto(VolumeSource& source, const Loaders& loaders, const LookOf& lookOf)
{
    source.look.lo = source.info.minimum;
    source.look.hi = source.info.maximum;
    if (lookOf)
        source.look = lookOf(source);
    source.visible = visibleVoxels(source, loaders);
    if (source.visible->points.empty())
        source.range = rangeOf(source, loaders);
}

// Collective: each rank reads a share of what all must know of the whole volume. Without `lookOf` it is shown like a
// generated volume. Throws std::runtime_error, the same on all ranks.
inline VolumeSource openVolume(const std::string& path, const Loaders& loaders = {}, const VoxelGrid& grid = {},
                               const LookOf& lookOf = {})
{
    VolumeFile file;
    loaders.gatherOf<char>([&] {
        file = volumeFileOf(path, grid);
        return std::vector<char>();
    });
    const auto open = [data = file.data] {
        auto stream = std::make_shared<std::ifstream>();
        // Without a buffer the stream reads only the bytes that are asked for; rows are read as a whole.
        stream->rdbuf()->pubsetbuf(nullptr, 0);
        stream->open(data, std::ios::binary);
        return stream; // one that is not open is a stream that cannot be read
    };
    VolumeSource source;
    source.name = path;
    source.notes = file.notes;
    source.info = describeVolume(open(), file, loaders);
    source.open = [open, file, info = source.info, counter = loaders.readCounter()] {
        return boxReader(open(), file, info, counter);
    };
    lookInto(source, loaders, lookOf);
    return source;
}

} // namespace example
