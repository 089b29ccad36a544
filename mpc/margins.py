"""Linear analysis of the sampled loop about hover: exact plant, actuators, estimators and control laws of a team."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from model import state
from model.arrays import Array
from model.discretisation import zero_order_hold
from model.hover import hover
from model.linearisation import Linearisation, Model
from model.motors import lagged
from model.parameters import ParameterError, System
from mpc.controller import Controller
from mpc.feedback import tangent

GROWTH = 0.02  # fastest that counts as stable, 1/s; headings neither grow nor decay, and rounding moves them
_DECAY = 1e-3  # slowest that is one, 1/s: undamped modes have zero, and rounding moves them
_COARSE, _FINE = 1.4, 0.005  # steps of the search: until the first unstable plant, then by bisection
FARTHEST, FARTHEST_S = 10.0, 0.6  # factors, and lag and delay, s
_FIRST_S = 1e-3  # shortest lag and delay that are tried, s


@dataclass(frozen=True, slots=True, kw_only=True)
class Mismatch:
    """Differences between the plant and the controllers' model."""

    lag_s: float = 0.0  # time constant of the plant's motors, s
    delay_s: float = 0.0  # between command and motors, s
    gain: float = 1.0  # actual inputs over commanded inputs
    uav_inertia: float = 1.0  # actual value over the known one, as all that follow
    uav_mass: float = 1.0
    payload_mass: float = 1.0
    payload_inertia: float = 1.0
    rod_length: float = 1.0

    def system(self, known: System) -> System:
        """Return the actual bodies."""
        body, uavs = known.payload, []
        for uav in known.uavs:
            changed = replace(uav, mass=uav.mass * self.uav_mass, rod_length=uav.rod_length * self.rod_length)
            uavs.append(replace(changed, inertia=uav.inertia * self.uav_inertia))
        payload = replace(body, mass=body.mass * self.payload_mass, inertia=body.inertia * self.payload_inertia)
        return System(payload=payload, uavs=uavs, gravity=known.gravity)


class SampledLoop(ABC):
    """A sampled loop about hover, as a function of the plant."""

    period_s: float
    known_lag_s = 0.0  # time constant of the motors that controllers know
    _headings = 0  # modes that neither grow nor decay, as no state depends on them

    @abstractmethod
    def matrix(self, plant: Mismatch) -> Array:
        """Return the step from one sampling instant to the next. Raises: ParameterError: the bodies have no hover."""

    def growth(self, plant: Mismatch) -> float:
        """Return the growth rate of the fastest growing mode, 1/s; infinite where the bodies have no hover."""
        try:
            step = self.matrix(plant)
        except ParameterError:
            return math.inf
        return math.log(float(np.abs(np.linalg.eigvals(step)).max())) / self.period_s

    def settling_s(self, plant: Mismatch) -> float | None:
        """Return the time in which the slowest deviation decays by e, headings of UAVs apart; None if one does not."""
        eigenvalues = np.linalg.eigvals(self.matrix(plant))
        others = eigenvalues[np.argsort(np.abs(eigenvalues - 1.0))[self._headings :]]
        decay = -math.log(float(np.abs(others).max())) / self.period_s
        return 1.0 / decay if decay > _DECAY else None


