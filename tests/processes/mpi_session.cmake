# cmake -DTOLD=<count> -DSAID=<file> -P mpi_session.cmake -- <mpiexec> <argument>... <program> <argument>...
# Starts an mpi_session in which rank 1 leaves, with the file SAID as its last argument. The job must end by itself,
# soon and with code 1, after rank 1 has written the reason to the file, and TOLD other ranks their errors.
cmake_policy(VERSION 3.16)
file(WRITE ${SAID} "")
set(arguments ${SAID})
include(${CMAKE_CURRENT_LIST_DIR}/mpi_job.cmake)

set(limit 30) # s, on a machine that is busy with other things; less than the others would wait
if(seconds GREATER limit)
  message(SEND_ERROR "the job took ${seconds} s, at most ${limit} s was expected")
endif()
if(NOT code STREQUAL "1")
  message(SEND_ERROR "the job ended with code ${code}, not 1")
endif()
file(READ ${SAID} said)
string(REGEX MATCHALL "caught: rank 1 leaves" leaving "${said}")
string(REGEX MATCHALL "caught: dfb: transport failure: rank 1: an exception has ended" told "${said}")
string(REGEX MATCHALL "caught: " caught "${said}")
foreach(list leaving told caught)
  list(LENGTH ${list} ${list})
endforeach()
math(EXPR all "1 + ${TOLD}")
if(NOT leaving EQUAL 1 OR NOT told EQUAL TOLD OR NOT caught EQUAL all)
  message(SEND_ERROR "${leaving} ranks said that they leave, and ${told} of ${TOLD} that they were told")
endif()
if("${out}${err}" MATCHES "goes on without|finalised")
  message(SEND_ERROR "a rank went on")
endif()
