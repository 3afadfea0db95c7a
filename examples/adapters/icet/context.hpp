// The context of an IceT client: its settings, its connection to the other ranks, and its frame.
#pragma once

#include "image.hpp"

#include <IceT.h>
#include <dfb/dfb.hpp>
#include <mpi.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <vector>

namespace dfb_icet {

using dfb::Region; // rows count upwards

// IceT gives rectangles of pixels by their lower left corner.
inline Region viewport(int x, int y, int width, int height) noexcept { return {x, y, x + width, y + height}; }

// `part` in coordinates of the picture of `tile`. Rows of both count upwards, so no picture is flipped.
inline Region regionIn(const Region& tile, const Region& part) noexcept
{
    return viewport(part.x0 - tile.x0, part.y0 - tile.y0, part.width(), part.height());
}

struct Tile {
    Region viewport;
    int displayRank = 0;
};

// Settings of a client, which icetCopyState() copies.
struct Settings {
    Settings();

    bool isEnabled(IceTEnum option) const { return enabled[option - ICET_STATE_ENABLE_START]; }
    Region wall() const;                    // all tiles
    std::array<int, 2> largestTile() const; // width and height, each of any tile
    int tileOf(int displayRank) const;

    IceTBitField diagnostics = ICET_DIAG_ALL_NODES | ICET_DIAG_WARNINGS;
    IceTEnum colorFormat = ICET_IMAGE_COLOR_RGBA_UBYTE, depthFormat = ICET_IMAGE_DEPTH_FLOAT;
    IceTEnum mode = ICET_COMPOSITE_MODE_Z_BUFFER;
    IceTEnum strategy = static_cast<IceTEnum>(-1), singleImageStrategy = ICET_SINGLE_IMAGE_STRATEGY_AUTOMATIC;
    std::vector<Tile> tiles;
    int physicalWidth = 0, physicalHeight = 0;
    std::vector<std::array<double, 3>> vertices; // around this rank's geometry; none: it may be anywhere
    IceTDrawCallbackType draw = nullptr;
    std::array<bool, ICET_STATE_ENABLE_END - ICET_STATE_ENABLE_START> enabled{};
};

// A frame: the arguments of its call, and its results.
struct Frame {
    std::int64_t count = 0; // of this context
    bool isPreRendered = false;
    std::array<double, 16> projection{}, modelview{}; // column by column
    std::array<float, 4> background{};
    Region contained;                  // the part of the wall that this rank has pixels in
    double nearest = 1, farthest = -1; // of the vertices, as normalised depth
    std::vector<int> tiles;            // the tiles that `contained` touches
    double renderSeconds = 0, totalSeconds = 0;
    std::int64_t bytesSent = 0;                    // by all ranks
    std::int64_t tilesTouched = 0, tilesTotal = 0; // small tiles of the library
};

// The pictures of a context's tiles. Those that frames need again are kept.
class Pictures {
public:
    struct Key {
        int tile = 0, width = 0, height = 0, displayRank = 0;
        dfb::OutputFormat format = dfb::OutputFormat::RGBA8;
        dfb::ImageBlend blend = dfb::ImageBlend::Nearest;
        bool depth = false;
    };

    // Drops pictures that have not been used for long. Call it with the number of the context's next frame. This and
    // find() are collective: all ranks make the same calls in the same order. If some do not, find() throws, and the
    // connection has failed.
    void newFrame(std::int64_t frame);
    dfb::ImageCompositor& find(const Key& key, const IceTContextStruct& context);
    void clear() { entries_.clear(); }

private:
    struct Entry {
        Key key;
        std::int64_t lastUse = 0;
        std::unique_ptr<dfb::ImageCompositor> compositor;
    };
    std::vector<Entry> entries_;
};

// Matrices and background that a client gives with a frame. Pointers to matrices may be null.
struct View {
    const IceTDouble *projection, *modelview;
    const IceTFloat* background;
};

// Where this rank's pixels come from: `limits` is the part of the wall outside of which there are none, null if the
// client renders when it is called back; `input` returns the input of a tile. An exception fails the frame on all
// ranks.
struct Source {
    const Region* limits = nullptr;
    std::function<dfb::InputImage(int tile)> input;
};

// Throws if a frame is drawn: the client calls from its draw callback.
void requireNotDrawing(const IceTContextStruct& context);

// Makes a frame and returns the picture of this rank's tile, if it displays one. Collective.
IceTImage makeFrame(IceTContextStruct& context, const View& view, const Source& source);

// Finds Frame::contained and Frame::tiles: the part of the wall that the vertices cover, within `limits` if not null.
void findContained(IceTContextStruct& context, const Region* limits);

// The pixels of an image that shows the part `memory` of the wall, of which `part` is valid, as input of a tile.
dfb::InputImage inputOf(IceTContextStruct& context, const Image& image, const Region& memory, const Region& part,
                        const Region& tile);

// The colour of each rank. Collective. Throws Error after timeLimit() if not all ranks call it: the communicator must
// not be used then.
std::vector<int> gatherColors(const IceTContextStruct& context, int color);

double secondsNow();
// Set by DFB_ICET_STATS and DFB_ICET_TIMEOUT, which is in seconds; 0: no limit.
bool wantsStatistics();
std::chrono::milliseconds timeLimit();

} // namespace dfb_icet

struct IceTContextStruct {
    // Collective over `communicator`, as are the next two.
    explicit IceTContextStruct(MPI_Comm communicator);
    ~IceTContextStruct();
    // Leaves MPI, which is about to end. Every later frame is an error.
    void close();

    int rank() const noexcept { return ownRank; }
    int size() const noexcept { return static_cast<int>(order.size()); }

    MPI_Comm comm = MPI_COMM_NULL;               // for gatherColors()
    std::shared_ptr<dfb::Connection> connection; // null after close()
    std::shared_ptr<dfb::Executor> executor;     // of all pictures
    int ownRank = 0;
    dfb_icet::Settings settings;
    std::vector<int> order;    // of the ranks, front to back
    std::vector<int> replicas; // the ranks that have this rank's data, with this rank
    bool hasGl = false, isDrawing = false;
    dfb_icet::Frame frame;
    dfb_icet::Pictures pictures;
    dfb_icet::Image rendered, result; // images of the draw callback, and of the last frame
    std::vector<float> withAlpha;     // an RGB image with the alpha that the library needs
};
