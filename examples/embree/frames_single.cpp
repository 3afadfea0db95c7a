// dfb_render where every rank has the whole scene.
#include "rank_run.hpp"
#include "run.hpp"

namespace example {

int runImageParallel(std::shared_ptr<dfb::Connection> connection, const char* transport, const Options& o, int threads)
{
    const auto run = [&](auto tileOp, auto pixelOp) {
        return runWith<decltype(tileOp), decltype(pixelOp)>(std::move(connection), transport, o, threads);
    };
    if (o.verify)
        return run(VerifiedSingle(), dfb::NoPixelOp());
    if (o.adaptive > 0)
        return run(AdaptiveSingle(), dfb::NoPixelOp());
    if (o.wallColumns > 0 && o.exposure > 0)
        return run(Single(), ToneMapToWall());
    if (o.wallColumns > 0)
        return run(Single(), dfb::ToWall());
    if (o.exposure > 0)
        return run(Single(), dfb::ToneMap());
    return run(Single(), dfb::NoPixelOp());
}

} // namespace example
