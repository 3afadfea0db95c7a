# Runs the command behind "--", followed by `arguments` if that is set, for at most 120 s. Sets `code`, `out`, `err`,
# and `seconds`, the time that it took.
set(command "")
set(own OFF)
foreach(i RANGE ${CMAKE_ARGC})
  if(own AND DEFINED CMAKE_ARGV${i})
    list(APPEND command "${CMAKE_ARGV${i}}")
  elseif("${CMAKE_ARGV${i}}" STREQUAL "--")
    set(own ON)
  endif()
endforeach()
string(TIMESTAMP start "%s" UTC)
execute_process(COMMAND ${command} ${arguments}
  RESULT_VARIABLE code OUTPUT_VARIABLE out ERROR_VARIABLE err TIMEOUT 120)
string(TIMESTAMP end "%s" UTC)
math(EXPR seconds "${end} - ${start}")
message(STATUS "${seconds} s, code ${code}\n${out}${err}")
