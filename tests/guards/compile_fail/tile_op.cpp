// An archetype, which has only what a TileOp must have. Each case leaves out one part.
#include <dfb/dfb.hpp>

struct Op {
#if defined(CASE_NO_DEFAULT_CONSTRUCTOR) // expect: dfb: TileOp must provide a default constructor
    explicit Op(int);
#endif

#if defined(CASE_NO_CHANNELS) // expect: dfb: TileOp must provide static constexpr ChannelMask channels
#else
    static constexpr dfb::ChannelMask channels = dfb::colorChannel;
#endif

#if defined(CASE_LARGE_TILES) // expect: dfb: the tile size of a TileOp must be 8 to 256 pixels
    static constexpr int tileSize = 512;
#endif

#if defined(CASE_BY_DEPTH_WITHOUT_DEPTH) // expect: dfb: a TileOp with activeByDepth must have depthChannel
    static constexpr bool activeByDepth = true;
#endif

#if defined(CASE_NO_NEW_FRAME) // expect: dfb: TileOp must provide void newFrame(const TileInfo&)
#elif defined(CASE_WRONG_NEW_FRAME) // expect: dfb: TileOp must provide void newFrame(const TileInfo&)
    void newFrame(int);
#else
    void newFrame(const dfb::TileInfo&);
#endif

#if defined(CASE_LEAVES_FRAME_DATA) // expect: dfb: a TileOp with a FrameData must provide void newFrame(const TileInfo&, const FrameData&)
    struct FrameData {};
#endif

#if defined(CASE_NO_ADD) // expect: dfb: TileOp must provide void add(Fragment&&)
#elif defined(CASE_WRONG_ADD) // expect: dfb: TileOp must provide void add(Fragment&&)
    void add(dfb::Fragment&);
#else
    void add(dfb::Fragment&&);
#endif

#if defined(CASE_NO_FINISH) // expect: dfb: TileOp must provide void finish(FinishedTile&)
#elif defined(CASE_WRONG_FINISH) // expect: dfb: TileOp must provide void finish(FinishedTile&)
    void finish();
#else
    void finish(dfb::FinishedTile&);
#endif
};

template class dfb::DistributedFrameBuffer<Op, dfb::NoPixelOp, dfb::InprocTransport>;
