// The names of volumes in HDF5 files.
#pragma once

#include <cstddef>
#include <string>
#include <utility>

namespace example {

// Splits file.h5:/path/to/dataset into its two parts. The second is "/" if it is left out, and empty if the file is no
// HDF5 file.
inline std::pair<std::string, std::string> splitHdf5Path(const std::string& path)
{
    const std::string endings[] = {".h5", ".hdf5"};
    for (const std::string& ending : endings) {
        const std::size_t at = path.find(ending + ':'), behind = at + ending.size();
        if (at != std::string::npos && at > 0)
            return {path.substr(0, behind), (path.compare(behind, 2, ":/") == 0 ? "" : "/") + path.substr(behind + 1)};
    }
    for (const std::string& ending : endings)
        if (path.size() > ending.size() && path.compare(path.size() - ending.size(), ending.size(), ending) == 0)
            return {path, "/"};
    return {path, ""};
}

inline bool isHdf5(const std::string& path) { return !splitHdf5Path(path).second.empty(); }

} // namespace example
