# cpack -G DEB in the build folder makes libdfb-dev_<version>_all.deb. It is for all processors, as nothing in it is
# compiled, not even dfb::compiled. It depends on the packages that the headers of this build's components need.
set(CPACK_PACKAGE_CONTACT "the maintainers of dfb <maintainers@dfb.invalid>")
set(CPACK_PACKAGE_DESCRIPTION_SUMMARY "Distributed rendering: the tiles of many ranks become one image (headers)")
set(CPACK_RESOURCE_FILE_LICENSE ${PROJECT_SOURCE_DIR}/LICENSE)
set(CPACK_STRIP_FILES OFF)
# Whatever the umask is.
set(CPACK_INSTALL_DEFAULT_DIRECTORY_PERMISSIONS OWNER_READ OWNER_WRITE OWNER_EXECUTE GROUP_READ GROUP_EXECUTE
  WORLD_READ WORLD_EXECUTE)

set(CPACK_DEBIAN_PACKAGE_NAME libdfb-dev)
set(CPACK_DEBIAN_FILE_NAME DEB-DEFAULT)
set(CPACK_DEBIAN_PACKAGE_ARCHITECTURE all)
set(CPACK_DEBIAN_PACKAGE_SECTION libdevel)
set(CPACK_DEBIAN_PACKAGE_SUGGESTS "cmake (>= 3.16), pkg-config")
set(_dfb_depends "")
if(DFB_WITH_MPI)
  list(APPEND _dfb_depends "libmpich-dev | libopenmpi-dev")
endif()
if(DFB_WITH_TBB)
  list(APPEND _dfb_depends "libtbb-dev")
endif()
if(DFB_WITH_SNAPPY)
  list(APPEND _dfb_depends "libsnappy-dev")
endif()
list(JOIN _dfb_depends ", " CPACK_DEBIAN_PACKAGE_DEPENDS)

string(REGEX REPLACE "([][+.*()^?|$\\])" "\\\\\\1" _dfb_source "${PROJECT_SOURCE_DIR}")
set(CPACK_SOURCE_IGNORE_FILES "^${_dfb_source}/(build|[.]git)/")
include(CPack)
