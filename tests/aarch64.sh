#!/bin/sh
# sh tests/aarch64.sh [CTEST ARGUMENT...]
# Builds the core of the library and tests for aarch64 (preset "aarch64": no MPI, ranks are threads), and runs them with
# qemu: the tests of headers and of numbers, and whole frames, one file after the other. It leaves out files that take a
# minute each there, and those whose ranks must answer within a time limit, for which qemu may be too slow on a busy
# machine. Composites the tiles of tests/stress/isa.cpp there and on this machine. All values must be equal bit for bit,
# and within 1 ulp without -ffp-contract=off, which is the flag of dfb::strict_fp. Arguments go to ctest and replace
# this choice of tests, such as -R '^inproc[.]' for all frames. Installs what is missing; takes 11 minutes on one core.
# Exits with 77 on machines other than x86-64, and if there is no cross compiler and none can be installed.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
cd "$root"
[ "$(uname -m)" = x86_64 ] || {
    echo "aarch64.sh: SKIPPED: it compares with x86-64, which this machine is not; sh tests/run.sh is for any" >&2
    exit 77
}
sh cmake/install_packages.sh aarch64 || exit 77
[ $# -gt 0 ] || set -- -R '^(unit|stress|inproc)\.' \
    -E '^(inproc\.(corners|counters|edges|image_compositor|moving|faults|lost_peers|messaging|timeouts)|stress\.(scaling|skip))$'
jobs=$(sh cmake/jobs.sh)

build=build/aarch64
cmake --preset aarch64
cmake --build --preset aarch64 --parallel "$jobs" --target test_unit test_stress test_inproc

# isa COMPILER OPTION... PROGRAM
isa() {
    "$@" -std=c++17 -O2 -Wall -Wextra -Werror -pthread -Iinclude -Itests/include tests/stress/isa.cpp
}
emulate() {
    qemu-aarch64 -L /usr/aarch64-linux-gnu "$@"
}
isa g++ -march=x86-64 -ffp-contract=off -o $build/isa_here
isa aarch64-linux-gnu-g++ -ffp-contract=off -o $build/isa
isa aarch64-linux-gnu-g++ -ffp-contract=fast -o $build/isa_contracted
$build/isa_here write $build/here.values
emulate $build/isa write $build/aarch64.values
emulate $build/isa_contracted write $build/contracted.values
echo "aarch64.sh: x86-64 and aarch64:"
$build/isa_here compare $build/here.values $build/aarch64.values 0
echo "aarch64.sh: the same with products and sums contracted on aarch64:"
$build/isa_here compare $build/here.values $build/contracted.values 1

exec ctest --preset aarch64 "$@"
