"""Classes of the user that a scenario names, engine or controller.

Found, made, called, and recorded with a version.
"""

import hashlib
import importlib
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import AfterValidator

from transport.model.arrays import Array

_LONGEST_TEXT = 400  # of an error that is passed on, characters: it travels in messages, with the name of the class
_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")
_DIGESTS: dict[str, str] = {}  # hashes of the files of imported modules, as they were imported


class OwnClassError(ValueError):
    """A class of the user that cannot be used, or that has failed; one line."""


def or_class(*names: str) -> AfterValidator:
    """Return a check that a text is one of some names or has the form "package.module:Class"."""

    def check(value: str) -> str:
        if value not in names and not _NAME.fullmatch(value):
            raise ValueError(
                f"expected {', '.join(map(repr, names))} or 'package.module:Class', got {value!r}"
            )
        return value

    return AfterValidator(check)


def own_class(name: str) -> Any:
    """Return the user's class "package.module:Class", from the current folder or the installed packages.

    The current folder comes first, for this module alone: a file there named like an installed
    package hides that package from no other import. A module whose file has changed is imported
    again, since the recorded version must be that of the code that runs.
    Raises: OwnClassError: it is not found, or its import fails.
    """
    module_name, _, attribute = name.partition(":")
    folder = str(Path.cwd())
    spec = _new_in(folder, module_name.partition(".")[0])
    with told(f"its import from {folder} or the installed packages"), _on_path(folder):
        if spec is not None:
            _execute(spec)
        module = importlib.import_module(module_name)
        digest = _digest(module_name)
        if _DIGESTS.setdefault(module_name, digest) != digest and module_name != "__main__":
            module = importlib.reload(module)
            _DIGESTS[module_name] = digest
        return getattr(module, attribute)


@contextmanager
def _on_path(folder: str) -> Iterator[None]:
    """Search a folder last, so that modules beside the user's file can be imported by it."""
    sys.path.append(folder)
    try:
        yield
    finally:
        del sys.path[len(sys.path) - 1 - sys.path[::-1].index(folder)]


def _new_in(folder: str, name: str) -> ModuleSpec | None:
    """Return how to import a package from a folder; None if it is not there, or already imported.

    Raises: OwnClassError: another package of this name, which is not the user's, is imported.
    """
    importlib.invalidate_caches()  # the file may be newer than this process
    spec = None if name == "__main__" else PathFinder.find_spec(name, [folder])
    if spec is None or spec.loader is None:
        return None
    imported = sys.modules.get(name)
    if imported is None:
        return spec
    file = getattr(imported, "__file__", None)
    if file == spec.origin:
        return None
    if name not in _DIGESTS:
        raise OwnClassError(f"{spec.origin} has the name of the imported package {file}: rename it")
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
    """Return the version of a class.

    What it has as `version`, or a hash of its file; empty if there is neither.
    """
    given = getattr(make, "version", None)
    return _digest(make.__module__) if given is None else str(given)


def _digest(module: str) -> str:
    """Return a hash of the file of an imported module; empty without one."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()[:12] if file else ""


def made(make: Callable[..., Any], methods: Sequence[str], *arguments: object) -> Any:
    """Return a new object of a class.

    Raises: OwnClassError: its constructor fails, or it lacks one of the methods.
    """
    with told("the constructor"):
        found = make(*arguments)
    for name in methods:
        if not callable(getattr(found, name, None)):
            raise OwnClassError(f"expected the methods {', '.join(methods)}, got no {name}")
    return found


def real_array(given: object) -> Array:
    """Return a copy of a real array, finite or not, that a method returned.

    Complex numbers and texts raise.
    """
    return np.array(given).astype(np.float64, casting="same_kind")


@contextmanager
def told(what: str) -> Iterator[None]:
    """Turn exceptions of a class into OwnClassError, with file and line.

    Its output goes to standard error.
    """
    try:
        with redirect_stdout(sys.stderr):
            yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())[:_LONGEST_TEXT]
        line = "".join(c if c.isprintable() else "?" for c in text)  # a message can hold it
        # Behind `told` and its caller: the code of the class, and what it calls.
        for frame in reversed(traceback.extract_tb(error.__traceback__)[2:]):
            if not re.match(r"<|.*site-packages", frame.filename) and frame.filename != __file__:
                line += f" ({Path(frame.filename).name}:{frame.lineno})"
                break
        raise OwnClassError(f"{what} raised {line}") from error
