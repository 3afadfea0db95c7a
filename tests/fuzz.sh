#!/bin/sh
# sh tests/fuzz.sh [SECONDS [TARGET...]]
# Installs what is missing and builds the fuzz targets for libFuzzer with the preset "fuzz". Runs each target, or those
# that are named, for SECONDS (default 60), as many at a time as there are cores. New inputs are kept in
# build/fuzz/corpus. An input that crashes a target is kept in build/fuzz/crashes and should be added to
# tests/fuzz/corpus.
set -u

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
cd "$root" || exit 1
seconds=${1:-60}
[ $# -eq 0 ] || shift
case $seconds in
*[!0-9]* | 0) # for libFuzzer: without end
    echo "usage: sh tests/fuzz.sh [SECONDS [TARGET...]]" >&2
    exit 2
    ;;
esac
sh cmake/install_packages.sh clang || exit 1

jobs=$(sh cmake/jobs.sh)
cmake --preset fuzz || exit 1
# shellcheck disable=SC2046 # one word per target
[ $# -gt 0 ] || set -- $(cmake --build --preset fuzz --target help | sed -nE 's/^test_fuzz_([a-z_]+): phony$/\1/p')

programs=""
for target; do
    programs="$programs test_fuzz_$target"
    mkdir -p "build/fuzz/corpus/$target" build/fuzz/crashes
    rm -f "build/fuzz/$target.failed" # of a run that was interrupted
done
# shellcheck disable=SC2086 # one word per program
cmake --build --preset fuzz --parallel "$jobs" --target $programs || exit 1

# A single input may take 10 seconds and 2 GB, at most 256 MB in one allocation.
export ASAN_OPTIONS="detect_stack_use_after_return=1" UBSAN_OPTIONS="print_stacktrace=1"
printf '%s\n' "$@" | xargs -P "$jobs" -I{} sh -c '
    build/fuzz/tests/test_fuzz_{} -max_total_time='"$seconds"' -timeout=10 -rss_limit_mb=2048 -malloc_limit_mb=256 -max_len=8192 \
        -use_value_profile=1 -print_final_stats=1 -artifact_prefix=build/fuzz/crashes/{}- \
        build/fuzz/corpus/{} tests/fuzz/corpus/{} >build/fuzz/{}.log 2>&1 || touch build/fuzz/{}.failed'

verdict=passed
for target; do
    log=build/fuzz/$target.log
    runs=$(sed -n 's/^stat::number_of_executed_units: *//p' "$log")
    reached=$(sed -nE 's/.*(cov: [0-9]+ ft: [0-9]+).*/\1/p' "$log" | tail -n 1)
    echo "fuzz.sh: $target: ${runs:-?} runs, ${reached:-}"
    if [ -e "build/fuzz/$target.failed" ]; then
        rm "build/fuzz/$target.failed"
        tail -n 60 "$log"
        verdict=FAILED
    fi
done
echo "fuzz.sh: $verdict"
[ $verdict = passed ]
