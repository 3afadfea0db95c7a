// PLY: the reader that makes a mesh from a PLY file.
//
// It is our own, because the one packaged library that reads PLY (Assimp 5.2) crashes on a binary file cut short, fills
// up a short ASCII file with zeros, and takes trailing bytes and indices beyond the last vertex without a word.
#pragma once

#include "mesh.hpp"
#include "voxels.hpp"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstring>
#include <sstream>
#include <string_view>

namespace example {

namespace detail {

struct PlyProperty {
    std::string name;
    FileType type = FileType::Float32;
    bool isList = false;
    FileType countType = FileType::UInt8;
    int channel = -1; // 0, 1 or 2: red, green or blue
};

struct PlyElement {
    std::string name;
    std::uint64_t count = 0;
    std::vector<PlyProperty> properties;

    bool isVertex() const { return name == "vertex"; }
    bool isFace() const { return name == "face"; }
};

// A cursor over the bytes of a PLY file: the header line by line, then numbers.
class PlyReader {
public:
    PlyReader(std::string_view bytes, const std::string& name, Notes* notes) : bytes_(bytes), name_(name), notes_(notes)
    {
    }

    Mesh read()
    {
        readHeader();
        Mesh mesh;
        for (const PlyElement& element : elements_) {
            // A row takes at least a byte, so that a false count cannot ask for more memory than the file has.
            if (!element.properties.empty() && element.count > bytes_.size() - at_)
                fail("it ends early: expected " + std::to_string(element.count) + " of element " + element.name
                     + ", got " + std::to_string(bytes_.size() - at_) + " bytes");
            for (std::uint64_t row = 0; row < element.count && !element.properties.empty(); ++row)
                readRow(element, row, mesh);
        }
        if (format_ == Format::Ascii)
            skipSpace();
        if (at_ != bytes_.size())
            fail("expected its end after " + std::to_string(at_) + " bytes, got " + std::to_string(bytes_.size())
                 + " bytes");
        if (mesh.triangles.empty())
            fail("it has no faces");
        finishColors(mesh, name_, notes_);
        return mesh;
    }

    // ---- for reading several ranges of rows: the header, then some rows at a time

    void readHeader()
    {
        if (bytes_.substr(0, 4) != "ply\n" && bytes_.substr(0, 5) != "ply\r\n")
            fail("expected a PLY file, got no line 'ply' at its start");
        headerLine();
        bool hasFormat = false;
        for (;;) {
            const std::vector<std::string> words = headerLine();
            if (words.empty() || words[0] == "comment" || words[0] == "obj_info")
                continue;
            if (words[0] == "end_header")
                break;
            if (words[0] == "format" && words.size() == 3 && !hasFormat && words[2] == "1.0") {
                hasFormat = true;
                if (words[1] == "ascii")
                    format_ = Format::Ascii;
                else if (words[1] == "binary_little_endian")
                    format_ = Format::LittleEndian;
                else if (words[1] == "binary_big_endian")
                    format_ = Format::BigEndian;
                else
                    fail("unknown format '" + words[1] + "'");
            } else if (words[0] == "element" && words.size() == 3) {
                PlyElement element;
                element.name = words[1];
                const char* end = words[2].data() + words[2].size();
                const auto result = std::from_chars(words[2].data(), end, element.count);
                if (result.ec != std::errc() || result.ptr != end)
                    fail("bad element count '" + words[2] + "'");
                elements_.push_back(element);
            } else if (words[0] == "property" && !elements_.empty()
                       && (words.size() == 3 || (words.size() == 5 && words[1] == "list"))) {
                PlyProperty property;
                property.name = words.back();
                property.isList = words.size() == 5;
                property.type = typeOf(words[words.size() - 2]);
                if (property.isList)
                    property.countType = typeOf(words[2]);
                property.channel = channelOf(property);
                elements_.back().properties.push_back(property);
            } else {
                fail("unexpected header line that begins with '" + words[0] + "'");
            }
        }
        if (!hasFormat)
            fail("the header names no format");
        checkElements();
        for (const PlyElement& element : elements_)
            vertexCount_ = element.isVertex() ? element.count : vertexCount_;
    }

    void readRow(const PlyElement& element, std::uint64_t row, Mesh& mesh)
    {
        const bool isVertex = element.isVertex(), isFace = element.isFace();
        Vec3 p, color;
        unsigned channels = 0; // a bit for each
        for (const PlyProperty& property : element.properties) {
            if (!property.isList) {
                const double value = number(property.type, element, row);
                if (isVertex && property.name.size() == 1 && property.name[0] >= 'x' && property.name[0] <= 'z')
                    component(p, property.name[0] - 'x') = static_cast<float>(value);
                if (isVertex && property.channel >= 0) {
                    component(color, property.channel) = static_cast<float>(value / largestOf(property.type));
                    channels |= 1u << property.channel;
                }
                continue;
            }
            const double count = number(property.countType, element, row);
            if (!(count >= 0 && count <= static_cast<double>(bytes_.size() - at_)) || count != std::floor(count))
                fail("it ends early, or has a bad list, in " + element.name + ' ' + std::to_string(row));
            polygon_.clear();
            for (std::int64_t i = 0; i < static_cast<std::int64_t>(count); ++i) {
                const double index = number(property.type, element, row);
                const bool canBe = index >= 0 && index < 4294967296.0 && index == std::floor(index);
                polygon_.push_back(canBe ? static_cast<std::int64_t>(index) : -1);
            }
            if (isFace && isIndexList(property))
                addPolygon(mesh, polygon_, vertexCount_, [&] { return name_ + ": face " + std::to_string(row); });
        }
        if (isVertex)
            addVertex(mesh, p, [&] { return name_ + ": vertex " + std::to_string(row); });
        if (channels == 7)
            mesh.colors.push_back(color);
    }

