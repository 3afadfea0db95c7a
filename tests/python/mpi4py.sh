#!/bin/sh
# sh tests/python/mpi4py.sh [--root FOLDER] [--output FOLDER] [--help]
# Builds and installs the Python package with Debian's Open MPI, and runs its tests, tests/python/mpi.py and the example
# on ranks of mpi4py; renders a data set with VTK in pieces and compares with VTK alone; and checks that a module that was
# built with MPICH says so.
# All is installed into a Debian system of its own, since mpi4py brings Open MPI.
#   --root FOLDER    that system; made if it is not there, 2 GB, and used again. Default: build/python-root
#   --output FOLDER  for the pictures. Default: build/python
# Exits with 0 if all are right; with 77 if it cannot run here: it needs root, and Debian or a system made of it.
set -eu

script=mpi4py.sh
source=$(CDPATH='' cd -- "$(dirname -- "$0")/../.." && pwd)
root=$source/build/python-root
output=$source/build/python
# shellcheck source=tests/support/debian_root.sh
. "$source/tests/support/debian_root.sh"

read_options "$@"
isolate "$@"
enter_root python3-mpi4py python3-numpy python3-vtk9 python3-dev pybind11-dev openmpi-bin libopenmpi-dev libmpich-dev \
    xvfb xauth libgl1-mesa-dri g++ cmake make
copy_tree
build_tree dfb_python
in_root cmake --install /build --component python >"$root/install.log" 2>&1 ||
    give_up "it is not installed: see $root/install.log"
{
    in_root cmake -S /dfb -B /build-mpich -DCMAKE_BUILD_TYPE=Debug -DCMAKE_CXX_FLAGS_DEBUG=-O0 -DDFB_WITH_TBB=OFF \
        -DMPI_CXX_COMPILER=mpicxx.mpich -DDFB_WITH_SNAPPY=OFF -DDFB_BUILD_TESTS=OFF -DDFB_BUILD_BENCH=OFF &&
        in_root cmake --build /build-mpich --target dfb_python
} >"$root/build.log" 2>&1 || give_up "it does not build with MPICH: see $root/build.log"

said=$root/out/said # what the last program said
verdict=passed
failed() {
    say "FAILED: $*"
    verdict=FAILED
}

# python RANKS ARGUMENT...: runs Python on ranks of mpi4py.
python() {
    ranks=$1
    shift
    with_display timeout -k 10 200 mpirun.openmpi --oversubscribe --bind-to none -n "$ranks" python3 -B "$@"
}

rm -rf "$root/out"
mkdir "$root/out"
for test in compositor errors framebuffer memory package; do
    in_root timeout 200 python3 -B "/dfb/tests/python/$test.py" || failed "$test.py"
done
for count in 1 2 3 5; do
    for case in pictures frames errors owners left_open; do
        python $count -m mpi4py /dfb/tests/python/mpi.py $case >"$said" 2>&1 || failed "$case on $count ranks"
        if [ "$(grep -c ': done' "$said")" != $count ]; then
            cat "$said"
            failed "$case on $count ranks: not all came to its end"
        fi
    done
done

# The remaining ranks get the error and the job ends with one, also without -m mpi4py, which would end it at once. A
# hang would give 124.
code=0
python 3 /dfb/tests/python/mpi.py leaves >"$said" 2>&1 || code=$?
if [ $code = 0 ] || [ $code -ge 124 ] || ! grep -q "heard: Transport of rank 2" "$said" ||
    ! grep -q "KeyError: 'lost'" "$said"; then
    cat "$said"
    failed "a rank that leaves: exit code $code"
fi

in_root PYTHONPATH=/build-mpich/examples/adapters/python timeout 60 python3 -B /dfb/tests/python/mpi.py other_mpi \
    >"$said" 2>&1 || failed "a module that was built with another MPI"
different="different MPI libraries: Open MPI [^,]*, whose handles have 8 bytes, and MPICH [^,]*, whose handles have 4 bytes"
if ! grep -q "mpi4py and dfb were built with $different" "$said"; then
    cat "$said"
    failed "a module that was built with another MPI says something else"
fi

for count in 1 2 4; do
    python $count -m mpi4py /dfb/tests/python/vtk_pieces.py /out/vtk_pieces$count.ppm || failed "VTK in $count pieces"
    python $count -m mpi4py /dfb/examples/volume.py --size 120 /out/volume$count.ppm || failed "volume.py on $count ranks"
    for name in vtk_pieces volume; do
        cmp "$root/out/${name}1.ppm" "$root/out/$name$count.ppm" || failed "$name on $count ranks is not that on one"
    done
done
mkdir -p "$output"
cp "$root"/out/*.ppm "$output"
say "$verdict; the pictures are in $output"
[ $verdict = passed ]
