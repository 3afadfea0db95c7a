// Volume: regular grids of scalars, and the part of one that a brick holds.
//
// Files are headerless, name_XxYxZ_type.raw (the Open SciVis convention): x fastest, little-endian, type one of
// uint8, uint16, float32. Only the rows that are asked for are read: a rank reads its bricks, and its share of what
// all ranks must know of the whole volume (least and greatest value, where there is something to see).
//
// Values are normalised to [0, 1] over a range that is a function of the whole file, and so the same on all ranks:
// 0..255 for uint8, the least and greatest value for uint16 and float32. A float32 file with values on both sides
// of zero is taken for a density map: its range begins at zero, all below is background. Non-finite voxels count as
// the least value and have no part in the range.
#pragma once

#include "loaders.hpp"
#include "vec.hpp"
#include "volume_look.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <functional>
#include <istream>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the volume reader copies little-endian voxels as they are: little-endian machines only"
#endif

namespace example {

using Index3 = std::array<int, 3>;

// Of the blocks that a ray steps over at once where nothing in them can be seen, in voxels.
inline constexpr int skipWidth = 8;

enum class VoxelType { UInt8, UInt16, Float32 };

inline std::size_t voxelBytes(VoxelType type)
{
    return type == VoxelType::UInt8 ? 1 : type == VoxelType::UInt16 ? 2 : 4;
}

struct VolumeInfo {
    Index3 dims{};
    VoxelType type = VoxelType::UInt8;
    float minimum = 0, maximum = 255; // mapped to 0 and 1, unless there is another range to show
    float least = 0;                  // of the voxels; `minimum` may be greater
    std::uint64_t notFinite = 0;      // voxels, which count as the minimum
};

// Copies the voxels [x0, x1) of row (y, z) to `out`. Throws std::runtime_error. Called by one thread at a time.
using RowReader = std::function<void(int x0, int x1, int y, int z, std::byte* out)>;

// Where there is something to see, as far as some rows of the volume show it, on a lattice of about 64^3 voxels.
struct VisibleVoxels {
    // To point a camera: the ends of rows that stand out from the background, in voxels.
    std::vector<Vec3> points;
    int slack = 0; // how many voxels beyond these the lattice leaves out

    // To reckon what it costs: blocks of `width` voxels, x fastest, each 1 if something in it has an opacity, else 0.
    Index3 width{}, blocks{};
    std::vector<std::uint8_t> isSeen;
};

struct VolumeSource {
    VolumeInfo info;
    VolumeLook look;
    std::function<RowReader()> open; // each call gives a reader of its own
    std::string name;                // of the file
    // If they are known; the second only if there are no visible points.
    std::optional<VisibleVoxels> visible;
    std::optional<std::array<float, 2>> range;
};

// ---- files -----------------------------------------------------------------------------------------------------

// Dimensions and type as the file's name says. Throws std::runtime_error if it does not.
inline VolumeInfo parseVolumeName(const std::string& path)
{
    auto fail = [&path](const std::string& why) -> VolumeInfo {
        throw std::runtime_error(path + ": " + why
                                 + "; expected a name like name_64x64x64_uint8.raw, with uint8, uint16 or float32");
    };
    std::string name = path.substr(path.find_last_of('/') + 1);
    const std::string ending = ".raw";
    if (name.size() <= ending.size() || name.compare(name.size() - ending.size(), ending.size(), ending) != 0)
        return fail("not a .raw file");
    name.resize(name.size() - ending.size());

    const std::size_t typeAt = name.rfind('_');
    const std::size_t dimsAt = typeAt == std::string::npos || typeAt == 0 ? typeAt : name.rfind('_', typeAt - 1);
    if (typeAt == std::string::npos || typeAt == 0 || dimsAt == std::string::npos)
        return fail("no dimensions and type in the name");
    const std::string type = name.substr(typeAt + 1);
    VolumeInfo info;
    if (type == "uint8")
        info.type = VoxelType::UInt8;
    else if (type == "uint16")
        info.type = VoxelType::UInt16;
    else if (type == "float32")
        info.type = VoxelType::Float32;
    else
        return fail("unknown voxel type '" + type + "'");

    const std::string dims = name.substr(dimsAt + 1, typeAt - dimsAt - 1);
    std::size_t at = 0;
    for (int axis = 0; axis < 3; ++axis) {
        int value = 0;
        const std::size_t begin = at;
        for (; at < dims.size() && dims[at] >= '0' && dims[at] <= '9' && value <= 65536; ++at)
            value = 10 * value + (dims[at] - '0');
        if (at == begin || value < 2 || value > 65536 || (axis < 2 && (at >= dims.size() || dims[at++] != 'x')))
            return fail("bad dimensions '" + dims + "' (three numbers from 2 to 65536)");
        info.dims[static_cast<std::size_t>(axis)] = value;
    }
    return at == dims.size() ? info : fail("bad dimensions '" + dims + "'");
}

namespace detail {

// Widens [lo, hi] to the finite values of `count` voxels. Returns how many are not finite.
template <class T>
std::size_t growRange(const std::byte* bytes, std::size_t count, float& lo, float& hi)
{
    std::size_t notFinite = 0;
    for (std::size_t i = 0; i < count; ++i) {
        T value;
        std::memcpy(&value, bytes + i * sizeof(T), sizeof(T));
        const float f = static_cast<float>(value);
        if (std::isfinite(f)) {
            lo = std::min(lo, f);
            hi = std::max(hi, f);
        } else {
            ++notFinite;
        }
    }
    return notFinite;
}

} // namespace detail

// Dimensions and type from the name; checks that the stream is as long as the name says. Throws std::runtime_error
// that names the file, the expected and the found.
inline VolumeInfo checkVolume(std::istream& stream, const std::string& path)
{
    if (!stream)
        throw std::runtime_error(path + ": cannot be opened");
    const VolumeInfo info = parseVolumeName(path);
    const std::uint64_t expected = static_cast<std::uint64_t>(info.dims[0]) * static_cast<std::uint64_t>(info.dims[1])
                                   * static_cast<std::uint64_t>(info.dims[2]) * voxelBytes(info.type);
    stream.seekg(0, std::ios::end);
    const std::streamoff got = stream.tellg();
    if (!stream || got < 0)
        throw std::runtime_error(path + ": cannot be read");
    if (static_cast<std::uint64_t>(got) != expected)
        throw std::runtime_error(path + ": expected " + std::to_string(expected) + " bytes from the name, got "
                                 + std::to_string(got));
    return info;
}

// The least and the greatest of the finite values of some voxels; infinity and minus infinity if there are none.
struct VoxelRange {
    float lo = std::numeric_limits<float>::infinity(), hi = -lo;
    std::uint64_t notFinite = 0;

