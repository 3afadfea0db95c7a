#!/bin/sh
# sh tests/vtk/vtk.sh [--root FOLDER] [--output FOLDER] [--help]
# Builds examples/vtk with Debian's VTK and runs it on 1 to 4 ranks: surfaces and a volume, of VTK's wavelet, of a file
# and, where ../shared/data is, of a simulated molecule. Each picture is compared with what VTK alone renders.
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
enter_root libvtk9-dev python3-vtk9 python3-numpy openmpi-bin libopenmpi-dev xvfb xauth libgl1-mesa-dri g++ cmake make
copy_tree
build_tree vtk_parts

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
# check surfaces|volume NAME DATA RANKS...: with vtk_parts on so many ranks, and with VTK alone
check() {
    look=$1 name=$2 data=$3
    shift 3
    pictures=
    for count; do
        picture=/out/$name$count.ppm
        pictures="$pictures $picture"
        # shellcheck disable=SC2086 # no argument for VTK's own data
        with_display timeout 300 mpirun --oversubscribe -n "$count" /build/examples/vtk/vtk_parts "$look" "$picture" \
            ${data#-} || verdict=FAILED
    done
    # shellcheck disable=SC2086 # one word each
    with_display timeout 300 python3 /dfb/tests/vtk/compare.py "$look" "$data" $pictures || verdict=FAILED
}
check surfaces surfaces - 1 2 3 4
check volume volume - 1 2 3 4
check surfaces file /out/mandelbrot.vti 1 2 3 4
check volume file_volume /out/mandelbrot.vti 4
if [ -n "$real" ]; then
    check surfaces real $real 1 2 3 4
    check volume real_volume $real 4
fi
mkdir -p "$output"
cp "$root"/out/*.ppm "$output"
say "$verdict; the pictures are in $output"
[ $verdict = passed ]
