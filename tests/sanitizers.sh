#!/bin/sh
# sh tests/sanitizers.sh [--brief] [PRESET...]
# Installs what is missing, builds the presets "asan", "tsan" and "clang", or those that are named, and runs the
# library's tests in each. With --brief, for CI,
#   "asan" leaves out tests with ranks as threads, which "tsan" runs; 2 and 7 ranks over MPI, as it runs 3; cameras,
#     which "tsan" runs, too; and the check for uses of a function's variables after its end, which takes most of the
#     time;
#   "tsan" leaves out tests with a single thread, which "asan" runs: fuzz targets and the longer unit tests;
#   both leave out instruction sets, numbers, counts of work and steps of credit, which take them minutes, and are brief
#     in what they run: see tests/support/brief.hpp.
set -u

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
cd "$root" || exit 1

brief=no
if [ "${1:-}" = --brief ]; then
    brief=yes
    shift
fi
for preset in "$@"; do
    case $preset in
    asan | tsan | clang) ;;
    *)
        echo "usage: sh tests/sanitizers.sh [--brief] [asan] [tsan] [clang]" >&2
        exit 2
        ;;
    esac
done
sh cmake/install_packages.sh clang || exit 1
jobs=$(sh cmake/jobs.sh)
[ $# -gt 0 ] || set -- asan tsan clang

# All test programs except those of guards, which the presets leave out. A test without its program fails.
run() {
    cmake --preset "$1" || return
    without='^test_(odr|documented)$' tests='^$' test_preset=$1 long='stress[.]|unit[.]flow_control$'
    if [ "$1" = asan ] && [ $brief = yes ]; then
        without='^test_(odr|documented|inproc|conformance|stress|skip|scaling|isa_[a-z_]+)$'
        tests="^($long|unit[.]cameras\$|(inproc|conformance)[.]|(mpi|conformance_mpi)[.][a-z_]+[.]np[27]\$)"
        test_preset=asan-brief
    elif [ "$1" = tsan ] && [ $brief = yes ]; then
        fuzz='control|finished|fragment|packet|readers|tracker'
        unit='blend_kernels|dependency_tracker|fragment_message|levels|quiescence|sparse_planes|tile_ops|visibility|wire_format'
        without="^test_(odr|documented|stress|skip|scaling|isa_[a-z_]+|fuzz_($fuzz))\$"
        tests="^($long|unit[.]($unit)\$|fuzz[.]($fuzz)\$)" test_preset=tsan-brief
    fi
    targets=$(cmake --build --preset "$1" --target help | sed -nE 's/^((test|mpi)_[a-z_]+): phony$/\1/p' |
        grep -Ev "$without") || return
    # shellcheck disable=SC2086 # one word per target
    cmake --build --preset "$1" --parallel "$jobs" --target $targets || return
    ctest --preset "$test_preset" --parallel $((4 * jobs + 3)) -E "$tests" # slots, see tests/CMakeLists.txt
}

results=""
verdict=passed
for preset; do
    started=$(date +%s)
    if run "$preset"; then
        result=passed
    else
        result=FAILED
        verdict=FAILED
    fi
    results="$results, $preset $result in $(($(date +%s) - started)) s"
done
echo "sanitizers.sh: $verdict (${results#, })"
[ $verdict = passed ]
