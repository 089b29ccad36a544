"""Linear analysis of the sampled loop about hover.

Exact plant, actuators, estimators and control laws of a team.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.discretisation import zero_order_hold
from transport.model.linear.motor_lag import with_lag
from transport.model.physics.parameters import ParameterError
from transport.mpc.controller import Controller
from transport.mpc.law.tangent import tangent
from transport.mpc.margins.actual_plant import Mismatch, delayed_step

# Fastest growth that counts as stable, 1/s: headings neither grow nor decay but by rounding.
GROWTH = 0.02
_DECAY = 1e-3  # slowest decay that is one, 1/s: undamped modes have zero, and rounding moves them
_COARSE = 1.4  # factor of the search until the first unstable plant
_FINE = 0.005  # relative accuracy of the bisection after it
FARTHEST = 10.0  # largest factor that is tried
# Largest lag and delay that are tried, s; of a larger one that is known, a step more.
FARTHEST_S = 0.6
_FIRST_S = 1e-3  # shortest lag and delay that are tried, s


class SampledLoop(ABC):
    """A sampled loop about hover, as a function of the plant."""

    period_s: float
    known_lag_s = 0.0  # time constant of the motors that controllers know
    _headings = 0  # at most so many modes are headings on which no state depends

    @abstractmethod
    def matrix(self, plant: Mismatch) -> Array:
        """Return the step from one sampling instant to the next.

        Raises: ParameterError: the bodies have no hover.
        """

    def growth(self, plant: Mismatch) -> float:
        """Return the growth rate of the fastest growing mode, 1/s.

        Infinite where the bodies have no hover.
        """
        try:
            step = self.matrix(plant)
        except ParameterError:
            return math.inf
        return math.log(float(np.abs(np.linalg.eigvals(step)).max())) / self.period_s

    def settling_s(self, plant: Mismatch) -> float | None:
        """Return the time in which the slowest deviation decays by e, headings of UAVs apart.

        None if one does not.
        """
        eigenvalues = np.linalg.eigvals(self.matrix(plant))
        from_one = np.abs(eigenvalues - 1.0)
        nearest = np.argsort(from_one)[: self._headings]
        # Headings that a cost controls are no longer at 1.
        headings = [mode for mode in nearest if from_one[mode] < _DECAY * self.period_s]
        others = np.delete(eigenvalues, headings)
        decay = -math.log(float(np.abs(others).max())) / self.period_s
        return 1.0 / decay if decay > _DECAY else None


class Loop(SampledLoop):
    """The sampled loop of a team about hover as a function of the plant, by its controllers.

    With `next_tick` inputs act one sampling period after the measurement; `age` are the periods
    until an agent knows another agent's state, >= 1. UAVs without an agent, by 0-based numbers,
    follow a fail-safe, (4, n), unmeasured.
    """

    def __init__(
        self,
        controllers: Sequence[Controller],
        *,
        next_tick: bool,
        age: int = 1,
        uncontrolled: Mapping[int, Array] | None = None,
    ) -> None:
        self._controllers = tuple(controllers)
        self._delay = int(next_tick)  # periods between the measurement and its inputs
        self._age = age

        first = controllers[0]
        system = first.model.system
        hovering = first.regulation.hover
        self._system = system
        self._headings = system.N
        self.period_s = first.settings.sampling_period_s
        self.known_lag_s = first.settings.motor_lag_s

        # The controllers' model in coordinates xi of the manifold, actual inputs behind them.
        linear = first.model.linearise(hovering.x, hovering.u)
        T = tangent(hovering.x, motors=self.known_lag_s > 0.0)
        if self.known_lag_s > 0.0:
            linear = with_lag(
                linear, hovering.u, hovering.u, self.known_lag_s, system.commands_rates
            )
        discrete = zero_order_hold(linear, self.period_s)
        self._T = T
        self._motions = system.n - 2 * system.N  # number of coordinates of the motion alone
        self._A = T.T @ discrete.A @ T
        self._B = T.T @ discrete.B
        self._law = first.regulation.gain(0) @ T

        # Projections of states on what the agents measure at once: payload and own UAVs.
        self._measured = []
        for controller in controllers:
            seen = [slice(0, state.PAYLOAD), *map(state.uav_slice, controller.owned)]
            rows = T[np.r_[tuple(seen)]]
            self._measured.append(rows.T @ rows)
        self._set_uncontrolled(uncontrolled or {})

    def _set_uncontrolled(self, uncontrolled: Mapping[int, Array]) -> None:
        """Set the fail-safe of UAVs without agents, and the unmeasured coordinates."""
        m = self._system.m
        self._gone = np.zeros((m, 1), dtype=bool)  # their inputs
        self._fail_safe = np.zeros((m, len(self._A)))
        lost = np.zeros(len(self._T), dtype=bool)
        for uav, gain in uncontrolled.items():
            own = state.input_slice(uav)
            self._gone[own] = True
            self._fail_safe[own] = gain @ self._T[: gain.shape[1]]
            lost[state.uav_slice(uav)] = True
            # Its heading matters to no other state.
            lost[state.uav_slice(uav)][state.THETA][2] = False
        self._lost = np.flatnonzero((self._T[lost] != 0.0).any(axis=0))

    def matrix(self, plant: Mismatch) -> Array:
        """Return the step from one sampling instant to the next.

        The state is [motion of the plant, actual inputs that the controllers expect, past states,
        past commands, estimates of unmeasured coordinates].
        Raises: ParameterError: the bodies have no hover.
        """
        T_motion = self._T[: self._system.n, : self._motions]
        plant_step = delayed_step(self._system, T_motion, plant, self.period_s)
        late = plant_step.late

        whole = self._blocks(plant_step.size, late)
        now = np.vstack([whole.motion[: self._motions], whole.expected])
        issued, unmeasured = self._new_commands(whole, now)

        commands = [issued, *whole.commands]  # newest first
        in_force = self._in_force(commands)

        moved = plant_step.moved(whole.motion, in_force)
        expected = self._A[self._motions :] @ now + self._B[self._motions :] @ in_force[0]
        return np.vstack([moved, expected, now, *whole.past[:-1], *commands[:-1], *unmeasured])

    def _in_force(self, commands: Sequence[Array]) -> list[Array]:
        """Return the inputs in force of each period, newest first, from the commands, newest first.

        Commands of agents act `delay` periods after they are issued; a fail-safe needs no time for
        computing.
        """
        in_time = commands[: len(commands) - self._delay]
        delayed = commands[self._delay :]
        pairs = zip(in_time, delayed, strict=True)
        return [np.where(self._gone, at_once, late) for at_once, late in pairs]

    def _new_commands(self, whole: "_Blocks", now: Array) -> tuple[Array, list[Array]]:
        """Return the new commands, (m, size), and the agents' estimates of unmeasured coordinates."""
        issued = np.empty((self._system.m, now.shape[1]))
        gone = self._gone[:, 0]
        issued[gone] = self._fail_safe[gone] @ now

        unmeasured = []
        states = [now, *whole.past]
        for agent, controller in enumerate(self._controllers):
            x, next_unmeasured = self._estimate(
                agent, states, whole.commands, whole.unmeasured[agent]
            )
            issued[controller.own] = self._law[controller.own] @ x
            unmeasured.append(next_unmeasured)
        return issued, unmeasured

    def _blocks(self, motion: int, late: int) -> "_Blocks":
        """Return the parts of the whole state, as rows of the identity."""
        size = len(self._A)
        # Estimates reach back age + delay commands, the plant late + 1 periods before those in
        # force.
        kept = self._delay + max(self._age, late + 1)

        past = [size] * self._age
        commands = [self._system.m] * kept
        unmeasured = [len(self._lost)] * len(self._controllers)
        sizes = [motion, size - self._motions, *past, *commands, *unmeasured]
        parts = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1])

        first_command = 2 + len(past)
        first_unmeasured = first_command + len(commands)
        return _Blocks(
            motion=parts[0],
            expected=parts[1],
            past=parts[2:first_command],
            commands=parts[first_command:first_unmeasured],
            unmeasured=parts[first_unmeasured:],
        )

    def _estimate(
        self,
        agent: int,
        states: Sequence[Array],
        commands: Sequence[Array],
        unmeasured: Array,
    ) -> tuple[Array, Array]:
        """Return an agent's estimate of the state of its plan, and its next unmeasured coordinates.

        The newest state known of all UAVs is x(k - age). From there to k the agent measures its own
        part, and the others follow plans that it has, up to k - age + delay, and then the shared law;
        to the state of its plan, x(k + delay), it predicts.

        Args:
            agent: Index of its controller.
            states: Now and one, two, .. periods ago, (size, whole); of all UAVs up to `age`
                periods ago, payload and own UAVs since then.
            commands: One, two, .. periods ago, (m, whole).
            unmeasured: Its estimate of the unmeasured coordinates `age` periods ago, (lost, whole).
        Source: docs/equations.md (60a).
        """
        own = self._controllers[agent].own
        is_own = np.isin(np.arange(self._system.m), own)[:, None]
        x = states[self._age].copy()
        x[self._lost] = unmeasured
        held = np.zeros(0)

        # From the newest state known of all, x(k - age), to that of the plan, x(k + delay).
        for step in range(self._age + self._delay):
            # In force in this period: issued at k - age - delay + step; commands[0] is of k - 1.
            u = commands[self._age + self._delay - 1 - step]
            if step == self._delay:
                # The newest plans received; their difference from the shared law is held.
                held = u - self._law @ x
            elif step > self._delay:
                # Later plans of the others are not received: the shared law replaces them.
                u = np.where(is_own, u, self._law @ x + held)
            u = np.where(self._gone, self._fail_safe @ x, u)
            x = self._A @ x + self._B @ u

            if step < self._age:
                # Up to k the agent has its own measurements of x(k - age + step + 1).
                measured = states[self._age - 1 - step]
                x = x + self._measured[agent] @ (measured - x)
            if step == 0:
                unmeasured = x[self._lost]  # of x(k - age + 1), from which the next tick predicts
        return x, unmeasured


