// Good frames on ranks and networks that are slow at random, while ranks check all the time whether anything is still
// under way. None of them may be taken for a frame that misses an input; frames that do miss one must be found. Ranks
// are threads.
#include "catch.hpp"
#include "random_scene.hpp"

#include "send_all.hpp"

#include <dfb/testing/fault_transport.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <deque>
#include <memory>
#include <mutex>
#include <optional>
#include <random>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace quiet_stress_cases {

namespace {

using Transport = dfb::testing::FaultTransport<dfb::InprocTransport>;

// An operation that now and then takes some ms to finish a tile.
std::atomic<std::uint64_t> tilesFinished{0};
class SlowBlend : public dfb::BasicAlphaBlend<16> {
public:
    void finish(dfb::FinishedTile& out)
    {
        if (scene::mix(++tilesFinished) % 64 == 0)
            std::this_thread::sleep_for(std::chrono::microseconds(scene::mix(tilesFinished) % 5000));
        BasicAlphaBlend::finish(out);
    }
};
using FrameBuffer = dfb::DistributedFrameBuffer<SlowBlend, dfb::NoPixelOp, Transport>;

struct Outcome {
    int frames = 0, found = 0; // good frames; frames that miss an input and were found
    std::string wrong;
    std::int64_t looks = 0; // messages of the rounds in which ranks check
};

// Renders frames on `ranks` ranks. Random choices are the same on all ranks, but for the times that each waits.
Outcome frames(std::uint64_t seed, int ranks, int threads, int inFlight, int count)
{
    Outcome outcome;
    std::mutex mutex;
    std::atomic<std::int64_t> looks{0};
    const scene::Scene s = scene::makeScene(4, seed, 65, 49);
    const std::vector<dfb::testing::Pixel> expected = referenceOf(s);
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator inner) {
        dfb::testing::FaultOptions faults;
        faults.seed = seed;
        faults.delay = 0.05;
        faults.reorder = 0.05;
        faults.duplicate = 0.01;
        faults.maxDelay = std::chrono::microseconds(500 << seed % 6);
        faults.only = [&](int, const dfb::Buffer& message) {
            const auto header = dfb::detail::loadAs<dfb::detail::MessageHeader>(message.data());
            const bool isReduction = header.kind == dfb::detail::MessageKind::ReduceUp;
            looks +=
                isReduction && dfb::detail::loadAs<std::uint32_t>(message.data() + sizeof header) == ~std::uint32_t{0};
            return true;
        };
        auto config = configOf(s, threads);
        config.quiet = std::chrono::milliseconds(1);
        config.framesInFlight = inFlight;
        dfb::NetworkConfig options;
        options.progress = threads > 0 ? dfb::Progress::Thread : dfb::Progress::Caller;
        FrameBuffer fb({inner, faults}, config, options);
        std::mt19937_64 same(seed), own(seed * 31 + static_cast<std::uint64_t>(fb.rank()));
        const auto dawdle = [&] { // mostly not
            if (own() % 4 == 0)
                std::this_thread::sleep_for(std::chrono::microseconds(own() % (own() % 8 == 0 ? 12000 : 2000)));
        };
        const auto says = [&](const std::string& what) {
            const std::lock_guard<std::mutex> lock(mutex);
            if (outcome.wrong.size() < 2000)
                outcome.wrong += "rank " + std::to_string(fb.rank()) + ": " + what + "\n";
        };
        std::deque<std::pair<FrameBuffer::Frame, bool>> open; // and whether it misses an input
        const auto end = [&] {
            auto [frame, misses] = std::move(open.front());
            open.pop_front();
            dawdle();
            try {
                const dfb::FrameReport report = frame.end();
                if (misses)
                    says("no error");
                else if (fb.isDisplayRank())
                    wrongValues(scene::Picture(fb.image(), report), expected) == 0 ? void(++outcome.frames)
                                                                                   : says("values");
            } catch (const dfb::FrameError& e) {
                if (!misses || e.info().kind != dfb::ErrorKind::MissingInput)
                    says(e.what());
                else if (fb.isDisplayRank())
                    ++outcome.found;
            }
        };
        for (int i = 0; i < count; ++i) {
            if (open.size() == static_cast<std::size_t>(inFlight))
                end();
            const bool misses = same() % 16 == 0, declared = same() % 2 == 0;
            dawdle();
            auto params = paramsOf(s);
            params.declared = declared;
            open.emplace_back(fb.begin(params), misses);
            auto& frame = open.back().first;
            if (!declared) {
                frame_cases::sendAll(fb, frame, s, false);
                dawdle();
                if (!misses || fb.rank() > 0)
                    frame_cases::sendAll(fb, frame, s, true);
                continue;
            }
            const auto mine = bricksOf(s, fb.rank(), fb.size());
            std::vector<dfb::TileInput> inputs;
            for (int tile = 0; tile < fb.layout().tileCount(); ++tile)
                for (const dfb::Brick& b : mine)
                    if (scene::meets(fb, b, tile))
                        inputs.push_back({tile, b.id, 0});
            const bool declaresFirst = own() % 2 == 0;
            if (declaresFirst)
                frame.declare(inputs);
            const auto tile = std::make_unique<FrameBuffer::Tile>();
            const std::size_t sent = inputs.size() - (misses && fb.rank() == 0); // rank 0 has a brick
            for (std::size_t k = 0; k < sent; ++k) {
                if (k % 8 == 0)
                    dawdle();
                frame.start(*tile, inputs[k].tile);
                tile->generation = 1;
                tile->source = inputs[k].source;
                const auto brick = std::find_if(mine.begin(), mine.end(),
                                                [&](const dfb::Brick& b) { return b.id == inputs[k].source; });
                renderBrick(s, *brick, *tile);
                frame.setTile(*tile);
            }
            dawdle();
            if (!declaresFirst)
                frame.declare(inputs);
        }
        while (!open.empty())
            end();
    });
    outcome.looks = looks;
    return outcome;
}

void stress(int count, std::uint64_t seeds)
{
    Outcome all;
    for (std::uint64_t seed = 1; seed <= seeds; ++seed) {
        const int ranks = 1 + static_cast<int>(seed % 5);
        const Outcome o = frames(seed, ranks, static_cast<int>(seed % 3), 1 + static_cast<int>(seed / 2 % 3), count);
        INFO("seed " << seed << ", " << ranks << " ranks");
        CHECK(o.wrong == "");
        CHECK(o.frames + o.found == count);
        all.frames += o.frames;
        all.found += o.found;
        all.looks += o.looks;
    }
    INFO(all.frames << " frames, " << all.found << " that missed an input, " << all.looks << " messages of rounds");
    CHECK(all.found > 0);
    CHECK(all.looks > all.frames / 10); // otherwise the ranks check too seldom for this test
}

} // namespace

TEST_CASE("However slow ranks and messages are, a frame that gets all its inputs is not said to miss one", "[quiet]")
{
    stress(25, 6);
}

TEST_CASE("The same for a long time", "[.stress][quiet]") { stress(400, 60); }

} // namespace quiet_stress_cases
