// A framebuffer on rank 0 of 2 that receives arbitrary messages: each frame must end, well or with an error of dfb, and
// no other exception may leave it.
//
// An input: two bytes that say how the framebuffer is made, then messages, each with its kind, how it is sent, its
// length and its body. Rank 1 is simulated: after the last message of the input it gives the frame up, as a rank that
// works would do.
#include "fuzz.hpp"

#include <dfb/dfb.hpp>
#include <dfb/frame/tile_pipeline.hpp>
#include <dfb/frame/verdict.hpp>

#include <algorithm>
#include <array>
#include <functional>
#include <memory>
#include <optional>
#include <thread>

namespace {

namespace d = dfb::detail;
using d::MessageKind;

constexpr int side = 8, width = 20, height = 13, tileCount = 6;
constexpr int jobCount = 9;
constexpr int partialMs = 4; // how long a partial frame waits for missing finished tiles
enum Flags : std::uint8_t {
    DisplayElsewhere = 1,
    Declared = 2,
    HasCodec = 4,
    Rounded = 8,
    Deep = 16,
    NextJobs = 32,
    Gathers = 64,
    NoConfiguration = 128 // of rank 1: the input has its configuration
};
enum More : std::uint8_t {
    Partial = 1,
    Checksums = 2,
    InFlight = 4, // both frames are open at once
    Wall = 8,     // of two displays, one of each rank
    Ordered = 16, // opaque inputs hide others
    more = 31
};
// How the framebuffer is made and its frames begin.
struct Way {
    std::uint8_t flags = 0, rest = 0;

    bool has(Flags flag) const { return (flags & flag) != 0; }
    bool has(More flag) const { return (rest & flag) != 0; }
    std::size_t engineCount() const { return has(InFlight) ? 2 : 1; }
    // The wall is made first.
    std::uint32_t addressOf(std::int64_t frame) const
    {
        return (has(Wall) ? 1 : 0) + static_cast<std::uint32_t>((frame - 1) % static_cast<int>(engineCount()));
    }
};
// How a message is sent. ToAnother: to the wall, or to an object that does not exist. Awaited: only when the receiver
// waits and no other message comes, such as an answer.
enum How : std::uint8_t { NextFrame = 1, LastFrame = 2, OtherHeader = 3, numbered = 3, ToAnother = 4, Awaited = 8 };
constexpr std::uint8_t kinds = 31, endOfFrame = 31; // takes the place of a kind
static_assert(static_cast<int>(MessageKind::End) <= endOfFrame);

// Runs tasks in submit(), but never while a message is delivered, as locks are held then.
class TaskList final : public dfb::Executor {
public:
    int concurrency() const noexcept override { return 1; }
    void hold(bool isHeld)
    {
        isHeld_ = isHeld;
        wake();
    }

private:
    void wake() override
    {
        while (!isHeld_ && help()) {
        }
    }
    void run(std::size_t count, const std::function<void(std::size_t)>& body, const std::function<void()>&) override
    {
        for (std::size_t i = 0; i < count; ++i)
            body(i);
    }
    bool isHeld_ = true; // until the first poll()
};

// Rank 1, which is simulated, and the messages that it sends.
struct Peer {
    std::shared_ptr<TaskList> tasks = std::make_shared<TaskList>();
    dfb::TransportHandler* handler = nullptr;
    struct Message {
        std::string bytes; // with its header
        bool isAwaited = false;
    };
    std::vector<Message> script;
    std::size_t next = 0;
    std::uint32_t sequence = 0;
    bool checksums = false, isTimed = false; // frames have a time-out
    std::function<bool()> whenDone;          // sends the rest; returns false if there is none
    bool isGone = false;
    int idle = 0; // naps since the last message

