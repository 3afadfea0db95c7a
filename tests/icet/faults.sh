#!/bin/sh
# sh tests/icet/faults.sh [--cases N | --check]
# Puts faults into libdfb_icet, one at a time, in a copy of the source tree, and checks that the differential test finds
# each. The faults are at the end of this file. Takes 10 minutes on 2 cores.
#   --cases N   cases of the differential test; default 200
#   --check     only checks that the adapter still has the lines into which the faults are put
# Exits with 0 if each fault was found, and with 77 if there is no IceT (sh bench/get_icet.sh).
set -eu

source=$(CDPATH='' cd -- "$(dirname -- "$0")/../.." && pwd)
copy=$source/build/icet-faults
adapter=$copy/examples/adapters/icet
cases=200
isCheck=
case "${1:-}${2:+ N}" in
'') ;;
'--cases N') cases=$2 ;;
--check) isCheck=1 ;;
*)
    echo "usage: sh tests/icet/faults.sh [--cases N | --check]" >&2
    exit 2
    ;;
esac

build() {
    cmake --build "$copy/build" --target dfb_icet test_icet_differential >"$copy/build.log" 2>&1
}

# differential: runs the test, with its output in $copy/test.log
differential() {
    # shellcheck disable=SC2086 # one word per flag
    timeout 300 "$mpiexec" $flags -n 3 "$copy/build/tests/icet/test_icet_differential" "$icet" \
        "$copy/build/examples/adapters/icet/libdfb_icet.so" --cases "$cases" </dev/null >"$copy/test.log" 2>&1
}

# put FILE OLD NEW: replaces the text OLD in the adapter's file by NEW. OLD must occur exactly once.
put() {
    awk -v old="$2" -v new="$3" '
        { at = index($0, old) }
        at { ++count; $0 = substr($0, 1, at - 1) new substr($0, at + length(old)) }
        { print }
        END { exit count != 1 }' "$source/examples/adapters/icet/$1"
}

if [ ! "$isCheck" ]; then
    if [ ! -d "$source/build/peers/icet/lib" ]; then
        echo "faults.sh: SKIPPED: there is no IceT; sh bench/get_icet.sh gets it" >&2
        exit 77
    fi
    icet=$(find "$source/build/peers/icet/lib" -name '*IceTCore*.so' | head -n 1)
    rm -rf --one-file-system "$copy"
    mkdir -p "$copy"
    (cd "$source" && tar -cf - --exclude=./build --exclude=./.git .) | tar -xf - -C "$copy"
    cmake -S "$copy" -B "$copy/build" -G Ninja -DCMAKE_BUILD_TYPE=Debug -DCMAKE_CXX_FLAGS_DEBUG="-O1" \
        -DDFB_BUILD_BENCH=OFF -DDFB_ICET_DIR="$source/build/peers/icet" >"$copy/cmake.log"
    # The launcher of the MPI with which the test is built.
    mpiexec=$(sed -n 's/^MPIEXEC_EXECUTABLE:[A-Z]*=//p' "$copy/build/CMakeCache.txt")
    flags=
    if "$mpiexec" --version 2>&1 | grep -E 'Open MPI|OpenRTE|PRRTE' >/dev/null; then
        flags="--oversubscribe --bind-to none"
        [ "$(id -u)" -ne 0 ] || flags="$flags --allow-run-as-root"
    fi
    build
    if ! differential; then
        echo "faults.sh: FAILED: the test fails without a fault: see $copy/test.log" >&2
        exit 1
    fi
    echo "no fault: $(tail -n 1 "$copy/test.log")"
fi

verdict=0
count=0
while IFS='|' read -r name file old new; do
    case $name in '' | '#'*) continue ;; esac
    count=$((count + 1))
    target=/dev/null
    [ "$isCheck" ] || target=$adapter/$file
    if ! put "$file" "$old" "$new" >"$target"; then
        result="NOT PUT IN: $file has not one line with: $old"
        verdict=1
    elif [ "$isCheck" ]; then
        continue
    elif ! build; then
        result="DOES NOT COMPILE: see $copy/build.log"
        verdict=1
    elif differential; then
        result="NOT FOUND"
        verdict=1
    else
        result="found: $(grep -m 1 'case' "$copy/test.log" || tail -n 1 "$copy/test.log")"
    fi
    echo "$name: $result"
    [ "$isCheck" ] || cp "$source/examples/adapters/icet/$file" "$target"
done <<'END'
order of the ranks ignored|composite.cpp|if (s.isEnabled(ICET_ORDERED_COMPOSITE))|if (false)
8-bit background not rounded down|composite.cpp|value = static_cast<float>(levelOf(value)) / 255;|value = std::clamp(value, 0.0f, 1.0f);
no background behind nearest pixels|composite.cpp|plan.fillsBackground = hasColor &&|plan.fillsBackground = false &&
depth of nothing is infinite|composite.cpp|return depth == nothing ? 1.0f : depth;|return depth;
pixels at depth 1 count|composite.cpp|input.farDepth = 1;|
pixels outside of the client's limits are read|composite.cpp|input.valid = regionIn(tile, part);|input.valid = regionIn(tile, memory);
all tiles displayed by one rank|composite.cpp|tile.displayRank, plan.format,|0, plan.format,
display rank of an old frame kept|composite.cpp|k.tile, k.width, k.height, k.displayRank, k.format|k.tile, k.width, k.height, k.format
alpha kept in an image of three channels|image.cpp|std::copy_n(rgba + 4 * i, 3, out + 3 * i);|std::copy_n(rgba + 3 * i, 3, out + 3 * i);
bounds a pixel too narrow|bounds.cpp|pixel(std::ceil(right), wall.x0, wall.x1)|pixel(std::floor(right), wall.x0, wall.x1)
near plane ignored|bounds.cpp|if (before(v) >= 0) {|if (true) {
same data of two ranks counted twice|bounds.cpp|if (context.replicas.size() > 1)|if (false)
what a floating window showed used too late|draw.cpp|hasFloated_ = floats;|hasFloated_ = true;
projection half a pixel off|draw.cpp|double(wall.width() + 2 * (wall.x0 - window.x0) - window.width())|double(wall.width() + 2 * (wall.x0 - window.x0) + 1 - window.width())
END
found=${isCheck:+has a place}
found=${found:-was found}
echo "faults.sh: $count faults, $([ $verdict = 0 ] && echo "each $found" || echo "NOT ALL $found")"
exit $verdict
