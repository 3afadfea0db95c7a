// Frames whose features are chosen at random, many at once: how inputs are announced, who renders them and how they
// travel, owners, passes, formats, frames in flight, executors, late messages, and what goes wrong. Each picture is,
// bit for bit, the one that a single rank makes. A frame that must fail does so on all ranks, with the same error.
#include "catch.hpp"

#include <dfb/comm/inproc_transport.hpp>
#include <dfb/distributed_framebuffer.hpp>
#include <dfb/ops/image_parallel.hpp>
#include <dfb/ops/progressive.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/testing/adversarial.hpp>
#include <dfb/testing/fault_transport.hpp>

#if defined(DFB_HAS_SNAPPY)
#include <dfb/comm/snappy_codec.hpp>
#endif

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <deque>
#include <memory>
#include <mutex>
#include <new>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace {

using dfb::testing::Random;
using dfb::testing::uniform;
using Milliseconds = std::chrono::milliseconds;

int below(Random& random, int count) { return static_cast<int>(random() % static_cast<std::uint64_t>(count)); }
bool oneIn(Random& random, int count) { return below(random, count) == 0; }

enum class Tree {
    List,  // each input announces the one behind it
    Any,   // an input announces any number of others
    Single // one input per pass; the operation keeps state
};

struct Sorted : dfb::BasicAlphaBlend<16, dfb::allChannels & ~dfb::farChannel> {
    static constexpr Tree tree = Tree::Any;
};
struct Ordered : dfb::BasicOrderedBlend<16> {
    static constexpr Tree tree = Tree::List;
};
struct Accumulated : dfb::Progressive<dfb::BasicImageParallel<24>> {
    static constexpr Tree tree = Tree::Single;
};

struct Input {
    int tile = 0, pass = 0, generation = 0, children = 0;
    std::uint32_t source = 0;
    int rank = 0; // that renders it
    std::uint64_t seed = 0;
};

enum class Failure { None, Abort, Missing, Twice, Cancel, Leave };

struct FramePlan {
    dfb::FrameConfig config;
    std::vector<Input> inputs;
    bool isDynamic = false; // any rank renders any input: Frame::nextJob()
    Failure failure = Failure::None;
    int culprit = 0; // the rank on which it fails
};

// What is the same on all ranks.
struct Plan {
    std::uint64_t seed = 0;
    int ranks = 1;
    dfb::FrameBufferConfig config;
    dfb::NetworkConfig network;
    bool isLate = false; // messages come late and in another order
    std::vector<FramePlan> frames;
};

// The inputs of a tile.
void addInputs(Random& random, Tree tree, int tile, int ranks, FramePlan& frame)
{
    const bool isDeclared = frame.config.declared;
    std::vector<int> generations; // of sources 0, 1, ...
    if (!isDeclared)
        generations.push_back(0);
    for (int i = tree == Tree::Single ? 0 : below(random, 6); i > 0; --i)
        generations.push_back(isDeclared           ? 1
                              : tree == Tree::List ? generations.back() + 1
                                                   : std::max(1, generations.back() + below(random, 2)));
    for (std::size_t i = 0; i < generations.size(); ++i) {
        const bool isLast = i + 1 == generations.size() || generations[i + 1] > generations[i];
        const auto next = std::count(generations.begin(), generations.end(), generations[i] + 1);
        Input input;
        input.tile = tile;
        input.generation = generations[i];
        input.children = isLast ? static_cast<int>(next) : 0;
        input.source = static_cast<std::uint32_t>(i);
        input.rank = below(random, ranks);
        for (; input.pass < frame.config.passes; ++input.pass) {
            input.seed = random();
            frame.inputs.push_back(input);
        }
    }
}

// The next frame; sometimes the last one again, with other owners perhaps.
template <class Op>
FramePlan nextFrame(Random& random, const Plan& plan, const dfb::TileLayout& layout, bool mayFail)
{
    FramePlan frame;
    if (!plan.frames.empty() && oneIn(random, 2)) {
        frame = plan.frames.back();
    } else {
        frame.config.passes = oneIn(random, 3) ? 3 : 1;
        frame.config.background = {0.25f, 0.5f, 0, oneIn(random, 2) ? 1.0f : 0.5f};
        frame.config.accumulationId = plan.frames.size();
        frame.config.declared = Op::tree != Tree::Single && oneIn(random, 2);
        if (Op::tree == Tree::Any && oneIn(random, 3))
            frame.config.order = std::make_shared<const dfb::SourceOrder>(std::vector<std::uint32_t>{4, 2, 0, 5, 1, 3});
        for (int tile = 0; tile < layout.tileCount(); ++tile)
            addInputs(random, Op::tree, tile, plan.ranks, frame);
    }
    if (Op::tree != Tree::Single && oneIn(random, 3)) {
        std::vector<int> owners;
        for (int tile = 0; tile < layout.tileCount(); ++tile)
            owners.push_back(below(random, plan.ranks));
        frame.config.owners = std::make_shared<const std::vector<int>>(std::move(owners));
    }
    frame.failure = mayFail && oneIn(random, 3) ? static_cast<Failure>(1 + below(random, 5)) : Failure::None;
    // Hidden inputs of an ordered blend may be missing.
    if (Op::tree == Tree::List && (frame.failure == Failure::Missing || frame.failure == Failure::Twice))
        frame.failure = Failure::Abort;
    frame.culprit = below(random, plan.ranks);
    const bool anyRankMay = frame.config.declared || Op::tree == Tree::Single; // send any input
    frame.isDynamic = frame.failure == Failure::None && anyRankMay && oneIn(random, 3);
    return frame;
}

