# Tests of the source tree: they call the compiler with -fsyntax-only, so they need no build folder of their own and
# run side by side.
if(MSVC)
  return()
endif()

# Without source lines in the compiler's messages, so that only the message itself can match.
if(CMAKE_CXX_COMPILER_ID STREQUAL "GNU")
  set(_terse -fno-diagnostics-show-caret)
else()
  set(_terse -fno-caret-diagnostics)
endif()
set(_compile ${CMAKE_CXX_COMPILER} -std=c++17 -fsyntax-only ${DFB_QUICK_COMPILE} ${_terse})
set(_include ${PROJECT_SOURCE_DIR}/include)
set(_testing_include ${PROJECT_SOURCE_DIR}/tests/include)

add_test(NAME guard.layers
  COMMAND ${CMAKE_COMMAND} "-DROOTS=${_include};${_testing_include}" -P ${CMAKE_CURRENT_SOURCE_DIR}/guards/layers.cmake)
set_tests_properties(guard.layers PROPERTIES LABELS guard)

add_test(NAME guard.readme
  COMMAND ${CMAKE_COMMAND} -DROOT=${PROJECT_SOURCE_DIR} -P ${CMAKE_CURRENT_SOURCE_DIR}/guards/readme.cmake)
add_test(NAME guard.architecture
  COMMAND ${CMAKE_COMMAND} -DROOT=${PROJECT_SOURCE_DIR} -P ${CMAKE_CURRENT_SOURCE_DIR}/guards/architecture.cmake)
add_test(NAME guard.docs
  COMMAND ${CMAKE_COMMAND} -DROOT=${PROJECT_SOURCE_DIR} -P ${CMAKE_CURRENT_SOURCE_DIR}/guards/docs.cmake)
set_tests_properties(guard.readme guard.architecture guard.docs PROPERTIES LABELS guard)

# The site is built without a warning. Doxygen warns of broken links, but not of filters that fail.
if(TARGET docs)
  add_test(NAME guard.site COMMAND Doxygen::doxygen ${PROJECT_BINARY_DIR}/site/Doxyfile)
  set_tests_properties(guard.site PROPERTIES LABELS guard FAIL_REGULAR_EXPRESSION "awk: ")
endif()

# The blocks of code in docs/ compile, and the operations in them work.
if(TARGET dfb::mpi AND TARGET dfb::snappy)
  include(guards/doc_blocks/blocks.cmake)
  dfb_write_doc_blocks(_doc_blocks ${PROJECT_SOURCE_DIR} ${CMAKE_CURRENT_BINARY_DIR})
  add_library(dfb_doc_blocks OBJECT ${_doc_blocks})
  set_target_properties(dfb_doc_blocks PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 0)
  add_executable(test_documented guards/doc_blocks/operations.cpp)
  foreach(target IN ITEMS dfb_doc_blocks test_documented)
    target_link_libraries(${target} PRIVATE dfb_developer)
    target_include_directories(${target} PRIVATE
      ${CMAKE_CURRENT_SOURCE_DIR}/guards/doc_blocks ${CMAKE_CURRENT_BINARY_DIR}/doc_blocks)
  endforeach()
  add_test(NAME guard.documented_operations COMMAND test_documented)
  set_tests_properties(guard.documented_operations PROPERTIES LABELS guard)
endif()

# Every header compiles alone and when it is included twice. A header that is the door of a dependency is compiled with
# that component, the umbrella header with each set of components, and all others with only our include folder. Function
# bodies that dfb::compiled compiles once are read if the header itself has some. Elsewhere they would double the time.
function(_dfb_flags_of out target)
  set(folders "$<$<TARGET_EXISTS:${target}>:$<TARGET_PROPERTY:${target},INTERFACE_INCLUDE_DIRECTORIES>>")
  set(${out} "$<$<BOOL:${folders}>:-idirafter$<JOIN:${folders},$<SEMICOLON>-idirafter>>" PARENT_SCOPE)
endfunction()

