// A rank's share of a file: a range of its bytes, or the lines that begin in one.
#pragma once

#include "loaders.hpp"
#include "text.hpp"

#include <algorithm>
#include <cstdint>
#include <fstream>
#include <stdexcept>
#include <string>
#include <string_view>

namespace example {

// Throws std::runtime_error if the file cannot be read.
inline std::uint64_t fileSize(const std::string& path)
{
    std::ifstream stream(path, std::ios::binary | std::ios::ate);
    const std::streamoff size = stream ? static_cast<std::streamoff>(stream.tellg()) : -1;
    if (size < 0)
        throw std::runtime_error(path + ": cannot be opened");
    return static_cast<std::uint64_t>(size);
}

// Bytes [begin, end) of a file. Throws std::runtime_error if there are not so many.
inline std::string readBytes(const std::string& path, std::uint64_t begin, std::uint64_t end, const Loaders& loaders)
{
    std::ifstream stream;
    stream.rdbuf()->pubsetbuf(nullptr, 0); // without a buffer, only these bytes are read
    stream.open(path, std::ios::binary);
    std::string bytes(static_cast<std::size_t>(end - begin), '\0');
    stream.seekg(static_cast<std::streamoff>(begin));
    if (!stream.read(&bytes[0], static_cast<std::streamsize>(bytes.size())))
        throw std::runtime_error(path + ": reading failed after " + std::to_string(begin) + " bytes");
    *loaders.readCounter() += bytes.size();
    return bytes;
}

// The lines that begin in this rank's share of the bytes [first, size) of a file. Throws std::runtime_error if lines
// end with \r alone or are longer than 1 MiB: such files cannot be shared.
inline std::string readLinesOfShare(const std::string& path, std::uint64_t first, std::uint64_t size,
                                    const Loaders& loaders)
{
    if (first > size)
        throw std::runtime_error(path + ": ends early");
    auto [begin, end] = loaders.shareOf(size - first);
    begin += first;
    end += first;
    if (begin == end)
        return {};
    // Reads also the byte before, which tells whether a line begins here.
    const std::uint64_t before = begin > first ? 1 : 0;
    std::string bytes = readBytes(path, begin - before, end, loaders);
    const std::size_t start = before == 0 ? 0 : bytes.find('\n') + 1;
    if (before == 1 && start == 0)
        return {}; // a part of a line that begins before
    const std::uint64_t most = 1 << 20, step = 4096;
    for (std::uint64_t at = end; bytes.back() != '\n' && at < size; at += step) {
        if (at - end > most)
            throw std::runtime_error(path + ": a line is too long");
        const std::string more = readBytes(path, at, std::min(at + step, size), loaders);
        const std::size_t lineEnd = more.find('\n');
        bytes.append(more, 0, lineEnd == std::string::npos ? lineEnd : lineEnd + 1);
    }
    bytes.erase(0, start);
    for (std::size_t at = bytes.find('\r'); at != std::string::npos; at = bytes.find('\r', at + 1))
        if (bytes.compare(at, 2, "\r\n") != 0)
            throw std::runtime_error(path + ": lines end with \\r");
    return bytes;
}

// How many lines there are in a text.
inline std::uint64_t countLines(std::string_view text)
{
    return static_cast<std::uint64_t>(std::count(text.begin(), text.end(), '\n'))
           + (!text.empty() && text.back() != '\n');
}

} // namespace example
