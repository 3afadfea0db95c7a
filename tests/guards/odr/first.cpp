// With second.cpp: a function in a header that is neither a template nor inline would be defined twice.
#include <dfb/dfb.hpp>
#include <dfb/trace_file.hpp>

template class dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, dfb::InprocTransport>;
#if defined(DFB_HAS_MPI)
template class dfb::DistributedFrameBuffer<dfb::AlphaBlend>;
#endif

int second();

int main()
{
    return second();
}
