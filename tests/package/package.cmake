# Tests of the package: installs dfb, then builds and runs a user's project (CMakeLists.txt beside this file) against it
# in every way that the README promises.
if(NOT DFB_INSTALL)
  dfb_skip_test(package.install package "there are no install rules (DFB_INSTALL)")
  return()
endif()
set(_stage ${CMAKE_CURRENT_BINARY_DIR}/stage)
set(_others ${DFB_COMPONENTS})
list(REMOVE_ITEM _others core)

# Emptied first, as an install over an older one can leave stale files.
add_test(NAME package.clean COMMAND ${CMAKE_COMMAND} -E rm -rf ${_stage} ${_stage}_testing)
set_tests_properties(package.clean PROPERTIES LABELS package FIXTURES_SETUP dfb_stage_clean)
add_test(NAME package.install COMMAND ${CMAKE_COMMAND} --install ${PROJECT_BINARY_DIR} --prefix ${_stage})
set_tests_properties(package.install PROPERTIES LABELS package
  FIXTURES_REQUIRED dfb_stage_clean FIXTURES_SETUP dfb_stage)
# The component testing is installed only if it is named.
add_test(NAME package.install_testing COMMAND ${CMAKE_COMMAND} --install ${PROJECT_BINARY_DIR} --component testing
  --prefix ${_stage}_testing)
add_test(NAME package.install_for_testing COMMAND ${CMAKE_COMMAND} --install ${PROJECT_BINARY_DIR}
  --prefix ${_stage}_testing)
set_tests_properties(package.install_testing package.install_for_testing PROPERTIES LABELS package
  FIXTURES_REQUIRED dfb_stage_clean FIXTURES_SETUP dfb_stage_testing)

# dfb_add_package_test(<name> HOW <how> [STAGE <folder>] [VERSION <version>] [COMPONENTS <component>...] [EXPECT <component>...]
#                      [WITHOUT <package>...] [OPTIONS <option>...] [FAILS <regex>])
# WITHOUT: packages that are hidden, as if the machine did not have them.
function(dfb_add_package_test name)
  cmake_parse_arguments(PARSE_ARGV 1 A "" "HOW;STAGE;VERSION;FAILS" "COMPONENTS;EXPECT;WITHOUT;OPTIONS")
  if(NOT A_STAGE)
    set(A_STAGE stage)
  endif()
  list(JOIN A_COMPONENTS "," components)
  list(JOIN A_EXPECT "," expect)
  list(TRANSFORM A_WITHOUT REPLACE "(.+)" "-DCMAKE_DISABLE_FIND_PACKAGE_\\1=ON")
  set(arguments -DHOW=${A_HOW} -DVERSION=${A_VERSION} -DCOMPONENTS=${components} -DEXPECT=${expect}
    -DCMAKE_CXX_COMPILER=${CMAKE_CXX_COMPILER} -DCMAKE_CXX_COMPILER_LAUNCHER=${CMAKE_CXX_COMPILER_LAUNCHER}
    -DCMAKE_CXX_FLAGS=${DFB_QUICK_COMPILE} ${A_WITHOUT} ${A_OPTIONS})
  if(A_HOW STREQUAL "find_package")
    list(APPEND arguments -Ddfb_ROOT=${CMAKE_CURRENT_BINARY_DIR}/${A_STAGE})
  elseif(A_HOW STREQUAL "add_subdirectory")
    list(APPEND arguments -DDFB_SOURCE=${PROJECT_SOURCE_DIR})
  else()
    list(APPEND arguments -DFETCHCONTENT_SOURCE_DIR_DFB=${PROJECT_SOURCE_DIR})
  endif()
  list(JOIN arguments "|" arguments)

  add_test(NAME package.${name} COMMAND ${CMAKE_COMMAND}
    -DSOURCE=${CMAKE_CURRENT_SOURCE_DIR}/package
    -DBUILD=${CMAKE_CURRENT_BINARY_DIR}/package/${name}
    -DGENERATOR=${CMAKE_GENERATOR}
    -DARGUMENTS=${arguments}
    -DFAILS=${A_FAILS}
    -P ${CMAKE_CURRENT_SOURCE_DIR}/package/build_and_run.cmake)
  set_tests_properties(package.${name} PROPERTIES LABELS package TIMEOUT 900)
  if(A_HOW STREQUAL "find_package")
    set_tests_properties(package.${name} PROPERTIES FIXTURES_REQUIRED dfb_${A_STAGE})
  endif()
