// Text: the lines, words and numbers of text files, and a reader's notes about a file that it accepts.
#pragma once

#include <algorithm>
#include <charconv>
#include <cstddef>
#include <cstdio>
#include <exception>
#include <new>
#include <string>
#include <string_view>
#include <system_error>
#include <vector>

namespace example {

// Lines for the user. Each says what may differ from what the file, or an option, was meant to say.
using Notes = std::vector<std::string>;

// What an exception says; if memory is lacking, also what helps.
inline std::string reasonOf(const std::exception& e)
{
    const bool lacksMemory = dynamic_cast<const std::bad_alloc*>(&e) != nullptr;
    return std::string(e.what()) + (lacksMemory ? ": too little memory; of several ranks each needs less" : "");
}

inline std::string textOf(double value)
{
    char text[32];
    std::snprintf(text, sizeof text, "%g", value);
    return text;
}
inline std::string textOf(float value) { return textOf(static_cast<double>(value)); }

// The ending of a path, with its dot; empty if there is none.
inline std::string endingOf(const std::string& path) { return path.substr(std::min(path.rfind('.'), path.size())); }

// Goes through a text line by line. Lines end with \n, \r\n or \r.
class TextLines {
public:
    explicit TextLines(std::string_view bytes) : bytes_(bytes) {}

    bool atEnd() const { return at_ == bytes_.size(); }
    std::size_t number() const { return number_; } // of the line that next() gave last, from 1

    // The next line without its end; an empty one at the end of the text.
    std::string_view next()
    {
        const std::size_t begin = at_;
        while (at_ < bytes_.size() && bytes_[at_] != '\n' && bytes_[at_] != '\r')
            ++at_;
        const std::string_view line = bytes_.substr(begin, at_ - begin);
        at_ += bytes_.substr(at_, 2) == "\r\n" ? 2 : atEnd() ? 0 : 1;
        ++number_;
        return line;
    }

private:
    std::string_view bytes_;
    std::size_t at_ = 0, number_ = 0;
};

// Takes the next word from the front of a line; an empty one if there is none.
inline std::string_view nextWord(std::string_view& line)
{
    const char* space = " \t\r\f\v";
    line.remove_prefix(std::min(line.find_first_not_of(space), line.size()));
    const std::string_view word = line.substr(0, line.find_first_of(space));
    line.remove_prefix(word.size());
    return word;
}

// Takes a number, which may have a sign, from the front of a text. False if there is none or it is too large.
template <class Number>
bool takeNumber(std::string_view& text, Number& value)
{
    text.remove_prefix(text.size() > 1 && text[0] == '+' && text[1] != '-');
    const auto result = std::from_chars(text.data(), text.data() + text.size(), value);
    text.remove_prefix(static_cast<std::size_t>(result.ptr - text.data()));
    return result.ec == std::errc();
}

// Whether a word is a number and nothing else.
template <class Number>
bool parseNumber(std::string_view word, Number& value)
{
    return takeNumber(word, value) && word.empty();
}

} // namespace example
