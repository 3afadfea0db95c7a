# What our own tests and programs are compiled with. Nothing of it reaches a user's targets.
# dfb_developer_flags    warnings, and results that do not depend on the compiler
# dfb_developer          these, and the library, compiled once unless DFB_DEVELOP_HEADER_ONLY
# dfb_developer_headers  these, and the library as headers alone
option(DFB_DEVELOP_HEADER_ONLY "Compile dfb's own tests and programs without dfb::compiled" OFF)

add_library(dfb_developer_flags INTERFACE)
target_link_libraries(dfb_developer_flags INTERFACE dfb::strict_fp)
if(NOT MSVC)
  target_compile_options(dfb_developer_flags INTERFACE
    -Wall -Wextra -Wpedantic -Wshadow -Woverloaded-virtual
    $<$<BOOL:${DFB_WARNINGS_AS_ERRORS}>:-Werror>)
endif()
target_link_libraries(dfb_compiled PRIVATE dfb_developer_flags)

add_library(dfb_developer_headers INTERFACE)
target_link_libraries(dfb_developer_headers INTERFACE dfb_developer_flags dfb::dfb dfb::testing)

add_library(dfb_developer INTERFACE)
if(DFB_DEVELOP_HEADER_ONLY)
  target_link_libraries(dfb_developer INTERFACE dfb_developer_headers)
else()
  target_link_libraries(dfb_developer INTERFACE dfb_developer_flags dfb::compiled dfb::testing)
endif()

# Where bench/get_icet.sh puts IceT, for the adapter in its place, for its test and for benchmarks.
set(DFB_ICET_DIR ${PROJECT_SOURCE_DIR}/build/peers/icet CACHE PATH "IceT: where include/IceT.h and lib are")
