// A framebuffer on rank 0 of 2 that gets whatever it is sent: each frame ends, well or with an error of dfb, and
// nothing else gets out.
//
// An input: how the framebuffer is made, then messages: a byte for the kind and what is wrong with its header, a
// length, the body. The other rank is played: when the input has nothing more it gives the frame up, as a rank does
// that works.
#include "fuzz.hpp"

#include <dfb/dfb.hpp>

#include <algorithm>
#include <array>
#include <functional>
#include <memory>
#include <optional>

namespace {

namespace d = dfb::detail;
using d::MessageKind;

constexpr int side = 8, width = 20, height = 13, tileCount = 6;
constexpr int jobCount = 9;
enum Flags : std::uint8_t {
    DisplayElsewhere = 1,
    Declared = 2,
    HasCodec = 4,
    Rounded = 8,
    Deep = 16,
    NextJobs = 32,
    Gathers = 64,
    NoConfiguration = 128 // of the other rank: the input says what it was made with
};
// Beside the kind, in the byte of a message.
enum How : std::uint8_t { NextFrame = 16, LastFrame = 32, OtherHeader = 48, how = 48 };
constexpr std::uint8_t endOfFrame = 15; // in place of a kind

// Tasks run where they are submitted, but never within the delivery of a message, which holds locks.
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
    void run(std::size_t count, const std::function<void(std::size_t)>& body) override
    {
        for (std::size_t i = 0; i < count; ++i)
            body(i);
    }
    bool isHeld_ = true; // until the first poll()
};

// The other rank, and what it sends.
struct Peer {
    std::shared_ptr<TaskList> tasks = std::make_shared<TaskList>();
    std::shared_ptr<dfb::MemoryPool> pool = dfb::MemoryPool::create(false);
    dfb::TransportHandler* handler = nullptr;
    std::vector<std::string> script; // messages with their headers
    std::size_t next = 0;
    std::uint32_t sequence = 0;
    std::function<bool()> whenDone; // sends the rest; false if there is none
    int idle = 0;                   // naps since something came

    void send(std::string message)
    {
        if (message.size() >= sizeof(d::MessageHeader)) // or else only the first of a number would be looked at
            message.replace(offsetof(d::MessageHeader, sequence), sizeof sequence,
                            fuzz::Output().put(sequence++).bytes());
        script.push_back(std::move(message));
    }
    bool poll()
    {
        tasks->hold(false);
        if (next == script.size())
            return false;
        idle = 0;
        tasks->hold(true);
        handler->receive(1, fuzz::ExactBlocks::copyOf(script[next++]));
        tasks->hold(false);
        return true;
    }
    // Somebody waits and nothing comes.
    void nap()
    {
        if (whenDone && whenDone())
            return;
        ++idle;
        if (whenDone && idle > 2)
            fuzz::fail("a frame that does not end");
        if (idle == 3) { // outside frames a rank that is gone is what ends the wait
            dfb::ErrorInfo gone;
            gone.kind = dfb::ErrorKind::Transport;
            gone.message = "the other rank is gone";
            tasks->hold(true);
            handler->fail(gone);
            tasks->hold(false);
        }
        if (idle > 100)
            fuzz::fail("a wait that does not end");
    }
};

class PlayedTransport {
public:
    using Communicator = std::shared_ptr<Peer>;
    [[maybe_unused]] static constexpr const char* name = "played";

