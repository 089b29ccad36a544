"""The engine "rods": the equations of motion that the controllers predict with, with the plant's masses."""

import math
from importlib import metadata

import numpy as np

from model.arrays import Array
from model.linearisation import Model
from model.parameters import System
from protocol.scenario.plant_sections import PlantSection


class Rods:
    """Massless rigid rods, no ground; steps of at most `plant.step_s`, halved where their local error is large.

    Source: docs/equations.md (4)-(13).
    """

    version = metadata.version("payload-transport")

    def __init__(self, system: System, section: PlantSection) -> None:
        self._model = Model(system)
        self._step_s, self._tolerance = section.step_s, section.tolerance
        self._x: Array = np.zeros(system.n)  # until `reset`

    def reset(self, x: Array) -> None:
        """Continue from a state, (n,)."""
        self._x = x

    def advance(self, u: Array, forces: Array | None, duration_s: float) -> float:
        """Integrate an interval under held inputs, (4 N,), and forces, (3 + 3 N,); return the local error estimate."""
        steps = math.ceil(duration_s / self._step_s - 1e-9)
        self._x, error = self._model.integrate(self._x, u, duration_s, steps, forces=forces, tolerance=self._tolerance)
        return error

    def state(self) -> Array:
        """Return the present state, (n,)."""
        return self._x
