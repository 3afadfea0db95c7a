// Frames over a transport that reorders, delays, repeats, loses and damages messages. Each must end in the right image
// or in an error of dfb. Ranks are threads.
#include "brief.hpp"
#include "catch.hpp"
#include "fault_frames.hpp"

#include <algorithm>
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <vector>

namespace faults_cases {

namespace {

struct Tally {
    int frames = 0, right = 0, partial = 0, frameErrors = 0, transportErrors = 0;
    std::map<scene::FaultGroup::Op, int> rightOf; // by operation, where something was disturbed
    std::string wrong;                            // the first, with its seed
};

// Runs groups of frames, of all operations and loops, until there are `frames` frames.
Tally faultGroups(std::uint64_t firstSeed, int frames)
{
    Tally tally;
    for (std::uint64_t seed = firstSeed; tally.frames < frames && tally.wrong.empty(); ++seed) {
        scene::FaultGroup group = scene::faultGroup(seed);
        group.faults.counts = std::make_shared<dfb::testing::FaultCounts>();
        const auto expected = scene::referenceOf(group.scene);
        std::vector<std::vector<scene::FaultEnding>> endings(static_cast<std::size_t>(group.ranks));
        const scene::Limit limit("seed " + std::to_string(seed));
        dfb::runRanks(group.ranks, [&](dfb::InprocCommunicator communicator) {
            using Op = scene::FaultGroup::Op;
            using Base = dfb::InprocTransport;
            auto& mine = endings[static_cast<std::size_t>(communicator.rank())];
            switch (group.op) {
            case Op::Sorted: mine = scene::faultFrames<Base>(communicator, group, expected, 10); break;
            case Op::Ordered:
                mine = scene::faultFrames<Base, dfb::BasicOrderedBlend<16>>(communicator, group, expected, 10);
                break;
            case Op::Nearest:
                mine = scene::faultFrames<Base, dfb::BasicDepthComposite<16>>(communicator, group, expected, 10);
                break;
            case Op::Average:
                mine = scene::faultFrames<Base, dfb::BasicImageParallel<16>>(communicator, group, expected, 10);
                break;
            case Op::Deep:
                mine = scene::faultFrames<Base, dfb::BasicDeepBlend<16>>(communicator, group, expected, 10);
                break;
            case Op::Accumulated:
                mine = scene::faultFrames<Base, dfb::Progressive<dfb::BasicAlphaBlend<16>>>(communicator, group,
                                                                                            expected, 10);
                break;
            }
        });
        const auto& counts = *group.faults.counts;
        const bool disturbed =
            counts.reordered + counts.delayed + counts.duplicated + counts.dropped + counts.corrupted > 0;
        std::size_t longest = 0;
        for (const auto& e : endings)
            longest = std::max(longest, e.size());
        for (std::size_t frame = 0; frame < longest; ++frame) {
            std::vector<scene::FaultEnding> ranks;
            for (const auto& e : endings)
                if (frame < e.size())
                    ranks.push_back(e[frame]);
            const std::string wrong = scene::verdictOn(ranks, group.harmless);
            if (!wrong.empty() && tally.wrong.empty())
                tally.wrong = "seed " + std::to_string(seed) + ", frame " + std::to_string(frame + 1) + ": " + wrong;
            const auto ended = [&](const char* how) {
                return std::any_of(ranks.begin(), ranks.end(),
                                   [how](const scene::FaultEnding& r) { return scene::has(r.text, how); });
            };
            ++tally.frames;
            if (ended("TransportError")) {
                ++tally.transportErrors;
            } else if (ended("FrameError")) {
                ++tally.frameErrors;
            } else if (ended("partial")) {
                ++tally.partial;
            } else {
                ++tally.right;
                tally.rightOf[group.op] += disturbed;
            }
        }
    }
    return tally;
}

void check(const Tally& tally, int frames)
{
    INFO(tally.wrong);
    INFO(tally.frames << " frames: " << tally.right << " right, " << tally.partial << " partial, " << tally.frameErrors
                      << " FrameError, " << tally.transportErrors << " TransportError");
    CHECK(tally.wrong.empty());
    CHECK(tally.frames >= frames);
    CHECK(10 * tally.right >= 3 * frames);
    CHECK(tally.rightOf.size() == 6);
    for (const auto& [op, right] : tally.rightOf) {
        CAPTURE(static_cast<int>(op));
        CHECK(right > 0);
    }
    CHECK(tally.partial > 0);
    CHECK(tally.frameErrors > 0);
    CHECK(tally.transportErrors > 0);
}

} // namespace

TEST_CASE("Disturbed frames end in the right image or in an error of dfb", "[faults]")
{
    check(faultGroups(1, repeats(2000)), repeats(2000));
}

TEST_CASE("Many more disturbed frames", "[faults][.stress]") { check(faultGroups(100000, 40000), 40000); }

} // namespace faults_cases