# _dfb_add_header_test(<header> <suffix of the name> [<flag>...])
function(_dfb_add_header_test header suffix)
  string(REGEX REPLACE "^dfb/(.*)\\.hpp$" "\\1" name ${header})
  string(REPLACE "/" "." name ${name}${suffix})
  set(mode -DDFB_COMPILED)
  set(bodies "")
  if(EXISTS ${_include}/${header})
    file(STRINGS ${_include}/${header} bodies REGEX "DFB_HAS_BODIES|DFB_COMPILED")
  endif()
  if(bodies OR name STREQUAL "dfb") # which is also compiled as a user has it without dfb::compiled
    set(mode "")
  endif()
  add_test(NAME header.${name}
    COMMAND ${_compile} -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wsign-conversion -Wdouble-promotion -Werror
      ${mode} -I${_include} ${ARGN}
      -include ${header} -include ${header} -x c++ ${CMAKE_CURRENT_SOURCE_DIR}/guards/empty.cpp
    COMMAND_EXPAND_LISTS)
  set_tests_properties(header.${name} PROPERTIES LABELS guard)
endfunction()

_dfb_flags_of(_mpi_flags MPI::MPI_CXX)
_dfb_flags_of(_tbb_flags TBB::tbb)
_dfb_flags_of(_snappy_flags Snappy::snappy)
set(_mpi_doors dfb/comm/mpi_calls.hpp dfb/comm/mpi_ranks.hpp dfb/comm/mpi_session.hpp dfb/comm/mpi_transport.hpp)
set(_tbb_doors dfb/tbb_executor.hpp)
set(_snappy_doors dfb/comm/snappy_codec.hpp)

file(GLOB_RECURSE _headers CONFIGURE_DEPENDS RELATIVE ${_include} ${_include}/dfb/*.hpp)
list(REMOVE_ITEM _headers ${_mpi_doors} ${_tbb_doors} ${_snappy_doors})
foreach(_header IN LISTS _headers)
  _dfb_add_header_test(${_header} "")
endforeach()
file(GLOB_RECURSE _testing_headers CONFIGURE_DEPENDS RELATIVE ${_testing_include} ${_testing_include}/dfb/*.hpp)
foreach(_header IN LISTS _testing_headers)
  _dfb_add_header_test(${_header} "" -I${_testing_include})
endforeach()
foreach(_component mpi tbb snappy)
  if(TARGET dfb::${_component})
    string(TOUPPER ${_component} _upper)
    foreach(_door IN LISTS _${_component}_doors)
      _dfb_add_header_test(${_door} "" "${_${_component}_flags}")
    endforeach()
    # -M only looks whether all headers are there, as each door is compiled above.
    _dfb_add_header_test(dfb/dfb.hpp .with_${_component} -M -DDFB_HAS_${_upper}=1 "${_${_component}_flags}")
  endif()
endforeach()

# They compile one after another, too.
list(TRANSFORM _testing_headers REPLACE "(.+)" "-include;\\1" OUTPUT_VARIABLE _include_all)
add_test(NAME header.testing.all COMMAND ${_compile} -DDFB_COMPILED -I${_include} -I${_testing_include} ${_include_all} -x c++
  ${CMAKE_CURRENT_SOURCE_DIR}/guards/empty.cpp)
set_tests_properties(header.testing.all PROPERTIES LABELS guard)

# Without components no header of MPI, oneTBB or Snappy is included, even if they are installed.
list(TRANSFORM _headers REPLACE "(.+)" "#include <\\1>\n" OUTPUT_VARIABLE _include_all)
list(JOIN _include_all "" _include_all)
file(CONFIGURE OUTPUT all_of_core.cpp CONTENT "${_include_all}" @ONLY)
add_test(NAME guard.core_dependencies # -M lists what is included, and compiles nothing
  COMMAND ${CMAKE_CXX_COMPILER} -std=c++17 -M -DDFB_COMPONENTS -I${_include} "${_mpi_flags}"
    ${CMAKE_CURRENT_BINARY_DIR}/all_of_core.cpp
  COMMAND_EXPAND_LISTS)
set_tests_properties(guard.core_dependencies PROPERTIES LABELS guard
  FAIL_REGULAR_EXPRESSION "/mpi\\.h;/mpicxx\\.h;/snappy[a-z-]*\\.h;/(tbb|oneapi)/[a-z_/]*\\.h")

# The benchmarks still compile. Except for those in scaling/, they are not built with the tests.
if(TARGET dfb::mpi AND TARGET dfb::tbb AND TARGET dfb::snappy)
  file(GLOB _programs CONFIGURE_DEPENDS ${PROJECT_SOURCE_DIR}/bench/*/bench_*.cpp)
  list(FILTER _programs EXCLUDE REGEX "/scaling/")
  set(_bench_include "")
  foreach(_folder common compositing rendering)
    list(APPEND _bench_include -I${PROJECT_SOURCE_DIR}/bench/${_folder})
  endforeach()
  find_package(benchmark CONFIG QUIET)
  if(NOT TARGET benchmark::benchmark)
    list(FILTER _programs EXCLUDE REGEX "bench_kernels")
  endif()
  foreach(_program IN LISTS _programs)
    get_filename_component(_name ${_program} NAME_WE)
    add_test(NAME guard.${_name} COMMAND ${_compile} -Wall -Wextra -Werror -DDFB_COMPILED -I${_include} -I${_testing_include}
      ${_bench_include} -DDFB_HAS_MPI=1 -DDFB_HAS_TBB=1 -DDFB_HAS_SNAPPY=1 "${_mpi_flags}" "${_tbb_flags}" "${_snappy_flags}" ${_program} COMMAND_EXPAND_LISTS)
    set_tests_properties(guard.${_name} PROPERTIES LABELS guard)
  endforeach()
