# cmake "-DROOTS=<folder that holds dfb/>;..." -P layers.cmake
# Checks that the includes of the headers keep the layers of the library. A new header must be added to the table below.
cmake_minimum_required(VERSION 3.21)

# A header includes only headers of a strictly lower level.
set(level_0 version.hpp)
set(level_1 base/cpu.hpp base/detect.hpp base/fifo.hpp base/function_ref.hpp base/processors.hpp channels.hpp
            comm/quiescence.hpp compiled.hpp frame/hidden_tiles.hpp fwd.hpp testing/reference.hpp trace.hpp)
set(level_2 base/double_double.hpp blend/composite_row.hpp buffer.hpp comm/compression.hpp comm/heartbeat.hpp error.hpp
            testing/error_report.hpp wire/wire_kernels.hpp)
set(level_3 blend/background_pixels.hpp blend/blend_kernels.hpp blend/sort_kernels.hpp comm/message.hpp
            comm/mpi_calls.hpp comm/node_memory.hpp comm/packet.hpp comm/snappy_codec.hpp comm/transport.hpp exec.hpp
            gather/image_gate.hpp levels.hpp render/world.hpp wire/wire_format.hpp)
set(level_4 blend/compositing.hpp comm/flow_control.hpp comm/mpi_ranks.hpp comm/mpi_session.hpp comm/progress.hpp
            comm/reduction.hpp frame/open_frame.hpp image.hpp tbb_executor.hpp testing/detail/conformance_tools.hpp
            trace_file.hpp)
set(level_5 comm/connection.hpp testing/transport_conformance.hpp tile.hpp wire/active_pixels.hpp)
set(level_6 blend/in_place_kernels.hpp comm/inproc_transport.hpp comm/mailbox.hpp comm/mpi_transport.hpp
            dependency_tracker.hpp fragment.hpp tile_layout.hpp)
set(level_7 blend/fragment_compositor.hpp frame.hpp testing/fault_transport.hpp tile_op.hpp
            wire/sparse_planes.hpp wire/wire_losses.hpp)
set(level_8 frame/declarations.hpp ops/sort_last.hpp pixel_op.hpp render/link_owners.hpp
            render/sampling.hpp render/visibility.hpp wire/finished_record.hpp wire/fragment_message.hpp)
set(level_9 frame/operations.hpp gather/final_gather.hpp ops/image_parallel.hpp ops/progressive.hpp render/cameras.hpp
            testing/tile_op_test.hpp testing/verified.hpp)
set(level_10 frame/accumulation.hpp frame/agreement.hpp frame/engine.hpp frame/tile_table.hpp
            render/shared_world.hpp testing/adversarial.hpp)
set(level_11 frame/tile_pipeline.hpp frame/verdict.hpp gather/wall.hpp)
set(level_12 display_wall.hpp frame/outcome.hpp render/loops.hpp)
set(level_13 frame/job_share.hpp render/deep_parallel.hpp render/mixed_parallel.hpp)
set(level_14 frame/frame_engine.hpp)
set(level_15 distributed_framebuffer.hpp image_compositor.hpp)
set(level_16 dfb.hpp)
set(last_level 16)

# A dependency is included through a single header, its door.
set(door_of_mpi comm/mpi_calls.hpp)
set(door_of_snappy comm/snappy_codec.hpp)
set(door_of_tbb tbb_executor.hpp)

# The MPI calls that the library makes. They do not wait for other ranks: in calls that wait, MPI libraries spin, hold
# their lock, and wait for ever for a rank that has failed. Only MpiSession may call MPI_Finalize(). "Request" is a
# type.
set(calls_of_mpi
    Abort Cancel Comm_create_keyval Comm_delete_attr Comm_free Comm_free_keyval Comm_get_attr Comm_idup
    Comm_rank Comm_set_attr Comm_set_errhandler Comm_size Comm_test_inter Error_class Error_string Finalize
    Get_count Get_processor_name Iallgather Iallreduce Ialltoall Ibarrier Ibcast Init_thread Irecv Isend Issend
    Query_thread Request Test Test_cancelled Testall Testsome)

# Headers that must not include others, even indirectly. Rooms are folders. Of the headers at the root, those that
# define a tile and what is made of it count as pixels.
set(pixels "^((image|levels|tile|tile_layout|fragment|dependency_tracker|channels|tile_op|pixel_op)|(blend|ops)/.*)\\.hpp$")
set(messages "^(comm)/.*\\.hpp$")
set(loops "^(render)/.*\\.hpp$")
set(frames "^(frame|gather)/.*\\.hpp$")
set(doors "^(frame|display_wall|distributed_framebuffer)\\.hpp$")
set(threads "^(exec|tbb_executor)\\.hpp$")

