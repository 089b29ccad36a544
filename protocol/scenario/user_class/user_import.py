"""Classes of the user that a scenario names, an engine or a controller: import and version."""

import hashlib
import importlib
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from pydantic import AfterValidator

from transport.protocol.scenario.user_class.user_errors import OwnClassError, errors_of, printable

_MAIN = "__main__"  # module of a script or notebook, which is no file to be imported again

_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")


def or_class(*names: str) -> AfterValidator:
    """Return a check that texts are one of some names or have the form "package.module:Class"."""

    def check(value: str | list[str]) -> str | list[str]:
        for text in [value] if isinstance(value, str) else value:
            if text not in names and not _NAME.fullmatch(text):
                ready = ", ".join(map(repr, names))
                raise ValueError(f"expected {ready} or 'package.module:Class', got {text!r}")
        return value

    return AfterValidator(check)


def own_class(name: str) -> Any:
    """Return the user's class "package.module:Class", of the current folder or installed packages.

    The current folder comes first, for this module alone: a file there named like an installed
    package hides that package from no other import. As in all of Python a module is imported once.
    Raises: OwnClassError: it is not found, or its import fails.
    """
    module_name, _, attribute = name.partition(":")
    folder = Path.cwd()
    with errors_of(f"its import from {folder} or the installed packages"), _on_path(folder):
        if module_name != _MAIN:
            _import_from(folder, module_name.partition(".")[0])
        module = importlib.import_module(module_name)
        _digest_of(module)  # that of the code that runs, should the file change later
        return getattr(module, attribute)


@contextmanager
def _on_path(folder: Path) -> Iterator[None]:
    """Search a folder last, so that modules beside the user's file can be imported by it."""
    place = str(folder)
    sys.path.append(place)
    try:
        yield
    finally:
        last = len(sys.path) - 1 - sys.path[::-1].index(place)
        del sys.path[last]


def _import_from(folder: Path, package: str) -> None:
    """Import a package of a folder unless it is imported, or not there.

    Raises: OwnClassError: another package of this name is imported.
    """
    importlib.invalidate_caches()  # the file may be newer than this process
    spec = PathFinder.find_spec(package, [str(folder)])
    if spec is None or spec.loader is None:
        return

    imported = sys.modules.get(package)
    if imported is not None:
        file = getattr(imported, "__file__", None)
        if file != spec.origin:
            problem = f"{spec.origin} has the name of the imported package {file}"
            raise OwnClassError(f"{problem}: rename it, or restart Python")
        return

    module = module_from_spec(spec)
    sys.modules[package] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[package]
        raise


def version_of(make: Any) -> str:
    """Return the version of a class: its attribute `version`, else a hash of its file at import.

    Empty if there is neither. Raises: OwnClassError: the attribute is no text.
    """
    with errors_of("its version"):
        given = getattr(make, "version", None)
        if given is not None:
            return printable(str(given))
        return _digest_of(sys.modules.get(make.__module__))


@cache
def _digest_of(module: ModuleType | None) -> str:
    """Return a hash of the file of a module when first asked; empty if it has none."""
    file = getattr(module, "__file__", None)
    try:
        return hashlib.sha256(Path(file).read_bytes()).hexdigest()[:12] if file else ""
    except OSError:
        return ""
