#pragma once

// Runs this program's tests as its arguments say; returns Catch's exit code.
int runTests(int argc, char** argv);
