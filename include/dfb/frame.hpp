// What goes into a frame and what comes out of it: configuration, parameters, report.
#pragma once

#include <dfb/channels.hpp>
#include <dfb/comm/compression.hpp>
#include <dfb/comm/transport.hpp>
#include <dfb/error.hpp>
#include <dfb/exec.hpp>
#include <dfb/tile_layout.hpp>
#include <dfb/wire/wire_format.hpp>

#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

namespace dfb {

// The image that the display rank gets. All ranks must give the same; the constructor checks it.
struct ImageConfig {
    int width = 0, height = 0;                 // pixels, 1 to 65536
    OutputFormat format = OutputFormat::RGBA8; // of the colour
    bool depth = false;                        // whether the image has depth; a float more per pixel
    ChannelMask aux = 0;                       // its auxiliary channels, which the tile operation must have
    bool dither = false;                       // dithers 8-bit colour instead of rounding it: see ditherPixels()
    int displayRank = 0;                       // the rank that gets the image
    OwnerMap ownerMap = latticeOwner;          // which rank owns which tile; null: latticeOwner
};

// The messages of one framebuffer. All ranks must give the same; the constructor checks it.
struct MessageConfig {
    std::shared_ptr<const Codec> codec{}; // compresses messages; null: none are compressed
    CompressionMode compression = CompressionMode::Always;
    // The most that inputs and finished tiles take up in a rank's inbox and on the way to it, and the most that a rank
    // has under way to others before setTile() waits. Raised to 4 times the largest possible message.
    std::size_t poolBytes = std::size_t{64} << 20;
};

// What a framebuffer is made with. How its messages travel is the NetworkConfig of its connection.
struct FrameBufferConfig {
    FrameBufferConfig() = default;
    FrameBufferConfig(int width, int height, OutputFormat format = OutputFormat::RGBA8, bool depth = false)
    {
        image.width = width;
        image.height = height;
        image.format = format;
        image.depth = depth;
    }

