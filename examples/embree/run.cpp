// dfb_render over MPI, and with threads as ranks. Image-parallel runs are compiled in run_image.cpp.
#include "run.hpp"
#include "rank_run.hpp"

namespace example {

namespace {

bool isImageParallel(const Options& o)
{
    return o.mode == Mode::Image && o.deep == 0 && o.interleave <= 1
           && (o.verify || (o.blend != Blending::Order && o.blend != Blending::Nearest));
}

// Picks the operations that the options ask for.
int runOver(std::shared_ptr<dfb::Connection> connection, const char* transport, const Options& o, int threads)
{
    if (o.live)
        return runLive(std::move(connection), o, threads);
    if (isImageParallel(o))
        return runImageParallel(std::move(connection), transport, o, threads);
    const auto run = [&](auto tileOp, auto pixelOp) {
        return runWith<decltype(tileOp), decltype(pixelOp)>(std::move(connection), transport, o, threads);
    };
    if (o.deep > 0 || o.interleave > 1)
        return run(dfb::DeepBlend(), dfb::NoPixelOp());
    if (o.verify)
        return run(VerifiedBlend(), dfb::NoPixelOp());
    if (o.blend == Blending::Order)
        return run(Ordered(), dfb::NoPixelOp());
    if (o.blend == Blending::Nearest)
        return run(Nearest(), dfb::NoPixelOp());
    if (o.adaptive > 0)
        return run(AdaptiveBlend(), dfb::NoPixelOp());
    if (o.wallColumns > 0 && o.exposure > 0)
        return run(Blend(), ToneMapToWall());
    if (o.wallColumns > 0)
        return run(Blend(), dfb::ToWall());
    if (o.exposure > 0)
        return run(Blend(), dfb::ToneMap());
    return run(Blend(), dfb::NoPixelOp());
}

} // namespace

int runInproc(const dfb::InprocCommunicator& communicator, const Options& options, int threads)
{
    return runOver(dfb::connect<dfb::InprocTransport>(communicator, networkOf(options)), dfb::InprocTransport::name,
                   options, threads);
}

#if defined(DFB_HAS_MPI)
int runMpi(MPI_Comm communicator, const Options& options, int threads)
{
    return runOver(dfb::connect<dfb::MpiTransport>(communicator, networkOf(options)), dfb::MpiTransport::name, options,
                   threads);
}
#endif

} // namespace example
