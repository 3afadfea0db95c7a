#include "catch.hpp"
#include <dfb/base/function_ref.hpp>

namespace function_ref_cases {

int calls = 0;
int countCall() { return ++calls; }

int twice(dfb::detail::FunctionRef<int(int)> function) { return function(function(1)); }
int doubled(int value) { return 2 * value; }

TEST_CASE("A reference to a callable takes lambdas and functions, and drops a result that nobody wants", "[functionref]")
{
    CHECK(twice([](int value) { return value + 3; }) == 7);
    CHECK(twice(doubled) == 4);

    const auto run = [](dfb::detail::FunctionRef<void()> body) { body(); };
    run(countCall);
    run([] { return ++calls; });
    CHECK(calls == 2);
}

} // namespace function_ref_cases
