"""Inner loops of the UAVs: they make thrust and moments from commanded body rates, between schedule and motors."""

import importlib
from typing import Protocol

import numpy as np

from model.arrays import Array
from model.parameters import System
from model.state import OMEGA, PAYLOAD, PER_UAV
from protocol.scenario.setup import Setup

# Starts processes, so it is imported by runs with a firmware only.
_FIRMWARE = "plant.firmware.betaflight"
# Longest time between two evaluations of an inner loop, s.
INNER_STEP_S = 1e-3


class InnerLoop(Protocol):
    """The inner loops of all UAVs, with their state; evaluated in equal steps of at most `INNER_STEP_S`."""

    failure: str
    """Why the run ends, as an inner loop has failed; empty while all work."""

    def reset(self, x: Array, u: Array) -> None:
        """Continue from a plant state, (12 + 12 N,), and the commands in force, (4 N,).

        Called at the beginning of a run and after the failure of a UAV, whose state may then jump.
        """

    def moments(self, time_s: float, command: Array, x: Array) -> Array:
        """Return the inputs of the motors until the next call, (N, 4), N and N m.

        Given are the scenario time, which grows from call to call, thrust and body rates of each UAV, (N, 4), N and
        rad/s, and the plant state at that time, (12 + 12 N,), without noise.
        """


class RateLoop:
    """The inner loop that the controllers predict with, in discrete time and within limits of the moments, (3,).

    Source: docs/equations.md (57).
    """

    failure = ""

    def __init__(self, system: System, limits_Nm: Array) -> None:
        self._inertia = np.array([uav.inertia for uav in system.uavs])
        self._gains, self._limits_Nm = np.asarray(system.rate_gains), limits_Nm

    def reset(self, x: Array, u: Array) -> None:
        """Do nothing: this loop has no state."""

    def moments(self, time_s: float, command: Array, x: Array) -> Array:  # noqa: ARG002
        """Return thrust and moments for commanded body rates, (N, 4), N and N m."""
        omega, inputs = x[PAYLOAD:].reshape(-1, PER_UAV)[:, OMEGA], command.copy()
        momentum = _times(self._inertia, omega)
        wanted = _times(self._inertia, self._gains * (command[:, 1:] - omega))
        # The cross product, at a fifth of the time that numpy.cross takes for a few vectors.
        wanted += omega[:, _NEXT] * momentum[:, _LAST] - omega[:, _LAST] * momentum[:, _NEXT]
        inputs[:, 1:] = np.minimum(np.maximum(wanted, -self._limits_Nm), self._limits_Nm)
        return inputs


_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def _times(matrices: Array, vectors: Array) -> Array:
    """Return the product of each matrix with its vector, (N, 3)."""
    return np.asarray(np.matmul(matrices, vectors[:, :, None])[:, :, 0])


def inner_loop(setup: Setup, step_s: float) -> InnerLoop | None:
    """Return the inner loop of a run, called every `step_s`; None where agents command moments.

    Raises: ScenarioError: a firmware cannot be started.
    """
    if setup.settings.inputs == "moments":
        return None
    if setup.scenario.plant.inner_loop == "betaflight":
        firmware: InnerLoop = importlib.import_module(_FIRMWARE).Betaflight(setup, step_s)
        return firmware
    return RateLoop(setup.system, np.array(setup.settings.limits.moments_Nm))


def checked_firmware(setup: Setup) -> str:
    """Return name and version of the firmware of a run; empty where the inner loop is none.

    Raises: ScenarioError: it is not installed, or there is no compiler.
    """
    if setup.scenario.plant.inner_loop != "betaflight":
        return ""
    version: str = importlib.import_module(_FIRMWARE).version(setup)
    return version
