// sendAll: sends the inputs of a scene with setTile(), without a rendering loop.
#pragma once

#include "random_scene.hpp"

#include <memory>

namespace frame_cases {

// Sends this rank's inputs of every second tile into an open frame, as in Listing 3 of the paper.
template <class FrameBuffer, class Frame>
void sendAll(FrameBuffer& fb, Frame& frame, const scene::Scene& s, bool second)
{
    const auto mine = bricksOf(s, fb.rank(), fb.size());
    const auto tile = std::make_unique<typename FrameBuffer::Tile>();
    for (int index = second ? 1 : 0; index < fb.layout().tileCount(); index += 2) { // even or odd tiles
        if (fb.tileOwner(index) == fb.rank())
            scene::sendParent(frame, *tile, index, scene::bricksIn(fb, s, index));
        for (const dfb::Brick& b : mine)
            if (scene::meets(fb, b, index))
                scene::sendInput(frame, *tile, s, b, index);
    }
}

} // namespace frame_cases
