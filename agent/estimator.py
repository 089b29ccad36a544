"""State estimate of one agent from its measurements, the others' received states, and the model.

The measurement of tick k holds the payload and the owned UAVs. The others' states are received with their plans, at
least one tick late. The estimator keeps its past estimates, inserts each received state at its tick, and predicts
forward from there with the inputs now known for that time. Without disturbance the result is the plant state,
independent of the delay.

With a Kalman filter, messages hold measurements of the UAVs' own sensors instead of states. Then a tick has a belief
before and after its measurements, and a late message has the filter repeat its work from that message's tick on.

With motor lag the state is [x, a]: the actual inputs a, which no message has, follow from hover with the commands. An
error in them decays with the lag.
"""

from collections.abc import Callable, Iterator, Sequence
from operator import itemgetter

import numpy as np
import numpy.typing as npt

from agent.announced import AnnouncedInputs
from agent.disturbance import DisturbanceEstimator
from agent.kalman import Belief, KalmanFilter
from model import motors, state
from model.arrays import Array
from model.linearisation import Model
from protocol.wire.messages import Measurement, Plan

# Past ticks that can still be corrected; an older state is no better than the prediction.
WINDOW = 64

# Integration steps per sampling period: local error below 1e-8 at 50 ms, with motor lag below 1e-5 after large jumps
# of the commands; far below any sensor. With a Kalman filter one step, whose error is far below what the filter knows.
STEPS = 2


