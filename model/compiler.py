"""C source compiled for this processor by the compiler that is here, if one is, and kept in the cache folder.

Everything works without: what is compiled has a twin that is not. Set PAYLOAD_TRANSPORT_NATIVE=0 to do without.
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

from model.cache import cache_folder, replace_atomically

_COMMON = ("-fPIC", "-shared", "-w")
_TIMEOUT_S = 300.0


def enabled() -> bool:
    """Whether compiled code is wanted."""
    return os.environ.get("PAYLOAD_TRANSPORT_NATIVE") != "0"


def find_compiler() -> str | None:
    """The C compiler: $CC, or whichever of the usual ones is there."""
    return next(filter(None, map(shutil.which, filter(None, [os.environ.get("CC"), "cc", "gcc", "clang"]))), None)


def compiled_file(name: str, source: bytes, flags: Sequence[str]) -> Path:
    """Where a library is kept: the name has all that may make it differ or not run, the processor too."""
    digest = hashlib.sha256(source)
    digest.update(repr((tuple(flags), _processor())).encode())
    return cache_folder() / f"{name}-{digest.hexdigest()[:16]}.so"


def intact(path: Path) -> bool:
    """Whether a library is there in full, and nobody else's: loading half of one would end the process."""
    try:
        if path.stat().st_uid not in (0, os.getuid()):
            return False
        checksum = path.with_suffix(".sha256").read_text(encoding="ascii").strip()
        return hashlib.sha256(path.read_bytes()).hexdigest() == checksum
    except (OSError, ValueError):
        return False


def compile_library(path: Path, source: bytes, flags: Sequence[str]) -> bool:
    """Compile a C source; False where there is no compiler, it fails, or there is nowhere to keep the result."""
    compiler = find_compiler()
    if compiler is None:
        return False
    try:
        with tempfile.TemporaryDirectory() as folder:
            text, made = Path(folder) / "source.c", Path(folder) / "library.so"
            text.write_bytes(source)
            subprocess.run(
                [compiler, *_COMMON, *flags, "-o", made, text, "-lm"],
                check=True, capture_output=True, timeout=_TIMEOUT_S, stdin=subprocess.DEVNULL,
            )  # fmt: skip
            content = made.read_bytes()
    except (OSError, subprocess.SubprocessError):
        return False
    checksum = hashlib.sha256(content).hexdigest()
    return replace_atomically(path, content) and replace_atomically(path.with_suffix(".sha256"), checksum.encode())


@lru_cache
def _processor() -> str:
    """What code made for one processor needs to find again in another."""
    try:
        first = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0].splitlines()
        wanted = [line for line in first if line.startswith(("flags", "Features", "model name"))]
    except OSError:
        wanted = [platform.processor()]
    return "".join([platform.system(), platform.machine(), *wanted])