class Loop(SampledLoop):
    """The sampled loop of a team about hover, as a function of the plant, with a controller per agent.

    With `next_tick` inputs act one sampling period after the measurement; `age` are the periods until an agent knows
    another agent's state, >= 1. UAVs without an agent, by 0-based numbers, follow a fail-safe, (4, n), unmeasured.
    """

    def __init__(
        self, controllers: Sequence[Controller], *, next_tick: bool, age: int = 1,
        uncontrolled: Mapping[int, Array] | None = None,
    ) -> None:  # fmt: skip
        self._controllers, self._next_tick, self._age = tuple(controllers), next_tick, age
        first = controllers[0]
        self._system, at_rest = first.model.system, first.regulation.hover
        self._headings = self._system.N
        self.period_s, self.known_lag_s = first.settings.sampling_period_s, first.settings.motor_lag_s
        model = first.model.linearise(at_rest.x, at_rest.u)
        self._T = T = tangent(at_rest.x, motors=self.known_lag_s > 0.0)
        self._r = self._system.n - 2 * self._system.N  # coordinates of the motion; those of the actual inputs follow
        if self.known_lag_s > 0.0:
            model = lagged(model, at_rest.u, at_rest.u, self.known_lag_s, self._system.commands_rates)
        discrete = zero_order_hold(model, self.period_s)
        self._A, self._B = T.T @ discrete.A @ T, T.T @ discrete.B
        # Projections of states in tangent coordinates on what the agents measure at once.
        seen = [np.r_[(slice(0, state.PAYLOAD), *map(state.uav_slice, each.owned))] for each in controllers]
        self._measured = [T[rows].T @ T[rows] for rows in seen]
        self._law = first.regulation.gain(0) @ T
        lost = np.zeros(len(self._T), dtype=bool)
        m = self._system.m
        self._gone, self._fail_safe = np.zeros((m, 1), dtype=bool), np.zeros((m, len(self._A)))
        for uav, gain in (uncontrolled or {}).items():
            lost[state.uav_slice(uav)], self._gone[state.input_slice(uav)] = True, True
            lost[state.uav_slice(uav)][state.THETA][2] = False  # its heading matters to no other state
            self._fail_safe[state.input_slice(uav)] = gain @ self._T[: gain.shape[1]]
        self._lost = np.flatnonzero((self._T[lost] != 0.0).any(axis=0))  # their coordinates

    def matrix(self, plant: Mismatch) -> Array:
        """Return the step from one sampling instant to the next. Raises: ParameterError: the bodies have no hover."""
        period_s, m, r = self.period_s, self._system.m, self._r
        earlier, later, late = held_plant(self._system, self._T[: self._system.n, :r], plant, period_s)
        ahead, age = int(self._next_tick), self._age
        kept = ahead + max(age, late + 1)
        guessed = [len(self._lost)] * len(self._controllers)
        sizes = [len(earlier[0]), len(self._A) - r, *[len(self._A)] * age, *[m] * kept, *guessed]
        blocks = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1])
        motion, known_inputs, past = blocks[0], blocks[1], blocks[2 : 2 + age]
        commands, guesses = blocks[2 + age : 2 + age + kept], blocks[2 + age + kept :]
        now = np.vstack([motion[:r], known_inputs])
        issued = np.empty((m, now.shape[1]))
        issued[self._gone[:, 0]] = self._fail_safe[self._gone[:, 0]] @ now
        for agent, controller in enumerate(self._controllers):
            x, guesses[agent] = self._estimate(agent, [now, *past], commands, guesses[agent])
            issued[controller.own] = self._law[controller.own] @ x
        inputs = [issued, *commands]  # newest first
        # In force, now and before; the fail-safe needs no time for computing.
        acting = [np.where(self._gone, *pair) for pair in zip(inputs, inputs[ahead:], strict=False)]
        moved = later[0] @ (earlier[0] @ motion + earlier[1] @ acting[late + 1]) + later[1] @ acting[late]
        known_inputs = self._A[r:] @ now + self._B[r:] @ acting[0]
        return np.vstack([moved, known_inputs, now, *past[:-1], *inputs[:-1], *guesses])

    def _estimate(
        self, agent: int, known: Sequence[Array], commands: Sequence[Array], guess: Array
    ) -> tuple[Array, Array]:
        """Return an agent's estimate of the state of its plan, and of UAVs without agents, from states and commands."""
        own, age, ahead = self._controllers[agent].own, self._age, int(self._next_tick)
        x, offset = known[age].copy(), np.zeros(0)
        x[self._lost] = guess
        for step in range(age + ahead):
            u = commands[age + ahead - 1 - step]
            if step > ahead:
                # Later plans of the others have not been received: the shared control law replaces them.
                u = np.where(np.isin(np.arange(len(u)), own)[:, None], u, self._law @ x + offset)
            elif step == ahead:
                offset = u - self._law @ x
            u = np.where(self._gone, self._fail_safe @ x, u)
            x = self._A @ x + self._B @ u
            if step < age:
                x = x + self._measured[agent] @ (known[age - 1 - step] - x)
            if step == 0:
                guess = x[self._lost]
        return x, guess