template <class Op>
Plan planOf(std::uint64_t seed)
{
    Random random(seed);
    Plan plan;
    plan.seed = seed;
    plan.ranks = 1 + below(random, 5);
    dfb::ImageConfig& image = plan.config.image;
    image.width = 1 + below(random, 90);
    image.height = 1 + below(random, 70);
    image.format = static_cast<dfb::OutputFormat>(1 + below(random, 3));
    image.depth = oneIn(random, 3);
    image.dither = oneIn(random, 4);
    image.displayRank = below(random, plan.ranks);
    if (oneIn(random, 2))
        image.aux = Op::channels & dfb::imageAuxChannels;
    if (oneIn(random, 3))
        image.ownerMap = dfb::hashOwner;
#if defined(DFB_HAS_SNAPPY)
    if (oneIn(random, 3)) {
        plan.config.messages.codec = std::make_shared<dfb::SnappyCodec>();
        plan.config.messages.compression = oneIn(random, 2) ? dfb::CompressionMode::Auto : dfb::CompressionMode::Always;
    }
#endif
    if (oneIn(random, 3))
        plan.config.messages.poolBytes = 1; // is raised to the least that there can be
    if (oneIn(random, 6))
        plan.config.minTransmittance = 0.05f;
    plan.config.framesInFlight = Op::tree == Tree::Single ? 1 : 1 + below(random, 3);
    plan.network.checksums = oneIn(random, 3);
    plan.isLate = oneIn(random, 2);
    const bool mayFail = oneIn(random, 2);
    plan.config.quiet = Milliseconds(mayFail ? 40 : 2000);
    const int tileSize = dfb::detail::tile_size_v<Op>;
    const dfb::TileLayout layout(image.width, image.height, tileSize, tileSize);
    for (int f = 0; f < 5; ++f)
        plan.frames.push_back(nextFrame<Op>(random, plan, layout, mayFail));
    return plan;
}

template <class Tile>
constexpr bool hasAux = (Tile::channels & dfb::imageAuxChannels) != 0;

// The same pixels wherever it is rendered. Those of every second input can be written as bytes.
template <class Tile>
void render(const Input& input, Tile& tile)
{
    Random random(input.seed);
    dfb::testing::fillAdversarial(tile, random);
    for (float& value : tile.color)
        if (input.seed % 2 == 0)
            value = static_cast<float>(static_cast<int>(255 * std::clamp(value, 0.0f, 1.0f)) / 255.0);
    if constexpr (hasAux<Tile>)
        for (int i = 0; i < Tile::size * Tile::size; ++i) {
            for (int c = 0; c < 3; ++c) {
                tile.normal[3 * i + c] = tile.color[4 * i + 3] * uniform(random);
                tile.albedo[3 * i + c] = tile.color[4 * i + 3] * uniform(random);
                tile.position[3 * i + c] = uniform(random);
            }
            tile.primitiveId[i] = static_cast<std::uint32_t>(random());
            tile.instanceId[i] = oneIn(random, 2) ? dfb::noId : 1;
        }
}

template <class Tile>
void setPlace(const Input& input, Tile& tile)
{
    tile.generation = input.generation;
    tile.children = input.children;
    tile.source = input.source;
}

template <class Frame>
void declare(Frame& frame, const FramePlan& plan, int rank)
{
    std::vector<dfb::TileInput> mine;
    for (const Input& input : plan.inputs)
        if (input.pass == 0 && (input.rank == rank || rank < 0))
            mine.push_back({input.tile, input.source, 0});
    frame.declare(mine);
}

using Bytes = std::vector<std::byte>;

Bytes bytesOf(const dfb::Image& image)
{
    Bytes bytes;
    image.forEachPlane(
        [&](const std::byte* plane, std::size_t count) { bytes.insert(bytes.end(), plane, plane + count); });
    return bytes;
}

