#include <dfb/dfb.hpp>

template class dfb::DistributedFrameBuffer<dfb::ImageParallel, dfb::ToneMap, dfb::InprocTransport>;
#if defined(DFB_HAS_MPI)
template class dfb::DistributedFrameBuffer<dfb::ImageParallel, dfb::ToneMap>;
#endif

int second()
{
    return 0;
}
