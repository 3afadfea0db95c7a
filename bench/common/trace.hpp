// Trace: the option --trace FILE of a benchmark.
#pragma once

#include <dfb/trace_file.hpp>

#include <memory>
#include <string>
#include <utility>

namespace bench {

// A trace of the framebuffers of one connection on this rank, whose configuration gets `sink`. With an empty path there
// is no trace.
struct Trace {
    explicit Trace(std::string file)
        : sink(file.empty() ? nullptr : std::make_shared<dfb::TraceFile>()), path(std::move(file))
    {
    }

    // Writes the file if there is to be one. `fb`: any of the framebuffers. Collective.
    template <class FrameBuffer>
    void write(FrameBuffer& fb) const
    {
        if (sink)
            sink->write(fb, path);
    }

    std::shared_ptr<dfb::TraceFile> sink; // or null
    std::string path;
};

} // namespace bench
