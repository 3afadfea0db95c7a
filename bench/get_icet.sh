#!/bin/sh
# sh bench/get_icet.sh [DIR]
# Puts IceT's headers and library into DIR/include and DIR/lib (default: build/peers/icet, where the build looks for
# them), so that benchmarks can compare with IceT. They are taken from Debian's packages of ParaView, which are
# downloaded (70 MB) and unpacked, but not installed. Does nothing if IceT is there already; exits with 3 if the
# packages are not available.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
case ${1:-} in
-*)
    echo "usage: sh bench/get_icet.sh [DIR]" >&2
    exit 2
    ;;
esac
dir=${1:-$root/build/peers/icet}
dir=${dir%/}

give_up() {
    echo "get_icet.sh: IceT cannot be had here: $*" >&2
    exit 3
}

# A new folder is renamed to DIR when it is complete.
[ -e "$dir/include/IceT.h" ] && exit 0
[ ! -e "$dir" ] || give_up "$dir is there, but has no include/IceT.h"
for command in apt-get dpkg; do
    command -v "$command" >/dev/null 2>&1 || give_up "there is no $command"
done

work=$(mktemp -d)
new=$dir.$$
trap 'rm -rf "$work" "$new"' EXIT
trap 'exit 1' HUP INT TERM

(cd "$work" && apt-get -q download paraview-dev paraview >log 2>&1) ||
    give_up "apt-get download paraview-dev paraview: $(grep '^E: ' "$work/log" | tail -n 1)"
for package in "$work"/*.deb; do
    dpkg -x "$package" "$work/files"
done
header=$(find "$work/files" -name IceT.h | head -n 1)
library=$(find "$work/files" -name 'libvtkIceTCore*.so' | head -n 1)
if [ -z "$header" ] || [ -z "$library" ]; then
    give_up "no IceT in these packages: $(cd "$work" && echo *.deb)"
fi

mkdir -p "$new/include" "$new/lib"
cp "$(dirname "$header")/IceT.h" "$new/include"
for name in IceTConfig.h IceTMPI.h; do # the library needs the first, its users both
    cp "$(find "$work/files" -name $name | head -n 1)" "$new/include"
done
cp -P "$library"* "$new/lib"
mv -T "$new" "$dir" || [ -e "$dir/include/IceT.h" ] # of another run
echo "get_icet.sh: IceT is in $dir" >&2