// The pictures of the frames that end well.
template <class Op>
std::vector<Bytes> picturesOfOneRank(const Plan& plan)
{
    std::vector<Bytes> pictures;
    dfb::runRanks(1, [&](const dfb::InprocCommunicator& communicator) {
        dfb::FrameBufferConfig config;
        config.image = plan.config.image;
        config.image.displayRank = 0;
        config.minTransmittance = plan.config.minTransmittance;
        dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, dfb::InprocTransport> fb(communicator, config);
        const auto tile = std::make_unique<typename decltype(fb)::Tile>();
        for (const FramePlan& planned : plan.frames) {
            dfb::FrameConfig params = planned.config;
            params.owners = nullptr;
            auto frame = fb.begin(params);
            if (planned.failure != Failure::None)
                frame.cancel(); // ends what has accumulated
            else if (params.declared)
                declare(frame, planned, -1);
            for (const Input& input : planned.inputs) {
                frame.start(*tile, input.tile, input.pass);
                setPlace(input, *tile);
                render(input, *tile);
                frame.setTile(*tile);
            }
            try {
                frame.end();
                pictures.push_back(bytesOf(fb.image()));
            } catch (const dfb::FrameError&) {
                pictures.emplace_back();
            }
        }
    });
    return pictures;
}

// A frame of one rank that has begun, and the pixels that its inputs are read from.
template <class FrameBuffer>
struct OpenFrame {
    explicit OpenFrame(typename FrameBuffer::Frame&& begun) : frame(std::move(begun)) {}

    std::mutex mutex;
    std::vector<dfb::Buffer> pixels;   // under mutex
    typename FrameBuffer::Frame frame; // is left before the pixels go
};

// Sends an input: from a tile, or from memory elsewhere that may be read until the frame ends.
template <class FrameBuffer>
void send(FrameBuffer& fb, OpenFrame<FrameBuffer>& open, const Input& input, typename FrameBuffer::Tile& tile)
{
    using Tile = typename FrameBuffer::Tile;
    static_assert(std::is_trivially_destructible_v<Tile>);
    Random random(input.seed ^ 0x5bd1e995u);
    open.frame.start(tile, input.tile, input.pass);
    setPlace(input, tile);
    render(input, tile);
    if (oneIn(random, 2))
        return open.frame.setTile(tile);
    const std::size_t pixelCount = std::size_t{Tile::size} * Tile::size;
    dfb::Buffer memory = fb.sharedMemory(sizeof(Tile) + 4 * pixelCount);
    const Tile& there = *new (memory.data()) Tile(tile);
    auto* bytes = reinterpret_cast<std::uint8_t*>(memory.data() + sizeof(Tile));
    for (std::size_t i = 0; i < 4 * pixelCount; ++i)
        bytes[i] = static_cast<std::uint8_t>(255 * std::clamp(tile.color[i], 0.0f, 1.0f) + 0.5f);
    typename FrameBuffer::TileView view;
    open.frame.start(view, input.tile, input.pass);
    setPlace(input, view);
    view.stride = Tile::size;
    if (input.seed % 2 == 0 && oneIn(random, 2))
        view.color8 = bytes;
    else
        view.color = there.color;
    view.depth = there.depth;
    if constexpr (hasAux<Tile>) {
        view.normal = there.normal;
        view.albedo = there.albedo;
        view.position = there.position;
        view.primitiveId = there.primitiveId;
        view.instanceId = there.instanceId;
    }
    view.staysUntilEnd = oneIn(random, 2);
    open.frame.setTile(view);
    const std::lock_guard<std::mutex> lock(open.mutex);
    open.pixels.push_back(std::move(memory));
}

// Renders this rank's inputs of a frame, in any order, and does what makes the frame fail.
template <class FrameBuffer>
void renderInputs(FrameBuffer& fb, OpenFrame<FrameBuffer>& open, const FramePlan& plan, Random& random)
{
    std::vector<Input> mine;
    for (const Input& input : plan.inputs)
        if (plan.isDynamic || input.rank == fb.rank())
            mine.push_back(input);
    const auto number = static_cast<std::int64_t>(mine.size());
    if (plan.isDynamic)
        return open.frame.forEachWorker([&] {
            const auto tile = std::make_unique<typename FrameBuffer::Tile>();
            for (std::int64_t i = 0; (i = open.frame.nextJob(number)) >= 0;)
                send(fb, open, mine[static_cast<std::size_t>(i)], *tile);
        });
    std::shuffle(mine.begin(), mine.end(), random);
    if (fb.rank() == plan.culprit) {
        if (plan.failure == Failure::Cancel)
            open.frame.cancel();
        if (plan.failure == Failure::Abort || (plan.failure != Failure::None && mine.empty()))
            open.frame.guard([] { throw std::runtime_error("the renderer has failed"); });
        if (plan.failure == Failure::Missing && !mine.empty())
            mine.pop_back();
        if (plan.failure == Failure::Twice && !mine.empty())
            mine.push_back(mine.back());
    }
    open.frame.forEachTile(static_cast<std::int64_t>(mine.size()),
                           [&](std::int64_t i, typename FrameBuffer::Tile& tile) {
                               send(fb, open, mine[static_cast<std::size_t>(i)], tile);
                           });
}