@dataclass(frozen=True, slots=True, kw_only=True)
class _Blocks:
    """Parts of the state of a loop, as rows of the identity of the whole."""

    motion: Array  # of the plant, with the actual inputs of its motors
    expected: Array  # actual inputs that the controllers expect
    past: Sequence[Array]  # states one, two, .. periods ago
    commands: Sequence[Array]  # newest first
    unmeasured: Sequence[Array]  # estimates of unmeasured coordinates `age` periods ago, by agent


@dataclass(frozen=True, slots=True, kw_only=True)
class Margin:
    """Range of one property of the plant within which the hover is stable.

    None beyond the range that is searched.
    """

    nominal: float
    lower: float | None
    upper: float | None


_PROPERTIES = tuple(field.name for field in fields(Mismatch))


def margins(loop: SampledLoop, names: Sequence[str] = _PROPERTIES) -> dict[str, Margin]:
    """Return the margin to properties of `Mismatch`, by default all, each with the others as known.

    Empty if the loop is unstable as known.
    """
    nominal = Mismatch(lag_s=loop.known_lag_s)
    if loop.growth(nominal) > GROWTH:
        return {}
    return {name: _margin(loop, nominal, name) for name in names}


def _margin(loop: SampledLoop, nominal: Mismatch, name: str) -> Margin:
    """Return the margin to one property."""
    value = getattr(nominal, name)

    def is_stable(changed: float) -> bool:
        return loop.growth(replace(nominal, **{name: changed})) <= GROWTH

    if not name.endswith("_s"):  # a factor
        lower = _limit(is_stable, value, 1.0 / FARTHEST)
        upper = _limit(is_stable, value, FARTHEST)
        return Margin(nominal=value, lower=lower, upper=upper)

    # Lags and delays begin at zero, from which no factor leads on: below the shortest one tried
    # only the known value is looked at, which is stable.
    begin = max(value, _FIRST_S)
    farthest_s = max(FARTHEST_S, _COARSE * begin)
    upper_s = _limit(is_stable, begin, farthest_s) if is_stable(begin) else value
    lower_s = _limit(is_stable, value, _FIRST_S) if value > _FIRST_S else None
    return Margin(nominal=value, lower=lower_s, upper=upper_s)


def _limit(is_stable: Callable[[float], bool], inside: float, farthest: float) -> float | None:
    """Return the last stable value from `inside` towards `farthest`; None if all are stable.

    `inside` is stable.
    """
    grows = farthest > inside
    factor = _COARSE if grows else 1.0 / _COARSE
    while True:
        outside = inside * factor
        outside = min(outside, farthest) if grows else max(outside, farthest)
        if not is_stable(outside):
            break
        if outside == farthest:
            return None
        inside = outside

    while abs(math.log(outside / inside)) > _FINE:
        middle = math.sqrt(inside * outside)
        if is_stable(middle):
            inside = middle
        else:
            outside = middle
    return inside
