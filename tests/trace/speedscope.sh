#!/bin/sh
# sh tests/trace/speedscope.sh [--only-if-installed] [OUTPUT FOLDER]
# Opens a trace of dfb_render in speedscope, in Debian's Chromium, and writes a screenshot to the output folder
# (default: build/speedscope). Installs speedscope and puppeteer-core into ~/.cache/dfb-live (or
# $DFB_LIVE_NODE_MODULES), and builds dfb_render (preset "release", unless $DFB_RENDER says where it is). $DFB_TRACE: a
# trace to show instead of a new one. With --only-if-installed: exits with 77 if something is missing.
set -eu
root=$(CDPATH='' cd -- "$(dirname -- "$0")/../.." && pwd)
script=tests/trace/speedscope.sh
packages="puppeteer-core@24 speedscope@1"
# shellcheck source=tests/support/chromium.sh
. "$root/tests/support/chromium.sh"
output=${1:-$root/build/speedscope}

mkdir -p "$output"
trace=${DFB_TRACE:-}
if [ -z "$trace" ]; then
    if [ -z "${DFB_RENDER:-}" ]; then
        (cd "$root" && cmake --preset release && cmake --build --preset release --target dfb_render)
        DFB_RENDER=$root/build/release/examples/embree/dfb_render
    fi
    trace=$output/trace.json
    "$DFB_RENDER" demo --ranks 3 --size 320x240 --frames 4 --in-flight 2 --trace "$trace" >/dev/null
fi
DFB_LIVE_NODE_MODULES=$modules exec node "$root/tests/trace/speedscope.mjs" "$trace" "$output/speedscope.png"
