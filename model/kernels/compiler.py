"""The cache folder, and C source compiled for this processor.

PAYLOAD_TRANSPORT_NATIVE=0 switches compiled code off (`enabled`); 2, 4 or 8 sets the width of its
vectors in doubles, which is otherwise that of the processor's registers (`processor_flags`).
"""

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

_COMMON = ("-fPIC", "-w")
# Of the loops in `kernels.c`.
LOOP_FLAGS = ("-O3", "-fno-math-errno")
# Of functions that CasADi generates. No contraction of products and sums: the same bits as its
# interpreter. Functions of the library call each other directly, and short ones are inlined.
GENERATED_FLAGS = ("-Og", "-fno-math-errno", "-ffp-contract=off", "-fno-semantic-interposition")
_TIMEOUT_S = 300.0
_SWITCH = "PAYLOAD_TRANSPORT_NATIVE"
_WIDTHS = ("2", "4", "8")


def cache_folder() -> Path:
    """Return $PAYLOAD_TRANSPORT_CACHE, or the user's cache folder.

    A user without a home that can be written, as in a container with any user id, has one among the
    temporary files.
    """
    named = os.environ.get("PAYLOAD_TRANSPORT_CACHE")
    if named:
        return Path(named)
    shared = os.environ.get("XDG_CACHE_HOME")
    if shared:
        return Path(shared) / "payload-transport"
    temporary = Path(tempfile.gettempdir()) / f"payload-transport-{os.getuid()}"
    try:
        own = Path.home() / ".cache" / "payload-transport"
    except RuntimeError:
        return temporary
    nearest = next(folder for folder in (own, *own.parents) if folder.exists())
    return own if os.access(nearest, os.W_OK) else temporary


def enabled() -> bool:
    """Return whether compiled code is switched on."""
    return os.environ.get(_SWITCH) != "0"


def processor_flags() -> tuple[str, ...]:
    """Return the compiler's flags for this processor, with vectors of a forced width.

    Narrow vectors of x86 processors use no instruction of AVX-512, as on a processor without it.
    """
    is_arm = platform.machine() in ("aarch64", "arm64")
    # Clang for ARM processors does not know `native` as an architecture.
    flags = ["-mcpu=native" if is_arm else "-march=native"]

    width = os.environ.get(_SWITCH, "")
    if width in _WIDTHS:
        flags.append(f"-DLANES={width}")
        if width != "8" and not is_arm:
            flags.append("-mno-avx512f")
    elif width not in ("", "0"):
        expected = "expected 0 (no compiled code), 2, 4 or 8 (width of its vectors), or no value"
        warnings.warn(f"{_SWITCH}={width}: {expected}; ignored", RuntimeWarning, stacklevel=2)
    return tuple(flags)


def find_compiler() -> str | None:
    """Return the C compiler: $CC, or the first installed of cc, gcc and clang."""
    for name in (os.environ.get("CC"), "cc", "gcc", "clang"):
        path = shutil.which(name) if name else None
        if path is not None:
            return path
    return None


def compiled_file(name: str, source: bytes, flags: Sequence[str]) -> Path:
    """Return the path of a library, with a hash of source, flags and processor in its name."""
    how = repr((*_COMMON, *flags, _processor()))
    digest = hashlib.sha256(source + how.encode())
    return cache_folder() / f"{name}-{digest.hexdigest()[:16]}.so"


def intact(path: Path) -> bool:
    """Return whether a library exists as it was compiled, and is owned by this user or root."""
    try:
        if path.stat().st_uid not in (0, os.getuid()):
            return False
        return _checksum(path.read_bytes()) == _checksum_file(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False


def compile_library(path: Path, sources: Sequence[bytes], flags: Sequence[str]) -> bool:
    """Compile C sources, unless their library is intact; return whether there is one.

    All sources are compiled at the same time. There is no library without a compiler, or if it fails.
    If it cannot be started, or the cache cannot be written, a warning says so.
    """
    if intact(path):
        return True

    compiler = find_compiler()
    if compiler is None:
        return False

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            objects = _compiled([compiler, *_COMMON, *flags], sources, Path(folder))
            library = Path(folder) / path.name
            link = [compiler, "-shared", "-o", str(library), *map(str, objects), "-lm"]
            subprocess.run(link, check=True, capture_output=True, timeout=_TIMEOUT_S)
            checksum = _checksum_file(library)
            checksum.write_text(_checksum(library.read_bytes()), encoding="utf-8")

            # Other processes see each file in full or not at all. The checksum comes first: one that
            # looks between the two sees a library that does not match it, and compiles.
            os.replace(checksum, _checksum_file(path))
            os.replace(library, path)
    except subprocess.SubprocessError:
        return False
    except OSError as error:
        cannot = f"the cache {path.parent} cannot be written"
        if error.filename == compiler:
            cannot = f"the compiler {compiler} cannot be started"
        _warn_of_plain_kernels(f"{cannot} ({error.strerror})")
        return False
    return True


def _compiled(command: Sequence[str], sources: Sequence[bytes], folder: Path) -> list[Path]:
    """Compile C sources, all at the same time; return the object files.

    Raises: subprocess.SubprocessError: one cannot be compiled, or takes too long.
    """
    objects: list[Path] = []
    compilers: list[subprocess.Popen[bytes]] = []
    try:
        for number, content in enumerate(sources):
            source = folder / f"{number}.c"
            source.write_bytes(content)
            objects.append(source.with_suffix(".o"))
            compilers.append(
                subprocess.Popen(
                    [*command, "-c", "-o", str(objects[-1]), str(source)],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
            )
        for one in compilers:
            if one.wait(_TIMEOUT_S) != 0:
                raise subprocess.CalledProcessError(one.returncode, command)
    finally:
        # After an interrupt or an error no compiler goes on.
        for one in compilers:
            one.kill()
            one.wait()
    return objects


@lru_cache
def _warn_of_plain_kernels(problem: str) -> None:
    """Give a warning, once in a process: every library has the same problem."""
    remedy = "plain ones are used, which are several times slower"
    warnings.warn(f"no compiled kernels: {problem}; {remedy}", RuntimeWarning, stacklevel=3)


def _checksum(library: bytes) -> str:
    """Return the hash of a library's content."""
    return hashlib.sha256(library).hexdigest()


def _checksum_file(path: Path) -> Path:
    """Return the file with a library's hash: a library that a full disk cut has another."""
    return path.with_name(f"{path.name}.sha256")


@lru_cache
def _processor() -> str:
    """Return the processor's identity: code compiled for one may not run on another."""
    try:
        first = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0].splitlines()
        wanted = [line for line in first if line.startswith(("flags", "Features", "model name"))]
    except OSError:
        wanted = [platform.processor()]
    return "".join([platform.system(), platform.machine(), *wanted])
