// Frames over a transport that disturbs messages. Each frame must end in the right image or in an error of dfb, which
// is the same on every rank as long as the ranks can still communicate. A seed decides what is done to the messages.
#pragma once

#include "random_scene.hpp"

#include <dfb/testing/fault_transport.hpp>

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <future>
#include <memory>
#include <numeric>
#include <string>
#include <thread>
#include <type_traits>
#include <utility>
#include <vector>

namespace scene {

// The configuration of some frames, which follows from a seed.
struct FaultGroup {
    std::uint64_t seed = 0;
    int ranks = 2;
    bool harmless = false; // nothing is lost or damaged, so all frames must be right
    enum class Op { Sorted, Ordered, Nearest, Average, Deep, Accumulated } op = Op::Sorted;
    Loop loop = Loop::Listing3; // for Op::Sorted; each other operation has one loop
    Scene scene;
    dfb::testing::FaultOptions faults;
};

inline FaultGroup faultGroup(std::uint64_t seed)
{
    const std::uint64_t h = mix(seed);
    const auto pick = [h](int shift, std::uint64_t count) { return static_cast<int>((h >> shift) % count); };
    FaultGroup g;
    g.seed = seed;
    g.ranks = 2 + pick(0, 4);
    g.loop = std::vector<Loop>{Loop::Listing3, Loop::Declared, Loop::ImageDealt}[static_cast<std::size_t>(pick(4, 3))];
    g.op = static_cast<FaultGroup::Op>(std::max(0, pick(50, 8) - 2)); // three in eight sorted
    const bool isImageParallel =
        g.op == FaultGroup::Op::Average || (g.op == FaultGroup::Op::Sorted && !isDataParallel(g.loop));
    g.scene =
        makeScene(isImageParallel ? 1 : 1 + pick(8, 6), seed, 33 + pick(12, 40), 17 + pick(20, 40), 1 + pick(28, 2));
    g.scene.rule = g.op == FaultGroup::Op::Ordered   ? dfb::BlendRule::InOrder
                   : g.op == FaultGroup::Op::Nearest ? dfb::BlendRule::Nearest
                                                     : dfb::BlendRule::SortByDepth;
    g.faults.seed = seed;
    g.faults.maxDelay = std::chrono::microseconds(200 + 300 * pick(32, 5));
    g.faults.reorder = 0.3 * pick(36, 2);
    g.faults.delay = 0.1 * pick(37, 2);
    g.faults.duplicate = 0.2 * pick(38, 2);
    const double lethal = 0.001 * (1 << pick(44, 6));
    g.faults.drop = pick(40, 3) == 1 ? lethal : 0;
    g.faults.corrupt = pick(40, 3) == 2 ? 2 * lethal : 0;
    g.harmless = g.faults.drop + g.faults.corrupt == 0;
    g.scene.timeout = std::chrono::milliseconds(g.harmless ? 20000 : 80);
    g.scene.allowPartial = pick(54, 3) == 0;
    // Two kinds of messages are left alone. Those of reduce() construct the framebuffer, and no frame's time-out covers
    // them. Those that say that a rank gives up would be delivered by any transport that still works at all.
    g.faults.only = [](int, const dfb::Buffer& message) {
        const auto header = dfb::detail::loadAs<dfb::detail::MessageHeader>(message.data());
        if (header.kind != dfb::detail::MessageKind::ReduceUp && header.kind != dfb::detail::MessageKind::ReduceDown)
            return header.kind != dfb::detail::MessageKind::Failure;
        return dfb::detail::loadAs<std::uint32_t>(message.data() + sizeof header) != 0;
    };
    return g;
}

// Aborts the process after 60 seconds and prints `what`.
class Limit {
public:
    explicit Limit(std::string what)
        : watch_([over = over_.get_future(), what = std::move(what)] {
              if (over.wait_for(std::chrono::seconds(60)) == std::future_status::ready)
                  return;
              std::fprintf(stderr, "a test hangs: %s\n", what.c_str());
              std::abort();
          })
    {
    }
    Limit(const Limit&) = delete;
    Limit& operator=(const Limit&) = delete;
    ~Limit()
    {
        over_.set_value();
        watch_.join();
    }

private:
    std::promise<void> over_;
    std::thread watch_;
};

struct FaultEnding {
    std::string text;      // from outcomeOf(), or "partial: " and the reason
    std::size_t wrong = 0; // number of wrong values on the display rank
};

// Adds each sample as a segment of length 0.
inline void renderDeep(const Scene& s, const dfb::Brick& brick, dfb::DeepTile& deep)
{
    const dfb::Region& r = deep.header().region;
    for (int y = r.y0; y < r.y1; ++y)
        for (int x = r.x0; x < r.x1; ++x)
            if (const auto sample = sampleOf(s, brick, deep.header().pass, x, y))
                deep.add(x, y, {sample->rgba, sample->depth, sample->depth});
}

// Renders frame number `frame` (from 1) of a group, with the loop that belongs to the operation.
template <class TileOp, class FrameBuffer>
dfb::FrameReport faultFrame(FrameBuffer& fb, const FaultGroup& group, int frame)
{
    using Op = FaultGroup::Op;
    constexpr Op op = std::is_same_v<TileOp, dfb::BasicAlphaBlend<16>>       ? Op::Sorted
                      : std::is_same_v<TileOp, dfb::BasicOrderedBlend<16>>   ? Op::Ordered
                      : std::is_same_v<TileOp, dfb::BasicDepthComposite<16>> ? Op::Nearest
                      : std::is_same_v<TileOp, dfb::BasicImageParallel<16>>  ? Op::Average
                      : std::is_same_v<TileOp, dfb::BasicDeepBlend<16>>      ? Op::Deep
                                                                             : Op::Accumulated;
    const Scene& s = group.scene;
    const auto renderOne = [&](const dfb::Brick& b, auto& tile) { renderBrick(s, b, tile); };
    if constexpr (op == Op::Sorted) {
        return renderLoop(fb, s, group.loop);
    } else if constexpr (op == Op::Average) {
        return dfb::ImageParallelLoop(fb, dfb::WorkDistribution::Dynamic)
            .render([&](auto& tile) { renderBrick(s, s.bricks.front(), tile); }, paramsOf(s));
    } else if constexpr (op == Op::Deep) {
        return dfb::DeepParallelLoop(fb, dfb::World(bricksOf(s, fb.rank(), fb.size())), 2)
            .render(
                FlatCamera(), [&](const dfb::Brick& b, dfb::DeepTile& deep) { renderDeep(s, b, deep); }, paramsOf(s));
    } else if constexpr (op == Op::Accumulated) {
        dfb::FrameConfig params = paramsOf(s);
        params.accumulationId = static_cast<std::uint64_t>(frame); // one that fails leaves tiles without samples
        return dfb::DataParallelLoop(fb, dfb::World(bricksOf(s, fb.rank(), fb.size())))
            .render(FlatCamera(), renderOne, params);
    } else {
        const dfb::SharedWorld world(fb, dfb::World(bricksOf(s, fb.rank(), fb.size())));
        dfb::RoundRobinBricks inTurn;
        if constexpr (op == Op::Nearest) {
            return dfb::MixedParallelLoop(fb, world, inTurn).render(FlatCamera(), renderOne, paramsOf(s));
        } else {
            std::vector<int> order(s.bricks.size()); // by id, as in the world
            std::iota(order.begin(), order.end(), 0);
            return dfb::OrderedLoop(fb, world, inTurn).render(FlatCamera(), order, renderOne, paramsOf(s));
        }
    }
}

// Renders frames on this rank until one ends in a TransportError, after which no further frame is possible.
template <class Base, class TileOp = dfb::BasicAlphaBlend<16>>
std::vector<FaultEnding> faultFrames(const typename Base::Communicator& communicator, const FaultGroup& group,
                                     const std::vector<dfb::testing::Pixel>& expected, int frames)
{
    using Transport = dfb::testing::FaultTransport<Base>;
    using FrameBuffer = dfb::DistributedFrameBuffer<TileOp, dfb::NoPixelOp, Transport>;
    dfb::FrameBufferConfig config;
    config.image.width = group.scene.width;
    config.image.height = group.scene.height;
    config.image.format = dfb::OutputFormat::RGBA32F;
    config.image.depth = true;
    config.messages.poolBytes = group.seed % 3 ? std::size_t{64} << 20 : 0;
    config.executor = std::make_shared<dfb::ThreadExecutor>(1 + static_cast<int>(group.seed % 2));
    dfb::NetworkConfig options;
    options.checksums = true;
    std::vector<FaultEnding> endings;
    std::unique_ptr<FrameBuffer> made;
    // Another rank may already be in the first frame, and a message of that frame may be damaged.
    const std::string making = outcomeOf([&] {
        made = std::make_unique<FrameBuffer>(typename Transport::Communicator{communicator, group.faults}, config,
                                             options);
    });
    if (!made)
        return {{making, 0}};
    FrameBuffer& fb = *made;
    for (int frame = 0; frame < frames; ++frame) {
        FaultEnding ending;
        std::string why;
        ending.text = outcomeOf([&] {
            FaultGroup its = group;
            if (!FrameBuffer::keepsState && frame % 3 == 1)
                its.scene.owners = anyOwners(fb.layout(), fb.size(), group.seed + static_cast<std::uint64_t>(frame));
            const auto report = faultFrame<TileOp>(fb, its, frame + 1);
            if (report.failure)
                why = "partial: " + report.failure->message;
            if (fb.isDisplayRank())
                ending.wrong = wrongValues(Picture(fb.image(), report), referenceOf(group.scene, fb, expected));
        });
        if (!why.empty())
            ending.text = why;
        const bool over = has(ending.text, "TransportError");
        endings.push_back(std::move(ending));
        if (over)
            break;
    }
    return endings;
}

// Describes what is wrong with the outcome of one frame on all ranks. Empty if nothing is.
inline std::string verdictOn(const std::vector<FaultEnding>& ranks, bool harmless)
{
    bool anyTransport = false;
    for (const FaultEnding& r : ranks) {
        anyTransport = anyTransport || has(r.text, "TransportError");
        if (r.wrong > 0)
            return "a wrong image: " + std::to_string(r.wrong) + " values";
        if (r.text != "fine" && r.text.rfind("partial", 0) != 0 && !has(r.text, "FrameError")
            && !has(r.text, "TransportError"))
            return "an error of another type: " + r.text;
        if (harmless && r.text != "fine")
            return "nothing was lost, but: " + r.text;
    }
    for (const FaultEnding& r : ranks)
        if (!anyTransport && r.text != ranks.front().text)
            return "ranks differ: " + ranks.front().text + " and " + r.text;
    return {};
}

} // namespace scene
