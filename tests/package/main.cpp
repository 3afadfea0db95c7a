// Uses each component that should be there. With WITH_FRAME it includes all of dfb and renders a frame on two ranks,
// which are threads; this takes most of the compile time.
#if WITH_FRAME
#include <dfb/dfb.hpp>
#else
#include <dfb/comm/compression.hpp>
#include <dfb/exec.hpp>
#if defined(DFB_HAS_MPI)
#include <dfb/comm/mpi_session.hpp>
#endif
#if defined(DFB_HAS_TBB)
#include <dfb/tbb_executor.hpp>
#endif
#if defined(DFB_HAS_SNAPPY)
#include <dfb/comm/snappy_codec.hpp>
#endif
#endif

#include <atomic>
#include <cstddef>
#include <cstdio>
#include <memory>
#include <vector>

#if defined(DFB_HAS_MPI) != EXPECT_MPI || defined(DFB_HAS_TBB) != EXPECT_TBB || defined(DFB_HAS_SNAPPY) != EXPECT_SNAPPY
#error "dfb::dfb has not the components that were asked for"
#endif

#if EXPECT_TESTING
#include <dfb/testing/reference.hpp>
#elif defined(__has_include)
#if __has_include(<dfb/testing/reference.hpp>)
#error "the component 'testing' is there although nobody asked for it"
#endif
#endif

#if WITH_FRAME
using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, dfb::InprocTransport>;

bool frameIsRight(const std::shared_ptr<dfb::Executor>& executor, const std::shared_ptr<const dfb::Codec>& codec)
{
    bool right = true;
    dfb::runRanks(2, [&](const dfb::InprocCommunicator& communicator) {
        FrameBuffer::Config config;
        config.image.width = 100;
        config.image.height = 70;
        config.executor = executor;
        config.messages.codec = codec;
        FrameBuffer fb(communicator, config);
        auto frame = fb.begin();
        FrameBuffer::Tile tile;
        for (int i = 0; i < fb.layout().tileCount(); ++i) {
            if (fb.tileOwner(i) == fb.rank())
                continue; // the other rank's input goes over the wire
            frame.start(tile, i);
            for (int y = 0; y < tile.region.height(); ++y)
                for (int x = 0; x < tile.region.width(); ++x)
                    tile.pixel(x, y)[0] = tile.pixel(x, y)[3] = 1;
            frame.setTile(tile);
        }
        frame.end();
        for (std::size_t i = 0; fb.isDisplayRank() && i < fb.image().pixelCount(); ++i)
            right = right && fb.image().rgba8()[4 * i] == 255 && fb.image().rgba8()[4 * i + 3] == 255;
    });
    return right;
}
#else
bool frameIsRight(const std::shared_ptr<dfb::Executor>& executor, const std::shared_ptr<const dfb::Codec>& codec)
{
    std::atomic<int> tasks{0};
    if (executor)
        executor->parallelFor(3, [&](std::size_t) { ++tasks; });
    std::vector<std::byte> packed(codec ? codec->bound(100) : 0), in(100), out(100, std::byte{1});
    if (codec) {
        const std::size_t byteCount = codec->compress(in.data(), in.size(), packed.data());
        codec->decompress(packed.data(), byteCount, out.data(), out.size());
    }
    return tasks == (executor ? 3 : 0) && (!codec || in == out);
}
#endif

int main()
{
    std::shared_ptr<dfb::Executor> executor;
    std::shared_ptr<const dfb::Codec> codec;
#if EXPECT_TBB
    executor = std::make_shared<dfb::TbbExecutor>(2);
#endif
#if EXPECT_SNAPPY
    codec = std::make_shared<dfb::SnappyCodec>();
#endif
    bool right = frameIsRight(executor, codec);

#if EXPECT_TESTING
    right = right && dfb::testing::composite({}, {1, 0, 0, 1}).rgba[0] == 1;
#endif

#if EXPECT_MPI
    int initialized = 1;
    right = right && MPI_Initialized(&initialized) == MPI_SUCCESS && !initialized;
#endif

    std::puts(right ? "ok" : "the image is wrong");
    return right ? 0 : 1;
}
