# Install rules. Each component has an export of its own, so that find_package(dfb COMPONENTS core) of a user looks only
# for what core needs.
include(GNUInstallDirs)
include(CMakePackageConfigHelpers)

# Headers are the same on all processors, and so are all installed files.
set(_dfb_config_dir ${CMAKE_INSTALL_DATADIR}/cmake/dfb)
target_include_directories(dfb_core INTERFACE $<INSTALL_INTERFACE:${CMAKE_INSTALL_INCLUDEDIR}>)
install(DIRECTORY ${PROJECT_SOURCE_DIR}/include/dfb DESTINATION ${CMAKE_INSTALL_INCLUDEDIR}
  FILES_MATCHING PATTERN "*.hpp" PATTERN "compiled.cpp")

install(TARGETS dfb_core dfb_strict_fp EXPORT dfb-core)
foreach(_dfb_component IN LISTS DFB_COMPONENTS)
  if(NOT _dfb_component STREQUAL "core")
    install(TARGETS dfb_${_dfb_component} EXPORT dfb-${_dfb_component})
  endif()
  install(EXPORT dfb-${_dfb_component} NAMESPACE dfb:: FILE dfb-${_dfb_component}.cmake
    DESTINATION ${_dfb_config_dir})
endforeach()

# For a project that has dfb's sources in it and exports a library which links dfb::dfb. The file is not installed, as
# dfbConfig.cmake makes dfb::dfb.
install(TARGETS dfb EXPORT dfb-dfb)
install(EXPORT dfb-dfb NAMESPACE dfb:: FILE dfb-dfb.cmake DESTINATION ${_dfb_config_dir}
  COMPONENT dfb-dfb EXCLUDE_FROM_ALL)

# Installed only by cmake --install <build> --component testing.
target_include_directories(dfb_testing INTERFACE $<INSTALL_INTERFACE:${CMAKE_INSTALL_INCLUDEDIR}/dfb-testing>)
install(DIRECTORY ${PROJECT_SOURCE_DIR}/tests/include/dfb DESTINATION ${CMAKE_INSTALL_INCLUDEDIR}/dfb-testing
  COMPONENT testing EXCLUDE_FROM_ALL FILES_MATCHING PATTERN "*.hpp")
install(TARGETS dfb_testing EXPORT dfb-testing)
install(EXPORT dfb-testing NAMESPACE dfb:: FILE dfb-testing.cmake DESTINATION ${_dfb_config_dir}
  COMPONENT testing EXCLUDE_FROM_ALL)

configure_package_config_file(${CMAKE_CURRENT_LIST_DIR}/dfbConfig.cmake.in
  ${PROJECT_BINARY_DIR}/dfbConfig.cmake INSTALL_DESTINATION ${_dfb_config_dir} PATH_VARS CMAKE_INSTALL_INCLUDEDIR)
write_basic_package_version_file(${PROJECT_BINARY_DIR}/dfbConfigVersion.cmake
  COMPATIBILITY SameMinorVersion ARCH_INDEPENDENT)
install(FILES ${PROJECT_BINARY_DIR}/dfbConfig.cmake ${PROJECT_BINARY_DIR}/dfbConfigVersion.cmake
  DESTINATION ${_dfb_config_dir})
install(FILES ${PROJECT_SOURCE_DIR}/LICENSE DESTINATION ${CMAKE_INSTALL_DATAROOTDIR}/doc/dfb)

# For pkg-config: dfb-core.pc is for the headers alone, dfb.pc for all components. A dependency is named by the module
# of pkg-config that has the headers which CMake has found, which keeps paths of this machine out. If there is no such
# module, dfb.pc has the flags of the dependency itself.
find_package(PkgConfig QUIET)
set(_dfb_pc_requires dfb-core)
set(_dfb_pc_cflags "")
set(_dfb_pc_libs "")

# _dfb_pc_add(<component> <target> <libraries> <module>...)
function(_dfb_pc_add component target libraries)
  string(TOUPPER ${component} definition)
  string(APPEND _dfb_pc_cflags " -DDFB_HAS_${definition}=1")
  get_target_property(folders ${target} INTERFACE_INCLUDE_DIRECTORIES)
  set(real "")
  if(NOT folders)
    set(folders "")
    set(real ${CMAKE_CXX_IMPLICIT_INCLUDE_DIRECTORIES}) # such as those of mpicxx, if it is the compiler of this build
  endif()
  foreach(folder IN LISTS folders)
    get_filename_component(folder ${folder} REALPATH)
    list(APPEND real ${folder})
  endforeach()
  set(found "")
  foreach(module IN LISTS ARGN)
    if(PKG_CONFIG_FOUND AND NOT found)
      pkg_get_variable(folder ${module} includedir)
      get_filename_component(folder "${folder}" REALPATH)
      if(folder IN_LIST real)
        set(found ${module})
      endif()
    endif()
  endforeach()
  if(found)
    string(APPEND _dfb_pc_requires " ${found}")
  else()
    list(TRANSFORM folders PREPEND " -I")
    string(APPEND _dfb_pc_cflags ${folders})
    list(JOIN libraries " " libraries)
    string(APPEND _dfb_pc_libs " ${libraries}")
  endif()
  foreach(name requires cflags libs)
    set(_dfb_pc_${name} "${_dfb_pc_${name}}" PARENT_SCOPE)
  endforeach()
endfunction()

if(TARGET dfb_mpi)
  # Leaves out the C++ bindings that mpi.h may have, as pkg-config's mpi does not link them.
  string(APPEND _dfb_pc_cflags " -DMPICH_SKIP_MPICXX=1 -DOMPI_SKIP_MPICXX=1")
  _dfb_pc_add(mpi MPI::MPI_CXX "${MPI_CXX_LIBRARIES}" mpi ompi-cxx mpich) # mpi: of Debian, whichever is chosen
endif()
if(TARGET dfb_tbb)
  _dfb_pc_add(tbb TBB::tbb $<TARGET_LINKER_FILE:TBB::tbb> tbb)
endif()
if(TARGET dfb_snappy)
  _dfb_pc_add(snappy Snappy::snappy $<TARGET_LINKER_FILE:Snappy::snappy> snappy)
endif()

# With a generator for several configurations, the files are for one of them: Release if there is one.
set(_dfb_pc_condition "")
if(CMAKE_CONFIGURATION_TYPES)
  list(GET CMAKE_CONFIGURATION_TYPES 0 _dfb_pc_config)
  if("Release" IN_LIST CMAKE_CONFIGURATION_TYPES)
    set(_dfb_pc_config Release)
  endif()
  set(_dfb_pc_condition CONDITION $<CONFIG:${_dfb_pc_config}>)
endif()
# Relative to the .pc file, as an installed package may be moved.
file(RELATIVE_PATH _dfb_pc_include ${CMAKE_INSTALL_FULL_DATADIR}/pkgconfig ${CMAKE_INSTALL_FULL_INCLUDEDIR})
foreach(_dfb_name dfb dfb-core)
  configure_file(${CMAKE_CURRENT_LIST_DIR}/${_dfb_name}.pc.in ${PROJECT_BINARY_DIR}/${_dfb_name}.pc.in @ONLY)
  file(GENERATE OUTPUT ${PROJECT_BINARY_DIR}/${_dfb_name}.pc INPUT ${PROJECT_BINARY_DIR}/${_dfb_name}.pc.in
    ${_dfb_pc_condition})
  install(FILES ${PROJECT_BINARY_DIR}/${_dfb_name}.pc DESTINATION ${CMAKE_INSTALL_DATADIR}/pkgconfig)
endforeach()
