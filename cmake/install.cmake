# Install rules. Each component has an export of its own, so that a user's find_package(dfb COMPONENTS core)
# looks for nothing but what core needs.
include(GNUInstallDirs)
include(CMakePackageConfigHelpers)

set(_dfb_config_dir ${CMAKE_INSTALL_LIBDIR}/cmake/dfb)
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

# Only by cmake --install <build> --component testing.
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
