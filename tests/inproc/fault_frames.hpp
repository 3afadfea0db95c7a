// Frames over a transport that disturbs messages: each must end in the right image or in an error of dfb, the same on
// every rank as long as the ranks can still talk. What is done to the messages follows from a seed.
#pragma once

#include "scene.hpp"

#include <dfb/testing/fault_transport.hpp>

#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

namespace scene {

// What a seed stands for.
struct FaultGroup {
    std::uint64_t seed = 0;
    int ranks = 2;
    bool harmless = false; // nothing is lost or damaged: all frames must be right
    Loop loop = Loop::Listing3;
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
    g.scene = makeScene(isDataParallel(g.loop) ? 1 + pick(8, 6) : 1, seed, 33 + pick(12, 40), 17 + pick(20, 40),
                        1 + pick(28, 2));
    g.faults.seed = seed;
    g.faults.maxDelay = std::chrono::microseconds(200 + 300 * pick(32, 5));
    g.faults.reorder = 0.3 * pick(36, 2);
    g.faults.delay = 0.1 * pick(37, 2);
    g.faults.duplicate = 0.2 * pick(38, 2);
    const double lethal = 0.001 * (1 << pick(44, 6));
    g.faults.drop = pick(40, 3) == 1 ? lethal : 0;
    g.faults.corrupt = pick(40, 3) == 2 ? 2 * lethal : 0;
    g.harmless = g.faults.drop + g.faults.corrupt == 0;
    g.scene.timeoutMs = g.harmless ? 20000 : 80;
    // Left alone is what makes the framebuffer, as no frame's time-out covers it; and the word of a rank that it gives
    // up, which a transport that still works at all delivers.
    g.faults.only = [](int, const dfb::Buffer& message) {
        const auto header = dfb::detail::loadAs<dfb::detail::MessageHeader>(message.data());
        if (header.kind != dfb::detail::MessageKind::ReduceUp && header.kind != dfb::detail::MessageKind::ReduceDown)
            return header.kind != dfb::detail::MessageKind::Failure;
        return dfb::detail::loadAs<std::uint32_t>(message.data() + sizeof header) != 0;
    };
    return g;
}

struct FaultEnding {
    std::string text;      // as of outcomeOf()
    std::size_t wrong = 0; // values, on the display rank
};

// One rank's part: frames until one ends in a TransportError, after which nothing more can be done.
template <class Base>
std::vector<FaultEnding> faultFrames(const typename Base::Communicator& communicator, const FaultGroup& group,
                                     const std::vector<dfb::testing::Pixel>& expected, int frames)
{
    using Transport = dfb::testing::FaultTransport<Base>;
    using FrameBuffer = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, Transport>;
    dfb::FrameBufferConfig config;
    config.width = group.scene.width;
    config.height = group.scene.height;
    config.format = dfb::OutputFormat::RGBA32F;
    config.depth = true;
    config.checksums = true;
    config.gather = group.seed % 2 ? dfb::GatherMode::AtEnd : dfb::GatherMode::Batches;
    config.messagePoolBytes = group.seed % 3 ? std::size_t{64} << 20 : 0;
    config.executor = std::make_shared<dfb::ThreadExecutor>(1 + static_cast<int>(group.seed % 2));
    std::vector<FaultEnding> endings;
    std::unique_ptr<FrameBuffer> made;
    // Another rank may be in the first frame already, and a message of that damaged.
    const std::string making = outcomeOf([&] {
        made = std::make_unique<FrameBuffer>(typename Transport::Communicator{communicator, group.faults}, config);
    });
    if (!made)
        return {{making, 0}};
    FrameBuffer& fb = *made;
    for (int frame = 0; frame < frames; ++frame) {
        FaultEnding ending;
        ending.text = outcomeOf([&] {
            const auto report = renderLoop(fb, group.scene, group.loop);
            if (fb.isDisplayRank())
                ending.wrong = wrongValues(Picture(fb.image(), report), expected);
        });
        const bool over = has(ending.text, "TransportError");
        endings.push_back(std::move(ending));
        if (over)
            break;
    }
    return endings;
}

// What is wrong with the endings of one frame, over all ranks; empty if nothing is.
inline std::string verdictOn(const std::vector<FaultEnding>& ranks, bool harmless)
{
    bool anyTransport = false;
    for (const FaultEnding& r : ranks) {
        anyTransport = anyTransport || has(r.text, "TransportError");
        if (r.wrong > 0)
            return "a wrong image: " + std::to_string(r.wrong) + " values";
        if (r.text != "fine" && !has(r.text, "FrameError") && !has(r.text, "TransportError"))
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
