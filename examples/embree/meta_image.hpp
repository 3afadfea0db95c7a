// MetaImage: the reader of headers of .mhd and .mha files, as ITK writes them.
#pragma once

#include "header_lines.hpp"

namespace example {

namespace detail {

class MetaImageReader {
public:
    MetaImageReader(std::istream& stream, const std::string& path) : lines_(stream, path) { file_.path = path; }

    VolumeFile read()
    {
        std::string line;
        while (file_.data.empty() && lines_.next(line)) {
            if (trimmed(line).empty())
                continue;
            const std::size_t equals = line.find('=');
            if (equals == std::string::npos)
                lines_.fail("expected 'Key = value', got '" + lines_.shortened(line) + "'");
            readKey(trimmed(std::string_view(line).substr(0, equals)),
                    trimmed(std::string_view(line).substr(equals + 1)));
        }
        finish();
        return std::move(file_);
    }

private:
    void readKey(const std::string& key, const std::string& value)
    {
        if (key == "ObjectType" && value != "Image")
            lines_.fail("expected ObjectType = Image, got '" + lines_.shortened(value) + "'");
        else if (key == "NDims")
            hasDimension_ = lines_.isThree(value, "NDims =");
        else if (key == "DimSize")
            readSizes(value);
        else if (key == "ElementType")
            readType(value);
        else if (key == "ElementSpacing" || (key == "ElementSize" && !hasSpacing_))
            readSpacing(key, value);
        else if (key == "Offset" || key == "Origin" || key == "Position")
            file_.origin = lines_.origin(lines_.numbers<double, 3>(value, key));
        else if (key == "TransformMatrix" || key == "Rotation" || key == "Orientation")
            readMatrix(key, value);
        else if (key == "BinaryDataByteOrderMSB" || key == "ElementByteOrderMSB")
            file_.format.isBigEndian = flag(key, value);
        else if (key == "BinaryData" && !flag(key, value))
            lines_.fail("voxels as text cannot be read, expected BinaryData = True");
        else if (key == "CompressedData" && flag(key, value))
            lines_.fail(
                "compressed voxels cannot be read in parts, as each rank does; expected CompressedData = False");
        else if (key == "ElementNumberOfChannels" && lines_.numbers<int, 1>(value, key)[0] != 1)
            lines_.fail("expected one channel, got " + value);
        else if (key == "HeaderSize")
            skip_ = lines_.skip(value, "HeaderSize", -1);
        else if (key == "ElementDataFile")
            readDataFile(value);
    }

    bool flag(const std::string& key, const std::string& value) const
    {
        const std::string word = lowerCase(value);
        if (word != "true" && word != "false" && word != "1" && word != "0")
            lines_.fail("expected True or False for " + key + ", got '" + lines_.shortened(value) + "'");
        return word == "true" || word == "1";
    }
    void readSizes(const std::string& value)
    {
        if (!hasDimension_)
            lines_.fail("expected NDims before DimSize");
        file_.dims = lines_.dims(value);
    }
    void readType(const std::string& value)
    {
        file_.format.type = lines_.typeOf(value,
                                          {{"|MET_CHAR|", FileType::Int8},
                                           {"|MET_UCHAR|", FileType::UInt8},
                                           {"|MET_SHORT|", FileType::Int16},
                                           {"|MET_USHORT|", FileType::UInt16},
                                           {"|MET_INT|", FileType::Int32},
                                           {"|MET_UINT|", FileType::UInt32},
                                           {"|MET_FLOAT|", FileType::Float32},
                                           {"|MET_DOUBLE|", FileType::Float64}},
                                          "MET_ and CHAR, UCHAR, SHORT, USHORT, INT, UINT, FLOAT or DOUBLE");
        hasType_ = true;
    }
    void readSpacing(const std::string& key, const std::string& value)
    {
        file_.spacing = lines_.spacing(lines_.numbers<double, 3>(value, key));
        hasSpacing_ = key == "ElementSpacing"; // without it, the voxel's size is used
    }
    void readMatrix(const std::string& key, const std::string& value)
    {
        const auto m = lines_.numbers<double, 9>(value, key);
        if (!(m[0] > 0.999 && m[4] > 0.999 && m[8] > 0.999))
            file_.notes.push_back(lines_.turnedNote());
    }
    void readDataFile(const std::string& value)
    {
        isLocal_ = value == "LOCAL";
        file_.data = isLocal_ ? file_.path : lines_.pathOfData(value, "ElementDataFile");
    }

    void finish()
    {
        lines_.need(file_.dims[0] > 0, "DimSize");
        lines_.need(hasType_, "ElementType");
        lines_.need(!file_.data.empty(), "ElementDataFile");
        file_.begin = skip_ != 0 ? skip_ : isLocal_ ? lines_.position() : 0;
    }

    HeaderLines lines_;
    VolumeFile file_;
    bool hasDimension_ = false, hasType_ = false, hasSpacing_ = false, isLocal_ = false;
    std::int64_t skip_ = 0;
};

} // namespace detail

// The header of a MetaImage, whose voxels are raw and either in the same file or in another one. Throws
// std::runtime_error with `path` and, if a line is wrong, that line.
inline VolumeFile parseMetaImage(std::istream& stream, const std::string& path)
{
    return detail::MetaImageReader(stream, path).read();
}

} // namespace example
