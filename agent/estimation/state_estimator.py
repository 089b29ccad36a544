"""Estimator from measured and received states: prediction, with states of each tick replaced.

The measurement of tick k holds the payload and the owned UAVs. The others' states are received with
their plans, at least one tick late. Each received state is inserted at its tick, and the prediction
repeated from there with the inputs now known for that time.

With motor lag the state is [x, a]: the actual inputs a follow from hover with the commands; errors
decay with the lag.
"""

from collections.abc import Mapping, Sequence

from transport.agent.communication.announced_inputs import AnnouncedInputs
from transport.agent.estimation.disturbance import DisturbanceEstimator, MeasuredTeam
from transport.agent.estimation.predicted_motion import Failure, PredictedMotion
from transport.agent.estimation.received_states import NewStates, Reports, UavReport, by_uav
from transport.agent.estimation.repeated_ticks import History, TickRecursion
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.wire.messages import Measurement, Plan


class StateEstimator:
    """Estimator of the whole state, (n,), with motor lag [x, a], (n + m,), from the reference on.

    Args:
        motion: Prediction between ticks.
        owned: UAVs of the agent, 0-based.
        disturbance: Estimator of external forces, fed with the prediction errors; None for none.
    """

    belief = None  # no covariance

    def __init__(
        self,
        motion: PredictedMotion,
        owned: Sequence[int],
        disturbance: DisturbanceEstimator | None = None,
    ) -> None:
        self.new_states = NewStates()
        self.resets: set[int] = set()  # none: estimates are measured
        self._motion = motion
        self._owned = list(owned)
        self._disturbance = disturbance
        self._learned = -1  # newest tick whose measurement the disturbance estimator has
        # Whether reported inputs replace announced ones: a wrong input would look like a force.
        self._uses_inputs = disturbance is not None or motion.lag_s > 0.0
        self._reports = Reports()
        self._history: History[Array] = History()
        # Inputs in force over the newest period of the estimate, (4 N,); None before there is one.
        self._newest_inputs: Array | None = None

    @property
    def forces(self) -> Array | None:
        """Estimated external forces, (3 + 3 N,), inertial frame, N; None where not estimated."""
        return None if self._disturbance is None else self._disturbance.forces

    def take(self, plan: Plan) -> None:
        """Take in another agent's states at a tick before the next measurement's."""
        # Reports give the age of the newest state of the sender that an estimate could use.
        if not self._history.keeps(plan.tick):
            return
        self.new_states.take(plan)
        for uav, values in zip(plan.uavs, plan.uav_states, strict=True):
            self._tell(plan.tick, uav - 1, UavReport(values))

    def measure(self, measurement: Measurement) -> None:
        """Take in a measurement of a tick not later than the one to be estimated."""
        tick = measurement.tick
        # Reports give the age of the newest own measurement, also of one too old to be used.
        self.new_states.take(measurement)
        if not self._history.keeps(tick):
            return
        self._reports.tell_payload(tick, measurement.payload)
        for uav, report in by_uav(measurement):
            self._tell(tick, uav, report)

    def _tell(self, tick: int, uav: int, report: UavReport) -> None:
        if self._reports.has(tick, uav):
            return
        self._reports.tell(tick, uav, report)
        self._history.tell(tick)
        if report.inputs is not None and self._uses_inputs:
            self._history.outdate_after(tick - 1)  # they acted in the period before

    def change(self, failure: Failure) -> None:
        """Change the system at a tick, not before the previous change."""
        self._motion.add(failure)
        # An agent may learn of it late: the step to its tick, which ends in another state, is repeated.
        self._history.outdate_after(failure.tick - 1)
        if self._disturbance is not None and failure.own_left:
            team = MeasuredTeam(model=failure.model, hover=failure.hover, owned=failure.own_left)
            self._disturbance.rebuild(team)

    def estimate(self, k: int, announced: AnnouncedInputs) -> Array:
        """Return the estimate at tick k, read-only, with the inputs between the ticks as known now.

        Ticks come in order; gaps are bridged by prediction.
        """

        def following(x: Array, tick: int) -> Array:
            u = announced.in_force(tick, before=k, x=x)
            self._newest_inputs = u
            is_learning = self._disturbance is not None and tick >= self._learned
            is_informed = is_learning and announced.heard.is_informed(tick + 1, before=k)
            return self._advanced(x, tick, u, is_informed=is_informed)

        recursion = TickRecursion(
            begin=self._motion.reference_at, corrected=self._joined, following=following
        )
        x = self._history.advance(k, recursion)
        self._reports.forget_before(self._history.first)
        return x

    def past(self, tick: int) -> Array | None:
        """Return the estimate at a past tick, read-only; None where it is not kept."""
        return self._history.entry(tick)

    def start_state(self, tick: int) -> Array | None:
        """Return the estimate at the start of a received plan; None where it is not kept."""
        return self._history.entry(tick)

    def inputs_until(self, k: int, announced: AnnouncedInputs) -> Array:
        """Return the inputs in force until tick k, after `estimate` for it, (4 N,)."""
        return self._reports.inputs_until(k, self._newest_inputs, announced)

    def reported(self, k: int, x: Array) -> Array:  # noqa: ARG002  # the estimate is of this tick
        """Return the estimated states of the own UAVs for the plan of tick k, (owned, 12)."""
        n = self._motion.model.system.n
        return state.uav_blocks(x[:n])[self._owned]

    def log_numbers(self) -> Mapping[str, float]:
        """Return numbers for the log by name: none."""
        return {}

    def _advanced(self, x: Array, tick: int, u: Array, *, is_informed: bool) -> Array:
        """Return the estimate after `tick` from that of `tick` and the announced inputs between.

        Reported inputs replace those in `u`, in place: `_newest_inputs` is the same array.
        """
        if self._uses_inputs:
            self._reports.apply_inputs(tick + 1, u)
        predicted = self._motion.predict(x, tick, u, self.forces)
        joined = self._joined(predicted, tick + 1)
        self._learn(predicted, joined, tick + 1, is_informed=is_informed)
        return joined

    def _joined(self, x: Array, tick: int) -> Array:
        """Return a state at a tick, read-only, with all that messages of the tick say of it."""
        x = x.copy()
        payload = self._reports.payload(tick)
        if payload is not None:
            x[: state.PAYLOAD] = payload
        for uav, report in self._reports.uavs(tick).items():
            x[state.uav_slice(uav)] = report.values
        x.setflags(write=False)
        return x

    def _learn(self, predicted: Array, joined: Array, tick: int, *, is_informed: bool) -> None:
        """Correct the disturbance estimate, once per tick, if both its ends are measured.

        Not without information about the others: what they do differently would count as a force.
        """
        if self._disturbance is None or tick <= self._learned:
            return
        ends = (self._reports.payload(tick - 1), self._reports.payload(tick))
        if any(payload is None for payload in ends):
            return
        n = self._motion.model.system.n
        self._learned = tick
        if is_informed:
            self._disturbance.learn(predicted[:n], joined[:n])
