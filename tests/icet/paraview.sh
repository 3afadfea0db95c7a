#!/bin/sh
# sh tests/icet/paraview.sh [--root FOLDER] [--output FOLDER] [--help]
# Draws with Debian's ParaView on 3 ranks, once with IceT and once with libdfb_icet in its place, and compares: opaque
# surfaces, a volume, transparent surfaces, a selection, two views, a resize, a rank without data, and a wall of two
# displays.
# ParaView is installed into a Debian system of its own, since it brings Open MPI.
#   --root FOLDER    that system; made if it is not there, 3 GB, and used again. Default: build/paraview-root
#   --output FOLDER  for the pictures and logs. Default: build/paraview
# Exits with 0 if opaque pictures are equal, and blended ones as near as IceT's rounding lets them; with 77 if it cannot
# run here: it needs root, and Debian or a system made of it.
set -eu

script=paraview.sh
source=$(CDPATH='' cd -- "$(dirname -- "$0")/../.." && pwd)
root=$source/build/paraview-root
output=$source/build/paraview
# shellcheck source=tests/support/debian_root.sh
. "$source/tests/support/debian_root.sh"

read_options "$@"
isolate "$@"
enter_root paraview python3-paraview paraview-dev python3-numpy python3-pil openmpi-bin libopenmpi-dev xvfb xauth \
    libgl1-mesa-dri g++ cmake make
copy_tree
build_tree dfb_icet
adapter=/build/examples/adapters/icet/libdfb_icet.so
probe=/build/paraview_probe.so
in_root sh -c "mpicxx.openmpi -std=c++17 -O2 -shared -fPIC -I \$(echo /usr/include/paraview*/vtkicet/src/include) \
    /dfb/tests/icet/paraview_probe.cpp -o $probe" || give_up "the probe does not compile"

# draw FOLDER [LIBRARY]: draws with LIBRARY in place of IceT
draw() {
    say "drawing with ${2:-IceT}"
    in_root mkdir -p "/out/$1"
    with_display timeout 300 mpirun --oversubscribe -n 3 env DFB_ICET_STATS=1 DFB_PROBE="/out/$1" \
        LD_PRELOAD="$probe ${2:-}" pvbatch /dfb/tests/icet/paraview_scenes.py "/out/$1" >"$root/out/$1/scenes.log" 2>&1 ||
        give_up "pvbatch has failed: see $root/out/$1/scenes.log"
    in_root DFB_ICET_STATS=1 timeout 300 python3 /dfb/tests/icet/paraview_wall.py "/out/$1" ${2:+"$2"} ||
        give_up "the wall has failed: see $root/out/$1/wall.log"
}

rm -rf "$root/out"
draw icet
draw dfb $adapter
# Checks that the library was used: without it nothing would differ.
grep -q '^dfb_icet: frame' "$root/out/dfb/scenes.log" || give_up "dfb has not composited: see $root/out/dfb/scenes.log"
grep -q '^dfb_icet: frame.* in 2 tiles' "$root/out/dfb/wall.log" ||
    give_up "dfb has not composited the wall: see $root/out/dfb/wall.log"

verdict=passed
in_root python3 /dfb/tests/icet/paraview_compare.py /out || verdict=FAILED
rm -f "$root"/out/*/*put_[0-9]* "$root"/out/*/*_output "$root"/out/*/times
mkdir -p "$output"
cp -r "$root/out/." "$output"
say "$verdict; the pictures are in $output"
[ $verdict = passed ]
