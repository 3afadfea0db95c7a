// What nearly every test uses, compiled once (instances.cpp) and not in each test's file.
#pragma once

#include <dfb/dfb.hpp>

// The messaging of a transport, and framebuffers over it with a tile operation.
#define DFB_TEST_MESSAGING(how, Transport)                                                                             \
    how template class dfb::Messenger<Transport>;                                                                      \
    how template class dfb::ProgressThread<Transport>;                                                                 \
    how template class dfb::detail::Messaging<Transport>;                                                              \
    how template class dfb::detail::FrameOutcome<Transport>;
#define DFB_TEST_TILES(how, TileOp)                                                                                    \
    how template class dfb::detail::TileTable<TileOp>;                                                                 \
    how template class dfb::detail::TilePipeline<TileOp, dfb::NoPixelOp>;
#define DFB_TEST_FRAMES(how, TileOp, Transport)                                                                        \
    how template class dfb::detail::FrameEngine<TileOp, dfb::NoPixelOp, Transport>;
#define DFB_TEST_INSTANCES(how)                                                                                        \
    DFB_TEST_MESSAGING(how, dfb::InprocTransport)                                                                      \
    DFB_TEST_TILES(how, dfb::BasicAlphaBlend<16>)                                                                      \
    DFB_TEST_FRAMES(how, dfb::BasicAlphaBlend<16>, dfb::InprocTransport)

DFB_TEST_INSTANCES(extern)
#if defined(DFB_HAS_MPI)
#define DFB_TEST_MPI_INSTANCES(how)                                                                                    \
    DFB_TEST_MESSAGING(how, dfb::MpiTransport)                                                                         \
    DFB_TEST_FRAMES(how, dfb::BasicAlphaBlend<16>, dfb::MpiTransport)
DFB_TEST_MPI_INSTANCES(extern)
#endif
