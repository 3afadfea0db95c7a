// Catch itself, compiled once for all test programs.
#define CATCH_CONFIG_RUNNER
#include "catch.hpp"

#include "run_tests.hpp"

int runTests(int argc, char** argv)
{
    return Catch::Session().run(argc, argv);
}
