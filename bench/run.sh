#!/bin/sh
# sh bench/run.sh [--quick]
# Installs what is missing, builds the preset "release", gets IceT to compare with, if it can be had, and runs
# bench_error_time on 4 and on 8 ranks: figures to bench/results, the table to README.md. 10 minutes, or 2.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
cd "$root"
frames=41
[ "${1:-}" != --quick ] || frames=5
jobs=$(getconf _NPROCESSORS_ONLN 2>/dev/null || echo 2)
commit=$(git rev-parse --short HEAD 2>/dev/null || echo unknown)
results=bench/results

sh cmake/install_packages.sh
sh bench/get_icet.sh || [ $? -eq 3 ] # without IceT the others are measured
cmake --preset release -DDFB_BUILD_BENCH=ON
cmake --build --preset release --parallel "$jobs" --target bench_error_time

mkdir -p "$results"
rm -f "$results"/error_time.*
for ranks in 4 8; do
    mpiexec -n "$ranks" build/release/bench/bench_error_time --frames "$frames" --commit "$commit" \
        --json "$results/error_time.json" --svg "$results/error_time.$ranks" --table "$results/error_time.$ranks.md"
done

# What the README has between its marks is what was measured.
awk -v ranks4="$results/error_time.4.md" -v ranks8="$results/error_time.8.md" '
    /<!-- end of error_time -->/ { skip = 0 }
    !skip { print }
    /<!-- error_time: written by bench\/run.sh -->/ {
        skip = 1
        for (i = 0; i < 2; ++i) {
            file = i ? ranks8 : ranks4
            while ((getline line < file) > 0) print line
        }
        print ""
    }' README.md >README.md.new
mv README.md.new README.md
