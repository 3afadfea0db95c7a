// HeaderLines: the lines of text at the beginning of a volume's file, and the values in a line.
#pragma once

#include "text.hpp"
#include "volume_file.hpp"

#include <istream>

namespace example {

// Reads a stream line by line. Throws std::runtime_error whose text begins with the file and the line.
class HeaderLines {
public:
    HeaderLines(std::istream& stream, const std::string& path) : stream_(stream), path_(path)
    {
        if (!stream)
            throw std::runtime_error(path + ": cannot be opened");
    }

    // The next line, without its end. False at the end of the file.
    bool next(std::string& line)
    {
        line.clear();
        char c = 0;
        while (stream_.get(c)) {
            if (++position_ > most)
                fail("the header does not end within " + std::to_string(most) + " bytes");
            if (c == '\n')
                break;
            line += c;
        }
        if (line.empty() && !stream_)
            return false;
        ++number_;
        if (!line.empty() && line.back() == '\r')
            line.pop_back();
        return true;
    }

    std::int64_t position() const { return position_; } // the byte behind the last line

    [[noreturn]] void fail(const std::string& why) const { throw std::runtime_error(where() + ": " + why); }
    std::string where() const { return path_ + ": line " + std::to_string(number_); }

    // ---- values of the line that was read last

    // `count` numbers and nothing else.
    template <class Number, std::size_t count>
    std::array<Number, count> numbers(std::string_view text, const std::string& what) const
    {
        std::array<Number, count> values{};
        const std::string_view all = text;
        bool ok = true;
        for (Number& value : values)
            ok = parseNumber(nextWord(text), value) && ok;
        if (!ok || !nextWord(text).empty())
            fail("expected " + std::to_string(count) + (count == 1 ? " number" : " numbers") + " for " + what
                 + ", got '" + shortened(all) + "'");
        return values;
    }
    Index3 dims(std::string_view text) const
    {
        const auto dims = numbers<int, 3>(text, "the dimensions");
        for (const int value : dims)
            if (!isDimension(value))
                fail("expected dimensions from 2 to 65536, got " + std::to_string(value));
        return dims;
    }
    Vec3 spacing(const std::array<double, 3>& values) const
    {
        for (const double value : values)
            if (!isSpacing(value))
                fail("expected a spacing from 1e-15 to 1e9, got " + textOf(value));
        return vec(values);
    }
    Vec3 origin(const std::array<double, 3>& values) const
    {
        for (const double value : values)
            if (!isOrigin(value))
                fail("expected an origin of at most 1e12, got " + textOf(value));
        return vec(values);
    }
    static std::string shortened(std::string_view text) { return std::string(text.substr(0, 60)); }

    // `names`: for each type its names, with | around each of them.
    FileType typeOf(const std::string& value, const std::vector<std::pair<std::string, FileType>>& names,
                    const char* expected) const
    {
        for (const auto& [all, type] : names)
            if (all.find('|' + value + '|') != std::string::npos && value.find('|') == std::string::npos)
                return type;
        fail("the type '" + shortened(value) + "' cannot be drawn, expected " + expected);
    }
    bool isThree(std::string_view text, const std::string& what) const
    {
        if (const int dimension = numbers<int, 1>(text, what)[0]; dimension != 3)
            fail("expected " + what + " 3, got " + std::to_string(dimension));
        return true;
    }
    // A number of bytes or lines to skip.
    std::int64_t skip(std::string_view text, const std::string& what, int least) const
    {
        const std::int64_t value = numbers<std::int64_t, 1>(text, what)[0];
        if (value < least || value > std::int64_t{1} << 50)
            fail("expected a " + what + " of " + std::to_string(least) + " or more, got " + std::string(text));
        return value;
    }
    std::string turnedNote() const
    {
        return where()
               + ": its axes are turned or mirrored in space; it is drawn as it is stored, with x to the right, y down "
                 "and z to the back";
    }
    // The path of the only data file. A relative path in a header begins in the header's folder.
    std::string pathOfData(const std::string& name, const char* what) const
    {
        if (name.empty() || name.compare(0, 4, "LIST") == 0 || name.find('%') != std::string::npos)
            fail(std::string("expected one ") + what + ", got '" + shortened(name)
                 + "'; slices in files of their own cannot be read");
        const std::size_t folder = name[0] == '/' ? std::string::npos : path_.find_last_of('/');
        return (folder == std::string::npos ? "" : path_.substr(0, folder + 1)) + name;
    }
    // Throws std::runtime_error if a line that a header needs is not there.
    void need(bool isThere, const char* name) const
    {
        if (!isThere)
            throw std::runtime_error(path_ + ": the header has no line '" + name + "'");
    }

private:
    static constexpr std::int64_t most = 1 << 20;

    static Vec3 vec(const std::array<double, 3>& v) { return toFloat(Vec3d{v[0], v[1], v[2]}); }

    std::istream& stream_;
    std::string path_;
    std::int64_t position_ = 0;
    std::size_t number_ = 0;
};

inline std::string lowerCase(std::string text)
{
    for (char& c : text)
        c = c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c;
    return text;
}

inline std::string trimmed(std::string_view text)
{
    const char* space = " \t\r";
    text.remove_prefix(std::min(text.find_first_not_of(space), text.size()));
    return std::string(text.substr(0, text.find_last_not_of(space) + 1));
}

} // namespace example