    PlayedTransport(const Communicator& peer, std::shared_ptr<dfb::MemoryPool>, dfb::Progress) : peer_(peer) {}
    int rank() const { return 0; }
    int size() const { return 2; }
    bool needsPolling() const { return true; }
    bool mayPoll() const { return true; }
    bool wakesOnArrival() const { return true; }
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

dfb::FrameBufferConfig configFor(std::uint8_t flags)
{
    dfb::FrameBufferConfig config;
    config.width = width;
    config.height = height;
    config.depth = true;
    config.displayRank = flags & DisplayElsewhere ? 1 : 0;
    config.ownerMap = [](int tile, const dfb::TileLayout&, int) { return ownerOf(tile); };
    config.progress = dfb::Progress::Caller;
    config.sharedMemory = false;
#if defined(DFB_HAS_SNAPPY)
    if (flags & HasCodec)
        config.codec = std::make_shared<dfb::SnappyCodec>();
#endif
    if (flags & Rounded)
        config.wire = dfb::WireFormat::Unorm16;
    return config;
}

dfb::FrameParams paramsFor(std::uint8_t flags)
{
    dfb::FrameParams params;
    params.declared = flags & Declared;
    return params;
}

std::string messageOf(MessageKind kind, std::int64_t number, const std::string& body)
{
    d::MessageHeader header;
    header.kind = kind;
    header.number = number;
    return fuzz::Output().put(header).text(body).bytes();
}

std::string reductionOf(std::uint32_t scope, const d::SmallBytes& bytes)
{
    return fuzz::Output().put(scope).text(fuzz::textOf(bytes)).bytes();
}
enum : std::uint32_t { OwnScope, AllDeclared, FrameVerdict };

std::string vote(std::uint8_t flags)
{
    d::Verdict verdict;
    verdict.paramsHash = d::fingerprintOf(paramsFor(flags));
    return reductionOf(FrameVerdict, verdict.bytes());
}

// The next message of the input; empty at the end of a frame or of the input.
std::string nextMessage(fuzz::Input& in, std::int64_t frame)
{
    if (in.left() == 0)
        return "";
    const auto what = in.take<std::uint8_t>();
    if (what % 16 == endOfFrame)
        return "";
    const std::string body = in.text(in.take<std::uint16_t>() % 8192);
    switch (what & how) {
    case NextFrame: return messageOf(static_cast<MessageKind>(what % 16), frame + 1, body);
    case LastFrame: return messageOf(static_cast<MessageKind>(what % 16), frame - 1, body);
    case OtherHeader: return body; // it is the whole message
    default: return messageOf(static_cast<MessageKind>(what % 16), frame, body);
    }
}

template <class TileOp>
void play(std::uint8_t flags, fuzz::Input& in)
{
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, PlayedTransport>;
    using Pipeline = d::TilePipeline<TileOp, dfb::NoPixelOp>;
    const auto peer = std::make_shared<Peer>();
    auto config = configFor(flags);
    config.executor = peer->tasks;
    const auto agreement = d::Agreement::of<TileOp, dfb::NoPixelOp>(config, 1, side, Pipeline::travelling(config),
                                                                    tileCount, [](int tile) { return ownerOf(tile); });
    if (flags & NoConfiguration)
        for (std::string message = nextMessage(in, 0); !message.empty(); message = nextMessage(in, 0))
            peer->send(message);
    else
        peer->send(messageOf(MessageKind::ReduceUp, 0, reductionOf(OwnScope, agreement.bytes())));
    std::optional<FrameBuffer> fb;
    try {
        fb.emplace(peer, config);
        if (flags & Gathers) {
            for (std::string message = nextMessage(in, 1); !message.empty(); message = nextMessage(in, 1))
                peer->send(message);
            const auto all = fb->allGather(std::vector<std::byte>(3));
            fuzz::require(all.size() == 2 && all[0].size() == 3, "each rank's bytes are gathered");
        }
    } catch (const dfb::Error&) {
        return; // such as InvalidArgument and TransportError
    }
    auto tile = std::make_unique<typename FrameBuffer::Tile>();
    for (std::int64_t number = 1; number <= 2; ++number) {
        try {
            for (std::string message = nextMessage(in, number); !message.empty(); message = nextMessage(in, number))
                peer->send(message);
            peer->whenDone = [&, done = false]() mutable {
                if (std::exchange(done, true))
                    return false;
                d::ByteWriter reason;
                dfb::ErrorInfo info;
                info.kind = dfb::ErrorKind::Cancelled;
                info.rank = 1;
                put(reason, info);
                peer->send(messageOf(MessageKind::Abort, number, fuzz::textOf(reason.bytes())));
                peer->send(messageOf(MessageKind::ReduceUp, number, vote(flags)));
                return true;
            };
            auto frame = fb->begin(paramsFor(flags));
            fb->poll();
            if (flags & Declared)
                frame.declare({{0, 50, 0}, {1, 50, 0}});
            for (const int index : {0, 2, 4, 1}) {
                if ((flags & Declared) && index > 1)
                    continue;
                frame.start(*tile, index);
                tile->generation = (flags & Declared) || index == 1 ? 1 : 0;
                tile->source = (flags & Declared) ? 50 : 0;
                tile->children = tile->generation == 0 ? 1 : 0;
                tile->pixel(1, 1)[3] = 1;
                frame.setTile(*tile);
                fb->poll();
            }
            if (flags & NextJobs)
                for (dfb::JobRange jobs = frame.nextJobs(jobCount); jobs.begin < jobs.end;
                     jobs = frame.nextJobs(jobCount))
                    fuzz::require(jobs.begin >= 0 && jobs.end <= jobCount, "jobs are such that there are");
            const auto report = frame.end();
            for (const dfb::TileError& error : report.tileErrors)
                fuzz::require(error.tile >= 0 && error.tile < tileCount, "an error is of a tile that there is");
        } catch (const dfb::FrameError&) {
            // The next may be better.
        } catch (const dfb::TransportError&) {
            break;
        }
        peer->whenDone = nullptr;
    }
    peer->whenDone = nullptr;
    fb.reset();
}

} // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size)
{
    fuzz::Input in(data, size);
    const auto flags = in.take<std::uint8_t>();
    if (flags & Deep)
        play<dfb::BasicDeepBlend<side>>(flags, in);
    else
        play<dfb::BasicAlphaBlend<side>>(flags, in);
    return 0;
}

