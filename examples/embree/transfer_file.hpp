// Transfer functions from JSON files:
//
//     {"range": [0, 300], "points": [{"value": 0, "color": [0.2, 0.2, 0.3], "opacity": 0},
//                                    {"value": 1, "color": "#ffddaa", "opacity": 0.4}]}
//
// The values ascend. Without "range" they are values of the data. With "range", 0 and 1 stand for its two ends; with
// "range": "auto", for the ends of the range that is shown by default. Colours are sRGB. The opacity is that of a slab
// as thick as 1/256 of the volume's largest extent. Colour and opacity are linear between points.
#pragma once

#include "color_maps.hpp"
#include "file_look.hpp"

#include <string>
#include <vector>

namespace example {

struct TransferFile {
    TransferPoints points;    // in sRGB; value 0 stands for the start of the range, 1 for its end
    std::vector<float> range; // start and end, in values of the data; empty: "auto"
};

// Throws std::runtime_error that names the file and what is wrong.
TransferFile parseTransfer(const std::string& text, const std::string& path);

} // namespace example
