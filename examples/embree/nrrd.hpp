// NRRD: the reader of headers of .nrrd and .nhdr files (teem.sourceforge.net/nrrd/format.html).
//
// It is our own, because the reader of teem reads the whole file, and each rank needs only its part.
#pragma once

#include "header_lines.hpp"

#include <fstream>
#include <optional>

namespace example {

namespace detail {

class NrrdReader {
public:
    NrrdReader(std::istream& stream, const std::string& path) : lines_(stream, path) { file_.path = path; }

    VolumeFile read()
    {
        std::string line;
        if (!lines_.next(line) || line.compare(0, 7, "NRRD000") != 0 || line.size() != 8)
            throw std::runtime_error(file_.path + ": expected 'NRRD000' and a digit at its start");
        bool endsWithFile = false;
        for (;;) {
            endsWithFile = !lines_.next(line);
            if (line.empty())
                break;
            const std::size_t colon = line.find(": ");
            if (line[0] == '#' || line.find(":=") < colon)
                continue; // a comment, or a key and value, which do not describe the voxels
            if (colon == std::string::npos && line.back() != ':')
                lines_.fail("expected 'field: value', got '" + lines_.shortened(line) + "'");
            readField(lowerCase(line.substr(0, std::min(colon, line.size() - 1))),
                      trimmed(std::string_view(line).substr(std::min(colon, line.size() - 1) + 1)));
        }
        finish(endsWithFile);
        return std::move(file_);
    }

private:
    void readField(const std::string& field, const std::string& value)
    {
        if (field == "type")
            readType(value);
        else if (field == "dimension")
            hasDimension_ = lines_.isThree(value, "dimension");
        else if (field == "sizes")
            readSizes(value);
        else if (field == "encoding")
            readEncoding(value);
        else if (field == "endian")
            readEndian(value);
        else if (field == "spacings")
            readSpacings(value);
        else if (field == "space directions")
            readDirections(value);
        else if (field == "space origin")
            file_.origin = lines_.origin(vectors<1>(value, "space origin")[0]);
        else if (field == "axis mins" || field == "axismins")
            file_.origin = lines_.origin(lines_.numbers<double, 3>(value, "axis mins"));
        else if (field == "data file" || field == "datafile")
            file_.data = lines_.pathOfData(value, "data file");
        else if (field == "byte skip" || field == "byteskip")
            byteSkip_ = lines_.skip(value, "byte skip", -1);
        else if (field == "line skip" || field == "lineskip")
            lineSkip_ = lines_.skip(value, "line skip", 0);
    }

    void readType(const std::string& value)
    {
        type_ = lines_.typeOf(value,
                              {{"|signed char|int8|int8_t|", FileType::Int8},
                               {"|uchar|unsigned char|uint8|uint8_t|", FileType::UInt8},
                               {"|short|short int|signed short|signed short int|int16|int16_t|", FileType::Int16},
                               {"|ushort|unsigned short|unsigned short int|uint16|uint16_t|", FileType::UInt16},
                               {"|int|signed int|int32|int32_t|", FileType::Int32},
                               {"|uint|unsigned int|uint32|uint32_t|", FileType::UInt32},
                               {"|float|", FileType::Float32},
                               {"|double|", FileType::Float64}},
                              "an integer of up to 32 bits, float or double");
    }
    void readSizes(const std::string& value)
    {
        if (!hasDimension_)
            lines_.fail("expected a line 'dimension' before 'sizes'");
        file_.dims = lines_.dims(value);
    }
    void readEncoding(const std::string& value)
    {
        if (lowerCase(value) != "raw")
            lines_.fail("the encoding '" + lines_.shortened(value)
                        + "' cannot be read in parts, as each rank does; expected raw (unu save -e raw makes it)");
        isRaw_ = true;
    }
    void readEndian(const std::string& value)
    {
        const std::string word = lowerCase(value);
        if (word != "little" && word != "big")
            lines_.fail("expected endian little or big, got '" + lines_.shortened(value) + "'");
        isBigEndian_ = word == "big";
    }
    void readSpacings(const std::string& value)
    {
        auto spacings = lines_.numbers<double, 3>(value, "spacings");
        for (double& spacing : spacings)
            spacing = std::isnan(spacing) ? 1 : spacing; // NaN stands for an unknown spacing
        file_.spacing = lines_.spacing(spacings);
    }
    void readDirections(const std::string& value)
    {
        const auto axes = vectors<3>(value, "space directions");
        std::array<double, 3> spacings{};
        bool isTurned = false;
        for (std::size_t axis = 0; axis < 3; ++axis) {
            const auto& v = axes[axis];
            spacings[axis] = std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
            isTurned = isTurned || !(v[axis] > 0.999 * spacings[axis]);
        }
        file_.spacing = lines_.spacing(spacings);
        if (isTurned)
            file_.notes.push_back(lines_.turnedNote());
    }

