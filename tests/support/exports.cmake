# cmake -DLIBRARY=libdfb_icet.so -DEXPORTS=exports.map -DCOUNT=49 -DNM=nm -P exports.cmake
# Checks that the library exports exactly the functions of exports.map, and that these are COUNT.
file(STRINGS ${EXPORTS} wanted REGEX "^ +[A-Za-z0-9_]+;$")
list(TRANSFORM wanted REPLACE "[ ;]" "")
execute_process(COMMAND ${NM} -D --defined-only ${LIBRARY} OUTPUT_VARIABLE lines COMMAND_ERROR_IS_FATAL ANY)
string(REGEX MATCHALL "[^ \n]+\n" shown "${lines}")
list(TRANSFORM shown STRIP)
list(SORT wanted)
list(SORT shown)
list(LENGTH shown count)
if(NOT "${shown}" STREQUAL "${wanted}" OR NOT count EQUAL COUNT)
  message(FATAL_ERROR "${LIBRARY} shows ${count} names: ${shown}\nexpected: ${wanted}")
endif()
