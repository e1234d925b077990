"""Builds the Kalman filter (go1exp/deploy/estimation/cpp) when go1exp is installed.

An editable install leaves the extension beside its source; a wheel gets a copy of it. Without a C++ compiler, Python's
headers, pybind11 or Eigen, go1exp is installed without the filter, which then says at its first use what is missing.

By hand: python hatch_build.py [--sanitise] [FOLDER]
"""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parent
PACKAGE = ROOT / "go1exp" / "deploy" / "estimation"
NAME = "_kalman" + str(sysconfig.get_config_var("EXT_SUFFIX"))

# No fused multiply-add: every machine rounds alike.
FLAGS = ["-std=c++17", "-shared", "-fPIC", "-fvisibility=hidden", "-ffp-contract=off", "-Wall", "-Wextra"]
FAST = ["-O2", "-DNDEBUG"]
SANITISE = ["-O1", "-g", "-fno-omit-frame-pointer", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
SANITISE += ["-DEIGEN_RUNTIME_NO_MALLOC"]  # with Eigen's assertions on, an update that allocates aborts


class MissingToolError(RuntimeError):
    """Something that the build needs is not there; the message names it."""


def includes() -> list[Path]:
    """Folders of the headers: Python, pybind11, Eigen (of cmeel-eigen, or the system's)."""
    python = Path(sysconfig.get_path("include"))
    if not (python / "Python.h").is_file():
        raise MissingToolError(f"no Python.h in {python} (Debian: python3-dev)")
    try:
        import pybind11
    except ImportError as error:
        raise MissingToolError("no pybind11 in the building Python") from error
    found = [python, Path(pybind11.get_include())]
    try:
        files = importlib.metadata.files("cmeel-eigen") or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    # (sysconfig's paths do not know packages under pip's build isolation)
    places = [Path(str(f.locate())).resolve().parents[1] for f in files if f.parts[-2:] == ("Eigen", "Dense")]
    places += [Path(p) for p in ("/usr/include/eigen3", "/usr/local/include/eigen3") if (Path(p) / "Eigen").is_dir()]
    if not places:
        raise MissingToolError("no Eigen: neither cmeel-eigen in the building Python nor libeigen3-dev")
    return [*found, places[0]]


def compile_filter(folder: Path, sanitise: bool = False) -> Path:
    """Compile the extension into a folder, whole or not at all; return the file.

    Raises:
        MissingToolError: if a compiler or a header is missing.
        subprocess.CalledProcessError: if the source does not compile.
    """
    wanted = [os.environ["CXX"]] if os.environ.get("CXX") else ["g++", "clang++", "c++"]
    compiler = next((name.split() for name in wanted if shutil.which(name.split()[0])), None)
    if compiler is None:
        raise MissingToolError(f"no C++ compiler: {', '.join(wanted)} not found (Debian: g++; CXX names another)")
    folder.mkdir(parents=True, exist_ok=True)
    out, partial = folder / NAME, folder / f".{NAME}.part"
    options = [*FLAGS, *(SANITISE if sanitise else FAST), *(part for i in includes() for part in ("-isystem", str(i)))]
    if sys.platform == "darwin":
        options += ["-undefined", "dynamic_lookup"]
    try:
        subprocess.run([*compiler, *options, str(PACKAGE / "cpp/bindings.cpp"), "-o", str(partial)], check=True)
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)
    return out


class KalmanBuildHook(BuildHookInterface):
    """Called by hatchling for wheels and editable installs."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and say what the wheel holds."""
        try:
            extension = compile_filter(PACKAGE if version == "editable" else ROOT / "build" / "kalman")
        except MissingToolError as error:
            self.app.display_warning(f"go1exp: installed without its Kalman filter: {error}")
            return
        build_data["pure_python"] = False
        build_data["infer_tag"] = True
        if version != "editable":
            build_data["force_include"][str(extension)] = f"go1exp/deploy/estimation/{NAME}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Compile the Kalman filter.")
    parser.add_argument("folder", nargs="?", type=Path, default=PACKAGE)
    parser.add_argument("--sanitise", action="store_true", help="with the address and undefined-behaviour sanitisers")
    wanted = parser.parse_args()
    print(compile_filter(wanted.folder, wanted.sanitise))
