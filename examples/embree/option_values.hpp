// Values of options: checks and parsers for words of the command line, with one-line errors.
#pragma once

#include "file_look.hpp"
#include "text.hpp"
#include "vec.hpp"

#include <dfb/channels.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <array>
#include <cctype>
#include <cstdlib>
#include <sstream>
#include <string>
#include <string_view>
#include <vector>

namespace example {
namespace detail {

inline CLI::Validator ending(std::vector<std::string> endings)
{
    return CLI::Validator([endings](std::string& path) { return checkEnding(path, endings); }, "");
}

// A number within [lo, hi] and nothing else; CLI11's own range lets NaN pass. Takes leading zeros away.
inline CLI::Validator number(double lo, double hi)
{
    return CLI::Validator(
        [lo, hi](std::string& text) {
            char* end = nullptr;
            const double value = std::strtod(text.c_str(), &end);
            if (!text.empty() && *end == '\0' && value >= lo && value <= hi) {
                const std::size_t zeros = text.find_first_not_of("+-"), digits = text.find_first_not_of('0', zeros);
                if (digits != std::string::npos && std::isdigit(static_cast<unsigned char>(text[digits])))
                    text.erase(zeros, digits - zeros); // CLI11 would take 010 for the octal 8
                return std::string();
            }
            std::ostringstream message;
            message.precision(16);
            message << "'" << text << "' is no number from " << lo << " to " << hi;
            return message.str();
        },
        "");
}

// One of the words, which becomes its index: the value of an enumerator.
inline CLI::Validator choice(std::vector<std::string> words)
{
    return CLI::Validator(
        [words](std::string& text) {
            std::string all;
            for (std::size_t i = 0; i < words.size(); ++i) {
                if (text == words[i]) {
                    text = std::to_string(i);
                    return std::string();
                }
                all += (i == 0 ? "" : i + 1 == words.size() ? " or " : ", ") + words[i];
            }
            return "'" + text + "' is not " + all;
        },
        "");
}

// Breaks lines for the help's second column.
inline std::string wrapped(std::string text)
{
    const std::size_t width = 74;
    for (std::size_t begin = 0; text.size() - begin > width;) {
        const std::size_t space = text.rfind(' ', begin + width);
        if (space == std::string::npos || space < begin)
            break;
        text[space] = '\n';
        begin = space + 1;
    }
    return text;
}

inline void parseSize(const std::string& name, const std::string& text, int most, int& width, int& height)
{
    const std::size_t x = text.find('x');
    const auto side = [most](std::string_view word) {
        int value = 0;
        return parseNumber(word, value) && value >= 1 && value <= most ? value : 0;
    };
    const std::string_view both = text;
    width = side(both.substr(0, x));
    height = x == std::string::npos ? 0 : side(both.substr(x + 1));
    if (width == 0 || height == 0)
        throw CLI::ValidationError(name, "'" + text + "' is no pair of numbers such as 4x3, each from 1 to "
                                             + std::to_string(most));
}

// Three numbers within [lo, hi], as in R,G,B; `what` describes them in the error.
inline std::array<float, 3> parseThree(const std::string& name, const std::string& text, float lo, float hi,
                                       const std::string& what)
{
    const std::vector<float> values = numbersOf(text, 3);
    if (values.empty() || std::any_of(values.begin(), values.end(), [&](float v) { return !(v >= lo && v <= hi); }))
        throw CLI::ValidationError(name, "'" + text + "' is not " + what);
    return {values[0], values[1], values[2]};
}

// The channels that an .exr has besides colour, from the words of --layers.
inline dfb::ChannelMask parseLayers(const std::string& name, const std::string& text)
{
    static const std::vector<std::pair<std::string, dfb::ChannelMask>> layers = {
        {"depth", dfb::depthChannel},
        {"normal", dfb::normalChannel},
        {"albedo", dfb::albedoChannel},
        {"position", dfb::positionChannel},
        {"ids", dfb::primitiveIdChannel | dfb::instanceIdChannel},
        {"all", dfb::depthChannel | dfb::imageAuxChannels},
        {"none", 0}};
    dfb::ChannelMask all = 0;
    for (const std::string& word : splitAt(text, ',')) {
        const auto layer =
            std::find_if(layers.begin(), layers.end(), [&word](const auto& l) { return l.first == word; });
        if (layer == layers.end())
            throw CLI::ValidationError(name, "'" + word + "' is not depth, normal, albedo, position, ids, all or none");
        all = static_cast<dfb::ChannelMask>(all | layer->second);
    }
    return all;
}

} // namespace detail
} // namespace example
