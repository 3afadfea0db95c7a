# Flags and targets for our own tests and programs. They do not affect a user's targets.
# dfb_developer_flags    warnings, and results that do not depend on the compiler
# dfb_developer          these, and the library, compiled once unless DFB_DEVELOP_HEADER_ONLY
# dfb_developer_headers  these, and the library as headers alone
option(DFB_DEVELOP_HEADER_ONLY "Compile dfb's own tests and programs without dfb::compiled" OFF)

# GCC would spend 10 to 30 % of its time on saving memory. Without that, a file of ours takes up to 1.5 GB instead of
# 1.2.
set(DFB_QUICK_COMPILE "")
if(CMAKE_CXX_COMPILER_ID STREQUAL "GNU")
  set(DFB_QUICK_COMPILE --param=ggc-min-heapsize=1000000) # in kB: what it may use before it looks for garbage
endif()

add_library(dfb_developer_flags INTERFACE)
target_link_libraries(dfb_developer_flags INTERFACE dfb::strict_fp)
if(NOT MSVC)
  target_compile_options(dfb_developer_flags INTERFACE
    ${DFB_QUICK_COMPILE} -Wall -Wextra -Wpedantic -Wshadow -Woverloaded-virtual
    $<$<BOOL:${DFB_WARNINGS_AS_ERRORS}>:-Werror>)
endif()
target_link_libraries(dfb_compiled PRIVATE dfb_developer_flags)
if(NOT MSVC) # -O3 takes a third longer to compile, and nothing that was measured is faster
  target_compile_options(dfb_compiled PRIVATE $<$<CONFIG:Release>:-O2>)
endif()
if(CMAKE_CXX_FLAGS MATCHES "fsanitize") # tests that are not optimized then take much less time
  target_compile_options(dfb_compiled PRIVATE -O1)
endif()

add_library(dfb_developer_headers INTERFACE)
target_link_libraries(dfb_developer_headers INTERFACE dfb_developer_flags dfb::dfb dfb::testing)

add_library(dfb_developer INTERFACE)
if(DFB_DEVELOP_HEADER_ONLY)
  target_link_libraries(dfb_developer INTERFACE dfb_developer_headers)
else()
  target_link_libraries(dfb_developer INTERFACE dfb_developer_flags dfb::compiled dfb::testing)
endif()

# The folder into which bench/get_icet.sh puts IceT, for its adapter, for tests of the adapter, and for benchmarks.
set(DFB_ICET_DIR ${PROJECT_SOURCE_DIR}/build/peers/icet CACHE PATH "IceT: where include/IceT.h and lib are")

# dfb.hpp is parsed once for all programs that have the same flags, which saves half of the compile time of a small one.
# A file that forgets an include may then compile all the same; the preset clang, without precompiling, finds it.
option(DFB_PRECOMPILE "Precompile dfb.hpp for dfb's own tests and programs" OFF)

# _dfb_reuse(<folder>): handles the targets of a folder and of those below it
function(_dfb_reuse folder)
  get_property(targets DIRECTORY ${folder} PROPERTY BUILDSYSTEM_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(libraries ${target} LINK_LIBRARIES)
    get_target_property(type ${target} TYPE)
    get_target_property(options ${target} COMPILE_OPTIONS)
    if(target MATCHES "^dfb_precompiled" OR NOT libraries MATCHES "(^|;)dfb_(developer|catch)(;|$)")
      continue()
    elseif(options OR "OpenMP::OpenMP_CXX" IN_LIST libraries OR type MATCHES "^(MODULE|SHARED)_LIBRARY$")
      continue() # other flags
    elseif(type STREQUAL "STATIC_LIBRARY"
        OR target MATCHES "^(test_(unit|fuzz_(fragment|finished|packet|tracker|readers|driver))|dfb_(check|compare|make|fuzz|render_stopped).*)$")
      continue() # they include a few of dfb's headers: reading all takes longer
    elseif("dfb_catch" IN_LIST libraries OR "Catch2::Catch2" IN_LIST libraries)
      set(header dfb_precompiled_tests)
    else()
      set(header dfb_precompiled)
    endif()
    set_target_properties(${target} PROPERTIES PRECOMPILE_HEADERS_REUSE_FROM ${header})
  endforeach()
  get_property(folders DIRECTORY ${folder} PROPERTY SUBDIRECTORIES)
  foreach(below IN LISTS folders)
    _dfb_reuse(${below})
  endforeach()
endfunction()

# Call it when all targets exist. With ccache it does nothing, as ccache does not cache files that use a precompiled
# header.
function(dfb_precompile)
  if(NOT DFB_PRECOMPILE OR CMAKE_CXX_COMPILER_LAUNCHER)
    return()
  endif()
  file(WRITE ${PROJECT_BINARY_DIR}/precompiled.cpp "")
  add_library(dfb_precompiled OBJECT ${PROJECT_BINARY_DIR}/precompiled.cpp)
  target_link_libraries(dfb_precompiled PRIVATE dfb_developer)
  target_precompile_headers(dfb_precompiled PRIVATE <dfb/dfb.hpp>)
  if(TARGET dfb_catch)
    add_library(dfb_precompiled_tests OBJECT ${PROJECT_BINARY_DIR}/precompiled.cpp)
    target_link_libraries(dfb_precompiled_tests PRIVATE dfb_catch)
    target_precompile_headers(dfb_precompiled_tests PRIVATE
      ${PROJECT_SOURCE_DIR}/tests/support/catch.hpp <dfb/dfb.hpp>)
  endif()
  _dfb_reuse(${PROJECT_SOURCE_DIR})
endfunction()