endfunction()

set(_name_of_mpi MPI)
set(_name_of_tbb TBB)
set(_name_of_snappy Snappy)

# All components, in three ways.
set(_minor ${PROJECT_VERSION_MAJOR}.${PROJECT_VERSION_MINOR})
dfb_add_package_test(find_package HOW find_package VERSION ${_minor} EXPECT ${_others} OPTIONS -DFRAME=ON)
foreach(_how add_subdirectory FetchContent)
  set(_options "")
  foreach(_component mpi tbb snappy)
    string(TOUPPER ${_component} _upper)
    list(APPEND _options -DDFB_WITH_${_upper}=${DFB_WITH_${_upper}})
  endforeach()
  if(_how STREQUAL "add_subdirectory")
    list(APPEND _options -Ddfb_ROOT=${_stage} -DDFB_INSTALL=ON)
  elseif(TARGET dfb::tbb)
    list(APPEND _options -DOWN_TBB=$<TARGET_FILE:TBB::tbb>
      "-DOWN_TBB_INCLUDE=$<TARGET_PROPERTY:TBB::tbb,INTERFACE_INCLUDE_DIRECTORIES>")
  endif()
  dfb_add_package_test(${_how} HOW ${_how} EXPECT ${_others} OPTIONS ${_options})
endforeach()
set_tests_properties(package.add_subdirectory PROPERTIES FIXTURES_REQUIRED dfb_stage)
# Folders of one project ask for different components.
list(JOIN _others "," _folders)
dfb_add_package_test(find_package_folders HOW find_package COMPONENTS core EXPECT ${_others}
  OPTIONS -DFOLDERS=${_folders})

# Core alone, and each component alone, on a machine that has no other dependency. The frame with core is tested below,
# with the compiled library; header.dfb compiles it as headers.
dfb_add_package_test(find_package_core HOW find_package COMPONENTS core WITHOUT MPI TBB Snappy)
dfb_add_package_test(add_subdirectory_core HOW add_subdirectory WITHOUT MPI TBB Snappy
  OPTIONS -DDFB_WITH_MPI=OFF -DDFB_WITH_TBB=OFF -DDFB_WITH_SNAPPY=OFF)
foreach(_component IN LISTS _others)
  set(_without MPI TBB Snappy)
  list(REMOVE_ITEM _without ${_name_of_${_component}})
  dfb_add_package_test(find_package_${_component} HOW find_package
    COMPONENTS ${_component} EXPECT ${_component} WITHOUT ${_without})
endforeach()

# The library compiled once, by the user's project: from the package and, with core alone, from the sources; the latter by
# another compiler than the one in use, if there is one. With MPI it also builds a program that was written from the
# documentation alone, and renders frames.
set(_frame -DFRAME=ON)
if(TARGET dfb::mpi)
  set(_frame -DDOOR=ON)
endif()
dfb_add_package_test(find_package_compiled HOW find_package EXPECT ${_others} OPTIONS -DCOMPILED=ON ${_frame})
if(TARGET dfb::mpi)
  set_tests_properties(package.find_package_compiled PROPERTIES FIXTURES_SETUP dfb_door)
  dfb_add_mpi_run(package.door RANKS 1 3 LABELS package
    COMMAND ${CMAKE_CURRENT_BINARY_DIR}/package/find_package_compiled/door)
  set_tests_properties(package.door.np1 package.door.np3 PROPERTIES FIXTURES_REQUIRED dfb_door)
endif()
set(_compiler "")
if(DFB_OTHER_CXX_WORKS)
  set(_compiler -DCMAKE_CXX_COMPILER=${DFB_OTHER_CXX} -DCMAKE_CXX_FLAGS=)
endif()
dfb_add_package_test(add_subdirectory_compiled HOW add_subdirectory WITHOUT MPI TBB Snappy
  OPTIONS ${_compiler} -DDFB_WITH_MPI=OFF -DDFB_WITH_TBB=OFF -DDFB_WITH_SNAPPY=OFF -DFRAME=ON -DCOMPILED=ON)

