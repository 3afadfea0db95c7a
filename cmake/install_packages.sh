#!/bin/sh
# sh cmake/install_packages.sh [clang|bench|tests|browser|aarch64]
# Installs the packages that this machine lacks for building dfb, its tests and its examples. "clang" adds Clang and its
# sanitizers; "bench" adds what only the benchmarks need; "tests" adds what the site, the Python package (100 MB), the
# examples with other renderers, on GPUs and in Fortran, and EXR pictures and plots need; "browser" adds what drives the
# page of the live view; "aarch64" adds a compiler for that processor and qemu. Uses apt-get on Debian and Ubuntu;
# elsewhere says what is missing and exits with 1, except for the live view, which is then left out. Quick when nothing
# is missing.
set -eu
with=${1:-}
case $#:$with in
0: | 1:clang | 1:bench | 1:tests | 1:browser | 1:aarch64) ;;
*)
    echo "usage: sh cmake/install_packages.sh [clang|bench|tests|browser|aarch64]" >&2
    exit 2
    ;;
esac

have() {
    command -v "$1" >/dev/null 2>&1
}

say() {
    echo "install_packages.sh: $*" >&2
}

# Prints the Debian packages of missing dependencies that may also be there without a package.
tools() {
    have c++ || have g++ || have clang++ || echo g++
    have cmake || echo cmake
    have ninja || echo ninja-build
    have pkg-config || echo pkg-config
    # Any MPI will do. Two of them side by side conflict, so a part of Open MPI gets the rest of it.
    if ! have mpiexec || ! echo '#include <mpi.h>' | mpicxx -E -x c++ - >/dev/null 2>&1; then
        if mpiexec --version 2>&1 | grep -E 'Open MPI|OpenRTE|PRRTE' >/dev/null; then
            echo openmpi-bin libopenmpi-dev
        else
            echo mpich libmpich-dev
        fi
    fi
    if [ "$with" = clang ] && ! echo 'int main() {}' | clang++ -fsanitize=thread -x c++ - -o /dev/null 2>/dev/null; then
        echo clang libclang-rt-dev
    fi
    if [ "$with" = tests ] && ! have doxygen; then
        echo doxygen doxygen-awesome-css
    fi
    if [ "$with" = tests ] && ! have gfortran; then
        echo gfortran
    fi
    if [ "$with" = browser ]; then
        have chromium || echo chromium
        have node || echo nodejs
        have npm || echo npm
    fi
    if [ "$with" = aarch64 ]; then
        have aarch64-linux-gnu-g++ || echo g++-aarch64-linux-gnu
        have qemu-aarch64 || echo qemu-user
    fi
}

libraries="libtbb-dev libsnappy-dev catch2 libembree-dev libcli11-dev nlohmann-json3-dev libxxhash-dev libpng-dev libhdf5-dev"
libraries="$libraries libassimp-dev libcpp-httplib-dev libturbojpeg0-dev" # meshes; the live view
[ "$with" != bench ] || libraries="$libraries libbenchmark-dev python3-matplotlib"
if [ "$with" = tests ]; then
    libraries="$libraries libtachyon-mt-0-dev libopenexr-dev python3-matplotlib python3-dev python3-numpy pybind11-dev"
    libraries="$libraries ocl-icd-opencl-dev pocl-opencl-icd"
fi

# Without dpkg, a library is found by its header.
missing_headers() {
    while read -r name headers; do
        for header in $headers; do
            if echo "#include <$header>" | "${CXX:-c++}" -std=c++17 -E -x c++ - >/dev/null 2>&1; then
                continue 2
            fi
        done
        echo "$name"
    done <<END
oneTBB tbb/parallel_for.h
Snappy snappy.h
Catch2 catch2/catch_all.hpp catch2/catch.hpp
Embree(3_or_4) embree4/rtcore.h embree3/rtcore.h
CLI11 CLI/CLI.hpp
nlohmann-json nlohmann/json.hpp
xxHash xxhash.h
libpng png.h
HDF5 hdf5.h hdf5/serial/hdf5.h
Assimp assimp/Importer.hpp
$([ "$with" != bench ] || echo GoogleBenchmark benchmark/benchmark.h)
END
}

if ! have apt-get || ! have dpkg-query; then
    # shellcheck disable=SC2046,SC2116 # newlines to spaces
    missing=$(echo $(tools) $(missing_headers))
    [ -z "$missing" ] && exit 0
    say "please install, with your system's package manager: $missing"
    say "(headers in an unusual place are found through CPATH)"
    exit 1
fi

missing=$(tools)
for package in $libraries; do
    [ "$(dpkg-query -W -f '${db:Status-Status}' "$package" 2>/dev/null)" = installed ] || missing="$missing $package"
done
# shellcheck disable=SC2086,SC2116 # newlines to spaces
missing=$(echo $missing)
[ -z "$missing" ] && exit 0

if [ "$(id -u)" -eq 0 ]; then
    as_root="env"
elif have sudo; then
    as_root="sudo env"
else
    say "these packages are missing, and installing them needs root or sudo: apt-get install $missing"
    exit 1
fi
say "installing: $missing"

apt() {
    $as_root DEBIAN_FRONTEND=noninteractive apt-get -y -q -o DPkg::Lock::Timeout=300 "$@"
}

# shellcheck disable=SC2086 # one word per package
if ! apt install --no-install-recommends $missing; then
    say "refreshing the package lists and trying once more"
    apt update || say "they cannot be refreshed now"
    # A release may lack some packages. CMake then says what it leaves out.
    known=
    for package in $missing; do
        if LC_ALL=C apt-cache policy "$package" | grep '^  Candidate: [^(]' >/dev/null; then
            known="$known $package"
        else
            say "this system has no package $package"
        fi
    done
    if [ -z "$known" ]; then
        say "nothing could be installed"
        exit 1
    fi
    apt install --no-install-recommends $known
fi
