# dfb::core        the library, on threads alone
# dfb::mpi, dfb::tbb, dfb::snappy   core and one dependency each; a definition DFB_HAS_... tells the headers of it
# dfb::dfb         core and all of these that are enabled
# dfb::compiled    dfb::dfb, with function bodies compiled once for all programs that link it
# dfb::testing     core and, in an include folder of its own, helpers for tests: an exact reference, checks of tile
#                  operations and transports. Not part of dfb::dfb
# dfb::strict_fp   for images that are bitwise equal with all compilers: a * b + c is not contracted to one rounding

function(_dfb_add_component name)
  add_library(dfb_${name} INTERFACE)
  add_library(dfb::${name} ALIAS dfb_${name})
  set_target_properties(dfb_${name} PROPERTIES EXPORT_NAME ${name})
endfunction()

# Calls find_package, unless the project above has such a target, and ends with an error if nothing is found.
macro(_dfb_require option packages target)
  if(NOT TARGET ${target})
    find_package(${ARGN} QUIET)
  endif()
  if(NOT TARGET ${target})
    message(FATAL_ERROR "dfb: ${ARGV3} was not found. Install it (Debian and Ubuntu: apt-get install ${packages}), "
      "or leave it out with -D${option}=OFF.")
  endif()
endmacro()

set(_dfb_system SYSTEM) # no warnings from dfb's headers in another project
if(_dfb_top_level)
  set(_dfb_system "")
endif()
find_package(Threads REQUIRED)
_dfb_add_component(core)
target_compile_features(dfb_core INTERFACE cxx_std_17)
target_include_directories(dfb_core ${_dfb_system} INTERFACE $<BUILD_INTERFACE:${PROJECT_SOURCE_DIR}/include>)
target_compile_definitions(dfb_core INTERFACE DFB_COMPONENTS) # the headers look for no dependency by themselves
target_link_libraries(dfb_core INTERFACE Threads::Threads)

_dfb_add_component(strict_fp)
target_compile_options(dfb_strict_fp INTERFACE
  $<$<COMPILE_LANG_AND_ID:CXX,GNU,Clang,AppleClang,IntelLLVM>:-ffp-contract=off>)

_dfb_add_component(testing)
target_include_directories(dfb_testing ${_dfb_system} INTERFACE $<BUILD_INTERFACE:${PROJECT_SOURCE_DIR}/tests/include>)
target_link_libraries(dfb_testing INTERFACE dfb_core)

set(DFB_COMPONENTS core)

if(DFB_WITH_MPI)
  _dfb_require(DFB_WITH_MPI "mpich libmpich-dev" MPI::MPI_CXX MPI 3.1 COMPONENTS CXX)
  _dfb_add_component(mpi)
  target_link_libraries(dfb_mpi INTERFACE dfb_core MPI::MPI_CXX)
  target_compile_definitions(dfb_mpi INTERFACE DFB_HAS_MPI=1)
  list(APPEND DFB_COMPONENTS mpi)
endif()

if(DFB_WITH_TBB)
  _dfb_require(DFB_WITH_TBB "libtbb-dev" TBB::tbb TBB CONFIG)
  _dfb_add_component(tbb)
  target_link_libraries(dfb_tbb INTERFACE dfb_core TBB::tbb)
  target_compile_definitions(dfb_tbb INTERFACE DFB_HAS_TBB=1)
  list(APPEND DFB_COMPONENTS tbb)
endif()

if(DFB_WITH_SNAPPY)
  _dfb_require(DFB_WITH_SNAPPY "libsnappy-dev" Snappy::snappy Snappy CONFIG)
  _dfb_add_component(snappy)
  target_link_libraries(dfb_snappy INTERFACE dfb_core Snappy::snappy)
  target_compile_definitions(dfb_snappy INTERFACE DFB_HAS_SNAPPY=1)
  list(APPEND DFB_COMPONENTS snappy)
endif()

# Not exported, as the installed package builds dfb::dfb from the requested components.
add_library(dfb INTERFACE)
add_library(dfb::dfb ALIAS dfb)
foreach(_dfb_component IN LISTS DFB_COMPONENTS)
  target_link_libraries(dfb INTERFACE dfb_${_dfb_component})
endforeach()

# Built where it is used: by the project that links it, with the compiler and flags of that project.
add_library(dfb_compiled STATIC EXCLUDE_FROM_ALL ${PROJECT_SOURCE_DIR}/include/dfb/compiled.cpp)
add_library(dfb::compiled ALIAS dfb_compiled)
target_compile_definitions(dfb_compiled PUBLIC DFB_COMPILED)
target_link_libraries(dfb_compiled PUBLIC dfb)
set_target_properties(dfb_compiled PROPERTIES POSITION_INDEPENDENT_CODE ON)
