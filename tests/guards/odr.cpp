// Includes all of dfb, and instantiates the framebuffer: see guards.cmake.
#include <dfb/dfb.hpp>
#include <dfb/trace_file.hpp>

template class dfb::DistributedFrameBuffer<dfb::AlphaBlend, dfb::NoPixelOp, dfb::InprocTransport>;
#if defined(DFB_HAS_MPI)
template class dfb::DistributedFrameBuffer<dfb::AlphaBlend>;
#endif

int main()
{
    return 0;
}
