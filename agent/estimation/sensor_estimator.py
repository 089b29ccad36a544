"""Estimator from the sensors of all UAVs: a Kalman filter, repeated where measurements came late.

Messages hold measurements of the UAVs' own sensors and the inputs that their actuators applied. A
tick has a belief before and after its measurements, and a late message has the filter repeat its
work from that message's tick on.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from transport.agent.communication.announced_inputs import AnnouncedInputs
from transport.agent.estimation.estimate_notes import NAMES, pose_numbers
from transport.agent.estimation.filter.belief import Belief
from transport.agent.estimation.filter.filter_interface import Filter, FilterPeriod, Sensed
from transport.agent.estimation.predicted_motion import Failure, PredictedMotion
from transport.agent.estimation.received_states import NewStates, Reports, UavReport, by_uav
from transport.agent.estimation.repeated_ticks import History, TickRecursion
from transport.agent.silence.silence_thresholds import SHARED
from transport.model import state
from transport.model.arrays import Array, ShapeError
from transport.protocol.wire.messages import Measurement, Plan

# Gain of the shared control law at a tick, (m, n), with motor lag (m, n + m). Rows of UAVs without an
# agent hold the gain of the fail-safe.
Feedback = Callable[[int], Array]


@dataclass(frozen=True, slots=True)
class FilterTick:
    """Beliefs at a tick."""

    prior: Belief  # before its measurements
    posterior: Belief  # after them


class SensorEstimator:
    """Estimator of the whole state, (n,), with motor lag [x, a], (n + m,), from the reference on.

    Args:
        motion: Prediction between ticks.
        owned: UAVs of the agent, 0-based.
        team_filter: Kalman filter of the team.
        feedback: Gain by which the other agents answer to their estimates.
        ages: Sampling periods from a quantity to its measurement, by sensor.
    """

    def __init__(
        self,
        motion: PredictedMotion,
        owned: Sequence[int],
        team_filter: Filter,
        feedback: Feedback,
        ages: Sequence[int],
    ) -> None:
        self.new_states = NewStates()
        self.resets: set[int] = set()  # ticks at which the filter began anew about the reference
        self.forces: Array | None = None  # of the last estimate, (4 + 3 N,); None if not estimated
        self._motion = motion
        self._owned = list(owned)
        self._filter = team_filter
        self._feedback = feedback
        self._oldest = max(ages)
        self._sensors_by_age = [
            (age, tuple(sensor for sensor, of_sensor in enumerate(ages) if of_sensor == age))
            for age in sorted(set(ages))
        ]
        self._reports = Reports()
        self._history: History[FilterTick] = History()
        # Inputs in force over the newest period of the estimate, (4 N,); None before there is one.
        self._newest_inputs: Array | None = None

    @property
    def belief(self) -> Belief | None:
        """Newest belief; None before the first estimate."""
        newest = self._history.newest
        return None if newest is None else newest.posterior

    def take(self, plan: Plan) -> None:
        """Take in the measurements of another agent at the last ticks before its plan's."""
        if not self._history.keeps(plan.tick):
            return
        self.new_states.take(plan)
        for uav, rows in zip(plan.uavs, plan.uav_states, strict=True):
            newest_first = rows.reshape(state.REPORTS, state.REPORTED)
            for age, row in enumerate(newest_first):
                tick = plan.tick - age
                if row[state.IS_KNOWN] > 0.0 and self._is_new(tick, uav - 1):
                    report = UavReport(
                        values=row[state.SENSED_VALUES],
                        inputs=row[state.REPORTED_INPUTS],
                        missing=int(row[state.IS_KNOWN]) - 1,
                    )
                    self._tell(tick, uav - 1, report)

    def measure(self, measurement: Measurement) -> None:
        """Take in a measurement of a tick not later than the one to be estimated."""
        self.new_states.take(measurement)
        for uav, report in by_uav(measurement):
            if self._is_new(measurement.tick, uav):
                self._tell(measurement.tick, uav, report)

    def _is_new(self, tick: int, uav: int) -> bool:
        """Return whether a report of a UAV, 0-based, is new: most repeat one of an earlier plan."""
        return self._history.keeps(tick) and not self._reports.has(tick, uav)

    def _tell(self, tick: int, uav: int, report: UavReport) -> None:
        """Keep a report of a UAV, 0-based.

        Its inputs acted in the period before; its measurements are of quantities up to the largest
        age of a sensor before.
        """
        self._reports.tell(tick, uav, report)
        # Its oldest value is of this tick: corrections from there on are repeated.
        self._history.tell(tick - self._oldest)
        self._history.outdate_after(tick - 1)  # other inputs in the period before

    def change(self, failure: Failure) -> None:
        """Change the system at a tick, not before the previous change."""
        self._motion.add(failure)
        self._history.outdate_after(failure.tick - 1)

    def estimate(self, k: int, announced: AnnouncedInputs) -> Array:
        """Return the estimate at tick k, read-only, with the inputs between the ticks as known now.

        Ticks come in order; gaps are bridged by prediction.
        """

        def following(entry: FilterTick, tick: int) -> FilterTick:
            period = self._period(entry.posterior, tick, announced, k)
            return self._advanced(entry.posterior, tick, period)

        recursion = TickRecursion(begin=self._begin, corrected=self._corrected, following=following)
        belief = self._history.advance(k, recursion).posterior
        self._reports.forget_before(self._history.first)
        self.forces = self._filter.forces(belief)
        return belief.x

    def past(self, tick: int) -> Array | None:
        """Return the estimate at a past tick, read-only; None where it is not kept."""
        entry = self._history.entry(tick)
        return None if entry is None else entry.posterior.x

    def start_state(self, tick: int) -> Array | None:  # noqa: ARG002  # of any tick
        """Return None: a plan differs at its first step mostly by its sender's estimation error."""
        return None

    def inputs_until(self, k: int, announced: AnnouncedInputs) -> Array:
        """Return the inputs in force until tick k, after `estimate` for it, (4 N,)."""
        return self._reports.inputs_until(k, self._newest_inputs, announced)

    def reported(self, k: int, x: Array) -> Array:  # noqa: ARG002  # measurements, not the estimate
        """Return measurements and inputs of the own UAVs for the plan of tick k, (owned, 80).

        Each plan repeats those of the last ticks: the loss of one plan loses no measurement.
        """
        return self._reports.rows(k, self._owned)

    def log_numbers(self) -> Mapping[str, float]:
        """Return the pose of the payload with its covariance for the log, by name."""
        belief = self.belief
        if belief is None:
            return {}
        try:
            return dict(zip(NAMES, pose_numbers(belief).tolist(), strict=True))
        except (ShapeError, np.linalg.LinAlgError):
            return {}  # its covariance, computed only now, is out of range: the next tick begins anew

    def _begin(self, tick: int) -> FilterTick:
        """Return the beliefs about the reference, without any measurement: a new start."""
        belief = self._filter.first(self._motion.reference_at(tick))
        return FilterTick(prior=belief, posterior=belief)

    def _period(
        self, belief: Belief, tick: int, announced: AnnouncedInputs, k: int
    ) -> FilterPeriod:
        """Return the period after `tick` as it is understood at tick k, and keep its inputs.

        The last call of an `advance` is for the newest period, of which `inputs_until` tells.
        """
        # What plans announced, replaced in place by what UAVs have reported: a report at tick + 1
        # has the inputs that acted from `tick` on.
        u = announced.in_force(tick, before=k, x=belief.x)
        self._reports.apply_inputs(tick + 1, u)
        self._newest_inputs = u

        # Inputs that are not told answer to the state: du = K dx. The gain is that of the law of
        # now, whenever the covariance is computed.
        unannounced = announced.unannounced(tick, before=k)
        for uav in self._reports.uavs(tick + 1):
            unannounced.tell(uav)
        K = self._feedback(tick) if unannounced.any() else None

        # x(k' + 1) of k' = tick, under the estimated forces: (13b).
        forces = self._filter.forces(belief)
        return FilterPeriod(
            model=self._motion.model_at(tick),
            end=self._motion.predict(belief.x, tick, u, forces),
            u=u,
            forces=forces,
            unannounced=unannounced,
            K=K,
            correlation=SHARED,
            silent=announced.silent(tick, before=k),
        )

    def _advanced(self, belief: Belief, tick: int, period: FilterPeriod) -> FilterTick:
        """Return the beliefs after a period that began at `tick`."""
        try:
            prior = self._filter.predict(belief, period)
            for entries in self._motion.set_entries(period.end, tick + 1):
                prior = self._filter.certain(prior, entries)
        except (ShapeError, np.linalg.LinAlgError):
            return self._begun_anew(tick + 1)
        return self._corrected(FilterTick(prior=prior, posterior=prior), tick + 1)

    def _corrected(self, entry: FilterTick, tick: int) -> FilterTick:
        """Return the beliefs of a tick with all its measurements."""
        posterior = self._plausible(entry.prior, tick)
        if posterior is None:
            return self._begun_anew(tick)
        return FilterTick(prior=entry.prior, posterior=posterior)

    def _begun_anew(self, tick: int) -> FilterTick:
        """Return the beliefs of a tick about the reference, as those before were implausible.

        The cause may be a measurement of this tick: then without it.
        """
        self.resets.add(tick)
        anew = self._filter.first(self._motion.reference_at(tick))
        return FilterTick(prior=anew, posterior=self._plausible(anew, tick) or anew)

    def _plausible(self, prior: Belief, tick: int) -> Belief | None:
        """Return a belief with the measurements of its tick; None if it is implausible."""
        try:
            belief = self._filter.correct(prior, self._motion.model_at(tick), self._sensed(tick))
        except (ShapeError, np.linalg.LinAlgError):
            return None
        return belief if self._filter.is_plausible(belief) else None

    def told(self, tick: int, uav: int) -> UavReport | None:
        """Return the report of a UAV, 0-based, at a tick; None without one."""
        return self._reports.uavs(tick).get(uav)

    def _sensed(self, tick: int) -> list[Sensed]:
        """Return all measurements of quantities at a tick.

        A sensor of age d reports at tick k + d what was at tick k: z(k + d) = h(x(k)).
        """
        sensed = []
        for age, sensors in self._sensors_by_age:
            reports = self._reports.uavs(tick + age)
            for uav in sorted(reports):
                missing = reports[uav].missing
                measured = tuple(one for one in sensors if state.is_measured(one, missing))
                if measured:
                    sensed.append(Sensed(uav=uav, sensors=measured, values=reports[uav].values))
        return sensed
