// writePpm: an 8-bit image of dfb as a file that any image viewer opens. Alpha is left out.
#pragma once

#include <dfb/image.hpp>

#include <cstddef>
#include <fstream>
#include <stdexcept>
#include <string>

namespace example {

// `image` is RGBA8 or SRGBA8. Throws std::runtime_error if the file cannot be written.
inline void writePpm(const std::string& path, const dfb::Image& image)
{
    std::ofstream file(path, std::ios::binary);
    file << "P6 " << image.width() << ' ' << image.height() << " 255\n";
    for (std::size_t i = 0; i < image.pixelCount(); ++i)
        file.write(reinterpret_cast<const char*>(image.rgba8() + 4 * i), 3);
    if (!file.flush())
        throw std::runtime_error("cannot write " + path);
}

} // namespace example
