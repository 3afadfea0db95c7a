// The shares of a PLY file that ranks read together. A share of a binary file is a range of rows, whose positions
// follow from their numbers; a share of an ASCII file is a range of lines, each of which is a row.
#pragma once

#include "file_share.hpp"
#include "mesh_share.hpp"
#include "ply.hpp"

#include <optional>

namespace example {

namespace detail {

// One file whose header has been read.
class PlyShares {
public:
    // Throws std::runtime_error if the header is wrong or very long.
    PlyShares(const std::string& path, const Loaders& loaders, Notes* notes)
        : path_(path), loaders_(loaders), size_(fileSize(path)), header_(headerOf(path, size_, loaders)),
          reader_(header_, path, notes)
    {
        reader_.readHeader();
        begin_ = reader_.position();
    }

    bool isAscii() const { return reader_.isAscii(); }

    // Reads this rank's rows of the vertices and faces of a binary file. Returns false or throws if the rows of an
    // element differ in length.
    bool readRows(Mesh& mesh)
    {
        std::uint64_t at = begin_;
        std::vector<std::uint64_t> begins, rowBytes;
        for (const PlyElement& element : reader_.elements()) {
            begins.push_back(at);
            rowBytes.push_back(element.count > 0 ? rowBytesOf(element, at) : 0);
            if ((rowBytes.back() == 0 && element.count > 0 && !element.properties.empty())
                || (rowBytes.back() > 0 && element.count > size_ / rowBytes.back()))
                return false;
            at += element.count * rowBytes.back();
        }
        if (at != size_)
            return false;
        for (std::size_t i = 0; i < begins.size(); ++i) {
            const PlyElement& element = reader_.elements()[i];
            if (element.count == 0 || (!element.isVertex() && !element.isFace()))
                continue;
            const auto [first, end] = loaders_.shareOf(element.count);
            const std::uint64_t most = std::max<std::uint64_t>(1, (std::uint64_t{1} << 22) / rowBytes[i]);
            for (std::uint64_t from = first; from < end; from += most) {
                const std::uint64_t to = std::min(end, from + most);
                const std::string bytes =
                    readBytes(path_, begins[i] + from * rowBytes[i], begins[i] + to * rowBytes[i], loaders_);
                reader_.setBytes(bytes);
                for (std::uint64_t row = from; row < to; ++row) {
                    reader_.readRow(element, row, mesh);
                    if (reader_.position() != (row + 1 - from) * rowBytes[i])
                        return false;
                }
            }
        }
        return true;
    }

    // Reads this rank's lines of an ASCII file. Returns how many of them are rows.
    std::uint64_t readLines()
    {
        lines_ = readLinesOfShare(path_, begin_, size_, loaders_);
        std::uint64_t rows = 0;
        for (TextLines lines(lines_); !lines.atEnd();)
            rows += !isBlank(lines.next());
        return rows;
    }
    // Parses these lines. The first row has number `first` of all `count` rows. Returns false or throws if a line is
    // not a row.
    bool parseLines(std::uint64_t first, std::uint64_t count, Mesh& mesh)
    {
        std::uint64_t all = 0;
        for (const PlyElement& element : reader_.elements())
            all += element.properties.empty() ? 0 : element.count;
        if (all != count)
            return false;
        auto element = reader_.elements().begin();
        std::uint64_t row = first;
        for (TextLines lines(lines_); !lines.atEnd();) {
            const std::string_view line = lines.next();
            if (isBlank(line))
                continue;
            for (; element->properties.empty() || row >= element->count; ++element)
                row -= element->properties.empty() ? 0 : element->count;
            reader_.setBytes(line);
            reader_.readRow(*element, row++, mesh);
            reader_.skipSpace();
            if (reader_.position() != line.size())
                return false;
        }
        lines_ = std::string();
        return true;
    }

private:
    // The first bytes of the file, with the header.
    static std::string headerOf(const std::string& path, std::uint64_t size, const Loaders& loaders)
    {
        std::string bytes;
        for (std::uint64_t step = 1024; bytes.find("end_header") == std::string::npos; step *= 2) {
            const std::uint64_t end = std::min<std::uint64_t>(size, bytes.size() + step);
            if (bytes.size() == end || end > (1 << 20))
                throw std::runtime_error(path + ": no end_header");
            bytes += readBytes(path, bytes.size(), end, loaders);
        }
        return bytes;
    }
    static bool isBlank(std::string_view line) { return nextWord(line).empty(); }

    // The bytes of a row of the element that begins at byte `at`, if all faces have as many vertices as the first one.
    // 0 if rows can differ in other ways, or the first face is wrong.
    std::uint64_t rowBytesOf(const PlyElement& element, std::uint64_t at)
    {
        std::uint64_t bytes = 0;
        int lists = 0;
        for (const PlyProperty& property : element.properties) {
            if (!property.isList) {
                bytes += fileBytes(property.type);
                continue;
            }
            const std::uint64_t place = at + bytes, width = fileBytes(property.countType);
            if (++lists > 1 || !element.isFace() || place + width > size_)
                return 0;
            const std::string count = readBytes(path_, place, place + width, loaders_);
            reader_.setBytes(count);
            const double vertices = reader_.number(property.countType, element, 0);
            if (!(vertices >= 3 && vertices <= 65536))
                return 0;
            bytes += width + static_cast<std::uint64_t>(vertices) * fileBytes(property.type);
        }
        return bytes;
    }

    std::string path_;
    const Loaders& loaders_;
    std::uint64_t size_, begin_ = 0;
    std::string header_, lines_;
    PlyReader reader_;
};

} // namespace detail

// Collective: the same as parsePly(), but each rank reads a share of the file. Returns nothing, on all ranks, if
// anything is wrong, or if faces of a binary file have different numbers of vertices. parsePly() of the whole file then
// reads it, or says what is wrong.
inline std::optional<MeshShare> readPlyShare(const std::string& path, const Loaders& loaders, Notes* notes)
{
    std::optional<detail::PlyShares> shares;
    Notes own;
    std::uint64_t lines = 0;
    MeshShare share;
    if (!loaders.isOnAll([&] {
            shares.emplace(path, loaders, &own);
            if (shares->isAscii())
                lines = shares->readLines();
            return shares->isAscii() || shares->readRows(share.mesh);
        }))
        return std::nullopt;
    const std::vector<std::uint64_t> begins = loaders.beginsOf(lines);
    if (!loaders.isOnAll([&] {
            return !shares->isAscii()
                   || shares->parseLines(begins[static_cast<std::size_t>(loaders.rank())], begins.back(), share.mesh);
        }))
        return std::nullopt;
    share.vertexBegins = loaders.beginsOf(share.mesh.positions.size());
    std::optional<MeshShare> all = finished(std::move(share), path, loaders, &own);
    if (all && notes)
        notes->insert(notes->end(), own.begin(), own.end());
    return all;
}

} // namespace example
