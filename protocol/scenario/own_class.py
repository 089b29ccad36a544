"""Classes of the user that a scenario names, an engine or a controller: import and version."""

import hashlib
import importlib
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from typing import Any

from pydantic import AfterValidator

from transport.protocol.scenario.own_calls import OwnClassError, errors_of, is_foreign, printable

_MAIN = "__main__"  # module of a script or notebook, which is no file to be imported again
_PROGRAM = "transport"  # package of the program

_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Imported:
    """A file of the user as it was imported."""

    file: Path
    digest: str


# The user's modules, by name: those of named classes, and what these import from their folder.
_OWN_MODULES: dict[str, _Imported] = {}


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
    package hides that package from no other import. Where a file of the user has changed, all are
    imported again, since the recorded version must be that of the code that runs.
    Raises: OwnClassError: it is not found, or its import fails.
    """
    module_name, _, attribute = name.partition(":")
    package = module_name.partition(".")[0]
    folder = Path.cwd()
    spec = None
    if module_name != _MAIN:
        _forget_changed()
        spec = _spec_to_import(folder, package)

    before = set(sys.modules)
    with errors_of(f"its import from {folder} or the installed packages"), _on_path(folder):
        try:
            if spec is not None:
                _execute(spec)
            module = importlib.import_module(module_name)
        finally:
            _note_own(module_name, before, folder)
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


def _spec_to_import(folder: Path, package: str) -> ModuleSpec | None:
    """Return the specification of a package in a folder; None if it is imported or not there.

    Modules that the user has in other folders are forgotten: some may have the names of those here.
    Raises: OwnClassError: another package of this name, which is not the user's, is imported.
    """
    importlib.invalidate_caches()  # the file may be newer than this process
    spec = PathFinder.find_spec(package, [str(folder)])
    if spec is None or spec.loader is None:
        return None

    for name, own in list(_OWN_MODULES.items()):
        if not own.file.is_relative_to(folder):
            _forget(name)

    imported = sys.modules.get(package)
    if imported is None:
        return spec
    file = getattr(imported, "__file__", None)
    if file == spec.origin:
        return None
    problem = f"{spec.origin} has the name of the imported package {file}"
    raise OwnClassError(f"{problem}: rename it")


def _execute(spec: ModuleSpec) -> None:
    """Import a package as found."""
    module = module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)  # type: ignore[union-attr]
    except BaseException:
        del sys.modules[spec.name]
        raise


def _note_own(module_name: str, before: set[str], folder: Path) -> None:
    """Note the files of a named module, and of those of its folder that it has imported.

    Installed packages are not the user's: many cannot be imported a second time.
    """
    for name in (sys.modules.keys() - before) | {module_name}:
        file = getattr(sys.modules.get(name), "__file__", None)
        is_of_program = name == _MAIN or _is_within(_PROGRAM, name)
        if not file or is_foreign(file) or is_of_program or name in _OWN_MODULES:
            continue
        if Path(file).is_relative_to(folder) or name == module_name:
            _OWN_MODULES[name] = _Imported(file=Path(file), digest=_digest(Path(file)))


def _forget_changed() -> None:
    """Forget all modules of the user if a file of theirs has changed since it was imported.

    All of them, as others may have imported from it.
    """
    if any(_digest(own.file) != own.digest for own in _OWN_MODULES.values()):
        for name in list(_OWN_MODULES):
            _forget(name)


def _forget(name: str) -> None:
    """Forget a module of the user, so that it is imported anew."""
    sys.modules.pop(name, None)
    del _OWN_MODULES[name]


def _is_within(package: str, module: str) -> bool:
    """Return whether a module is a package or one of its parts."""
    return module == package or module.startswith(f"{package}.")


def version_of(make: Any) -> str:
    """Return the version of a class: its attribute `version`, else a hash of its file.

    Empty if there is neither. Raises: OwnClassError: the attribute is no text.
    """
    with errors_of("its version"):
        given = getattr(make, "version", None)
        if given is not None:
            return printable(str(given))
        file = getattr(sys.modules.get(make.__module__), "__file__", None)
    return _digest(Path(file)) if file else ""


def _digest(file: Path) -> str:
    """Return a hash of a file; empty if it cannot be read."""
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()[:12]
    except OSError:
        return ""