namespace {

// The body of the input of a tile.
template <class TileOp>
std::string inputOf(std::uint8_t flags, int index, int generation, std::uint32_t source, int children, bool isDense)
{
    static const auto pool = dfb::MemoryPool::create(false);
    using Tile = dfb::Tile<TileOp::channels, side>;
    const auto config = configFor(flags);
    const dfb::TileLayout layout(width, height, side);
    auto tile = std::make_unique<Tile>();
    static_cast<dfb::TileHeader&>(*tile) = {1, index, layout.region(index), 0, generation, children, source, 0};
    tile->clear();
    tile->forEachPixel([&](int x, int y, float* rgba, float& depth) {
        if (!isDense && (x + y) % 3 != 0)
            return;
        rgba[0] = 0.25f;
        rgba[3] = 0.5f;
        depth = static_cast<float>(x);
    });
    d::InputFaults faults;
    const dfb::Buffer message =
        d::encodeFragment(*pool, *tile, d::TilePipeline<TileOp, dfb::NoPixelOp>::travelling(config), 0,
                          config.codec.get(), d::WireCoder(config.wire), config.wire.color, faults);
    const std::size_t prefix = sizeof(d::MessageHeader);
    return fuzz::textOf(message.data() + prefix, message.size() - prefix);
}

std::string of(int what, const std::string& body)
{
    return fuzz::Output()
        .put(static_cast<std::uint8_t>(what))
        .put(static_cast<std::uint16_t>(body.size()))
        .text(body)
        .bytes();
}
std::string of(MessageKind kind, const std::string& body) { return of(static_cast<int>(kind), body); }

// The finished tiles 1, 3 and 5 and their count, as two bodies.
std::pair<std::string, std::string> finished(std::uint8_t flags)
{
    const auto config = configFor(flags);
    const auto pool = dfb::MemoryPool::create(false);
    std::vector<std::string> bodies;
    d::GatherSettings settings;
    settings.format = config.format;
    settings.channels = dfb::depthChannel;
    settings.codec = config.codec;
    const dfb::TileLayout layout(width, height, side);
    d::FinalGather gather(pool, layout, settings, false, 1, {false, true}, ownerOf, [&](dfb::Buffer&& message) {
        const std::size_t prefix = sizeof(d::MessageHeader);
        bodies.push_back(fuzz::textOf(message.data() + prefix, message.size() - prefix));
    });
    gather.newFrame(1, config.codec != nullptr, {});
    for (const int tile : {1, 3, 5}) {
        auto place = gather.reserve(tile);
        const dfb::Region region = layout.region(tile);
        for (int i = 0; i < region.width() * region.height(); ++i)
            for (const auto c : {d::Color, d::Depth})
                std::memset(place.planes.at[c] + 4 * i, i % 5 == 2 ? 9 : 1, 4);
        gather.commit(tile, std::move(place), region.width() * region.height());
    }
    gather.flush();
    return {bodies.at(0), bodies.at(1)};
}

} // namespace

