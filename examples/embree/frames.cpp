// Frames where each rank has a part of the scene. frames_single.cpp has those where each rank has the whole scene.
#include "frames_by.hpp"

namespace example {

std::unique_ptr<RunFrames> makeFrames(std::shared_ptr<dfb::Connection> connection, const Options& options,
                                      const dfb::FrameBufferConfig& config, dfb::testing::Verification& verification)
{
    constexpr LoopOver bricks = LoopOver::Bricks;
    const auto make = [&](auto function) { return function(std::move(connection), options, config, verification); };
    switch (compositingOf(options)) {
    case Compositing::Single:
    case Compositing::SingleVerified:
    case Compositing::SingleAdaptive: return make(makeSingleFrames);
    case Compositing::SortVerified: return make(framesBy<bricks, dfb::testing::Verified<Blend>>);
    case Compositing::SortAdaptive: // samples are saved tile by tile: smaller tiles save more
        return make(framesBy<bricks, dfb::Progressive<dfb::BasicAlphaBlend<16, tileChannels>>>);
    case Compositing::Order: return make(framesBy<LoopOver::BricksInOrder, Ordered>);
    case Compositing::Nearest: return make(framesBy<bricks, dfb::BasicDepthComposite<64, tileChannels>>);
    case Compositing::Deep: return make(framesBy<LoopOver::DeepBricks, dfb::DeepBlend>);
    case Compositing::Sort: break;
    }
    return make(framesWithPixelOp<bricks, Blend>);
}

} // namespace example
