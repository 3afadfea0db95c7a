# cmake "-DROOTS=<folder that holds dfb/>;..." -P layers.cmake
# Checks what the include lines of the headers promise. A new header goes into the table below.
cmake_minimum_required(VERSION 3.21)

# A header includes only headers of a strictly lower level.
set(level_0 channels.hpp comm/checksum.hpp comm/compression_gains.hpp comm/compression_trial.hpp detail/fifo.hpp
            detail/hidden_tiles.hpp detail/quiescence.hpp detail/small_bytes.hpp fwd.hpp moments.hpp
            render/tile_loop.hpp testing/reference.hpp version.hpp)
set(level_1 buffer.hpp comm/compression.hpp comm/heartbeat.hpp compiled.hpp cpu.hpp detail/float_environment.hpp
            double_double.hpp error.hpp processors.hpp testing/error_report.hpp)
set(level_2 comm/byte_io.hpp comm/message.hpp comm/node_memory.hpp comm/packet.hpp comm/snappy_codec.hpp
            comm/transport.hpp detail/background_pixels.hpp detail/blend_kernels.hpp detail/image_gate.hpp
            detail/sort_kernels.hpp exec.hpp levels.hpp render/world.hpp wire_codes.hpp)
set(level_3 comm/flow_control.hpp comm/link.hpp comm/reduction.hpp compositing.hpp detail/frame_gate.hpp image.hpp
            detail/active_pixels.hpp tbb_executor.hpp testing/detail/conformance_tools.hpp wire_format.hpp)
set(level_4 comm/progress.hpp dither.hpp render/footprint.hpp testing/transport_conformance.hpp tile.hpp
            wall_layout.hpp)
set(level_5 comm/connection.hpp deep_tile.hpp dependency_tracker.hpp fragment.hpp tile_layout.hpp)
set(level_6 comm/inproc_transport.hpp comm/mailbox.hpp comm/mpi_transport.hpp detail/sparse_planes.hpp
            detail/wire_losses.hpp fragment_compositor.hpp frame.hpp tile_op.hpp)
set(level_7 comm/mpi_session.hpp detail/frame_terms.hpp detail/job_share.hpp detail/manifest.hpp detail/wire.hpp
            ops/sort_last.hpp pixel_op.hpp render/image_parallel.hpp render/sampling.hpp render/visibility.hpp
            testing/fault_transport.hpp)
set(level_8 detail/finished_record.hpp detail/operations.hpp ops/image_parallel.hpp ops/pixel_ops.hpp
            ops/progressive.hpp render/cameras.hpp render/data_parallel.hpp render/deep_parallel.hpp
            render/shared_world.hpp testing/tile_op_test.hpp testing/verified.hpp)
set(level_9 detail/engine.hpp detail/final_gather.hpp detail/tile_table.hpp detail/verdict.hpp
            render/mixed_parallel.hpp testing/adversarial.hpp)
set(level_10 detail/frame_figures.hpp detail/outcome.hpp detail/tile_pipeline.hpp detail/wall.hpp)
set(level_11 detail/frame_engine.hpp display_wall.hpp)
set(level_12 distributed_framebuffer.hpp)
set(level_13 dfb.hpp)
set(last_level 13)

# A dependency has one door.
set(door_of_mpi comm/mpi_transport.hpp)
set(door_of_snappy comm/snappy_codec.hpp)
set(door_of_tbb tbb_executor.hpp)

# Who must not see whom, however many includes are in between: pixels and operations know nothing of messages and
# threads; messages know nothing of pixels (that one follows from the levels, too, as long as they stay so).
set(pixels_and_operations "^(image|levels|tile|tile_layout|fragment|dependency_tracker|channels|moments|double_double|dither|deep_tile|compositing|fragment_compositor|tile_op|pixel_op|ops/.*)\\.hpp$")
set(messages_and_threads "^(comm/.*|processors|exec|tbb_executor|frame|detail/.*|display_wall|distributed_framebuffer)\\.hpp$")
set(kernels "^detail/(blend_kernels|sort_kernels|fifo|background_pixels)\\.hpp$") # loops over numbers and a container, whoever uses them
set(messages "^comm/.*\\.hpp$")
set(pixels "^(image|levels|tile|tile_layout|fragment|dependency_tracker|channels|moments|double_double|dither|deep_tile|compositing|fragment_compositor|tile_op|pixel_op|ops/.*|render/.*)\\.hpp$")

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
    message(SEND_ERROR "${header}: not in the level table of tests/layers.cmake")
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

  file(STRINGS ${root_of_${header}}/dfb/${header} found REGEX "^[ \t]*using[ \t]+namespace")
  if(found)
    message(SEND_ERROR "${header}: 'using namespace' in a header")
  endif()
  file(STRINGS ${root_of_${header}}/dfb/${header} found REGEX "^#pragma once$")
  if(NOT found)
    message(SEND_ERROR "${header}: no '#pragma once'")
  endif()
endforeach()

# reached: what `header` includes, directly or not.
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
        if(target MATCHES "${${whom}}" AND NOT target MATCHES "${kernels}")
          message(SEND_ERROR "${header} reaches ${target}: ${who} must not know ${whom}")
        endif()
      endforeach()
    endif()
  endforeach()
endfunction()
check_blind(pixels_and_operations messages_and_threads)
check_blind(messages pixels)