set(headers "")
foreach(root IN LISTS ROOTS)
  file(GLOB_RECURSE found RELATIVE ${root}/dfb ${root}/dfb/*.hpp)
  if(NOT found)
    message(FATAL_ERROR "no headers in ${root}/dfb")
  endif()
  list(APPEND headers ${found})
  foreach(header IN LISTS found)
    set("root_of_${header}" ${root})
  endforeach()
endforeach()

foreach(level RANGE ${last_level})
  foreach(header IN LISTS level_${level})
    if(DEFINED "level_of_${header}")
      message(SEND_ERROR "${header}: twice in the level table")
    endif()
    set("level_of_${header}" ${level})
    if(NOT DEFINED "root_of_${header}")
      message(SEND_ERROR "${header}: in the level table, but there is no such header")
    endif()
  endforeach()
endforeach()

foreach(header IN LISTS headers)
  set("includes_of_${header}" "")
  if(NOT DEFINED "level_of_${header}")
    message(SEND_ERROR "${header}: not in the level table of tests/guards/layers.cmake")
    continue()
  endif()

  file(STRINGS ${root_of_${header}}/dfb/${header} lines REGEX "^[ \t]*#[ \t]*include")
  foreach(line IN LISTS lines)
    if(NOT line MATCHES "include[ \t]*<([^>]*)>")
      message(SEND_ERROR "${header}: '${line}': includes are written with <>")
      continue()
    endif()
    set(target ${CMAKE_MATCH_1})

    set(dependency "")
    if(target MATCHES "^mpi\\.h$")
      set(dependency mpi)
    elseif(target MATCHES "^snappy")
      set(dependency snappy)
    elseif(target MATCHES "^(tbb|oneapi)/")
      set(dependency tbb)
    endif()
    if(dependency AND NOT header STREQUAL door_of_${dependency})
      message(SEND_ERROR "${header}: includes <${target}>; the door of ${dependency} is ${door_of_${dependency}}")
    endif()

    if(target MATCHES "^dfb/(.*)")
      set(target ${CMAKE_MATCH_1})
      list(APPEND "includes_of_${header}" ${target})
      if(NOT DEFINED "level_of_${target}")
        message(SEND_ERROR "${header}: includes ${target}, which is not in the level table")
      elseif(NOT "${level_of_${target}}" LESS "${level_of_${header}}")
        message(SEND_ERROR "${header} (level ${level_of_${header}}) includes ${target} (level ${level_of_${target}}): "
          "includes point down")
      endif()
    endif()
  endforeach()

  file(STRINGS ${root_of_${header}}/dfb/${header} lines REGEX "MPI_[A-Z][a-z_]+\\(")
  foreach(line IN LISTS lines)
    string(REGEX REPLACE "//.*$|\"[^\"]*\"" "" line "${line}")
    string(REGEX MATCHALL "MPI_[A-Z][a-z_]+\\(" calls "${line}")
    foreach(call IN LISTS calls)
      string(REGEX REPLACE "MPI_(.*)\\(" "\\1" call "${call}")
      if(NOT call IN_LIST calls_of_mpi)
        message(SEND_ERROR "${header}: MPI_${call} may wait for other ranks")
      endif()
    endforeach()
  endforeach()

  file(STRINGS ${root_of_${header}}/dfb/${header} found REGEX "^[ \t]*using[ \t]+namespace")
  if(found)
    message(SEND_ERROR "${header}: 'using namespace' in a header")
  endif()
  file(STRINGS ${root_of_${header}}/dfb/${header} found REGEX "^#pragma once$")
  if(NOT found)
    message(SEND_ERROR "${header}: no '#pragma once'")
  endif()
endforeach()

# reached: all headers that `header` includes, directly or indirectly
function(collect header)
  foreach(target IN LISTS "includes_of_${header}")
    if(NOT target IN_LIST reached)
      list(APPEND reached ${target})
      collect(${target})
    endif()
  endforeach()
  set(reached ${reached} PARENT_SCOPE)
endfunction()

function(check_blind who whom)
  foreach(header IN LISTS headers)
    if(header MATCHES "${${who}}")
      set(reached "")
      collect(${header})
      foreach(target IN LISTS reached)
        if(target MATCHES "${${whom}}")
          message(SEND_ERROR "${header} reaches ${target}: ${who} must not know ${whom}")
        endif()
      endforeach()
    endif()
  endforeach()
endfunction()
check_blind(pixels messages)
check_blind(pixels frames)
check_blind(pixels threads)
check_blind(messages pixels)
check_blind(messages frames)
check_blind(loops frames)
check_blind(pixels doors)
check_blind(messages loops)
