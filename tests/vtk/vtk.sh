#!/bin/sh
# sh tests/vtk/vtk.sh [--root FOLDER] [--output FOLDER] [--help]
# Builds examples/vtk with Debian's VTK and runs it on 1 to 4 ranks: surfaces and a volume, of VTK's wavelet, of a file
# and, where ../shared/data is, of a simulated molecule. Each picture is compared with VTK's own, and the surfaces of all
# runs with each other.
# VTK is installed into a Debian system of its own, since it brings Open MPI.
#   --root FOLDER    that system; made if it is not there, 2 GB, and used again. Default: build/vtk-root
#   --output FOLDER  for the pictures. Default: build/vtk
# Exits with 0 if all are right; with 77 if it cannot run here: it needs root, and Debian or a system made of it.
set -eu

script=vtk.sh
source=$(CDPATH='' cd -- "$(dirname -- "$0")/../.." && pwd)
root=$source/build/vtk-root
output=$source/build/vtk
# shellcheck source=tests/support/debian_root.sh
. "$source/tests/support/debian_root.sh"

read_options "$@"
isolate "$@"
enter_root libvtk9-dev openmpi-bin libopenmpi-dev xvfb xauth libgl1-mesa-dri g++ cmake make
copy_tree
build_tree vtk_parts

# draw RANKS NAME ARGUMENT...
draw() {
    ranks=$1 name=$2
    shift 2
    with_display timeout 300 mpirun --oversubscribe -n "$ranks" /build/examples/vtk/vtk_parts --check \
        --output "/out/$name$ranks.ppm" "$@" || verdict=FAILED
}

rm -rf "$root/out"
mkdir "$root/out"
in_root python3 -c 'import vtk
source = vtk.vtkImageMandelbrotSource()
source.SetWholeExtent(0, 40, 0, 40, 0, 32)
writer = vtk.vtkXMLImageDataWriter()
writer.SetFileName("/out/mandelbrot.vti")
writer.SetInputConnection(source.GetOutputPort())
writer.Write()' || give_up "VTK writes no file"
real=
neghip=$source/../shared/data/neghip_64x64x64_uint8.raw
if [ -e "$neghip" ]; then
    real=/out/real.vti
    cp "$neghip" "$root/out/real.raw"
    in_root python3 -c 'import vtk
reader = vtk.vtkImageReader2()
reader.SetFileName("/out/real.raw")
reader.SetFileDimensionality(3)
reader.SetDataExtent(0, 63, 0, 63, 0, 63)
reader.SetDataScalarTypeToUnsignedChar()
writer = vtk.vtkXMLImageDataWriter()
writer.SetFileName("/out/real.vti")
writer.SetInputConnection(reader.GetOutputPort())
writer.Write()' || give_up "VTK does not read $neghip"
fi

verdict=passed
for count in 1 2 3 4; do
    draw $count surfaces
    draw $count volume --volume
    draw $count file /out/mandelbrot.vti
    [ -z "$real" ] || draw $count real $real
    for name in surfaces file ${real:+real}; do
        if ! cmp "$root/out/${name}1.ppm" "$root/out/$name$count.ppm"; then
            say "the $name on $count ranks is not that on one"
            verdict=FAILED
        fi
    done
done
draw 4 file_volume --volume /out/mandelbrot.vti
[ -z "$real" ] || draw 4 real_volume --volume $real
mkdir -p "$output"
cp "$root"/out/*.ppm "$output"
say "$verdict; the pictures are in $output"
[ $verdict = passed ]
