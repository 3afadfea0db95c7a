# cmake -D CXX= -D MAIN= -D STAGE= -D BUILD= -D MODULE= -D VERSION= -D EXPECT= [-D SOURCE= -D OPTIONS= -D GENERATOR=]
#   -P pkg_config.cmake
# Compiles main.cpp in the folder BUILD with the flags that pkg-config gives for MODULE, as installed in STAGE, and runs
# it. With SOURCE, first installs dfb there with a build that finds no pkg-config modules, so that dfb.pc has the flags
# of dependencies itself.
cmake_minimum_required(VERSION 3.21)

file(REMOVE_RECURSE ${BUILD})
file(MAKE_DIRECTORY ${BUILD})
if(SOURCE)
  string(REPLACE "|" ";" OPTIONS "${OPTIONS}")
  execute_process(COMMAND ${CMAKE_COMMAND} -S ${SOURCE} -B ${BUILD}/build -G ${GENERATOR} ${OPTIONS} -DDFB_BUILD_TESTS=OFF
    -DDFB_BUILD_EXAMPLES=OFF -DDFB_BUILD_BENCH=OFF -DCMAKE_DISABLE_FIND_PACKAGE_PkgConfig=ON -DCMAKE_INSTALL_PREFIX=${STAGE}
    OUTPUT_QUIET COMMAND_ERROR_IS_FATAL ANY)
  execute_process(COMMAND ${CMAKE_COMMAND} --install ${BUILD}/build OUTPUT_QUIET COMMAND_ERROR_IS_FATAL ANY)
endif()

set(ENV{PKG_CONFIG_PATH} ${STAGE}/share/pkgconfig:$ENV{PKG_CONFIG_PATH})
execute_process(COMMAND pkg-config --modversion ${MODULE} OUTPUT_VARIABLE version OUTPUT_STRIP_TRAILING_WHITESPACE
  COMMAND_ERROR_IS_FATAL ANY)
if(NOT version STREQUAL VERSION)
  message(FATAL_ERROR "pkg-config says version ${version}, CMake ${VERSION}")
endif()
file(STRINGS ${STAGE}/share/pkgconfig/${MODULE}.pc requires REGEX "^Requires:.* (mpi|mpich|ompi-cxx|tbb|snappy)")
if(SOURCE AND requires)
  message(FATAL_ERROR "modules were not to be found, but ${MODULE}.pc has '${requires}'")
endif()

set(definitions "-DWITH_FRAME=0")
foreach(component MPI TBB SNAPPY TESTING)
  string(TOLOWER ${component} lower)
  if(",${EXPECT}," MATCHES ",${lower},")
    string(APPEND definitions " -DEXPECT_${component}=1")
  else()
    string(APPEND definitions " -DEXPECT_${component}=0")
  endif()
endforeach()
# The flags are meant for a shell, with escaped spaces in paths.
execute_process(COMMAND sh -xc "eval \"'${CXX}' -std=c++17 ${definitions} '${MAIN}' $(pkg-config --cflags --libs ${MODULE}) -o consumer\" && ./consumer"
  WORKING_DIRECTORY ${BUILD} COMMAND_ERROR_IS_FATAL ANY)
