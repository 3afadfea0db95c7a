// VolumeFile: where the voxels of a volume are, and how they are stored. What a file's name or its header says.
#pragma once

#include "text.hpp"
#include "vec.hpp"
#include "voxels.hpp"

#include <array>
#include <cstdint>
#include <istream>
#include <stdexcept>
#include <string>

namespace example {

inline bool isVolumeEnding(const std::string& ending)
{
    return ending == ".raw" || ending == ".nrrd" || ending == ".nhdr" || ending == ".mha" || ending == ".mhd";
}

using Index3 = std::array<int, 3>;

// x fastest.
struct VolumeFile {
    std::string path;       // of the file that was asked for; errors begin with it
    std::string data;       // of the file that has the voxels, which may be the same
    std::int64_t begin = 0; // of the first voxel, in bytes; -1: the voxels end where the file ends
    Index3 dims{};
    VoxelFormat format;
    Vec3 spacing{1, 1, 1}; // between voxels
    Vec3 origin;           // of the centre of the first voxel
    Notes notes;           // for the user

    std::uint64_t voxelCount() const
    {
        return static_cast<std::uint64_t>(dims[0]) * static_cast<std::uint64_t>(dims[1])
               * static_cast<std::uint64_t>(dims[2]);
    }
};

// Readers refuse a spacing or origin that coordinates in float cannot have.
inline bool isSpacing(double value) { return value >= 1e-15 && value <= 1e9; }
inline bool isOrigin(double value) { return std::fabs(value) <= 1e12; }
inline bool isDimension(int value) { return value >= 2 && value <= 65536; }

// Takes dimensions and type from the file's name: name_XxYxZ_type.raw (the Open SciVis convention), with `be` behind
// the type if big-endian. Throws std::runtime_error if the name does not have them.
inline VolumeFile parseVolumeName(const std::string& path)
{
    auto fail = [&path](const std::string& why) -> VolumeFile {
        std::string types;
        for (const auto& [name, type] : fileTypes())
            types += (types.empty() ? "" : type == FileType::Float64 ? " or " : ", ") + name;
        throw std::runtime_error(path + ": " + why + "; expected a name like name_64x64x64_uint8.raw, with " + types
                                 + ", and 'be' behind the type where it is big-endian");
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
    VolumeFile file;
    file.path = file.data = path;
    bool isKnown = false;
    for (const auto& [word, known] : fileTypes())
        for (const bool isBigEndian : {false, true})
            if (type == word + (isBigEndian ? "be" : "")) {
                file.format = {known, isBigEndian};
                isKnown = true;
            }
    if (!isKnown)
        return fail("unknown voxel type '" + type + "'");

    const std::string dims = name.substr(dimsAt + 1, typeAt - dimsAt - 1);
    std::size_t at = 0;
    for (int axis = 0; axis < 3; ++axis) {
        int value = 0;
        const std::size_t begin = at;
        for (; at < dims.size() && dims[at] >= '0' && dims[at] <= '9' && value <= 65536; ++at)
            value = 10 * value + (dims[at] - '0');
        if (at == begin || !isDimension(value) || (axis < 2 && (at >= dims.size() || dims[at++] != 'x')))
            return fail("bad dimensions '" + dims + "' (three numbers from 2 to 65536)");
        file.dims[static_cast<std::size_t>(axis)] = value;
    }
    return at == dims.size() ? file : fail("bad dimensions '" + dims + "'");
}

// Checks that the stream of file.data is as long as it must be, and finds where the voxels begin. Throws
// std::runtime_error that names the file, what was expected and what was found.
inline void findVoxels(std::istream& stream, VolumeFile& file)
{
    const std::string where = file.path + (file.data == file.path ? "" : ": " + file.data);
    if (!stream)
        throw std::runtime_error(where + ": cannot be opened");
    const std::uint64_t voxels = file.voxelCount() * file.format.bytes();
    stream.seekg(0, std::ios::end);
    const std::streamoff size = stream.tellg();
    if (!stream || size < 0)
        throw std::runtime_error(where + ": cannot be read");
    const std::uint64_t got = static_cast<std::uint64_t>(size);
    if (file.begin < 0 && got >= voxels)
        file.begin = static_cast<std::int64_t>(got - voxels);
    const std::uint64_t before = static_cast<std::uint64_t>(std::max<std::int64_t>(0, file.begin));
    if (got != before + voxels)
        throw std::runtime_error(where + ": expected " + std::to_string(before + voxels) + " bytes, "
                                 + (before > 0
                                        ? std::to_string(before) + " of them before the voxels"
                                        : "as " + std::to_string(file.dims[0]) + 'x' + std::to_string(file.dims[1])
                                              + 'x' + std::to_string(file.dims[2]) + " voxels have")
                                 + ", got " + std::to_string(got));
}

} // namespace example
