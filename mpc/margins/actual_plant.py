"""The actual plant about hover, which differs from the controllers' model, over a sampling period."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.discretisation import Discrete, zero_order_hold
from transport.model.linear.linearisation import Linearisation, Model
from transport.model.physics.hover import hover
from transport.model.physics.parameters import System

# Size of F times the duration up to which a hold is computed at once; sizes below the other one are zero.
_LARGEST, _SMALL = 256.0, 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class Mismatch:
    """Differences between the plant and the controllers' model.

    Fields whose names end in `_s` are times, which begin at 0, the others factors of known values:
    margins are searched accordingly.
    """

    lag_s: float = 0.0  # time constant of the plant's motors, s
    delay_s: float = 0.0  # between command and motors, s
    # The same of the last UAV alone, s; of the others it is less in equal steps, 1/N of it of the first.
    spread_s: float = 0.0
    gain: float = 1.0  # actual inputs over commanded inputs
    uav_inertia: float = 1.0  # actual value over the known one, as all that follow
    uav_mass: float = 1.0
    payload_mass: float = 1.0
    payload_inertia: float = 1.0
    rod_length: float = 1.0

    def system(self, known: System) -> System:
        """Return the actual bodies."""
        uavs = []
        for uav in known.uavs:
            uavs.append(
                replace(
                    uav,
                    mass=uav.mass * self.uav_mass,
                    inertia=uav.inertia * self.uav_inertia,
                    rod_length=uav.rod_length * self.rod_length,
                )
            )
        payload = replace(
            known.payload,
            mass=known.payload.mass * self.payload_mass,
            inertia=known.payload.inertia * self.payload_inertia,
        )
        return System(payload=payload, uavs=uavs, gravity=known.gravity)


@dataclass(frozen=True, slots=True, kw_only=True)
class DelayedStep:
    """Step of the plant over a sampling period in which delayed commands arrive.

    It is in parts, each from one arrival to the next.
    """

    parts: tuple[Discrete, ...]
    # Of each part and each UAV, how many periods ago the command came that acts.
    ages: tuple[tuple[int, ...], ...]

    @property
    def size(self) -> int:
        """Number of states of the plant, with the actual inputs of its motors."""
        return len(self.parts[0].A)

    @property
    def late(self) -> int:
        """Largest number of whole periods of a delay."""
        return max(self.ages[-1])

    def moved(self, motion: Array, acting: Sequence[Array]) -> Array:
        """Return the motion one period later.

        Args:
            motion: Motion of the plant, (size, k).
            acting: Commands that are in force without delay, now and before, newest first, (m, k).
        """
        for part, ages in zip(self.parts, self.ages, strict=True):
            command = np.vstack(
                [acting[age][state.input_slice(uav)] for uav, age in enumerate(ages)]
            )
            motion = part.A @ motion + part.B @ command
        return motion


def delayed_step(system: System, T: Array, plant: Mismatch, period_s: float) -> DelayedStep:
    """Return the plant's step over a period, in coordinates of T, (n, r).

    Raises: ParameterError: the actual bodies have no hover.
    """
    F, G = _continuous(system, T, plant)
    N = system.N
    delays_s = [plant.delay_s + plant.spread_s * (uav + 1) / N for uav in range(N)]
    periods, parts_s = zip(*(divmod(delay_s, period_s) for delay_s in delays_s), strict=True)

    # Arrivals within the period; before the one of a UAV its command of one period earlier acts.
    begins_s = sorted({0.0, *parts_s})
    ages = [
        tuple(
            round(whole) + (begin_s < part_s)
            for whole, part_s in zip(periods, parts_s, strict=True)
        )
        for begin_s in begins_s
    ]
    ends_s = [*begins_s[1:], period_s]
    return DelayedStep(
        parts=tuple(
            _exact_step(F, G, end_s - begin_s)
            for begin_s, end_s in zip(begins_s, ends_s, strict=True)
        ),
        ages=tuple(ages),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Wrench:
    """Thrust and moments, (m,), by state and by command."""

    by_state: Array  # (m, r)
    by_command: Array  # (m, m)


def _wrench(system: System, T: Array) -> _Wrench:
    """Return J K (rate command - rate) with commanded rates, otherwise the commands: (57)."""
    by_state = np.zeros((system.m, system.n))
    by_command = np.eye(system.m)

    if system.rate_gains is not None:
        for i, uav in enumerate(system.uavs):
            moments = state.input_slice(i)
            gains = uav.inertia * system.rate_gains
            by_state[moments, state.uav_slice(i)][1:, state.OMEGA] = -gains
            by_command[moments, moments][1:, 1:] = gains
    return _Wrench(by_state=by_state @ T, by_command=by_command)


def _continuous(system: System, T: Array, plant: Mismatch) -> tuple[Array, Array]:
    """Return x' = F x + G u of the actual bodies, with motor lag the actual inputs behind x."""
    linear = _about_hover(system, replace(plant, lag_s=0.0, delay_s=0.0, spread_s=0.0, gain=1.0))
    F = T.T @ linear.A_c @ T
    G = plant.gain * (T.T @ linear.B_c)

    wrench = _wrench(system, T)
    if plant.lag_s == 0.0:
        return F + G @ wrench.by_state, G @ wrench.by_command
    return _with_motors(F, G, wrench, plant.lag_s)


@lru_cache(maxsize=8)
def _about_hover(system: System, differences: Mismatch) -> Linearisation:
    """Return the actual bodies about their hover.

    A search of margins to delay, lag or gain has the same bodies each time.
    """
    bodies = differences.system(system)
    actual = hover(bodies)
    return Model(bodies).linearise(actual.x, actual.u)


def _with_motors(F: Array, G: Array, wrench: _Wrench, lag_s: float) -> tuple[Array, Array]:
    """Return the motion with actual inputs as states: a' = (wrench - a) / lag, (53).

    They are in units of their effect: moments of small vehicles are tiny.
    """
    r, m = G.shape
    unit = 1.0 / np.abs(G).max(axis=0)
    own_decay = -np.eye(m) / lag_s
    to_motors = wrench.by_state / (unit * lag_s)[:, None]
    commanded = wrench.by_command / (unit * lag_s)[:, None]

    with_motors = np.block([[F, G * unit], [to_motors, own_decay]])
    return with_motors, np.vstack([np.zeros((r, m)), commanded])


def _exact_step(F: Array, G: Array, duration_s: float) -> Discrete:
    """Return the zero-order hold of x' = F x + G u."""
    none = np.zeros(len(F))
    # Short lags of small vehicles decay too fast for the hold of a whole period: halves are joined.
    size = float(np.abs(F).sum(axis=0).max()) * duration_s
    halvings = max(0, math.ceil(math.log2(max(size, _SMALL) / _LARGEST)))
    no_outputs = np.zeros((0, len(F)))
    linear = Linearisation.of(none, F, G, np.zeros(0), no_outputs)
    held = zero_order_hold(linear, duration_s / 2**halvings)
    for _ in range(halvings):
        held = Discrete(A=held.A @ held.A, B=held.A @ held.B + held.B, f_d=none)
    return held
