# Sourced by scripts of tests. Makes a Debian system in a folder, for programs whose packages bring an MPI that would
# replace the one of this machine. The caller sets script (its name), source (the working tree), root (the folder of the
# system) and output (the folder of the results).
# shellcheck shell=sh disable=SC2034,SC2154

say() {
    echo "$script: $*" >&2
}

skip() {
    say "SKIPPED: $*"
    exit 77
}

give_up() {
    say "$*"
    exit 1
}

# read_options ARGUMENT...: puts --root and --output into $root and $output. --help prints the head of the caller.
read_options() {
    while [ $# -gt 0 ]; do
        case $1 in
        --root | --output)
            if [ $# -lt 2 ] || [ -z "$2" ]; then
                say "$1 needs a folder"
                exit 2
            fi
            # An absolute path is valid wherever the script changes to.
            case $2 in
            /*) path=$2 ;;
            *) path=$PWD/$2 ;;
            esac
            path=${path%/}
            [ "$1" = --root ] && root=$path || output=$path
            shift 2
            ;;
        --help)
            sed -n '2,/^set /{/^#/s/^# \{0,1\}//p}' "$0"
            exit 0
            ;;
        *)
            say "there is no option '$1': see --help"
            exit 2
            ;;
        esac
    done
}

# isolate ARGUMENT...: runs the calling script again with these arguments, with mounts and processes of its own, which
# are gone when it ends, however it ends. Returns if the script already runs so.
isolate() {
    [ "${DFB_ISOLATED:-}" != yes ] || return 0
    [ "$(id -u)" -eq 0 ] || skip "it makes a system in a folder, which only root can"
    for command in apt-get dpkg unshare; do
        command -v "$command" >/dev/null 2>&1 || skip "there is no $command: it needs Debian or a system made of it"
    done
    unshare --mount --pid --fork true 2>/dev/null || skip "this machine lets nobody mount (a container?)"
    mkdir -p "$(dirname "$root")"
    exec 9>"$root.lock"
    flock --nonblock 9 || give_up "another run works in $root"
    export DFB_ISOLATED=yes
    exec unshare --mount --pid --fork --kill-child --mount-proc sh "$0" "$@"
}

# Prints the address of this machine's package archive, its release, and its components, separated by commas.
package_source() {
    # shellcheck disable=SC1091 # Debian's
    codename=$(. /etc/os-release && echo "${VERSION_CODENAME:-}")
    # shellcheck disable=SC2016 # apt's own variables
    apt-get indextargets --format '$(REPO_URI) $(RELEASE) $(COMPONENT)' 'Created-By: Packages' |
        awk -v release="$codename" '$2 == release && (uri == "" || $1 == uri) { uri = $1; parts = parts sep $3; sep = "," }
            END { if (uri != "") print uri, release, parts }'
}

make_root() {
    [ ! -e "$root" ] || rmdir "$root" 2>/dev/null || give_up "$root is neither empty nor a Debian system"
    if ! command -v debootstrap >/dev/null 2>&1; then
        say "installing debootstrap"
        DEBIAN_FRONTEND=noninteractive apt-get -y -q install --no-install-recommends debootstrap >&2 ||
            skip "debootstrap is missing, and cannot be installed"
    fi
    from=$(package_source)
    [ -n "$from" ] || skip "apt does not say where this release's packages are"
    # shellcheck disable=SC2086 # one word each
    set -- $from
    say "making $2 from $1 in $root"
    mkdir -p "$(dirname "$root")"
    rm -rf --one-file-system "$root.new"
    debootstrap --variant=minbase --components="$3" "$2" "$root.new" "$1" >"$root.log" 2>&1 ||
        give_up "debootstrap failed: see $root.log"
    echo force-unsafe-io >"$root.new/etc/dpkg/dpkg.cfg.d/fast" # a root that breaks is made again
    echo "127.0.0.1 localhost" >"$root.new/etc/hosts"
    mv "$root.new" "$root"
    rm "$root.log"
}

# in_root COMMAND...: runs a command in the system, without the environment of this script.
in_root() {
    chroot "$root" /usr/bin/env -i PATH=/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LC_ALL=C.UTF-8 \
        OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1 "$@"
}

# with_display COMMAND...: runs a command in the system with an X server. Needs -noreset: a server that resets itself
# when a client leaves refuses the next client meanwhile.
with_display() {
    in_root xvfb-run -a -s "-screen 0 1280x1024x24 -nolisten tcp -noreset" "$@"
}

# install_there PACKAGE...: installs packages in the system with apt; a package may also be a file.
install_there() {
    say "installing there: $*"
    { in_root dpkg --configure -a && in_root apt-get -q update && in_root DEBIAN_FRONTEND=noninteractive apt-get -y -q install \
        --no-install-recommends "$@"; } >"$root/packages.log" 2>&1 ||
        give_up "packages cannot be installed: see $root/packages.log"
}

# enter_root PACKAGE...: makes the system in $root if there is none, and installs the packages that it lacks.
enter_root() {
    [ -e "$root/etc/debian_version" ] || make_root
    for folder in dev sys; do
        mount --rbind "/$folder" "$root/$folder"
    done
    mount -t proc proc "$root/proc"
    cp -L /etc/resolv.conf "$root/etc/resolv.conf"
    # shellcheck disable=SC2016 # dpkg's own variable
    missing=$(for package; do
        [ "$(in_root dpkg-query -W -f '${db:Status-Status}' "$package" 2>/dev/null)" = installed ] || echo "$package"
    done)
    if [ -n "$missing" ]; then
        # shellcheck disable=SC2086 # one word per package
        install_there $missing
        in_root apt-get clean
    fi
}

# Copies the working tree to /dfb in the system. Files keep their times, so that only changed ones are compiled again.
copy_tree() {
    rm -rf --one-file-system "$root/dfb"
    mkdir "$root/dfb"
    tar -C "$source" -c --one-file-system --exclude=./build --exclude=./.git --exclude="./${root#"$source"/}" . | tar -C "$root/dfb" -x
}

# build_tree TARGET...: builds the targets in the system, in /build.
build_tree() {
    say "building $*"
    {
        in_root cmake -S /dfb -B /build -DCMAKE_BUILD_TYPE=Release -DMPI_CXX_COMPILER=mpicxx.openmpi -DDFB_WITH_TBB=OFF \
            -DDFB_WITH_SNAPPY=OFF -DDFB_BUILD_TESTS=OFF -DDFB_BUILD_BENCH=OFF &&
            in_root cmake --build /build --parallel "$(sh "$source/cmake/jobs.sh")" --target "$@"
    } >"$root/build.log" 2>&1 || give_up "it does not build: see $root/build.log"
}