    // Vectors as in (1,0,0) (0,1,0) (0,0,1).
    template <std::size_t count>
    std::array<std::array<double, 3>, count> vectors(std::string_view text, const std::string& what) const
    {
        std::array<std::array<double, 3>, count> all{};
        const std::string_view whole = text;
        const auto skip = [&text](char c) {
            text.remove_prefix(std::min(text.find_first_not_of(' '), text.size()));
            const bool isThere = !text.empty() && text[0] == c;
            text.remove_prefix(isThere);
            return isThere;
        };
        bool ok = true;
        for (auto& vector : all)
            for (std::size_t i = 0; i < 3 && ok; ++i) {
                ok = skip(i == 0 ? '(' : ',');
                text.remove_prefix(std::min(text.find_first_not_of(' '), text.size()));
                ok = ok && takeNumber(text, vector[i]) && (i < 2 || skip(')'));
            }
        if (!ok || !trimmed(text).empty())
            lines_.fail("expected " + std::to_string(count) + (count == 1 ? " vector" : " vectors") + " (x,y,z) for "
                        + what + ", got '" + lines_.shortened(whole) + "'");
        return all;
    }

    void finish(bool endsWithFile)
    {
        lines_.need(type_.has_value(), "type");
        lines_.need(file_.dims[0] > 0, "sizes");
        lines_.need(isRaw_, "encoding");
        file_.format.type = *type_;
        lines_.need(isBigEndian_.has_value() || file_.format.bytes() == 1, "endian");
        file_.format.isBigEndian = isBigEndian_.value_or(false);
        if (file_.data.empty()) {
            if (endsWithFile)
                throw std::runtime_error(file_.path + ": expected a line 'data file', or an empty line and the voxels");
            file_.data = file_.path;
            file_.begin = lines_.position();
        }
        skipLines();
        file_.begin = byteSkip_ < 0 ? -1 : file_.begin + byteSkip_;
    }
    // Skips lines in the file that has the voxels, from where they would begin.
    void skipLines()
    {
        if (lineSkip_ == 0 || byteSkip_ < 0)
            return;
        std::ifstream data(file_.data, std::ios::binary);
        data.seekg(file_.begin);
        const std::int64_t end = file_.begin + mostInLines;
        for (std::int64_t left = lineSkip_; left > 0;) {
            const int c = file_.begin < end ? data.get() : -1;
            if (c < 0)
                throw std::runtime_error(file_.path + ": " + file_.data + ": expected " + std::to_string(lineSkip_)
                                         + " lines before the voxels, got " + std::to_string(lineSkip_ - left));
            ++file_.begin;
            left -= c == '\n';
        }
    }

    static constexpr std::int64_t mostInLines = 1 << 24;

    HeaderLines lines_;
    VolumeFile file_;
    std::optional<FileType> type_;
    std::optional<bool> isBigEndian_;
    bool hasDimension_ = false, isRaw_ = false;
    std::int64_t byteSkip_ = 0, lineSkip_ = 0;
};

} // namespace detail

// The header of an NRRD file, whose voxels are raw and either in the same file or in another one. Throws
// std::runtime_error with `path` and, if a line is wrong, that line.
inline VolumeFile parseNrrd(std::istream& stream, const std::string& path)
{
    return detail::NrrdReader(stream, path).read();
}

} // namespace example
