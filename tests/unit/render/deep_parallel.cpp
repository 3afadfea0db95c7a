#include "catch.hpp"

#include <dfb/comm/inproc_transport.hpp>
#include <dfb/distributed_framebuffer.hpp>
#include <dfb/render/deep_parallel.hpp>

#include <limits>
#include <memory>
#include <utility>
#include <vector>

TEST_CASE("A deep tile keeps 1 to 65535 segments a pixel")
{
    CHECK(dfb::DeepTile(0).maxSegments() == 1);
    CHECK(dfb::DeepTile(65536).maxSegments() == 65535);

    dfb::DeepTile deep(65536);
    dfb::TileHeader header;
    header.region = {0, 0, 1, 1};
    deep.reset(header);
    for (int i = 0; i < 65536; ++i) {
        const auto from = static_cast<float>(i);
        deep.add(0, 0, {{0.1f, 0, 0, 0.1f}, from, from + 0.5f});
    }
    CHECK(deep.layers() == 65535);
    auto front = std::make_unique<dfb::Tile<dfb::allChannels, 8>>();
    front->clear();
    deep.writeLayer(0, *front);
    CHECK(front->depth[0] == 0);
}

TEST_CASE("A loop of deep tiles refuses a number of segments that a tile cannot keep")
{
    dfb::runRanks(1, [](dfb::InprocCommunicator communicator) {
        using FrameBuffer = dfb::DistributedFrameBuffer<dfb::DeepBlend, dfb::NoPixelOp, dfb::InprocTransport>;
        FrameBuffer fb(communicator, dfb::FrameBufferConfig(8, 8));
        const dfb::World world;
        for (const int segments : {0, 65536})
            CHECK_THROWS_AS(dfb::DeepParallelLoop<FrameBuffer>(fb, world, segments), dfb::InvalidArgument);
    });
}

TEST_CASE("The error bound of a deep tile holds for alpha above 1")
{
    for (const float alpha : {0.5f, 1.5f, 3.0f}) {
        dfb::DeepTile deep(2);
        dfb::TileHeader header;
        header.region = {0, 0, 1, 1};
        deep.reset(header);
        deep.add(0, 0, {{alpha, 0, 0, alpha}, 0, 0.5f});
        deep.add(0, 0, {{0, 0.25f, 0, 0.25f}, 1, 1.5f});
        deep.add(0, 0, {{0, 0, 0.5f, 0.5f}, 3, 3.5f});
        CHECK(deep.errorBound() > 0);
    }
}

TEST_CASE("A segment of depth NaN is sorted as one at infinity, whenever it comes")
{
    const float nan = std::numeric_limits<float>::quiet_NaN();
    const dfb::Segment first{{0.9f, 0, 0, 0.9f}, 1, 1}, second{{0, 0.3f, 0, 0.3f}, 2, 2},
        last{{0, 0, 0.5f, 0.5f}, nan, nan};
    for (const auto& order : {std::vector{last, first, second}, {first, last, second}, {second, first, last}}) {
        dfb::DeepTile deep(3);
        dfb::TileHeader header;
        header.region = {0, 0, 1, 1};
        deep.reset(header);
        for (const dfb::Segment& segment : order)
            deep.add(0, 0, segment);
        auto layer = std::make_unique<dfb::Tile<dfb::allChannels, 8>>();
        for (int i = 0; i < 3; ++i) {
            layer->clear();
            deep.writeLayer(i, *layer);
            CHECK(layer->color[i] > 0);
        }
    }
}

TEST_CASE("Segments of equal depth keep their order, and NaN equals infinity")
{
    const float nan = std::numeric_limits<float>::quiet_NaN(), infinity = std::numeric_limits<float>::infinity();
    for (const auto& [first, second] : {std::pair{2.0f, 2.0f}, {nan, infinity}, {infinity, nan}}) {
        dfb::DeepTile deep(2);
        dfb::TileHeader header;
        header.region = {0, 0, 1, 1};
        deep.reset(header);
        deep.add(0, 0, {{0.5f, 0, 0, 0.5f}, first, first});
        deep.add(0, 0, {{0, 0.5f, 0, 0.5f}, second, second});
        auto front = std::make_unique<dfb::Tile<dfb::allChannels, 8>>();
        front->clear();
        deep.writeLayer(0, *front);
        CHECK(front->color[0] == 0.5f);
    }
}
