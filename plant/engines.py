"""Engines of the plant: their interface, rods, and the checks of one that a scenario names."""

import importlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np

from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.parameters import System
from transport.model.state import StateView
from transport.plant.actual_bodies import about
from transport.plant.inner_loops import checked_firmware
from transport.plant.plant_run import PlantRun
from transport.plant.wind_and_noise import Environment
from transport.protocol.scenario.sections.plant_sections import PlantSection
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.user_class.user_errors import (
    OwnClassError,
    errors_of,
    new_object,
    real_array,
)
from transport.protocol.scenario.user_class.user_import import own_class, version_of

# An interval of a whole number of steps, but for rounding, takes that number.
_ROUNDING = 1e-9


class Rods:
    """Massless rigid rods, no ground; steps are halved where their local error is large.

    Source: docs/equations.md (4)-(13).
    """

    version = metadata.version("payload-transport")

    def __init__(self, system: System, section: PlantSection) -> None:
        self._model = Model(system)
        self._step_s = section.step_s
        self._tolerance = section.tolerance
        self._x: Array = np.zeros(system.n)  # until `reset`

    def reset(self, x: Array) -> None:
        """Continue from a state, (n,)."""
        self._x = x

    def advance(self, u: Array, forces: Array | None, duration_s: float) -> float:
        """Integrate an interval under held inputs, (4 N,), and forces, (3 + 3 N,).

        Return the local error estimate.
        """
        steps = math.ceil(duration_s / self._step_s - _ROUNDING)
        self._x, error = self._model.integrate(
            self._x, u, duration_s, steps, forces=forces, tolerance=self._tolerance
        )
        return error

    def state(self) -> Array:
        """Return the present state, (n,)."""
        return self._x


class Physics(Protocol):
    """Integration of the ground truth in the layout and the signs of `model.state`, SI.

    An engine is made of the plant's actual `System` and its section of the scenario. Its bodies have
    mass, inertia and drag against their own velocities; the plant adds wind, noise and failures. The
    run records the engine's `version`, or a hash of its file if it has none. An engine with cables
    has `tensions`, the least tension of each in the last interval, (N,), N. A run ends with the text
    of any exception.
    """

    def reset(self, x: Array) -> None:
        """Continue from a state, (12 + 12 N,).

        Called before the first interval and after the failure of a UAV.
        """

    def advance(self, u: Array, forces: Array | None, duration_s: float) -> float | None:
        """Integrate a sampling period or a part of one.

        Args:
            u: Held thrust and moments of each UAV, (4 N,), N and N m, in its body frame; a thrust is
                >= 0 and acts along -b3.
            forces: Held external forces on the centres of mass of payload and UAVs, (3 + 3 N,),
                inertial frame, N, or None.
            duration_s: Length of the interval.

        Returns: The largest local error of a component, if known.
        """

    def state(self) -> Array:
        """Return the present state, (12 + 12 N,), with |e_i| = 1 and e_i . Omega_i = 0."""


# Largest difference of the state that an engine reads out after `reset` from the given one, SI.
_SAME_STATE = 1e-6
# Largest deviation of the length of a rod direction from 1: beyond rounding, below any error of a
# real rod.
_LENGTH_ERROR = 1e-3
UNKNOWN_ERROR = -1.0


