# cmake -DRANKS=<n> -DVICTIM=<rank> -DREACTION=<abort|handler> -DWHERE=<where> -DBACK=<ON|OFF> -DNETWORK=<ON|OFF>
#   -DTIMEOUT_MS=<ms> -DFOLDER=<folder> -P mpi_dead.cmake -- <mpiexec> <argument>... <program> <argument>...
# Starts mpi_dead and checks its output: which ranks got an error about which rank, and when; or that the job was
# aborted in time. BACK: the lost rank comes back and gets an error, too. NETWORK: MPI may find the loss first, when it
# sends a message there. Ranks that are in a destructor cannot get an error, except in a handler; they end in time.
cmake_policy(VERSION 3.16)
file(REMOVE_RECURSE ${FOLDER})
file(MAKE_DIRECTORY ${FOLDER})
set(arguments ${FOLDER})
include(${CMAKE_CURRENT_LIST_DIR}/mpi_job.cmake)
file(REMOVE_RECURSE ${FOLDER})

set(margin 5000) # ms, on a machine that is busy with other things
math(EXPR limit "${TIMEOUT_MS} + ${margin}")
if(REACTION STREQUAL "abort")
  math(EXPR limit "(${limit} + ${margin}) / 1000") # from the start of the program
  if(seconds GREATER limit)
    message(SEND_ERROR "the job took ${seconds} s, at most ${limit} s was expected")
  endif()
  if(code STREQUAL "0")
    message(SEND_ERROR "the job ended with code 0")
  endif()
  # The first rank that notices the loss ends the job for all. In a frame it may name another rank than the victim, for
  # the reason below. Runs with the reaction `handler` check that each rank names the right one.
  set(named ${VICTIM})
  if(WHERE STREQUAL "frame")
    set(named "[0-9]+")
  endif()
  if(NOT err MATCHES "dfb: transport failure: rank ${named}: this rank is lost")
    message(SEND_ERROR "standard error does not say that rank ${named} is lost")
  endif()
  if(out MATCHES "mpi_dead: ")
    message(SEND_ERROR "a rank went on")
  endif()
else()
  math(EXPR last "${RANKS} - 1")
  foreach(rank RANGE ${last})
    if(rank EQUAL VICTIM AND NOT BACK)
      continue()
    endif()
    # A rank that ends or is stopped while it sends may leave a slot in the queue of MPI's shared memory that it never
    # fills. Then its receiver gets no messages of other ranks either, and may name one of those. This concerns at most
    # one rank.
    set(named ${VICTIM})
    if(WHERE MATCHES "^(pixels|shared)$" AND NOT NETWORK
        AND "${out}" MATCHES "mpi_dead: rank ${rank} told of rank ([0-9]+) [^\n]* Rank ([0-9]+) has heard nothing"
        AND NOT CMAKE_MATCH_1 EQUAL VICTIM AND NOT CMAKE_MATCH_2 EQUAL VICTIM)
      if(NOT DEFINED deaf)
        set(deaf ${CMAKE_MATCH_2})
      endif()
      if(CMAKE_MATCH_2 EQUAL deaf)
        set(named ${CMAKE_MATCH_1})
      endif()
    endif()
    set(pattern "told of rank ${named} after ([0-9]+) ms, gone after ([0-9]+) ms: dfb: transport failure: rank ${named}: this rank is lost")
    if(NETWORK)
      set(pattern "told of rank [0-9]+ after ([0-9]+) ms, gone after ([0-9]+) ms: dfb: transport failure: (rank ${VICTIM}: this rank is lost|rank [0-9]+: MPI_[A-Za-z]+ with rank ${VICTIM}: )")
    endif()
    if(WHERE STREQUAL "end")
      if(NOT "${out}" MATCHES "mpi_dead: rank [0-9]+ ${pattern}")
        message(SEND_ERROR "nobody has noticed that rank ${VICTIM} is lost")
      endif()
      set(pattern "told of rank -?[0-9]+ after ([0-9]+) ms, gone after ([0-9]+) ms")
    endif()
    if(NOT "${out}" MATCHES "mpi_dead: rank ${rank} ${pattern}")
      message(SEND_ERROR "rank ${rank} was not told of rank ${VICTIM}")
    elseif(NOT rank EQUAL VICTIM AND (CMAKE_MATCH_1 GREATER limit OR CMAKE_MATCH_2 GREATER limit))
      message(SEND_ERROR "rank ${rank} was told after ${CMAKE_MATCH_1} ms and gone after ${CMAKE_MATCH_2} more, "
        "at most ${limit} ms was expected")
    endif()
  endforeach()
  if("${out}" MATCHES "unexpected")
    message(SEND_ERROR "an unexpected exception")
  endif()
endif()
