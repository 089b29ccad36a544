"""The engine that a scenario names: found, built, and checked in all it returns."""

import hashlib
import importlib
import math
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from model.arrays import Array
from model.parameters import System
from model.state import StateView
from plant.environment import Environment
from plant.inner_loop import checked_firmware
from plant.physics import EngineClass, Physics
from plant.rods import Rods
from protocol.scenario.errors import ScenarioError
from protocol.scenario.setup import Setup

# How far the state that an engine reads out after `reset` may be from the given one, SI.
_SAME_STATE = 1e-6
# How far the length of a rod direction may be from 1: beyond rounding, below any error of a real rod.
_UNIT = 1e-3
_METHODS = ("reset", "advance", "state")
UNKNOWN_ERROR = -1.0
# Hashes of the files of imported engines.
_DIGESTS: dict[str, str] = {}
# Longest text of an error that is passed on, characters: it travels in messages, with the name of the engine.
_LONGEST_TEXT = 400


_is_called = ContextVar("_is_called", default=False)  # whether the code of an engine runs, in this thread
_hooks: list[str] = []  # the audit events that are refused, once the hook is installed


class EngineError(ValueError):
    """An engine that cannot be used, or that has failed; one line."""


class Engine:
    """The engine of a plant. An engine that fails is data: `failure` says why the run ends.

    Args:
        setup: The run.
        system: Actual parameters of the bodies.
    Raises: ScenarioError: no such engine, a package is missing, or it does not take the initial state.
    """

    def __init__(self, setup: Setup, system: System) -> None:
        self.name = setup.scenario.plant.engine
        self.failure = ""
        self._section = setup.scenario.plant
        self._shape = setup.hover.x.shape
        try:
            self._make = _engine_class(self.name)
            self._physics = self._built(system, setup.initial_state())
            self._x = self._read()
        except EngineError as error:
            raise ScenarioError(setup.scenario.name, "plant.engine", str(error)) from error

    def warm_up(self, setup: Setup) -> None:
        """Integrate a period and go back to the initial state: the first period may compile what others use."""
        self.advance(setup.hover.u, None, setup.settings.sampling_period_s)
        self.reset(setup.initial_state())

    def replace(self, system: System, x: Array) -> None:
        """Continue from a state, (n,), with other bodies."""
        self._x = x
        with self._failing():
            self._physics = self._built(system, x)

    def reset(self, x: Array) -> None:
        """Continue from a state, (n,)."""
        self._x = x
        with self._failing():
            self._reset(self._physics, x)

    def advance(self, u: Array, forces: Array | None, duration_s: float) -> tuple[Array, float]:
        """Integrate an interval under held inputs, (4 N,), and forces, (3 + 3 N,), or none.

        Returns: State at its end, (n,), the last one if the engine has failed; the local error, -1 if it is unknown.
        """
        error = UNKNOWN_ERROR
        if not self.failure:
            with self._failing():
                with _told("advance"):
                    estimate = self._physics.advance(u, forces, duration_s)
                    error = error if estimate is None or not math.isfinite(estimate) else float(estimate)
                self._x = self._read()
        return self._x, error

    def _built(self, system: System, x: Array) -> Physics:
        """Return a new engine at a state."""
        with _told("the constructor"):
            physics = self._make(system, self._section)
        missing = [name for name in _METHODS if not callable(getattr(physics, name, None))]
        if missing:
            raise EngineError(f"expected the methods {', '.join(_METHODS)}, got no {missing[0]}")
        self._reset(physics, x)
        return physics

    def _reset(self, physics: Physics, x: Array) -> None:
        with _told("reset"):
            physics.reset(x.copy())
        found = _state_of(physics, self._shape)
        furthest = int(np.argmax(np.abs(found - x)))
        if not abs(found[furthest] - x[furthest]) <= _SAME_STATE:
            raise EngineError(
                f"state: expected the state given to reset, got {found[furthest]:g} instead of {x[furthest]:g} "
                f"at index {furthest}"
            )

    def _read(self) -> Array:
        found = _state_of(self._physics, self._shape)
        lengths = np.linalg.norm(StateView(found).e_P, axis=1)
        wrong = np.flatnonzero(np.abs(lengths - 1.0) > _UNIT)
        if len(wrong) and np.isfinite(found).all():
            expected = f"expected a unit vector as rod direction of UAV{wrong[0] + 1}"
            raise EngineError(f"state: {expected}, got length {lengths[wrong[0]]:g}")
        return found

    @contextmanager
    def _failing(self) -> Iterator[None]:
        """Keep the text of a failure; the first one counts."""
        try:
            yield
        except EngineError as error:
            self.failure = self.failure or f"engine {self.name}: {error}"