endif()

# A file that includes everything defines nothing that another one would define as well: all that stands in headers is
# inline or a template. It compiles without warnings under stricter flags, and links.
add_executable(test_odr guards/odr.cpp)
target_link_libraries(test_odr PRIVATE dfb_developer_headers)
target_compile_options(test_odr PRIVATE -Wconversion -O0)
add_test(NAME guard.odr COMMAND sh -c "! \"$1\" -C \"$2\" | grep ' [TDBRC] ' | grep -v ' main$'" sh
  ${CMAKE_NM} $<TARGET_OBJECTS:test_odr>)
set_tests_properties(guard.odr PROPERTIES LABELS guard)

# The linker refuses a program of which some files link dfb::compiled and others use the headers alone, also if these
# are in a library that comes first. It accepts shared libraries that differ in this.
if(NOT DFB_DEVELOP_HEADER_ONLY AND CMAKE_SYSTEM_NAME STREQUAL "Linux")
  add_test(NAME guard.compiled_mixed COMMAND ${CMAKE_CXX_COMPILER} -std=c++17 -I${_include}
    ${CMAKE_CURRENT_SOURCE_DIR}/guards/mixed/headers.cpp ${CMAKE_CURRENT_SOURCE_DIR}/guards/mixed/compiled.cpp
    $<TARGET_FILE:dfb_compiled> -pthread -o guard_compiled_mixed)
  set_tests_properties(guard.compiled_mixed PROPERTIES LABELS guard
    PASS_REGULAR_EXPRESSION "dfb_either_all_files_with_dfb_compiled_or_none: TLS definition")
  add_test(NAME guard.compiled_mixed_library
    COMMAND sh -c "mkdir -p mixed && cd mixed && \"$1\" -std=c++17 -I\"$2\" -c \"$3/headers.cpp\" \"$3/compiled.cpp\" &&
      ar rcs libheaders.a headers.o && \"$1\" compiled.o libheaders.a \"$4\" -pthread -o mixed" sh
      ${CMAKE_CXX_COMPILER} ${_include} ${CMAKE_CURRENT_SOURCE_DIR}/guards/mixed $<TARGET_FILE:dfb_compiled>)
  set_tests_properties(guard.compiled_mixed_library PROPERTIES LABELS guard
    PASS_REGULAR_EXPRESSION "dfb_either_all_files_with_dfb_compiled_or_none.*TLS")
  add_test(NAME guard.compiled_apart
    COMMAND sh -c "\"$@\" -DDFB_COMPILED -DDFB_COMPILING -o apart_compiled.so && \"$@\" -o apart_headers.so &&
      \"$1\" -shared -Wl,--no-as-needed apart_compiled.so apart_headers.so -o apart.so" sh
      ${CMAKE_CXX_COMPILER} -std=c++17 -I${_include} -shared -fPIC -include dfb/compiled.hpp
      ${CMAKE_CURRENT_SOURCE_DIR}/guards/empty.cpp)
  set_tests_properties(guard.compiled_apart PROPERTIES LABELS guard)