class StateEstimator:
    """Estimator of the whole state at the present tick, x, (n,), with motor lag [x, a], (n + m,).

    The reference state at the first tick begins it. It has a disturbance estimator, fed with the prediction errors, a
    Kalman filter of measurements, or neither.
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
        self._model = model
        self._reference = reference
        self._period_s = period_s
        self._disturbance = disturbance
        self._motor_lag_s = motor_lag_s
        self._kalman = kalman
        # With a filter, measurements and inputs until then of UAVs, 0-based, by tick: (19,).
        self._sensors: dict[int, dict[int, Array]] = {}
        ages = () if kalman is None else kalman.ages
        self._sensors_of_age = [(age, tuple(i for i, of in enumerate(ages) if of == age)) for age in sorted(set(ages))]
        self._priors: list[Belief] = []  # of a Kalman filter before the measurements, by tick as the estimates
        self._beliefs: list[Belief] = []  # after them
        self._learned = -1  # newest tick whose measurement the disturbance estimator has
        self._first = 0  # tick of the oldest estimate kept
        self._estimates: list[Array] = []
        self._received: dict[int, dict[int, Plan]] = {}  # plans whose states are known, by tick and agent
        self._measured: dict[int, Measurement] = {}
        self._stale_from: int | None = None  # earliest tick whose estimate or inputs have changed
        self._sensed_from: int | None = None  # earliest tick whose measurements have changed, with a filter
        self._newest: dict[int, int] = {}
        self.measured = -1  # tick of the newest measurement taken in
        self._breaks: list[tuple[int, Model, Callable[[Array], Array]]] = []  # see `change`, ascending in the tick

    def take(self, plan: Plan) -> None:
        """Take in another agent's state at a tick before the next measurement's."""
        if plan.tick < self._first:
            return
        if self._kalman is not None:
            for uav, values in zip(plan.uavs, plan.uav_states, strict=True):
                for age, row in enumerate(values.reshape(state.REPORTS, state.REPORTED)):
                    if row[0] > 0.0:
                        self._sense(plan.tick - age, uav - 1, row[1:])
            self._newest[plan.agent] = max(plan.tick, self._newest.get(plan.agent, -1))
            return
        self._received.setdefault(plan.tick, {})[plan.agent] = plan
        self._newest[plan.agent] = max(plan.tick, self._newest.get(plan.agent, -1))
        self._changed(plan.tick)

    def measure(self, measurement: Measurement) -> None:
        """Take in a measurement of a tick not later than the one to be estimated."""
        self.measured = max(self.measured, measurement.tick)
        if measurement.tick >= self._first:
            self._measured[measurement.tick] = measurement
            # Disturbance and reported inputs act in the period before, which is therefore predicted again.
            if self._kalman is not None:
                for uav, *of in zip(measurement.uavs, measurement.uav_states, measurement.inputs, strict=True):
                    self._sense(measurement.tick, uav - 1, np.concatenate(of))
                return
            self._changed(measurement.tick - (self._disturbance is not None or self._motor_lag_s > 0.0))

    def _sense(self, tick: int, uav: int, values: Array) -> None:
        """Take in measurements and inputs of a UAV, once; the inputs acted in the period before."""
        if tick >= self._first and uav not in self._sensors.setdefault(tick, {}):
            self._sensors[tick][uav] = values
            since = tick - self._oldest
            self._sensed_from = since if self._sensed_from is None else min(self._sensed_from, since)
            self._changed(tick - max(1, self._oldest))

    def reports(self, k: int, uavs: Sequence[int]) -> Array:
        """Return measurements and inputs of UAVs, 0-based, at the last ticks, as a plan holds them, (UAVs, 80)."""
        found = np.zeros((len(uavs), state.REPORTS, state.REPORTED))
        for i, uav in enumerate(uavs):
            for age in range(state.REPORTS):
                values = self._sensors.get(k - age, {}).get(uav)
                if values is not None:
                    found[i, age, 0], found[i, age, 1:] = 1.0, values
        return found.reshape(len(uavs), -1)

    def change(self, tick: int, model: Model, moved: Callable[[Array], Array]) -> None:
        """Change the system from a tick on, not before that of the previous change.

        `moved` maps the state before the change to the state after it, (n,) to (n,).
        """
        self._breaks.append((tick, model, moved))
        self._changed(tick - 1)

    def estimate(self, k: int, announced: AnnouncedInputs) -> Array:
        """Return the estimate at tick k, read-only, with the announced inputs between the ticks as known now.

        Ticks come in order; gaps are bridged by prediction.
        """
        if not self._estimates:
            self._first = k
            self._sensors = {tick: sensed for tick, sensed in self._sensors.items() if tick >= k}
            self._received = {tick: plans for tick, plans in self._received.items() if tick >= k}
            self._measured = {tick: measurement for tick, measurement in self._measured.items() if tick >= k}
            self._estimates = [self._joined(self._reference_at(k), k)]
        begin = self._first + len(self._estimates) - 1
        if self._stale_from is not None:
            begin = min(begin, max(self._stale_from, self._first))
            self._stale_from = None
        at = begin - self._first
        del self._estimates[at + 1 :]
        del self._priors[at + 1 :], self._beliefs[at + 1 :]
        if self._kalman is None or self._sensed_from is None or self._sensed_from <= begin or not self._beliefs:
            del self._beliefs[at:]
            self._estimates[at] = self._joined(self._estimates[at].copy(), begin)
        self._sensed_from = None
        for tick in range(begin, k):
            u = announced.at(tick, before=k, x=self._estimates[-1])
            if self._kalman is not None:
                unannounced = announced.unannounced(tick, before=k)
                for uav, values in self._sensors.get(tick + 1, {}).items():
                    u[state.input_slice(uav)] = values[state.SENSED :]
                    unannounced[:, state.input_slice(uav)] = False
                self._filter(tick, u, unannounced, self._kalman)
            elif self._disturbance is None:
                if self._motor_lag_s > 0.0:
                    self._report(u, tick + 1)
                self._estimates.append(self._overwritten(self._predicted(tick, u), tick + 1))
            else:
                self._estimates.append(self._disturbed(tick, u, self._disturbance))
        self._forget()
        return self._estimates[-1]

    @property
    def belief(self) -> Belief | None:
        """Newest belief of a Kalman filter; None without one."""
        return self._beliefs[-1] if self._beliefs else None

    def known(self, tick: int) -> Array | None:
        """Return the estimate at a past tick, read-only; None where it is not kept."""
        at = tick - self._first
        return self._estimates[at] if 0 <= at < len(self._estimates) else None

    def age(self, agent: int, tick: int) -> int:
        """Return the ticks since the newest state received from another agent, -1 for none."""
        return tick - self._newest[agent] if agent in self._newest else -1

    def inputs_until(self, k: int, announced: AnnouncedInputs) -> Array:
        """Return the inputs announced for the period before tick k, after `estimate` for that tick, (4 N,)."""
        return announced.at(k - 1, before=k, x=self.known(k - 1))

    def reported_inputs(self, tick: int) -> Array | None:
        """Return the inputs that the own actuators report at a tick, (owned, 4), N and N m, if measured."""
        measurement = self._measured.get(tick)
        return None if measurement is None else measurement.inputs

    def _changed(self, tick: int) -> None:
        self._stale_from = tick if self._stale_from is None else min(self._stale_from, tick)

    @property
    def _oldest(self) -> int:
        """Age of the oldest quantity in a message, ticks."""
        return 0 if self._kalman is None else max(self._kalman.ages)

    def _filter(self, tick: int, u: Array, unannounced: npt.NDArray[np.bool_], kalman: KalmanFilter) -> None:
        """Add prior, belief and estimate of the next tick."""
        before = self._beliefs[-1]
        ahead = self._predicted(tick, u, kalman.forces(before))
        prior = kalman.predict(before, self._model_at(tick), tick, ahead, u, *unannounced)
        for since, _, moved in self._breaks:
            if since == tick + 1:
                shifted = ahead + 1.0  # entries that a failure sets do not stay where they are moved to
                prior = kalman.certain(prior, np.flatnonzero(moved(shifted) != shifted))
        self._priors.append(prior)
        self._estimates.append(self._joined(ahead, tick + 1))

    def _joined(self, x: Array, tick: int) -> Array:
        """Return the estimate at a tick from its prediction and the messages of the tick."""
        if self._kalman is None:
            return self._overwritten(x, tick)
        at = tick - self._first
        if at == len(self._priors):
            self._priors.append(self._kalman.first(x))
        self._beliefs.append(self._kalman.correct(self._priors[at], self._model_at(tick), list(self._sensed(tick))))
        return self._beliefs[at].x

    def _sensed(self, tick: int) -> Iterator[tuple[int, tuple[int, ...], Array]]:
        """Yield UAV, sensors and measurements of all that is known of a tick."""
        for age, sensors in self._sensors_of_age:
            for uav, values in sorted(self._sensors.get(tick + age, {}).items(), key=itemgetter(0)):
                yield uav, sensors, values

    def _model_at(self, tick: int) -> Model:
        return next((model for since, model, _ in reversed(self._breaks) if since <= tick), self._model)

    def _disturbed(self, tick: int, u: Array, disturbance: DisturbanceEstimator) -> Array:
        """Return the estimate at the next tick under the disturbance, and correct the disturbance estimate.

        The correction is made once for each period with measurements at both ends.
        """
        end = self._measured.get(tick + 1)
        # A wrong input would look like a force.
        self._report(u, tick + 1)
        forces = disturbance.forces
        ahead = self._predicted(tick, u, forces)
        found = self._overwritten(ahead.copy(), tick + 1)
        if end is not None and tick in self._measured and tick >= self._learned:
            self._learned = tick + 1
            n = self._model.system.n
            disturbance.learn(ahead[:n], found[:n])
        return found

    def _report(self, u: Array, tick: int) -> None:
        """Replace announced inputs until a tick by those that the own actuators report, if measured."""
        measurement = self._measured.get(tick)
        if measurement is not None:
            for uav, inputs in zip(measurement.uavs, measurement.inputs, strict=True):
                u[state.input_slice(uav - 1)] = inputs

    def _predicted(self, tick: int, u: Array, forces: Array | None = None) -> Array:
        """Predict the next state from the newest estimate.

        If integration from a received state diverges, use the reference state.
        """
        model, steps = self._model_at(tick), STEPS if self._kalman is None else 1
        ahead, _ = motors.integrate(model, self._estimates[-1], u, self._period_s, steps, self._motor_lag_s, forces)
        if np.abs(ahead).max() > state.LARGEST:
            return self._reference_at(tick + 1)
        for since, _, moved in self._breaks:
            if since == tick + 1:
                ahead = moved(ahead)
        return ahead

    def _reference_at(self, tick: int) -> Array:
        """Return the reference state at a tick, with the failures so far."""
        x = self._reference(tick)
        for since, _, moved in self._breaks:
            if since <= tick:
                x = moved(x)
        return x

    def _overwritten(self, x: Array, tick: int) -> Array:
        """Replace predicted states by those measured or received for that tick."""
        measurement = self._measured.get(tick)
        if measurement is not None:
            x[: state.PAYLOAD] = measurement.payload
            for uav, block in zip(measurement.uavs, measurement.uav_states, strict=True):
                x[state.uav_slice(uav - 1)] = block
        for plan in self._received.get(tick, {}).values():
            for uav, block in zip(plan.uavs, plan.uav_states, strict=True):
                x[state.uav_slice(uav - 1)] = block
        x.setflags(write=False)
        return x

    def _forget(self) -> None:
        while len(self._estimates) > WINDOW:
            del self._estimates[0], self._priors[:1], self._beliefs[:1]
            self._received.pop(self._first, None)
            self._sensors.pop(self._first, None)
            self._measured.pop(self._first, None)
            self._first += 1
