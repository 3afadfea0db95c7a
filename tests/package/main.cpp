// A frame over two ranks that are threads, and one use of each component that should be there.
#include <dfb/dfb.hpp>

#include <cstdio>
#include <vector>

#if defined(DFB_HAS_MPI) != EXPECT_MPI || defined(DFB_HAS_TBB) != EXPECT_TBB || defined(DFB_HAS_SNAPPY) != EXPECT_SNAPPY
#error "dfb::dfb has not the components that were asked for"
#endif

using FrameBuffer = dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, dfb::InprocTransport>;

int main()
{
    bool right = true;
    dfb::runRanks(2, [&](const dfb::InprocCommunicator& communicator) {
        FrameBuffer::Config config;
        config.width = 100;
        config.height = 70;
#if EXPECT_TBB
        config.executor = std::make_shared<dfb::TbbExecutor>(2);
#endif
#if EXPECT_SNAPPY
        config.codec = std::make_shared<dfb::SnappyCodec>();
#endif
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

#if EXPECT_MPI
    int initialized = 1;
    right = right && MPI_Initialized(&initialized) == MPI_SUCCESS && !initialized;
#endif

    std::puts(right ? "ok" : "the image is wrong");
    return right ? 0 : 1;
}