def checked_engine(setup: Setup) -> str:
    """Return name and version of the engine of a run after building it once, as the plant will, and of a firmware.

    Raises: ScenarioError: no such engine, a package is missing, or it does not take the initial state.
    """
    firmware = checked_firmware(setup)
    engine = Engine(setup, Environment(setup).system)
    return f"{engine.name} {engine_version(engine.name)}".rstrip() + (f", {firmware}" if firmware else "")


def engine_version(name: str) -> str:
    """Return the version of an engine: of its package, or what its class has as `version`, or a hash of its file.

    Raises: EngineError: it is not found.
    """
    make = _engine_class(name)
    given = getattr(make, "version", None)
    if given is not None:
        return str(given)
    file = getattr(sys.modules.get(make.__module__), "__file__", None)
    return _digest(Path(file)) if file else ""


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()[:12]


def _engine_class(name: str) -> EngineClass:
    """Return the class of an engine, or another callable that makes one.

    Raises: EngineError: it is not found.
    """
    if name == "rods":
        return Rods
    if name == "mujoco":
        if find_spec("mujoco") is None:
            raise EngineError("expected the package mujoco, got none; pip install 'payload-transport[mujoco]'")
        engine: EngineClass = importlib.import_module("plant.mujoco_engine").MujocoEngine
        return engine
    return _own_class(name)


def _refuse_forks() -> None:
    """Refuse forks by the code of an engine in this process: a copy would go on as this process."""

    def refuse(event: str, _: object) -> None:
        if event in _hooks and _is_called.get():
            raise RuntimeError("an engine must not fork its process; use subprocess, or the start method 'spawn'")

    if not _hooks:
        _hooks.extend(("os.fork", "os.forkpty"))
        sys.addaudithook(refuse)  # for ever


def _own_class(name: str) -> EngineClass:
    """Return the user's class "package.module:Class", which may lie in the current folder.

    The folder is on the path during this import only, and last: a file there hides no package.
    """
    _refuse_forks()
    module_name, _, attribute = name.partition(":")
    folder = str(Path.cwd())
    sys.path.append(folder)
    importlib.invalidate_caches()  # the file may be newer than this process
    try:
        with _told("its import"):
            module = _newest(importlib.import_module(module_name))
    except EngineError as error:
        missing = error.__cause__.name if isinstance(error.__cause__, ModuleNotFoundError) else None
        if missing is not None and f"{module_name}.".startswith(f"{missing}."):
            expected = f"expected a module {missing!r} in {folder} or among the installed packages"
            raise EngineError(f"{expected}, got none") from error
        raise
    finally:
        del sys.path[len(sys.path) - 1 - sys.path[::-1].index(folder)]
    found: Any = getattr(module, attribute, None)
    if not callable(found):
        where = getattr(module, "__file__", None) or module_name
        raise EngineError(f"expected a class {attribute!r} in {where}, got {_kind(found)}")
    make: Callable[..., Physics] = found
    return make


def _newest(module: ModuleType) -> ModuleType:
    """Import a module again if its file has changed since: the recorded version must be that of the code that runs."""
    file = getattr(module, "__file__", None)
    if file is None or not Path(file).is_file() or module.__name__ == "__main__":
        return module
    digest = _digest(Path(file))
    if _DIGESTS.setdefault(file, digest) != digest:
        module = importlib.reload(module)
        _DIGESTS[file] = digest
    return module


def _kind(found: object) -> str:
    return "none" if found is None else f"an object of type {type(found).__name__}"


def _state_of(physics: Physics, shape: tuple[int, ...]) -> Array:
    """Return a copy of the state of an engine, of the given shape; it need not be finite."""
    with _told("state"):
        given = np.asarray(physics.state())
        if np.iscomplexobj(given):
            raise EngineError(f"state: expected real numbers, got {given.dtype}")
        found = np.array(given, dtype=np.float64)
    if found.shape != shape:
        raise EngineError(f"state: expected shape {shape}, got {found.shape}")
    return found


@contextmanager
def _told(what: str) -> Iterator[None]:
    """Turn any exception of the code of an engine into one line: what was called, the error, file and line.

    Its output goes to standard error: results are on standard output.
    """
    _is_called.set(True)
    try:
        with redirect_stdout(sys.stderr):
            yield
    except (EngineError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise EngineError(f"{what} raised {_line(error)}{_place(error)}") from error
    finally:
        _is_called.set(False)


def _line(error: BaseException) -> str:
    """Return type and text of an exception as a line of printable characters that a message can hold."""
    text = " ".join(f"{type(error).__name__}: {error}".splitlines())
    shown = text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}..."
    return "".join(c if c.isprintable() else "?" for c in shown)


def _place(error: BaseException) -> str:
    """Return file and line of the engine's own code where an exception came from; empty if that is elsewhere."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if frame.filename != __file__ and "site-packages" not in frame.filename and not frame.filename.startswith("<"):
            return f" ({Path(frame.filename).name}:{frame.lineno})"
    return ""