def held_plant(
    known: System, T: Array, plant: Mismatch, period_s: float
) -> tuple[tuple[Array, Array], tuple[Array, Array], int]:
    """Return the plant's steps before and after the arrival of a delayed command, and whole periods of that delay.

    They map the motion in coordinates of T, (n, r), with motor lag and the actual inputs, and held commands.
    Raises: ParameterError: the bodies have no hover.
    """
    actual = hover(plant.system(known))
    linear = Model(plant.system(known)).linearise(actual.x, actual.u)
    m, r = known.m, T.shape[1]
    F, G = T.T @ linear.A_c @ T, plant.gain * (T.T @ linear.B_c)
    # Thrust and moments by state and by command, (57).
    by_state, by_command = np.zeros((m, known.n)), np.eye(m)
    if known.rate_gains is not None:
        for i, uav in enumerate(known.uavs):
            moments, gains = state.input_slice(i), uav.inertia * known.rate_gains
            by_state[moments, state.uav_slice(i)][1:, state.OMEGA] = -gains
            by_command[moments, moments][1:, 1:] = gains
    by_state = by_state @ T
    if plant.lag_s == 0.0:
        F, G = F + G @ by_state, G @ by_command
    else:
        # Actual inputs in units of their effect: moments of small vehicles are tiny in N m.
        unit = 1.0 / np.abs(G).max(axis=0)
        F = np.block([[F, G * unit], [by_state / (unit * plant.lag_s)[:, None], -np.eye(m) / plant.lag_s]])
        G = np.vstack([np.zeros((r, m)), by_command / (unit * plant.lag_s)[:, None]])
    periods, part_s = divmod(plant.delay_s, period_s)
    return _held(F, G, part_s), _held(F, G, period_s - part_s), round(periods)


def _held(F: Array, G: Array, duration_s: float) -> tuple[Array, Array]:
    if duration_s == 0.0:
        return np.eye(len(F)), np.zeros_like(G)
    none = np.zeros(0)
    discrete = zero_order_hold(Linearisation.of(np.zeros(len(F)), F, G, none, np.zeros((0, len(F)))), duration_s)
    return discrete.A, discrete.B


@dataclass(frozen=True, slots=True, kw_only=True)
class Margin:
    """Range of one property of the plant within which the hover is stable; None beyond the range that is searched."""

    nominal: float
    lower: float | None
    upper: float | None


def margins(loop: SampledLoop) -> dict[str, Margin]:
    """Return the margin to each property of `Mismatch`, the others as known; none if the loop is unstable as known."""
    nominal = Mismatch(lag_s=loop.known_lag_s)
    if loop.growth(nominal) > GROWTH:
        return {}
    found = {}
    for name in Mismatch.__dataclass_fields__:
        value = getattr(nominal, name)

        def stable(changed: float, name: str = name) -> bool:
            return loop.growth(replace(nominal, **{name: changed})) <= GROWTH

        if name.endswith("_s"):
            begin = max(value, _FIRST_S)
            upper = _limit(stable, begin, FARTHEST_S) if stable(begin) else begin
            lower = _limit(stable, value, _FIRST_S) if value > 0.0 else None
        else:
            upper, lower = _limit(stable, value, FARTHEST), _limit(stable, value, 1.0 / FARTHEST)
        found[name] = Margin(nominal=value, lower=lower, upper=upper)
    return found


def _limit(stable: Callable[[float], bool], inside: float, farthest: float) -> float | None:
    """Return the last stable value from `inside` towards `farthest`; None if all are stable."""
    step = _COARSE if farthest > inside else 1.0 / _COARSE
    while stable(outside := (min if step > 1.0 else max)(inside * step, farthest)):
        if outside == farthest:
            return None
        inside = outside
    while abs(math.log(outside / inside)) > _FINE:
        middle = math.sqrt(inside * outside)
        inside, outside = (middle, outside) if stable(middle) else (inside, middle)
    return inside
