# Target docs: makes a site of docs/ and the headers in <build>/site/html. A warning of Doxygen or a broken link is an
# error. Needs Doxygen 1.9.1 or later; looks better with doxygen-awesome-css.
find_package(Doxygen 1.9.1 QUIET)
if(NOT DOXYGEN_FOUND)
  return()
endif()
set(DFB_SITE ${PROJECT_BINARY_DIR}/site)
find_file(DFB_SITE_STYLE doxygen-awesome.css PATHS /usr/share /usr/local/share PATH_SUFFIXES doxygen-awesome-css NO_DEFAULT_PATH)
mark_as_advanced(DFB_SITE_STYLE)
if(NOT DFB_SITE_STYLE)
  set(DFB_SITE_STYLE "")
endif()

# A page for each example that is a single file, or for the main file of its folder
file(GLOB examples CONFIGURE_DEPENDS ${PROJECT_SOURCE_DIR}/examples/*.cpp ${PROJECT_SOURCE_DIR}/examples/tachyon/*.cpp
  ${PROJECT_SOURCE_DIR}/examples/opencl/*.cpp ${PROJECT_SOURCE_DIR}/examples/vtk/*.cpp
  ${PROJECT_SOURCE_DIR}/examples/adapters/c/minimal.c
  ${PROJECT_SOURCE_DIR}/examples/adapters/c/heat.f90)
set(pages "")
foreach(example IN LISTS examples)
  get_filename_component(example ${example} NAME)
  string(APPEND pages "/** @example ${example} */\n")
endforeach()
file(WRITE ${DFB_SITE}/examples.dox "${pages}")

if(NOT EXISTS ${PROJECT_SOURCE_DIR}/docs/site/Doxyfile.in) # only a part of the sources
  return()
endif()
configure_file(${PROJECT_SOURCE_DIR}/docs/site/Doxyfile.in ${DFB_SITE}/Doxyfile @ONLY)
add_custom_target(docs
  COMMAND ${CMAKE_COMMAND} -E remove_directory ${DFB_SITE}/html
  COMMAND Doxygen::doxygen ${DFB_SITE}/Doxyfile
  COMMENT "Writing ${DFB_SITE}/html/index.html"
  VERBATIM)
