"""For pip: builds the module dfb._dfb with CMake. pip install examples/adapters/python

Variables of the environment:
  CMAKE_ARGS  more options for CMake, such as -DDFB_WITH_MPI=OFF
  DFB_BUILD   a folder in which CMake has configured dfb already, to be used in place of a new one
"""

import os
import pathlib
import re
import shlex
import shutil
import subprocess
import sys

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

SOURCE = pathlib.Path(__file__).resolve().parent.parent.parent.parent
SCRATCH = SOURCE / "build/pip"


def version():
    header = SOURCE / "include/dfb/version.hpp"
    if not header.exists():
        raise SystemExit("dfb is built from its whole source tree, of which this folder is only a part")
    text = header.read_text()
    return ".".join(re.search(rf"define DFB_VERSION_{part} (\d+)", text)[1] for part in ("MAJOR", "MINOR", "PATCH"))


class BuildWithCMake(build_ext):
    def build_extension(self, ext):
        build = os.environ.get("DFB_BUILD")
        if not build:
            build = pathlib.Path(self.build_temp).resolve()
            self.configure(build)
        subprocess.run(["cmake", "--build", build, "--target", "dfb_python", "--parallel", str(min(4, os.cpu_count()))],
                       check=True)
        module = next(pathlib.Path(build, "examples/adapters/python/dfb").glob("_dfb.*"))
        target = pathlib.Path(self.get_ext_fullpath(ext.name))
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(module, target.with_name(module.name))

    def configure(self, build):
        options = [f"-DPython3_EXECUTABLE={sys.executable}", "-DCMAKE_BUILD_TYPE=Release", "-DDFB_BUILD_TESTS=OFF",
                   "-DDFB_BUILD_BENCH=OFF"]
        pathlib.Path(build, "CMakeCache.txt").unlink(missing_ok=True)  # it may name folders of an earlier pip
        try:
            import pybind11
            options.append(f"-Dpybind11_DIR={pybind11.get_cmake_dir()}")
        except ImportError:
            pass  # CMake looks where the system has it
        subprocess.run(["cmake", "-S", SOURCE, "-B", build, *options, *shlex.split(os.environ.get("CMAKE_ARGS", ""))],
                       check=True)


SCRATCH.mkdir(parents=True, exist_ok=True)
setup(version=version(), ext_modules=[Extension("dfb._dfb", [])], cmdclass={"build_ext": BuildWithCMake},
      options={"build": {"build_base": str(SCRATCH)}, "egg_info": {"egg_base": str(SCRATCH)}})
