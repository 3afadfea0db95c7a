// Voxels: the types of a volume's values, in a file and in memory, and the least and greatest of some.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the volume reader copies little-endian voxels as they are: little-endian machines only"
#endif

namespace example {

// Types in memory. Each has all values of the file's type, except that 32-bit integers and doubles become the nearest
// float.
enum class VoxelType { UInt8, UInt16, Float32, Int16 };

// Calls `function` with a value of the type.
template <class Function>
auto withVoxelType(VoxelType type, const Function& function)
{
    switch (type) {
    case VoxelType::UInt8: return function(std::uint8_t{});
    case VoxelType::UInt16: return function(std::uint16_t{});
    case VoxelType::Int16: return function(std::int16_t{});
    default: return function(float{});
    }
}

inline std::size_t voxelBytes(VoxelType type)
{
    return withVoxelType(type, [](auto voxel) { return sizeof voxel; });
}

// Types in a file.
enum class FileType { UInt8, Int8, UInt16, Int16, UInt32, Int32, Float32, Float64 };

// The name of each, as in the names of .raw files.
inline const std::vector<std::pair<std::string, FileType>>& fileTypes()
{
    static const std::vector<std::pair<std::string, FileType>> all{
        {"uint8", FileType::UInt8},     {"int8", FileType::Int8},      {"uint16", FileType::UInt16},
        {"int16", FileType::Int16},     {"uint32", FileType::UInt32},  {"int32", FileType::Int32},
        {"float32", FileType::Float32}, {"float64", FileType::Float64}};
    return all;
}

// Calls `function` with a value of the type.
template <class Function>
auto withFileType(FileType type, const Function& function)
{
    switch (type) {
    case FileType::Int8: return function(std::int8_t{});
    case FileType::UInt16: return function(std::uint16_t{});
    case FileType::Int16: return function(std::int16_t{});
    case FileType::UInt32: return function(std::uint32_t{});
    case FileType::Int32: return function(std::int32_t{});
    case FileType::Float32: return function(float{});
    case FileType::Float64: return function(double{});
    default: return function(std::uint8_t{});
    }
}

inline std::size_t fileBytes(FileType type)
{
    return withFileType(type, [](auto value) { return sizeof value; });
}

// How voxels are stored in a file.
struct VoxelFormat {
    FileType type = FileType::UInt8;
    bool isBigEndian = false;

    std::size_t bytes() const { return fileBytes(type); }
    bool isFloat() const { return type == FileType::Float32 || type == FileType::Float64; }
    VoxelType inMemory() const
    {
        switch (type) {
        case FileType::UInt8: return VoxelType::UInt8;
        case FileType::UInt16: return VoxelType::UInt16;
        case FileType::Int8:
        case FileType::Int16: return VoxelType::Int16;
        default: return VoxelType::Float32;
        }
    }
    // Whether voxels in memory have the bytes of the file.
    bool isAsInMemory() const
    {
        return bytes() == voxelBytes(inMemory()) && (bytes() == 1 || !isBigEndian) && type != FileType::UInt32
               && type != FileType::Int32;
    }
    // Converts bytes of the file to voxels in memory. The two must not overlap.
    void convert(const std::byte* from, std::size_t count, std::byte* to) const
    {
        withFileType(type, [&](auto voxel) {
            withVoxelType(inMemory(), [&](auto kept) {
                for (std::size_t i = 0; i < count; ++i, from += sizeof voxel, to += sizeof kept) {
                    std::byte bytes[sizeof voxel];
                    std::memcpy(bytes, from, sizeof voxel);
                    if (isBigEndian)
                        std::reverse(bytes, bytes + sizeof voxel);
                    std::memcpy(&voxel, bytes, sizeof voxel);
                    kept = as<decltype(kept)>(voxel);
                    std::memcpy(to, &kept, sizeof kept);
                }
            });
        });
    }

private:
    template <class Kept, class Voxel>
    static Kept as(Voxel voxel)
    {
        if constexpr (sizeof(Voxel) > sizeof(float)) // doubles beyond the range of floats become infinite
            if (std::fabs(voxel) > static_cast<Voxel>(std::numeric_limits<float>::max()))
                return static_cast<Kept>(std::copysign(std::numeric_limits<float>::infinity(), voxel));
        return static_cast<Kept>(voxel);
    }
};

// The least and the greatest of the finite values of some voxels; infinity and minus infinity if there are none.
struct VoxelRange {
    float lo = std::numeric_limits<float>::infinity(), hi = -lo;
    std::uint64_t notFinite = 0;

    void grow(VoxelType type, const std::byte* bytes, std::size_t count)
    {
        withVoxelType(type, [&](auto value) {
            for (std::size_t i = 0; i < count; ++i) {
                std::memcpy(&value, bytes + i * sizeof value, sizeof value);
                const float f = static_cast<float>(value);
                if (std::isfinite(f)) {
                    lo = std::min(lo, f);
                    hi = std::max(hi, f);
                } else {
                    ++notFinite;
                }
            }
        });
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

} // namespace example
