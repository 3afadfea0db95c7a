#include <dfb/dfb.hpp>
#include <dfb/trace_file.hpp>

int second()
{
    return 0;
}
