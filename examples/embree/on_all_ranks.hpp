// onAllRanks(): a step of all ranks, after which they know whether it has succeeded on all. loadersOf(): what ranks
// load together.
#pragma once

#include "loaders.hpp"
#include "text.hpp"

#include <dfb/framebuffer_base.hpp>

#include <cstdint>
#include <cstdio>
#include <exception>
#include <functional>
#include <string>
#include <vector>

namespace example {

// Runs `step` on every rank. If it throws on any, the lowest such rank prints why, and all return false. `fb`: a
// framebuffer that has no open frame. Collective.
inline bool onAllRanks(dfb::FrameBufferBase& fb, const std::function<void()>& step)
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

// Loaders on the ranks of a framebuffer, which must outlive them. No frame may be open while they load.
inline Loaders loadersOf(dfb::FrameBufferBase& fb)
{
    return Loaders(
        fb.rank(), fb.size(), [&fb](const Loaders::Bytes& bytes) { return fb.allGather(bytes); },
        [&fb](const std::vector<std::int64_t>& values) { return fb.allReduce(values, dfb::Reduce::Sum); });
}

} // namespace example
