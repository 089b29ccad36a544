"""State estimate of one agent from its measurements, the others' received states, and the model.

The measurement of tick k holds the payload and the owned UAVs. The others' states are received with their plans, at
least one tick late. The estimator keeps its past estimates, inserts each received state at its tick, and predicts
forward from there with the inputs now known for that time. With a Kalman filter, messages hold measurements of the
UAVs' own sensors instead of states: a tick has a belief before and after them, and a late message has the filter repeat
its work from that message's tick on.

With motor lag the state is [x, a]: the actual inputs a follow from hover with the commands; errors decay with the lag.
"""

import math
import sys
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from agent.announced import AnnouncedInputs
from agent.kalman import Belief, KalmanFilter
from agent.kalman import told as told_numbers
from model import motors, state
from model.arrays import Array, ShapeError
from model.discretisation import zero_order_hold
from model.hover import Hover
from model.linearisation import Linearisation, Model
from protocol.wire.messages import Measurement, Plan

# Past ticks that can still be corrected; an older state is no better than the prediction.
WINDOW = 64

# Integration steps per sampling period: local error below 1e-8 at 50 ms, with motor lag below 1e-5 after large jumps
# of the commands; far below any sensor. With a Kalman filter one step, whose error is far below what the filter knows.
STEPS = 2
_NEVER = sys.maxsize
# Unknowns of a disturbance: the force on the payload (3), and the horizontal force on each UAV (2).
_UNKNOWNS = 5


class DisturbanceEstimator:
    """Estimate of constant external forces by an agent that measures its UAVs, 0-based: a low-pass filter of errors.

    Unmodelled payload mass and wind both act as a force on the payload. Wind acts on the UAVs, too: its horizontal
    force shows in their own motion and is assumed equal for all of them. A vertical force on a UAV passes through the
    stiff rod and is counted as one on the payload. The `forces`, (3 + 3 N,), inertial frame, N, zero at first, enter
    the prediction, so that its error vanishes once they are right (offset-free MPC: Pannocchia, Rawlings 2003).
    """

    def __init__(
        self, model: Model, hover: Hover, owned: Sequence[int], period_s: float, time_constant_s: float
    ) -> None:
        self._period_s, self._time_constant_s = period_s, time_constant_s
        self.forces: Array = np.zeros(3 + 3 * model.system.N)
        self.rebuild(model, hover, owned)

    def rebuild(self, model: Model, hover: Hover, owned: Sequence[int]) -> None:
        """Take another model of the team, its hover and at least one owned UAV; keep the estimated forces."""
        self._model, self._bodies, period_s = model, [1 + uav for uav in owned], self._period_s
        N = model.system.N
        spread = np.vstack([np.eye(3, _UNKNOWNS), np.tile(np.eye(3, _UNKNOWNS, k=3), (N, 1))])
        linear = model.linearise(hover.x, hover.u)
        # At rest, velocities depend on the state as the positions' derivatives do.
        velocities = np.vstack([linear.A_c[state.R0], linear.C[: 3 * N] @ linear.A_c]).reshape(1 + N, 3, -1)
        # The zero-order hold of inputs applies to constant forces as well.
        E = model.force_effect(hover.x, hover.u) @ spread
        effect = zero_order_hold(Linearisation.of(linear.f, linear.A_c, E, linear.y, linear.C), period_s).B
        self._inverse = np.linalg.inv(self._observed(velocities @ effect))
        self._gain = (1.0 - math.exp(-period_s / self._time_constant_s)) * spread
        self._weight = model.system.total_mass * model.system.gravity

    def learn(self, predicted: Array, measured: Array) -> None:
        """Correct the estimate by the prediction error of a period.

        Given are the state at its end predicted with the estimate, (n,), and the same with the measured entries
        replaced. An error that implies a force above the team's weight is ignored: the prediction was wrong.

        Source: docs/equations.md (41).
        """
        error = self._model.velocities(measured) - self._model.velocities(predicted)
        force = self._inverse @ self._observed(error)
        if np.abs(force).max() <= self._weight:
            self.forces = self.forces + self._gain @ force

    def _observed(self, velocities: Array) -> Array:
        """Return payload's and own UAVs' mean horizontal velocity, (5, ...), from those of all, (1 + N, 3, ...)."""
        return np.concatenate([velocities[0], velocities[self._bodies, :2].mean(axis=0)])


