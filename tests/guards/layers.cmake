# cmake "-DROOTS=<folder that holds dfb/>;..." -P layers.cmake
# Checks that no header includes itself through others, that folders keep their rules about each other, and that each
# dependency is included in only one header.
cmake_minimum_required(VERSION 3.21)

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
    Get_count Get_library_version Get_processor_name Iallgather Iallreduce Ialltoall Ibarrier Ibcast Init_thread Irecv
    Isend Issend Query_thread Request Test Test_cancelled Testall Testsome)

# Headers that must not include others, even indirectly. Rooms are folders. Of the headers at the root, those that
# define a tile and what is made of it count as pixels.
set(pixels "^((image|tile|tile_layout|fragment|dependency_tracker|channels|tile_op|pixel_op)|(blend|ops)/.*)\\.hpp$")
set(messages "^(comm)/.*\\.hpp$")
set(loops "^(render)/.*\\.hpp$")
set(frames "^(frame|gather)/.*\\.hpp$")
set(doors "^(frame|display_wall|framebuffer_base|distributed_framebuffer)\\.hpp$")
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

foreach(header IN LISTS headers)
  set("includes_of_${header}" "")
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

# reached: all headers that `header` includes, directly or indirectly, except what is reached only through headers that
# match `through`
function(collect header)
  foreach(target IN LISTS "includes_of_${header}")
    if(NOT target IN_LIST reached)
      list(APPEND reached ${target})
      if(NOT through OR NOT target MATCHES "${through}")
        collect(${target})
      endif()
    endif()
  endforeach()
  set(reached ${reached} PARENT_SCOPE)
endfunction()

foreach(header IN LISTS headers)
  foreach(target IN LISTS "includes_of_${header}")
    set(reached ${target})
    collect(${target})
    if(header IN_LIST reached)
      message(SEND_ERROR "${header} includes ${target}, which includes ${header} again, maybe through others")
    endif()
  endforeach()
endforeach()

# check_blind(<who> <whom> [<except through>])
function(check_blind who whom)
  set(through "${${ARGV2}}")
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
check_blind(loops frames doors)
check_blind(pixels doors)
check_blind(messages loops)