    void send(std::string message, bool isAwaited = false)
    {
        if (message.size() >= sizeof(d::MessageHeader)) { // otherwise only the first with a number would be read
            const auto put = [&](std::size_t at, std::uint32_t value) {
                message.replace(at, sizeof value, fuzz::Output().put(value).bytes());
            };
            put(offsetof(d::MessageHeader, sequence), sequence++);
            put(offsetof(d::MessageHeader, checksum), 0);
            if (checksums)
                put(offsetof(d::MessageHeader, checksum), dfb::crc32c(fuzz::bytesOf(message), message.size()));
        }
        script.push_back({std::move(message), isAwaited});
    }
    bool poll()
    {
        tasks->hold(false);
        if (next == script.size() || script[next].isAwaited)
            return false;
        idle = 0;
        tasks->hold(true);
        handler->receive(1, fuzz::ExactBlocks::copyOf(script[next++].bytes));
        tasks->hold(false);
        return true;
    }
    // Called when rank 0 waits and no message comes.
    void nap()
    {
        if (next < script.size()) {
            script[next].isAwaited = false;
            return;
        }
        if (whenDone && whenDone())
            return;
        ++idle;
        if (isTimed && whenDone)
            std::this_thread::sleep_for(std::chrono::microseconds(100 * partialMs));
        if (whenDone && idle > (isTimed ? 200 : 2))
            fuzz::fail("a frame that does not end");
        if (idle >= 3 && !whenDone && !isGone) { // outside frames only the loss of the other rank ends a wait
            isGone = true;
            dfb::ErrorInfo gone;
            gone.kind = dfb::ErrorKind::Transport;
            gone.message = "the other rank is gone";
            tasks->hold(true);
            handler->fail(gone);
            tasks->hold(false);
        }
        if (idle > 300)
            fuzz::fail("a wait that does not end");
    }
};

class PlayedTransport {
public:
    using Communicator = std::shared_ptr<Peer>;

    PlayedTransport(const Communicator& peer, std::shared_ptr<dfb::MemoryPool>, dfb::Progress) : peer_(peer) {}
    int rank() const { return 0; }
    int size() const { return 2; }
    bool needsPolling() const { return true; }
    bool mayPoll() const { return true; }
    bool quiet() const { return true; }
    void nap(std::chrono::nanoseconds) { peer_->nap(); }
    void interrupt() {}
    void start(dfb::TransportHandler& handler) { peer_->handler = &handler; }
    void send(int, dfb::Buffer&&) {}
    bool poll() { return peer_->poll(); }
    void stop(bool) { peer_->tasks->hold(false); }

private:
    std::shared_ptr<Peer> peer_;
};

int ownerOf(int tile) { return tile % 2; }

dfb::WallLayout wallLayout()
{
    dfb::WallLayout layout;
    layout.columns = 2;
    layout.displayWidth = width / 2;
    layout.displayHeight = height;
    layout.ranks = {0, 1};
    return layout;
}

// What rank 1 says of the wall's configuration.
std::string wallText(bool checksums)
{
    d::Agreement::Settings settings;
    settings.add("the wall's columns x rows", "2x1");
    settings.add("the size of its displays", "10x13");
    settings.add("the size of its bezels", "0x0");
    settings.add("its format", "RGBA8");
    settings.add("the list of its displays' ranks", "{0, 1}");
    settings.add("its poolBytes", std::size_t{64} << 20); // the default
    settings.add("checksums", checksums);
    return settings.text();
}

dfb::FrameBufferConfig configFor(Way way)
{
    dfb::FrameBufferConfig config;
    config.image.width = width;
    config.image.height = height;
    config.image.depth = !way.has(Ordered) && !way.has(Wall);
    config.image.displayRank = way.has(DisplayElsewhere) ? 1 : 0;
    config.image.ownerMap = [](int tile, const dfb::TileLayout&, int) { return ownerOf(tile); };
#if defined(DFB_HAS_SNAPPY)
    if (way.has(HasCodec))
        config.messages.codec = std::make_shared<dfb::SnappyCodec>();
#endif
    if (way.has(Rounded))
        config.precision = dfb::WireFormat::Unorm16;
    config.framesInFlight = static_cast<int>(way.engineCount());
    if (way.has(Wall))
        config.image.format = dfb::OutputFormat::None;
    return config;
}

dfb::FrameConfig paramsFor(Way way)
{
    dfb::FrameConfig params;
    params.declared = way.has(Declared);
    params.allowPartial = way.has(Partial);
    params.timeout = std::chrono::milliseconds(way.has(Partial) ? partialMs : 0);
    return params;
}

std::string messageOf(MessageKind kind, std::uint32_t receiver, std::int64_t number, const std::string& body)
{
    d::MessageHeader header;
    header.kind = kind;
    header.receiver = receiver;
    header.number = number;
    return fuzz::Output().put(header).text(body).bytes();
}

std::string reductionOf(std::uint32_t scope, const d::SmallBytes& bytes)
{
    return fuzz::Output().put(scope).text(fuzz::textOf(bytes)).bytes();
}
enum : std::uint32_t { OwnScope, AllDeclared, FrameVerdict };

// `inputsOnTheWay`: how many inputs rank 1 has sent that have not arrived.
std::string vote(Way way, int inputsOnTheWay = 0)
{
    d::Verdict verdict;
    verdict.sums.inputsLeft = inputsOnTheWay;
    verdict.terms = d::FrameTerms::of(paramsFor(way), 1);
    return reductionOf(FrameVerdict, verdict.bytes());
}

// Queues all messages of the input up to the end of a frame.
void sendAll(Peer& peer, fuzz::Input& in, Way way, std::int64_t frame)
{
    while (in.left() > 0) {
        const int kind = in.take<std::uint8_t>() & kinds;
        if (kind == endOfFrame)
            return;
        const auto how = in.take<std::uint8_t>();
        std::string message = in.text(in.take<std::uint16_t>() % 8192);
        if ((how & numbered) != OtherHeader) { // otherwise it is the whole message
            const std::int64_t number =
                frame + ((how & numbered) == NextFrame ? 1 : 0) - ((how & numbered) == LastFrame ? 1 : 0);
            const std::uint32_t another = way.has(Wall) ? 0 : 2;
            message = messageOf(static_cast<MessageKind>(kind),
                                how & ToAnother ? another : way.addressOf(std::max<std::int64_t>(number, 1)), number,
                                message);
        }
        peer.send(std::move(message), (how & Awaited) != 0);
    }
}

template <class TileOp, class PixelOp>
class Player {
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, PixelOp, PlayedTransport>;

public:
    Player(Way way, fuzz::Input& in) : way_(way), in_(in), peer_(std::make_shared<Peer>())
    {
        peer_->checksums = way.has(Checksums);
        peer_->isTimed = way.has(Partial);
    }

