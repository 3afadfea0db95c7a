// The configuration of framebuffers, the parameters of frames, and the report of a frame.
#pragma once

#include <dfb/channels.hpp>
#include <dfb/comm/compression.hpp>
#include <dfb/comm/transport.hpp>
#include <dfb/error.hpp>
#include <dfb/exec.hpp>
#include <dfb/tile.hpp>
#include <dfb/tile_layout.hpp>
#include <dfb/trace.hpp>
#include <dfb/wire/wire_format.hpp>

#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

DFB_NAMESPACE_BEGIN

// The image that the display rank gets. All ranks must give the same; the constructor checks it.
struct ImageConfig {
    int width = 0, height = 0;                 // pixels, 1 to 65536
    OutputFormat format = OutputFormat::RGBA8; // of the colour
    bool depth = false;                        // whether the image has depth; a float more per pixel
    ChannelMask aux = 0;                       // its auxiliary channels, which the tile operation must have
    bool dither = false;                       // dithers 8-bit colour instead of rounding it: see ditherPixels()
    int displayRank = 0;                       // the rank that gets the image
    // Which rank owns which tile. Null: latticeOwner. Only if it is null, loops with a SharedWorld and ImageCompositor
    // choose owners near the pixels for each frame, where ranks are on several nodes.
    OwnerMap ownerMap{};
};

// The messages of one framebuffer. All ranks must give the same; the constructor checks it.
struct MessageConfig {
    std::shared_ptr<const Codec> codec{}; // compresses messages; null: none are compressed
    CompressionMode compression = CompressionMode::Always;
    // Limits the bytes of inputs and finished tiles in a rank's inbox and on the way to it. If a rank has more than
    // this under way to others, setTile() waits. Raised to 4 times the largest possible message if it is less.
    std::size_t poolBytes = std::size_t{64} << 20;
};

// The configuration of a framebuffer. The NetworkConfig of its connection says how its messages travel.
struct FrameBufferConfig {
    FrameBufferConfig() = default;
    FrameBufferConfig(int width, int height, OutputFormat format = OutputFormat::RGBA8, bool depth = false)
        : image{width, height, format, depth}
    {
    }

    ImageConfig image;
    MessageConfig messages;
    // How precisely the colour of inputs is sent: a WireFormat, an ErrorBudget, HalfLevel, or a Precision. The default
    // is exact. Depth, positions and ids always travel exactly; normals and albedo are scaled to the rounded alpha.
    // Finished tiles travel in image.format. All ranks must give the same.
    Precision precision{};
    // Early termination, in all operations of the library but DepthComposite. If the layers of a pixel let through less
    // than this fraction of the light, the layers behind them and the background are left out. The pixel changes by no
    // more than this times the largest colour. 0 (exact) to below 1. All ranks must give the same.
    float minTransmittance = 0;
    // How many frames may be open at once, 1 or more. Memory grows with it. Operations that keep state allow one. All
    // ranks must give the same.
    int framesInFlight = 1;
    // Runs rendering and compositing on this rank. Null: a ThreadExecutor with Connection::threadShare() threads. A
    // CallerExecutor makes no threads. Ranks may give different ones.
    std::shared_ptr<Executor> executor{};
    // onTile(tile index, its pixels, image), for windows that show a frame while it is made. Called on the display rank
    // for each composited tile, when its pixels are in the image of the open frame. A tile without active pixels is
    // left out if the operation is one of the library's (not Progressive), the pixel operation is pointwise, and its
    // inputs are not read in place. Worker threads call it, and your own threads in setTile(), poll(), loops and calls
    // that wait, such as end(). It is called for several tiles at once, while other pixels of the image are still being
    // written. It must be quick. An exception makes the frame fail. For tiles whose owners are on the display rank's
    // node, all calls may come at the end of the frame.
    TileCallback onTile{};
    // After this time in end(), ranks check whether a message is still under way; they check again at growing
    // intervals. If twice none is, the frame fails with ErrorKind::MissingInput. 1 ms to 24 days. A short time costs a
    // few messages in each slow frame. If a tile may be hidden, an OrderedLoop waits at most this long for the message
    // that says so. Then it renders the tile. Ranks may give different times.
    std::chrono::milliseconds quiet{2000};
    // Records what this rank does for its frames, and when: see trace.hpp. Null: nothing is recorded, at no cost. Ranks
    // may give different ones.
    std::shared_ptr<TraceSink> trace{};
};

