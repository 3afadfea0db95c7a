// Files of options, in JSON or TOML.
#pragma once

#include "options.hpp"

#include <CLI/CLI.hpp>

#include <istream>
#include <iterator>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
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
        OptionsInFile all;
        try {
            all = parseJsonOptions(text);
        } catch (const std::runtime_error& error) {
            throw CLI::ConfigError(error.what());
        }
        std::vector<CLI::ConfigItem> found;
        for (auto& [name, values] : all) {
            CLI::ConfigItem item;
            item.name = name;
            item.inputs = std::move(values);
            found.push_back(std::move(item));
        }
        return found;
    }
};

} // namespace example