    // Returns how many frames ended well.
    int play()
    {
        try {
            make();
        } catch (const dfb::InvalidArgument&) {
            fuzz::require(way_.has(NoConfiguration) || way_.has(Gathers),
                          "a framebuffer is made if the other rank agrees");
            return 0;
        } catch (const dfb::Error&) {
            fuzz::require(way_.has(NoConfiguration) || way_.has(Gathers), "as is one that nobody disturbs");
            return 0;
        }
        try {
            if (way_.has(InFlight)) {
                sendAll(*peer_, in_, way_, 1);
                sendAll(*peer_, in_, way_, 2);
                auto first = render(1);
                auto second = render(2);
                end(first, 1);
                end(second, 2);
            } else {
                for (std::int64_t number = 1; number <= 2; ++number) {
                    sendAll(*peer_, in_, way_, number);
                    auto frame = render(number);
                    end(frame, number);
                }
            }
        } catch (const dfb::TransportError&) { // it can no longer be used
        }
        peer_->whenDone = nullptr;
        return fine_;
    }

private:
    using Frame = typename FrameBuffer::Frame;

    void make()
    {
        auto config = configFor(way_);
        config.executor = peer_->tasks;
        dfb::NetworkConfig options;
        options.progress = dfb::Progress::Caller;
        options.sharedMemory = false;
        options.checksums = way_.has(Checksums);
        const auto traits = d::OperationTraits::of<TileOp, PixelOp>();
        std::vector<int> owners;
        for (int tile = 0; tile < tileCount; ++tile)
            owners.push_back(ownerOf(tile));
        const auto agreement = d::Agreement::of(traits, config, options.checksums, {1, 0},
                                                d::TilePipeline::travelling(traits, config), owners);
        const auto agree = [&](std::uint32_t address, const d::Agreement& what) {
            peer_->send(messageOf(MessageKind::ReduceUp, address, 0, reductionOf(OwnScope, what.bytes())));
        };
        connection_ = dfb::connect<PlayedTransport>(peer_, options);
        if (way_.has(NoConfiguration))
            sendAll(*peer_, in_, way_, 0);
        PixelOp pixelOp;
        if constexpr (!std::is_same_v<PixelOp, dfb::NoPixelOp>) {
            if (!way_.has(NoConfiguration))
                agree(0, d::Agreement{true, wallText(options.checksums), 1});
            wall_.emplace(connection_, wallLayout(), dfb::OutputFormat::RGBA8, peer_->tasks);
            pixelOp.wall = &*wall_;
        }
        if (!way_.has(NoConfiguration))
            for (std::size_t i = 0; i < way_.engineCount(); ++i)
                agree(way_.addressOf(static_cast<std::int64_t>(i) + 1), agreement);
        fb_.emplace(connection_, config, pixelOp);
        if (way_.has(Gathers)) {
            sendAll(*peer_, in_, way_, 1);
            const auto all = fb_->allGather(std::vector<std::byte>(3));
            fuzz::require(all.size() == 2 && all[0].size() == 3, "each rank's bytes are gathered");
        }
    }