    ImageConfig image;
    MessageConfig messages;
    // How exactly the colour of inputs travels: a WireFormat, an ErrorBudget, or a Precision. The default is exact.
    // Other channels always travel exactly, and finished tiles in image.format. The same on all ranks.
    Precision precision{};
    // For AlphaBlend, OrderedBlend and DeepBlend. Above 0: a pixel whose layers let less than this part of the light
    // through counts as opaque, and layers behind are left out. The pixel changes by no more than this times the
    // largest colour. 0 (exact) to below 1; the same on all ranks.
    float minTransmittance = 0;
    // How many frames may be open at once, 1 or more; the same on all ranks. Memory grows with it. Operations that keep
    // state allow one.
    int framesInFlight = 1;
    // Runs rendering and compositing on this rank. Null: a ThreadExecutor with Connection::threadShare() threads. A
    // CallerExecutor makes no threads. Ranks may differ.
    std::shared_ptr<Executor> executor{};
    // Called on the display rank for each tile that had an input, when its pixels are in the image of the open frame:
    // tile index, pixels, image. For windows that show a frame as it comes. From worker threads, the progress thread or
    // a thread in end(), several at once for different tiles; other pixels of the image are being written meanwhile.
    // It must be quick. An exception makes the frame fail. Tiles of ranks on the same node may all come at the end.
    TileCallback onTile{};
    // end() waits this long before it looks whether any rank still has something under way; then it looks again, more
    // and more seldom. This is how a frame fails that nothing can complete: see ErrorKind::MissingInput. 1 ms or more;
    // ranks may differ. A short time costs a few messages in each slow frame.
    std::chrono::milliseconds quiet{2000};
};

// The samples that a tile gets in a frame: [first, first + count) of all that it may ever get.
struct TileSamples {
    int first = 0, count = 1;
};
using SamplePlan = std::shared_ptr<const std::vector<TileSamples>>;

// What a frame begins with; the same on all ranks, which is checked in the verdict.
struct FrameConfig {
    std::array<float, 4> background{0, 0, 0, 0}; // premultiplied linear RGBA behind everything
    // Samples a pixel, each a pass. With a tile operation that keepsState they are those that follow the last frame's,
    // see accumulationId; with any other, from 0 on.
    int passes = 1;
    // Not null: the samples of each tile, by its index, in place of `passes`; see sampling.hpp. A tile with none is not
    // rendered, and the image keeps its pixels from the last frame. The last frame must then have ended well. An
    // operation without keepsState begins with sample 0, and may leave tiles out only with framesInFlight 1 and a
    // pixel operation that is pointwise.
    SamplePlan samples;
    // For an ErrorBudget: no pixel has more inputs than this in a pass; 0: not known, taken for 65536. Loops that know
    // better say so themselves.
    int maxLayers = 0;
    // For tile operations that keepState (Progressive): frames with the same id accumulate, and the image is the mean
    // of all their samples, whatever they show. Take another one when camera, scene or background change: then the
    // samples of each tile begin with 0 again. They do so too after a frame that failed or was partial, and without
    // `samples` after a frame with them.
    std::uint64_t accumulationId = 0;
    // False: the inputs of generation 0 say what follows, as in the paper; every owned tile needs one per pass.
    // True: each rank says with Frame::declare() what it will send, and owners count on that. Loops set it themselves.
    bool declared = false;
    // 0: no limit. Otherwise a frame fails with ErrorKind::TimedOut if it is not complete this long after a rank called
    // end(); the error says what is missing and from whom. If not even the verdict comes within twice the time, end()
    // throws TransportError. setTile() makes the frame fail if it waits this long for room. Inputs that are never sent
    // need no time-out: the frame fails with ErrorKind::MissingInput some seconds after all ranks are in end().
    std::chrono::milliseconds timeout{0};
    // A frame that fails has the tiles that were finished by then: end() throws nothing but says so in
    // FrameReport::failure. An exception of a renderer or an operation, or inputs at odds, cost no more than their
    // tiles; what misses an input is given up when nothing is under way any more, or after `timeout`. Without that a
    // message that could not be read ends the frame at once, with the tiles that are finished. Ranks that disagree fail
    // it all the same. See also DistributedFrameBuffer::isComplete().
    bool allowPartial = false;
};

// One input that a rank will send for a tile (for each pass of the frame): generation 1, without children.
struct TileInput {
    int tile = 0;
    std::uint32_t source = 0;
    std::uint16_t part = 0;
};
inline bool operator==(const TileInput& a, const TileInput& b) noexcept
{
    return a.tile == b.tile && a.source == b.source && a.part == b.part;
}

// Jobs [begin, end).
struct JobRange {
    std::int64_t begin = 0, end = 0;
};

// How the values of ranks are combined.
enum class Reduce : std::uint8_t { Sum, Min, Max };

// What its operation says of a tile that was finished in a frame.
struct TileError {
    int tile = 0;
    double error = 0; // TileReport::error
};

// A number that a renderer wants to know of all ranks when the frame ends, such as the cost of a brick.
struct Figure {
    std::uint64_t key = 0;
    double value = 0;
};

// Figures of a finished frame. "All" are sums or maxima over the ranks and the same everywhere, up to the moment when
// each rank entered the verdict; the others are this rank's own.
struct FrameReport {
    std::int64_t frame = 0;
    std::optional<ErrorInfo> failure; // all: with FrameConfig::allowPartial, why there are tiles missing, if there are
    // All: tiles that were not finished; the display rank's has those, too, that have not come. They show the
    // background.
    std::int64_t tilesIncomplete = 0;
    double totalMs = 0;               // begin() to the return of end(), this rank
    double renderMs = 0;              // begin() to the call of end(), this rank
    double compositingOverheadMs = 0; // the call of end() to its return, this rank
    double renderMsMax = 0;           // all: the longest renderMs
    // This rank: who moved its messages. Caller: the calls of its user. Thread: a thread of the library's own, or,
    // where ranks are threads, whoever sent them.
    Progress progress = Progress::Thread;
    int threads = 1; // this rank: workers of its executor
    // All: message bytes to other ranks, without the transport's own, and what owners have put into the image of the
    // display rank themselves.
    std::int64_t bytesSent = 0;
    std::int64_t messagesSent = 0;         // all
    std::int64_t tilesTotal = 0;           // in the image
    std::int64_t tilesTouched = 0;         // all: tiles that had an input
    std::int64_t nonFinitePixels = 0;      // all: input pixels with an infinity or NaN (see wire/fragment_message.hpp)
    std::int64_t alphaOutsidePixels = 0;   // all: finite input pixels whose alpha is not within [0, 1]
    std::int64_t orderUndefinedPixels = 0; // all: of finished tiles, see TileReport
    WireFormat wireColor = WireFormat::Float32; // that this rank's inputs in range travelled in
    bool compressed = false;                    // all: whether a codec was used, see CompressionMode
    std::int64_t compressedLinks = 0;           // all: from how many ranks to how many, counted in pairs, it gained
    // All: how far colour and alpha of a pixel may be off for Precision and minTransmittance, from what came.
    // Neither changes depth, positions and ids.
    double wireErrorBound = 0;
    double mergeErrorBound = 0;        // all: how much merging segments may have changed a pixel, see DeepTile
    std::vector<TileError> tileErrors; // all: of the tiles finished in this frame, by index, if the operation reports
    std::vector<Figure> figures;       // all: sums of what Frame::addFigure() was given, by key
    // All: with pixels, of frames that failed, or hidden by others that were there sooner, dropped since the last
    // verdict.
    std::int64_t lateMessages = 0;
    std::int64_t repeatedMessages = 0; // all: came twice, dropped since the last verdict
    std::int64_t peakInboxBytes = 0;   // all: most that one rank's inbox held, of what counts on messages.poolBytes
    std::int64_t peakMemoryBytes = 0;  // all: most that one rank's framebuffer ever held in message and image memory
};

} // namespace dfb