// What became of the frames. The errors are those of each rank; "left" if it left the frame.
struct Outcome {
    std::vector<Bytes> pictures;
    std::vector<std::vector<std::string>> errors;
};

template <class Op>
Outcome render(const Plan& plan)
{
    using Transport = dfb::testing::FaultTransport<dfb::InprocTransport>;
    using FrameBuffer = dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, Transport>;
    const std::size_t count = plan.frames.size();
    Outcome outcome{std::vector<Bytes>(count), {count, std::vector<std::string>(static_cast<std::size_t>(plan.ranks))}};
    dfb::runRanks(plan.ranks, [&](const dfb::InprocCommunicator& inner) {
        Random random(plan.seed + 7919 * static_cast<std::uint64_t>(1 + inner.rank()));
        dfb::testing::FaultOptions faults;
        faults.seed = plan.seed;
        faults.reorder = faults.delay = plan.isLate ? 0.1 : 0;
        faults.maxDelay = std::chrono::microseconds(500);
        dfb::NetworkConfig network = plan.network;
        network.progress = plan.isLate && oneIn(random, 2) ? dfb::Progress::Caller : dfb::Progress::Auto;
        dfb::FrameBufferConfig config = plan.config;
        if (oneIn(random, 3))
            config.executor = std::make_shared<dfb::CallerExecutor>();
        else
            config.executor = std::make_shared<dfb::ThreadExecutor>(1 + below(random, 2));
        FrameBuffer fb(dfb::connect<Transport>({inner, faults}, network), config);
        std::deque<OpenFrame<FrameBuffer>> open;
        std::size_t ended = 0;
        const auto end = [&] {
            std::string& error = outcome.errors[ended][static_cast<std::size_t>(fb.rank())];
            try {
                if (plan.frames[ended].failure == Failure::Leave && plan.frames[ended].culprit == fb.rank()) {
                    error = "left";
                } else {
                    open.front().frame.end();
                    if (fb.isDisplayRank())
                        outcome.pictures[ended] = bytesOf(fb.image());
                }
            } catch (const dfb::FrameError& e) {
                error = e.what();
            }
            open.pop_front();
            ++ended;
        };
        for (const FramePlan& frame : plan.frames) {
            if (static_cast<int>(open.size()) == config.framesInFlight)
                end();
            open.emplace_back(fb.begin(frame.config));
            if (frame.config.declared)
                declare(open.back().frame, frame, fb.rank());
            renderInputs(fb, open.back(), frame, random);
        }
        while (!open.empty())
            end();
    });
    return outcome;
}

// Returns what is wrong.
template <class Op>
std::string wrongOf(std::uint64_t seed)
{
    const Plan plan = planOf<Op>(seed);
    const std::vector<Bytes> expected = picturesOfOneRank<Op>(plan);
    const Outcome outcome = render<Op>(plan);
    std::string wrong;
    for (std::size_t f = 0; f < plan.frames.size(); ++f) {
        const auto say = [&](const std::string& text) { wrong += "frame " + std::to_string(f) + ": " + text + "\n"; };
        std::string error = outcome.errors[f][plan.frames[f].culprit == 0 && plan.ranks > 1 ? 1 : 0];
        for (const std::string& other : outcome.errors[f])
            if (other != error && other != "left")
                say("one rank says \"" + error + "\", another \"" + other + "\"");
        if (plan.frames[f].failure == Failure::None ? !error.empty() : error.empty())
            say(error.empty() ? "has not failed" : error);
        if (plan.frames[f].failure == Failure::None && outcome.pictures[f] != expected[f])
            say("another picture than that of one rank");
    }
    return wrong;
}

} // namespace

TEMPLATE_TEST_CASE("Frames with random features are those of one rank", "[features]", Sorted, Ordered, Accumulated)
{
    for (std::uint64_t seed = 0; seed < 100; ++seed) {
        INFO("seed " << seed);
        CHECK(wrongOf<TestType>(seed) == "");
    }
}

TEMPLATE_TEST_CASE("Many frames with random features", "[.long]", Sorted, Ordered, Accumulated)
{
    for (std::uint64_t seed = 1000; seed < 6000; ++seed) {
        INFO("seed " << seed);
        CHECK(wrongOf<TestType>(seed) == "");
    }
}
