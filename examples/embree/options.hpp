// Options: the command line of dfb_render.
#pragma once

#include "camera.hpp"
#include "file_look.hpp"
#include "text.hpp"

#include <dfb/channels.hpp>
#include <dfb/comm/heartbeat.hpp>
#include <dfb/wire/wire_format.hpp>

#include <array>
#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace example {

enum class Mode { Data, Image, Mixed };
enum class Blending { Sort, Order, Nearest };
enum class CutBy { Auto, Volume, Content };
enum class Balance { Cost, RoundRobin };
enum class Distribution { Owned, Linear, RoundRobin, Dynamic };
enum class Compression { None, Snappy, Auto };
enum class OwnerMap { Auto, Lattice, Linear, Hash };

struct OutputFiles {
    // Empty: not written. All but the last three may be patterns.
    std::string output, alpha, depth, aux, stats, trace, saveOptions;
    std::string cinema; // a folder; empty: none. `output` is in it then
    int pngBits = 8;
    dfb::ChannelMask layers = dfb::depthChannel; // of an .exr, beside colour

    bool isExr() const { return endingOf(output) == ".exr"; }
    bool writesNothing() const
    {
        return output.empty() && alpha.empty() && depth.empty() && aux.empty() && stats.empty() && trace.empty()
               && saveOptions.empty();
    }
};

inline constexpr int mostCells = 1 << 24; // of all bricks

struct Options : OutputFiles, RenderSettings {
    std::vector<std::string> scene; // `synthetic`, `demo`, or files, as the user wrote them
    std::vector<SceneFile> files;   // the files among these, each with its look
    bool fit = true;
    int xyzFrame = 0;                                    // of .xyz files; 0: the first
    std::optional<std::array<float, 3>> spacing, origin; // of volumes; none: as the file says
    Mode mode = Mode::Data;
    int ranks = 0;     // threads as ranks, without MPI; 0: MPI's ranks
    int bricks = 0;    // 0: one per rank
    int replicate = 2; // ranks that hold each brick, in mixed mode
    Blending blend = Blending::Sort;
    CutBy cut = CutBy::Auto;
    Balance balance = Balance::Cost;
    Distribution distribution = Distribution::Owned; // in image mode
    int interleave = 1;                              // cells of a brick
    int deep = 0;                                    // segments per pixel and brick; 0: one fragment
    dfb::WireFormat wire = dfb::WireFormat::Float32;
    double errorBudget = 0;     // 0: `wire`
    float minTransmittance = 0; // 0: off
    bool verify = false;
    int inFlight = 1; // frames that may be open at once
    int threads = 0;  // per rank; 0: its part of the processors
    Compression compression = Compression::None;
    bool sharedMemory = true;
    int peerTimeout = static_cast<int>(dfb::defaultPeerTimeout.count() / 1000); // seconds; 0: off
    OwnerMap ownerMap = OwnerMap::Auto;

    float adaptive = 0;                             // 0: off
    FileLook look;                                  // for files that have none of their own
    float exposure = 0;                             // 0: off
    std::optional<std::array<float, 3>> background; // linear RGB, opaque; none: transparent black
    bool dither = false;

    std::optional<int> live; // the port of a live view, -1: any; none: there is none

    int wallColumns = 0, wallRows = 0; // 0: no wall
    int bezel = 0;

    // The effective values of all options except the scene, by name and as words of the command line. Empty ones are
    // left out.
    std::vector<std::pair<std::string, std::string>> values;
    std::vector<std::pair<std::string, std::string>> given; // those of them that the user gave

    bool isDeep() const { return deep > 0 || interleave > 1; }
};

// Exit codes besides 0.
inline constexpr int exitFailed = 1; // the run has failed
inline constexpr int exitUsage = 2;  // the command line is wrong

// Either options to run with, or a message to print (on one rank) and a code to exit with: the help and 0, or one
// line on what is wrong and exitUsage.
struct ParsedOptions {
    std::optional<Options> options;
    int exitCode = 0;
    std::string message;
};

// Prints nothing, so that one of many ranks can do it.
ParsedOptions parseOptions(int argc, const char* const* argv);

// Each option in a file of options, and its values.
using OptionsInFile = std::vector<std::pair<std::string, std::vector<std::string>>>;

// The options in the text of a file that is a JSON object. Throws std::runtime_error.
OptionsInFile parseJsonOptions(const std::string& text);

// Returns the text of a JSON file with which --config repeats this run.
std::string optionsText(const std::vector<std::string>& scene,
                        const std::vector<std::pair<std::string, std::string>>& given);

} // namespace example
