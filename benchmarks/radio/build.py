"""Builds reference.cc against the libraries of the package `ns3`, below build/radio."""

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
FOLDER = HERE.parents[1] / "build" / "radio"
# `make radio-reference` installs ns3 here, without its Python bindings.
PACKAGES = FOLDER / "packages"
PROGRAM = FOLDER / "reference"
SOURCE = HERE / "reference.cc"
LIBRARIES = ("wifi", "mobility", "propagation", "network", "core")


class BuildError(Exception):
    """The program could not be built."""


def version() -> str:
    """Return the version of ns-3 as installed. Raises: BuildError: it is not."""
    return _library("core").name.removeprefix("libns").removesuffix("-core.so")


def program() -> Path:
    """Return the program, built if its source is newer.

    Raises: BuildError: ns-3 or g++ is missing.
    """
    if PROGRAM.exists() and PROGRAM.stat().st_mtime > SOURCE.stat().st_mtime:
        return PROGRAM
    libraries = [_library(name) for name in LIBRARIES]
    folder = libraries[0].parent
    command = [
        "g++",
        "-std=c++20",
        "-O1",
        f"-I{PACKAGES / 'ns3' / 'include'}",
        str(SOURCE),
        "-o",
        str(PROGRAM),
        *map(str, libraries),
        f"-Wl,-rpath,{folder}",
        "-Wl,--allow-shlib-undefined",  # further libraries of ns-3, which these do not call
    ]
    try:
        subprocess.run(command, check=True, stdout=sys.stderr)
    except (OSError, subprocess.CalledProcessError) as error:
        raise BuildError(f"reference.cc: expected g++ to build it, got {error}") from error
    return PROGRAM


def _library(name: str) -> Path:
    libraries = sorted((PACKAGES / "ns3" / "lib64").glob(f"libns*-{name}.so"))
    if not libraries:
        raise BuildError(f"{PACKAGES}: expected the package ns3, got none; make radio-reference")
    return libraries[0]
