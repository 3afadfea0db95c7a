# Sourced, with their arguments, by scripts of tests that drive Debian's Chromium. The caller sets script (its path in
# the tree), root (the working tree) and packages (of npm, each NAME@VERSION). With the argument --only-if-installed,
# exits with 77 if something is missing; otherwise installs it. Sets modules: the folder of the npm packages.
# shellcheck shell=sh disable=SC2154

case ${1:-} in
--only-if-installed) ;;
-*)
    echo "usage: sh $script [--only-if-installed] [OUTPUT FOLDER]" >&2
    exit 2
    ;;
esac
modules=${DFB_LIVE_NODE_MODULES:-}
[ -n "$modules" ] || modules=${XDG_CACHE_HOME:-${HOME:-$root/build}/.cache}/dfb-live
lacking=
for package in $packages; do
    [ -d "$modules/node_modules/${package%@*}" ] || lacking="$lacking $package"
done

missing() {
    echo "${script##*/}: skipped: $1 is missing; sh $script installs what the test needs"
    exit 77
}

if [ "${1:-}" = --only-if-installed ]; then
    shift
    command -v chromium >/dev/null 2>&1 || missing chromium
    command -v node >/dev/null 2>&1 || missing node
    [ -z "$lacking" ] || missing "${lacking# }"
else
    sh "$root/cmake/install_packages.sh" browser
    if [ -n "$lacking" ]; then
        mkdir -p "$modules"
        # shellcheck disable=SC2086 # one word per package
        npm install --prefix "$modules" --no-audit --no-fund $lacking
    fi
fi