    Frame render(std::int64_t number)
    {
        whenNothingComes(number);
        Frame frame = fb_->begin(paramsFor(way_));
        try {
            fb_->poll();
            const bool declared = way_.has(Declared);
            if (declared)
                frame.declare({{0, 50, 0}, {1, 50, 0}});
            for (const int index : {0, 2, 4, 1}) {
                if (declared && index > 1)
                    continue;
                frame.start(*tile_, index);
                tile_->generation = declared || index == 1 ? 1 : 0;
                tile_->source = declared ? 50 : 0;
                tile_->children = tile_->generation == 0 ? 1 : 0;
                tile_->pixel(1, 1)[3] = 1;
                frame.setTile(*tile_);
                fb_->poll();
            }
            if (way_.has(NextJobs))
                for (std::int64_t job = frame.nextJob(jobCount); job >= 0; job = frame.nextJob(jobCount))
                    fuzz::require(job < jobCount, "a job is one that there is");
        } catch (const dfb::FrameError&) { // end() throws it again
        }
        return frame;
    }

    void end(Frame& frame, std::int64_t number)
    {
        try {
            whenNothingComes(number);
            const auto report = frame.end();
            for (const dfb::TileError& error : report.tileErrors)
                fuzz::require(error.tile >= 0 && error.tile < tileCount, "an error is of a tile that there is");
            fuzz::require(!report.failure || way_.has(Partial), "only a frame that may be partial is");
            fuzz::require(report.tilesIncomplete >= 0 && report.tilesIncomplete <= tileCount,
                          "tiles that miss are such that there are");
            fuzz::require(report.failure || report.tilesIncomplete == 0, "what is not partial is complete");
            peer_->whenDone = nullptr;
            if (wall_)
                wall_->finish(report.frame);
            fine_ += report.failure ? 0 : 1;
        } catch (const dfb::TransportError&) {
            throw;
        } catch (const dfb::Error&) { // FrameError, or an error of the wall: the next frame may be good
        }
        peer_->whenDone = nullptr;
    }

    void whenNothingComes(std::int64_t number)
    {
        peer_->idle = 0;
        peer_->whenDone = [this, number, done = false]() mutable {
            if (std::exchange(done, true))
                return false;
            d::SmallBytes reason;
            dfb::ErrorInfo info;
            info.kind = dfb::ErrorKind::Cancelled;
            info.rank = 1;
            put(reason, info);
            const std::uint32_t address = way_.addressOf(number);
            peer_->send(messageOf(MessageKind::Abort, address, number, fuzz::textOf(reason)));
            peer_->send(messageOf(MessageKind::ReduceUp, address, number, vote(way_)));
            return true;
        };
    }

    Way way_;
    fuzz::Input& in_;
    int fine_ = 0;
    std::shared_ptr<Peer> peer_;
    std::shared_ptr<dfb::Connection> connection_;
    std::optional<dfb::DisplayWall> wall_;
    std::optional<FrameBuffer> fb_;
    std::unique_ptr<typename FrameBuffer::Tile> tile_ = std::make_unique<typename FrameBuffer::Tile>();
};

template <class TileOp>
int play(Way way, fuzz::Input& in)
{
    if (way.has(Wall))
        return Player<TileOp, dfb::ToWall>(way, in).play();
    return Player<TileOp, dfb::NoPixelOp>(way, in).play();
}

// Returns how many frames ended well.
int play(fuzz::Input in)
{
    Way way;
    way.flags = in.take<std::uint8_t>();
    way.rest = in.take<std::uint8_t>() & more;
    return way.has(Deep)      ? play<dfb::BasicDeepBlend<side>>(way, in)
           : way.has(Ordered) ? play<dfb::BasicOrderedBlend<side>>(way, in)
                              : play<dfb::BasicAlphaBlend<side>>(way, in);
}

} // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size)
{
    play(fuzz::Input(data, size));
    return 0;
}

