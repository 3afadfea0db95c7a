# A recipe for Spack 1.0. It was compiled by Python and compared with Spack's documentation, and never run.
#
#     spack repo create ~/spack-dfb dfb_repo && spack repo add ~/spack-dfb/spack_repo/dfb_repo
#     mkdir -p ~/spack-dfb/spack_repo/dfb_repo/packages/dfb && cp package.py $_
#     spack install dfb@main ^mpich     (or dfb@0.2.0, if your copy has that tag)
#
# `git` is the place of your copy: with a folder, file:///home/me/dfb.

from spack_repo.builtin.build_systems.cmake import CMakePackage

from spack.package import *


class Dfb(CMakePackage):
    """Distributed rendering: the tiles of many ranks become one image, the same bit for bit in whatever order they come."""

    git = "https://dfb.invalid/dfb.git"

    license("Apache-2.0")

    version("main", branch="main")
    version("0.2.0", tag="v0.2.0")

    variant("mpi", default=True, description="Ranks are MPI processes")
    variant("tbb", default=True, description="Tasks run on oneTBB")
    variant("snappy", default=True, description="Messages may be compressed with Snappy")

    depends_on("cxx", type="build")
    depends_on("cmake@3.16:", type="build")
    depends_on("mpi@3.1:", when="+mpi")
    depends_on("tbb", when="+tbb")
    depends_on("snappy", when="+snappy")

    def cmake_args(self):
        return [
            self.define_from_variant("DFB_WITH_MPI", "mpi"),
            self.define_from_variant("DFB_WITH_TBB", "tbb"),
            self.define_from_variant("DFB_WITH_SNAPPY", "snappy"),
            self.define("DFB_BUILD_TESTS", False),
            self.define("DFB_BUILD_EXAMPLES", False),
            self.define("DFB_BUILD_BENCH", False),
        ]
