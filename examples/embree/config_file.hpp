// Files of options, in JSON or TOML.
#pragma once

#include <CLI/CLI.hpp>
#include <nlohmann/json.hpp>

#include <istream>
#include <iterator>
#include <sstream>
#include <string>
#include <vector>

namespace example {

// The format of --config: a JSON object, {"scene": ["a.ply"], "size": "300x200", "spp": 4, "shadows": true}, or the
// same in TOML, without a # in a value.
class OptionsFile : public CLI::ConfigTOML {
public:
    // Throws CLI::ConfigError.
    std::vector<CLI::ConfigItem> from_config(std::istream& stream) const override
    {
        std::vector<CLI::ConfigItem> all = itemsOf(stream);
        for (const CLI::ConfigItem& item : all)
            if (item.inputs.empty() && item.name != "++" && item.name != "--") // these begin and end a section
                throw CLI::ConfigError("--config: " + item.name + ": the list is empty");
        return all;
    }

private:
    std::vector<CLI::ConfigItem> itemsOf(std::istream& stream) const
    {
        const std::string text{std::istreambuf_iterator<char>(stream), {}};
        const std::size_t first = text.find_first_not_of(" \t\r\n");
        if (first == std::string::npos || text[first] != '{') {
            std::istringstream toml(text);
            return CLI::ConfigTOML::from_config(toml);
        }
        const auto all = nlohmann::ordered_json::parse(text, nullptr, false);
        if (all.is_discarded())
            throw CLI::ConfigError("--config: the file is no JSON");
        std::vector<CLI::ConfigItem> found;
        for (const auto& [name, value] : all.items()) {
            CLI::ConfigItem item;
            item.name = name;
            for (const auto& word : value.is_array() ? value : nlohmann::ordered_json::array({value})) {
                if (!word.is_string() && !word.is_number() && !word.is_boolean())
                    throw CLI::ConfigError("--config: " + name + ": expected a text, a number, true or false");
                item.inputs.push_back(word.is_string() ? word.get<std::string>() : word.dump());
            }
            found.push_back(std::move(item));
        }
        return found;
    }
};

namespace detail {

// An option's value: a number, true or false if it is one, otherwise a text.
inline nlohmann::ordered_json valueOf(const std::string& text)
{
    const nlohmann::ordered_json value = nlohmann::ordered_json::parse(text, nullptr, false);
    return value.is_number() || value.is_boolean() ? value : nlohmann::ordered_json(text);
}

} // namespace detail

} // namespace example
