// dfb_render with a live view.
#include "live_run.hpp"
#include "run.hpp"

namespace example {

int runLive(std::shared_ptr<dfb::Connection> connection, const Options& o, int threads)
{
    if (o.mode == Mode::Image)
        return LiveRun<LiveSingle>(std::move(connection), o, threads).run();
    return LiveRun<LiveBlend>(std::move(connection), o, threads).run();
}

} // namespace example