    void skipSpace()
    {
        while (at_ < bytes_.size() && (bytes_[at_] == ' ' || (bytes_[at_] >= '\t' && bytes_[at_] <= '\r')))
            ++at_;
    }

    const std::vector<PlyElement>& elements() const { return elements_; }
    bool isAscii() const { return format_ == Format::Ascii; }
    std::size_t position() const { return at_; }
    double number(FileType type, const PlyElement& element, std::uint64_t row)
    {
        const auto where = [&] {
            return " in " + element.name + ' ' + std::to_string(row) + " of " + std::to_string(element.count);
        };
        if (format_ == Format::Ascii) {
            skipSpace();
            if (at_ == bytes_.size())
                fail("it ends early," + where());
            double value = 0;
            std::string_view rest = bytes_.substr(at_);
            const bool isNumber = takeNumber(rest, value);
            at_ = bytes_.size() - rest.size();
            const bool ended =
                at_ == bytes_.size() || bytes_[at_] == ' ' || (bytes_[at_] >= '\t' && bytes_[at_] <= '\r');
            if (!isNumber || !ended)
                fail("expected a number," + where());
            return value;
        }
        return withFileType(type, [&](auto value) {
            if (bytes_.size() - at_ < sizeof value)
                fail("it ends early," + where());
            char bytes[sizeof value];
            std::memcpy(bytes, bytes_.data() + at_, sizeof value);
            if (format_ == Format::BigEndian)
                std::reverse(bytes, bytes + sizeof value);
            std::memcpy(&value, bytes, sizeof value);
            at_ += sizeof value;
            return static_cast<double>(value);
        });
    }

    void setBytes(std::string_view bytes)
    {
        bytes_ = bytes;
        at_ = 0;
    }

private:
    enum class Format { Ascii, LittleEndian, BigEndian };

    [[noreturn]] void fail(const std::string& why) const { throw std::runtime_error(name_ + ": " + why); }

    std::vector<std::string> headerLine()
    {
        const std::size_t end = bytes_.find('\n', at_);
        if (end == std::string_view::npos)
            fail("the header ends without end_header");
        std::istringstream line{std::string(bytes_.substr(at_, end - at_))};
        at_ = end + 1;
        std::vector<std::string> words;
        for (std::string word; line >> word;)
            words.push_back(word);
        return words;
    }

    void checkElements() const
    {
        bool seenVertex = false;
        for (const PlyElement& element : elements_) {
            int coordinates = 0, indexLists = 0, colors = 0;
            for (const PlyProperty& p : element.properties) {
                colors += p.channel >= 0;
                coordinates += !p.isList && (p.name == "x" || p.name == "y" || p.name == "z");
                indexLists += p.isList && isIndexList(p);
            }
            if (element.name == "vertex" && (coordinates != 3 || seenVertex))
                fail("expected one element vertex with x, y and z");
            if (element.name == "face" && (indexLists != 1 || !seenVertex))
                fail("expected an element face after the vertices with one list of vertex indices");
            if (element.name == "face" && colors > 0 && notes_)
                notes_->push_back(name_ + ": the colours of faces are left out; those of vertices would be used");
            seenVertex = seenVertex || element.name == "vertex";
        }
        if (!seenVertex)
            fail("it has no element vertex");
    }

    // 0, 1 or 2 if the property is red, green or blue, else -1.
    static int channelOf(const PlyProperty& p)
    {
        static const std::array<const char*, 3> names{"red", "green", "blue"};
        for (int i = 0; i < 3 && !p.isList; ++i)
            if (p.name == names[static_cast<std::size_t>(i)]
                || p.name == std::string("diffuse_") + names[static_cast<std::size_t>(i)])
                return i;
        return -1;
    }

    static bool isIndexList(const PlyProperty& p) { return p.name == "vertex_indices" || p.name == "vertex_index"; }

    FileType typeOf(const std::string& word) const
    {
        static const std::array<const char*, 8> others{"uchar", "char", "ushort", "short",
                                                       "uint",  "int",  "float",  "double"};
        for (std::size_t i = 0; i < others.size(); ++i)
            if (word == others[i] || word == fileTypes()[i].first)
                return fileTypes()[i].second;
        fail("unknown type '" + word + "'");
    }

    // The value of a channel at full intensity.
    static double largestOf(FileType type)
    {
        static const std::array<double, 8> all{255, 127, 65535, 32767, 255, 255, 1, 1}; // 32-bit integers: as bytes
        return all[static_cast<std::size_t>(type)];
    }

    std::string_view bytes_;
    std::string name_;
    Notes* notes_;
    std::size_t at_ = 0;
    Format format_ = Format::Ascii;
    std::vector<PlyElement> elements_;
    std::uint64_t vertexCount_ = 0;
    std::vector<std::int64_t> polygon_;
};

} // namespace detail

// Reads ASCII, or binary of either byte order. Vertex colours (red, green, blue) are taken as sRGB; integers count as a
// part of their type's largest value. Properties and elements other than positions and faces are skipped; polygons
// become fans of triangles. Throws std::runtime_error with `name`, what was expected and what was found. `notes` gets
// what was left out, if not null.
inline Mesh parsePly(std::string_view bytes, const std::string& name, Notes* notes = nullptr)
{
    return detail::PlyReader(bytes, name, notes).read();
}

} // namespace example