// The samples that a tile gets in a frame: those numbered [first, first + count).
struct TileSamples {
    int first = 0, count = 1;
};
// The samples of all tiles, by number of the tile.
using SamplePlan = std::shared_ptr<const std::vector<TileSamples>>;

// The parameters of a frame. All ranks must give the same. This is checked by the verdict: the reduction over all ranks
// that ends a frame.
struct FrameConfig {
    std::array<float, 4> background{0, 0, 0, 0}; // premultiplied linear RGBA behind everything
    // Samples a pixel, 1 or more; each is a pass. They are numbered from 0. With a tile operation that has keepsState
    // they go on from the last frame, if that had this accumulationId.
    int passes = 1;
    // If not null, it has the samples of each tile, by the tile's index, and replaces `passes`; see sampling.hpp. A
    // tile without samples is not rendered, and the image keeps its pixels from the last frame, which must not have
    // failed. With keepsState: that frame must have had the same accumulationId. Without: the samples of a tile begin
    // with 0. Tiles without samples then need framesInFlight 1 and a pixel operation that is pointwise; in the first
    // frame and after resize() they show the background.
    SamplePlan samples;
    // For an ErrorBudget or HalfLevel: the most inputs that a pixel has in a pass. 0: not known, counts as 65536.
    // ImageParallelLoop, MixedParallelLoop, OrderedLoop and ImageCompositor set it; the other loops do not.
    int maxLayers = 0;
    // For tile operations with keepsState, such as Progressive: the image is the mean of the samples of all consecutive
    // frames with this id. Give another id when camera, scene or background change: the samples of each tile then begin
    // with 0. They also do so after a frame that failed or was partial, and in a frame without `samples` that follows a
    // frame with them.
    std::uint64_t accumulationId = 0;
    // False: inputs of generation 0 announce the others, as in the paper, and every tile needs one of them per pass.
    // True: each rank calls Frame::declare(), and owners wait for the declared inputs. Loops set it themselves.
    bool declared = false;
    // The frame fails with ErrorKind::TimedOut if it is not complete this long after a rank called end(). It also fails
    // if setTile() waits for room and no receiver takes a message of this rank for this long, or if nextJob() waits
    // this long. The error says what is missing and from whom. If there is still no verdict after twice the time, end()
    // throws TransportError. 0: no limit. At most 24 days. An input that is never sent needs no time-out: the frame
    // fails with ErrorKind::MissingInput some seconds after all ranks are in end().
    std::chrono::milliseconds timeout{0};
    // For AlphaBlend. If not null, it lists the sources of all inputs, front to back for every ray of the frame. Inputs
    // are then blended in this order: nothing is sorted, and no depth travels unless the image has it. The pixels are
    // the same as without it. An input with pixels of a source that is not in the order makes the frame fail.
    // MixedParallelLoop, and DataParallelLoop with a SharedWorld, set it where the bricks (1024 at most) have such an
    // order and the camera says where its rays begin: see render/visibility.hpp.
    std::shared_ptr<const SourceOrder> order{};
    // If not null, it says which rank owns which tile in this frame, in place of ImageConfig::ownerMap. The image does
    // not depend on it. Not allowed for operations that keep state. Loops set it themselves: see ImageConfig::ownerMap.
    TileOwners owners{};
    // True: a frame that fails still gives the tiles that were finished. end() then sets FrameReport::failure in place
    // of a FrameError, and DistributedFrameBuffer::isComplete() tells which tiles there are. If a renderer or an
    // operation throws, or inputs of a tile contradict each other, only that tile is lost. A tile with a missing input
    // is given up when nothing is under way any more, which takes at least FrameBufferConfig::quiet, or after
    // `timeout`. An exception that concerns no tile, such as a camera's, takes the frame as long. If a message cannot
    // be read, the frame ends at once; with a `timeout` it goes on until then. If ranks disagree about these
    // parameters, end() still throws.
    bool allowPartial = false;
};

