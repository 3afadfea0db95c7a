// The namespace of a version: two versions of the library that are compiled into one process have different names.
#include "catch.hpp"

#include <dfb/base/double_double.hpp>
#include <dfb/image.hpp>

#include <string>
#include <type_traits>
#include <typeinfo>

namespace version {

TEST_CASE("The linker sees the version in every name, and a program does not")
{
    const std::string version = "v" + std::to_string(DFB_VERSION_MAJOR) + "_" + std::to_string(DFB_VERSION_MINOR);
    CHECK(std::string(typeid(dfb::Image).name()).find(version) != std::string::npos);
    CHECK(std::string(typeid(dfb::detail::DoubleDouble).name()).find(version) != std::string::npos);
    CHECK(std::is_same_v<dfb::Image, dfb::DFB_NAMESPACE_OF(DFB_VERSION_MAJOR, DFB_VERSION_MINOR)::Image>);
}

} // namespace version
