// An archetype, which has only what a PixelOp must have. Each case leaves out one part.
#include <dfb/dfb.hpp>

struct Op {
#if defined(CASE_NO_COPY) // expect: dfb: PixelOp must provide a copy constructor
    Op() = default;
    Op(const Op&) = delete;
#endif

#if defined(CASE_NO_PROCESS) // expect: dfb: PixelOp must provide void process(PixelTile&) const
#elif defined(CASE_PROCESS_NOT_CONST) // expect: dfb: PixelOp must provide void process(PixelTile&) const
    void process(dfb::PixelTile&);
#else
    void process(dfb::PixelTile&) const;
#endif

#if defined(CASE_CHANGES_FRAME_DATA) // expect: dfb: a PixelOp with a FrameData must provide void newFrame(const FrameData&)
    struct FrameData {};
    void newFrame(FrameData&);
#endif
};

template class dfb::DistributedFrameBuffer<dfb::AlphaBlend, Op, dfb::InprocTransport>;
