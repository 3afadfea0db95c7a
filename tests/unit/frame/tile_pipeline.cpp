// TilePipeline: which inputs in place an owner accepts.
#include "catch.hpp"

#include <dfb/frame/tile_pipeline.hpp>
#include <dfb/ops/sort_last.hpp>

#include <string>
#include <utility>
#include <vector>

namespace tile_pipeline_cases {

namespace {

using Op = dfb::BasicAlphaBlend<8>;

// The outcome of an input in place, in a frame of one tile.
std::string outcomeOf(const dfb::detail::OperationTraits& traits, dfb::WireFormat format)
{
    namespace d = dfb::detail;
    d::OperationsOf<Op, dfb::NoPixelOp> operations(dfb::NoPixelOp(), traits);
    dfb::FrameBufferConfig config(8, 8);
    config.precision = format;
    d::TilePipeline pipeline(dfb::MemoryPool::create(), config, operations, 0, 1, 0, nullptr, nullptr);
    pipeline.setFarRanks(false);
    const dfb::FrameConfig params;
    pipeline.newFrame(0, params, {}, false);
    const std::vector<float> pixels(4 * 64);
    dfb::TileView<Op::channels, 8> view;
    view.tile = 0;
    view.region = {0, 0, 8, 8};
    view.color = view.depth = pixels.data();
    view.stride = 8;
    d::TileTable::Arrival arrival;
    try {
        pipeline.arrive(pipeline.inputOf(d::InputPixels(view)), 0, arrival);
    } catch (const dfb::Error& e) {
        return e.what();
    }
    return "fine";
}

} // namespace

TEST_CASE("Inputs in place are taken only where they are read in place", "[tile_pipeline]")
{
    const auto traits = dfb::detail::OperationTraits::of<Op, dfb::NoPixelOp>();
    auto copies = traits, keeps = traits;
    copies.readsInPlace = false;
    keeps.keepsState = true;
    CHECK(outcomeOf(traits, dfb::WireFormat::Float32) == "fine");
    const std::string refused = "dfb: malformed message: an input in place, which this rank does not read";
    CHECK(outcomeOf(copies, dfb::WireFormat::Float32) == refused);
    CHECK(outcomeOf(keeps, dfb::WireFormat::Float32) == refused);
    CHECK(outcomeOf(traits, dfb::WireFormat::Unorm8) == refused);
}

} // namespace tile_pipeline_cases
