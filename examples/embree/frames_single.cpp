// Frames where every rank has the whole scene.
#include "frames_by.hpp"

namespace example {

std::unique_ptr<RunFrames> makeSingleFrames(std::shared_ptr<dfb::Connection> connection, const Options& options,
                                            const dfb::FrameBufferConfig& config,
                                            dfb::testing::Verification& verification)
{
    constexpr LoopOver tiles = LoopOver::Tiles;
    const auto make = [&](auto function) { return function(std::move(connection), options, config, verification); };
    switch (compositingOf(options)) {
    case Compositing::SingleVerified: return make(framesBy<tiles, dfb::testing::Verified<Single>>);
    case Compositing::SingleAdaptive: // samples are saved tile by tile: smaller tiles save more
        return make(framesBy<tiles, dfb::Progressive<dfb::BasicImageParallel<16, tileChannels>>>);
    default: return make(framesWithPixelOp<tiles, Single>);
    }
}

} // namespace example
