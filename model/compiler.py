"""The cache folder, and C source compiled for this processor; PAYLOAD_TRANSPORT_NATIVE=0 switches it off."""

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


def replace_atomically(path: Path, content: bytes) -> bool:
    """Write a file that other processes see in full or not at all; return False if that fails, as on a full disk."""
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            temporary = Path(file.name)
            file.write(content)
        os.replace(temporary, path)
    except OSError:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        return False
    return True


def enabled() -> bool:
    """Return whether compiled code is switched on."""
    return os.environ.get("PAYLOAD_TRANSPORT_NATIVE") != "0"


def find_compiler() -> str | None:
    """Return the C compiler: $CC, or the first installed of cc, gcc and clang."""
    return next(filter(None, map(shutil.which, filter(None, [os.environ.get("CC"), "cc", "gcc", "clang"]))), None)


def compiled_file(name: str, source: bytes, flags: Sequence[str]) -> Path:
    """Return the path of a library, with a hash of source, flags and processor in its name."""
    digest = hashlib.sha256(source)
    digest.update(repr((tuple(flags), _processor())).encode())
    return cache_folder() / f"{name}-{digest.hexdigest()[:16]}.so"


def intact(path: Path) -> bool:
    """Return whether a library is there, and this user's or root's."""
    try:
        return path.stat().st_uid in (0, os.getuid())
    except OSError:
        return False


def compile_library(path: Path, source: bytes, flags: Sequence[str]) -> bool:
    """Compile a C source; return False if there is no compiler, it fails, or the cache cannot be written."""
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
            return replace_atomically(path, made.read_bytes())
    except (OSError, subprocess.SubprocessError):
        return False


@lru_cache
def _processor() -> str:
    """Return the processor's identity: code compiled for one may not run on another."""
    try:
        first = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0].splitlines()
        wanted = [line for line in first if line.startswith(("flags", "Features", "model name"))]
    except OSError:
        wanted = [platform.processor()]
    return "".join([platform.system(), platform.machine(), *wanted])
