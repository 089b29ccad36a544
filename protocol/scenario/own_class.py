"""Classes of the user that a scenario names, an engine or a controller: import, calls, version."""

import contextlib
import hashlib
import importlib
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, NoReturn

import numpy as np
from pydantic import AfterValidator

from transport.model.arrays import Array

_PROGRAM = "transport."  # beginning of the names of the program's modules
_MAIN = "__main__"  # module of a script or notebook, which is no file to be imported again

# Characters of an error that is passed on: it travels in messages, with the name of the class.
_LONGEST_TEXT = 400

_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")
_FOREIGN_FILE = re.compile(r"<|.*site-packages")

# Hashes of the files of imported modules as they were imported, by the name of the module.
_DIGESTS: dict[str, str] = {}


class OwnClassError(ValueError):
    """A class of the user that cannot be used, or that has failed; one line."""


def or_class(*names: str) -> AfterValidator:
    """Return a check that a text is one of some names or has the form "package.module:Class"."""

    def check(value: str) -> str:
        if value not in names and not _NAME.fullmatch(value):
            ready = ", ".join(map(repr, names))
            raise ValueError(f"expected {ready} or 'package.module:Class', got {value!r}")
        return value

    return AfterValidator(check)


def own_class(name: str) -> Any:
    """Return the user's class "package.module:Class", of the current folder or installed packages.

    The current folder comes first, for this module alone: a file there named like an installed
    package hides that package from no other import. A module whose file has changed is imported
    again, since the recorded version must be that of the code that runs.
    Raises: OwnClassError: it is not found, or its import fails.
    """
    module_name, _, attribute = name.partition(":")
    package = module_name.partition(".")[0]
    folder = str(Path.cwd())
    spec = _new_in(folder, package)
    with errors_of(f"its import from {folder} or the installed packages"), _on_path(folder):
        if spec is not None:
            _execute(spec)
        return getattr(_current(module_name), attribute)


def _current(name: str) -> ModuleType:
    """Return a module, imported again if its file has changed since it was imported."""
    module = importlib.import_module(name)
    digest = _digest(name)
    imported = _DIGESTS.setdefault(name, digest)
    if imported != digest and name != _MAIN:
        module = importlib.reload(module)
        _DIGESTS[name] = digest
    return module


@contextmanager
def _on_path(folder: str) -> Iterator[None]:
    """Search a folder last, so that modules beside the user's file can be imported by it."""
    sys.path.append(folder)
    try:
        yield
    finally:
        last = len(sys.path) - 1 - sys.path[::-1].index(folder)
        del sys.path[last]


def _new_in(folder: str, name: str) -> ModuleSpec | None:
    """Return the specification of a package in a folder; None if it is imported or not there.

    Raises: OwnClassError: another package of this name, which is not the user's, is imported.
    """
    importlib.invalidate_caches()  # the file may be newer than this process
    spec = None if name == _MAIN else PathFinder.find_spec(name, [folder])
    if spec is None or spec.loader is None:
        return None

    imported = sys.modules.get(name)
    if imported is None:
        return spec
    file = getattr(imported, "__file__", None)
    if file == spec.origin:
        return None
    if name not in _DIGESTS:
        problem = f"{spec.origin} has the name of the imported package {file}"
        raise OwnClassError(f"{problem}: rename it")
    del _DIGESTS[name]
    return spec


def _execute(spec: ModuleSpec) -> None:
    """Import a package as found."""
    module = module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)  # type: ignore[union-attr]
    except BaseException:
        del sys.modules[spec.name]
        raise


def version_of(make: Any) -> str:
    """Return the version of a class: its attribute `version`, else a hash of its file.

    Empty if there is neither.
    """
    given = getattr(make, "version", None)
    return _digest(make.__module__) if given is None else str(given)


def _digest(module: str) -> str:
    """Return a hash of the file of an imported module; empty without one."""
    file = getattr(sys.modules.get(module), "__file__", None)
    if not file:
        return ""
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()[:12]


def new_object(make: Callable[..., Any], methods: Sequence[str], *arguments: object) -> Any:
    """Return a new object of a class.

    Raises: OwnClassError: its constructor fails, or it lacks one of the methods.
    """
    with errors_of("the constructor"):
        instance = make(*arguments)

    for name in methods:
        if not callable(getattr(instance, name, None)):
            raise OwnClassError(f"expected the methods {', '.join(methods)}, got no {name}")
    return instance


def real_array(given: object) -> Array:
    """Return a copy of a real array, finite or not, that a method returned.

    Complex numbers and texts raise.
    """
    return np.array(given).astype(np.float64, casting="same_kind")


@contextmanager
def errors_of(call: str) -> Iterator[None]:
    """Turn exceptions of a call of a class into OwnClassError, with file and line, also `os._exit`.

    Its output goes to standard error.
    """
    try:
        with redirect_stdout(sys.stderr), _no_exit():
            yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise OwnClassError(f"{call} raised {_in_words(error)}{_place_of(error)}") from error


def _in_words(error: BaseException) -> str:
    """Return an exception in one printable line of limited length, which a message can hold."""
    text = " ".join(f"{type(error).__name__}: {error}".split())[:_LONGEST_TEXT]
    return "".join(character if character.isprintable() else "?" for character in text)


def _place_of(error: BaseException) -> str:
    """Return file and line of the user's code that raised an exception; empty if none did."""
    # The first two frames are those of `told` and of its caller.
    for frame in reversed(traceback.extract_tb(error.__traceback__)[2:]):
        is_foreign = _FOREIGN_FILE.match(frame.filename) or frame.filename == __file__
        if not is_foreign:
            return f" ({Path(frame.filename).name}:{frame.lineno})"
    return ""


@contextmanager
def _no_exit() -> Iterator[None]:
    """Turn `os._exit` by the code that is called within it into SystemExit.

    A command that ended so would look like a success, with no word of the class. Other threads,
    forked children and the program's own handlers of signals end as they ask to; `os.abort`,
    signals and C code end the process, which its parent reports.
    """
    end = os._exit
    process = os.getpid()
    caller = _caller()

    def end_or_raise(status: int) -> NoReturn:
        frame = sys._getframe(1)
        is_of_program = frame.f_globals.get("__name__", "").startswith(_PROGRAM)
        if os.getpid() == process and not is_of_program and _is_within(frame, caller):
            raise SystemExit(f"os._exit({status})")
        end(status)

    os._exit = end_or_raise
    try:
        yield
    finally:
        os._exit = end


def _caller() -> FrameType | None:
    """Return the frame of the function that called this module."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and frame.f_code.co_filename in (__file__, contextlib.__file__):
        frame = frame.f_back
    return frame


def _is_within(frame: FrameType | None, caller: FrameType | None) -> bool:
    """Return whether a frame was called, directly or not, by another one, so in its thread."""
    while frame is not None:
        if frame is caller:
            return True
        frame = frame.f_back
    return False