    void grow(VoxelType type, const std::byte* bytes, std::size_t count)
    {
        if (type == VoxelType::UInt8)
            detail::growRange<std::uint8_t>(bytes, count, lo, hi);
        else if (type == VoxelType::UInt16)
            detail::growRange<std::uint16_t>(bytes, count, lo, hi);
        else
            notFinite += detail::growRange<float>(bytes, count, lo, hi);
    }
    static VoxelRange of(const std::vector<VoxelRange>& ranges)
    {
        VoxelRange all;
        for (const VoxelRange& range : ranges) {
            all.lo = std::min(all.lo, range.lo);
            all.hi = std::max(all.hi, range.hi);
            all.notFinite += range.notFinite;
        }
        return all;
    }
};

// Of voxels [begin, end), in file order. Adds what it reads to `bytesRead`.
inline VoxelRange scanVoxels(std::istream& stream, const std::string& path, VoxelType type, std::uint64_t begin,
                             std::uint64_t end, std::uint64_t& bytesRead)
{
    VoxelRange range;
    const std::size_t size = voxelBytes(type), most = std::size_t{1} << 20;
    std::vector<std::byte> chunk;
    stream.seekg(static_cast<std::streamoff>(begin * size));
    while (begin < end) {
        const std::size_t count = static_cast<std::size_t>(std::min<std::uint64_t>(most / size, end - begin));
        chunk.resize(count * size);
        if (!stream.read(reinterpret_cast<char*>(chunk.data()), static_cast<std::streamsize>(chunk.size())))
            throw std::runtime_error(path + ": reading failed after " + std::to_string(begin * size) + " bytes");
        range.grow(type, chunk.data(), count);
        begin += count;
        bytesRead += chunk.size();
    }
    return range;
}

// Collective: checkVolume() of this rank's own stream, and the range, of which each rank looks at a share of the
// voxels. Throws std::runtime_error, the same on all ranks.
inline VolumeInfo describeVolume(std::istream& stream, const std::string& path, const Loaders& loaders = {})
{
    VolumeInfo info;
    const VoxelRange range = VoxelRange::of(loaders.gatherOf<VoxelRange>([&] {
        info = checkVolume(stream, path);
        if (info.type == VoxelType::UInt8)
            return std::vector<VoxelRange>{{0, 255, 0}};
        const auto [begin, end] =
            loaders.shareOf(static_cast<std::uint64_t>(info.dims[0]) * static_cast<std::uint64_t>(info.dims[1])
                            * static_cast<std::uint64_t>(info.dims[2]));
        return std::vector<VoxelRange>{scanVoxels(stream, path, info.type, begin, end, *loaders.readCounter())};
    }));
    const float lo = range.lo, hi = range.hi;
    info.least = lo;
    info.notFinite = range.notFinite;
    if (lo > hi)
        throw std::runtime_error(path + ": not one of its voxels is finite");
    info.minimum = lo < 0 && hi > 0 ? 0 : lo;
    info.maximum = hi;
    if (hi == info.minimum) { // all alike: something above them, or else below
        info.maximum = hi + std::max(1.0f, std::fabs(hi) / 1024);
        if (!std::isfinite(info.maximum)) {
            info.minimum = hi / 2;
            info.maximum = hi;
        }
    }
    return info;
}

// Reads rows of a stream that describeVolume() has accepted. Adds what it reads to the counter, if there is one.
inline RowReader rowReader(std::shared_ptr<std::istream> stream, const std::string& path, const VolumeInfo& info,
                           std::shared_ptr<std::uint64_t> bytesRead = nullptr)
{
    std::streamoff position = -1;
    return [stream, path, info, bytesRead, position](int x0, int x1, int y, int z, std::byte* out) mutable {
        const auto wide = [](int i) { return static_cast<std::streamoff>(i); };
        const std::streamoff begin =
            ((wide(z) * info.dims[1] + y) * info.dims[0] + x0) * static_cast<std::streamoff>(voxelBytes(info.type));
        const std::streamsize bytes = (wide(x1) - x0) * static_cast<std::streamsize>(voxelBytes(info.type));
        if (position != begin) // a seek throws the stream's buffer away
            stream->seekg(begin);
        if (!stream->read(reinterpret_cast<char*>(out), bytes))
            throw std::runtime_error(path + ": reading row y=" + std::to_string(y) + " z=" + std::to_string(z)
                                     + " failed");
        position = begin + bytes;
        if (bytesRead)
            *bytesRead += static_cast<std::uint64_t>(bytes);
        if (info.type == VoxelType::Float32)
            for (int i = 0; i < x1 - x0; ++i) {
                float value;
                std::memcpy(&value, out + 4 * i, sizeof value);
                if (!std::isfinite(value))
                    std::memcpy(out + 4 * i, &info.minimum, sizeof value);
            }
    };
}

// The value of a voxel.
inline float voxelValue(VoxelType type, const std::byte* voxel)
{
    const auto as = [voxel](auto value) {
        std::memcpy(&value, voxel, sizeof value);
        return static_cast<float>(value);
    };
    return type == VoxelType::UInt8    ? as(std::uint8_t{})
           : type == VoxelType::UInt16 ? as(std::uint16_t{})
                                       : as(float{});
}

// Every how many voxels along an axis there is a row of the lattice that stands for a volume.
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
    visible.slack = std::max({stride(0), stride(1), stride(2)}) - 1;
    for (std::size_t axis = 0; axis < 3; ++axis) {
        visible.width[axis] = std::max(skipWidth, stride(axis)); // a row or more in each
        visible.blocks[axis] = 1 + (info.dims[axis] - 1) / visible.width[axis];
    }
    const TransferFunction transferFunction(1, look.points);
    std::vector<std::uint8_t> seenInRows; // for each block along a row
    visible.points = loaders.gatherOf<Vec3>([&] {
        const RowReader read = source.open();
        std::vector<Vec3> points;
        const auto [begin, end] = loaders.shareOf(rows(1) * rows(2));
        for (std::uint64_t i = begin; i < end; ++i) {
            const int y = static_cast<int>(i % rows(1)) * stride(1), z = static_cast<int>(i / rows(1)) * stride(2);
            read(0, info.dims[0], y, z, row.data());
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
    // A row speaks for what lies between it and the one before.
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
        const VolumeInfo& info = source.info;
        const RowReader read = source.open();
        const std::size_t count = static_cast<std::size_t>(info.dims[0]);
        std::vector<std::byte> row(count * voxelBytes(info.type));
        VoxelRange range;
        const auto rows = static_cast<std::uint64_t>(info.dims[1]);
        const auto [begin, end] = loaders.shareOf(rows * static_cast<std::uint64_t>(info.dims[2]));
        for (std::uint64_t i = begin; i < end; ++i) {
            read(0, info.dims[0], static_cast<int>(i % rows), static_cast<int>(i / rows), row.data());
            range.grow(info.type, row.data(), count);
        }
        return std::vector<VoxelRange>{range};
    }));
    return {all.lo, all.hi};
}

