#!/bin/sh
# sh tests/package/deb.sh [--root FOLDER] [--output FOLDER] [--help]
# Makes the Debian package libdfb-dev with cpack, and installs it with apt into a Debian system that has a compiler, CMake
# and pkg-config, but nothing that dfb needs: once with MPICH and once with Open MPI. Builds and runs a program
# there that finds dfb by CMake, and one that finds it by pkg-config, and removes the package again.
#   --root FOLDER    that system; made if it is not there, 1 GB, and used again. Default: build/deb-root
#   --output FOLDER  for the package. Default: build/deb
# Exits with 0 if all of it works; with 77 if it cannot run here: it needs root, and Debian or a system made of it.
set -eu

script=deb.sh
source=$(CDPATH='' cd -- "$(dirname -- "$0")/../.." && pwd)
root=$source/build/deb-root
output=$source/build/deb
# shellcheck source=tests/support/debian_root.sh
. "$source/tests/support/debian_root.sh"

read_options "$@"
isolate "$@"
mkdir -p "$output"
rm -f "$output"/*.deb
cmake -S "$source" -B "$output/build" -DDFB_BUILD_TESTS=OFF -DDFB_BUILD_EXAMPLES=OFF -DDFB_BUILD_BENCH=OFF >"$output/log" 2>&1 ||
    give_up "cmake fails: see $output/log"
(cd "$output/build" && cpack -G DEB -B "$output") >>"$output/log" 2>&1 || give_up "cpack fails: see $output/log"
version=$(sed -n 's/^CMAKE_PROJECT_VERSION:.*=//p' "$output/build/CMakeCache.txt")
package=libdfb-dev_${version}_all.deb
[ -e "$output/$package" ] || give_up "cpack has made $(ls "$output"/*.deb), not $package"
say "made $package: $(dpkg-deb -f "$output/$package" Depends)"

enter_root g++ cmake make pkg-config
remove_package() {
    # shellcheck disable=SC2016 # dpkg's own variable
    there=$(in_root dpkg-query -W -f '${Package} ' libdfb-dev mpich libmpich-dev openmpi-bin libopenmpi-dev 2>/dev/null || true)
    # shellcheck disable=SC2086 # one word per package
    in_root DEBIAN_FRONTEND=noninteractive apt-get -y -q autoremove --purge $there >"$root/packages.log" 2>&1 ||
        give_up "packages cannot be removed: see $root/packages.log"
    for header in dfb/dfb.hpp mpi.h tbb/tbb.h snappy.h; do
        left=$(find "$root/usr/include" "$root/usr/lib" -path "*/$header")
        [ -z "$left" ] || give_up "the system is not clean: there is $left"
    done
}

cp "$output/$package" "$root/tmp"
for mpi in mpich openmpi; do
    in_root apt-get -q update >"$root/packages.log" 2>&1 || give_up "apt-get update fails: see $root/packages.log"
    remove_package
    if [ $mpi = mpich ]; then
        install_there "/tmp/$package" # MPICH comes first in what it depends on
    else
        install_there "/tmp/$package" libopenmpi-dev openmpi-bin
        [ ! -e "$root/usr/include/$(in_root gcc -print-multiarch)/mpich" ] || give_up "MPICH came beside Open MPI"
    fi
    rm -rf "$root/scratch"
    mkdir "$root/scratch"
    cp -r "$source/tests/package" "$source/examples/minimal.cpp" "$root/scratch"

    say "by find_package, with $mpi"
    # shellcheck disable=SC2015 # either step may fail
    in_root cmake -S /scratch/package -B /scratch/build -DHOW=find_package -DVERSION="${version%.*}" -DEXPECT="mpi;tbb;snappy" \
        -DFRAME=ON -DCOMPILED=ON -DCMAKE_CXX_FLAGS=-O0 >"$root/build.log" 2>&1 &&
        in_root cmake --build /scratch/build >>"$root/build.log" 2>&1 ||
        give_up "FAILED: it does not build by find_package: see $root/build.log"
    in_root /scratch/build/stranger || give_up "FAILED: the program that was built by find_package"

    say "by pkg-config, with $mpi"
    # shellcheck disable=SC2016 # expands there
    in_root sh -c 'cd /scratch && g++ -std=c++17 -O0 minimal.cpp $(pkg-config --cflags --libs dfb) -o minimal && ./minimal' ||
        give_up "FAILED: it does not build or run by pkg-config"
    [ "$(wc -c <"$root/scratch/minimal.ppm")" -eq $((15 + 640 * 320 * 3)) ] || give_up "FAILED: no picture of minimal.cpp"
done
remove_package
say "passed; the package is $output/$package"
