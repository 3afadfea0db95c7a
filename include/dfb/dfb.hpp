// All that most programs need; dfb/trace_file.hpp and parts of dfb/blend/ are left out. MPI, oneTBB and Snappy are
// included if DFB_HAS_MPI, DFB_HAS_TBB and DFB_HAS_SNAPPY are defined. The CMake targets dfb::mpi, dfb::tbb and
// dfb::snappy define them; see also version.hpp.
#pragma once

#include <dfb/comm/inproc_transport.hpp>
#include <dfb/display_wall.hpp>
#include <dfb/distributed_framebuffer.hpp>
#include <dfb/image_compositor.hpp>
#include <dfb/ops/image_parallel.hpp>
#include <dfb/ops/progressive.hpp>
#include <dfb/ops/sort_last.hpp>
#include <dfb/pixel_op.hpp>
#include <dfb/render/brick_owners.hpp>
#include <dfb/render/cameras.hpp>
#include <dfb/render/deep_parallel.hpp>
#include <dfb/render/loops.hpp>
#include <dfb/render/mixed_parallel.hpp>
#include <dfb/render/sampling.hpp>

#if defined(DFB_HAS_MPI)
#include <dfb/comm/mpi_session.hpp>
#include <dfb/comm/mpi_transport.hpp>
#endif
#if defined(DFB_HAS_TBB)
#include <dfb/tbb_executor.hpp>
#endif
#if defined(DFB_HAS_SNAPPY)
#include <dfb/comm/snappy_codec.hpp>
#endif
