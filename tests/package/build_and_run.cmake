# cmake -D SOURCE= -D BUILD= -D GENERATOR= -D ARGUMENTS= [-D FAILS=<regex>] -P build_and_run.cmake
# Configures, builds and runs the user's project from scratch. With FAILS, configuring must fail with that text.
cmake_minimum_required(VERSION 3.21)

file(REMOVE_RECURSE ${BUILD})
string(REPLACE "|" ";" ARGUMENTS "${ARGUMENTS}")
set(configure ${CMAKE_COMMAND} -S ${SOURCE} -B ${BUILD} -G ${GENERATOR})
foreach(argument IN LISTS ARGUMENTS)
  string(REPLACE "," "\\;" argument "${argument}")
  list(APPEND configure "${argument}")
endforeach()

if(FAILS)
  execute_process(COMMAND ${configure} RESULT_VARIABLE result OUTPUT_VARIABLE output ERROR_VARIABLE output)
  string(REGEX REPLACE "[ \n]+" " " output "${output}") # cmake wraps its messages
  if(result EQUAL 0)
    message(FATAL_ERROR "configuring should have failed")
  elseif(NOT output MATCHES "${FAILS}")
    message(FATAL_ERROR "configuring should have failed with '${FAILS}', not with\n${output}")
  endif()
  return()
endif()

execute_process(COMMAND ${configure} COMMAND_ERROR_IS_FATAL ANY)
execute_process(COMMAND ${CMAKE_COMMAND} --build ${BUILD} COMMAND_ERROR_IS_FATAL ANY)
execute_process(COMMAND ${BUILD}/stranger COMMAND_ERROR_IS_FATAL ANY)
