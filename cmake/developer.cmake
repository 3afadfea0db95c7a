# dfb_developer: what our own tests and programs are compiled with. Nothing of it reaches a user's targets.
add_library(dfb_developer INTERFACE)
target_link_libraries(dfb_developer INTERFACE dfb::dfb dfb::testing dfb::strict_fp)
if(NOT MSVC)
  target_compile_options(dfb_developer INTERFACE
    -Wall -Wextra -Wpedantic -Wshadow -Woverloaded-virtual
    $<$<BOOL:${DFB_WARNINGS_AS_ERRORS}>:-Werror>)
endif()
