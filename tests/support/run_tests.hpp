#pragma once

// Runs the tests that the arguments select and returns Catch's exit code.
int runTests(int argc, char** argv);