namespace {

// The body of an input of a tile: the one that rank 0 announces, or that source 9 has declared.
template <class TileOp>
std::string inputFor(Way way, int index, bool isDense)
{
    static const auto pool = dfb::MemoryPool::create(false);
    using Tile = dfb::Tile<TileOp::channels, side>;
    const auto config = configFor(way);
    const dfb::TileLayout layout(width, height, side);
    auto tile = std::make_unique<Tile>();
    static_cast<dfb::TileHeader&>(*tile) = {1, index, layout.region(index), 0, 1, 0, 9, 0};
    tile->clear();
    tile->forEachPixel([&](int x, int y, float* rgba, float& depth) {
        if (!isDense && (x + y) % 3 != 0)
            return;
        rgba[0] = 0.25f;
        rgba[3] = 0.5f;
        depth = static_cast<float>(x);
    });
    d::InputFaults faults;
    const dfb::Buffer message = d::encodeFragment(
        *pool, *tile, d::TilePipeline::travelling(d::OperationTraits::of<TileOp, dfb::NoPixelOp>(), config), 0,
        config.messages.codec.get(), d::WireCoder(config.precision), config.precision.color, faults);
    const std::size_t prefix = sizeof(d::MessageHeader);
    return fuzz::textOf(message.data() + prefix, message.size() - prefix);
}

std::string inputOf(Way way, int index, bool isDense)
{
    return way.has(Deep)      ? inputFor<dfb::BasicDeepBlend<side>>(way, index, isDense)
           : way.has(Ordered) ? inputFor<dfb::BasicOrderedBlend<side>>(way, index, isDense)
                              : inputFor<dfb::BasicAlphaBlend<side>>(way, index, isDense);
}

std::string of(MessageKind kind, const std::string& body, int how = 0)
{
    return fuzz::Output()
        .put(kind)
        .put(static_cast<std::uint8_t>(how))
        .put(static_cast<std::uint16_t>(body.size()))
        .text(body)
        .bytes();
}

// The bodies of two messages: the finished tiles 1, 3 and 5, and their count.
std::pair<std::string, std::string> finished(Way way)
{
    const auto config = configFor(way);
    const auto pool = dfb::MemoryPool::create(false);
    std::vector<std::string> bodies;
    const dfb::TileLayout layout(width, height, side);
    const dfb::ChannelMask channels = config.image.depth ? dfb::depthChannel : 0;
    const auto send = [&](dfb::Buffer&& message, std::size_t) {
        const std::size_t prefix = sizeof(d::MessageHeader);
        bodies.push_back(fuzz::textOf(message.data() + prefix, message.size() - prefix));
    };
    d::TileSender sender(pool, layout, config, channels, 0, send, nullptr);
    sender.newFrame(1, config.messages.codec != nullptr, true);
    for (const int tile : {1, 3, 5}) {
        auto place = sender.reserve(tile);
        const dfb::Region region = layout.region(tile);
        for (int i = 0; i < region.width() * region.height(); ++i)
            for (const auto c : {d::Color, d::Depth})
                if (c == d::Color || config.image.depth)
                    std::memset(place.planes.at[c] + 4 * i, i % 5 == 2 ? 9 : 1, 4);
        sender.commit(tile, std::move(place), region.width() * region.height());
    }
    sender.flush();
    return {bodies.at(0), bodies.at(1)};
}

} // namespace