endif()

# Wrong use gives our message as the first error. The cases are in the files; a new case needs only a line
#   #elif defined(CASE_<NAME>) // expect: <message>      or   // flags: <flag>... expect: <message>
# Without a case the file is the control, which must compile. dfb.hpp is precompiled once for all files that begin with
# it. A compiler that cannot use the result reads dfb.hpp itself.
set(_early ${CMAKE_CURRENT_BINARY_DIR}/compile_fail/dfb_early.hpp)
file(CONFIGURE OUTPUT ${_early} CONTENT "#include <dfb/dfb.hpp>\n" @ONLY)
if(CMAKE_CXX_COMPILER_ID STREQUAL "GNU")
  set(_early_suffix gch)
else()
  set(_early_suffix pch)
endif()
add_test(NAME compile_fail.dfb_early
  COMMAND ${CMAKE_CXX_COMPILER} -std=c++17 ${DFB_QUICK_COMPILE} -DDFB_COMPILED -I${_include}
    -x c++-header ${_early} -o ${_early}.${_early_suffix})
set_tests_properties(compile_fail.dfb_early PROPERTIES LABELS compile_fail FIXTURES_SETUP dfb_early)

function(_dfb_add_compile_fail file)
  set(path ${CMAKE_CURRENT_SOURCE_DIR}/guards/compile_fail/${file}.cpp)
  set_property(DIRECTORY APPEND PROPERTY CMAKE_CONFIGURE_DEPENDS ${path})
  set(early "")
  set(fixture "")
  file(STRINGS ${path} umbrella REGEX "^#include <dfb/dfb\\.hpp>")
  if(umbrella)
    set(early -include ${_early})
    set(fixture FIXTURES_REQUIRED dfb_early)
  endif()
  add_test(NAME compile_fail.${file}.control COMMAND ${_compile} -DDFB_COMPILED -I${_include} ${early} ${path})
  set_tests_properties(compile_fail.${file}.control PROPERTIES LABELS compile_fail ${fixture})
  file(STRINGS ${path} lines REGEX "defined\\(CASE_")
  foreach(line IN LISTS lines)
    if(NOT line MATCHES "^#(el)?if defined\\(CASE_([A-Z0-9_]+)\\) // (flags: (.*) )?expect: (.+)$")
      message(FATAL_ERROR "${path}: no case and its message in '${line}'")
    endif()
    set(case ${CMAKE_MATCH_2})
    separate_arguments(flags UNIX_COMMAND "${CMAKE_MATCH_4}")
    string(REGEX REPLACE "([][+.*()^?|$\\])" "\\\\\\1" message "${CMAKE_MATCH_5}")
    string(TOLOWER ${case} name)
    add_test(NAME compile_fail.${file}.${name}
      COMMAND ${_compile} -Wfatal-errors -DDFB_COMPILED -I${_include} ${flags} ${early} -DCASE_${case} ${path})
    set_tests_properties(compile_fail.${file}.${name} PROPERTIES
      LABELS compile_fail ${fixture} PASS_REGULAR_EXPRESSION "error:[^\n]*${message}")
  endforeach()
endfunction()

file(GLOB _files CONFIGURE_DEPENDS guards/compile_fail/*.cpp)
foreach(_file IN LISTS _files)
  get_filename_component(_file ${_file} NAME_WE)
  _dfb_add_compile_fail(${_file})
endforeach()
