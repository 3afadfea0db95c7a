# The live view. If packages that it needs are missing, programs say so.
if(NOT DFB_BUILD_EXAMPLES)
  return()
endif()
if(NOT DFB_LIVE_MISSING STREQUAL "")
  if(TARGET dfb_render)
    add_test(NAME live.missing COMMAND sh -c "\"$1\" demo --size 16x16 --live; echo \"code $?\"" sh
      $<TARGET_FILE:dfb_render>)
    set_tests_properties(live.missing PROPERTIES LABELS example TIMEOUT 30
      PASS_REGULAR_EXPRESSION "^dfb_render: --live: this program was built without it[^\n]*\ncode 1\n$")
  endif()
  return()
endif()

find_package(nlohmann_json CONFIG REQUIRED)
find_package(PNG REQUIRED)
dfb_add_unit_test(live SOURCES live/server.cpp LABELS example WAIT server)
add_test(NAME live.server.end COMMAND test_live ${_select} "[#server][end]")
set_tests_properties(live.server.end PROPERTIES LABELS example)
list(APPEND _undisturbed live.server.end)
target_link_libraries(test_live PRIVATE dfb_live PkgConfig::DFB_HTTPLIB PkgConfig::DFB_TURBOJPEG PNG::PNG
  nlohmann_json::nlohmann_json)

if(NOT TARGET dfb_render OR NOT TARGET dfb::mpi OR NOT CMAKE_SYSTEM_NAME STREQUAL "Linux")
  return()
endif()
add_executable(dfb_live_job live/job.cpp)
target_link_libraries(dfb_live_job PRIVATE dfb_developer_flags PkgConfig::DFB_HTTPLIB nlohmann_json::nlohmann_json)
set(_mpi ${MPIEXEC_EXECUTABLE} ${_mpiexec_flags} ${MPIEXEC_PREFLAGS} ${MPIEXEC_NUMPROC_FLAG})
dfb_limit(_limit 240)
# _add_live_job(<name> <case> <command>...)
function(_add_live_job name case)
  add_test(NAME live.job.${name} COMMAND ${_limit} $<TARGET_FILE:dfb_live_job> ${case} ${ARGN})
  set_tests_properties(live.job.${name} PROPERTIES LABELS example TIMEOUT 260)
endfunction()
set(_render $<TARGET_FILE:dfb_render> ${MPIEXEC_POSTFLAGS} demo --size 160x120)
_add_live_job(button.data.np3 button ${_mpi} 3 ${_render} --live 0)
_add_live_job(button.image.np2 button ${_mpi} 2 ${_render} --mode image --live 0)
_add_live_job(button.mixed.np3 button ${_mpi} 3 ${_render} --mode mixed --live 0)
_add_live_job(button.threads button $<TARGET_FILE:dfb_render> demo --size 160x120 --ranks 2 --live 0)
_add_live_job(button.in_situ.np2 step ${_mpi} 2 $<TARGET_FILE:in_situ> ${MPIEXEC_POSTFLAGS} --size 32 --every 20 --live 0)
set(_interrupt interrupt)
if(_is_open_mpi)
  set(_interrupt killed)
endif()
_add_live_job(interrupt.np3 ${_interrupt} ${_mpi} 3 ${_render} --live 0)
_add_live_job(interrupt.busy.np2 ${_interrupt} ${_mpi} 2 ${_render} --path 64 --mode image --size 1024x768 --spp 4096 --live 0)
_add_live_job(interrupt.in_situ.np2 ${_interrupt} ${_mpi} 2 $<TARGET_FILE:in_situ> ${MPIEXEC_POSTFLAGS} --size 32 --live 0)
_add_live_job(rest.np2 rest ${_mpi} 2 ${_render} --spp 4 --live 0)
list(APPEND _undisturbed live.job.rest.np2) # it measures processor time, which others need not have
_add_live_job(fire.np2 fire ${_mpi} 2 ${_render} --live 0)
add_test(NAME live.taken COMMAND ${_limit} $<TARGET_FILE:dfb_live_job> taken $<TARGET_FILE:dfb_render> demo --size 16x16
  --ranks 1 --live 0)
set_tests_properties(live.taken PROPERTIES LABELS example TIMEOUT 260)

# The page in a browser: see browser.sh, which installs what it needs.
set(DFB_LIVE_NODE_MODULES "$ENV{DFB_LIVE_NODE_MODULES}" CACHE PATH "Folder that has puppeteer-core, for the test of the page")
add_test(NAME live.browser COMMAND ${CMAKE_COMMAND} -E env
  DFB_RENDER=$<TARGET_FILE:dfb_render> DFB_IN_SITU=$<TARGET_FILE:in_situ> "DFB_MPIEXEC=${_mpi}"
  "DFB_LIVE_NODE_MODULES=${DFB_LIVE_NODE_MODULES}"
  sh ${CMAKE_CURRENT_SOURCE_DIR}/live/browser.sh --only-if-installed ${CMAKE_CURRENT_BINARY_DIR}/live_browser)
set_tests_properties(live.browser PROPERTIES LABELS example TIMEOUT 300 RUN_SERIAL ON SKIP_RETURN_CODE 77)

# A trace in speedscope, with the same browser: see speedscope.sh.
add_test(NAME render.speedscope COMMAND ${CMAKE_COMMAND} -E env DFB_RENDER=$<TARGET_FILE:dfb_render>
  "DFB_LIVE_NODE_MODULES=${DFB_LIVE_NODE_MODULES}"
  sh ${CMAKE_CURRENT_SOURCE_DIR}/trace/speedscope.sh --only-if-installed ${CMAKE_CURRENT_BINARY_DIR}/speedscope)
set_tests_properties(render.speedscope PROPERTIES LABELS example TIMEOUT 120 SKIP_RETURN_CODE 77)
