#!/bin/sh
# sh tests/sanitizers.sh [--brief] [PRESET...]
# Installs what is missing, then builds the presets "asan", "tsan" and "clang", or those that are named, and runs the
# tests of what the library does in each. With --brief, for CI,
#   "asan" leaves out what runs in one process with ranks as threads, which "tsan" has; what computes numbers or steps of
#     credit for a minute and more, which "tsan" has as well; 2 and 7 ranks over MPI, as it has 3; instruction sets; and
#     uses of a function's variables after its end, for which it takes most of the time;
#   "tsan" leaves out instruction sets, and fuzz targets of one thread, which "asan" has.
set -u

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
cd "$root" || exit 1
sh cmake/install_packages.sh clang || exit 1

brief=no
if [ "${1:-}" = --brief ]; then
    brief=yes
    shift
fi
jobs=$(getconf _NPROCESSORS_ONLN 2>/dev/null || echo 2)
[ $# -gt 0 ] || set -- asan tsan clang

# All test programs but that of guard.odr, which runs nothing and takes long to compile. A test whose program is missing
# fails.
run() {
    cmake --preset "$1" || return
    without='^test_odr$' tests='^$' test_preset=$1
    if [ "$1" = asan ] && [ $brief = yes ]; then
        without='^test_(odr|inproc|stress|isa_[a-z_]+)$'
        tests='^(inproc[.]|stress[.]|unit[.]flow_control$|(mpi|conformance_mpi)[.][a-z_]+[.]np[27]$)' test_preset=asan-brief
    elif [ "$1" = tsan ] && [ $brief = yes ]; then
        fuzz='control|finished|fragment|packet|readers|tracker'
        without="^test_(odr|isa_[a-z_]+|fuzz_($fuzz))\$"
        tests="^(stress[.]isa|fuzz[.]($fuzz)\$)"
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
