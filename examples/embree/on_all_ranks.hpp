// onAllRanks(): a step of all ranks, after which they know whether it has succeeded on all.
#pragma once

#include "text.hpp"

#include <dfb/frame.hpp>

#include <cstdio>
#include <exception>
#include <string>

namespace example {

// Runs `step` on every rank. If it throws on any, the lowest such rank prints why, and all return false. `fb`: a
// framebuffer that has no open frame. Collective.
template <class FrameBuffer, class Step>
bool onAllRanks(FrameBuffer& fb, const Step& step)
{
    std::string error;
    bool failed = false;
    try {
        step();
    } catch (const std::exception& e) {
        error = reasonOf(e);
        failed = true;
    }
    const auto lowest = fb.allReduce({failed ? fb.rank() : fb.size()}, dfb::Reduce::Min).front();
    if (lowest == fb.rank())
        std::fprintf(stderr, "dfb_render: %s\n", error.c_str());
    return lowest == fb.size();
}

} // namespace example
