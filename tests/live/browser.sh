#!/bin/sh
# sh tests/live/browser.sh [--only-if-installed] [OUTPUT FOLDER]
# Tests the page of the live view in Debian's Chromium, driven by puppeteer-core. Installs both, puppeteer-core into
# ~/.cache/dfb-live (or $DFB_LIVE_NODE_MODULES), builds dfb_render and in_situ (preset "release", unless $DFB_RENDER and
# $DFB_IN_SITU say where they are), and writes screenshots to the output folder (default: build/live_browser). Drags for
# 100 frames; each picture must come within the time of a frame and 30 ms. With --only-if-installed: exits with 77 if
# something is missing, renders fewer and cheaper frames, and allows for a slow machine.
set -eu
root=$(CDPATH='' cd -- "$(dirname -- "$0")/../.." && pwd)
script=tests/live/browser.sh
packages=puppeteer-core@24 # the last major version for node 18 and 20
strict=--strict
[ "${1:-}" != --only-if-installed ] || strict=
# shellcheck source=tests/support/chromium.sh
. "$root/tests/support/chromium.sh"
output=${1:-$root/build/live_browser}

if [ -z "${DFB_RENDER:-}" ]; then
    (
        cd "$root"
        cmake --preset release -DDFB_WITH_MPI=ON -DDFB_BUILD_EXAMPLES=ON
        cmake --build --preset release --target dfb_render in_situ
    )
    DFB_RENDER=$root/build/release/examples/embree/dfb_render
    DFB_IN_SITU=$root/build/release/examples/in_situ
    # The launcher of the MPI with which these are built.
    mpiexec=$(sed -n 's/^MPIEXEC_EXECUTABLE:[A-Z]*=//p' "$root/build/release/CMakeCache.txt")
    flags=
    if "$mpiexec" --version 2>&1 | grep -E 'Open MPI|OpenRTE|PRRTE' >/dev/null; then
        flags=";--oversubscribe;--bind-to;none"
        [ "$(id -u)" -ne 0 ] || flags="$flags;--allow-run-as-root"
    fi
    DFB_MPIEXEC="$mpiexec$flags;-n"
fi
mkdir -p "$output"
DFB_RENDER=$DFB_RENDER DFB_IN_SITU=$DFB_IN_SITU DFB_MPIEXEC=${DFB_MPIEXEC:-mpiexec;-n} DFB_LIVE_NODE_MODULES=$modules \
    exec node "$root/tests/live/browser/drive.mjs" "$output" $strict