std::vector<std::pair<std::string, std::string>> fuzz::seeds()
{
    std::vector<std::pair<std::string, std::string>> all;
    const auto add = [&](const std::string& name, std::uint8_t flags, const std::string& messages) {
        all.emplace_back(name, Output().put(flags).text(messages).bytes());
    };
    const auto inputs = [](std::uint8_t flags, int generation, std::uint32_t source) {
        std::string text;
        for (const int tile : {0, 2, 4})
            text +=
                of(MessageKind::Fragment,
                   flags & Deep ? inputOf<dfb::BasicDeepBlend<side>>(flags, tile, generation, source, 0, tile == 2)
                                : inputOf<dfb::BasicAlphaBlend<side>>(flags, tile, generation, source, 0, tile == 2));
        return text;
    };
    const std::string end(1, static_cast<char>(endOfFrame));
    const auto frameOf = [&](std::uint8_t flags) {
        std::string text = inputs(flags, 1, 9);
        if (flags & Declared) {
            text = of(MessageKind::Manifest, Output().put(2).put(9u).put(std::uint16_t{0}).bytes());
            text += of(MessageKind::ManifestAck, "") + of(MessageKind::ReduceUp, reductionOf(AllDeclared, {}));
            text += of(MessageKind::Fragment, inputOf<dfb::BasicAlphaBlend<side>>(flags, 2, 1, 9, 0, true));
        }
        if (!(flags & DisplayElsewhere)) {
            const auto [tiles, count] = finished(flags);
            text += of(MessageKind::FinishedTiles, tiles) + of(MessageKind::TilesDone, count);
        }
        return text + of(MessageKind::ReduceUp, vote(flags)) + end;
    };
    for (const std::uint8_t flags :
         {0, +DisplayElsewhere, +Declared, +HasCodec, +Rounded, +Deep, Declared | HasCodec, Rounded | HasCodec})
        add("frame_" + std::to_string(flags), flags, frameOf(flags) + frameOf(flags));
    const auto jobs = [](std::int64_t from, std::int64_t to) {
        return of(MessageKind::Jobs, Output().put(from).put(to).bytes());
    };
    add("jobs", NextJobs, jobs(4, 6) + inputs(0, 1, 9));
    add("jobs_that_are_not", NextJobs, jobs(4, 60) + jobs(-4, -3));
    add("jobs_asked_for", NextJobs | DisplayElsewhere,
        of(MessageKind::JobRequest, Output().put(std::int64_t{jobCount}).put(1).put(0).bytes())
            + of(MessageKind::JobRequest, Output().put(std::int64_t{4}).put(1).put(0).bytes()));
    add("manifest_late", Declared,
        of(MessageKind::ManifestAck, "") + of(MessageKind::ReduceUp, reductionOf(AllDeclared, {}))
            + of(MessageKind::Manifest, Output().put(2).put(9u).put(std::uint16_t{0}).bytes()));
    add("credit", 0,
        of(MessageKind::CreditRequest, Output().put(std::uint64_t{1000}).put(std::uint64_t{2000}).bytes())
            + of(MessageKind::Credit, Output().put(std::uint64_t{1000}).put(std::uint64_t{500}).bytes()));
    add("credit_without_end", 0,
        of(MessageKind::CreditRequest, Output().put(~std::uint64_t{0}).put(~std::uint64_t{0}).bytes()));
    dfb::ErrorInfo info;
    info.kind = dfb::ErrorKind::UserCode;
    info.message = "the renderer broke";
    d::ByteWriter reason;
    put(reason, info);
    add("abort", 0, of(MessageKind::Abort, textOf(reason.bytes())) + end + inputs(0, 1, 9));
    add("failure", 0, of(MessageKind::Failure, textOf(reason.bytes())));
    add("vote_that_is_none", 0, of(MessageKind::ReduceUp, Output().put(+FrameVerdict).text("no vote").bytes()));
    add("reduction_that_is_none", 0, of(MessageKind::ReduceUp, Output().put(9u).bytes()));
    add("result_from_below", 0, of(MessageKind::ReduceDown, vote(0)));
    d::Verdict verdict;
    verdict.paramsHash = d::fingerprintOf(paramsFor(0));
    verdict.tileErrors = {{99, 1.0}};
    add("vote_on_no_tile", 0, of(MessageKind::ReduceUp, reductionOf(FrameVerdict, verdict.bytes())));
    for (const int tile : {2, -2})
        add("hidden" + std::to_string(tile), 0,
            of(MessageKind::Hidden, Output().put(tile).put(1).bytes()) + inputs(0, 1, 9));
    add("image_place", 0, of(MessageKind::ImagePlace, std::string(sizeof(d::ImagePlaces), '\1')));
    add("image_place_of_the_display", DisplayElsewhere,
        of(MessageKind::ImagePlace, std::string(sizeof(d::ImagePlaces), '\1')));
    add("next_frame_first", 0,
        of(static_cast<int>(MessageKind::Fragment) | NextFrame,
           inputOf<dfb::BasicAlphaBlend<side>>(0, 0, 1, 9, 0, true))
            + inputs(0, 1, 9) + end);
    add("of_the_last_frame", 0, end + of(static_cast<int>(MessageKind::Fragment) | LastFrame, "late"));
    d::MessageHeader header;
    header.number = 1000;
    add("far_frame", 0, of(OtherHeader, Output().put(header).bytes()));
    header.number = 1;
    header.receiver = 5000;
    add("far_object", 0, of(OtherHeader, Output().put(header).bytes()));
    header.receiver = 0;
    header.version = 3;
    add("other_version", 0, of(OtherHeader, Output().put(header).bytes()));
    header.version = d::MessageHeader::formatVersion;
    header.magic = d::MessageHeader::magicSwapped;
    add("other_byte_order", 0, of(OtherHeader, Output().put(header).bytes()));
    add("other_channels", 0, of(MessageKind::Fragment, inputOf<dfb::BasicDeepBlend<side>>(Deep, 0, 1, 9, 0, true)));
    add("configuration", NoConfiguration,
        of(MessageKind::ReduceUp, reductionOf(OwnScope, d::Agreement{true, "size 4x4", 1}.bytes())) + end);
    add("configuration_broken", NoConfiguration, of(MessageKind::ReduceUp, std::string("\0\0\0\0no", 6)) + end);
    const auto gathered = [](std::int32_t rank, std::uint64_t count, const std::string& bytes) {
        return of(MessageKind::ReduceUp, Output().put(+OwnScope).put(rank).put(count).text(bytes).bytes());
    };
    add("gathered", Gathers, gathered(1, 2, "ab"));
    add("gathered_too_much", Gathers, gathered(1, ~std::uint64_t{0}, "ab"));
    add("gathered_of_another", Gathers, gathered(0, 2, "ab"));
    add("gathered_of_no_rank", Gathers, gathered(7, 2, "ab"));
    return all;
}
