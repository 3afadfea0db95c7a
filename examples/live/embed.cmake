# Run with: cmake -DIN=<file> -DOUT=<.cpp> -P embed.cmake
# Writes a C++ source that has the file as a string.
file(READ ${IN} text)
# Compilers may limit a literal to 65536 characters. Adjacent literals are joined.
string(LENGTH "${text}" length)
set(literals "")
set(at 0)
while(at LESS length)
  string(SUBSTRING "${text}" ${at} 8000 part)
  string(APPEND literals "\n    R\"page(${part})page\"")
  math(EXPR at "${at} + 8000")
endwhile()
file(WRITE ${OUT} "// Made of view.html.
namespace example {
extern const char viewPage[];
const char viewPage[] =${literals};
} // namespace example
")