# With pkg-config and the compiler alone: all components, core, and all components if pkg-config does not know the
# dependencies.
find_program(DFB_PKG_CONFIG pkg-config)
mark_as_advanced(DFB_PKG_CONFIG)
if(DFB_PKG_CONFIG)
  function(dfb_add_pkg_config_test name module stage)
    list(JOIN ARGN "," expect)
    add_test(NAME package.${name} COMMAND ${CMAKE_COMMAND} -DCXX=${CMAKE_CXX_COMPILER} -DMODULE=${module} -DSTAGE=${stage}
      -DMAIN=${CMAKE_CURRENT_SOURCE_DIR}/package/main.cpp -DBUILD=${CMAKE_CURRENT_BINARY_DIR}/package/${name}
      -DVERSION=${PROJECT_VERSION} -DEXPECT=${expect} -DGENERATOR=${CMAKE_GENERATOR} ${_source}
      -P ${CMAKE_CURRENT_SOURCE_DIR}/package/pkg_config.cmake)
    set_tests_properties(package.${name} PROPERTIES LABELS package FIXTURES_REQUIRED dfb_stage)
  endfunction()
  set(_source "")
  dfb_add_pkg_config_test(pkg_config dfb ${_stage} ${_others})
  dfb_add_pkg_config_test(pkg_config_core dfb-core ${_stage})
  if(_others)
    set(_options -DCMAKE_CXX_COMPILER=${CMAKE_CXX_COMPILER} -DMPI_CXX_COMPILER=${MPI_CXX_COMPILER})
    foreach(_component MPI TBB SNAPPY)
      list(APPEND _options -DDFB_WITH_${_component}=${DFB_WITH_${_component}})
    endforeach()
    list(JOIN _options "|" _options)
    set(_source -DSOURCE=${PROJECT_SOURCE_DIR} -DOPTIONS=${_options})
    dfb_add_pkg_config_test(pkg_config_alone dfb ${CMAKE_CURRENT_BINARY_DIR}/package/pkg_config_alone/stage ${_others})
  endif()
endif()

# Core keeps to itself even where the compiler finds mpi.h.
if(MPI_CXX_INCLUDE_DIRS)
  list(JOIN MPI_CXX_INCLUDE_DIRS ":" _path)
  foreach(_test find_package_core add_subdirectory_core pkg_config_core)
    if(TEST package.${_test})
      set_tests_properties(package.${_test} PROPERTIES ENVIRONMENT CPATH=${_path})
    endif()
  endforeach()
endif()

# The component testing, in addition to the requested ones.
dfb_add_package_test(find_package_testing HOW find_package STAGE stage_testing COMPONENTS testing EXPECT testing
  WITHOUT MPI TBB Snappy)

# Requests that cannot be met give a clear error.
dfb_add_package_test(find_package_misses_testing HOW find_package COMPONENTS testing
  FAILS "component 'testing' is not installed")
# In versions 0.x each minor version has its own interface. A later patch satisfies a request for an earlier one.
math(EXPR _earlier "${PROJECT_VERSION_MINOR} - 1")
math(EXPR _later "${PROJECT_VERSION_MINOR} + 1")
math(EXPR _patch "${PROJECT_VERSION_PATCH} + 1")
foreach(_version ${PROJECT_VERSION_MAJOR}.${_earlier} ${PROJECT_VERSION_MAJOR}.${_later} ${_minor}.${_patch})
  dfb_add_package_test(refuses_${_version} HOW find_package VERSION ${_version} FAILS "requested version \"${_version}\"")
endforeach()
dfb_add_package_test(unknown_component HOW find_package COMPONENTS cuda FAILS "component 'cuda' is not installed")
foreach(_component IN LISTS _others)
  set(_package ${_name_of_${_component}})
  string(TOUPPER ${_component} _upper)
  dfb_add_package_test(find_package_misses_${_component} HOW find_package WITHOUT ${_package}
    FAILS "component '${_component}' needs ${_package}")
  dfb_add_package_test(add_subdirectory_misses_${_component} HOW add_subdirectory WITHOUT ${_package}
    FAILS "${_package} was not found.*apt-get install .*-DDFB_WITH_${_upper}=OFF")
endforeach()
