#!/bin/sh
# sh bench/run.sh [--quick]
# Installs what is missing, builds the preset "release", gets IceT to compare with, if it can be had, and runs
# bench_error_time on 4 and on 8 ranks, its table to README.md, bench_compositing and bench_overlap on 2, 4 and 8 ranks,
# and bench_paper on 8, their tables to bench/README.md; all figures to bench/results. 18 minutes, or 6.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
cd "$root"
frames=41 compositing_frames=11 views=12 paper_views=8 paper_sizes=256x256,512x512
[ "${1:-}" != --quick ] || frames=5 compositing_frames=3 views=4 paper_views=3 paper_sizes=256x256
jobs=$(getconf _NPROCESSORS_ONLN 2>/dev/null || echo 2)
commit=$(git rev-parse --short HEAD 2>/dev/null || echo unknown)
results=bench/results

sh cmake/install_packages.sh
sh bench/get_icet.sh || [ $? -eq 3 ] # without IceT the others are measured
cmake --preset release -DDFB_BUILD_BENCH=ON
cmake --build --preset release --parallel "$jobs" --target bench_error_time bench_compositing bench_overlap bench_paper

mkdir -p "$results"
rm -f "$results"/error_time.* "$results"/compositing.* "$results"/overlap.* "$results"/paper.*
for ranks in 4 8; do
    mpiexec -n "$ranks" build/release/bench/bench_error_time --frames "$frames" --commit "$commit" \
        --json "$results/error_time.json" --svg "$results/error_time.$ranks" --table "$results/error_time.$ranks.md"
done

for ranks in 2 4 8; do
    mpiexec -n "$ranks" build/release/bench/bench_compositing --scene all --size 1024x1024 \
        --frames "$compositing_frames" --commit "$commit" \
        --json "$results/compositing.json" --table "$results/compositing.md"
done

for ranks in 2 4 8; do
    mpiexec -n "$ranks" build/release/bench/bench_overlap --size 256x256,512x512,1024x1024 --views "$views" \
        --commit "$commit" --json "$results/overlap.json" --table "$results/overlap.md"
done

for figure in 6 7 8 9 10; do
    ranks=1,2,4,8
    [ "$figure" -ne 10 ] || ranks=4,8
    mpiexec -n 8 build/release/bench/bench_paper --figure "$figure" --ranks "$ranks" --size "$paper_sizes" \
        --views "$paper_views" --check 1 --commit "$commit" \
        --json "$results/paper.json" --svg "$results/paper.$figure.svg" --table "$results/paper.md"
done

# between FILE NAME TABLE...: what FILE has between the marks of NAME is what was measured.
between() {
    file=$1 name=$2
    shift 2
    awk -v name="$name" -v tables="$*" '
        $0 == "<!-- end of " name " -->" { skip = 0 }
        !skip { print }
        $0 == "<!-- " name ": written by bench/run.sh -->" {
            skip = 1
            count = split(tables, table, " ")
            for (i = 1; i <= count; ++i)
                while ((getline line < table[i]) > 0) print line
            print ""
        }' "$file" >"$file.new"
    mv "$file.new" "$file"
}
between README.md error_time "$results/error_time.4.md" "$results/error_time.8.md"
between bench/README.md compositing "$results/compositing.md"
between bench/README.md overlap "$results/overlap.md"
between bench/README.md paper "$results/paper.md"
