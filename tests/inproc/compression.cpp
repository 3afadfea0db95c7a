// CompressionMode: the image is the same, and all ranks try and choose alike.
#include "catch.hpp"
#include "scene.hpp"

#include <dfb/dfb.hpp>
#if defined(DFB_HAS_SNAPPY)
#include <dfb/comm/snappy_codec.hpp>

#include <algorithm>
#include <cstdint>
#include <memory>
#include <mutex>
#include <vector>

TEST_CASE("Frames with and without compression take turns until all ranks have chosen", "[compression]")
{
    const scene::Scene s = scene::makeScene(5, 8);
    constexpr int ranks = 3, frames = 40;
    std::vector<std::vector<bool>> compressed(ranks);
    std::vector<std::uint64_t> hashes;
    std::vector<std::int64_t> bytes(2, 0);
    dfb::runRanks(ranks, [&](dfb::InprocCommunicator communicator) {
        auto config = scene::configOf(s);
        config.codec = std::make_shared<dfb::SnappyCodec>();
        config.compression = dfb::CompressionMode::Auto;
        using Fb = dfb::DistributedFrameBuffer<dfb::BasicAlphaBlend<16>, dfb::NoPixelOp, dfb::InprocTransport>;
        Fb fb(communicator, config);
        for (int frame = 0; frame < frames; ++frame) {
            const auto report = scene::renderLoop(fb, s, scene::Loop::Declared, 0, 1);
            compressed[static_cast<std::size_t>(fb.rank())].push_back(report.compressed);
            if (fb.isDisplayRank()) {
                hashes.push_back(scene::Picture(fb.image(), report).hash());
                if (frame > 0)
                    bytes[report.compressed] = report.bytesSent;
            }
        }
    });
    for (const std::vector<bool>& ofRank : compressed)
        CHECK(ofRank == compressed.front());
    const std::vector<bool> first(compressed.front().begin(), compressed.front().begin() + 10);
    CHECK(first == std::vector<bool>{false, true, false, true, false, true, false, true, false, true});
    CHECK(std::count(hashes.begin(), hashes.end(), hashes.front()) == frames);
    CHECK(bytes[1] < bytes[0]);
}
#endif
