# Runs of the program dfb_render, as its users start it: one ctest entry for each case of cli_cases.cmake.
if(NOT TARGET dfb_render)
  return()
endif()

set(DFB_TEST_DATA "${PROJECT_SOURCE_DIR}/../shared/data" CACHE PATH
  "Folder with volumes, meshes and molecules to test dfb_render on; without it they are left out")

add_executable(dfb_compare_pfm embree/tools/compare_pfm.cpp)
target_link_libraries(dfb_compare_pfm PRIVATE dfb_developer)
find_package(nlohmann_json CONFIG REQUIRED) # dfb_render has it, too
add_executable(dfb_check_stats embree/tools/check_stats.cpp)
target_link_libraries(dfb_check_stats PRIVATE dfb_developer nlohmann_json::nlohmann_json)

# The same program, but that rank 1 stops in the middle of its frames.
if(TARGET dfb::mpi AND CMAKE_SYSTEM_NAME STREQUAL "Linux")
  add_executable(dfb_render_stopped $<TARGET_OBJECTS:dfb_render> embree/tools/stop_rank.cpp)
  target_link_libraries(dfb_render_stopped PRIVATE dfb_developer dfb_embree_example)
  dfb_add_mpi_run(render.peer_timeout RANKS 2 TIMEOUT 20 LABELS example WAITS
    COMMAND $<TARGET_FILE:dfb_render_stopped> demo --size 64x64 --frames 1000000 --peer-timeout 1)
  set_tests_properties(render.peer_timeout.np2 PROPERTIES
    PASS_REGULAR_EXPRESSION "dfb: transport failure: rank 1: this rank is lost")
endif()

set(_launch "")
if(TARGET dfb::mpi)
  set(_launch ${MPIEXEC_EXECUTABLE} ${_mpiexec_flags} ${MPIEXEC_PREFLAGS} ${MPIEXEC_NUMPROC_FLAG})
endif()
set(_snappy OFF)
if(TARGET dfb::snappy)
  set(_snappy ON)
endif()
set(_settings ${CMAKE_CURRENT_BINARY_DIR}/render_cli_$<CONFIG>.cmake)
file(GENERATE OUTPUT ${_settings} CONTENT "# For cli_cases.cmake.
set(RENDER [==[$<TARGET_FILE:dfb_render>]==])
set(COMPARE [==[$<TARGET_FILE:dfb_compare_pfm>]==])
set(CHECK_STATS [==[$<TARGET_FILE:dfb_check_stats>]==])
set(MPIEXEC [==[${_launch}]==]) # with its flags, up to the one before the number of ranks; empty: no MPI
set(POSTFLAGS [==[${MPIEXEC_POSTFLAGS}]==])
set(TIMEOUT_PROGRAM [==[${DFB_TIMEOUT}]==])
set(SNAPPY ${_snappy})
set(DATA [==[${DFB_TEST_DATA}]==])
set(FOLDER [==[${CMAKE_CURRENT_BINARY_DIR}/render_cli]==])
")

# _add_cli_case(<case> [<start>...]): each start is one of one, ranksN (threads as ranks) and npN (under mpiexec).
function(_add_cli_case case)
  foreach(start IN LISTS ARGN)
    if(start MATCHES "^np" AND NOT TARGET dfb::mpi)
      continue()
    endif()
    add_test(NAME render.cli.${case}.${start}
      COMMAND ${CMAKE_COMMAND} -DSETTINGS=${_settings} -DCASE=${case} -DSTART=${start}
        -P ${CMAKE_CURRENT_SOURCE_DIR}/embree/cli_cases.cmake)
    set_tests_properties(render.cli.${case}.${start} PROPERTIES LABELS example TIMEOUT 180)
  endforeach()
endfunction()

_add_cli_case(help one np3)
_add_cli_case(bad_options one np1 np3)
_add_cli_case(bad_files ranks1 ranks3 np1 np3)
_add_cli_case(headers ranks3 np1 np3)
_add_cli_case(bad_output ranks1 ranks3 np1 np3)
_add_cli_case(ranks_under_mpiexec np3)
if(UNIX AND NOT APPLE)
  _add_cli_case(too_large ranks3 np3)
endif()
_add_cli_case(ordinary ranks3 ranks4 np3 np4)
_add_cli_case(stats ranks3 np3)
_add_cli_case(loading ranks1 ranks3 np4)
_add_cli_case(frames ranks3 np3)
_add_cli_case(no_output one np3)
_add_cli_case(algorithms ranks2 ranks7 np2 np4)
_add_cli_case(precision ranks3 np4)
_add_cli_case(wall_and_aux ranks3 np2 np4)
_add_cli_case(png ranks2 np3)
_add_cli_case(far ranks3 np3)
_add_cli_case(hash ranks1 ranks2 ranks5 np1 np3 np4)
_add_cli_case(modes ranks3 np3)
_add_cli_case(shared_memory np2)
if(EXISTS ${DFB_TEST_DATA}/boston_teapot_256x256x178_uint8.raw)
  _add_cli_case(teapot one)
endif()
if(EXISTS ${DFB_TEST_DATA}/stanford_bunny.ply AND EXISTS ${DFB_TEST_DATA}/neghip_64x64x64_uint8.raw
    AND EXISTS ${DFB_TEST_DATA}/proteasome_3l5q.xyz)
  _add_cli_case(real_data ranks3 np4)
  _add_cli_case(three_files one)
endif()
