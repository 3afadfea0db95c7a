#!/bin/sh
# sh bench/run.sh [--quick] [--launcher CMD]
# Installs what is missing, builds the preset "release", gets IceT to compare with, if it is available, and runs all
# benchmarks except bench_messaging and bench_gather. Tables, figures and pictures go to bench/results. Takes an hour.
# With --quick it takes 8 minutes, and the files stay in build/bench_results, as they are not precise. With --launcher,
# bench_compositing also runs on several hosts: CMD, in front of a program, starts it there, ideally as 4 ranks, one on
# each host. The exit status is 1 if the counts of bench_scaling or bench_skip are wrong.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
cd "$root"
frames=41 compositing_frames=11 views=12 skip_size=4096x4096 paper_views=8 paper_sizes=256x256,512x512 quick=
all_ranks="2 3 4 8 16" some_ranks="2 4 8" moving_sizes=1024x1024,2048x2048 large_sizes=2048x2048,4096x4096
launcher=
# The fastest variants of each system, and those that sort by depth
main_rows="limit|defaults|dfb: float32, to|dfb: float32, all in place|in order, float32, to|in order, float32, all in place|in order, bytes, all in place|in order, unorm8|direct|sequential, radix-k|sequential, tree|sequential, binary swap|reduce, radix-kr"
while [ $# -gt 0 ]; do
    case $1 in
    --quick)
        frames=5 compositing_frames=3 views=4 skip_size=1024x1024 paper_views=3 paper_sizes=256x256 quick=--quick
        all_ranks=4 some_ranks=4 moving_sizes=1024x1024 large_sizes=2048x2048
        ;;
    --launcher)
        launcher=${2:?"a launcher is missing: sh bench/run.sh [--quick] [--launcher CMD]"}
        shift
        ;;
    *)
        echo "run.sh: no option $1: sh bench/run.sh [--quick] [--launcher CMD]" >&2
        exit 2
        ;;
    esac
    shift
done
jobs=$(sh cmake/jobs.sh)
commit=$(git rev-parse --short HEAD 2>/dev/null || echo unknown)
results=build/bench_results # copied to bench/results at the end, without --quick
bench=build/release/bench

sh cmake/install_packages.sh bench
sh bench/get_icet.sh || [ $? -eq 3 ] # without IceT the others are measured
cmake --preset release -DDFB_BUILD_BENCH=ON
cmake --build --preset release --parallel "$jobs" --target bench_error_time bench_compositing bench_overlap \
    bench_scaling bench_skip bench_paper bench_kernels

# The launcher of the MPI with which the programs were built.
mpiexec=$(sed -n 's/^MPIEXEC_EXECUTABLE:[A-Z]*=//p' build/release/CMakeCache.txt)
flags=
if "$mpiexec" --version 2>&1 | grep -E 'Open MPI|OpenRTE|PRRTE' >/dev/null; then
    flags="--oversubscribe --bind-to none"
    [ "$(id -u)" -ne 0 ] || flags="$flags --allow-run-as-root"
fi
# on_ranks N PROGRAM ARGUMENT...
on_ranks() {
    count=$1
    shift
    # shellcheck disable=SC2086 # one word per flag
    "$mpiexec" $flags -n "$count" "$@"
}

rm -rf "$results"
mkdir -p "$results"
for name in kernels compositing overlap paper scaling skip; do
    printf '# Results of bench_%s\n\n' "$name" >"$results/$name.md"
done

"$bench"/bench_kernels --json "$results/kernels.json" --table "$results/kernels.md"

for ranks in 4 8; do
    on_ranks "$ranks" "$bench"/bench_error_time --frames "$frames" --commit "$commit" \
        --json "$results/error_time.json" --table "$results/error_time.$ranks.md"
done
python=python3
"$python" -c 'import matplotlib' 2>/dev/null || python=/usr/bin/python3 # the one that Debian's packages are for
"$python" bench/compositing/plot_error_time.py "$results/error_time.json" "$results" ||
    echo "run.sh: no pictures of error against time: they need python3 with matplotlib"

# The measurement at one size tells most; the others show whether it holds in general.
for ranks in $all_ranks; do
    on_ranks "$ranks" "$bench"/bench_compositing --scene all --size 1024x1024 \
        --frames "$compositing_frames" --commit "$commit" \
        --json "$results/compositing.json" --table "$results/compositing.md"
done
for ranks in $some_ranks; do
    for way in --moving --reader; do
        on_ranks "$ranks" "$bench"/bench_compositing --scene bricks,overlap,dense --size "$moving_sizes" $way \
            --only "$main_rows" --frames "$compositing_frames" --commit "$commit" \
            --json "$results/compositing.json" --table "$results/compositing.md"
    done
    on_ranks "$ranks" "$bench"/bench_compositing --scene bricks,overlap,dense --size "$large_sizes" \
        --only "$main_rows" \
        --frames 5 --commit "$commit" --json "$results/compositing.json" --table "$results/compositing.md"
done

for ranks in $some_ranks; do
    on_ranks "$ranks" "$bench"/bench_overlap --size 256x256,512x512,1024x1024 --views "$views" \
        --commit "$commit" --json "$results/overlap.json" --table "$results/overlap.md"
    on_ranks "$ranks" "$bench"/bench_overlap --size 512x512 --views "$views" --in-a-row 7 \
        --commit "$commit" --json "$results/overlap.json"
done

for figure in 6 7 8 9 10; do
    ranks=1,2,4,8
    [ "$figure" -ne 10 ] || ranks=4,8
    on_ranks 8 "$bench"/bench_paper --figure "$figure" --ranks "$ranks" --size "$paper_sizes" \
        --views "$paper_views" --check 1 --commit "$commit" \
        --json "$results/paper.json" --svg "$results/paper.$figure.svg" --table "$results/paper.md"
done

status=0
"$bench"/bench_scaling $quick --commit "$commit" --json "$results/scaling.json" \
    --svg "$results/scaling.svg" --table "$results/scaling.md" || status=1
"$bench"/bench_skip $quick --size "$skip_size" --commit "$commit" --json "$results/skip.json" \
    --svg "$results/skip.svg" --table "$results/skip.md" || status=1

if [ -n "$launcher" ]; then
    $launcher "$bench"/bench_compositing --scene bricks --size 1024x1024 --frames "$frames" --commit "$commit" \
        --only "in order, float32, to|snappy|half a level|in order, bytes, to|direct|sequential" \
        --json "$results/network.json" --table "$results/network.md"
else
    echo "run.sh: no --launcher: nothing was measured over a network"
fi
[ -z "$quick" ] || exit "$status"
mkdir -p bench/results
find bench/results -type f ! -name messaging.md ! -name gather.md -exec rm -f {} +
cp "$results"/* bench/results
exit "$status"
