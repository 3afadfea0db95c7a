#!/bin/sh
# sh examples/demo.sh [--live] [SCENE FILE...]
# Installs what is missing, builds dfb_render (preset "release", in build/release), and renders the files, or a
# generated scene, on 4 MPI ranks, each of which has a part of the data. Writes demo.png into the current folder. With
# --live, shows the scene in a browser, where it can be turned, until the job is ended there or by Ctrl-C.
set -eu

ranks=4
size=1024x768
picture=demo.png

say() {
    echo "demo.sh: $*"
}

usage() {
    echo "usage: sh examples/demo.sh [--live] [SCENE FILE...]"
    echo "scene files: volumes (NAME_XxYxZ_TYPE.raw, .nrrd, .nhdr, .mha, .mhd, .h5:/DATASET), meshes (.ply, .obj, .stl," \
        ".gltf, .glb), particles (.xyz); several make one scene"
}

live=
if [ "${1:-}" = --live ]; then
    live=--live
    shift
fi
for argument in "$@"; do
    case $argument in
    --help)
        usage
        exit 0
        ;;
    -*)
        usage >&2
        exit 2
        ;;
    esac
    file=$argument
    while [ ! -f "$file" ] && [ "$file" != "${file%:*}" ]; do
        file=${file%:*} # behind a colon: how it looks, or a data set
    done
    if [ ! -f "$file" ] || [ ! -r "$file" ]; then
        echo "demo.sh: cannot read the file '$file'" >&2
        exit 1
    fi
done

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
build=$root/build/release
jobs=$(sh "$root/cmake/jobs.sh")

sh "$root/cmake/install_packages.sh"
say "building dfb_render in $build"
(
    cd "$root"
    cmake --preset release -DDFB_WITH_MPI=ON -DDFB_BUILD_EXAMPLES=ON
    cmake --build --preset release --parallel "$jobs" --target dfb_render
)

# The launcher of the MPI with which dfb_render was built.
mpiexec=$(sed -n 's/^MPIEXEC_EXECUTABLE:[A-Z]*=//p' "$build/CMakeCache.txt")
flags=
if "$mpiexec" --version 2>&1 | grep -E 'Open MPI|OpenRTE|PRRTE' >/dev/null; then
    flags="--oversubscribe --bind-to none"
    [ "$(id -u)" -ne 0 ] || flags="$flags --allow-run-as-root"
fi

if [ $# -eq 0 ]; then
    set -- demo
fi
say "rendering $* on $ranks ranks"
if [ -n "$live" ]; then
    # shellcheck disable=SC2086 # one word per flag
    exec "$mpiexec" -n $ranks $flags "$build/examples/embree/dfb_render" "$@" --mode data --live
fi
rm -f "$picture"
started=$(date +%s)
# shellcheck disable=SC2086 # one word per flag
"$mpiexec" -n $ranks $flags "$build/examples/embree/dfb_render" "$@" --mode data --size $size --background 0,0,0 \
    --output "$picture"
if [ ! -s "$picture" ]; then
    echo "demo.sh: dfb_render has written no picture" >&2
    exit 1
fi
say "done in $(($(date +%s) - started)) s; the picture ($size) is $PWD/$picture"
