# cmake -DBUILD= -DSTAGE= -DADAPTER= -DLIBDIR= -DMPICC= -DMPIFORT= -P installed.cmake
# Installs component c into STAGE, and builds programs there as the adapter's README.md says; minimal.c also with the
# flags of pkg-config, if that is there. MPIFORT may be empty.
cmake_minimum_required(VERSION 3.21)
file(REMOVE_RECURSE ${STAGE})
execute_process(COMMAND ${CMAKE_COMMAND} --install ${BUILD} --component c --prefix ${STAGE} COMMAND_ERROR_IS_FATAL ANY)
file(COPY ${ADAPTER}/minimal.c ${ADAPTER}/heat.f90 DESTINATION ${STAGE})
file(STRINGS ${ADAPTER}/README.md lines REGEX "^    (mpicc|mpif90) ")
list(LENGTH lines count)
if(NOT count EQUAL 2)
  message(FATAL_ERROR "README.md has ${count} lines that build a program, not one for mpicc and one for mpif90")
endif()
foreach(line IN LISTS lines)
  string(STRIP "${line}" line)
  string(REPLACE "$DIR/lib" "$DIR/${LIBDIR}" line "${line}")
  if(line MATCHES "^mpif90" AND NOT MPIFORT)
    continue()
  endif()
  string(REGEX REPLACE "^mpicc" "${MPICC}" line "${line}")
  string(REGEX REPLACE "^mpif90" "${MPIFORT}" line "${line}")
  execute_process(COMMAND sh -ec "IFS=; DIR='${STAGE}'; ${line}" WORKING_DIRECTORY ${STAGE} COMMAND_ERROR_IS_FATAL ANY)
endforeach()
find_program(pkg_config pkg-config)
if(pkg_config)
  execute_process(WORKING_DIRECTORY ${STAGE} COMMAND_ERROR_IS_FATAL ANY COMMAND ${CMAKE_COMMAND} -E env
    PKG_CONFIG_PATH=${STAGE}/${LIBDIR}/pkgconfig
    sh -ec "${MPICC} -std=c99 minimal.c \$(${pkg_config} --cflags --libs dfb_c) -lm -o minimal")
endif()
