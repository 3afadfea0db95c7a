#!/bin/sh
# sh tests/c/debian.sh [--root FOLDER] [--output FOLDER] [--help]
# Does in a new Debian system what examples/adapters/c/README.md says: installs libdfb_c.so, and builds the programs in C
# and Fortran with it. Runs them on 3 ranks: their pictures must be those of C++ (tests/c/twin.cpp), bit for bit. The
# steps are read from README.md, so both are always the same.
#   --root FOLDER    that system; made if it is not there, 1 GB, and used again. Default: build/c-root
#   --output FOLDER  for the log and the pictures. Default: build/c
# Exits with 0 if all works; with 77 if it cannot run here: it needs root, and Debian or a system made of it.
set -eu

script=debian.sh
source=$(CDPATH='' cd -- "$(dirname -- "$0")/../.." && pwd)
root=$source/build/c-root
output=$source/build/c
# shellcheck source=tests/support/debian_root.sh
. "$source/tests/support/debian_root.sh"

read_options "$@"
isolate "$@"
mkdir -p "$output"
enter_root gfortran
copy_tree

say "the steps of README.md"
adapter=/dfb/examples/adapters/c
{
    echo "DIR=/opt/dfb; cd /dfb"
    sed -n '/^    \(sh\|cmake\) /p' "$source/examples/adapters/c/README.md"
    echo "cd $adapter"
    sed -n '/^    mpi/p' "$source/examples/adapters/c/README.md"
} >"$root/tmp/steps"
[ "$(grep -c '^    ' "$root/tmp/steps")" -eq 5 ] || give_up "README.md does not have 5 steps"
in_root sh -ex /tmp/steps >"$output/log" 2>&1 || give_up "FAILED: see $output/log"
in_root mpicxx -std=c++17 -O1 -DDFB_HAS_MPI=1 -I /dfb/include /dfb/tests/c/twin.cpp -o /tmp/twin -pthread \
    >>"$output/log" 2>&1 ||
    give_up "the program in C++ does not build: see $output/log"

rm -rf "$root/scratch"
mkdir "$root/scratch"
for command in "$adapter/minimal" "/tmp/twin minimal twin_minimal.ppm" \
    "$adapter/heat 120 40" "/tmp/twin heat twin_heat_ 120 40"; do
    in_root sh -c "cd /scratch && timeout 120 mpiexec -n 3 $command" || give_up "FAILED: $command"
done
cp "$root"/scratch/*.ppm "$output"
cmp "$output/minimal_c.ppm" "$output/twin_minimal.ppm" || give_up "FAILED: the picture in C is not that in C++"
for number in 0000 0001 0002; do
    cmp "$output/heat_$number.ppm" "$output/twin_heat_$number.ppm" ||
        give_up "FAILED: the picture in Fortran is not that in C++"
done
say "passed; the pictures are in $output"