// An input of generation 1 that will come for this tile in each pass of the frame: see Frame::declare().
struct TileInput {
    int tile = 0;
    std::uint32_t source = 0;
    std::uint16_t part = 0;
};
inline bool operator==(const TileInput& a, const TileInput& b) noexcept
{
    return a.tile == b.tile && a.source == b.source && a.part == b.part;
}

// How the values of ranks are combined.
enum class Reduce : std::uint8_t { Sum, Min, Max };

// The error of a finished tile, as its operation estimates it.
struct TileError {
    int tile = 0;
    double error = 0; // TileReport::error
};

// A sum over all ranks that is known when the frame ends, such as the cost of a brick: see Frame::addFigure().
struct Figure {
    std::uint64_t key = 0;
    double value = 0;
};

// The figures of a finished frame that are sums over all ranks. All are std::int64_t: a verdict adds them as such.
struct FrameSums {
    // Bytes of messages to other ranks, without the transport's own headers, plus the bytes that owners wrote directly
    // into the display rank's image.
    std::int64_t bytesSent = 0;
    std::int64_t messagesSent = 0;
    std::int64_t tilesTouched = 0; // tiles that had an input
    // Input pixels with an infinite or NaN colour, or a NaN depth. Pixels that are read in place count only if they
    // were read. Those behind an opaque input may be left unread.
    std::int64_t nonFinitePixels = 0;
    std::int64_t alphaOutsidePixels = 0;   // finite input pixels whose alpha is not within [0, 1]
    std::int64_t orderUndefinedPixels = 0; // of finished tiles, see TileReport
    std::int64_t compressedLinks = 0;      // pairs of sender and receiver for which compression paid
    // Since the last verdict: messages with pixels that came after the end of their frame, and errors that came after
    // their rank's vote. Inputs that a frame drops after it has failed do not count.
    std::int64_t lateMessages = 0;
    std::int64_t repeatedMessages = 0; // messages that came twice and were dropped, since the last verdict
};

// Figures of a finished frame. FrameSums and those marked "all" are the same on all ranks, and include all that ranks
// counted before the verdict. The others are this rank's own.
struct FrameReport : FrameSums {
    std::int64_t frame = 0;
    std::optional<ErrorInfo> failure; // all: with FrameConfig::allowPartial, why the frame failed, if it did
    // Tiles that were not finished. On the display rank also finished tiles that have not reached it, and background
    // tiles for which the pixel operation threw. All these tiles show the background.
    std::int64_t tilesIncomplete = 0;
    double totalMs = 0;               // begin() to the return of end(), this rank
    double renderMs = 0;              // begin() to the first call of isDone(), tryEnd() or end(), this rank
    double compositingOverheadMs = 0; // from that call to the return of end(), this rank
    double renderMsMax = 0; // all: the longest renderMs; of a rank that votes before end(), the time until then
    // This rank: who moved messages: calls of the program (Caller), or a thread of the library (Thread). With
    // InprocTransport the sending thread delivers them, which counts as Thread.
    Progress progress = Progress::Thread;
    int threads = 1;                            // this rank: workers of its executor
    std::int64_t tilesTotal = 0;                // in the image
    WireFormat wireColor = WireFormat::Float32; // in which format this rank rounded inputs, see Precision
    bool compressed = false;                    // all: whether a codec was used, see CompressionMode
    // All: how far colour and alpha of a pixel may be off because of Precision and minTransmittance, before the pixel
    // operation. Depth, positions and ids are exact.
    double wireErrorBound = 0;
    double mergeErrorBound = 0;        // all: how far a pixel may be off because segments were merged, see DeepTile
    std::vector<TileError> tileErrors; // all: of the tiles finished in this frame, by index, if the operation reports
    std::vector<Figure> figures;       // all: the sums of Frame::addFigure(), by key
    std::int64_t peakInboxBytes = 0;   // all: the most that a rank's inbox held of what messages.poolBytes limits
    std::int64_t peakMemoryBytes = 0;  // all: the most message and image memory that a rank's connection ever held
};

DFB_NAMESPACE_END