// Collective: how a volume is to be shown, of one of which all but its look is known.
using LookOf = std::function<VolumeLook(const VolumeSource&)>;

// Collective: the ranks share what has to be known of the whole volume. Without `lookOf` it is shown as a generated
// volume is. Throws std::runtime_error, the same on all ranks.
inline VolumeSource openVolume(const std::string& path, const Loaders& loaders = {}, const LookOf& lookOf = {})
{
    const auto open = [path] {
        auto stream = std::make_shared<std::ifstream>();
        // Without a buffer no byte is read that nobody asked for; rows are read as a whole.
        stream->rdbuf()->pubsetbuf(nullptr, 0);
        stream->open(path, std::ios::binary);
        return stream; // one that is not open is a stream that cannot be read
    };
    VolumeSource source;
    source.name = path;
    source.info = describeVolume(*open(), path, loaders);
    source.open = [open, path, info = source.info, counter = loaders.readCounter()] {
        return rowReader(open(), path, info, counter);
    };
    source.look.lo = source.info.minimum;
    source.look.hi = source.info.maximum;
    if (lookOf)
        source.look = lookOf(source);
    source.visible = visibleVoxels(source, loaders);
    if (source.visible->points.empty())
        source.range = rangeOf(source, loaders);
    return source;
}

// ---- the part in memory ----------------------------------------------------------------------------------------

