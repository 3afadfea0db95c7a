// Cinema: the table data.csv with the pictures of an orbit, by specification D of Cinema databases.
#pragma once

#include "camera.hpp"
#include "output.hpp"

#include <cmath>
#include <cstdio>
#include <string>
#include <vector>

namespace example {

// Writes one row for each of `files`, the frames of a turn, with paths relative to the folder. The columns phi and
// theta are the camera's azimuth and elevation in degrees; phi is from 0 to 360. Throws std::runtime_error with the
// file's name.
inline void writeCinema(const std::string& path, const View& view, const std::vector<std::string>& files)
{
    std::string table = "phi,theta,FILE\n";
    for (std::size_t frame = 0; frame < files.size(); ++frame) {
        const double turn = 360.0 * static_cast<double>(frame) / static_cast<double>(files.size());
        const double azimuth = std::fmod(static_cast<double>(view.azimuth) + turn, 360.0);
        char angles[80];
        std::snprintf(angles, sizeof angles, "%.10g,%.10g,", azimuth < 0 ? azimuth + 360 : azimuth,
                      static_cast<double>(view.elevation));
        table += angles + files[frame] + '\n';
    }
    writeText(path, table);
}

} // namespace example
