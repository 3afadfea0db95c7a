// Options: the command lines of the benchmarks, without MPI.
#pragma once

#include "figures.hpp"

#include <array>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <map>
#include <sstream>
#include <string>
#include <vector>

namespace bench {

inline std::vector<std::string> partsOf(const std::string& text, char separator)
{
    std::istringstream stream(text);
    std::vector<std::string> parts;
    for (std::string part; std::getline(stream, part, separator);)
        parts.push_back(part);
    return parts;
}

// Reads "1024x768". Returns false if it is no size, or a side is smaller than 16.
inline bool readSize(const std::string& text, int& width, int& height)
{
    int end = 0;
    return text.size() < 12 && std::sscanf(text.c_str(), "%dx%d%n", &width, &height, &end) == 2
           && text[static_cast<std::size_t>(end)] == 0 && width >= 16 && height >= 16 && width <= 65536
           && height <= 65536;
}

// A reader of "1024x768,..." into `sizes`.
inline std::function<bool(const std::string&)> readSizes(std::vector<std::array<int, 2>>& sizes)
{
    return [&sizes](const std::string& value) {
        sizes.clear();
        for (const std::string& part : partsOf(value, ',')) {
            sizes.emplace_back();
            if (!readSize(part, sizes.back()[0], sizes.back()[1]))
                return false;
        }
        return !sizes.empty();
    };
}

// Options with a value each. Their readers return false for one that makes no sense. `switches` have no value. Ends the
// program after --help, or if it was called wrongly.
inline void readOptions(int argc, char** argv, const char* usage,
                        const std::map<std::string, std::function<bool(const std::string&)>>& readers,
                        const std::map<std::string, bool*>& switches = {})
{
    for (int i = 1; i < argc; i += 2) {
        const std::string name = argv[i];
        if (const auto found = switches.find(name); found != switches.end()) {
            *found->second = true;
            --i;
            continue;
        }
        const auto reader = readers.find(name);
        if (reader != readers.end() && i + 1 < argc && reader->second(argv[i + 1]))
            continue;
        std::printf("%s\n", usage);
        std::exit(name == "--help" ? 0 : 2);
    }
}

// A reader of a whole number.
template <class Number>
std::function<bool(const std::string&)> readNumber(Number& to, int least)
{
    return [&to, least](const std::string& value) {
        char* end = nullptr;
        const long n = std::strtol(value.c_str(), &end, 10);
        to = static_cast<Number>(n);
        return *end == 0 && !value.empty() && n >= least && n < 1000000000;
    };
}

// A reader of "1,2,8" into `numbers`, each from `least` to `most`.
inline std::function<bool(const std::string&)> readNumbers(std::vector<int>& numbers, int least, int most)
{
    return [&numbers, least, most](const std::string& value) {
        numbers.clear();
        for (const std::string& part : partsOf(value, ','))
            if (!readNumber(numbers.emplace_back(), least)(part) || numbers.back() > most)
                return false;
        return !numbers.empty();
    };
}

// A reader that keeps the text.
inline std::function<bool(const std::string&)> readText(std::string& text)
{
    return [&text](const std::string& value) {
        text = value;
        return true;
    };
}

} // namespace bench
