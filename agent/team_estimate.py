"""State and inputs of the whole team as one agent estimates them, through changes of the roster and failures."""

from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np

from agent.announced import AnnouncedInputs
from agent.disturbance import DisturbanceEstimator
from agent.estimator import WINDOW, StateEstimator
from agent.kalman import KalmanFilter
from model import state
from model.arrays import Array
from model.hover import motor_off_state, released_state
from model.state import input_indices
from mpc.controller import Controller
from mpc.prediction import Prediction
from mpc.tracking import Course
from protocol.scenario.setup import Setup
from protocol.wire.messages import Measurement, Plan


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """Information of an agent at a tick."""

    measurement: Measurement  # the tick's own
    measurements: Sequence[Measurement]  # those that have become usable since the last step, in order
    plans: Sequence[Plan]  # plans of the others that have become usable since the last step, in order
    lost: int  # plans known since then to be lost on their links
    agents: Set[int]  # on the roster, 1-based
    off: frozenset[int]  # UAVs whose motors are off, 0-based
    released: frozenset[int]  # those of them that are released
    failed_since: int  # tick of the newest failure of a UAV
    ticks_since_start: int  # since this process joined
    started_ns: int  # begin of the step on the stopwatch


class TeamEstimate:
    """Estimate of one agent; the controller is kept up to date with the team.

    Attributes:
        announced: Inputs announced by all agents.
        estimator: Estimated states, by tick.
    """

    def __init__(self, setup: Setup, agent: int, controller: Controller) -> None:
        self._setup, self._agent, self._controller = setup, agent, controller
        self._owned = setup.owned[agent - 1]
        self.peers = tuple(other for other in setup.agents if other != agent)
        self._off_roster: set[int] = set()  # agents that the controller leaves out
        self.restart()

    def restart(self) -> None:
        """Reset for a new start in the run; the controller keeps its state, also the agents that it leaves out."""
        setup, section = self._setup, self._setup.scenario.controller
        period_s = setup.settings.sampling_period_s
        self._disturbance: DisturbanceEstimator | None = None
        self._filtered: Array | None = None  # forces that the Kalman filter has estimated by the last tick
        if section.disturbance.estimate and section.estimator == "measured":
            self._disturbance = DisturbanceEstimator(
                setup.model, setup.hover, self._owned, period_s, section.disturbance.time_constant_s
            )
        self._kalman = KalmanFilter(setup, self._feedback, self._owned) if section.estimator == "kalman" else None
        self.estimator = StateEstimator(
            setup.model, self._reference, period_s, self._disturbance, setup.settings.motor_lag_s, self._kalman
        )
        self.announced = AnnouncedInputs(
            setup.owned,
            setup.hover.u,
            setup.fail_safe,
            section.received_plans,
            own=self._agent,
            law=self._law_inputs,
            past=self.estimator.known,
            settings=setup.settings,
            carried=self._kalman is None,
        )
        self._failed: tuple[frozenset[int], frozenset[int]] = frozenset(), frozenset()  # UAVs off, and released
        # Start, prediction and own inputs of the last step.
        self._expected: tuple[int, Prediction | Course, Array] | None = None
        # Arguments and result of `_law_inputs` by tick.
        self._law_cache: dict[int, tuple[Array, Array | None, object, Array | None]] = {}

    def head(self, setup: Setup) -> None:
        """Take the reference from a run with a further target."""
        self._setup = setup
        if setup.ahead is not None and self._controller.regulation.head(setup.X_ref, setup.ahead):
            self.announced.law_since = setup.ahead.first
        self.announced.fail_safe = self._controller.regulation.fail_safe

    @property
    def forces(self) -> Array | None:
        """Estimated external forces, (3 + 3 N,), inertial frame, N; None where they are not estimated."""
        return self._filtered if self._disturbance is None else self._disturbance.forces

    def update(self, known: Known) -> Array:
        """Take in what is known at a tick and return the estimated state, (n,); with motor lag (n + m,)."""
        k = known.measurement.tick
        self._update_roster(known)
        for plan in known.plans:
            self.announced.add(plan)
            self.estimator.take(plan)
        for measurement in known.measurements:
            self.estimator.measure(measurement)
        x = self.estimator.estimate(k, self.announced)
        if self._kalman is not None and self.estimator.belief is not None:
            self._filtered = self._kalman.forces(self.estimator.belief)
        if self._setup.scenario.controller.received_states == "as_received":
            x = self._with_states_as_received(x, k)
        return x

    def reported(self, k: int, x: Array) -> Array:
        """Return what a plan of tick k says of the own UAVs: their states, (owned, 12), in an estimate, (n,).

        With vehicle sensors it says the measurements and inputs of the last ticks instead, (owned, 80).
        """
        if self._kalman is None:
            return state.StateView(x[: self._setup.system.n]).uavs[list(self._owned)]
        return self.estimator.reports(k, self._owned)

    def inputs_until(self, k: int) -> Array:
        """Return the inputs in force until a tick: own ones as the actuators report them, the others as announced."""
        u = self._setup.hover.u.copy()
        if k > 0:
            u = self.estimator.inputs_until(k, self.announced)
        reported = self.estimator.reported_inputs(k)
        if reported is not None:
            u[input_indices(self._owned)] = reported.reshape(-1)
        return u

    def expect(self, start: int, prediction: Prediction | Course, inputs: Array) -> None:
        """Keep a step's prediction from tick `start` on, from which the inputs of an agent that leaves are taken."""
        self._expected = start, prediction, inputs

    def _update_roster(self, known: Known) -> None:
        """Take in the roster of a tick; all agents do that at the same tick."""
        tick = known.measurement.tick
        off_roster = set(self._setup.agents) - known.agents
        self.announced.off_roster = off_roster
        if self._controller.regulation.advance(tick):
            self.announced.law_since = tick
        # An agent that starts has no control law for the meantime.
        since = tick if known.ticks_since_start > 0 else None
        self._update_failures(known, since)
        if off_roster == self._off_roster:
            return
        for agent in self._off_roster - off_roster:
            self.announced.forget(agent)
        for agent in off_roster - self._off_roster:
            self._assume_last_plan(agent, tick)
        self._off_roster, self.announced.law_since = off_roster, tick
        self._controller.without([uav for agent in sorted(off_roster) for uav in self._setup.owned[agent - 1]], since)

    def _assume_last_plan(self, agent: int, tick: int) -> None:
        """Assume the predicted inputs of an agent that leaves the roster at a tick, if its last plan was not received.

        Source: docs/equations.md (32b).
        """
        newest = self.announced.newest(agent, before=tick)
        if self._expected is not None and newest is not None and newest.tick < tick - 1:
            start, prediction, inputs = self._expected
            self.announced.assume(agent, start, self._controller.foreseen(prediction, inputs))

    def _update_failures(self, known: Known, since: int | None) -> None:
        """Switch to model and control law of the remaining UAVs if further UAVs have failed."""
        off, released = known.off, known.released
        known_off, known_released = self._failed
        if (off, released) == self._failed:
            return
        self._failed = off, released
        stopped, cut = sorted(off - known_off - released), sorted(released - known_released)

        def moved(x: Array) -> Array:
            for uav in stopped:
                x = motor_off_state(x, uav)
            for uav in cut:
                x = released_state(x, uav)
            return x

        controller, failed = self._controller, min(known.measurement.tick, known.failed_since)
        controller.fail(off, released, since)
        self.announced.fail_safe = controller.regulation.fail_safe
        self.estimator.change(failed, controller.model, moved)
        self.announced.failed_since = failed
        left = [uav for uav in self._owned if uav not in off]
        if self._disturbance is not None and left:
            self._disturbance.rebuild(controller.model, controller.regulation.hover, left)

    def _law_inputs(self, tick: int, x: Array) -> Array | None:
        """Return inputs of all UAVs by the shared control law, without corrections, (m,); None for open loop.

        Cached by tick: the inputs are needed for each of the others, and those of a past tick again at later ticks.
        """
        forces, regulation = self.forces, self._controller.regulation
        cached = self._law_cache.get(tick)
        if cached is None or cached[0] is not x or cached[1] is not forces or cached[2] is not regulation.version:
            inputs = regulation.inputs(x, self._setup.X_ref[tick], forces, tick)
            cached = self._law_cache[tick] = x, forces, regulation.version, inputs
            if len(self._law_cache) > 2 * WINDOW:
                del self._law_cache[min(self._law_cache)]
        return cached[3]

    def _feedback(self, tick: int) -> Array:
        """Return the gain of the shared control law at a tick, (m, n); with motor lag (m, n + m)."""
        return self._controller.regulation.gain(tick)

    def _reference(self, tick: int) -> Array:
        """Return the reference state at a tick, (n,); with motor lag (n + m,), the actual inputs those of hover."""
        reference: Array = self._setup.X_ref[tick].copy()
        return np.concatenate([reference, self._setup.hover.u]) if self._setup.settings.motor_lag_s else reference

    def _with_states_as_received(self, x: Array, k: int) -> Array:
        """Return the estimate with the others' states as last received, not predicted to the tick."""
        x = x.copy()
        for plan in filter(None, (self.announced.newest(agent, before=k) for agent in self.peers)):
            for uav, block in zip(plan.uavs, plan.uav_states, strict=True):
                x[state.uav_slice(uav - 1)] = block
        return x