std::vector<std::pair<std::string, std::string>> fuzz::seeds()
{
    std::vector<std::pair<std::string, std::string>> all;
    const auto add = [&](const std::string& name, Way way, const std::string& messages) {
        all.emplace_back(name, Output().put(way.flags).put(way.rest).text(messages).bytes());
    };
    const auto inputs = [](Way way) {
        std::string text;
        for (const int tile : {0, 2, 4})
            text += of(MessageKind::Fragment, inputOf(way, tile, tile == 2));
        return text;
    };
    const std::string end(1, static_cast<char>(endOfFrame));
    const auto partsOf = [](std::initializer_list<dfb::Region> regions) {
        std::string text;
        for (const dfb::Region& region : regions)
            text += of(MessageKind::FinishedTiles,
                       Output()
                           .put(std::int32_t{0})
                           .put(region)
                           .put(std::int32_t{0})
                           .text(std::string(static_cast<std::size_t>(4 * region.width() * region.height()), '\7'))
                           .bytes(),
                       ToAnother);
        return text;
    };
    const std::string wallVote = of(MessageKind::ReduceUp, reductionOf(OwnScope, {}), ToAnother);
    const auto frameOf = [&](Way way, bool isFirst = true) {
        std::string text = inputs(way);
        if (way.has(Declared)) {
            text.clear();
            if (isFirst || way.engineCount() > 1) // a declaration holds in the engine's next frame, too
                text += of(MessageKind::Manifest, Output().put(2).put(9u).put(std::uint16_t{0}).bytes())
                        + of(MessageKind::ManifestAck, "");
            text += of(MessageKind::ReduceUp, reductionOf(AllDeclared, {}));
            text += of(MessageKind::Fragment, inputOf(way, 2, true));
        }
        if (!way.has(DisplayElsewhere) && !way.has(Wall)) {
            const auto [tiles, count] = finished(way);
            text += of(MessageKind::FinishedTiles, tiles) + of(MessageKind::TilesDone, count);
        }
        if (way.has(Wall)) // the tiles of the display that rank 1 owns: 1, 3 and 5
            text += partsOf({{8, 0, 10, 8}, {0, 8, 8, 13}}) + wallVote;
        return text + of(MessageKind::ReduceUp, vote(way, way.has(Declared) ? 0 : 2)) + end;
    };
    const auto addFrames = [&](Way way) {
        add("frame_" + std::to_string(way.flags) + (way.rest ? "_" + std::to_string(way.rest) : ""), way,
            frameOf(way) + frameOf(way, false));
        // A partial frame waits for partialMs, and this process may get no core in that time. With a wall and two
        // frames in flight, a wait that takes long enough for a nap lets the second frame's reduction come too early.
        const bool dependsOnTime = way.has(Partial) || (way.has(Wall) && way.has(InFlight));
        int tries = dependsOnTime ? 1000 : 1;
        while (play(Input(all.back().second)) != 2)
            require(--tries > 0, "both frames end well");
    };
    for (const int flags :
         {0, +DisplayElsewhere, +Declared, +HasCodec, +Rounded, +Deep, Declared | HasCodec, Rounded | HasCodec})
        addFrames({static_cast<std::uint8_t>(flags)});
    for (const int rest :
         {+Partial, +Checksums, +InFlight, +Wall, +Ordered, Partial | InFlight, Wall | InFlight, Wall | Partial})
        for (const int flags : {0, +Declared})
            addFrames({static_cast<std::uint8_t>(flags), static_cast<std::uint8_t>(rest)});
    add("partial_without_what_the_other_has", {0, Partial}, inputs({}) + end);
    add("wall_twice", {0, Wall}, partsOf({{8, 0, 10, 8}, {8, 1, 10, 2}}) + frameOf({0, Wall}));
    add("wall_part_beyond", {0, Wall}, partsOf({{8, 0, 11, 8}}) + frameOf({0, Wall}));
    add("wall_vote_broken", {0, Wall},
        of(MessageKind::ReduceUp, Output().put(+OwnScope).text("no").bytes(), ToAnother) + frameOf({0, Wall}));
    add("to_nobody", {}, of(MessageKind::Fragment, "lost", ToAnother) + frameOf({}));
    const auto jobs = [](std::int64_t from, std::int64_t to) {
        return of(MessageKind::Jobs, Output().put(from).put(to).bytes(), Awaited);
    };
    add("jobs", {NextJobs}, jobs(4, 6) + jobs(6, 9) + jobs(9, 9) + frameOf({}));
    add("jobs_that_are_not", {NextJobs}, jobs(4, 60) + jobs(-4, -3));
    add("jobs_asked_for", {NextJobs | DisplayElsewhere},
        of(MessageKind::JobRequest, Output().put(std::int64_t{jobCount}).put(1).put(0).bytes())
            + of(MessageKind::JobRequest, Output().put(std::int64_t{4}).put(1).put(0).bytes()));
    add("manifest_late", {Declared},
        of(MessageKind::ManifestAck, "", Awaited) + of(MessageKind::ReduceUp, reductionOf(AllDeclared, {}))
            + of(MessageKind::Manifest, Output().put(2).put(9u).put(std::uint16_t{0}).bytes()));
    add("credit", {},
        of(MessageKind::CreditRequest, Output().put(std::uint64_t{1000}).put(std::uint64_t{2000}).bytes())
            + of(MessageKind::Credit, Output().put(std::uint64_t{1000}).put(std::uint64_t{500}).bytes()));
    add("credit_without_end", {},
        of(MessageKind::CreditRequest, Output().put(~std::uint64_t{0}).put(~std::uint64_t{0}).bytes()));
    dfb::ErrorInfo info;
    info.kind = dfb::ErrorKind::UserCode;
    info.message = "the renderer broke";
    d::SmallBytes reason;
    put(reason, info);
    add("abort", {}, of(MessageKind::Abort, textOf(reason)) + end + inputs({}));
    add("failure", {}, of(MessageKind::Failure, textOf(reason)));
    add("vote_that_is_none", {}, of(MessageKind::ReduceUp, Output().put(+FrameVerdict).text("no vote").bytes()));
    add("reduction_that_is_none", {}, of(MessageKind::ReduceUp, Output().put(9u).bytes()));
    add("result_from_below", {}, of(MessageKind::ReduceDown, vote({})));
    d::Verdict verdict;
    verdict.terms = d::FrameTerms::of(paramsFor({}), 1);
    verdict.tileErrors = {{99, 1.0}};
    add("vote_on_no_tile", {}, of(MessageKind::ReduceUp, reductionOf(FrameVerdict, verdict.bytes())));
    for (const int tile : {2, -2})
        add("hidden" + std::to_string(tile), {0, Ordered},
            of(MessageKind::Hidden, Output().put(tile).put(1).put(0).bytes()) + frameOf({0, Ordered}));
    for (const int word : {1, 2, 3})
        add("hidden_word" + std::to_string(word), {0, Ordered},
            of(MessageKind::Hidden, Output().put(2).put(1).put(word).bytes()) + frameOf({0, Ordered}));
    add("image_place", {}, of(MessageKind::ImagePlace, std::string(sizeof(d::ImagePlaces), '\1')));
    add("image_place_of_the_display", {DisplayElsewhere},
        of(MessageKind::ImagePlace, std::string(sizeof(d::ImagePlaces), '\1')));
    add("next_frame_first", {}, of(MessageKind::Fragment, inputOf({}, 0, true), NextFrame) + inputs({}) + end);
    add("of_the_last_frame", {}, end + of(MessageKind::Fragment, "late", LastFrame));
    d::MessageHeader header;
    header.number = 1000;
    add("far_frame", {}, of(MessageKind::Fragment, Output().put(header).bytes(), OtherHeader));
    header.number = 1;
    header.receiver = 5000;
    add("far_object", {}, of(MessageKind::Fragment, Output().put(header).bytes(), OtherHeader));
    header.receiver = 0;
    header.version = 3;
    add("other_version", {}, of(MessageKind::Fragment, Output().put(header).bytes(), OtherHeader));
    header.version = d::MessageHeader::formatVersion;
    header.magic = d::MessageHeader::magicSwapped;
    add("other_byte_order", {}, of(MessageKind::Fragment, Output().put(header).bytes(), OtherHeader));
    add("other_channels", {}, of(MessageKind::Fragment, inputOf({Deep}, 0, true)));
    add("configuration", {NoConfiguration},
        of(MessageKind::ReduceUp, reductionOf(OwnScope, d::Agreement{true, "width=4\n", 1}.bytes())) + end);
    add("configuration_broken", {NoConfiguration}, of(MessageKind::ReduceUp, std::string("\0\0\0\0no", 6)) + end);
    const auto gathered = [](std::int32_t rank, std::uint64_t count, const std::string& bytes) {
        const std::string call = "allGather()";
        return of(MessageKind::ReduceUp, Output()
                                             .put(+OwnScope)
                                             .put(std::int32_t{1})
                                             .put(static_cast<std::uint32_t>(call.size()))
                                             .text(call)
                                             .put(rank)
                                             .put(count)
                                             .text(bytes)
                                             .bytes());
    };
    add("gathered", {Gathers}, gathered(1, 2, "ab"));
    add("gathered_too_much", {Gathers}, gathered(1, ~std::uint64_t{0}, "ab"));
    add("gathered_of_another", {Gathers}, gathered(0, 2, "ab"));
    add("gathered_by_another_call", {Gathers},
        of(MessageKind::ReduceUp,
           Output().put(+OwnScope).put(std::int32_t{1}).put(std::uint32_t{2}).text("no").bytes()));
    add("gathered_of_no_rank", {Gathers}, gathered(7, 2, "ab"));
    return all;
}
