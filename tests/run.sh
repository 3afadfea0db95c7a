#!/bin/sh
# sh tests/run.sh [CTEST ARGUMENT...]
# Installs what is missing, builds the preset "dev" in build/dev, and runs all tests; arguments go to ctest, for
# example: sh tests/run.sh -L unit
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
cd "$root"
sh cmake/install_packages.sh tests

jobs=$(sh cmake/jobs.sh)
cmake --preset dev
cmake --build --preset dev --parallel "$jobs"
exec ctest --preset dev --parallel $((4 * jobs + 3)) "$@" # slots, see tests/CMakeLists.txt
