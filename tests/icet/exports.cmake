# cmake -DLIBRARY=libdfb_icet.so -DEXPORTS=exports.map -DNM=nm -P exports.cmake
# The library shows the functions of exports.map and nothing else.
file(STRINGS ${EXPORTS} wanted REGEX "^ +icet[A-Za-z]+;$")
list(TRANSFORM wanted REPLACE "[ ;]" "")
execute_process(COMMAND ${NM} -D --defined-only ${LIBRARY} OUTPUT_VARIABLE lines COMMAND_ERROR_IS_FATAL ANY)
string(REGEX MATCHALL "[^ \n]+\n" shown "${lines}")
list(TRANSFORM shown STRIP)
list(SORT wanted)
list(SORT shown)
list(LENGTH shown count)
if(NOT "${shown}" STREQUAL "${wanted}" OR NOT count EQUAL 49)
  message(FATAL_ERROR "${LIBRARY} shows ${count} names: ${shown}\nexpected: ${wanted}")
endif()
