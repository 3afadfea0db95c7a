#!/bin/sh
# sh cmake/jobs.sh
# Prints how many compilers to run at the same time: one for each processor that this process may use, but only as many
# as there is memory for. A file of ours takes up to 1.5 GB.
set -eu

jobs=$(env -u OMP_NUM_THREADS nproc 2>/dev/null || getconf _NPROCESSORS_ONLN 2>/dev/null || echo 2)
free=$(sed -n 's/^MemAvailable: *\([0-9]*\) kB$/\1/p' /proc/meminfo 2>/dev/null || true)
# Less, if a container or a batch system sets a limit.
# obey FOLDER FILE: the limits of that group and of those above it
obey() {
    folder=$1
    while [ "$folder" != /sys/fs ]; do
        limit=$(cat "$folder/$2" 2>/dev/null || true) # bytes, or "max"
        if [ "${limit:-max}" != max ] && [ "${free:-$limit}" -gt $((limit / 1024)) ]; then
            free=$((limit / 1024))
        fi
        folder=${folder%/*}
    done
}
obey "/sys/fs/cgroup$(sed -n 's/^0:://p' /proc/self/cgroup 2>/dev/null || true)" memory.max
obey "/sys/fs/cgroup/memory$(sed -n 's/^[0-9]*:memory://p' /proc/self/cgroup 2>/dev/null || true)" memory.limit_in_bytes # version 1
[ -z "$free" ] || [ "$jobs" -le $((free / 1500000)) ] || jobs=$((free / 1500000))
echo $((jobs > 0 ? jobs : 1))
