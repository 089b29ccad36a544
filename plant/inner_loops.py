"""Inner loops, which make thrust and moments from commanded body rates: that of the model, or a firmware."""

import importlib
from typing import Protocol

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.parameters import System
from transport.plant.plant_run import PlantRun

# These start processes, so they are imported by runs with a firmware or autopilots only.
_FIRMWARE = "transport.plant.firmware.betaflight"
_AUTOPILOTS = "transport.plant.autopilot.autopilot_processes"
_BETAFLIGHTS = "transport.plant.autopilot.betaflight_over_msp"
# Longest time between two evaluations of an inner loop, s.
INNER_STEP_S = 1e-3


class InnerLoop(Protocol):
    """The inner loops of all UAVs, with their state.

    Evaluated in equal steps of at most `INNER_STEP_S`.
    """

    failure: str  # why the run ends, as an inner loop has failed; empty while all work

    def reset(self, x: Array) -> None:
        """Continue from a plant state, (12 + 12 N,), which may have jumped as a UAV failed."""

    def moments(self, command: Array, x: Array) -> Array:
        """Return thrust and moments of the motors until the next call, (N, 4), N and N m.

        command: thrust and body rates of each UAV, (N, 4), N and rad/s; x: plant state, (12 + 12 N,).
        """


class RateLoop:
    """The inner loop that the controllers predict with, sampled, with limits of the moments, (3,).

    Source: docs/equations.md (57).
    """

    failure = ""

    def __init__(self, system: System, limits_Nm: Array) -> None:
        self._inertia = np.array([uav.inertia for uav in system.uavs])
        self._gains = np.asarray(system.rate_gains)
        self._limits_Nm = limits_Nm

    def reset(self, x: Array) -> None:
        """Do nothing: this loop has no state."""

    def moments(self, command: Array, x: Array) -> Array:
        """Return thrust and moments for commanded body rates, (N, 4), N and N m."""
        omega = x[state.PAYLOAD :].reshape(-1, state.PER_UAV)[:, state.OMEGA]
        error = command[:, 1:] - omega

        # tau = J K (omega_cmd - omega) + omega x (J omega), limited: (57).
        momentum = _each(self._inertia, omega)
        tau = _each(self._inertia, self._gains * error) + _cross(omega, momentum)

        inputs = command.copy()
        inputs[:, 1:] = np.minimum(np.maximum(tau, -self._limits_Nm), self._limits_Nm)
        return inputs


def _each(matrices: Array, vectors: Array) -> Array:
    """Return M_i v_i for each UAV i, (N, 3)."""
    return np.asarray(np.matmul(matrices, vectors[:, :, None])[:, :, 0])


# For each axis the next one, and the one after that.
_NEXT = np.array([1, 2, 0])
_AFTER_NEXT = np.array([2, 0, 1])


def _cross(a: Array, b: Array) -> Array:
    """Return a_i x b_i for each UAV i, (N, 3).

    It takes a fifth of the time of numpy.cross for a few vectors.
    """
    forward = a.take(_NEXT, axis=1) * b.take(_AFTER_NEXT, axis=1)
    backward = a.take(_AFTER_NEXT, axis=1) * b.take(_NEXT, axis=1)
    return np.asarray(forward - backward)


def inner_loop(setup: PlantRun, step_s: float) -> InnerLoop | None:
    """Return the inner loop of a run, if any, called every `step_s`.

    Raises: ScenarioError: no firmware starts.
    """
    if setup.run.settings.inputs == "moments":
        return None
    if setup.section.inner_loop != "betaflight":
        return RateLoop(setup.run.system, np.array(setup.run.settings.limits.moments_Nm))
    firmware: InnerLoop = importlib.import_module(_FIRMWARE).Betaflight(setup, step_s)
    return firmware


def checked_firmware(setup: PlantRun) -> str:
    """Return name and version of the firmware of a run, or of its autopilots, if any.

    Raises: ScenarioError: it is not usable.
    """
    if setup.section.autopilot is not None:
        bank = _BETAFLIGHTS if setup.section.autopilot == "betaflight" else _AUTOPILOTS
        return str(importlib.import_module(bank).version(setup))
    if setup.section.inner_loop != "betaflight":
        return ""
    return str(importlib.import_module(_FIRMWARE).version(setup))
