"""Classes of the user that a scenario names, engine or controller: found, made, called, and recorded with a version."""

import hashlib
import importlib
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import AfterValidator

from model.arrays import Array

# Longest text of an error that is passed on, characters: it travels in messages, with the name of the class.
_LONGEST_TEXT = 400
_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")
# Hashes of the files of imported modules, as they were imported.
_DIGESTS: dict[str, str] = {}


class OwnClassError(ValueError):
    """A class of the user that cannot be used, or that has failed; one line."""


def or_class(*names: str) -> AfterValidator:
    """Return a check that a text is one of some names or has the form "package.module:Class"."""

    def check(value: str) -> str:
        if value not in names and not _NAME.fullmatch(value):
            raise ValueError(f"expected {', '.join(map(repr, names))} or 'package.module:Class', got {value!r}")
        return value

    return AfterValidator(check)


def own_class(name: str) -> Any:
    """Return the user's class "package.module:Class", which may lie in the current folder: that hides no package.

    A module whose file has changed is imported again: the recorded version must be that of the code that runs.

    Raises: OwnClassError: it is not found, or its import fails.
    """
    module_name, _, attribute = name.partition(":")
    folder = str(Path.cwd())
    sys.path.append(folder)
    importlib.invalidate_caches()  # the file may be newer than this process
    try:
        with told("its import"):
            module = importlib.import_module(module_name)
            digest = _digest(module_name)
            if _DIGESTS.setdefault(module_name, digest) != digest and module_name != "__main__":
                module = importlib.reload(module)
                _DIGESTS[module_name] = digest
    except OwnClassError as error:
        missing = error.__cause__.name if isinstance(error.__cause__, ModuleNotFoundError) else None
        if missing is not None and f"{module_name}.".startswith(f"{missing}."):
            expected = f"expected a module {missing!r} in {folder} or among the installed packages"
            raise OwnClassError(f"{expected}, got none") from error
        raise
    finally:
        del sys.path[len(sys.path) - 1 - sys.path[::-1].index(folder)]
    found = getattr(module, attribute, None)
    if not callable(found):
        where = getattr(module, "__file__", None) or module_name
        raise OwnClassError(f"expected a class {attribute!r} in {where}, got {type(found).__name__}")
    return found


def version_of(make: Any) -> str:
    """Return the version of a class: what it has as `version`, or a hash of its file; empty if there is neither."""
    given = getattr(make, "version", None)
    return _digest(make.__module__) if given is None else str(given)


def _digest(module: str) -> str:
    """Return a hash of the file of an imported module; empty without one."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()[:12] if file else ""


def made(make: Callable[..., Any], methods: Sequence[str], *arguments: object) -> Any:
    """Return a new object of a class. Raises: OwnClassError: its constructor fails, or it lacks one of the methods."""
    with told("the constructor"):
        found = make(*arguments)
    for name in methods:
        if not callable(getattr(found, name, None)):
            raise OwnClassError(f"expected the methods {', '.join(methods)}, got no {name}")
    return found


def real_array(what: str, given: object) -> Array:
    """Return a copy of a real array, finite or not, that a method returned, within `told`. Raises: OwnClassError."""
    found = np.asarray(given)
    if np.iscomplexobj(found):
        raise OwnClassError(f"{what}: expected real numbers, got {found.dtype}")
    return np.array(found, dtype=np.float64)


@contextmanager
def told(what: str) -> Iterator[None]:
    """Turn any exception of the code of a class into an OwnClassError: what was called, the error, file and line.

    Its output goes to standard error: results are on standard output.
    """
    try:
        with redirect_stdout(sys.stderr):
            yield
    except (OwnClassError, KeyboardInterrupt):
        raise
    except BaseException as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())
        text = text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}..."
        line = "".join(c if c.isprintable() else "?" for c in text)  # a message can hold it
        raise OwnClassError(f"{what} raised {line}{_place(error)}") from error


def _place(error: BaseException) -> str:
    """Return file and line of the class's own code where an exception came from; empty if that is elsewhere."""
    frames = traceback.extract_tb(error.__traceback__)
    others = {frame.filename for frame in frames[:2]}  # `told`, and the function that calls the class within it
    for frame in reversed(frames):
        if frame.filename not in others and not re.match(r"<|.*site-packages", frame.filename):
            return f" ({Path(frame.filename).name}:{frame.lineno})"
    return ""