// The voxels [lo, hi) of a volume. The box may reach beyond the volume by the ghosts that gradients need; there the
// nearest voxel is repeated, so that sampling needs no clamping.
class VoxelBlock {
public:
    VoxelBlock(const VolumeSource& source, const Index3& lo, const Index3& hi)
        : info_(source.info), lo_(lo), nx_(static_cast<std::size_t>(hi[0] - lo[0])),
          nxy_(nx_ * static_cast<std::size_t>(hi[1] - lo[1])), hi_(hi)
    {
        const std::size_t size = voxelBytes(info_.type);
        bytes_.resize(nxy_ * static_cast<std::size_t>(hi[2] - lo[2]) * size);
        const RowReader read = source.open();
        const int x0 = std::max(lo[0], 0), x1 = std::min(hi[0], info_.dims[0]);
        const std::size_t rowBytes = nx_ * size;
        // Calls f(y, z, the row in the block) for the rows whose voxels are in the volume, or for the others.
        const auto forRows = [&](bool areInside, const auto& f) {
            for (int z = lo[2]; z < hi[2]; ++z)
                for (int y = lo[1]; y < hi[1]; ++y)
                    if (areInside == (y >= 0 && y < info_.dims[1] && z >= 0 && z < info_.dims[2]))
                        f(y, z, bytes_.data() + index(lo[0], y, z) * size);
        };
        const auto readRow = [&](int y, int z, std::byte* row) {
            std::byte* inside = row + static_cast<std::size_t>(x0 - lo[0]) * size;
            read(x0, x1, y, z, inside);
            for (int x = lo[0]; x < x0; ++x)
                std::memcpy(row + static_cast<std::size_t>(x - lo[0]) * size, inside, size);
            for (int x = x1; x < hi[0]; ++x)
                std::memcpy(row + static_cast<std::size_t>(x - lo[0]) * size,
                            inside + static_cast<std::size_t>(x1 - 1 - x0) * size, size);
        };
        forRows(true, readRow);
        forRows(false, [&](int y, int z, std::byte* row) {
            const int nearY = std::clamp(y, 0, info_.dims[1] - 1), nearZ = std::clamp(z, 0, info_.dims[2] - 1);
            if (nearY >= lo[1] && nearY < hi[1] && nearZ >= lo[2] && nearZ < hi[2])
                std::memcpy(row, bytes_.data() + index(lo[0], nearY, nearZ) * size, rowBytes);
            else
                readRow(nearY, nearZ, row);
        });
    }

    const VolumeInfo& info() const { return info_; }
    const Index3& lo() const { return lo_; }
    const Index3& hi() const { return hi_; }
    std::size_t rowStride() const { return nx_; }
    std::size_t sliceStride() const { return nxy_; }

    // Of a voxel by its index in the whole volume.
    std::size_t index(int x, int y, int z) const
    {
        return static_cast<std::size_t>(z - lo_[2]) * nxy_ + static_cast<std::size_t>(y - lo_[1]) * nx_
               + static_cast<std::size_t>(x - lo_[0]);
    }
    template <class T>
    const T* data() const
    {
        return reinterpret_cast<const T*>(bytes_.data());
    }

private:
    VolumeInfo info_;
    Index3 lo_;
    std::size_t nx_, nxy_;
    Index3 hi_;
    std::vector<std::byte> bytes_;
};

} // namespace example
