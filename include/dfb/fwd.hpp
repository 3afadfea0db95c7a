// Declarations of the main types, and the default template arguments, which are stated here and nowhere else.
#pragma once

#include <dfb/version.hpp>

DFB_NAMESPACE_BEGIN

struct NoPixelOp;      // pixel_op.hpp
class MpiTransport;    // comm/mpi_transport.hpp
class InprocTransport; // comm/inproc_transport.hpp
class Executor;        // exec.hpp
class Image;           // image.hpp
class Connection;      // comm/connection.hpp

template <class TileOp, class PixelOp = NoPixelOp, class Transport = MpiTransport>
class DistributedFrameBuffer; // distributed_framebuffer.hpp

DFB_NAMESPACE_END
