"""The cache folder, and C source compiled for this processor.

PAYLOAD_TRANSPORT_NATIVE=0 switches it off.
"""

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

_COMMON = ("-fPIC", "-shared", "-w")
_TIMEOUT_S = 300.0


def cache_folder() -> Path:
    """Return $PAYLOAD_TRANSPORT_CACHE, or the user's cache folder."""
    named = os.environ.get("PAYLOAD_TRANSPORT_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "payload-transport"


def enabled() -> bool:
    """Return whether compiled code is switched on."""
    return os.environ.get("PAYLOAD_TRANSPORT_NATIVE") != "0"


def find_compiler() -> str | None:
    """Return the C compiler: $CC, or the first installed of cc, gcc and clang."""
    return next(
        filter(None, map(shutil.which, filter(None, [os.environ.get("CC"), "cc", "gcc", "clang"]))),
        None,
    )


def compiled_file(name: str, source: bytes, flags: Sequence[str]) -> Path:
    """Return the path of a library, with a hash of source, flags and processor in its name."""
    digest = hashlib.sha256(source + repr((tuple(flags), _processor())).encode())
    return cache_folder() / f"{name}-{digest.hexdigest()[:16]}.so"


def intact(path: Path) -> bool:
    """Return whether a library is there, and this user's or root's."""
    try:
        return path.stat().st_uid in (0, os.getuid())
    except OSError:
        return False


def compile_library(path: Path, source: bytes, flags: Sequence[str]) -> bool:
    """Compile a C source if it is not.

    Return False if there is no compiler, it fails, or the cache is not writable.
    """
    compiler = find_compiler()
    if intact(path) or compiler is None:
        return intact(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            made = str(Path(folder) / path.name)
            command = [compiler, *_COMMON, *flags, "-o", made, "-x", "c", "-", "-lm"]
            subprocess.run(
                command, input=source, check=True, capture_output=True, timeout=_TIMEOUT_S
            )
            os.replace(made, path)  # other processes see it in full or not at all
    except (OSError, subprocess.SubprocessError):
        return False
    return True


@lru_cache
def _processor() -> str:
    """Return the processor's identity: code compiled for one may not run on another."""
    try:
        first = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0].splitlines()
        wanted = [line for line in first if line.startswith(("flags", "Features", "model name"))]
    except OSError:
        wanted = [platform.processor()]
    return "".join([platform.system(), platform.machine(), *wanted])
