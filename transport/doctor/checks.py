"""All checks of `transport doctor`, and those of Python, packages, linear algebra, kernels and disk."""

import platform
import shutil
import sys
from collections.abc import Callable, Iterator
from importlib import import_module, metadata
from pathlib import Path

import threadpoolctl
from packaging.requirements import Requirement
from packaging.version import Version

from model import compiler, native
from model.compiler import cache_folder
from protocol.scenario.setup import Setup
from transport.doctor.host import Finding, host_checks, judged

_DISTRIBUTION = "payload-transport"
_LEAST_PYTHON = (3, 11)
# A run of 25 s writes 4 MB; an experiment has some hundred runs.
_LEAST_DISK_MB = 500


def checks(setup: Setup) -> Iterator[tuple[str, Finding]]:
    """Yield every check with its name as soon as it is done; all together take some seconds."""
    yield "python", python()
    yield from zip(("packages", "extras"), packages(), strict=False)
    for name in ("ports", "network", "step"):
        yield name, _guarded(name, setup)
    yield "blas threads", blas()
    yield "kernels", kernels()
    yield "disk", disk(Path.cwd())
    yield from host_checks(setup)


def _guarded(name: str, setup: Setup) -> Finding:
    """Return the finding of a check of `run_checks`; any error, also of its imports, is a failed check."""
    try:
        check: Callable[[Setup], Finding] = getattr(import_module("transport.doctor.run_checks"), name)
        return check(setup)
    except Exception as error:  # noqa: BLE001 - named in the finding
        found = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        advice = "pip install --force-reinstall the package in the message; if there is none, report the error"
        return Finding("fail", found, advice)


def python() -> Finding:
    """Check the interpreter."""
    found = f"{platform.python_implementation()} {platform.python_version()}, {sys.maxsize.bit_length() + 1} bit"
    if sys.version_info < _LEAST_PYTHON or sys.maxsize < 2**32:
        return Finding("fail", found, "install a 64-bit Python 3.11 or newer")
    return Finding("ok", found)


def packages(distribution: str = _DISTRIBUTION) -> Iterator[Finding]:
    """Check the required packages, then those of the extras."""
    try:
        required = [Requirement(line) for line in metadata.requires(distribution) or []]
        name = f"{distribution} {metadata.version(distribution)}"
    except metadata.PackageNotFoundError:
        yield Finding("fail", f"{distribution} is not installed", "pip install . in its folder")
        return
    wrong: list[str] = []
    right: list[str] = []
    missing: dict[str, list[str]] = {}  # by extra
    for requirement in required:
        installed = _version(requirement.name)
        fits = installed is not None and requirement.specifier.contains(Version(installed), prereleases=True)
        if _belongs(requirement):
            needed = f"{requirement.name} {installed or 'is missing'} (needs {requirement.specifier or 'any'})"
            (right if fits else wrong).append(f"{requirement.name} {installed}" if fits else needed)
        elif not fits and requirement.name != distribution:
            for extra in metadata.metadata(distribution).get_all("Provides-Extra") or []:
                if _belongs(requirement, extra):
                    missing.setdefault(extra, []).append(requirement.name)
    if wrong:
        advice = f"pip install --upgrade {distribution}, or build it again: make clean run"
        yield Finding("fail", f"{name}: {', '.join(wrong)}", advice)
    else:
        yield Finding("ok", f"{name} with {', '.join(right)}")
    absent = "; ".join(f"{extra} ({', '.join(names)})" for extra, names in missing.items())
    yield Finding("ok", f"not installed, optional: {absent}" if absent else "all installed")


def blas() -> Finding:
    """Check that linear algebra can be limited to one thread: several would change bits and compete for cores."""
    with threadpoolctl.threadpool_limits(1):
        limited = threadpoolctl.threadpool_info()
    free = threadpoolctl.threadpool_info()
    libraries = ", ".join(f"{pool['internal_api']} {pool['version'] or ''}".strip() for pool in free) or "none found"
    unlimited = [pool["internal_api"] for pool in limited if pool["num_threads"] != 1]
    found = f"{', '.join(unlimited)} cannot be limited to" if unlimited else f"{libraries}:"
    advice = "export OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 MKL_NUM_THREADS=1"
    return judged(f"{found} one thread in every process of a run", bool(unlimited), advice)


def kernels() -> Finding:
    """Check that the kernels of a step are compiled: otherwise a step takes nearly twice as long."""
    found = compiler.find_compiler()
    if native.AVAILABLE:
        return Finding("ok", f"compiled for this processor, in {cache_folder()}")
    if not compiler.enabled():
        reason, advice = "switched off", "unset PAYLOAD_TRANSPORT_NATIVE"
    elif found is None:
        reason, advice = "no C compiler", "install gcc or clang"
    else:
        reason = f"{found} fails, or {cache_folder()} cannot be written"
        advice = f"make {found} compile shared libraries, or set $CC or $PAYLOAD_TRANSPORT_CACHE"
    return Finding("warn", f"{reason}: a step takes nearly twice as long", advice)


def disk(folder: Path) -> Finding:
    """Check the free space for run folders."""
    free_mb = shutil.disk_usage(folder).free / 1e6
    advice = "free some space, or use another folder: --out"
    return judged(f"{free_mb / 1e3:.1f} GB free at {folder}", free_mb < _LEAST_DISK_MB, advice)


def _belongs(requirement: Requirement, extra: str = "") -> bool:
    """Return whether a requirement applies here, without or with an extra."""
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