class StateEstimator:
    """Estimator of the whole state, x, (n,), with motor lag [x, a], (n + m,), from the reference at its first tick on.

    It has a disturbance estimator, fed with the prediction errors, a Kalman filter of measurements, or neither.
    """

    def __init__(
        self,
        model: Model,
        reference: Callable[[int], Array],
        period_s: float,
        disturbance: DisturbanceEstimator | None = None,
        motor_lag_s: float = 0.0,
        kalman: KalmanFilter | None = None,
    ) -> None:
        self._model, self._reference, self._period_s = model, reference, period_s
        self._disturbance, self._motor_lag_s, self._kalman = disturbance, motor_lag_s, kalman
        # States of UAVs, 0-based, by tick, (12,); with a filter measurements and inputs until then, (19,).
        self._told: dict[int, dict[int, Array]] = {}
        self._measured: dict[int, Measurement] = {}
        ages = () if kalman is None else kalman.ages
        self._oldest = max(ages, default=0)  # quantity in a message, ticks
        self._sensors_of_age = [(age, tuple(i for i, of in enumerate(ages) if of == age)) for age in sorted(set(ages))]
        # Periods before a measurement that it changes: inputs reported with it act in the one before.
        self._uses_reports = disturbance is not None or motor_lag_s > 0.0
        self._changed = int(self._uses_reports) if kalman is None else max(1, self._oldest)
        self._learned = -1  # newest tick whose measurement the disturbance estimator has
        self._first = 0  # tick of the oldest estimate kept
        self._estimates: list[Array] = []
        self._priors: list[Belief] = []  # of a Kalman filter before the measurements, by tick as the estimates
        self._beliefs: list[Belief] = []  # after them
        self._stale_from = _NEVER  # earliest tick whose estimate or inputs have changed
        self._sensed_from = -1  # earliest tick whose measurements have changed, with a filter
        self._newest: dict[int, int] = {}
        self.resets: set[int] = set()  # ticks at which the filter began anew about the reference
        self.measured = -1  # tick of the newest measurement taken in
        self._breaks: list[tuple[int, Model, Callable[[Array], Array]]] = []  # see `change`, ascending in the tick

    def take(self, plan: Plan) -> None:
        """Take in another agent's state at a tick before the next measurement's."""
        if plan.tick < self._first:
            return
        self._newest[plan.agent] = max(plan.tick, self._newest.get(plan.agent, -1))
        for uav, values in zip(plan.uavs, plan.uav_states, strict=True):
            if self._kalman is None:
                self._tell(plan.tick, uav, values, 0)
                continue
            for age, row in enumerate(values.reshape(state.REPORTS, state.REPORTED)):
                if row[0] > 0.0:
                    self._tell(plan.tick - age, uav, row[1:], self._changed)

    def measure(self, measurement: Measurement) -> None:
        """Take in a measurement of a tick not later than the one to be estimated."""
        tick = measurement.tick
        self.measured = max(self.measured, tick)
        if tick < self._first:
            return
        self._measured[tick] = measurement
        for uav, values, inputs in zip(measurement.uavs, measurement.uav_states, measurement.inputs, strict=True):
            told = values if self._kalman is None else np.concatenate([values, inputs])
            self._tell(tick, uav, told, self._changed)

    def _tell(self, tick: int, uav: int, values: Array, before: int) -> None:
        """Keep, once, what a message says of a UAV, 1-based; it changes estimates from so many ticks before on."""
        if tick >= self._first and uav - 1 not in self._told.setdefault(tick, {}):
            self._told[tick][uav - 1] = values
            self._sensed_from = min(self._sensed_from, tick - self._oldest)
            self._stale_from = min(self._stale_from, tick - before)

    def reports(self, k: int, uavs: Sequence[int]) -> Array:
        """Return measurements and inputs of UAVs, 0-based, at the last ticks, as a plan holds them, (UAVs, 80)."""
        found = np.zeros((len(uavs), state.REPORTS, state.REPORTED))
        for age in range(state.REPORTS):
            told = self._told.get(k - age, {})
            for i, uav in enumerate(uavs):
                if uav in told:
                    found[i, age, 0], found[i, age, 1:] = 1.0, told[uav]
        return found.reshape(len(uavs), -1)

    def change(self, tick: int, model: Model, moved: Callable[[Array], Array]) -> None:
        """Change the system from a tick on, not before the previous change; `moved` maps the state there, (n,)."""
        self._breaks.append((tick, model, moved))
        self._stale_from = min(self._stale_from, tick - 1)

    def estimate(self, k: int, announced: AnnouncedInputs) -> Array:
        """Return the estimate at tick k, read-only, with the announced inputs between the ticks as known now.

        Ticks come in order; gaps are bridged by prediction.
        """
        if not self._estimates:
            self._first = k
            self._told = {tick: told for tick, told in self._told.items() if tick >= k}
            self._measured = {tick: measurement for tick, measurement in self._measured.items() if tick >= k}
            self._estimates = [self._reference_at(k)]
            self._priors = [] if self._kalman is None else [self._kalman.first(self._estimates[0])]
        begin = min(self._first + len(self._estimates) - 1, max(self._stale_from, self._first))
        at = begin - self._first
        del self._estimates[at + 1 :], self._priors[at + 1 :], self._beliefs[at + 1 :]
        if self._kalman is None or self._sensed_from <= begin:
            del self._beliefs[at:]
            self._estimates[at] = self._joined(self._estimates[at].copy(), begin)
        self._stale_from = self._sensed_from = _NEVER
        for tick in range(begin, k):
            u = announced.at(tick, before=k, x=self._estimates[-1])
            if self._kalman is None:
                self._estimates.append(self._followed(tick, u))
            else:
                silent = announced.silent(tick, before=k)
                self._estimates.append(
                    self._filtered(tick, u, (announced.unannounced(tick, before=k), silent), self._kalman)
                )
        while len(self._estimates) > WINDOW:
            del self._estimates[0], self._priors[:1], self._beliefs[:1]
            self._told.pop(self._first, None)
            self._measured.pop(self._first, None)
            self._first += 1
        return self._estimates[-1]

    @property
    def belief(self) -> Belief | None:
        """Newest belief of a Kalman filter; None without one."""
        return self._beliefs[-1] if self._beliefs else None

    def known(self, tick: int) -> Array | None:
        """Return the estimate at a past tick, read-only; None where it is not kept."""
        at = tick - self._first
        return self._estimates[at] if 0 <= at < len(self._estimates) else None

    def told(self, tick: int, uav: int) -> Array | None:
        """Return what a message says of a UAV, 0-based, at a tick: measurements and inputs, (19,), with a filter."""
        return self._told.get(tick, {}).get(uav)

    def age(self, agent: int, tick: int) -> int:
        """Return the ticks since the newest state received from another agent, -1 for none."""
        return tick - self._newest[agent] if agent in self._newest else -1

    def inputs_until(self, k: int, announced: AnnouncedInputs) -> Array:
        """Return the inputs in force until tick k after `estimate` for it, (4 N,): announced, own ones as reported."""
        u = announced.at(k - 1, before=k, x=self.known(k - 1))
        self._report(u, k)
        return u

    def _filtered(
        self,
        tick: int,
        u: Array,
        unknown: tuple[npt.NDArray[np.bool_], tuple[Array, Array] | None],
        kalman: KalmanFilter,
    ) -> Array:
        """Add prior and belief of the next tick; return its estimate. `unknown` is about inputs that no plan says."""
        unannounced, silent = unknown
        for uav, values in self._told.get(tick + 1, {}).items():
            u[state.input_slice(uav)] = values[state.SENSED :]
            unannounced[:, state.input_slice(uav)] = False
        before = self._beliefs[-1]
        ahead = self._predicted(tick, u, kalman.forces(before))
        prior = kalman.predict(before, self._model_at(tick), tick, ahead, u, *unannounced, silent)
        for moved in self._moves_at(tick + 1):
            shifted = ahead + 1.0  # entries that a failure sets do not stay where they are moved to
            prior = kalman.certain(prior, np.flatnonzero(moved(shifted) != shifted))
        self._priors.append(prior)
        return self._joined(ahead, tick + 1)

    def _followed(self, tick: int, u: Array) -> Array:
        """Return the estimate at the next tick; correct the disturbance estimate once, if both ends are measured."""
        if self._uses_reports:
            self._report(u, tick + 1)  # a wrong input would look like a force
        disturbance, n = self._disturbance, self._model.system.n
        ahead = self._predicted(tick, u, None if disturbance is None else disturbance.forces)
        found = self._joined(ahead.copy(), tick + 1)
        if disturbance is not None and {tick, tick + 1} <= self._measured.keys() and tick >= self._learned:
            self._learned = tick + 1
            disturbance.learn(ahead[:n], found[:n])
        return found

    def _joined(self, x: Array, tick: int) -> Array:
        """Return the estimate at a tick, read-only, from its prediction and the messages of the tick."""
        if self._kalman is not None:
            self._beliefs.append(self._corrected(self._kalman, tick))
            return self._beliefs[-1].x
        if tick in self._measured:
            x[: state.PAYLOAD] = self._measured[tick].payload
        for uav, block in self._told.get(tick, {}).items():
            x[state.uav_slice(uav)] = block
        x.setflags(write=False)
        return x

    def _corrected(self, kalman: KalmanFilter, tick: int) -> Belief:
        """Return the belief at a tick; one about the reference where numbers are out of range, which is counted."""
        model, sensed = self._model_at(tick), list(self._sensed(tick))
        at = tick - self._first
        belief = _plausible(kalman, self._priors[at], model, sensed)
        if belief is not None:
            return belief
        self.resets.add(tick)
        self._priors[at] = anew = kalman.first(self._reference_at(tick))
        # What made the numbers leave their range may be a measurement of this tick.
        return _plausible(kalman, anew, model, sensed) or anew

    def told_of_payload(self) -> Array | None:
        """Return what the newest belief says of the payload (`agent.kalman.TOLD`); None without, or after a reset."""
        belief = self.belief
        try:
            return None if belief is None else told_numbers(belief)
        except (ShapeError, np.linalg.LinAlgError):
            # The covariance is computed when it is asked for.
            tick = self._first + len(self._beliefs) - 1
            self._priors[-1] = self._kalman.first(self._reference_at(tick)) if self._kalman else self._priors[-1]
            self.resets.add(tick)
            self._stale_from = min(self._stale_from, tick)
            return None

    def _sensed(self, tick: int) -> Iterator[tuple[int, tuple[int, ...], Array]]:
        """Yield UAV, sensors and measurements of all that is known of a tick."""
        for age, sensors in self._sensors_of_age:
            told = self._told.get(tick + age, {})
            for uav in sorted(told):
                yield uav, sensors, told[uav]

    def _report(self, u: Array, tick: int) -> None:
        """Replace announced inputs until a tick by those that the own actuators report, if measured."""
        measurement = self._measured.get(tick)
        if measurement is not None:
            for uav, inputs in zip(measurement.uavs, measurement.inputs, strict=True):
                u[state.input_slice(uav - 1)] = inputs

    def _predicted(self, tick: int, u: Array, forces: Array | None) -> Array:
        """Predict the next state from the newest estimate; if that diverges, return the reference state."""
        model, steps = self._model_at(tick), STEPS if self._kalman is None else 1
        ahead, _ = motors.integrate(model, self._estimates[-1], u, self._period_s, steps, self._motor_lag_s, forces)
        if np.abs(ahead).max() > state.LARGEST:
            return self._reference_at(tick + 1)
        for moved in self._moves_at(tick + 1):
            ahead = moved(ahead)
        return ahead

    def _model_at(self, tick: int) -> Model:
        return next((model for since, model, _ in reversed(self._breaks) if since <= tick), self._model)

    def _moves_at(self, tick: int) -> list[Callable[[Array], Array]]:
        return [moved for since, _, moved in self._breaks if since == tick]

    def _reference_at(self, tick: int) -> Array:
        """Return the reference state at a tick, with the failures so far."""
        x = self._reference(tick)
        for since, _, moved in self._breaks:
            if since <= tick:
                x = moved(x)
        return x


def _plausible(
    kalman: KalmanFilter, prior: Belief, model: Model, sensed: Sequence[tuple[int, tuple[int, ...], Array]]
) -> Belief | None:
    """Return the belief after a correction; None where numbers are out of range."""
    try:
        belief = kalman.correct(prior, model, sensed)
    except (ShapeError, np.linalg.LinAlgError):
        return None
    return belief if kalman.is_plausible(belief) else None