class Engine:
    """The engine of a plant with the actual bodies.

    Its failure is data: `failure` says why the run ends.

    Attributes:
        failure: Why the engine has failed; "" if it has not.
        tensions: Least tension of each cable in the last interval, (N,), N; (0,) without cables.

    Raises: ScenarioError: no such engine, or it does not take the initial state.
    """

    def __init__(self, setup: PlantRun, system: System) -> None:
        self.failure = ""
        self.tensions: Array = np.zeros(0)
        self._section = setup.section
        # About the actual centre of the payload; states from and to outside are about the assumed one.
        self._x: Array = about(setup.run.initial_state(), system.payload.centre)
        try:
            self._make = _engine_class(self._section.engine)
            self._build(system)
        except OwnClassError as error:
            raise ScenarioError(setup.run.rules.name, "plant.engine", str(error)) from error

    def warm_up(self, setup: PlantRun) -> None:
        """Integrate a period and go back to the initial state.

        The first period may compile what others use.
        """
        self.advance(setup.run.hover.u, None, setup.run.settings.sampling_period_s)
        self.restart(setup.run.initial_state(), self._system)

    def restart(self, x: Array, system: System) -> None:
        """Continue from a state about the assumed centre, (n,); with other bodies by a new object."""
        self._x = about(x, system.payload.centre)
        with self._failing():
            if system is self._system:
                self._reset()
            else:
                self._build(system)

    def advance(self, u: Array, forces: Array | None, duration_s: float) -> tuple[Array, float]:
        """Integrate an interval under held inputs, (4 N,), and forces, (3 + 3 N,), or none.

        Returns: State at its end, (n,), the last one if the engine has failed; the local error, -1
            if it is unknown.
        """
        # Our own engine: reading and checking its state would take longer than its steps, and it
        # cannot fail.
        if type(self._physics) is Rods:
            error = self._physics.advance(u, forces, duration_s)
            self._x = self._physics.state()
            known_error = error if math.isfinite(error) else UNKNOWN_ERROR
            return self._told(), known_error

        error = UNKNOWN_ERROR
        if self.failure:
            return self._told(), error
        with self._failing():
            # Copies: the arrays are the plant's record, and an engine may work in place.
            own_forces = None if forces is None else forces.copy()
            with errors_of("advance"):
                told_error = self._physics.advance(u.copy(), own_forces, duration_s)
                if told_error is not None and math.isfinite(told_error):
                    error = float(told_error)
            self._x = self._read()
            self.tensions = self._read_tensions()
        return self._told(), error

    def _told(self) -> Array:
        """Return the state of the point of the payload that the controllers take for its centre of mass."""
        return about(self._x, -self._system.payload.centre)

    def _build(self, system: System) -> None:
        """Make the engine of some bodies and give it the state. Raises: OwnClassError."""
        self._system = system
        methods = ("reset", "advance", "state")
        self._physics: Physics = new_object(self._make, methods, system, self._section)
        self._reset()

    def _reset(self) -> None:
        """Give the engine the state, and check that it takes it. Raises: OwnClassError."""
        x = self._x
        with errors_of("reset"):
            self._physics.reset(x.copy())

        taken = self._read()
        differences = np.abs(taken - x)
        furthest = int(np.argmax(differences))  # the place of a NaN if there is one
        is_taken = differences[furthest] <= _SAME_STATE  # false for NaN
        if not is_taken:
            got = f"{taken[furthest]:g} instead of {x[furthest]:g} at index {furthest}"
            raise OwnClassError(f"state: expected the state given to reset, got {got}")

    def _read(self) -> Array:
        """Return a copy of the engine's state; it need not be finite. Raises: OwnClassError."""
        with errors_of("state"):
            x = real_array(self._physics.state())
        if x.shape != self._x.shape:
            raise OwnClassError(f"state: expected shape {self._x.shape}, got {x.shape}")

        lengths = np.linalg.norm(StateView(x).e_P, axis=1)
        wrong = np.flatnonzero(np.abs(lengths - 1.0) > _LENGTH_ERROR)
        if len(wrong) and np.isfinite(x).all():
            expected = f"expected a unit vector as rod direction of UAV{wrong[0] + 1}"
            raise OwnClassError(f"state: {expected}, got length {lengths[wrong[0]]:g}")
        return x

    def _read_tensions(self) -> Array:
        """Return the tensions of the engine's cables.

        They need not be finite once its state is not.

        Raises: OwnClassError: a wrong shape, or not finite.
        """
        with errors_of("tensions"):
            tensions = real_array(getattr(self._physics, "tensions", ()))
        cables = (self._system.N,)
        has_cables = len(self.tensions) > 0
        allowed = [cables] if has_cables else [(0,), cables]
        if tensions.shape not in allowed:
            expected = " or ".join(map(str, allowed))
            raise OwnClassError(f"tensions: expected shape {expected}, got {tensions.shape}")

        wrong = np.flatnonzero(~np.isfinite(tensions))
        if len(wrong) and np.isfinite(self._x).all():
            expected = f"expected a finite number for the cable of UAV{wrong[0] + 1}"
            raise OwnClassError(f"tensions: {expected}, got {tensions[wrong[0]]:g}")
        return tensions

    @contextmanager
    def _failing(self) -> Iterator[None]:
        """Keep the text of a failure; the first one counts."""
        try:
            yield
        except OwnClassError as error:
            self.failure = self.failure or f"engine {self._section.engine}: {error}"


def checked_engine(setup: PlantRun) -> str:
    """Return name and version of the engine of a run, and of a firmware if there is one.

    Builds the engine once, as the plant will.

    Raises: ScenarioError: no such engine or firmware, or it does not take the initial state.
    """
    firmware = checked_firmware(setup)
    name = setup.section.engine
    Engine(setup, Environment(setup).system)
    try:
        engine = f"{name} {engine_version(name)}".rstrip()
    except OwnClassError as error:
        raise ScenarioError(setup.run.rules.name, "plant.engine", str(error)) from error
    return f"{engine}, {firmware}" if firmware else engine


def engine_version(name: str) -> str:
    """Return the version of an engine, or a hash of its file.

    Raises: OwnClassError: it is not found, or its version is no text.
    """
    return version_of(_engine_class(name))


def _engine_class(name: str) -> Any:
    """Return the class of an engine, or another callable that makes one.

    Raises: OwnClassError: it is not found.
    """
    if name == "rods":
        return Rods
    if name != "mujoco":
        return own_class(name)
    if find_spec("mujoco") is None:
        remedy = "pip install 'payload-transport[mujoco]'"
        raise OwnClassError(f"expected the package mujoco, got none; {remedy}")
    return importlib.import_module("transport.plant.mujoco_engine").MujocoEngine
